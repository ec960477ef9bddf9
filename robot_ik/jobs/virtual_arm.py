"""The simulated servos of an arm file: at the robot's home, and moved by its model where that is wanted."""

from __future__ import annotations

from robot_ik.errors import RobotIkError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import Clock
from robot_ik.robot import Robot, load_robot


def model_of(config: ArmConfig) -> Robot | None:
    """The robot that an arm file names, with its joints alone; None where its model is not at hand."""
    try:
        return load_robot(config.robot, joints=config.names)
    except RobotIkError:
        return None


def virtual_arm(config: ArmConfig, clock: Clock, *, seed: int = 0) -> VirtualBus:
    """Servos that stand at the robot's home, where its model is at hand, else at q = 0.

    Args:
        config: Which servos.
        clock: On which they move.
        seed: Of their random faults.
    """
    robot = model_of(config)
    home = robot.home if robot is not None and robot.joints == config.names else None
    return VirtualBus.from_config(config, clock, home, seed=seed)


def add_world(config: ArmConfig, bus: VirtualBus) -> None:
    """From here on the robot's own MuJoCo model moves the shafts.

    Raises:
        RobotIkError: It has no model at hand, or not these joints.
    """
    from robot_ik.hardware.virtual.world import World  # MuJoCo, which a bus without a world does not need

    World(load_robot(config.robot).model, config, bus)
