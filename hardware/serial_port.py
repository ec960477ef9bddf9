"""The serial port: the SDK's port handler, changed so that it sleeps while it waits.

The SDK opens its port without a timeout and polls it, which keeps a core busy while a packet is on
the wire (measured at 57 600 baud: 16 ms of CPU a cycle, 0.3 ms with this handler). This handler
also uses monotonic time and locks the port. The SDK's packet code is unchanged.
"""

from __future__ import annotations

import errno
import os
import select
import sys
import time
from collections.abc import Sequence

import serial
from dynamixel_sdk import PortHandler
from serial.tools import list_ports

from robot_ik.errors import BusNotOpenError, did_you_mean
from robot_ik.hardware.bus import Counters
from robot_ik.hardware.checks import users_of
from robot_ik.hardware.models import BAUD_RATES
from robot_ik.hardware.ports import NO_PORTS

LONGEST_DRAIN = 0.1
"""s. Longest wait for a silent line."""

RESPONSE_TIME = 0.034
"""s that a servo is given beyond the time of the bytes.

Twice a USB latency timer of 16 ms, plus 2 ms, as in the SDK.
"""

MAX_LATE_BYTES = 1024
"""Largest number of bytes read after the time of a packet is over.

They arrived while this program was held up.
"""

WRITE_TIMEOUT = 0.5
"""s beyond the time of the bytes. A port that has not taken them by then is gone."""

WATCH = 1.5e-4
"""s before and after the expected moment of a reply in which the port is polled without sleeping.

A sleep ends up to 50 µs late by the timer's slack (prctl(2), PR_SET_TIMERSLACK), and waking takes
time.
"""

_POLL = 0.002
"""s. Used only where the operating system cannot wait on a serial port with select()."""

try:  # termios does not exist on Windows
    import termios

    PORT_ERRORS: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:
    PORT_ERRORS = (OSError,)


class SleepingPortHandler(PortHandler):
    """One serial port for one process. Counts its bytes.

    ``openPort`` raises the errors of pyserial. ``describe_failure`` turns them into text.

    Args:
        port_name: Name of the port.
        baud: bit/s.
        counters: The bytes are added here.
        posix: The port is a file that supports select() and must be locked. Otherwise (Windows) it
            is a handle that the system gives to one program only.
    """

    def __init__(
        self, port_name: str, baud: int, counters: Counters, *, posix: bool = os.name == "posix"
    ) -> None:
        super().__init__(port_name)
        self._posix = posix
        self.baudrate = baud
        self.seconds_per_byte = 10.0 / baud  # 8N1 is 10 bits a byte
        self._counters = counters
        self._file = -1
        self._late_bytes = MAX_LATE_BYTES

    def setupPort(self, cflag_baud: int) -> bool:
        self.closePort()
        self.ser = serial.Serial(
            port=self.port_name,
            baudrate=cflag_baud,
            bytesize=serial.EIGHTBITS,
            timeout=0 if self._posix else _POLL,
            write_timeout=WRITE_TIMEOUT,
            exclusive=True if self._posix else None,
        )
        self.is_open = True
        self.ser.reset_input_buffer()
        self._file = self.ser.fileno() if self._posix else -1
        return True

    def fileno(self) -> int | None:
        """Return the file descriptor of the open port; None if there is none."""
        return self._file if self._file >= 0 and self.is_open else None

    def closePort(self) -> None:
        port = self.ser
        self.ser = None
        self.is_open = False
        if port is not None:
            port.close()

    def getCFlagBaud(self, baudrate: int) -> int:
        """Return the rate if a servo can be set to it, else -1.

        The SDK's own list ends before 4.5 M.
        """
        return baudrate if baudrate in BAUD_RATES else -1

    def getCurrentTime(self) -> float:
        """Return milliseconds of the monotonic clock."""
        return time.monotonic() * 1000.0

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(
            1000.0 * (packet_length * self.seconds_per_byte + RESPONSE_TIME)
        )

    def setPacketTimeoutMillis(self, msec: float) -> None:
        super().setPacketTimeoutMillis(msec)
        self._late_bytes = MAX_LATE_BYTES

    def receive(self, deadline: float, expected: float | None = None) -> bytes:
        """Return received bytes; sleep until there are some or ``deadline`` has passed.

        Args:
            deadline: On the monotonic clock, s. After it the port is read once without waiting.
                Callers that poll must check the deadline themselves, because a line may never fall
                silent.
            expected: Usual time of the reply, s; None: unknown. Around it the port is polled
                without sleeping, because a sleeping thread notices a reply late.
        """
        if self._posix:
            return self._read(4096) if self._has_data(deadline, expected) else b""
        while not (data := self._read(self.ser.in_waiting or 1)):
            if time.monotonic() > deadline:
                break
        return data

    def _read(self, length: int) -> bytes:
        """Return at most ``length`` received bytes."""
        if not self._posix:
            data = bytes(self.ser.read(length))
        elif not (data := os.read(self._file, length)):
            raise serial.SerialException("the port is ready to read but has no data: it went away")
        self._counters.bytes_received += len(data)
        return data

    def _has_data(self, deadline: float, expected: float | None) -> bool:
        """Return whether bytes can be read before the deadline."""
        files = [self._file]
        now = time.monotonic()
        if expected is not None:
            begin = min(expected, deadline) - WATCH
            end = min(expected + WATCH, deadline)
            if now < begin and select.select(files, [], [], begin - now)[0]:
                return True
            while (now := time.monotonic()) < end:
                if select.select(files, [], [], 0.0)[0]:
                    return True
        return bool(select.select(files, [], [], max(deadline - now, 0.0))[0])

    def clear(self) -> None:
        """Discard received bytes."""
        self.ser.reset_input_buffer()

    def readPort(self, length: int) -> bytes:
        """Return received bytes; sleep until there are some or the packet's time is over.

        At most ``length`` bytes are returned. The SDK checks the clock only if too few bytes came.
        So after that time this method returns at most ``MAX_LATE_BYTES`` bytes, then none.
        """
        if self.getTimeSinceStart() > self.packet_timeout:
            length = min(length, self._late_bytes)
            self._late_bytes -= max(length, 0)
        if length <= 0:
            return b""
        wait = (self.packet_timeout - self.getTimeSinceStart()) / 1000.0
        if self._posix and not select.select([self._file], [], [], max(wait, 0.0))[0]:
            return b""
        return self._read(length)

    def writePort(self, packet: Sequence[int] | bytes) -> int:
        """Write all bytes and return their number, or raise an error."""
        if not self._posix:
            self.ser.write(bytes(packet))
        else:
            # pyserial reports a timeout for bytes that it has written if this process was stalled.
            remaining = bytes(packet)
            end = time.monotonic() + WRITE_TIMEOUT + len(remaining) * self.seconds_per_byte
            while remaining := remaining[self._write(remaining) :]:
                wait = end - time.monotonic()
                if wait <= 0.0 or not select.select([], [self._file], [], wait)[1]:
                    raise serial.SerialTimeoutException(
                        f"the port takes no bytes for {WRITE_TIMEOUT} s"
                    )
        self._counters.bytes_sent += len(packet)
        return len(packet)

    def _write(self, data: bytes) -> int:
        """Return the number of bytes that the system took; usually all."""
        try:
            return os.write(self._file, data)
        except BlockingIOError:
            return 0

    def drain(self, quiet: float) -> None:
        """Discard received bytes until the line was silent for ``quiet`` s.

        Gives up after ``LONGEST_DRAIN``.
        """
        end = time.monotonic() + LONGEST_DRAIN
        while (now := time.monotonic()) < end and self.receive(now + quiet):
            pass


def describe_failure(port: str, error: Exception) -> BusNotOpenError:
    """Return an error with the reason why ``port`` cannot be opened and the ports of the system."""
    text = str(error)
    number = getattr(error, "errno", None)
    if sys.platform == "win32":
        # pyserial gives the reason as text only. A port in use is "access denied".
        codes = {
            "PermissionError": errno.EBUSY,
            "Access is denied": errno.EBUSY,
            "FileNotFound": errno.ENOENT,
        }
        number = next((value for phrase, value in codes.items() if phrase in text), number)
    if "exclusively lock" in text or number in (errno.EBUSY, errno.EWOULDBLOCK):
        users = [
            f"{'this program' if number == os.getpid() else name} (process {number})"
            for number, name in users_of(port).items()
        ]
        place = " in " + ", ".join(users) if users else ", here or in another program"
        reason = f"it is already open{place}"
        hint = "close the other program first"
    elif number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        reason = "there is no such port"
        hint = did_you_mean(port, NO_PORTS)
    elif number in (errno.EACCES, errno.EPERM):
        reason = "this user may not open it"
        hint = (
            "join the group that owns it (often: sudo usermod -aG dialout $USER) and log in again"
        )
        if sys.platform == "darwin":
            hint = (
                "allow the adapter's driver in System Settings, Privacy & Security; "
                "use its name /dev/cu.…"
            )
    elif number == errno.EISDIR or "Inappropriate ioctl" in text or "(25" in text:
        reason = "it is not a serial port"
        hint = ""
    else:
        reason = text
        hint = ""
    names = [f"{p.device} ({p.description})" for p in list_ports.comports()]
    ports = (
        f"serial ports here: {', '.join(names)}"
        if names
        else "there is no serial port on this machine"
    )
    lines = [hint, ports, f"without servos: --bus {' or '.join(NO_PORTS)}"]
    return BusNotOpenError(
        f"cannot open {port}: {reason}", hint="\n".join(line for line in lines if line)
    )


OPEN_ERRORS: tuple[type[Exception], ...] = (*PORT_ERRORS, ValueError)
"""Errors of opening a port.

ValueError: a name or rate that the operating system does not take.
"""

QUIET = 0.003
"""s without a byte after which a line counts as silent.

Used where a repeated request is the worst that can follow.
"""

MIN_TIMEOUT = 0.005
"""s. Shortest time that a servo is given, however quick it was: computers pause."""

TIMEOUT_FACTOR = 3.0
"""A servo is given this multiple of its longest recent response time."""

MAX_JITTER = 1e-4
"""s. Replies whose times scatter by less are polled for.

A sleeping thread wakes up about this late.
"""

_DECAY = 0.98
"""Share of the longest response time that is kept from one reply to the next."""
_GAIN = 1 / 8
"""Weight of a new response time in the running mean."""
_SPREAD_GAIN = 1 / 4
"""Weight of a new deviation in the running mean deviation."""


class RoundTripEstimator:
    """Times from request to reply, s, without those of the bytes.

    The usual time and its spread are the running mean and mean deviation of Jacobson, "Congestion
    avoidance and control" (1988), appendix A.
    """

    def __init__(self) -> None:
        self._longest: float | None = None
        self._usual = 0.0
        self._spread = 1.0  # unknown at first

    def add(self, took: float) -> None:
        """Add a response time in s.

        It may be a little below 0, because adapters deliver bytes in pieces.
        """
        if self._longest is None:
            self._longest = took
            self._usual = took
        self._longest = max(took, _DECAY * self._longest)
        deviation = took - self._usual
        self._usual += _GAIN * deviation
        self._spread += _SPREAD_GAIN * (min(abs(deviation), 1.0) - self._spread)

    def timeout(self, at_most: float) -> float:
        """Return the time to wait for a reply, s."""
        if self._longest is None:
            return at_most
        return min(max(TIMEOUT_FACTOR * self._longest, MIN_TIMEOUT), at_most)

    @property
    def expected(self) -> float | None:
        """Usual response time, s.

        None while it is not known to within ``MAX_JITTER``.
        """
        return self._usual if self._spread < MAX_JITTER else None
