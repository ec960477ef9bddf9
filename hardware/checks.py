"""Rows of a health report, and the users and permissions of a device file."""

from __future__ import annotations

import getpass
import os
from dataclasses import dataclass
from pathlib import Path

OK = "ok"
NOTE = "note"
PROBLEM = "problem"


@dataclass(frozen=True)
class CheckRow:
    """One line of the report: the subject, its status, the result of the check, and advice."""

    what: str
    status: str
    found: str
    do: str = ""


def permission_hint(path: str) -> str:
    """Return how this user gets access to a device file."""
    try:
        group = Path(path).group()
    except (KeyError, OSError, NotImplementedError):
        # The group has no name, or the system has no groups (Windows).
        group = ""
    if group in ("", "root", "wheel"):
        return f"no permission for {path}: ask for a udev rule that gives it to one of your groups"
    return f"sudo usermod -aG {group} {getpass.getuser()}, then log out and in again"


def named_users_of(path: str) -> list[str]:
    """Return the programs with ``path`` open, as ``name (pid)``. Linux only."""
    return [f"{name} ({number})" for number, name in users_of(path).items()]


def users_of(device: str) -> dict[int, str]:
    """Return the programs with a device file open, by process number, as far as this user may see.

    A program that serves a pseudo terminal may keep both of its ends open and does not count.
    """
    target = os.path.realpath(device)
    users = {}
    for process in sorted(Path("/proc").glob("[0-9]*"), key=lambda folder: int(folder.name)):
        try:
            files = list((process / "fd").iterdir())
            opened = sum(os.path.realpath(file) == target for file in files)
            if opened > sum(_serves(file, target) for file in files):
                users[int(process.name)] = (process / "comm").read_text(encoding="utf-8").strip()
        except OSError:
            continue  # the process ended, or belongs to another user
    return users


def _serves(file: Path, terminal: str) -> bool:
    """Whether an open file (of /proc) is the other end of a pseudo terminal /dev/pts/N."""
    if not terminal.startswith("/dev/pts/") or os.path.basename(os.path.realpath(file)) != "ptmx":
        return False
    about = (file.parent.parent / "fdinfo" / file.name).read_text(encoding="utf-8")
    return f"tty-index:\t{os.path.basename(terminal)}\n" in about
