"""The SDK's port handler, made quiet: it sleeps while it waits, keeps monotonic time and owns its port alone.

The SDK opens its port without a timeout and polls it: a whole core is burned while a packet is on the wire
(16 ms of CPU a cycle at 57 600 baud, measured; 0.3 ms with this handler).  Packet code is left as it is.
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
"""s after which a line that does not fall silent is no longer waited for."""

RESPONSE_TIME = 0.034
"""s a servo is given beyond the bytes' own time: twice a 16 ms USB latency timer and 2 ms, as in the SDK."""

MAX_LATE_BYTES = 1024
"""Bytes read at most after a packet's time is over: what came in while this program was held up, no more."""

WRITE_TIMEOUT = 0.5
"""s beyond the bytes' own time; a port that has not taken them by then is gone."""

WATCH = 1.5e-4
"""s before and after the moment a reply is expected in which the port is watched without sleeping.

A sleep ends up to 50 µs late by the timer's slack (prctl(2), PR_SET_TIMERSLACK), and waking takes time.
"""

_POLL = 0.002  # s, only where the operating system cannot wait on a serial port with select()

try:  # what a vanished port raises besides OSError; termios does not exist on Windows
    import termios

    PORT_ERRORS: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:
    PORT_ERRORS = (OSError,)


class SleepingPortHandler(PortHandler):
    """One serial port for one process; counts its bytes.

    ``openPort`` raises what pyserial raises; ``describe_failure`` turns that into text.

    Args:
        port_name: As the system names it.
        baud: bit/s.
        counters: Its bytes are added here.
        posix: A port is a file on which one can wait and which must be locked; else (Windows) a handle that
            the system itself gives to one program only.
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
        port, self.ser, self.is_open = self.ser, None, False
        if port is not None:
            port.close()

    def getCFlagBaud(self, baudrate: int) -> int:
        """Every rate a servo can be set to; the SDK's own list stops before 4.5 M."""
        return baudrate if baudrate in BAUD_RATES else -1

    def getCurrentTime(self) -> float:
        """Milliseconds on a clock that never jumps."""
        return time.monotonic() * 1000.0

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(1000.0 * (packet_length * self.seconds_per_byte + RESPONSE_TIME))

    def setPacketTimeoutMillis(self, msec: float) -> None:
        super().setPacketTimeoutMillis(msec)
        self._late_bytes = MAX_LATE_BYTES

    def receive(self, deadline: float, expected: float | None = None) -> bytes:
        """What has come in, at least a byte; sleeps until then, or ``deadline``: nothing.

        Args:
            deadline: On the monotonic clock, s.  After it there is one look at what is there: who calls again
                and again looks at the clock himself, for a line may never fall silent.
            expected: When the reply usually comes, where that is known: shortly before and after it the
                port is watched without sleeping, for who sleeps notices a reply late.
        """
        if self._posix:
            return self._take(4096) if self._comes(deadline, expected) else b""
        while not (data := self._take(self.ser.in_waiting or 1)):
            if time.monotonic() > deadline:
                break
        return data

    def _take(self, length: int) -> bytes:
        """At most ``length`` bytes of what has come in."""
        if not self._posix:
            data = bytes(self.ser.read(length))
        elif not (data := os.read(self._file, length)):
            raise serial.SerialException("the port is ready to read and has nothing: it went away")
        self._counters.bytes_received += len(data)
        return data

    def _comes(self, deadline: float, expected: float | None) -> bool:
        """Whether there is something to read before the deadline."""
        files, now = [self._file], time.monotonic()
        if expected is not None:
            begin, end = min(expected, deadline) - WATCH, min(expected + WATCH, deadline)
            if now < begin and select.select(files, [], [], begin - now)[0]:
                return True
            while (now := time.monotonic()) < end:
                if select.select(files, [], [], 0.0)[0]:
                    return True
        return bool(select.select(files, [], [], max(deadline - now, 0.0))[0])

    def clear(self) -> None:
        """Throws away what has come in."""
        self.ser.reset_input_buffer()

    def readPort(self, length: int) -> bytes:
        """At most ``length`` bytes; sleeps until there are some or the packet's time is over.

        The SDK looks at the clock only where too few bytes came.  So after that time there are at most
        ``MAX_LATE_BYTES`` bytes, then none, whatever comes in.
        """
        if self.getTimeSinceStart() > self.packet_timeout:
            length = min(length, self._late_bytes)
            self._late_bytes -= max(length, 0)
        if length <= 0:
            return b""
        wait = (self.packet_timeout - self.getTimeSinceStart()) / 1000.0
        if self._posix and not select.select([self._file], [], [], max(wait, 0.0))[0]:
            return b""
        return self._take(length)

    def writePort(self, packet: Sequence[int] | bytes) -> int:
        """Number of bytes written: all of them, or an error."""
        if not self._posix:
            self.ser.write(bytes(packet))
        else:
            # Not pyserial's write: it reports a timeout for bytes that are out if this process was stalled.
            left = bytes(packet)
            end = time.monotonic() + WRITE_TIMEOUT + len(left) * self.seconds_per_byte
            while left := left[self._write(left) :]:
                wait = end - time.monotonic()
                if wait <= 0.0 or not select.select([], [self._file], [], wait)[1]:
                    raise serial.SerialTimeoutException(f"the port takes no bytes for {WRITE_TIMEOUT} s")
        self._counters.bytes_sent += len(packet)
        return len(packet)

    def _write(self, data: bytes) -> int:
        """How many bytes the system takes at once; it rarely takes less than all."""
        try:
            return os.write(self._file, data)
        except BlockingIOError:
            return 0

    def drain(self, quiet: float) -> None:
        """Throws away what comes in until the line was silent for ``quiet`` s; at most ``LONGEST_DRAIN``."""
        end = time.monotonic() + LONGEST_DRAIN
        while (now := time.monotonic()) < end and self.receive(now + quiet):
            pass


def describe_failure(port: str, error: Exception) -> BusNotOpenError:
    """Why opening ``port`` raised ``error``, which ports there are and what to do."""
    text, number = str(error), getattr(error, "errno", None)
    if sys.platform == "win32":  # pyserial gives the reason as text only; a port in use is "access denied"
        codes = {
            "PermissionError": errno.EBUSY,
            "Access is denied": errno.EBUSY,
            "FileNotFound": errno.ENOENT,
        }
        number = next((value for phrase, value in codes.items() if phrase in text), number)
    if "exclusively lock" in text or number in (errno.EBUSY, errno.EWOULDBLOCK):
        who = [
            f"{'this program' if number == os.getpid() else name} (process {number})"
            for number, name in users_of(port).items()
        ]
        reason = f"it is already open{' in ' + ', '.join(who) if who else ', here or in another program'}"
        hint = "close the other program first"
    elif number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        reason, hint = "there is no such port", did_you_mean(port, NO_PORTS)
    elif number in (errno.EACCES, errno.EPERM):
        reason = "this user may not open it"
        hint = "join the group that owns it (often: sudo usermod -aG dialout $USER) and log in again"
        if sys.platform == "darwin":
            hint = "allow the adapter's driver in System Settings, Privacy & Security; use its name /dev/cu.…"
    elif number == errno.EISDIR or "Inappropriate ioctl" in text or "(25" in text:
        reason, hint = "it is not a serial port", ""
    else:
        reason, hint = text, ""
    names = [f"{p.device} ({p.description})" for p in list_ports.comports()]
    exist = f"serial ports here: {', '.join(names)}" if names else "there is no serial port on this machine"
    lines = [hint, exist, f"without servos: --bus {' or '.join(NO_PORTS)}"]
    return BusNotOpenError(f"cannot open {port}: {reason}", hint="\n".join(line for line in lines if line))


OPEN_ERRORS: tuple[type[Exception], ...] = (*PORT_ERRORS, ValueError)
"""What opening a port raises; ValueError: a name or rate the operating system does not take."""

QUIET = 0.003
"""s without a byte after which a line is taken to be empty, when nothing worse than a repeat can follow."""

MIN_TIMEOUT = 0.005
"""s; a servo has at least so long to answer, however quick it used to be: computers pause."""

TIMEOUT_FACTOR = 3.0
"""A servo has so many times the longest recent response time."""

MAX_JITTER = 1e-4
"""s; replies whose times scatter by less are worth watching for: who sleeps wakes up about so late."""

_DECAY = 0.98  # share of the longest response time kept from one reply to the next
_GAIN, _SPREAD_GAIN = 1 / 8, 1 / 4


class RoundTripEstimator:
    """Times from request to reply, s, without those of the bytes.

    The usual time and its spread are the running mean and mean deviation of Jacobson, "Congestion avoidance
    and control" (1988), appendix A.
    """

    def __init__(self) -> None:
        self._longest: float | None = None
        self._usual = 0.0
        self._spread = 1.0  # at first nothing is known

    def add(self, took: float) -> None:
        """One more reply; ``took`` may be a little below 0, for adapters hand bytes over in pieces."""
        if self._longest is None:
            self._longest, self._usual = took, took
        self._longest = max(took, _DECAY * self._longest)
        miss = took - self._usual
        self._usual += _GAIN * miss
        self._spread += _SPREAD_GAIN * (min(abs(miss), 1.0) - self._spread)

    def timeout(self, at_most: float) -> float:
        """s to wait for a reply."""
        if self._longest is None:
            return at_most
        return min(max(TIMEOUT_FACTOR * self._longest, MIN_TIMEOUT), at_most)

    @property
    def expected(self) -> float | None:
        """s after which a reply usually comes; None where that is not known to within ``MAX_JITTER``."""
        return self._usual if self._spread < MAX_JITTER else None
