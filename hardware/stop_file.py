"""How one process asks the arm that another one drives to stop, without its port: ``robot-ik stop``.

All arms of a user have their files in one folder:

* ``ID.lock``: locked as long as the program has the arm.  The system takes the lock from a program that ends.
* ``ID.arm``: what the arm is.  It is written whole, and only once ``ID.lock`` is locked.
* ``ID.stop``: a request.  It stays until the arm has carried it out or its program has ended.
* ``ID.done``: the reply.

The arm looks for a request in its control cycle and with every beat of its heartbeat.  An ID is used once.
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
"""s after which files of an arm that is gone are removed: a program may still be about to read them."""


def _folder_of_user() -> Path:
    """One place for all programs of a user: it depends on no environment variable.

    An arm that cron, a service or ``su`` has started must be found from a terminal.  Windows has no such
    folder; there all programs of a user have the same temporary folder.
    """
    if os.name == "posix":
        return Path(f"/tmp/robot-ik-run-{os.getuid()}")
    return Path(tempfile.gettempdir()) / "robot-ik-run"


FOLDER = _folder_of_user()


def runtime_folder() -> Path:
    """``FOLDER``, which only this user can look into; made if need be.

    Raises:
        HardwareError: There is something else of that name, or it belongs to another user.
    """
    try:
        FOLDER.mkdir(mode=0o700, exist_ok=True)
        found = FOLDER.lstat()
    except OSError as error:
        raise HardwareError(f"no runtime folder {FOLDER}: {error.strerror}") from error
    foreign = hasattr(os, "getuid") and found.st_uid != os.getuid()
    if foreign or not stat.S_ISDIR(found.st_mode):
        raise HardwareError(f"{FOLDER} is not a folder of this user", hint="remove it, or ask its owner to")
    if stat.S_IMODE(found.st_mode) != 0o700:
        FOLDER.chmod(0o700)
    return FOLDER


class StopFile:
    """The arm's side; ``name`` is the arm's."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._stem: Path | None = None
        self._request = ""
        self._files: list[int] = []

    def open(self, port: str) -> None:
        """From here on the arm on ``port`` can be found; without a folder it cannot, and the log says so.

        An arm that can be found already stays so, with the requests that wait for it.
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
        """A folder that is locked is left alone by systemd-tmpfiles, which else removes what is old."""
        if os.name == "posix":
            file = os.open(folder, os.O_RDONLY)
            self._files.append(file)
            _lock(file, shared=True)

    def requested(self) -> str | None:
        """``hold`` or ``torque_off`` if a program asks for it."""
        if not self._request or not os.path.exists(self._request):
            return None
        with suppress(OSError, ValueError, LookupError, TypeError):
            if read_json(Path(self._request), "the request")["policy"] == "torque_off":
                return "torque_off"
        return "hold"  # a request that cannot be read is one all the same

    def acknowledge(self, *, ok: bool, text: str) -> None:
        """What became of the request, if there is one: a stop may have come from inside the program."""
        if self._stem is None or not os.path.exists(self._request):
            return
        try:
            write_atomically(self._stem.with_suffix(".done"), json.dumps({"ok": ok, "text": text}))
        except OutputError as error:
            log.warning("answering robot-ik stop: %s", error)
        with suppress(OSError):
            os.unlink(self._request)

    def close(self) -> None:
        """The arm is left.  May be called any number of times."""
        files, self._files = self._files, []
        stem, self._stem, self._request = self._stem, None, ""
        if stem is not None:
            _remove(stem, ".arm", ".stop")  # a reply stays for the program that waits for it
        for file in files:
            os.close(file)
        if stem is not None:
            _remove(stem, ".lock")  # after it is closed: Windows removes no open file


@dataclass(frozen=True)
class RunningArm:
    """An arm that a living program of this user drives; ``stem``: its files without their endings."""

    name: str
    port: str
    pid: int
    stem: Path

    def stop(self, policy: str = "hold", timeout: float = 3.0) -> tuple[bool, str]:
        """Asks it to stop by ``hold`` or ``torque_off``, and waits ``timeout`` s for the reply.

        Without a reply the request stays: a program that goes on later carries it out then.

        Returns:
            Whether every servo confirmed it; what happened, as text.
        """
        reply, request = self.stem.with_suffix(".done"), self.stem.with_suffix(".stop")
        reply.unlink(missing_ok=True)
        write_atomically(request, json.dumps({"policy": policy}))
        end = time.monotonic() + timeout
        while True:
            lives = _has_program(self.stem)  # before the look for a reply
            if reply.exists():
                outcome = json.loads(reply.read_text("utf-8"))
                reply.unlink(missing_ok=True)
                return bool(outcome["ok"]), str(outcome["text"])
            if not lives:
                request.unlink(missing_ok=True)
                return False, "its program has closed it or ended meanwhile; cut the power if it still moves"
            if time.monotonic() >= end:
                return False, (
                    f"no answer for {timeout:g} s; cut the power if it still moves. The request stays: "
                    "the arm stops when its program goes on"
                )
            time.sleep(_POLL_PERIOD)


def running_arms(port: str | None = None) -> list[RunningArm]:
    """Arms that are enabled now; those on ``port`` only, if it is named.

    Raises:
        HardwareError: The runtime folder is not this user's.
    """
    folder = runtime_folder()
    remove_litter(folder)
    stems = sorted(path.with_suffix("") for path in folder.glob("*.arm"))
    arms = [arm for stem in stems if (arm := _read_running(stem)) is not None]
    return [arm for arm in arms if port is None or os.path.realpath(arm.port) == os.path.realpath(port)]


def remove_litter(folder: Path) -> None:
    """Removes the files of programs that ended without closing their arms.

    An ``ID.arm`` appears only after its lock, so the files of a running arm are never taken for these.  What
    else lies in the folder stays.
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
    """Removes files of an arm, those that are there."""
    for ending in endings:
        with suppress(OSError):
            stem.with_suffix(ending).unlink()


def _read_running(stem: Path) -> RunningArm | None:
    """The arm of an ID; None where no program has it, or these are no arm's files."""
    if not _has_program(stem):
        return None
    with suppress(OSError, ValueError, LookupError, TypeError, RecursionError):
        about = json.loads(stem.with_suffix(".arm").read_text("utf-8"))
        return RunningArm(str(about["name"]), str(about["port"]), int(about["pid"]), stem)
    return None


def _has_program(stem: Path) -> bool | None:
    """Whether a program has the arm of an ID; None where there is no ``ID.lock``.

    A folder or a link of that name is none.
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
    """Locks an open file if no process has a lock that forbids it.

    ``shared``: several processes may have such a lock at once, so that two that look do not disturb each
    other.  Windows has none: there a file that another process looks at counts as locked.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            os.lseek(file, 1 << 20, os.SEEK_SET)  # behind the text, which others must be able to read
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
