"""The virtual bus behind a serial port that any program on this machine can open: a pseudo terminal.

Where there is none (Windows) the bus is still there in process (``SimBus``).
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
_REPLUG_PERIOD = 0.02  # s; how often an unplugged port looks whether it is plugged in again
_WORLD_PERIOD = 0.01  # s; how often a world of its own goes on where no packet comes
_BITS_PER_BYTE = 10  # 8N1: a start bit, eight of data, a stop bit
_TCGETS2 = 0x802C542A  # Linux: struct termios2, which also knows rates without a B constant
_TERMIOS2 = struct.Struct("4I20x2I")  # four flag words, line and control characters, two rates
_RATES = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}


class PtyPort(Closing):
    """Serves a virtual bus on a pty; a context manager.

    The thread sleeps in ``select`` until bytes come, so an idle port costs nothing.  A client may close
    and another open the port at any time; while this object lives the port stays, but for the fault
    ``port_unplugged``: then it is gone, and a new one appears under the same link afterwards.

    Args:
        bus: The servos.
        link: Also make this symbolic link to the port: a name that stays the same from run to run.
        match_baud: Servos hear only a client whose rate is theirs; without, any rate does.
        wire_baud: Take as long as the bytes of request and reply take at this rate; 0: no time at all.

    Attributes:
        path: Of the port, e.g. ``/dev/pts/7``; another one after it was unplugged.
        link: As given, or ``None``.

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
        self._master = self._slave = -1
        try:
            self._plug_in()
        except BaseException:
            self._close_files(self._wake_reader, self._wake_writer)
            raise
        bus.when_changed(self._wake)
        self._thread = threading.Thread(target=self._serve, name=f"virtual bus {self.path}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Takes the port away, as pulling the cable does; may be called any number of times."""
        if self._closed.is_set():
            return
        self._closed.set()
        os.write(self._wake_writer, b"x")
        if threading.current_thread() is not self._thread:
            self._thread.join()
        self._pull_out()
        self._close_files(self._wake_reader, self._wake_writer)

    def client_baud(self) -> int:
        """Bits/s the client has set the port to; 0 if it is not known."""
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
            # Raw before anyone opens it: else the line discipline echoes and swallows bytes.
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self.path = os.ttyname(self._slave)
            if self.link is not None:
                _make_link(self.link, self.path)
        except BaseException:
            self._close_files(self._master, self._slave)
            raise

    def _pull_out(self) -> None:
        """Takes link and pty away; a client that has it open gets an error."""
        if self._master < 0:
            return
        if self.link is not None:
            _remove_link(self.link, self.path)
        self._close_files(self._master, self._slave)
        self._master = self._slave = -1

    @staticmethod
    def _close_files(*handles: int) -> None:
        for handle in handles:
            with contextlib.suppress(OSError):
                os.close(handle)

    def _wait(self) -> bool:
        """Sleeps until there are bytes, something booked is due, or it is over; whether there are bytes."""
        self.bus.advance()
        if self.bus.unplugged and self._master >= 0:
            self._pull_out()
        elif not self.bus.unplugged and self._master < 0:
            self._plug_in()
        waits = []
        if (due := self.bus.schedule.next_time) is not None:
            waits.append(max(0.0, due - self.bus.clock.now()))
        if self.bus.unplugged:  # the program that runs the bus may plug it in at any time
            waits.append(_REPLUG_PERIOD)
        if self.bus.world is not None:  # else it would have to catch up while a client waits
            waits.append(_WORLD_PERIOD)
        handles = [self._wake_reader] if self._master < 0 else [self._master, self._wake_reader]
        ready, _, _ = select.select(handles, [], [], min(waits, default=None))
        if self._wake_reader in ready:
            os.read(self._wake_reader, _CHUNK)
        return self._master in ready

    def _serve(self) -> None:
        """The thread: bytes to the bus, replies back, until closed."""
        while not self._closed.is_set():
            try:
                if not self._wait():
                    continue
            except OutputError as error:
                log.warning("virtual bus: it cannot be plugged in again: %s", error)
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
                reply, delay = self.bus.respond(data, self.client_baud() if self._match_baud else None)
            except Exception:
                # A mistake in a servo must not look like a dead cable.
                log.exception("virtual bus on %s failed on %s", self.path, data.hex(" "))
                continue
            self._pace(arrived, len(data), len(reply), delay)
            if not self.bus.unplugged:
                self._send(reply)

    def _pace(self, arrived: float, received: int, sent: int, delay: float) -> None:
        """Waits until the last byte of the reply would have come over the wire."""
        seconds = delay if sent else 0.0
        if self._wire_baud:
            seconds += (received + sent) * _BITS_PER_BYTE / self._wire_baud
        if seconds > 0.0:
            # Not a sleep: closing must not wait for it.
            self._closed.wait(max(0.0, arrived + seconds - time.monotonic()))

    def _send(self, reply: bytes) -> None:
        """Bytes that are not read are lost, as on a wire; a full buffer must not stop the bus."""
        try:
            while reply and not self._closed.is_set():
                reply = reply[os.write(self._master, reply) :]
        except BlockingIOError:
            log.debug("virtual bus on %s: nobody reads, %d bytes lost", self.path, len(reply))
        except OSError as error:
            log.debug("virtual bus on %s: %s", self.path, error)


def _make_link(link: Path, path: str) -> None:
    """Makes or replaces a symbolic link in one step, so that a client finds the old one or the new one."""
    if os.path.lexists(link) and not link.is_symlink():
        raise OutputError(
            f"{link} exists and is not a symbolic link; it stays as it is", hint="choose another --link"
        )
    fresh = link.with_name(f".{link.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        os.symlink(path, fresh)
        os.replace(fresh, link)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        raise OutputError(
            f"the link {link} cannot be made: {error.strerror or error}", hint="is its folder writable?"
        ) from error


def _remove_link(link: Path, path: str) -> None:
    """Removes a link unless another port has taken it over."""
    with contextlib.suppress(OSError):
        if os.readlink(link) == path:
            link.unlink()
