"""Joints for tests: a joint by the numbers of its servo, changed servos, second servos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from robot_ik.hardware.arm_file import TwinTable, second_servo
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Direct, Gear, Joint, Servo


@dataclass(frozen=True)
class Twin:
    """The second servo of a joint, see ``TwinTable``."""

    id: int
    direction: Any = 1
    zero_ticks: int = 2048
    shadow: bool = False
    reverse: bool | None = None


def make_joint(
    name: str = "j",
    id: int = 1,
    model: str = "XM430-W350",
    mode: OperatingMode = OperatingMode.EXTENDED_POSITION,
    direction: Any = 1,
    zero_ticks: int = 2048,
    lower: float = -2.0,
    upper: float = 2.0,
    velocity: float = 1.0,
    acceleration: float = 1.0,
    *,
    gear: Gear | None = None,
    reverse: bool | None = False,
    **more: Any,
) -> Joint:
    """Return a joint with one servo."""
    servo = Servo(id, model, mode, direction, zero_ticks, reverse)
    return Joint(name, gear or Direct(), (servo,), lower, upper, velocity, acceleration, **more)


def with_servo(joint: Joint, **changes: Any) -> Joint:
    """Return a joint whose servos are changed."""
    return replace(joint, servos=tuple(replace(servo, **changes) for servo in joint.servos))


def with_twin(joint: Joint, twin: Twin | None) -> Joint:
    """Return a joint with a second servo, or without."""
    first = joint.servo
    if twin is None:
        return replace(joint, servos=(first,))
    table = TwinTable(
        id=twin.id,
        direction=twin.direction,
        zero_ticks=twin.zero_ticks,
        shadow=twin.shadow,
        reverse=twin.reverse,
    )
    return replace(joint, servos=(first, second_servo(first, table)))
