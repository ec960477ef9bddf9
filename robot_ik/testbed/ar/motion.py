"""Motions of the drawn robot: stand, wave, replay, follow a marker, mirror a live arm."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.config import read_text, shown
from robot_ik.errors import ConfigError
from robot_ik.geometry import Pose
from robot_ik.goals import PositionGoal
from robot_ik.hardware.config import ArmConfig
from robot_ik.inverse_kinematics import solve
from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Array, JointSource
from robot_ik.robot import Robot
from robot_ik.robot_arm import open_robot, robot_named_in
from robot_ik.script import load_script, shipped
from robot_ik.testbed.ar.script_motion import is_script, play_script

# A wave goes this part of the way from home to the nearer limit of each joint.
_WAVE_SHARE = 0.25
# Largest amplitude of a wave, rad (m for slides). Some joints have no limits.
_MAX_WAVE = 0.45
# Period of a wave of the joints with an even index, s. It is 2/3 of that for the others.
_WAVE_PERIOD = 4.0
# In one picture the drawn tool covers this part of its distance to the marker.
_FOLLOW_SHARE = 0.35


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A motion of the drawn robot.

    Attributes:
        q: Returns the joint angles (nq,). Its arguments are the time since the first picture in s,
            and ``pose_board_marker`` of the marker to follow (None if it is not visible).
        seconds: Length of a repeated trajectory, s. 0: the motion has no end.
        notice: Message for the user, one line. Empty: none.
    """

    q: Callable[[float, Pose | None], Array]
    seconds: float = 0.0
    notice: str = ""


def standing(robot: Robot) -> DrawnMotion:
    """Return a motion that stays at home."""
    return DrawnMotion(lambda _time, _marker: robot.home)


def waving(robot: Robot) -> DrawnMotion:
    """Return a motion that swings each joint about home, inside its limits.

    Robots with ball or free joints stay at home.
    """
    if robot.nq != robot.nv:
        return standing(robot)
    margin = np.minimum(robot.upper - robot.home, robot.home - robot.lower)
    wanted = np.nan_to_num(_WAVE_SHARE * margin, posinf=_MAX_WAVE)
    amplitude = np.clip(wanted, 0.0, _MAX_WAVE)
    is_odd = np.arange(robot.nq) % 2
    frequency = 2.0 * math.pi / _WAVE_PERIOD * (1.0 + 0.5 * is_odd)

    def q(time: float, _marker: Pose | None) -> Array:
        return np.asarray(robot.home + amplitude * np.sin(frequency * time))

    return DrawnMotion(q)


def replay(trajectory: Trajectory, notice: str = "") -> DrawnMotion:
    """Return a motion that repeats a trajectory."""
    begin = float(trajectory.times[0])
    length = trajectory.duration

    def q(time: float, _marker: Pose | None) -> Array:
        return trajectory.at(begin + (time % length if length > 0.0 else 0.0))

    return DrawnMotion(q, length, notice)


def following(robot: Robot, figure: DrawnRobot) -> DrawnMotion:
    """Return a motion that reaches for the marker to follow with the tool.

    The robot keeps its last joint angles if the marker is not visible.
    """
    last = np.array(robot.home)

    def q(_time: float, marker: Pose | None) -> Array:
        if marker is not None:
            target = marker_from_base(marker, figure)
            position = robot.forward(last).position
            position = position + _FOLLOW_SHARE * (target - position)
            last[:] = solve(robot, PositionGoal(robot.tool, position=position), start=last).q
        return last.copy()

    return DrawnMotion(q)


def marker_from_base(pose_board_marker: Pose, figure: DrawnRobot) -> Array:
    """Return the position (3,) of a marker seen from the base of the drawn robot.

    The unit is the robot's own metre: lengths in the picture are divided by the scale.
    """
    pose_base_marker = figure.pose_board_base.inverse().compose(pose_board_marker)
    return np.asarray(pose_base_marker.position / figure.scale)


def robot_of(text: str) -> str:
    """Return the robot of a motion. Empty: any robot.

    Args:
        text: See ``make_motion``.

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


def make_motion(
    text: str, robot: Robot, figure: DrawnRobot, stack: contextlib.ExitStack
) -> DrawnMotion:
    """Return the motion that a text names.

    Args:
        text: ``home``, ``wave``, ``follow``, a trajectory (``FILE.csv``), a script (``FILE.toml``
            or the name of a bundled one), or an arm (``FILE.toml[@BUS]``).
        robot: Robot that moves.
        figure: How it is drawn.
        stack: Closes the arm.

    Raises:
        ConfigError: The text is unknown, or the file does not fit the robot.
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
        return replay(_load_trajectory(path, robot))
    if path.suffix == ".toml":
        read_text(path, "the script or arm file")
        arm = _open_arm(path, bus or "sim", robot, stack)
        return DrawnMotion(lambda _time, _marker: arm.read().q)
    raise ConfigError(
        f"unknown motion {text!r}",
        file="command line",
        key="--motion",
        allowed="home, wave, follow, a trajectory (FILE.csv), a script (FILE.toml or "
        f"{', '.join(shipped())}), or an arm (FILE.toml@PORT)",
    )


def _load_trajectory(path: Path, robot: Robot) -> Trajectory:
    trajectory = Trajectory.load_csv(path)
    if tuple(trajectory.joints) != tuple(robot.joints):
        raise ConfigError(
            f"has the joints {shown(', '.join(trajectory.joints))}",
            file=path,
            key="line 1",
            allowed=f"those of {robot.name}: {', '.join(robot.joints)}",
        )
    return trajectory


def _open_arm(path: Path, bus: str, robot: Robot, stack: contextlib.ExitStack) -> JointSource:
    """Return a connected arm. Its servos get no torque, because it is only read."""
    config = ArmConfig.load(path)
    if set(config.chain.names) != set(robot.joints):
        raise ConfigError(
            f"is of an arm with the joints {', '.join(config.chain.names)}",
            file=path,
            allowed=f"those of {robot.name}: {', '.join(robot.joints)}",
        )
    return stack.enter_context(open_robot(robot, config, bus))
