"""Files that are read whole, and appear whole or not at all; values in the form that JSON can hold."""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from robot_ik.errors import ConfigError, OutputError


def read_text(path: Path, what: str, hint: str = "") -> str:
    """The text of a file that somebody named.

    Args:
        path: The file.
        what: What it should be, for the message: "the arm file".
        hint: What to try if there is none.

    Raises:
        ConfigError: It is not there, may not be read, or is no text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        reason = "it is no text (UTF-8)"
    except OSError as error:
        reason = error.strerror or str(error)
    raise ConfigError(f"{what} cannot be read: {reason}", file=path, hint=hint)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes beside ``path`` first, then renames over it.

    Raises:
        OutputError: The folder is missing or not writable; an older file of that name is untouched.
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise _unwritable(path, error) from error
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(name, 0o644)  # mkstemp makes private files; a result is to be read by others
        os.replace(name, path)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        Path(name).unlink(missing_ok=True)


@contextlib.contextmanager
def folder_for_results(path: Path) -> Iterator[Path]:
    """Makes sure at once that files can be written to ``path``; takes back what stayed empty.

    Raises:
        OutputError: The folder cannot be made, or nothing can be written in it.
    """
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        yield make_folder(path)
    finally:
        for folder in made:  # the innermost first; a folder that holds something stays
            with contextlib.suppress(OSError):
                folder.rmdir()


def make_folder(path: Path) -> Path:
    """Makes a folder (and those above it) in which files can be written.

    Raises:
        OutputError: It cannot be made, or nothing can be written in it.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise _unwritable(path, error) from error
    return path


def plain(value: Any) -> Any:
    """``value`` as JSON can hold it: arrays become lists, numbers that are not finite become null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)


def _unwritable(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"cannot write {path}: {error.strerror or error}", hint="give a folder that exists or can be made"
    )
