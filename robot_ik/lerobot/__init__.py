"""Interfaces to LeRobot.

``Kinematics`` replaces LeRobot's ``RobotKinematics``. It needs neither LeRobot nor placo.

LeRobot's programs find the robot type ``robot_ik_arm`` and the camera type ``robot_ik_scene`` by
``--robot.discover_packages_path=robot_ik.lerobot``, or through the distribution
``lerobot_robot_robot_ik``. These modules need LeRobot, so each name is imported when it is first
used.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robot_ik.lerobot.arm import RobotIkArm
    from robot_ik.lerobot.config_arm import RobotIkArmConfig
    from robot_ik.lerobot.config_scene_camera import SceneCameraConfig
    from robot_ik.lerobot.kinematics import Kinematics
    from robot_ik.lerobot.scene_camera import SceneCamera

__all__ = ["Kinematics", "RobotIkArm", "RobotIkArmConfig", "SceneCamera", "SceneCameraConfig"]

_MODULES = {
    "Kinematics": "kinematics",
    "RobotIkArm": "arm",
    "RobotIkArmConfig": "config_arm",
    "SceneCamera": "scene_camera",
    "SceneCameraConfig": "config_scene_camera",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
