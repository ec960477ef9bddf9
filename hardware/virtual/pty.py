"""The virtual bus behind a pseudo terminal: a serial port that any program can open.

Windows has no pseudo terminals. There ``SimBus`` serves the bus in process.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import select
import struct
import sys
import termios
import threading
import time
import tty
from pathlib import Path

from robot_ik.errors import OutputError
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import Closing

log = logging.getLogger(__name__)

_CHUNK = 4096
"""Bytes read at once."""
_REPLUG_PERIOD = 0.02
"""s between two checks whether an unplugged port is plugged in again."""
_WORLD_PERIOD = 0.01
"""s between two updates of a world while no packet comes."""
_BITS_PER_BYTE = 10
"""8N1: a start bit, eight data bits, a stop bit."""
_TCGETS2 = 0x802C542A
"""Linux request for struct termios2, which also has rates without a B constant."""
_TERMIOS2 = struct.Struct("4I20x2I")
"""Layout of termios2: four flag words, line and control characters, two rates."""
_RATES = {
    getattr(termios, name): int(name[1:])
    for name in dir(termios)
    if name[0] == "B" and name[1:].isdigit()
}
"""Constant of termios -> bit/s."""


class PtyPort(Closing):
    """Serves a virtual bus on a pty; a context manager.

    The thread sleeps in ``select`` until bytes come, so an idle port costs no CPU. Clients may open
    and close the port at any time. The port exists until ``close``, except during the fault
    ``port_unplugged``: the port disappears, and later a new one appears under the same link.

    Args:
        bus: The servos.
        link: Symbolic link to the port, a name that stays the same from run to run.
        match_baud: Servos answer a client with their own baud rate only. By default they answer at
            any rate.
        wire_baud: Rate at which bytes take their time, bit/s. 0: bytes take no time.

    Attributes:
        path: Path of the port, e.g. ``/dev/pts/7``. It changes after the port was unplugged.
        link: The symbolic link; None if there is none.

    Raises:
        OutputError: ``link`` exists and is not a symbolic link, or cannot be made.
    """

    def __init__(
        self,
        bus: VirtualBus,
        link: Path | str | None = None,
        *,
        match_baud: bool = False,
        wire_baud: int = 0,
    ) -> None:
        self.bus = bus
        self.link = Path(link) if link is not None else None
        self._match_baud = match_baud
        self._wire_baud = wire_baud
        self._closed = threading.Event()
        self._wake_reader, self._wake_writer = os.pipe()
        self._master = -1
        self._slave = -1
        try:
            self._plug_in()
        except BaseException:
            self._close_files(self._wake_reader, self._wake_writer)
            raise
        bus.when_changed(self._wake)
        self._thread = threading.Thread(
            target=self._serve, name=f"virtual bus {self.path}", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Remove the port, as pulling the cable does. May be called any number of times."""
        if self._closed.is_set():
            return
        self._closed.set()
        os.write(self._wake_writer, b"x")
        if threading.current_thread() is not self._thread:
            self._thread.join()
        self._pull_out()
        self._close_files(self._wake_reader, self._wake_writer)

    def client_baud(self) -> int:
        """Return the rate that the client has set, bit/s; 0 if it is unknown."""
        if sys.platform == "linux":
            with contextlib.suppress(OSError):
                raw = fcntl.ioctl(self._master, _TCGETS2, bytes(_TERMIOS2.size))
                return int(_TERMIOS2.unpack(raw)[-1])
        try:
            speed: int = termios.tcgetattr(self._master)[5]
        except termios.error:
            return 0
        return int(_RATES.get(speed, speed))

    def _wake(self) -> None:
        if not self._closed.is_set():
            os.write(self._wake_writer, b"x")

    def _plug_in(self) -> None:
        self._master, self._slave = os.openpty()
        try:
            # Raw mode before a client opens the port: a line discipline echoes and drops bytes.
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self.path = os.ttyname(self._slave)
            if self.link is not None:
                _make_link(self.link, self.path)
        except BaseException:
            self._close_files(self._master, self._slave)
            raise

    def _pull_out(self) -> None:
        """Remove link and pty. A client that has it open gets an error."""
        if self._master < 0:
            return
        if self.link is not None:
            _remove_link(self.link, self.path)
        self._close_files(self._master, self._slave)
        self._master = -1
        self._slave = -1

    @staticmethod
    def _close_files(*handles: int) -> None:
        for handle in handles:
            with contextlib.suppress(OSError):
                os.close(handle)

    def _wait(self) -> bool:
        """Sleep until bytes arrive, a scheduled fault is due, or the port is closed.

        Returns:
            Whether there are bytes to read.
        """
        self.bus.advance()
        if self.bus.unplugged and self._master >= 0:
            self._pull_out()
        elif not self.bus.unplugged and self._master < 0:
            self._plug_in()
        waits = []
        if (due := self.bus.schedule.next_time) is not None:
            waits.append(max(0.0, due - self.bus.clock.now()))
        if self.bus.unplugged:  # the program that owns the bus may plug it in at any time
            waits.append(_REPLUG_PERIOD)
        if self.bus.world is not None:  # otherwise it must catch up while a client waits
            waits.append(_WORLD_PERIOD)
        handles = [self._wake_reader] if self._master < 0 else [self._master, self._wake_reader]
        ready, _, _ = select.select(handles, [], [], min(waits, default=None))
        if self._wake_reader in ready:
            os.read(self._wake_reader, _CHUNK)
        return self._master in ready

    def _serve(self) -> None:
        """Pass bytes to the bus and replies back until the port is closed (the thread)."""
        while not self._closed.is_set():
            try:
                if not self._wait():
                    continue
            except OutputError as error:
                log.warning("virtual bus: the port cannot be plugged in again: %s", error)
                return
            arrived = time.monotonic()
            try:
                data = os.read(self._master, _CHUNK)
            except OSError as error:
                if error.errno in (errno.EAGAIN, errno.EINTR):
                    continue
                log.warning("virtual bus on %s: the port went away: %s", self.path, error)
                return
            try:
                reply, delay = self.bus.respond(
                    data, self.client_baud() if self._match_baud else None
                )
            except Exception:
                # An error in a virtual servo must not look like a broken cable.
                log.exception("virtual bus on %s failed on %s", self.path, data.hex(" "))
                continue
            self._pace(arrived, len(data), len(reply), delay)
            if not self.bus.unplugged:
                self._send(reply)

    def _pace(self, arrived: float, received: int, sent: int, delay: float) -> None:
        """Wait until the last byte of the reply would have arrived over a wire."""
        seconds = delay if sent else 0.0
        if self._wire_baud:
            seconds += (received + sent) * _BITS_PER_BYTE / self._wire_baud
        if seconds > 0.0:
            # Not a sleep: closing must not wait for it.
            self._closed.wait(max(0.0, arrived + seconds - time.monotonic()))

    def _send(self, reply: bytes) -> None:
        """Send a reply.

        Bytes that no client reads are lost, as on a wire. A full buffer does not stop the bus.
        """
        try:
            while reply and not self._closed.is_set():
                reply = reply[os.write(self._master, reply) :]
        except BlockingIOError:
            log.debug("virtual bus on %s: no client reads, %d bytes lost", self.path, len(reply))
        except OSError as error:
            log.debug("virtual bus on %s: %s", self.path, error)


def _make_link(link: Path, path: str) -> None:
    """Make or replace a symbolic link in one step.

    A client finds either the old port or the new one.
    """
    if os.path.lexists(link) and not link.is_symlink():
        raise OutputError(
            f"{link} exists and is not a symbolic link; nothing was changed",
            hint="choose another --link",
        )
    fresh = link.with_name(f".{link.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        os.symlink(path, fresh)
        os.replace(fresh, link)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        raise OutputError(
            f"cannot make the link {link}: {error.strerror or error}",
            hint="check that its folder exists and is writable",
        ) from error


def _remove_link(link: Path, path: str) -> None:
    """Remove a link unless another port has taken it over."""
    with contextlib.suppress(OSError):
        if os.readlink(link) == path:
            link.unlink()
