"""LeRobot's units of joint positions.

Degrees for hinges, millimetres for slides, and 0 (closed) to 100 (open) for grippers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from robot_ik.errors import UnsafeCommandError, did_you_mean
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import GRIPPER, Joint

POSITION = ".pos"
"""End of the key of a joint position in observations and actions."""

VELOCITY = ".vel"
"""End of the key of a joint velocity in observations."""


@dataclass(frozen=True)
class Scale:
    """Linear relation between a joint value (rad or m) and LeRobot's number.

    Attributes:
        zero: Joint value at LeRobot's 0.
        per_unit: Joint value of one unit.
    """

    zero: float
    per_unit: float

    def number(self, value: float) -> float:
        """Return LeRobot's number of a joint value."""
        return (value - self.zero) / self.per_unit

    def value(self, number: float) -> float:
        """Return the joint value of LeRobot's number."""
        return self.zero + number * self.per_unit

    def rate(self, velocity: float) -> float:
        """Return LeRobot's number a second of a joint velocity."""
        return velocity / self.per_unit

    @classmethod
    def of(cls, joint: Joint) -> Scale:
        """Return the scale of a joint: percent for a gripper, otherwise degrees or millimetres."""
        if joint.group != GRIPPER:
            return cls(0.0, joint.per_unit)
        closed = joint.at_opening(0.0)
        return cls(closed, (joint.at_opening(1.0) - closed) / 100.0)


class Units:
    """LeRobot's numbers of every joint of an arm.

    Args:
        config: Arm file.

    Attributes:
        joints: Names in the order of the arm file.
        grippers: Names of the gripper joints.
        features: LeRobot's description of the joint positions: key -> type.
        velocity_features: The same of the joint velocities.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._scales = {joint.name: Scale.of(joint) for joint in config.joints}
        self.joints = config.names
        self.grippers = tuple(joint.name for joint in config.group(GRIPPER))
        self.features: dict[str, type] = {name + POSITION: float for name in self.joints}
        self.velocity_features: dict[str, type] = {name + VELOCITY: float for name in self.joints}

    def numbers(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return key -> LeRobot's number, in the order of ``joints``."""
        return {name + POSITION: self.number(name, values[name]) for name in self.joints}

    def rates(self, velocities: Mapping[str, float]) -> dict[str, float]:
        """Return key -> LeRobot's number a second, in the order of ``joints``.

        Args:
            velocities: Joint -> rad/s or m/s.
        """
        return {name + VELOCITY: self._scales[name].rate(velocities[name]) for name in self.joints}

    def values(self, action: Mapping[str, float]) -> dict[str, float]:
        """Return joint -> rad or m, of the keys that end in ``.pos``.

        Raises:
            UnsafeCommandError: A key names no joint of this arm, or there is no such key.
        """
        values = {}
        for key, number in action.items():
            if not key.endswith(POSITION):
                continue
            name = key.removesuffix(POSITION)
            if name not in self._scales:
                question = did_you_mean(name, self.joints)
                raise UnsafeCommandError(
                    f"an action for unknown joint {name!r}{'; ' + question if question else ''}",
                    ", ".join(self.joints),
                )
            values[name] = self.value(name, number)
        if not values:
            keys = ", ".join(name + POSITION for name in self.joints)
            raise UnsafeCommandError(f"an action without joints ({list(action)})", keys)
        return values

    def number(self, name: str, value: float) -> float:
        """Return LeRobot's number of the value of a joint."""
        return self._scales[name].number(value)

    def value(self, name: str, number: float) -> float:
        """Return the joint value of LeRobot's number."""
        return self._scales[name].value(float(number))
