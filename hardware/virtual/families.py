"""The virtual servos of every servo family: one row a family."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from robot_ik.hardware.servo import Drive
from robot_ik.hardware.virtual.protocol1_side import Protocol1Side
from robot_ik.hardware.virtual.protocol2_side import Protocol2Side
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.hardware.virtual.servo_side import ServoSide
from robot_ik.hardware.virtual.sts3215 import VirtualSts3215
from robot_ik.ports import Clock


@dataclass(frozen=True)
class VirtualFamily:
    """Virtual servos of one family.

    Attributes:
        side: Their side of the wire protocol.
        from_drive: (servo of an arm file, clock, position in ticks, baud rate) -> servo.
        another: (model, id, clock, baud rate) -> servo.
    """

    side: ServoSide
    from_drive: Callable[[Drive, Clock, float, int], Any]
    another: Callable[[str, int, Clock, int], Any]


def _dynamixel_x(drive: Drive, clock: Clock, position_ticks: float, baud: int) -> VirtualServo:
    servo = drive.servo
    return VirtualServo(
        servo.model,
        servo.id,
        clock,
        position_ticks=position_ticks,
        mode=servo.mode,
        baud=baud,
        reverse=bool(servo.reverse),
        shadow_of=servo.primary_id,
    )


def _feetech_sts(drive: Drive, clock: Clock, position_ticks: float, baud: int) -> VirtualSts3215:
    return VirtualSts3215(
        drive.id, clock, model=drive.servo.model, position_ticks=position_ticks, baud=baud
    )


VIRTUAL_FAMILIES: Mapping[str, VirtualFamily] = MappingProxyType(
    {
        "dynamixel_x": VirtualFamily(
            Protocol2Side(),
            _dynamixel_x,
            lambda model, id, clock, baud: VirtualServo(model, id, clock, baud=baud),
        ),
        "feetech_sts": VirtualFamily(
            Protocol1Side(),
            _feetech_sts,
            lambda model, id, clock, baud: VirtualSts3215(id, clock, model=model, baud=baud),
        ),
    }
)
"""Name of a family -> its virtual servos.  The only place of registration."""
