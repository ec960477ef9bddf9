"""What the drawn robot does: stands, waves, replays a trajectory, follows a marker, mirrors a live arm."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from robot_ik.camera.drawing.renderers import DrawnRobot
from robot_ik.camera.registration import Seen
from robot_ik.errors import ConfigError
from robot_ik.goals import PositionGoal
from robot_ik.jobs.script import ScriptRequest, ScriptRun, find_script, load_script, shipped
from robot_ik.jobs.script.run import resolved
from robot_ik.motion.trajectory import RecorderSink, Trajectory
from robot_ik.ports import Array, Clock, JointSource
from robot_ik.problem import Problem
from robot_ik.reading import read_text, read_toml
from robot_ik.robot import Robot
from robot_ik.solvers import SOLVERS

# ------------------------------------------------------------------------------------------
# A script's motion for the drawn robot: the script runs on simulated servos, their shafts are kept.


class _RecordingClock:
    """A clock that records the joints after each wait."""

    def __init__(self, clock: Clock, run: ScriptRun, recorder: RecorderSink) -> None:
        self._clock, self._run, self._recorder = clock, run, recorder

    def now(self) -> float:
        return self._clock.now()

    def sleep_until(self, deadline: float) -> None:
        self._clock.sleep_until(deadline)
        self._recorder.send(self._run.setup.true_q(), self._clock.now())


def is_script(text: str) -> bool:
    """Whether this is a script: the name of one that comes along, or a TOML file with steps."""
    if text in shipped():
        return True
    path = Path(text).expanduser()
    try:
        return path.suffix == ".toml" and "steps" in read_toml(path, "the script")
    except ConfigError:
        return False


def robot_of(text: str) -> str:
    """The robot that a motion is made for: a script's or an arm file's; empty where it is for any.

    Raises:
        ConfigError: The script or the arm file is wrong.
    """
    if is_script(text):
        script = load_script(find_script(text))
        return resolved(script, script.content.robot)
    path = Path(text.partition("@")[0])
    if path.suffix != ".toml":
        return ""
    read_text(path, "the script or arm file")
    from robot_ik.hardware.config import ArmConfig

    return ArmConfig.load(path).robot


def play_script(text: str, robot: Robot) -> tuple[Trajectory, str]:
    """Runs it; how the joints moved, where the shafts truly were, and what went wrong in one line.

    Joints that the script's servos do not turn stay at home.

    Raises:
        ConfigError: The script is of another robot, or it is wrong.
        RobotIkError: Of the simulated arm.
    """
    file = find_script(text)
    run = ScriptRun(load_script(file), ScriptRequest())
    setup, report = run.setup, run.report
    if report.robot != robot.name:
        raise ConfigError(
            f"is a script of {report.robot}, and {robot.name} is drawn",
            file=file, key="robot", allowed=f"--robot {report.robot}",
        )  # fmt: skip
    recorder = RecorderSink(setup.robot.joints)
    recorder.send(setup.true_q(), setup.clock.now())  # of a script that waits nowhere, this is all
    setup.clock = _RecordingClock(setup.clock, run, recorder)
    run.run()
    moved = recorder.trajectory()
    q = np.tile(robot.home, (len(moved), 1))
    for column, joint in enumerate(moved.joints):
        q[:, robot.joints.index(joint)] = moved.q[:, column]
    failed = next((step for step in report.steps if step.outcome == "failed"), None)
    notice = "" if failed is None else f"the script failed at {failed.name!r}: {failed.found}"
    return Trajectory(moved.times, q, robot.joints), notice


# A wave goes this part of the way to each joint's limits, at most so far, in so many seconds.
_WAVE_SHARE, _WAVE_MOST, _WAVE_PERIOD = 0.25, 0.45, 4.0
# The drawn tool covers at most this part of what is left of its way in one picture.
_CHASE = 0.35


class DrawnMotion(Protocol):
    """Gives joint angles for each picture."""

    def q(self, time: float, seen: Seen | None) -> Array:
        """(nq,) at ``time``, seconds since the first picture, with what was seen in this one."""
        ...


@dataclass(frozen=True, eq=False)
class Standing:
    """Stays at home."""

    robot: Robot

    def q(self, time: float, seen: Seen | None) -> Array:
        return self.robot.home


@dataclass(frozen=True, eq=False)
class Waving:
    """Swings each joint about home, inside its limits; robots with ball or free joints stay at home."""

    robot: Robot

    def q(self, time: float, seen: Seen | None) -> Array:
        robot = self.robot
        if robot.nq != robot.nv:
            return robot.home
        margin = np.minimum(robot.upper - robot.home, robot.home - robot.lower)
        swing = np.clip(np.nan_to_num(_WAVE_SHARE * margin, posinf=_WAVE_MOST), 0.0, _WAVE_MOST)
        phase = 2.0 * np.pi * time / _WAVE_PERIOD
        return np.asarray(robot.home + swing * np.sin(phase * (1.0 + 0.5 * (np.arange(robot.nq) % 2))))


@dataclass(frozen=True, eq=False)
class Replay:
    """Plays a trajectory over and over; ``notice`` is what the user should know of it, in one line."""

    trajectory: Trajectory
    notice: str = ""

    def q(self, time: float, seen: Seen | None) -> Array:
        length = self.trajectory.duration
        return self.trajectory.at(float(self.trajectory.times[0]) + (time % length if length > 0 else 0.0))


class Following:
    """Reaches for the other marker with its tool; holds still while the marker is not seen."""

    def __init__(self, robot: Robot, figure: DrawnRobot) -> None:
        self._robot, self._figure = robot, figure
        self._solver = SOLVERS["auto"]()
        self._q = np.array(robot.home)

    def q(self, time: float, seen: Seen | None) -> Array:
        if seen is None or seen.marker is None:
            return self._q
        marker = seen.marker.pose
        board = seen.pose_camera_board.inverse().compose(marker)
        base = self._figure.pose_board_base.inverse().compose(board)
        wanted = base.position / self._figure.scale
        here = self._robot.forward(self._q).position
        goal = PositionGoal(self._robot.tool, position=here + _CHASE * (wanted - here))
        found = self._solver.solve(Problem(self._robot, goal), self._q)
        self._q = np.array(found.q)
        return self._q


@dataclass(frozen=True, eq=False)
class Mirroring:
    """Stands as a live arm stands."""

    source: JointSource

    def q(self, time: float, seen: Seen | None) -> Array:
        return self.source.read().q


def make_motion(text: str, robot: Robot, figure: DrawnRobot, stack: contextlib.ExitStack) -> DrawnMotion:
    """The motion of ``robot``, drawn as ``figure``, that ``text`` names; ``stack`` closes what it opens.

    ``text`` is ``home``, ``wave``, ``follow``, ``FILE.csv``, a script (``FILE.toml`` or the name of one that
    comes along), or ``FILE.toml[@BUS]`` of an arm.

    Raises:
        ConfigError: It means nothing, or the file does not fit the robot.
    """
    if text == "home":
        return Standing(robot)
    if text == "wave":
        return Waving(robot)
    if text == "follow":
        return Following(robot, figure)
    if is_script(text):
        return Replay(*play_script(text, robot))
    name, _, bus = text.partition("@")
    path = Path(name)
    if path.suffix == ".csv":
        trajectory = Trajectory.load_csv(path)
        if tuple(trajectory.joints) != tuple(robot.joints):
            raise ConfigError(
                f"has the joints {', '.join(trajectory.joints)}",
                file=path, key="line 1", allowed=f"those of {robot.name}: {', '.join(robot.joints)}",
            )  # fmt: skip
        return Replay(trajectory)
    if path.suffix == ".toml":
        read_text(path, "the script or arm file")
        return Mirroring(_live_arm(path, bus or "sim", robot, stack))
    raise ConfigError(
        f"{text!r} is no motion", file="command line", key="--motion",
        allowed="home, wave, follow, a trajectory (FILE.csv), a script (FILE.toml or "
        f"{', '.join(shipped())}), or an arm (FILE.toml@PORT)",
    )  # fmt: skip


def _live_arm(path: Path, bus: str, robot: Robot, stack: contextlib.ExitStack) -> JointSource:
    """A connected arm, whose servos get no torque: it is only looked at."""
    from robot_ik.hardware import open_arm
    from robot_ik.hardware.config import ArmConfig

    config = ArmConfig.load(path)
    if tuple(joint.name for joint in config.joints) != tuple(robot.joints):
        raise ConfigError(
            f"is of an arm with the joints {', '.join(joint.name for joint in config.joints)}",
            file=path, allowed=f"those of {robot.name}: {', '.join(robot.joints)}",
        )  # fmt: skip
    return stack.enter_context(open_arm(config, bus))
