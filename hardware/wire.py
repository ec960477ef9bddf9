"""One serial port as a line of Protocol 2.0 packets: locked, never left busy, nothing decoded unchecked.

The SDK marks a port busy while a transaction runs and forgets to clear the mark when an exception (Ctrl-C, a
pulled cable) ends it; every later write, torque off among them, is then refused.  Here the mark is cleared
whatever happens, and a line on which answers may still be under way is emptied before the next request.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dynamixel_sdk import COMM_RX_CORRUPT, COMM_SUCCESS, Protocol2PacketHandler

from robot_ik.errors import BusDisconnectedError, BusNotOpenError
from robot_ik.hardware.bus import ALERT_BIT, Counters
from robot_ik.hardware.control_table import BAUD_RATES
from robot_ik.hardware.packets import SHORTEST_STATUS, Answer
from robot_ik.hardware.quiet_port import PORT_ERRORS, QuietPortHandler, describe_failure

log = logging.getLogger(__name__)

OPEN_ERRORS: tuple[type[Exception], ...] = (*PORT_ERRORS, ValueError)
"""What opening a port raises; ValueError: a name or rate the operating system does not take."""

QUIET = 0.003
"""s without a byte after which a line is taken to be empty, when nothing worse than a repeat can follow."""


class Wire:
    """A port, and the SDK's packet code for single requests.  One transaction at a time, from any thread.

    Args:
        port: Its name.
        baud: bit/s.
        counters: What happens is added here.
        answer_time: s a servo is given to answer, beyond the time of the bytes.
        make_handler: Makes the port handler; takes the four above.
        now: The clock of ages and deadlines, s.

    Attributes:
        last_good: Servo id -> when it last answered, on ``now``.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        counters: Counters,
        answer_time: float,
        make_handler: Callable[..., QuietPortHandler] = QuietPortHandler,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.port = port
        self.baud = baud
        self.counters = counters
        self.packet = Protocol2PacketHandler()
        self.answer_time = answer_time
        self.last_good: dict[int, float] = {}
        self.now = now
        self._make_handler = make_handler
        self._lock = threading.RLock()
        self._handler: QuietPortHandler | None = None
        self._dirty = False  # answers to an earlier request may still be under way …
        self._asked = ""  # … to this one

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._handler is not None

    def open(self) -> None:
        """Opens the port for this process alone.

        Raises:
            BusNotOpenError: Missing, not a serial port, not permitted, in use, or an impossible rate.
        """
        with self._lock:
            if self._handler is not None:
                return
            handler = self._make_handler(self.port, self.baud, self.counters, self.answer_time)
            if handler.getCFlagBaud(self.baud) <= 0:
                rates = ", ".join(str(rate) for rate in BAUD_RATES.values())
                raise BusNotOpenError(f"cannot open {self.port} at {self.baud} baud; possible: {rates}")
            try:
                handler.openPort()
            except OPEN_ERRORS as error:
                handler.closePort()
                raise describe_failure(self.port, error) from error
            self._handler = handler
            self._dirty, self._asked = True, ""

    def close(self) -> None:
        """Closes the port; may be called any number of times and never raises."""
        with self._lock:
            handler, self._handler = self._handler, None
            if handler is not None:
                try:
                    handler.closePort()
                except PORT_ERRORS as error:
                    log.warning("closing %s: %s", self.port, error)

    @contextmanager
    def transaction(self, asks: str | None) -> Iterator[QuietPortHandler]:
        """The open port, for one request and its answers.

        Args:
            asks: What is asked, in a word; None where nobody answers.  A packet does not say which request
                it answers.  So after an answer was missed, another question waits until that answer cannot
                come any more; the same question need not: a late answer to it is as good as any.

        Raises:
            BusNotOpenError, BusDisconnectedError: Not open; the port went away (it is closed then).
        """
        with self._lock:
            handler = self._handler
            if handler is None:
                raise BusNotOpenError(f"the bus on {self.port} is not open", hint="call open() first")
            clean = False
            try:
                handler.is_using = False
                if asks is not None:
                    if self._dirty:
                        handler.drain(QUIET if asks == self._asked else self.answer_time)
                        self._dirty = False
                    self._asked = asks
                yield handler
                clean = True
            except PORT_ERRORS as error:
                self.close()
                raise BusDisconnectedError(
                    f"the port {self.port} went away: {error}",
                    hint="check cable and adapter, then connect again; torque stays as it was until then",
                ) from error
            finally:
                handler.is_using = False
                self._dirty = self._dirty or not clean

    def missed(self) -> None:
        """An answer is outstanding: whatever is asked next must not take it for its own."""
        self._dirty = True

    def receive(self, port: QuietPortHandler) -> Answer | None:
        """The next status packet within the packet's time; None if there was none or it was damaged."""
        packet, result = self.packet.rxPacket(port, False)
        if result == COMM_SUCCESS and len(packet) >= SHORTEST_STATUS:
            end = 5 + (packet[5] | packet[6] << 8)  # of the data; the length field is that after unstuffing
            if 9 <= end <= len(packet):
                error = packet[8]
                alert = bool(error & ALERT_BIT)
                self.counters.alerts += alert
                return Answer(packet[4], error & ~ALERT_BIT, alert, bytes(packet[9:end]))
        if result in (COMM_SUCCESS, COMM_RX_CORRUPT):
            self.counters.corrupt += 1
        return None
