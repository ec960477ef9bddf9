"""The lion: a paw reaches a ball while the other three stand, and the lion looks at the ball.

The motion is that of the lion of Šimunić's thesis. First key poses are solved: relaxed, leaning
onto three paws with the eyes on the ball, and reaching. ``Keyframes`` interpolates between them.
Inverse kinematics then solves each frame again, with the standing paws and the centre of mass as
hard goals and the frame as posture. Every model can be used whose ``robot.toml`` names four tools
that end in ``_paw`` and one tool ``gaze``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.budget import Budget
from robot_ik.errors import ModelError, TrajectoryError
from robot_ik.figure.decide import Decision
from robot_ik.figure.figure import bodies_between
from robot_ik.figure.hull import hull, hull_edges, inset
from robot_ik.goals import (
    AimGoal,
    CenterOfMassGoal,
    Goal,
    HalfSpaceGoal,
    PoseGoal,
    PositionGoal,
    PostureGoal,
)
from robot_ik.inverse_kinematics import solve
from robot_ik.motion.keyframes import Keyframes
from robot_ik.motion.timing import minimum_jerk
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

MARGIN = 0.03
"""Smallest distance of the centre of mass from the border of the standing paws' triangle, m."""

NEAR = 2e-3
"""Largest distance of a paw's sole from the middle of the ball, m."""

LEAN = 0.7
"""Time of leaning onto three paws, s."""

REACH = 0.9
"""Time of reaching, s."""

HOLD = 0.4
"""Time at the ball, s."""

_SPEED = 4.0
"""Joint speed limit, rad/s. It is below the limits of the model."""

_GAZE_LIMIT_DEG = 100.0
"""Largest angle between straight forward and the gaze, degrees."""

_STRAIGHT = 1e-9
"""A ball at a smaller distance to the side is straight ahead, m."""

_POSE_BUDGET = Budget(iterations=1200, restarts=6)
"""Budget of a key pose. A paw whose pose is not found counts as out of reach."""

_FRAME_BUDGET = Budget(iterations=60, restarts=0)
"""Budget of a frame."""


def is_lion(robot: Robot) -> bool:
    """Return whether a robot has four paws and a gaze."""
    return len(paws_of(robot)) == 4 and "gaze" in robot.frames


def paws_of(robot: Robot) -> tuple[str, ...]:
    """Return the frames of the paws."""
    return tuple(name for name in robot.file.tools if name.endswith("_paw"))


class Lion:
    """Reaches for balls from a relaxed pose.

    Args:
        robot: The model. Default: the bundled lion.

    Attributes:
        robot: The model.
        relaxed: (nq,) home, all paws on the floor.
        paws: Frames of the paws.

    Raises:
        ModelError: The model does not have four paws and a gaze.
    """

    def __init__(self, robot: Robot | None = None) -> None:
        self.robot = robot or load_robot("lion")
        self.relaxed = np.array(self.robot.home)
        self.paws = paws_of(self.robot)
        if not is_lion(self.robot):
            raise ModelError(
                f"{self.robot.name!r} has the paws {', '.join(self.paws) or 'none'}",
                path=self.robot.path,
                hint="name four tools …_paw and one gaze in its robot.toml",
            )
        self._prints = {paw: self.robot.forward(self.relaxed, paw) for paw in self.paws}
        self._lengths = {paw: self._length_from_base(paw) for paw in self.paws}

    def decide(self, ball: ArrayLike) -> Decision:
        """Return ``reach`` with the nearest paw that reaches a ball (3,), or ``nothing``.

        The frame of the paw is the arm of the decision. Each paw is tried by solving for its pose.
        """
        position = _as_position(ball)
        if position is None:
            return Decision("nothing", None, "there is no ball: its position is not finite")
        if position[2] < 0.0:
            depth_mm = -1e3 * position[2]
            return Decision("nothing", None, f"the ball is {depth_mm:.0f} mm under the floor")
        distances = {
            paw: float(np.linalg.norm(self._prints[paw].position - position)) for paw in self.paws
        }
        for paw in sorted(self.paws, key=distances.__getitem__):
            if self._reaching_pose(paw, position) is not None:
                reason = f"{paw} is {distances[paw]:.2f} m away, and reaches it on the other three"
                return Decision("reach", paw, reason)
        return Decision("nothing", None, "no paw reaches it while the other three stand")

    def reach(self, ball: ArrayLike, paw: str | None = None, *, rate: float = 60.0) -> Keyframes:
        """Return the whole motion: lean, reach, hold, and return to the relaxed pose.

        Args:
            ball: (3,) in the world, m.
            paw: Frame of the paw. Default: the one that ``decide`` chooses.
            rate: Frames per second.

        Raises:
            TrajectoryError: No paw, or not the given paw, reaches the ball.
        """
        if paw is None:
            decision = self.decide(ball)
            if decision.arm is None:
                raise TrajectoryError(
                    f"the lion does not reach {np.asarray(ball).tolist()}: {decision.reason}"
                )
            paw = decision.arm
        elif paw not in self.paws:
            raise TrajectoryError(f"there is no paw {paw!r}", hint=f"use {', '.join(self.paws)}")
        position = _as_position(ball)
        end = None if position is None else self._reaching_pose(paw, position)
        if position is None or end is None:
            raise TrajectoryError(
                f"{paw} does not reach {np.asarray(ball).tolist()} while the others stand"
            )

        # All paws are on the floor, the weight is on the other three, and the eyes are on the ball.
        lean = self._solved_pose(self.paws, position, self._center_goal(paw), [])
        plan = Keyframes.through(
            self.robot,
            [self.relaxed, lean, end, end, lean, self.relaxed],
            durations=(LEAN, REACH, HOLD, REACH, LEAN),
            velocity_limits=_SPEED,
        )
        return self._on_standing_paws(plan, paw, rate)

    def support(self, lifted: str | None) -> Array:
        """Return positions of the standing paws: (3, 2), or (4, 2) if ``lifted`` is None."""
        return np.array([self._prints[paw].position[:2] for paw in self.paws if paw != lifted])

    def _reaching_pose(self, paw: str, ball: Array) -> Array | None:
        """Return the pose (nq,) with a paw at a ball (3,), or None if it is not found."""
        standing = [other for other in self.paws if other != paw]
        for other in standing:
            # A ball beyond the stretched bones between the two paws is out of reach.
            distance = float(np.linalg.norm(self._prints[other].position - ball))
            if distance > self._lengths[other] + self._lengths[paw]:
                return None
        goals: list[Goal] = [PositionGoal(paw, ball)]
        q = self._solved_pose(standing, ball, self._center_goal(paw), goals)
        if float(np.linalg.norm(self.robot.measure(q, paw).position - ball)) >= NEAR:
            return None
        for other in standing:
            if self.robot.measure(q, other).distance(self._prints[other])[0] >= NEAR:
                return None
        return q

    def _length_from_base(self, frame: str) -> float:
        """Return the length of the bones between the free base and a frame, m."""
        model = self.robot.model
        attached = self.robot.frame(frame)
        bodies = bodies_between(model, attached.body, 0)[:-1]
        bones = [attached.local.position, *model.body_pos[bodies]]
        return float(np.linalg.norm(bones, axis=1).sum())

    def _solved_pose(
        self, standing: Sequence[str], ball: Array, center: Array, goals: Sequence[Goal]
    ) -> Array:
        """Return a pose (nq,) with the gaze at a ball.

        Args:
            standing: Paws that stand.
            ball: (3,) the ball.
            center: (3,) required position of the centre of mass. Only x and y are used.
            goals: Further goals.
        """
        all_goals = [
            *self._hard_goals(standing, center),
            *goals,
            AimGoal("gaze", self._gaze_target(ball), axis="x", soft=True),
            PostureGoal(self.relaxed, joints={self.robot.joints[0]: 0.3}, soft=True, priority=1),
        ]
        solution = solve(
            self.robot, all_goals, solver="lm", start=self.relaxed, budget=_POSE_BUDGET
        )
        return np.array(solution.q)

    def _gaze_target(self, ball: Array) -> Array:
        """Return the ball (3,), or the limit of the gaze towards a ball behind the lion."""
        robot = self.robot
        eye = robot.forward(self.relaxed, "gaze").position
        to_ball = ball - eye
        base = int(robot.model.jnt_bodyid[int(robot.tree.joint_ids[0])])
        base_name = str(robot.model.body(base).name)
        forward = robot.forward(self.relaxed, base_name).rotation[:, 0]
        limit = np.radians(_GAZE_LIMIT_DEG)
        lateral = to_ball - float(to_ball @ forward) * forward
        distance = np.linalg.norm(lateral)
        if distance < _STRAIGHT or np.arctan2(distance, to_ball @ forward) <= limit:
            return ball
        direction = np.cos(limit) * forward + np.sin(limit) * (lateral / distance)
        return np.asarray(eye + np.linalg.norm(to_ball) * direction)

    def _hard_goals(self, standing: Sequence[str], center: Array) -> list[Goal]:
        """Return the goals of standing paws and of the centre of mass."""
        prints: list[Goal] = [PoseGoal.at(paw, self._prints[paw]) for paw in standing]
        return [*prints, CenterOfMassGoal(None, center, axes="xy")]

    def _center_goal(self, lifted: str | None) -> Array:
        """Return the required centre of mass (3,) while a paw is lifted. None: no paw is lifted."""
        center = self.robot.center_of_mass(self.relaxed)
        if lifted is not None:
            normal, offset = hull_edges(hull(self.support(lifted)))
            center[:2] = inset(normal, offset, center[:2], MARGIN)
        return center

    def _on_standing_paws(self, plan: Keyframes, paw: str, rate: float) -> Keyframes:
        """Return the frames of a plan with the standing paws exactly at their positions."""
        relaxed_center = self._center_goal(None)
        leaning_center = self._center_goal(paw)
        lift_time = float(plan.times[1])
        landing_time = float(plan.times[4])
        times = np.arange(0.0, plan.duration, 1.0 / rate)
        q = self.relaxed
        rows = [q]
        for t in times[1:].tolist():
            is_lifted = lift_time < t < landing_time
            share = min(1.0, t / lift_time, (plan.duration - t) / (plan.duration - landing_time))
            standing = [other for other in self.paws if other != paw or not is_lifted]
            center = relaxed_center + minimum_jerk(share) * (leaning_center - relaxed_center)
            goals = self._hard_goals(standing, center)
            if is_lifted:
                goals.append(HalfSpaceGoal(paw, (0.0, 0.0, 0.0), "z"))
            goals.append(PostureGoal(plan.at(t), soft=True))
            solution = solve(self.robot, goals, solver="lm", start=q, budget=_FRAME_BUDGET)
            q = np.array(solution.q)
            rows.append(q)
        rows.append(self.relaxed)
        return Keyframes(self.robot, np.append(times, plan.duration), rows)


def _as_position(ball: ArrayLike) -> Array | None:
    """Return a ball as (3,) finite numbers, or None."""
    position = np.asarray(ball, dtype=float)
    is_finite = position.shape == (3,) and bool(np.isfinite(position).all())
    return position if is_finite else None
