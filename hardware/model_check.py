"""The model of an arm against the calibration beside its arm file."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

from robot_ik.errors import RobotIkError, UnknownJointError
from robot_ik.hardware.calibration import check_model, own_calibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.robot import Robot, load_robot

log = logging.getLogger(__name__)


def check_own_model(config: ArmConfig, robot: Robot | None = None) -> None:
    """Check that the arm was calibrated for this model.

    Without a calibration beside the arm file there is nothing to check, and no model is loaded.  If
    the model that the arm file names cannot be read, a warning is logged.

    Args:
        config: Arm file.
        robot: Model.  None: the robot that the arm file names.

    Raises:
        CalibrationMismatchError: The calibration is of another model.
        ConfigError: The calibration cannot be read.
    """
    if own_calibration(config) is None:
        return
    if robot is None:
        try:
            robot = _named_robot(config)
        except RobotIkError as error:
            problem = error.args[0]
            log.warning("the calibration is not compared with the model: %s", problem)
            return
    check_model(config, _limits(robot))


def model_limits(config: ArmConfig) -> Mapping[str, tuple[float, float]]:
    """Return joint -> limits, rad or m, of the robot that an arm file names.

    Joints without a finite limit in the model, and all joints if the model cannot be read, have
    the limits of the arm file.
    """
    file_limits = {joint.name: (joint.lower, joint.upper) for joint in config.joints}
    try:
        limits = _limits(_named_robot(config))
    except RobotIkError as error:
        log.warning("without the model (%s): limits are the arm file's", error.args[0])
        return file_limits
    finite_limits = {
        name: ends
        for name, ends in limits.items()
        if name in file_limits and all(map(math.isfinite, ends))
    }
    return file_limits | finite_limits


def _named_robot(config: ArmConfig) -> Robot:
    """Return the robot that an arm file names, with the joints of the arm that it has."""
    try:
        return load_robot(config.robot_source, joints=config.names)
    except UnknownJointError:  # a joint of the gripper that the model does not have
        return load_robot(config.robot_source)


def _limits(robot: Robot) -> dict[str, tuple[float, float]]:
    """Return joint -> limits of a model, rad or m."""
    return {
        joint: (float(robot.lower[v]), float(robot.upper[v]))
        for joint, v in zip(robot.joints, robot.tree.vadr.tolist(), strict=True)
    }
