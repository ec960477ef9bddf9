"""What the drawn robot does: stands, waves, replays a trajectory, follows a marker, mirrors a live arm."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.config import read_text, read_toml, shown
from robot_ik.errors import ConfigError
from robot_ik.geometry import Pose
from robot_ik.goals import PositionGoal
from robot_ik.hardware.config import ArmConfig
from robot_ik.inverse_kinematics import solve
from robot_ik.jobs.robot_setup import robot_named_in
from robot_ik.jobs.script import ScriptRequest, ScriptRun, load_script, shipped
from robot_ik.motion.trajectory import RecorderSink, Trajectory
from robot_ik.ports import Array, Clock, JointSource
from robot_ik.robot import Robot
from robot_ik.robot_arm import open_robot

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
        script = load_script(text)
        return script.resolved(script.robot)
    path = Path(text.partition("@")[0])
    if path.suffix != ".toml":
        return ""
    read_text(path, "the script or arm file")
    return robot_named_in(ArmConfig.load(path))


def play_script(text: str, robot: Robot) -> tuple[Trajectory, str]:
    """Runs it; how the joints moved, where the shafts truly were, and what went wrong in one line.

    Joints that the script's servos do not turn stay at home.

    Raises:
        ConfigError: The script is of another robot, or it is wrong.
        RobotIkError: Of the simulated arm.
    """
    script = load_script(text)
    run = ScriptRun(script, ScriptRequest())
    setup, report = run.setup, run.report
    if report.robot != robot.name:
        raise ConfigError(
            f"is a script of {report.robot}, and {robot.name} is drawn",
            file=script.file, key="robot", allowed=f"--robot {report.robot}",
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


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """What the drawn robot does.

    Attributes:
        q: Returns (nq,) at a time, s since the first picture. The second argument is
            ``pose_board_marker`` of the marker to follow; None if it is not visible.
        seconds: Of a trajectory that is played over and over; 0: it has no end.
        notice: What the user should know of it, in one line.
    """

    q: Callable[[float, Pose | None], Array]
    seconds: float = 0.0
    notice: str = ""


def standing(robot: Robot) -> DrawnMotion:
    """Stays at home."""
    return DrawnMotion(lambda time, marker: robot.home)


def waving(robot: Robot) -> DrawnMotion:
    """Swings each joint about home, inside its limits; robots with ball or free joints stay at home."""
    if robot.nq != robot.nv:
        return standing(robot)
    margin = np.minimum(robot.upper - robot.home, robot.home - robot.lower)
    swing = np.clip(np.nan_to_num(_WAVE_SHARE * margin, posinf=_WAVE_MOST), 0.0, _WAVE_MOST)
    pace = 2.0 * np.pi / _WAVE_PERIOD * (1.0 + 0.5 * (np.arange(robot.nq) % 2))
    return DrawnMotion(lambda time, marker: np.asarray(robot.home + swing * np.sin(pace * time)))


def replay(trajectory: Trajectory, notice: str = "") -> DrawnMotion:
    """Plays a trajectory over and over."""
    begin, length = float(trajectory.times[0]), trajectory.duration
    part = (lambda time: time % length) if length > 0 else (lambda time: 0.0)
    return DrawnMotion(lambda time, marker: trajectory.at(begin + part(time)), length, notice)


def following(robot: Robot, figure: DrawnRobot) -> DrawnMotion:
    """Reaches for the other marker with the tool; holds still while the marker is not seen."""
    last = np.array(robot.home)

    def q(time: float, marker: Pose | None) -> Array:
        if marker is not None:
            wanted = marker_from_base(marker, figure)
            here = robot.forward(last).position
            goal = PositionGoal(robot.tool, position=here + _CHASE * (wanted - here))
            last[:] = solve(robot, goal, start=last).q
        return last.copy()

    return DrawnMotion(q)


def marker_from_base(pose_board_marker: Pose, figure: DrawnRobot) -> Array:
    """Return the marker's position (3,) seen from the base of the drawn robot, in its own metres."""
    pose_base_marker = figure.pose_board_base.inverse().compose(pose_board_marker)
    return np.asarray(pose_base_marker.position / figure.scale)


def make_motion(text: str, robot: Robot, figure: DrawnRobot, stack: contextlib.ExitStack) -> DrawnMotion:
    """The motion of ``robot``, drawn as ``figure``, that ``text`` names; ``stack`` closes what it opens.

    ``text`` is ``home``, ``wave``, ``follow``, ``FILE.csv``, a script (``FILE.toml`` or the name of one that
    comes along), or ``FILE.toml[@BUS]`` of an arm.

    Raises:
        ConfigError: It means nothing, or the file does not fit the robot.
    """
    if text == "home":
        return standing(robot)
    if text == "wave":
        return waving(robot)
    if text == "follow":
        return following(robot, figure)
    if is_script(text):
        return replay(*play_script(text, robot))
    name, _, bus = text.partition("@")
    path = Path(name)
    if path.suffix == ".csv":
        trajectory = Trajectory.load_csv(path)
        if tuple(trajectory.joints) != tuple(robot.joints):
            raise ConfigError(
                f"has the joints {shown(', '.join(trajectory.joints))}",
                file=path, key="line 1", allowed=f"those of {robot.name}: {', '.join(robot.joints)}",
            )  # fmt: skip
        return replay(trajectory)
    if path.suffix == ".toml":
        read_text(path, "the script or arm file")
        arm = _live_arm(path, bus or "sim", robot, stack)
        return DrawnMotion(lambda time, marker: arm.read().q)
    raise ConfigError(
        f"{text!r} is no motion", file="command line", key="--motion",
        allowed="home, wave, follow, a trajectory (FILE.csv), a script (FILE.toml or "
        f"{', '.join(shipped())}), or an arm (FILE.toml@PORT)",
    )  # fmt: skip


def _live_arm(path: Path, bus: str, robot: Robot, stack: contextlib.ExitStack) -> JointSource:
    """A connected arm, whose servos get no torque: it is only looked at."""
    config = ArmConfig.load(path)
    if set(config.chain.names) != set(robot.joints):
        raise ConfigError(
            f"is of an arm with the joints {', '.join(config.chain.names)}",
            file=path, allowed=f"those of {robot.name}: {', '.join(robot.joints)}",
        )  # fmt: skip
    return stack.enter_context(open_robot(robot, config, bus))
