"""The testbed without any window: commands go into a queue, an immutable ``View`` comes out.

Only ``tick`` solves, and only its thread touches robots and solvers; front ends, on whatever threads,
call ``send``.  Time is the number of ticks, so the same commands at the same ticks give the same bits,
whichever front end they came from (``CommandLog``).  What has to load or compile is prepared beside the
loop, and takes effect at the tick where it is ready.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from robot_ik.errors import RobotIkError
from robot_ik.figure.decide import Decision
from robot_ik.figure.session import FigureFrame, FigureSession
from robot_ik.geometry import Pose
from robot_ik.motion.sources import RandomSource
from robot_ik.ports import Array, Closing, short_switch_interval
from robot_ik.robot import Robot, load_robot
from robot_ik.testbed import commands
from robot_ik.testbed.instance import Instance, InstanceView
from robot_ik.testbed.preparing import Preparer, SetupDone
from robot_ik.testbed.setup import (
    CURVE_PERIOD,
    ExtraGoal,
    MethodChoice,
    Ready,
    Setup,
    branches_of,
    completed,
    first_ball,
)

if TYPE_CHECKING:
    from robot_ik.testbed.arm import ArmLink, ArmView

_log = logging.getLogger(__name__)

MESSAGE_SECONDS = 6.0
"""How long an error stays on the page."""
_RANDOM_PERIOD = 2.0  # seconds of ball time at each random position
_SLOW_TICKS = 6  # between two measurements of what is too dear for each tick
_BRANCH_TICKS = 12
_REACH = 3.0  # extents of the model: farther away no ball is of use


@dataclass(frozen=True, eq=False)
class BranchView:
    """One branch of the solution: its name, angles (nq,), bodies' poses (nbody, 3) and (nbody, 4)."""

    name: str
    q: Array
    xpos: Array
    xquat: Array


@dataclass(frozen=True)
class FigureView:
    """What is seen of a figure that decides by itself."""

    mode: str  # ``active``: it follows the ball; ``passive``: it acts on the ball as it was at the command
    action: str  # what it does now
    phase: float  # how far that has come, 0 to 1
    decision: Decision  # what it decided to do, and why
    waiting: bool  # passive, and not asked to act yet


@dataclass(frozen=True, eq=False)
class View:
    """A session at one tick; nothing in it changes any more."""

    tick: int  # ticks taken, and their time in seconds
    now: float
    robot: str  # name or path as it was asked for
    motion: commands.Motion  # how the ball moves
    running: bool
    speed: float
    ball: Pose  # its pose, world
    kind: commands.GoalKind  # what it asks of the tool
    extras: tuple[ExtraGoal, ...]  # goals beside it
    limits: bool  # whether they are on
    show_branches: bool
    dragged: str  # body that is dragged; empty: none
    instances: tuple[InstanceView, ...]  # one to four
    branches: tuple[BranchView, ...]  # of the first instance, where they are asked for
    busy: str  # what is prepared beside the loop, as text; empty: nothing
    message: str  # an error in one sentence, for some seconds
    arm: ArmView | None  # the servo arm that the first instance drives; None without
    figure: FigureView | None  # the first instance, where it is a figure that decides by itself
    can_act: bool  # whether this robot is a figure that can
    missing_meshes: tuple[str, ...]  # mesh files of the robot that are not drawn, as its file names them

    @property
    def count(self) -> commands.Count:
        """Instances side by side."""
        return len(self.instances)  # type: ignore[return-value]

    @property
    def state(self) -> str:
        """What goes on, in a few words."""
        if self.tick == 0:
            return "getting ready"
        if self.dragged:
            return f"{self.dragged} is dragged"
        return "running" if self.running else "holding still"

    def digest(self) -> str:
        """A fingerprint of all that the commands decide: not of times, and not of a servo arm."""
        seen = hashlib.sha256()
        fields: list[Any] = [self.tick, self.robot, self.motion, self.running, self.speed, self.kind]
        fields += [[dataclasses.astuple(extra) for extra in self.extras], self.limits, self.dragged]
        fields.append(None if self.figure is None else dataclasses.astuple(self.figure))
        for one in self.instances:
            fields += [one.method, one.options, one.status, one.iterations, one.statistics.count]
            fields += [one.statistics.iterations, one.statistics.solved]
        seen.update(json.dumps(fields).encode())
        arrays = [self.ball.position, self.ball.wxyz]
        for one in self.instances:
            arrays += [one.q, one.xpos, one.trail, one.errors, np.array((one.error, one.angle))]
        arrays += [branch.q for branch in self.branches]
        for array in arrays:
            seen.update(np.ascontiguousarray(array, dtype=float).tobytes())
        return seen.hexdigest()[:32]


class Session(Closing):
    """One model, one ball, one to four instances that follow it.

    Args:
        start: What it begins with.
        beside: Prepare what must compile on a thread, while the loop goes on; else at once, in ``tick``.
        arm: A servo arm that follows the first instance.

    Raises:
        RobotIkError: There is no such robot or method, or a value of ``start`` that it does not take.
    """

    def __init__(
        self, start: commands.Start | None = None, *, beside: bool = True, arm: ArmLink | None = None
    ) -> None:
        self.start = commands.checked_start(commands.Start() if start is None else start)
        setup = Setup(self.start.robot, self.start.count, tuple(map(MethodChoice, self.start.methods)))
        for choice in setup.choices:
            choice.solver()
        self._queue: queue.SimpleQueue[commands.Command] = queue.SimpleQueue()
        self._log: list[tuple[int, commands.Command]] = []
        self._tick, self._phase = 0, 0.0
        self._motion: commands.Motion = "curve"
        self._running, self._speed = True, 1.0
        self._message: tuple[str, int] = ("", 0)
        self._drag: commands.DragLink | None = None
        self._branches: tuple[BranchView, ...] = ()
        self._ready: Ready | None = None
        self._figure: FigureSession | None = None
        self._frame: FigureFrame  # its latest
        self.arm = arm
        self.robot: Robot
        self.instances: list[Instance]
        self._stand(load_robot(setup.robot), setup.count)
        self._setup = completed(setup, self.robot)
        done = self._queue.put if beside else self._adopt
        self._preparer = Preparer(setup, self.robot, done, beside=beside)
        if not beside:
            self._preparer.ask(None)

    # --------------------------------------------------------------------------------- from any thread

    def send(self, command: commands.Command) -> None:
        """Takes a command from any thread; it takes effect with the next tick, or when it is prepared."""
        self._queue.put(command)

    @property
    def busy(self) -> str:
        """What is prepared beside the loop, as text; empty: nothing."""
        return self._preparer.doing

    @property
    def ball(self) -> Pose:
        """Where the ball is, world."""
        return self._ball

    def close(self) -> None:
        """Leaves the arm, if there is one; the session is over."""
        self._preparer.close()
        if self.arm is not None:
            self.arm.close()

    # ------------------------------------------------------------------------------------ the loop's own

    @property
    def ready(self) -> bool:
        """Whether something can be solved yet; until then time stands still."""
        return self._ready is not None

    def tick(self) -> None:
        """Takes what was asked, moves the ball, solves every instance once.

        The first one lets preparing begin: a front end has its first picture before a compiler runs.
        """
        self._preparer.begin()
        while not self._queue.empty():
            self._take(self._queue.get())
        if self._ready is None:
            return
        self._tick += 1
        if self._running:
            self._step(self._ready)
        if self.arm is not None:
            self.arm.follow(self.instances[0].robot, self.instances[0].q, self._running)

    def _step(self, ready: Ready) -> None:
        self._phase += self._speed / commands.RATE
        if self._motion != "hand" and self._drag is None:
            self._ball = self._moving_ball()
        if self._drag is not None:
            self._follow_drag(self._drag, ready)
        else:
            for one in self.instances[int(self._figure is not None) :]:
                one.solve(ready.goals, self._ball)
        if self._figure is not None:
            self._figure.set_ball(self._ball.position)
            self._frame = self._figure.step()
            self.instances[0].stand(self._frame.q, self._frame.action, ready.goals, self._ball)
        for one in self.instances:
            if self._tick % _SLOW_TICKS == 0:
                one.measure_manipulability()
            if self._tick % commands.RATE == 0:
                one.measure_statistics(ready.goals, self._ball)
        if ready.setup.branches and self._tick % _BRANCH_TICKS == 0:
            self._find_branches(ready)

    def _follow_drag(self, drag: commands.DragLink, ready: Ready) -> None:
        for one in self.instances:
            one.drag(drag, ready.goals, self._ball)

    def _moving_ball(self) -> Pose:
        if self._ready is None:
            raise RuntimeError("no robot is ready")
        source = self._random if self._motion == "random" else self._ready.curve
        moved = source.poll(self._phase).target
        return moved if self._ready.goals.kind == "pose" else Pose(moved.position, self._ball.wxyz)

    def view(self) -> View:
        """What is seen now."""
        setup = self._setup
        if setup.kind is None or setup.extras is None:
            raise RuntimeError("the setup is not completed")
        text, until = self._message
        return View(
            tick=self._tick,
            now=self._tick / commands.RATE,
            robot=setup.robot,
            motion=self._motion,
            running=self._running,
            speed=self._speed,
            ball=self._ball,
            kind=setup.kind,
            extras=setup.extras,
            limits=setup.limits,
            show_branches=setup.branches,
            dragged=self._drag.body if self._drag is not None else "",
            instances=tuple(one.view() for one in self.instances),
            branches=self._branches,
            busy=self.busy,
            message=text if self._tick <= until else "",
            arm=self.arm.view() if self.arm is not None else None,
            figure=self._figure_view(),
            can_act=self.robot.file.figure is not None,
            missing_meshes=self.robot.missing_meshes,
        )

    def _figure_view(self) -> FigureView | None:
        if self._figure is None:
            return None
        mode, frame = self._figure.mode, self._frame
        waiting = mode == "passive" and self._figure.ball is None
        return FigureView(mode, frame.action, frame.phase, frame.decision, waiting)

    def log(self) -> commands.CommandLog:
        """All that took effect up to now, and the digest of the present view."""
        return commands.CommandLog(self.start, tuple(self._log), self._tick, self.view().digest())

    def ball_path(self) -> Array:
        """(n, 3) positions of the ball on its curve, for a camera that shall see all of it."""
        if self._ready is None:
            return np.array([self._ball.position])
        curve, times = self._ready.curve, np.linspace(0.0, CURVE_PERIOD, 9)
        return np.array([curve.poll(float(t)).target.position for t in times])

    # ---------------------------------------------------------------------------------------- commands

    def _take(self, command: commands.Command) -> None:
        """Does what was asked; what cannot be done is said in the view, never raised."""
        if isinstance(command, SetupDone):
            self._adopt(command)
            return
        try:
            command = commands.checked_command(command)
        except RobotIkError as error:
            self._say(str(error).splitlines()[0])
            return
        if isinstance(command, commands.SetupCommand):
            self._preparer.ask(command)
        elif isinstance(command, commands.DragLink) and not self._preparer.can_drag:
            self._say("parts can be dragged in a moment: what that needs is being compiled")
        else:
            self._log.append((self._tick, command))
            self._apply(command)

    def _apply(self, command: commands.Command) -> None:
        match command:
            case commands.SetMotion(motion):
                self._motion = motion
            case commands.SetRunning(running):
                self._running = running
                if self.arm is not None and not running:
                    self.arm.stop("stopped: press Start")
            case commands.SetSpeed(speed):
                self._speed = speed
            case commands.MoveGoal(position, wxyz):
                self._move_ball(np.array(position), wxyz)
            case commands.Nudge(step):
                self._move_ball(np.array(self._ball.position) + step, None)
            case commands.DragLink():
                self._grab(command)
            case commands.Release():
                self._release()
            case commands.Reset():
                self._phase, self._motion, self._running, self._drag = 0.0, "curve", True, None
                self._begin_random()
                for one in self.instances:
                    one.reset()
                if self._figure is not None:
                    self._figure.reset()
                    self._motion = "hand"
            case commands.Act():
                if self._figure is None:
                    self._say("no figure decides: switch it on in the tab Figure")
                else:
                    self._figure.start_passive()
            case commands.PickBranch(index):
                if index < len(self._branches):
                    self.instances[0].move_to(self._branches[index].q)
                else:
                    self._say("there is no branch of that number")
            case commands.SetArm(state):
                if self.arm is None:
                    self._say("there is no arm: start with --bus sim, pty or a port")
                else:
                    self.arm.ask(state)

    def _release(self) -> None:
        """The ball goes to where the tool of the dragged robot is."""
        drag = self._drag
        if drag is not None:
            if self._running and self._ready is not None:
                # A slow browser's drag may come with its end in one tick: where it ended counts.
                self._follow_drag(drag, self._ready)
            self._ball = self.instances[min(drag.instance, len(self.instances) - 1)].tool_pose()
            self._drag, self._motion = None, "hand"

    def _move_ball(self, position: Array, wxyz: Sequence[float] | None) -> None:
        """By hand from now on; never farther than a robot of this size could use."""
        self._motion = "hand"
        radius, middle = _REACH * float(self.robot.model.stat.extent), self.robot.model.stat.center
        away = position - middle
        distance = float(np.linalg.norm(away))
        position = position if distance <= radius else middle + away * (radius / distance)
        orientation = self._ball.wxyz if wxyz is None else np.array(wxyz)
        if np.linalg.norm(orientation) > 1e-6:
            self._ball = Pose(position, orientation / np.linalg.norm(orientation))

    def _grab(self, command: commands.DragLink) -> None:
        if mujoco.mj_name2id(self.robot.model, mujoco.mjtObj.mjOBJ_BODY, command.body) <= 0:
            self._say(f"this part cannot be dragged: {command.body or 'it has no name'}")
        elif self._figure is not None:
            self._say("the figure decides by itself: drag the ball")
        else:
            self._drag = command

    def _adopt(self, found: SetupDone) -> None:
        """What was prepared takes effect now."""
        if found.ready is None:
            self._say(found.error)
            return
        if found.command is not None:
            self._log.append((self._tick, found.command))
        before, self._ready = self._ready, found.ready
        ready = found.ready
        self._setup = ready.setup
        if isinstance(found.command, commands.SetRobot):
            self._phase, self._motion, self._drag = 0.0, "curve", None
            self._stand(ready.robot, ready.setup.count)
        elif len(self.instances) != ready.setup.count:
            missing = ready.setup.count - len(self.instances)
            fresh = [Instance(ready.robot) for _ in range(missing)]
            self.instances = [*self.instances, *fresh][: ready.setup.count]
        self.robot, self._branches = ready.robot, ()
        self._set_figure(before, ready)
        for one, solver, refused in zip(self.instances, ready.solvers, ready.refused, strict=True):
            flat = ready.goals.flattened(solver)
            one.take(ready.robot, solver, refused, "all goals at one priority" if flat else "")
        self._begin_random()
        if before is None:
            self._ball = self._moving_ball()
        for k, why in enumerate(ready.refused):
            if why:
                self._say(f"robot {k + 1}: {why}")

    def _set_figure(self, before: Ready | None, ready: Ready) -> None:
        """A figure that decides begins at home, and goes back there when it is switched off."""
        wanted = ready.setup.figure
        if before is not None and before.loaded is ready.loaded and before.setup.figure == wanted:
            return
        if self._figure is not None:
            self._figure = None
            self.instances[0].reset()
        if wanted != "off" and ready.abilities is not None:
            self._figure = FigureSession(ready.abilities, mode=wanted)
            self._frame = self._figure.step()
            self._motion = "hand"

    def _stand(self, robot: Robot, count: int) -> None:
        """New robots, at home."""
        self.robot = robot
        self.instances = [Instance(robot) for _ in range(count)]
        self._ball = first_ball(robot)
        self._branches = ()

    def _begin_random(self) -> None:
        self._random = RandomSource(self.robot, seed=self.start.seed, period=_RANDOM_PERIOD)
        self._random.poll(0.0)

    def _find_branches(self, ready: Ready) -> None:
        one, found = self.instances[0], []
        try:
            branches = branches_of(ready.robot, ready.goals.main(self._ball), one.q)
        except RobotIkError as error:
            self._branches = ()
            self._say(str(error).splitlines()[0])
            return
        for branch in branches:
            data = ready.robot.data_at(branch.q)
            found.append(BranchView(branch.name, branch.q.copy(), data.xpos.copy(), data.xquat.copy()))
        self._branches = tuple(found)

    def report(self, problem: str) -> None:
        """Show a problem of the front end for ``MESSAGE_SECONDS``; called by the thread that ticks."""
        self._say(problem)

    def _say(self, text: str) -> None:
        _log.debug("%s", text)
        self._message = text, self._tick + round(MESSAGE_SECONDS * commands.RATE)


def replayed(log: commands.CommandLog) -> Iterator[Session]:
    """The session of a log, tick by tick; the last one is over all its commands.

    Raises:
        RobotIkError: As ``Session``.
    """
    with Session(log.start, beside=False) as session:
        waiting = list(log.commands)
        last = max([log.ticks, *(tick + 1 for tick, _ in waiting)])
        for tick in range(last):
            while waiting and waiting[0][0] <= tick:
                session.send(waiting.pop(0)[1])
            session.tick()
            yield session


def last_view(log: commands.CommandLog) -> View:
    """The view at the end of a log; of an empty one, after one tick."""
    log = log if log.ticks or log.commands else dataclasses.replace(log, ticks=1)
    for session in replayed(log):
        last = session
    return last.view()


def _surviving(session: Session, draw: Callable[[View], object]) -> Callable[[View], object]:
    """``draw`` with its exceptions logged, once each, and shown as the session's message."""
    logged: set[str] = set()

    def drawn(view: View) -> object:
        try:
            return draw(view)
        except Exception as error:
            problem = f"{type(error).__name__}: {error}".splitlines()[0]
            if problem not in logged:
                logged.add(problem)
                _log.exception("the view cannot be drawn; the session goes on, because it holds an arm")
            session.report(f"the view cannot be drawn ({problem}); STOP still works")
            return None

    return drawn


def run(
    session: Session,
    draw: Callable[[View], object],
    stop: threading.Event,
    *,
    every: int = 2,
    now: Callable[[], float] = time.perf_counter,
) -> None:
    """The only loop of a front end: ticks in real time, and draws each ``every``-th view.

    It runs on absolute deadlines of the clock ``now`` (seconds) until ``stop`` is set, or ``draw`` gives
    False as that of a closed window does; after a stall it goes on from there and does not hurry.

    An exception of ``draw`` ends a session without an arm only.  With an arm the session logs it, shows it
    as its message and goes on: commands, STOP among them, still arrive.
    """
    step, due, count = 1.0 / commands.RATE, now(), 0
    if session.arm is not None:
        draw = _surviving(session, draw)
    with short_switch_interval():
        while not stop.is_set():
            session.tick()
            if count % every == 0 and draw(session.view()) is False:
                break
            count, due = count + 1, due + step
            if (rest := due - now()) > 0.0:
                stop.wait(rest)
            else:
                due = now()
