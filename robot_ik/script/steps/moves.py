"""Steps that move the arm to a goal and wait until the servos have arrived."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import model_validator

from robot_ik.config import KeyProblem, Position, Positive, Word, Wxyz
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.motion.line import line_move
from robot_ik.motion.trajectory import Trajectory, joint_move
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.script.state import RunState, StepResult
from robot_ik.script.steps.base import Action, Framed, Share, require_known
from robot_ik.script.steps.findings import Finding, error_finding, report_findings
from robot_ik.script.steps.gripper import gripper_joints
from robot_ik.script.steps.joints import JointValues, Tolerant, keyframes
from robot_ik.workcell.verdict import SOLVE_TOLERANCE

#: Measures the errors at the end of a move. The arm arrived if all findings are ok.
Judge = Callable[[], list[Finding]]


class Move(Tolerant, Action):
    """A planned motion. It ends when the servos have arrived within the tolerance.

    Attributes:
        speed: Share of the speed limits. None: the script's speed.
    """

    speed: Share | None = None

    def run(self, state: RunState, result: StepResult) -> None:
        """Plan the motion, send it, and wait until the servos have arrived.

        Raises:
            StepFailed: The servos did not arrive, or not in time.
            NotConvergedError: No joint values reach the goal. Nothing was sent.
            TrajectoryError: There is no path. Nothing was sent.
            RobotIkError: The arm or the camera failed.
        """
        trajectory, judge = self.plan(state, state.start(), result)

        def arrived() -> bool:
            return all(finding.ok for finding in judge())

        state.play(trajectory, self.time_limit_s, arrived, result)
        report_findings(judge(), result, "not arrived: ")

    def plan(self, state: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """Plan the motion.

        Args:
            state: State of the run.
            start: Joint values at the start, (nq,) in rad and m.
            result: Result of the step, for measured values.

        Returns:
            The trajectory, and the judge of its end.
        """
        raise NotImplementedError

    def caps(self, state: RunState) -> dict[str, Any]:
        """Return the speed limits as arguments of ``joint_move``."""
        return state.setup.caps(self.speed or state.script.speed)

    def by_goal(self, state: RunState, goal: Goal) -> Judge:
        """Return a judge that measures the error of a goal at the measured joint values."""

        def judge() -> list[Finding]:
            metres, radians = goal.error(state.robot, state.setup.q)
            frame = goal.frame or state.robot.tool
            findings = [error_finding(1e3 * metres, self.tolerance_mm, " mm", frame, "off_mm")]
            has_rotation = goal.weights[1] > 0.0
            if has_rotation:
                degrees = float(np.degrees(radians))
                findings.append(error_finding(degrees, self.tolerance_deg, "°", frame, "off_deg"))
            return findings

        return judge

    def to_goal(
        self, state: RunState, start: Array, goal: Goal, judged_goal: Goal
    ) -> tuple[Trajectory, Judge]:
        """Plan a straight motion in joint space to a goal.

        Args:
            state: State of the run.
            start: Joint values at the start, (nq,) in rad and m.
            goal: Goal of the solve.
            judged_goal: Goal that the judge measures.
        """
        q = solve_for(state, goal, start)
        trajectory = joint_move(state.robot, start, q, **self.caps(state))
        return state.setup.checked(trajectory), self.by_goal(state, judged_goal)

    def to_joints(self, state: RunState, start: Array, q: Array) -> tuple[Trajectory, Judge]:
        """Plan a straight motion in joint space to joint values.

        Args:
            state: State of the run.
            start: Joint values at the start, (nq,) in rad and m.
            q: Joint values at the end, (nq,) in rad and m.
        """

        def judge() -> list[Finding]:
            return [self.farthest(state.robot, state.setup.q, q)]

        trajectory = joint_move(state.robot, start, q, **self.caps(state))
        return state.setup.checked(trajectory), judge


def solve_for(state: RunState, goal: Goal, start: Array) -> Array:
    """Return joint values that meet a goal, (nq,) in rad and m. The gripper keeps its values.

    Args:
        state: State of the run. The status of the solve is written into it.
        goal: The goal.
        start: Start of the solve, (nq,) in rad and m.

    Raises:
        NotConvergedError: The solver found no joint values.
    """
    problem = Problem(
        state.robot,
        goal,
        solver=state.solver,
        tolerance=SOLVE_TOLERANCE,
        seed=state.seed,
        collisions=state.setup.collisions,
    )
    solution = problem.solve(start)
    state.status = solution.status.name
    q = np.array(solution.require().q)

    # An open gripper would drop what it holds.
    gripper = gripper_joints(state.robot)
    fingers = [index for index, name in enumerate(state.robot.joints) if name in gripper]
    q[fingers] = start[fingers]
    return q


class PositionStep(Framed, Move):
    """Move the frame's origin to a position with any orientation.

    Attributes:
        position: Goal of the frame's origin in the world frame, metres.
    """

    title_keys = ("position",)

    do: Literal["position"]
    position: Position

    def plan(self, state: RunState, start: Array, _result: StepResult) -> tuple[Trajectory, Judge]:
        """Plan a straight motion in joint space."""
        goal = PositionGoal(self.frame or state.robot.tool, self.position)
        return self.to_goal(state, start, goal, goal)


class PoseStep(Framed, Move):
    """Move the frame to a position and an orientation, straight in joint space.

    Attributes:
        position: Goal of the frame's origin in the world frame, metres.
        wxyz: Goal of the frame's orientation, as a unit quaternion.
    """

    title_keys = ("position",)

    do: Literal["pose"]
    position: Position
    wxyz: Wxyz

    def plan(self, state: RunState, start: Array, _result: StepResult) -> tuple[Trajectory, Judge]:
        """Plan a straight motion in joint space."""
        goal = PoseGoal(self.frame or state.robot.tool, self.position, self.wxyz)
        return self.to_goal(state, start, goal, goal)


class MarkerStep(Move):
    """Detect the printed marker with the synthetic camera, and move the tool above it."""

    do: Literal["marker"]

    @property
    def needs_camera(self) -> bool:
        """Whether the step needs the synthetic camera."""
        return True

    def plan(self, state: RunState, start: Array, result: StepResult) -> tuple[Trajectory, Judge]:
        """Plan a motion to the detected marker. The judge measures the error to the true marker."""
        if state.vision is None:
            raise RuntimeError("this step needs a camera")
        target = state.vision.find_target()
        if target.true_pose is None:
            raise RuntimeError("the camera of a script must be synthetic")
        goal = target.goal
        true_pose = target.true_pose.compose(state.vision.scene.pose_marker_tool)
        difference = goal.target.position - true_pose.position
        result.numbers["seen_off_mm"] = round(1e3 * float(np.linalg.norm(difference)), 4)

        judged_goal = goal.moved_to(true_pose)
        if isinstance(goal, PoseGoal) and goal.free_axis is not None:
            # Five joints turn the tool's axis within a plane only, and the detected axis is a
            # little outside it.
            angle = 0.5 * float(np.radians(self.tolerance_deg))
            goal = replace(goal, tolerance=Tolerance(SOLVE_TOLERANCE.position, angle))
        return self.to_goal(state, start, goal, judged_goal)


class LineStep(Framed, Move):
    """Move the frame along a straight line.

    Attributes:
        position: End of the line in the world frame, metres.
        by: Vector from the start to the end, instead of ``position``, metres.
        wxyz: Orientation at the end, as a unit quaternion. None: that at the start.
        linear_speed: Largest speed of the frame, m/s.
    """

    title_keys = ("position", "by")

    do: Literal["line"]
    position: Position | None = None
    by: Position | None = None
    wxyz: Wxyz | None = None
    linear_speed: Positive = 0.25

    @model_validator(mode="after")
    def _check_end(self) -> LineStep:
        if (self.position is None) == (self.by is None):
            problem = "a line needs either a position or a vector"
            raise KeyProblem(problem, "position", "position or by")
        return self

    def plan(self, state: RunState, start: Array, _result: StepResult) -> tuple[Trajectory, Judge]:
        """Plan a straight motion of the frame."""
        begin = state.robot.forward(start, self.frame)
        if self.position is None:
            position = begin.position + np.asarray(self.by)
        else:
            position = np.asarray(self.position)
        target = Pose(position, begin.wxyz if self.wxyz is None else self.wxyz)
        trajectory = line_move(
            state.robot,
            start,
            target,
            frame=self.frame,
            linear_speed=self.linear_speed,
            **self.caps(state),
        )
        judge = self.by_goal(state, PoseGoal.at(self.frame, target))
        return state.setup.checked(trajectory), judge


class JointsStep(JointValues, Move):
    """Move the named joints to values. The other joints stay."""

    title_keys = ("joints_deg", "joints_mm")

    do: Literal["joints"]

    @model_validator(mode="after")
    def _check_joints(self) -> JointsStep:
        if self.joints_deg is None and self.joints_mm is None:
            allowed = "joints_deg, joints_mm (slides) or both"
            raise KeyProblem("no joint is named", "joints_deg", allowed)
        return self

    def plan(self, state: RunState, start: Array, _result: StepResult) -> tuple[Trajectory, Judge]:
        """Plan a straight motion in joint space."""
        return self.to_joints(state, start, self.with_values(state.robot, start))


class KeyframeStep(Move):
    """Move all joints to a keyframe of the model.

    Attributes:
        keyframe: Name of the keyframe.
    """

    title_keys = ("keyframe",)

    do: Literal["keyframe"]
    keyframe: Word = "home"

    def check(self, state: RunState) -> None:
        """Check that the model has the keyframe."""
        super().check(state)
        require_known("keyframe", self.keyframe, keyframes(state.robot), "keyframe")

    def plan(self, state: RunState, start: Array, _result: StepResult) -> tuple[Trajectory, Judge]:
        """Plan a straight motion in joint space."""
        return self.to_joints(state, start, keyframes(state.robot)[self.keyframe])
