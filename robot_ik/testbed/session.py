"""The testbed without a window: a session takes commands from a queue and returns views.

Only ``tick`` solves, and only its thread touches robots and solvers. Front ends call ``send`` from
any thread. Time is the number of ticks, so the same commands at the same ticks give the same bits
from every front end (``CommandLog``). Models and kernels are loaded and compiled beside the loop.
A command that needs them takes effect at the tick where they are ready.
"""

from __future__ import annotations

import logging
import queue
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from robot_ik.errors import RobotIkError, did_you_mean
from robot_ik.figure.session import FigureFrame, FigureSession
from robot_ik.geometry import Pose
from robot_ik.kernels.tree import HINGE, SLIDE
from robot_ik.motion.key_poses import KeyPoses
from robot_ik.motion.sources import RandomSource
from robot_ik.ports import Array, Closing
from robot_ik.robot import Robot, load_robot
from robot_ik.testbed import commands
from robot_ik.testbed.course_run import CourseRun
from robot_ik.testbed.instance import Instance
from robot_ik.testbed.obstacles import Obstacles
from robot_ik.testbed.planning import PlanDone, PlannedMotion, Planner, PlanTask
from robot_ik.testbed.preparing import Preparer, SetupDone
from robot_ik.testbed.problem_text import problem_text
from robot_ik.testbed.robot_goals import first_ball
from robot_ik.testbed.setup import (
    CURVE_PERIOD,
    Ready,
    Setup,
    branches_of,
    completed,
    selected,
)
from robot_ik.testbed.timeline import Timeline
from robot_ik.testbed.view import BranchView, FigureView, View

if TYPE_CHECKING:
    from robot_ik.testbed.arm import ArmLink

_log = logging.getLogger(__name__)

MESSAGE_SECONDS = 6.0
"""Seconds for which an error is shown."""

RANDOM_PACE = 2.0
"""Seconds of ball time at each random position, unless ``SetPace`` says otherwise."""

_SLOW_TICKS = 6
"""Ticks between two measurements that are too slow for each tick."""

_BRANCH_TICKS = 12
"""Ticks between two searches for branches."""

_MAX_BALL_DISTANCE = 3.0
"""Extents of the model. A ball that is farther away is moved to this distance."""

_SHORTEST_QUATERNION = 1e-6
"""A quaternion that is shorter than this does not define an orientation."""

_LOCKED = "the ball is locked while the figure acts: press R, or leave the passive mode (I)"


class Session(Closing):
    """One model, one ball, and one to four instances that follow it.

    Args:
        start: Start of the session.
        beside: Load and compile on a thread while the loop continues. False: load and compile at
            once.
        arm: A servo arm that follows the first instance.

    Raises:
        RobotIkError: There is no such robot or method.
    """

    def __init__(
        self,
        start: commands.Start | None = None,
        *,
        beside: bool = True,
        arm: ArmLink | None = None,
    ) -> None:
        self.start = start or commands.Start()
        setup = Setup.of(self.start)
        for choice in setup.choices:
            choice.solver()
        self._queue: queue.SimpleQueue[commands.Command | SetupDone | PlanDone]
        self._queue = queue.SimpleQueue()
        self._log: list[tuple[int, commands.Command]] = []
        self._tick = 0
        self._phase = 0.0
        self._motion: commands.Motion = "curve"
        self._running = True
        self._speed = 1.0
        self._pace = RANDOM_PACE
        self._restarts = True
        self._message = ""
        self._message_end = 0
        self._drag: commands.DragLink | None = None
        self._branches: tuple[BranchView, ...] = ()
        self._ready: Ready | None = None
        self._waiting_count = 1  # setups that are not adopted: that of the start
        self._figure: FigureSession | None = None
        self._frame: FigureFrame
        self.arm = arm
        self.robot: Robot
        self.instances: list[Instance]
        self._course_run: CourseRun | None = None
        loaded = load_robot(setup.robot)
        self._stand(selected(loaded, setup), setup.count)
        self._setup = completed(setup, self.robot)
        done = self._queue.put if beside else self._adopt
        self._planner = Planner(self._queue.put if beside else self._adopt_plan, beside=beside)
        self._preparer = Preparer(setup, loaded, done, beside=beside)
        if not beside:
            self._preparer.ask(None)

    # Called from any thread

    def send(self, command: commands.Command) -> None:
        """Take a command. It takes effect with the next tick, or when it is prepared."""
        self._queue.put(command)

    @property
    def busy(self) -> str:
        """What is prepared beside the loop. Empty: every setup has taken effect."""
        return self._preparer.doing or ("preparing …" if self._waiting_count else "")

    @property
    def ball(self) -> Pose:
        """Pose of the ball, world."""
        return self._ball

    @property
    def timeline(self) -> Timeline:
        """The timeline. Other threads may only read it."""
        return self._timeline

    def close(self) -> None:
        """End the session and leave the arm, if there is one."""
        self._preparer.close()
        self._planner.close()
        if self.arm is not None:
            self.arm.close()

    # Called from the thread of the loop

    @property
    def ready(self) -> bool:
        """Whether the first setup is prepared. Until then ``tick`` does not count."""
        return self._ready is not None

    def tick(self) -> None:
        """Take commands, move the ball and solve every instance once.

        The first tick starts the preparation, so that a front end draws before a compiler runs.
        """
        self._preparer.begin()
        while not self._queue.empty():
            self._take(self._queue.get())
        if self._ready is None:
            return
        self._tick += 1
        if self._motion == "timeline":
            self._show_timeline(self._ready)
        elif self._motion == "plan":
            self._show_plan(self._ready)
        elif self._running:
            self._step(self._ready)
        if self._tick % _SLOW_TICKS == 0:
            self._measure_distances()
        if self.arm is not None:
            first = self.instances[0]
            self.arm.follow(first.robot, first.q, self._running)

    def _measure_distances(self) -> None:
        try:
            self._obstacles.measure(self.instances[0].q)
        except RobotIkError as error:
            self.report(f"no contacts are shown: {problem_text(error)}")

    def _step(self, ready: Ready) -> None:
        self._phase += self._speed / commands.RATE
        if self._motion == "course" and self._course_run is not None and self._drag is None:
            self._ball = self._course_run.step(self._speed)
        is_moving = self._motion in ("curve", "random") and self._drag is None
        if is_moving and not self._is_locked:
            self._ball = self._moving_ball(ready)
        if self._drag is not None:
            self._follow_drag(self._drag, ready)
        else:
            self._solve(ready)
        if self._figure is not None:
            self._figure.set_ball(self._ball.position)
            self._frame = self._figure.step()
            first = self.instances[0]
            first.stand(self._frame.q, self._frame.action, ready.goals, self._ball)
        for one in self.instances:
            if self._tick % _SLOW_TICKS == 0:
                one.measure_manipulability()
            if self._tick % commands.RATE == 0:
                one.measure_statistics(ready.goals, self._ball)
        if ready.setup.branches and self._tick % _BRANCH_TICKS == 0:
            self._find_branches(ready)

    def _solve(self, ready: Ready) -> None:
        """Solve all instances, except a first one that a figure or a joint bar moves."""
        restarts = self._restarts and self._motion == "random"
        solved = self.instances
        if self._figure is not None:
            solved = self.instances[1:]
        elif self._motion == "joints":
            first = self.instances[0]
            first.stand(first.q, "set by hand", ready.goals, self._ball)
            solved = self.instances[1:]
        for one in solved:
            one.solve(ready.goals, self._ball, restarts=restarts)
        if self._motion == "course" and self._course_run is not None:
            self._course_run.judge([one.is_met for one in self.instances])

    def _show_timeline(self, ready: Ready) -> None:
        """Put every instance to the timeline's pose, and the ball to the tool."""
        q = self._timeline.step(1.0 / commands.RATE)
        if q is None:
            self._motion = "hand"
            return
        self.instances[0].move_to(q)
        self._ball = self.instances[0].tool_pose()
        for one in self.instances:
            one.stand(q, "timeline", ready.goals, self._ball)

    def _show_plan(self, ready: Ready) -> None:
        """Put the first instance to the plan's posture. The others follow the ball."""
        q = self._planned.step(1.0 / commands.RATE)
        if q is None:
            self._motion = "hand"
            return
        self.instances[0].stand(q, "plan", ready.goals, self._ball)
        for one in self.instances[1:]:
            one.solve(ready.goals, self._ball, restarts=False)

    def _pull(self) -> Array | None:
        """Return the grabbed point and where the mouse pulls it (2, 3), or None without a drag."""
        drag = self._drag
        if drag is None:
            return None
        data = self.instances[min(drag.instance, len(self.instances) - 1)].data
        body = self.robot.body_id(drag.body)
        grip = data.xpos[body] + data.xmat[body].reshape(3, 3) @ np.array(drag.grip)
        return np.array([grip, drag.to])

    def _follow_drag(self, drag: commands.DragLink, ready: Ready) -> None:
        for one in self.instances:
            one.drag(drag, ready.goals, self._ball)

    def _moving_ball(self, ready: Ready) -> Pose:
        source = self._random if self._motion == "random" else ready.curve
        moved = source.poll(self._phase).target
        return moved if ready.goals.kind == "pose" else Pose(moved.position, self._ball.wxyz)

    def view(self) -> View:
        """Return the session at the present tick."""
        setup = self._setup
        if setup.kind is None or setup.extras is None:
            raise RuntimeError("the setup is not completed")
        run = self._course_run
        return View(
            tick=self._tick,
            now=self._tick / commands.RATE,
            robot=setup.robot,
            motion=self._motion,
            running=self._running,
            speed=self._speed,
            pace=self._pace,
            restarts=self._restarts,
            ball=self._ball,
            kind=setup.kind,
            extras=setup.extras,
            pins=setup.pins,
            tool=self.robot.tool,
            base=setup.base,
            stiffness=setup.stiffness,
            course=None if run is None else run.view(self.count),
            show_branches=setup.branches,
            dragged=self._drag.body if self._drag is not None else "",
            pull=self._pull(),
            instances=tuple(one.view() for one in self.instances),
            branches=self._branches,
            busy=self.busy,
            message=self._message if self._tick <= self._message_end else "",
            arm=self.arm.view() if self.arm is not None else None,
            figure=self._figure_view(),
            can_act=self.robot.file.figure is not None,
            missing_meshes=self.robot.missing_meshes,
            timeline=self._timeline.view(),
            obstacles=self._obstacles.view(),
            plan=self._planned.view(),
            contacts=self._obstacles.contact_views(),
        )

    @property
    def count(self) -> int:
        """Instances side by side."""
        return len(self.instances)

    def _figure_view(self) -> FigureView | None:
        if self._figure is None:
            return None
        mode: commands.FigureMode = "passive" if self._figure.mode == "passive" else "active"
        return FigureView(
            mode=mode,
            action=self._frame.action,
            phase=self._frame.phase,
            decision=self._frame.decision,
            waiting=mode == "passive" and self._figure.ball is None,
            locked=self._is_locked,
        )

    @property
    def _is_locked(self) -> bool:
        """Whether a passive figure acts: until it has finished, the ball cannot be moved."""
        figure = self._figure
        return figure is not None and figure.mode == "passive" and figure.ball is not None

    def log(self) -> commands.CommandLog:
        """Return all commands that took effect, and the digest of the present view."""
        digest = self.view().digest()
        return commands.CommandLog(self.start, tuple(self._log), self._tick, digest)

    def ball_path(self) -> Array:
        """Return positions (n, 3) of the ball along its curve, to which a camera is fitted."""
        if self._ready is None:
            return np.array([self._ball.position])
        if self._course_run is not None:
            return self._course_run.path()
        times = np.linspace(0.0, CURVE_PERIOD, 9)
        return np.array([self._ready.curve.poll(float(t)).target.position for t in times])

    # Commands

    def _take(self, command: commands.Command | SetupDone | PlanDone) -> None:
        """Execute a command. The view shows an error; nothing is raised."""
        if isinstance(command, SetupDone):
            self._adopt(command)
        elif isinstance(command, PlanDone):
            self._adopt_plan(command)
        elif isinstance(command, commands.PlanMotion):
            self._ask_plan(command)
        elif isinstance(command, commands.SetupCommand):
            self._waiting_count += 1
            self._preparer.ask(command)
        elif isinstance(command, commands.DragLink) and not self._preparer.can_drag:
            self.report("the kernels of dragging are being compiled: drag again in some seconds")
        else:
            self._log.append((self._tick, command))
            try:
                self._apply(command)
            except RobotIkError as error:
                self.report(problem_text(error))

    def _apply(self, command: commands.Command) -> None:
        match command:
            case commands.SetMotion(motion):
                self._set_motion(motion)
            case commands.SetPace(seconds):
                self._pace = seconds
                self._begin_random()
            case commands.SetRestarts(on):
                self._restarts = on
            case commands.SetRunning(running):
                self._set_running(running)
            case commands.SetSpeed(speed):
                self._speed = speed
            case commands.SetBudget(index, iterations, distance):
                if index < len(self.instances):
                    self.instances[index].set_budget(iterations, distance)
            case commands.MoveGoal(position, wxyz):
                self._move_ball(np.array(position), wxyz)
            case commands.Nudge(step):
                self._move_ball(np.array(self._ball.position) + step, None)
            case commands.SetJoint(joint, value):
                self._set_joint(joint, value)
            case commands.DragLink():
                self._grab(command)
            case commands.Release():
                self._release()
            case commands.Reset():
                self._reset()
            case commands.Act():
                self._act()
            case commands.PickBranch(index):
                self._pick_branch(index)
            case commands.SetArm(state):
                if self.arm is None:
                    self.report("there is no arm: start with --bus sim, pty or a port")
                else:
                    self.arm.ask(state)
            case _:
                self._apply_to_timeline(command)

    def _apply_to_timeline(self, command: commands.Command) -> None:
        """Execute a command about the timeline, about obstacles or about plans."""
        match command:
            case commands.RecordPose():
                self._timeline.record(self.instances[0].q)
            case commands.RemovePose(index):
                self._timeline.remove(index)
            case commands.MovePose(index, time):
                self._timeline.move(index, time)
            case commands.Scrub(time):
                if self._may_show_timeline():
                    self._timeline.seek(time)
            case commands.PlayTimeline(playing):
                if not playing:
                    self._stop_playing()
                elif self._may_show_timeline():
                    self._running = True
                    self._timeline.play(True)
            case commands.LoadPoses(text):
                self._timeline.load(KeyPoses.parse(text, self.robot, "poses.toml"))
            case commands.MarkPlanStart():
                self._planned.mark_start(self.instances[0].q)
            case commands.PlayPlan(playing):
                if not playing:
                    self._planned.play(False)
                elif self._may_show_plan():
                    self._running = True
                    self._planned.play(True)
            case commands.ScrubPlan(time):
                if self._may_show_plan():
                    self._planned.seek(time)
            case commands.RemovePlan():
                self._planned.remove()
            case _:
                self._apply_to_obstacles(command)

    def _apply_to_obstacles(self, command: commands.Command) -> None:
        """Execute a command about obstacles. A plan is for the obstacles before it."""
        self._planned.invalidate()
        match command:
            case commands.AddObstacle(shape):
                self._obstacles.add(shape)
            case commands.AddMesh(name, vertices):
                self._obstacles.add_mesh(name, np.array(vertices))
            case commands.ResizeObstacle(index, size):
                self._obstacles.resize(index, size)
            case commands.MoveObstacle(index, position):
                self._obstacles.move(index, np.array(position))
            case commands.RemoveObstacle(index):
                self._obstacles.remove(index)

    def _stop_playing(self) -> None:
        """Stop the cursors of timeline and plan."""
        self._timeline.play(False)
        self._planned.play(False)

    def _set_motion(self, motion: commands.BallMotion) -> None:
        if self._is_locked:
            self.report(_LOCKED)
            return
        self._motion = motion
        self._stop_playing()

    def _set_running(self, running: bool) -> None:
        self._running = running
        if not running:
            self._stop_playing()
            if self.arm is not None:
                self.arm.stop("stopped: press Start")

    def _reset(self) -> None:
        self._phase = 0.0
        self._motion = "curve"
        if self._course_run is not None:
            self._course_run.begin()
            self._motion = "course"
        self._running = True
        self._drag = None
        self._stop_playing()
        self._begin_random()
        for one in self.instances:
            one.reset()
        if self._figure is not None:
            self._figure.reset()
            self._motion = "hand"
            self._ball = first_ball(self.robot)

    def _act(self) -> None:
        if self._figure is None:
            self.report("no figure decides by itself: choose Active or Passive at the top")
        else:
            self._figure.start_passive()

    def _pick_branch(self, index: int) -> None:
        if index < len(self._branches):
            self.instances[0].move_to(self._branches[index].q)
        else:
            self.report(f"there is no branch {index + 1}: {len(self._branches)} are shown")

    def _set_joint(self, joint: str, value: float) -> None:
        """Set a joint of the first instance within its limits. The ball goes to the tool."""
        first = self.instances[0]
        if joint not in self.robot.joints:
            hint = did_you_mean(joint, self.robot.joints)
            self.report(f"there is no joint {joint!r}. {hint}".rstrip(" ."))
            return
        if self._figure is not None:
            self.report("the figure decides by itself: choose Methods at the top to set joints")
            return
        number = self.robot.joints.index(joint)
        if int(self.robot.tree.kind[number]) not in (HINGE, SLIDE):
            self.report(f"{joint} is neither a hinge nor a slide: drag the ball or a part instead")
            return
        q = first.q.copy()
        q[int(self.robot.tree.qadr[number])] = value
        first.move_to(first.robot.clip(q))
        self._drag = None
        self._ball = first.tool_pose()
        self._motion = "joints"
        self._stop_playing()

    def _may_show_timeline(self) -> bool:
        """Return whether the timeline can be shown. If so, the robots follow it."""
        if self._figure is not None:
            self.report("the figure decides by itself: choose Methods at the top to play poses")
            return False
        if self._timeline.is_empty:
            self.report("the timeline is empty: press Record pose first")
            return False
        self._drag = None
        self._motion = "timeline"
        return True

    def _may_show_plan(self) -> bool:
        """Return whether there is a plan to show. If so, the first instance follows it."""
        if not self._planned.has_motion:
            self.report("there is no planned motion: press Plan to the ball first")
            return False
        self._stop_playing()
        self._drag = None
        self._motion = "plan"
        return True

    def _ask_plan(self, command: commands.PlanMotion) -> None:
        """Plan beside the loop. Without values the command gets the present start and ball."""
        if self._ready is None or self._figure is not None:
            self.report("a figure that decides by itself plans its own motions")
            return
        if command.position is None:
            # Commands, so that the log has them: the ball stays at the goal.
            self._take(commands.RemovePlan())
            if self._motion in ("curve", "random"):
                self._take(commands.SetMotion("hand"))
            x, y, z = self._ball.position.tolist()
            wxyz = tuple(self._ball.wxyz.tolist())
            start = tuple(self._planned.start.tolist())
            command = replace(command, start=start, position=(x, y, z), wxyz=wxyz)
            self._ask_plan(command)
            return
        goal = self._ready.goals.main(Pose(command.position, command.wxyz or self._ball.wxyz))
        obstacles = tuple(placed.obstacle() for placed in self._obstacles.placed)
        task = PlanTask(command, self.robot, goal, obstacles)
        self._planned.begin(task)
        self._planner.ask(task)

    def _adopt_plan(self, done: PlanDone) -> None:
        """Show a plan, unless obstacles, robot or goal have changed since its command."""
        if self._planned.take(done):
            self._log.append((self._tick, done.task.command))

    def _release(self) -> None:
        """End a drag. The ball goes to the tool of the dragged robot."""
        drag = self._drag
        if drag is not None:
            if self._running and self._ready is not None:
                # A drag of a slow browser may come with its end in one tick.
                self._follow_drag(drag, self._ready)
            dragged = self.instances[min(drag.instance, len(self.instances) - 1)]
            self._ball = dragged.tool_pose()
            self._drag = None
            self._motion = "hand"

    def _move_ball(self, position: Array, wxyz: Sequence[float] | None) -> None:
        """Move the ball by hand, up to ``_MAX_BALL_DISTANCE``."""
        if self._is_locked:
            self.report(_LOCKED)
            return
        self._motion = "hand"
        self._stop_playing()
        radius = _MAX_BALL_DISTANCE * float(self.robot.model.stat.extent)
        middle = self.robot.model.stat.center
        offset = position - middle
        distance = float(np.linalg.norm(offset))
        if distance > radius:
            position = middle + offset * (radius / distance)
        orientation = self._ball.wxyz if wxyz is None else np.array(wxyz)
        length = np.linalg.norm(orientation)
        if length > _SHORTEST_QUATERNION:
            self._ball = Pose(position, orientation / length)

    def _grab(self, command: commands.DragLink) -> None:
        body = mujoco.mj_name2id(self.robot.model, mujoco.mjtObj.mjOBJ_BODY, command.body)
        if body <= 0:
            self.report(f"{command.body!r} cannot be dragged: drag a part of the robot")
        elif self._figure is not None:
            self.report("the figure decides by itself: drag the ball instead")
        else:
            self._drag = command
            if self._motion in ("joints", "timeline"):
                self._motion = "hand"
                self._stop_playing()

    def _adopt(self, result: SetupDone) -> None:
        """Apply a prepared setup, or report why it could not be prepared."""
        self._waiting_count -= 1
        if result.ready is None:
            self.report(result.error)
            return
        if result.command is not None:
            self._log.append((self._tick, result.command))
        before = self._ready
        ready = result.ready
        self._ready = ready
        self._setup = ready.setup
        if self._is_another_robot(result.command, ready):
            self._phase = 0.0
            self._motion = "curve"
            self._drag = None
            self._stand(ready.robot, ready.setup.count)
            self._begin_course(ready)
        elif len(self.instances) != ready.setup.count:
            missing = ready.setup.count - len(self.instances)
            fresh = [Instance(ready.robot) for _ in range(missing)]
            self.instances = [*self.instances, *fresh][: ready.setup.count]
        is_other_goal = before is not None and before.setup.kind != ready.setup.kind
        if is_other_goal or self.robot is not ready.robot:
            self._planned.use(ready.robot)
        is_other_tool = self.robot.tool != ready.robot.tool
        self.robot = ready.robot
        self._branches = ()
        self._set_figure(before, ready)
        self._give_methods(ready)
        self._begin_random()
        if before is None:
            self._ball = self._moving_ball(ready)
        elif is_other_tool and self._motion not in ("curve", "random"):
            self._drag = None
            self._ball = self.instances[0].tool_pose()
        for k, reason in enumerate(ready.refused):
            if reason:
                self.report(f"robot {k + 1}: {reason}")

    def _is_another_robot(self, command: commands.SetupCommand | None, ready: Ready) -> bool:
        """Return whether new instances are needed: for other joints, or for another model."""
        if isinstance(command, commands.SetRobot | commands.SetCourse):
            return True
        is_same_model = self.robot.model is ready.robot.model
        return not is_same_model or self.robot.joints != ready.robot.joints

    def _begin_course(self, ready: Ready) -> None:
        """Begin the course of a setup, if it has one."""
        self._course_run = None
        if ready.course is not None:
            self._course_run = CourseRun(ready.course)
            self._motion = "course"

    def _give_methods(self, ready: Ready) -> None:
        """Give each instance its robot and its method."""
        limits = ready.setup.limits or ()
        for k, one in enumerate(self.instances):
            solver = ready.solvers[k]
            limb = ready.limbs[k]
            note = "all goals at one priority" if ready.goals.flattened(solver) else ""
            if limb is not None:
                note = f"moves {len(limb.robot.joints)} joints towards the ball, no other goal"
            one.take(
                ready.robots[k],
                solver,
                limited=limits[k],
                refused=ready.refused[k],
                note=note,
                limb=limb,
            )

    def _set_figure(self, before: Ready | None, ready: Ready) -> None:
        """Start or end a figure session. The first instance is at home before and after it."""
        wanted = ready.setup.figure
        is_same_robot = before is not None and before.loaded is ready.loaded
        if before is not None and is_same_robot and before.setup.figure == wanted:
            return
        if self._figure is not None:
            self._figure = None
            self.instances[0].reset()
        if wanted != "off" and ready.abilities is not None:
            self._figure = FigureSession(ready.abilities, mode=wanted)
            self._frame = self._figure.step()
            self._motion = "hand"
            self._stop_playing()

    def _stand(self, robot: Robot, count: int) -> None:
        """Put new robots to their home poses."""
        self.robot = robot
        self.instances = [Instance(robot) for _ in range(count)]
        self._ball = first_ball(robot)
        self._branches = ()
        self._timeline = Timeline(robot)
        self._obstacles = Obstacles(robot)
        self._planned = PlannedMotion(robot)

    def _begin_random(self) -> None:
        period = max(self._pace, 1.0 / commands.RATE)
        self._random = RandomSource(self.robot, seed=self.start.seed, period=period)
        self._random.poll(self._phase)

    def _find_branches(self, ready: Ready) -> None:
        first = self.instances[0]
        try:
            branches = branches_of(ready.robot, ready.goals.main(self._ball), first.q)
        except RobotIkError as error:
            self._branches = ()
            self.report(problem_text(error))
            return
        views = []
        for branch in branches:
            data = ready.robot.data_at(branch.q)
            pose = data.xpos.copy(), data.xquat.copy()
            views.append(BranchView(branch.name, branch.q.copy(), *pose))
        self._branches = tuple(views)

    def report(self, problem: str) -> None:
        """Show a problem for ``MESSAGE_SECONDS``. Only the thread of the loop may call it."""
        _log.debug("%s", problem)
        self._message = problem
        self._message_end = self._tick + round(MESSAGE_SECONDS * commands.RATE)
