"""Virtual servos behind a real pty, and the driver of real ones on it: all but the wire is as with metal."""

from __future__ import annotations

from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.pty import PtyPort


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
            self._pty = PtyPort(self._servos)
        self.port = self._wire.port = self._pty.path  # another one after it was unplugged
        super().open()

    def close(self) -> None:
        """Closes the port, then removes it; may be called any number of times."""
        super().close()
        served, self._pty = self._pty, None
        if served is not None:
            served.close()
