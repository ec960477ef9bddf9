"""Register the types of ``robot_ik.lerobot`` with LeRobot.

LeRobot imports every distribution whose name starts with ``lerobot_robot_``.
"""

from robot_ik.lerobot import RobotIkArmConfig, SceneCameraConfig

__all__ = ["RobotIkArmConfig", "SceneCameraConfig"]
