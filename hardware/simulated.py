"""Servo buses with simulated servos: in process, and behind a pty.

The driver is that of real servos, including packets, checks and repetitions. In process its port
calls the virtual bus as a function: a reply is there at once or never, and requests take no time on
the clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from robot_ik.hardware import pty_port
from robot_ik.hardware.bus import Counters
from robot_ik.hardware.protocol2 import PROTOCOL_2
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.hardware.serial_port import SleepingPortHandler
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.wire_protocol import WireProtocol

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.pty import PtyPort


class SimBus(SerialBus):
    """Implements ``ServoBus`` on a ``VirtualBus``, usually on a ``VirtualClock``."""

    def __init__(
        self,
        virtual_bus: VirtualBus,
        protocol: WireProtocol = PROTOCOL_2,
        *,
        retries: int = 2,
        real: bool = False,
    ) -> None:
        super().__init__("sim", 1_000_000, protocol, retries=retries, clock=virtual_bus.clock)
        self.real = real  # tests treat these servos as real
        self.virtual_bus = virtual_bus

    def _make_handler(self) -> InProcessPort:
        return InProcessPort(self.virtual_bus, self.port, self.baud, self.counters)


class InProcessPort(SleepingPortHandler):
    """The serial port of a ``SimBus``: bytes are answered before ``writePort`` returns."""

    def __init__(self, virtual_bus: VirtualBus, name: str, baud: int, counters: Counters) -> None:
        super().__init__(name, baud, counters)
        self.seconds_per_byte = 0.0
        self._bus = virtual_bus
        self._buffer = b""

    def openPort(self) -> bool:
        self._advance()
        self.is_open = True
        return True

    def closePort(self) -> None:
        self.is_open = False

    def clear(self) -> None:
        self._buffer = b""

    clearPort = clear

    def writePort(self, packet: Sequence[int] | bytes) -> int:
        self._advance()
        self._counters.bytes_sent += len(packet)
        self._buffer += self._bus.handle(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:
        data = self._buffer[:length]
        self._buffer = self._buffer[length:]
        self._counters.bytes_received += len(data)
        return data

    def receive(self, _deadline: float, _expected: float | None = None) -> bytes:
        return self.readPort(len(self._buffer))

    def isPacketTimeout(self) -> bool:
        """Return True if there is no reply: none will come later."""
        return not self._buffer

    def _advance(self) -> None:
        self._bus.advance()
        if self._bus.unplugged:
            raise OSError("the port was unplugged")


class ServedBus(SerialBus):
    """Virtual servos behind a real pty, with the driver of real servos on it.

    The port is made by ``open`` and removed by ``close``. Meanwhile ``port`` is its path.
    """

    real = False

    def __init__(self, servos: VirtualBus, baud: int, protocol: WireProtocol = PROTOCOL_2) -> None:
        super().__init__("pty", baud, protocol)
        self.clock = servos.clock  # clock of the arm; the wire takes real time
        self.virtual_bus = servos
        self._pty: PtyPort | None = None

    def open(self) -> None:
        if self._pty is None:
            self._pty = pty_port()(self.virtual_bus)
        self.port = self._pty.path  # it changes after the port was unplugged
        super().open()

    def close(self) -> None:
        super().close()
        served = self._pty
        self._pty = None
        if served is not None:
            served.close()
