"""A servo bus without a wire: the driver itself, on a port that calls the virtual bus as a function.

The same code drives servos here and on metal, packets, checks and repetitions included; only time differs:
a reply is there at once or never, and requests take no time on the clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from robot_ik.hardware.bus import Counters
from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.serial_port import SleepingPortHandler
from robot_ik.hardware.virtual.bus import VirtualBus

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.pty import PtyPort


class SimBus(DynamixelBus):
    """Implements ``ServoBus`` on a ``VirtualBus``, usually on a ``VirtualClock``.

    Args:
        virtual_bus: The servos.
        retries: How often an unanswered or corrupt request is repeated.
    """

    def __init__(self, virtual_bus: VirtualBus, *, retries: int = 2) -> None:
        self.virtual_bus = virtual_bus

        def handler(name: str, baud: int, counters: Counters, response_time: float) -> InProcessPort:
            return InProcessPort(virtual_bus, name, baud, counters)

        super().__init__("sim", retries=retries, make_handler=handler, now=virtual_bus.clock.now)


class InProcessPort(SleepingPortHandler):
    """What the driver takes for a serial port: bytes written are answered before the call returns.

    Args:
        virtual_bus: The servos.
        name: For messages.
        baud: bit/s, for messages.
        counters: Of the bus.
    """

    def __init__(self, virtual_bus: VirtualBus, name: str, baud: int, counters: Counters) -> None:
        super().__init__(name, baud, counters)
        self.seconds_per_byte = 0.0
        self._bus = virtual_bus
        self._buffer = b""

    def openPort(self) -> bool:
        """Nothing can be in the way, but for a port that is not there."""
        self._advance()
        self.is_open = True
        return True

    def closePort(self) -> None:
        """May be called any number of times."""
        self.is_open = False

    def clear(self) -> None:
        """Throws away what was not read."""
        self._buffer = b""

    clearPort = clear

    def drain(self, quiet: float, longest: float = 0.1) -> None:
        """The same: nothing is on its way."""
        self._buffer = b""

    def writePort(self, packet: Sequence[int] | bytes) -> int:
        """Number of bytes written."""
        self._advance()
        self._counters.bytes_sent += len(packet)
        self._buffer += self._bus.handle(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:
        """At most ``length`` bytes."""
        data, self._buffer = self._buffer[:length], self._buffer[length:]
        self._counters.bytes_received += len(data)
        return data

    def receive(self, deadline: float, expected: float | None = None) -> bytes:
        """All there is."""
        return self.readPort(len(self._buffer))

    def setPacketTimeout(self, packet_length: int) -> None:
        """Nothing is waited for here."""

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Nothing is waited for here."""

    def isPacketTimeout(self) -> bool:
        """What is not there now will not come."""
        return not self._buffer

    def _advance(self) -> None:
        self._bus.advance()
        if self._bus.unplugged:
            raise OSError("it was unplugged")


# ------------------------------------------------------------------------------------------
# Virtual servos behind a real pty, and the driver of real ones on it: all but the wire is as with metal.


class ServedBus(DynamixelBus):
    """A ``DynamixelBus`` that brings its own port and takes it away when closed.

    Args:
        servos: What is behind the port.
        baud: bit/s.

    Attributes:
        port: Path of the pty while it is open.
    """

    def __init__(self, servos: VirtualBus, baud: int) -> None:
        super().__init__("pty", baud)
        self._servos = servos
        self._pty: PtyPort | None = None

    def open(self) -> None:
        """Makes the pty and opens it."""
        if self._pty is None:
            from robot_ik.hardware.virtual.pty import PtyPort  # not on Windows

            self._pty = PtyPort(self._servos)
        self.port = self._wire.port = self._pty.path  # another one after it was unplugged
        super().open()

    def close(self) -> None:
        """Closes the port, then removes it; may be called any number of times."""
        super().close()
        served, self._pty = self._pty, None
        if served is not None:
            served.close()
