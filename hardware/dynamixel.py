"""Dynamixel servos on a serial port: ``SerialBus`` with Protocol 2."""

from __future__ import annotations

from robot_ik.hardware.protocol2 import PROTOCOL_2
from robot_ik.hardware.serial_bus import CYCLE_TIME, LENGTHS, MAX_FAST_FAILURES, SerialBus
from robot_ik.ports import Clock

__all__ = ["CYCLE_TIME", "LENGTHS", "MAX_FAST_FAILURES", "DynamixelBus", "listening_time"]

PING_DATA = PROTOCOL_2.ping_data_size
PING_BYTES = PROTOCOL_2.shortest_status + PING_DATA


class DynamixelBus(SerialBus):
    """Protocol 2 servos on one port."""

    def __init__(
        self, port: str, baud: int = 1_000_000, *, retries: int = 2, clock: Clock | None = None
    ) -> None:
        super().__init__(port, baud, PROTOCOL_2, retries=retries, clock=clock)


def listening_time(baud: int) -> float:
    """Return the s in which every possible id could have answered a broadcast ping."""
    return DynamixelBus("", baud).listening_time
