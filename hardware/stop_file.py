"""Request files with which one process stops the arm of another: ``robot-ik stop``.

The requesting process does not need the port. All arms of a user have their files in one folder:

* ``ID.lock``: locked as long as the program has the arm. The system unlocks it when the program
  ends.
* ``ID.arm``: description of the arm. It is written at once, after ``ID.lock`` is locked.
* ``ID.stop``: a request. It stays until the arm has carried it out or its program has ended.
* ``ID.done``: the reply.

The arm checks for a request in its control cycle and with every beat of its heartbeat. An ID is
used once.
"""

from __future__ import annotations

import json
import logging
import os
import stat
import tempfile
import time
import uuid
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from robot_ik.config import read_json
from robot_ik.errors import HardwareError, OutputError, RobotIkError
from robot_ik.files import write_atomically

log = logging.getLogger(__name__)

_POLL_PERIOD = 0.01
"""s between two polls for a reply."""

_LITTER_AGE = 3600.0
"""s after which files of a program that has ended are removed.

Another program may be about to read younger ones.
"""


def _folder_of_user() -> Path:
    """Return the folder for all programs of a user. It depends on no environment variable.

    ``robot-ik stop`` in a terminal must find an arm of cron, a service or ``su``. Windows has no
    such folder, but all programs of a user share a temporary folder.
    """
    if os.name == "posix":
        return Path(f"/tmp/robot-ik-run-{os.getuid()}")
    return Path(tempfile.gettempdir()) / "robot-ik-run"


FOLDER = _folder_of_user()
"""Folder of this user."""


def runtime_folder() -> Path:
    """Return ``FOLDER``, which only this user can read. It is made if it does not exist.

    Raises:
        HardwareError: The name belongs to something else or to another user.
    """
    try:
        FOLDER.mkdir(mode=0o700, exist_ok=True)
        status = FOLDER.lstat()
    except OSError as error:
        raise HardwareError(f"no runtime folder {FOLDER}: {error.strerror}") from error
    foreign = hasattr(os, "getuid") and status.st_uid != os.getuid()
    if foreign or not stat.S_ISDIR(status.st_mode):
        raise HardwareError(
            f"{FOLDER} is not a folder of this user",
            hint="remove it, or ask its owner to remove it",
        )
    if stat.S_IMODE(status.st_mode) != 0o700:
        FOLDER.chmod(0o700)
    return FOLDER


class StopFile:
    """The arm's side of the request files.

    Args:
        name: Name of the arm.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._stem: Path | None = None
        self._request = ""
        self._files: list[int] = []

    def open(self, port: str) -> None:
        """Make the arm on ``port`` visible to ``robot-ik stop``.

        If the folder cannot be made, a warning is logged and the arm stays invisible. A visible arm
        stays visible, with the requests that wait for it.
        """
        if self._stem is not None:
            return
        about = {"pid": os.getpid(), "port": os.path.abspath(port), "name": self._name}
        try:
            folder = runtime_folder()
            remove_litter(folder)
            self._keep_from_cleaners(folder)
            stem = folder / uuid.uuid4().hex
            file = os.open(stem.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            self._stem = stem
            self._files.append(file)
            if not _lock(file):
                raise HardwareError(f"no file can be locked in {folder}")
            write_atomically(stem.with_suffix(".arm"), json.dumps(about))
        except (OSError, RobotIkError) as error:
            log.warning("robot-ik stop cannot reach this arm: %s", error)
            self.close()
            return
        self._request = str(stem.with_suffix(".stop"))

    def _keep_from_cleaners(self, folder: Path) -> None:
        """Lock the folder.

        systemd-tmpfiles removes old folders, but not locked ones.
        """
        if os.name == "posix":
            file = os.open(folder, os.O_RDONLY)
            self._files.append(file)
            _lock(file, shared=True)

    def requested(self) -> str | None:
        """Return ``hold`` or ``torque_off`` if there is a request, else None."""
        if not self._request or not os.path.exists(self._request):
            return None
        with suppress(OSError, ValueError, LookupError, TypeError):
            if read_json(Path(self._request), "the request")["policy"] == "torque_off":
                return "torque_off"
        return "hold"  # a damaged request is a request, too

    def acknowledge(self, *, ok: bool, text: str) -> None:
        """Write the reply to a request.

        Does nothing if there is no request: a stop may come from inside the program.
        """
        if self._stem is None or not os.path.exists(self._request):
            return
        try:
            write_atomically(self._stem.with_suffix(".done"), json.dumps({"ok": ok, "text": text}))
        except OutputError as error:
            log.warning("answering robot-ik stop: %s", error)
        with suppress(OSError):
            os.unlink(self._request)

    def close(self) -> None:
        """Remove the arm's files. May be called any number of times."""
        files = self._files
        self._files = []
        stem = self._stem
        self._stem = None
        self._request = ""
        if stem is not None:
            _remove(stem, ".arm", ".stop")  # another program may wait for the reply
        for file in files:
            os.close(file)
        if stem is not None:
            _remove(stem, ".lock")  # Windows removes no open file


@dataclass(frozen=True)
class RunningArm:
    """An arm that a running program of this user drives.

    Attributes:
        name: Name of the arm.
        port: Its port.
        pid: Process that drives it.
        stem: Path of its files without their endings.
    """

    name: str
    port: str
    pid: int
    stem: Path

    def stop(self, policy: str = "hold", timeout: float = 3.0) -> tuple[bool, str]:
        """Request a stop and wait for the reply.

        Without a reply the request stays. A suspended program carries it out when it continues.

        Args:
            policy: ``hold`` or ``torque_off``.
            timeout: s to wait for the reply.

        Returns:
            Whether every servo confirmed the stop, and a description of the result.
        """
        reply = self.stem.with_suffix(".done")
        request = self.stem.with_suffix(".stop")
        reply.unlink(missing_ok=True)
        write_atomically(request, json.dumps({"policy": policy}))
        end = time.monotonic() + timeout
        while True:
            is_running = _has_program(self.stem)  # checked before the reply
            if reply.exists():
                outcome = json.loads(reply.read_text("utf-8"))
                reply.unlink(missing_ok=True)
                return bool(outcome["ok"]), str(outcome["text"])
            if not is_running:
                request.unlink(missing_ok=True)
                return (
                    False,
                    "the program has closed the arm or ended; cut the power if the arm still moves",
                )
            if time.monotonic() >= end:
                return False, (
                    f"no answer for {timeout:g} s; cut the power if the arm still moves. "
                    "The request stays: the arm stops when its program continues"
                )
            time.sleep(_POLL_PERIOD)


def running_arms(port: str | None = None) -> list[RunningArm]:
    """Return the arms that are enabled now.

    Args:
        port: Only arms on this port; None: all.

    Raises:
        HardwareError: The runtime folder does not belong to this user.
    """
    folder = runtime_folder()
    remove_litter(folder)
    stems = sorted(path.with_suffix("") for path in folder.glob("*.arm"))
    arms = [arm for stem in stems if (arm := _read_running(stem)) is not None]
    return [
        arm for arm in arms if port is None or os.path.realpath(arm.port) == os.path.realpath(port)
    ]


def remove_litter(folder: Path) -> None:
    """Remove the files of programs that ended without closing their arms.

    An ``ID.arm`` appears only after its lock, so the files of a running arm are never removed.
    Other files in the folder stay.
    """
    for path in folder.glob("*.arm"):
        if _has_program(path.with_suffix("")) is False:
            _remove(path.with_suffix(""), ".arm", ".stop", ".done", ".lock")
    for pattern in (".*", "*.lock", "*.stop", "*.done"):
        for path in folder.glob(pattern):
            with suppress(OSError):
                old = time.time() - path.stat().st_mtime > _LITTER_AGE
                if old and not path.with_suffix(".arm").exists():
                    path.unlink()


def _remove(stem: Path, *endings: str) -> None:
    """Remove the existing files of an arm."""
    for ending in endings:
        with suppress(OSError):
            stem.with_suffix(ending).unlink()


def _read_running(stem: Path) -> RunningArm | None:
    """Return the arm of an ID; None if no program drives it or its files are not valid."""
    if not _has_program(stem):
        return None
    with suppress(OSError, ValueError, LookupError, TypeError, RecursionError):
        about = json.loads(stem.with_suffix(".arm").read_text("utf-8"))
        return RunningArm(str(about["name"]), str(about["port"]), int(about["pid"]), stem)
    return None


def _has_program(stem: Path) -> bool | None:
    """Return whether a program drives the arm of an ID; None if there is no ``ID.lock``.

    A folder or a link with that name does not count.
    """
    try:
        file = os.open(stem.with_suffix(".lock"), os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return None
    try:
        return not _lock(file, shared=True)
    finally:
        os.close(file)


def _lock(file: int, *, shared: bool = False) -> bool:
    """Lock an open file unless another process has a lock that forbids it.

    Args:
        file: File descriptor.
        shared: Several processes may hold such a lock at once, so that they can check a lock at the
            same time. Windows has no shared locks. There a file that another process checks counts
            as locked.

    Returns:
        Whether the file is locked now.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            os.lseek(file, 1 << 20, os.SEEK_SET)  # beyond the text, which other processes read
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
            return True
        except OSError:
            return False
        finally:
            os.lseek(file, 0, os.SEEK_SET)
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        return True
    except OSError:
        return False
