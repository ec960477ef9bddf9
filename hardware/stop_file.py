"""How one process asks the arm that another one drives to stop, without its port: ``robot-ik stop``.

A running arm has a file in the user's runtime folder and keeps it locked, so that a dead program's file is
known for what it is.  Who asks writes a request beside it; the arm looks for it in its control cycle and with
every beat of its heartbeat, stops, and writes a reply.
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
from robot_ik.errors import HardwareError
from robot_ik.files import write_atomically

log = logging.getLogger(__name__)

_POLL = 0.01  # s between two polls for a reply


def runtime_folder() -> Path:
    """A folder that only this user can look into; made if need be.

    Raises:
        HardwareError: There is something else of that name, or it belongs to another user.
    """
    base = os.environ.get("XDG_RUNTIME_DIR", "")
    user = os.getuid() if hasattr(os, "getuid") else 0
    if base and Path(base).is_dir() and os.access(base, os.W_OK):
        folder = Path(base) / "robot-ik"
    else:
        folder = Path(tempfile.gettempdir()) / f"robot-ik-run-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise HardwareError(f"no runtime folder {folder}: {error.strerror}") from error
    if not stat.S_ISDIR(found.st_mode) or (hasattr(os, "getuid") and found.st_uid != user):
        raise HardwareError(f"{folder} is not a folder of this user", hint="remove it, or ask its owner to")
    if stat.S_IMODE(found.st_mode) != 0o700:
        folder.chmod(0o700)
    return folder


class StopFile:
    """The arm's side; ``name`` is the arm's."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._stem: Path | None = None
        self._request = ""
        self._file = -1

    def open(self, port: str) -> None:
        """From here on the arm on ``port`` can be found; without a folder it cannot, and the log says so."""
        self.close()
        about = {"pid": os.getpid(), "port": os.path.realpath(port), "name": self._name}
        try:
            stem = runtime_folder() / uuid.uuid4().hex
            self._file = os.open(stem.with_suffix(".arm"), os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            _locked(self._file)
            os.write(self._file, json.dumps(about).encode())
        except (OSError, HardwareError) as error:
            log.warning("robot-ik stop cannot reach this arm: %s", error)
            self.close()
            return
        self._stem, self._request = stem, str(stem.with_suffix(".stop"))

    def requested(self) -> str | None:
        """``hold`` or ``torque_off`` if somebody asks for it."""
        if not self._request or not os.path.exists(self._request):
            return None
        with suppress(OSError, ValueError, LookupError, TypeError):
            if read_json(Path(self._request), "the request")["policy"] == "torque_off":
                return "torque_off"
        return "hold"  # whatever it says, somebody asks

    def acknowledge(self, *, ok: bool, text: str) -> None:
        """What became of the request, if there is one: a stop may have come from inside the program."""
        if self._stem is None or not os.path.exists(self._request):
            return
        try:
            write_atomically(self._stem.with_suffix(".done"), json.dumps({"ok": ok, "text": text}))
            os.unlink(self._request)
        except OSError as error:
            log.warning("answering robot-ik stop: %s", error)

    def close(self) -> None:
        """The arm is left.  May be called any number of times."""
        file, self._file = self._file, -1
        stem, self._stem, self._request = self._stem, None, ""
        if stem is not None:
            for ending in (".arm", ".stop"):  # a reply stays for who waits for it
                with suppress(OSError):
                    stem.with_suffix(ending).unlink()
        if file >= 0:
            os.close(file)


@dataclass(frozen=True)
class RunningArm:
    """An arm that a living program of this user drives; ``stem``: its files without their endings."""

    name: str
    port: str
    pid: int
    stem: Path

    def stop(self, policy: str = "hold", timeout: float = 3.0) -> tuple[bool, str]:
        """Asks it to stop by ``hold`` or ``torque_off``, and waits ``timeout`` s for the reply.

        Returns:
            Whether every servo confirmed it; what happened, as text.
        """
        reply, request = self.stem.with_suffix(".done"), self.stem.with_suffix(".stop")
        reply.unlink(missing_ok=True)
        write_atomically(request, json.dumps({"policy": policy}))
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            if reply.exists():
                outcome = json.loads(reply.read_text("utf-8"))
                reply.unlink(missing_ok=True)
                return bool(outcome["ok"]), str(outcome["text"])
            time.sleep(_POLL)
        request.unlink(missing_ok=True)
        return False, f"no answer for {timeout:g} s; cut the power if it still moves"


def running_arms(port: str | None = None) -> list[RunningArm]:
    """Arms that are enabled now; those on ``port`` only, if it is named.

    Raises:
        HardwareError: The runtime folder is not this user's.
    """
    found = []
    for path in sorted(runtime_folder().glob("*.arm")):
        arm = _read_living(path)
        if arm is None:
            if path.exists() and path.stat().st_size:  # an empty one is about to be locked
                for ending in (".arm", ".stop", ".done"):  # its program was killed
                    path.with_suffix(ending).unlink(missing_ok=True)
        elif port is None or arm.port == os.path.realpath(port):
            found.append(arm)
    return found


def _read_living(path: Path) -> RunningArm | None:
    """The arm of a file; None where no process has it locked any more."""
    try:
        file = os.open(path, os.O_RDWR)
    except OSError:
        return None
    try:
        if _locked(file):
            return None
        about = json.loads(os.read(file, 4096) or b"{}")
        return RunningArm(str(about["name"]), str(about["port"]), int(about["pid"]), path.with_suffix(""))
    except (OSError, ValueError, LookupError, TypeError):
        return None
    finally:
        os.close(file)


def _locked(file: int) -> bool:
    """Takes the lock of an open file if no process has it."""
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
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    except OSError:
        return False
