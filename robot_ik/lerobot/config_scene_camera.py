"""Options of the camera type ``robot_ik_scene``."""
# LeRobot's parser reads the types of the fields, so annotations must not be postponed.

from dataclasses import dataclass

from lerobot.cameras import CameraConfig


@CameraConfig.register_subclass("robot_ik_scene")
@dataclass(kw_only=True)
class SceneCameraConfig(CameraConfig):
    """A drawn picture of the arm at its measured joint angles. It needs no OpenGL.

    Attributes:
        width: Width of the picture, px.
        height: Height of the picture, px.
        fps: Pictures per second that LeRobot writes into the dataset.
        position: Camera position, m, base frame.
        look_at: Point in the middle of the picture, m, base frame.
        field_of_view_deg: Horizontal field of view.
    """

    width: int | None = 320
    height: int | None = 240
    fps: int | None = 30
    position: tuple[float, float, float] = (0.62, 0.32, 0.36)
    look_at: tuple[float, float, float] = (0.22, -0.02, 0.06)
    field_of_view_deg: float = 60.0
