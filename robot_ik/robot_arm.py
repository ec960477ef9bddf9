"""The front door to a robot with servos: a model, an arm file and a bus that fit together."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import ConfigError
from robot_ik.hardware import bus_row, open_arm
from robot_ik.hardware.calibration import check_model
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import Array, Clock, Closing
from robot_ik.robot import Robot, load_robot
from robot_ik.robot_file import catalogue

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.virtual.bus import VirtualBus


@dataclass(frozen=True)
class RobotArm(Closing):
    """A robot model and the arm of servos that moves it.

    Used in a ``with`` block: entering connects the arm, leaving applies the exit policy.

    Attributes:
        robot: Model with the arm's joints in the arm's order, limited to what the servos reach.
        arm: Servos; disconnected until the ``with`` block.
    """

    robot: Robot
    arm: Arm

    @property
    def config(self) -> ArmConfig:
        """Arm file."""
        return self.arm.config

    @property
    def clock(self) -> Clock:
        """Clock on which the arm runs; virtual on the bus ``sim``."""
        return self.arm.clock

    def read(self) -> Array:
        """Return the measured joint values (n,), rad or m, in the order of ``robot.joints``."""
        return self.arm.read().q

    def __enter__(self) -> Self:
        if self.arm.state.value == "disconnected":
            self.arm.connect()
        return self

    def close(self) -> None:
        """Leave the arm as its exit policy says, and close the bus."""
        self.arm.close()


def open_robot(
    name: str | os.PathLike[str],
    arm: Path | str | None = None,
    bus: str = "sim",
    *,
    on_exit: str | None = None,
    start: ArrayLike | None = None,
    virtual_bus: VirtualBus | None = None,
) -> RobotArm:
    """Return a robot and its arm on a bus.  Nothing is connected and no torque changes.

    If a calibration stands beside the arm file, the model must be the one that was calibrated.
    This check cannot be skipped.

    Args:
        name: Robot of the catalogue, or path of a model.
        arm: Arm file.  None: the arm file beside the model.
        bus: ``"sim"``, ``"pty"`` or a serial port such as ``"/dev/ttyUSB0"``.
        on_exit: ``"torque_off"``, ``"hold"`` or ``"park"``.  None: as the arm file says.
        start: (n,) initial joint values of simulated servos.  None: home of the robot.
        virtual_bus: Simulated servos to use instead of new ones.

    Raises:
        ConfigError: There is no arm file, or it does not fit the model.
        CalibrationMismatchError: The model is not the one of the calibration.
        ModelError: The model cannot be read.
    """
    robot = load_robot(name)
    config = ArmConfig.load(arm or _arm_file_beside(robot))
    robot, config = _matched(robot, name, config)
    check_model(config, _model_limits(robot))
    robot = robot.with_limits(config.lower, config.upper)
    if start is None and virtual_bus is None and bus_row(bus).virtual:
        start = robot.home
    opened = open_arm(config, bus, on_exit=on_exit, virtual_bus=virtual_bus, start=start)
    return RobotArm(robot, opened)


def _arm_file_beside(robot: Robot) -> Path:
    if robot.arm_file is not None:
        return robot.arm_file
    robots = [name for name, folder in catalogue().items() if (folder / "arm.toml").is_file()]
    raise ConfigError(
        "this robot has no arm file",
        file=robot.name,
        allowed=f"--arm FILE, or one of {', '.join(robots)}",
    )


def _matched(
    robot: Robot, name: str | os.PathLike[str], config: ArmConfig
) -> tuple[Robot, ArmConfig]:
    """Return the robot with the arm's joints only, and the arm in the robot's joint order."""
    _require_joints(robot.joints, config)
    if set(config.names) != set(robot.joints):
        robot = load_robot(name, joints=config.names)
    by_name = {joint.name: joint for joint in config.joints}
    return robot, replace(config, joints=tuple(by_name[joint] for joint in robot.joints))


def _require_joints(joints: Sequence[str], config: ArmConfig) -> None:
    unknown = [joint for joint in config.names if joint not in joints]
    if unknown:
        raise ConfigError(
            f"the model has no joint {', '.join(map(repr, unknown))}",
            file=config.file or config.name,
            key="joints",
            allowed=", ".join(joints),
        )


def _model_limits(robot: Robot) -> dict[str, tuple[float, float]]:
    """Return joint -> limits of the model, rad or m."""
    lower = np.asarray(robot.lower)[robot.tree.vadr]
    upper = np.asarray(robot.upper)[robot.tree.vadr]
    pairs = zip(lower.tolist(), upper.tolist(), strict=True)
    return dict(zip(robot.joints, pairs, strict=True))
