"""Options of the robot type ``robot_ik_arm``."""
# LeRobot's parser reads the types of the fields, so annotations must not be postponed.

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig

CONTROLS = ("joints", "tool")
"""Values of ``control``."""


@RobotConfig.register_subclass("robot_ik_arm")
@dataclass(kw_only=True)
class RobotIkArmConfig(RobotConfig):
    """An arm of servos that robot_ik drives. It is simulated by default.

    Attributes:
        arm: Robot of the catalogue that has an arm file, or path of an arm file.
        port: ``sim``: simulated servos in this process; ``pty``: simulated servos behind a pseudo
            terminal; or a serial port.
        control: ``joints``: actions are ``<joint>.pos``; ``tool``: actions are the tool pose,
            ``ee.x`` to ``ee.wz``, and ``ee.gripper_pos``.
        observe_tool: Add the measured tool pose ``ee.x`` to ``ee.wz`` to the observation.
        observe_velocity: Add the measured joint velocities, ``<joint>.vel``, to the observation.
            The unit is that of ``<joint>.pos`` a second: deg/s, mm/s or %/s.
        fps: Rate of LeRobot's loop, Hz. The limiter needs it: one command moves the arm by at most
            two periods of its speed limit.
        disable_torque_on_disconnect: True: apply the exit policy of the arm file. False: hold the
            arm with torque.
        cameras: LeRobot's cameras by name. The type ``robot_ik_scene`` draws the arm.
    """

    arm: str = "so101"
    port: str = "sim"
    control: str = "joints"
    observe_tool: bool = False
    observe_velocity: bool = False
    fps: float = 30.0
    disable_torque_on_disconnect: bool = True
    cameras: dict[str, CameraConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.control not in CONTROLS:
            allowed = " or ".join(CONTROLS)
            raise ValueError(f"unknown control {self.control!r} (allowed: {allowed})")
        if not self.fps > 0.0:
            raise ValueError(f"fps {self.fps} is not allowed (allowed: above 0, such as 30)")
