"""``Kinematics``: in place of LeRobot's ``RobotKinematics``, without LeRobot and without placo."""

from robot_ik.lerobot.kinematics import Kinematics

__all__ = ["Kinematics"]
