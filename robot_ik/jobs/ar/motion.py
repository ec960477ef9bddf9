"""Motions of the drawn robot: home, wave, trajectory, script, following a marker, live arm."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.config import read_text, read_toml
from robot_ik.errors import ConfigError
from robot_ik.geometry import Pose
from robot_ik.goals import PositionGoal
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.inverse_kinematics import solve
from robot_ik.jobs.robot_setup import check_calibrated_model, robot_named_in
from robot_ik.jobs.script import ScriptRequest, ScriptRun, load_script, shipped
from robot_ik.motion.trajectory import RecorderSink, Trajectory
from robot_ik.ports import Array, Clock, JointSource
from robot_ik.robot import Robot

# A wave goes this share of the way to each joint's limits.
_WAVE_SHARE = 0.25
# Largest amplitude of a wave, rad: for joints with wide limits or none.
_WAVE_MOST = 0.45
# Period of a wave, s.
_WAVE_PERIOD = 4.0
# Share of the distance to the marker that the drawn tool covers in one picture. It smooths the
# motion.
_CHASE = 0.35


class _RecordingClock:
    """A clock that records the joints after each wait."""

    def __init__(self, clock: Clock, run: ScriptRun, recorder: RecorderSink) -> None:
        self._clock = clock
        self._run = run
        self._recorder = recorder

    def now(self) -> float:
        return self._clock.now()

    def sleep_until(self, deadline: float) -> None:
        self._clock.sleep_until(deadline)
        self._recorder.send(self._run.setup.true_q(), self._clock.now())


def is_script(text: str) -> bool:
    """Return whether this is the name of a bundled script, or a TOML file with steps."""
    if text in shipped():
        return True
    path = Path(text).expanduser()
    try:
        return path.suffix == ".toml" and "steps" in read_toml(path, "the script")
    except ConfigError:
        return False


def robot_of(text: str) -> str:
    """Return the robot of a script or an arm file. Empty for motions of any robot.

    Raises:
        ConfigError: The script or the arm file is invalid.
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
    """Run a script on simulated servos.

    Joints that the script's servos do not turn stay at home.

    Returns:
        The true motion of the joints, and what failed, in one line. Empty if nothing failed.

    Raises:
        ConfigError: The script is for another robot, or it is invalid.
        RobotIkError: The simulated arm fails.
    """
    script = load_script(text)
    run = ScriptRun(script, ScriptRequest())
    setup = run.setup
    report = run.report
    if report.robot != robot.name:
        raise ConfigError(
            f"is a script of {report.robot}, and {robot.name} is drawn",
            file=script.file,
            key="robot",
            allowed=f"--robot {report.robot}",
        )
    recorder = RecorderSink(setup.robot.joints)
    # A script that never waits has only this configuration.
    recorder.send(setup.true_q(), setup.clock.now())
    setup.clock = _RecordingClock(setup.clock, run, recorder)
    run.run()
    moved = recorder.trajectory()
    q = np.tile(robot.home, (len(moved), 1))
    for column, joint in enumerate(moved.joints):
        q[:, robot.joints.index(joint)] = moved.q[:, column]
    failed = next((step for step in report.steps if step.outcome == "failed"), None)
    notice = "" if failed is None else f"the script failed at {failed.name!r}: {failed.found}"
    return Trajectory(moved.times, q, robot.joints), notice


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """Motion of the drawn robot.

    Attributes:
        q: Returns (nq,) at a time, s since the first picture. The second argument is
            ``pose_board_marker`` of the marker to follow; None if it is not visible.
        seconds: Length of a trajectory that is repeated, s. 0 for a motion without an end.
        notice: What the user should know about it, in one line.
    """

    q: Callable[[float, Pose | None], Array]
    seconds: float = 0.0
    notice: str = ""


def standing(robot: Robot) -> DrawnMotion:
    """Return a robot that stays at home."""
    return DrawnMotion(lambda _time, _marker: robot.home)


def waving(robot: Robot) -> DrawnMotion:
    """Return a motion of each joint about home, inside its limits.

    Robots with ball or free joints stay at home.
    """
    if robot.nq != robot.nv:
        return standing(robot)
    margin = np.minimum(robot.upper - robot.home, robot.home - robot.lower)
    swing = np.clip(np.nan_to_num(_WAVE_SHARE * margin, posinf=_WAVE_MOST), 0.0, _WAVE_MOST)
    pace = 2.0 * np.pi / _WAVE_PERIOD * (1.0 + 0.5 * (np.arange(robot.nq) % 2))
    return DrawnMotion(lambda time, _marker: np.asarray(robot.home + swing * np.sin(pace * time)))


def replay(trajectory: Trajectory, notice: str = "") -> DrawnMotion:
    """Return a motion that repeats a trajectory."""
    begin = float(trajectory.times[0])
    length = trajectory.duration

    def q(time: float, _marker: Pose | None) -> Array:
        return trajectory.at(begin + time % length if length > 0.0 else begin)

    return DrawnMotion(q, length, notice)


def following(robot: Robot, figure: DrawnRobot) -> DrawnMotion:
    """Return a motion that reaches for a marker and holds still while it is not visible."""
    last = np.array(robot.home)

    def q(_time: float, marker: Pose | None) -> Array:
        if marker is not None:
            wanted = marker_from_base(marker, figure)
            here = robot.forward(last).position
            goal = PositionGoal(robot.tool, position=here + _CHASE * (wanted - here))
            last[:] = solve(robot, goal, start=last).q
        return last.copy()

    return DrawnMotion(q)


def marker_from_base(pose_board_marker: Pose, figure: DrawnRobot) -> Array:
    """Return the marker's position (3,) in the base of the drawn robot, in its own metres."""
    pose_base_marker = figure.pose_board_base.inverse().compose(pose_board_marker)
    return np.asarray(pose_base_marker.position / figure.scale)


def make_motion(
    text: str, robot: Robot, figure: DrawnRobot, stack: contextlib.ExitStack
) -> DrawnMotion:
    """Return the motion of ``robot``, drawn as ``figure``, that ``text`` names.

    ``text`` is ``home``, ``wave``, ``follow``, ``FILE.csv``, a script (``FILE.toml`` or the name of
    a bundled script), or ``FILE.toml[@BUS]`` of an arm.

    Raises:
        ConfigError: ``text`` is no motion, or the file does not fit the robot.
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
                f"has the joints {', '.join(trajectory.joints)}",
                file=path,
                key="line 1",
                allowed=f"those of {robot.name}: {', '.join(robot.joints)}",
            )
        return replay(trajectory)
    if path.suffix == ".toml":
        read_text(path, "the script or arm file")
        arm = _live_arm(path, bus or "sim", robot, stack)
        return DrawnMotion(lambda _time, _marker: arm.read().q)
    raise ConfigError(
        f"{text!r} is no motion",
        file="command line",
        key="--motion",
        allowed="home, wave, follow, a trajectory (FILE.csv), a script (FILE.toml or "
        f"{', '.join(shipped())}), or an arm (FILE.toml@PORT)",
    )


def _live_arm(path: Path, bus: str, robot: Robot, stack: contextlib.ExitStack) -> JointSource:
    """Return a connected arm. It is only read: its servos get no torque."""
    config = ArmConfig.load(path)
    if tuple(joint.name for joint in config.joints) != tuple(robot.joints):
        raise ConfigError(
            f"is of an arm with the joints {', '.join(joint.name for joint in config.joints)}",
            file=path,
            allowed=f"those of {robot.name}: {', '.join(robot.joints)}",
        )
    check_calibrated_model(robot, config)
    return stack.enter_context(open_arm(config, bus))
