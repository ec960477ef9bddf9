"""Dynamixel servos on a serial port: ``SerialBus`` with Protocol 2."""

from __future__ import annotations

from robot_ik.hardware.protocol2 import PROTOCOL_2
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.ports import Clock


class DynamixelBus(SerialBus):
    """Protocol 2 servos on one port."""

    def __init__(
        self, port: str, baud: int = 1_000_000, *, retries: int = 2, clock: Clock | None = None
    ) -> None:
        super().__init__(port, baud, PROTOCOL_2, retries=retries, clock=clock)
