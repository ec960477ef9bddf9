"""The interface that LeRobot's programs use as ``robot.bus``."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from lerobot.motors import Motor, MotorNormMode

from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import GRIPPER
from robot_ik.lerobot.units import POSITION


class BusView:
    """Motors by name, and their positions in LeRobot's units. Goals pass the arm's limiter.

    ``lerobot-find-joint-limits`` and ``gym_manipulator`` use it.

    Args:
        config: Arm file.
        observe: Returns the present positions by key.
        command: Takes the goal positions by key.

    Attributes:
        motors: Joint -> LeRobot's motor.
    """

    def __init__(
        self,
        config: ArmConfig,
        observe: Callable[[], Mapping[str, float]],
        command: Callable[[Mapping[str, float]], object],
    ) -> None:
        self.motors = {}
        for joint in config.joints:
            is_gripper = joint.group == GRIPPER
            mode = MotorNormMode.RANGE_0_100 if is_gripper else MotorNormMode.DEGREES
            self.motors[joint.name] = Motor(joint.servo.id, joint.servo.model.lower(), mode)
        self._observe = observe
        self._command = command

    def sync_read(self, data_name: str, *_args: object, **_options: object) -> dict[str, float]:
        """Return Present_Position by motor."""
        _require(data_name, "Present_Position")
        return {key.removesuffix(POSITION): value for key, value in self._observe().items()}

    def sync_write(self, data_name: str, values: Mapping[str, float], **_options: object) -> None:
        """Send Goal_Position by motor."""
        _require(data_name, "Goal_Position")
        self._command({name + POSITION: value for name, value in values.items()})


def _require(data_name: str, allowed: str) -> None:
    if data_name != allowed:
        raise NotImplementedError(
            f"register {data_name!r} is not supported (allowed: {allowed}); use robot.arm instead"
        )
