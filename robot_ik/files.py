"""Files: written whole or not at all, and claimed before the work begins; values as JSON can hold them."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import errno
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from robot_ik.errors import OutputError


def timestamp() -> str:
    """The time in UTC, ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


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


@contextlib.contextmanager
def claimed(*paths: Path | None, overwrite: bool = False) -> Iterator[None]:
    """Keeps the names of result files for one run, from before its work begins until it ends.

    Args:
        paths: The files, written whole later (``write_atomically``); None: one that is not wanted.  Their
            folders are made where they do not exist.
        overwrite: Whether files that are there may be replaced.

    Raises:
        OutputError: A file is there already, its name is a folder's, another run is about to write it, or
            it cannot be written.
    """
    with contextlib.ExitStack() as stack:
        for path in filter(None, paths):
            if path.is_dir():
                raise _unwritable(path, IsADirectoryError(errno.EISDIR, "it is a folder"))
            if os.path.lexists(path) and not overwrite:
                raise _held(path, "it exists")
            stack.enter_context(folder_for_results(path.parent))
            lock = path.with_name(f".{path.name}.lock")
            try:
                handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o644)
            except OSError as error:
                raise _unwritable(path, error) from error
            stack.enter_context(_locked(handle, path))
            stack.callback(lock.unlink, missing_ok=True)
        yield


@contextlib.contextmanager
def claimed_folder(path: Path, own: str, *, overwrite: bool = False) -> Iterator[list[Path]]:
    """Keeps a folder for the results of one run, from before its work begins; takes back what stayed empty.

    Args:
        path: Made where it does not exist.
        own: Pattern of the names of such results.  A folder that holds one of them holds results.
        overwrite: Whether they may be replaced.

    Yields:
        The results that are there, to be removed when the first new one is written.

    Raises:
        OutputError: It holds results, another run is writing to it, or it cannot be written to.
    """
    with folder_for_results(path), _locked(None if os.name == "nt" else os.open(path, os.O_RDONLY), path):
        held = sorted(path.glob(own))
        if held and not overwrite:
            raise _held(path, f"it holds {held[0].name}" + (", …" if len(held) > 1 else ""))
        yield held


@contextlib.contextmanager
def _locked(handle: int | None, path: Path) -> Iterator[None]:
    """Keeps other runs out of ``path`` by a lock that ends with the process, however that ends."""
    if handle is None:
        yield
        return
    try:
        with contextlib.suppress(ImportError):  # Windows has no such lock
            import fcntl

            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                hint = "give a name of its own"
                raise OutputError(f"another run is writing to {path}", hint=hint) from error
            except OSError:  # a file system without locks
                pass
        yield
    finally:
        os.close(handle)


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
    """``value`` as JSON can hold it: arrays become lists, numbers that are not finite become null.

    A dataclass, such as a pose, becomes its fields; what is left its text.
    """
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
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return str(value)


def json_text(value: Any, indent: str = "", *, ascii: bool = False) -> str:
    """JSON for people and machines: objects over several lines, lists of plain values on one.

    ``value`` as ``plain`` makes it; ``ascii``: other signs are escaped.
    """

    def text(item: Any) -> str:
        return json_text(item, indent + "  ", ascii=ascii)

    inner = f"\n{indent}  "
    if isinstance(value, dict) and value:
        rows = ",".join(f"{inner}{text(key)}: {text(item)}" for key, item in value.items())
        return f"{{{rows}\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, (dict, list)) for item in value):
        return f"[{','.join(inner + text(item) for item in value)}\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=ascii)


def toml_value(value: Any) -> str:
    """Text, numbers and lists of them in TOML: as in JSON, which leaves one control character as it is."""
    return json_text(plain(value)).replace("\x7f", "\\u007f")


def _held(path: Path, why: str) -> OutputError:
    return OutputError(
        f"{path} is not written to: {why}, and stays as it is",
        hint="choose another name, or give --overwrite",
    )


def _unwritable(path: Path, error: OSError) -> OutputError:
    file = next((place for place in (path, *path.parents) if place.is_file()), None)
    if isinstance(error, IsADirectoryError):
        why, hint = "it is a folder", "give the name of a file in it"
    elif file is not None and isinstance(error, FileExistsError | NotADirectoryError):
        why, hint = (
            f"{file} is a file, and a folder is wanted there",
            "give the name of a folder, or a new one",
        )
    elif isinstance(error, FileNotFoundError) and not path.parent.is_dir():
        why, hint = f"there is no folder {path.parent}", "make it first, or give another"
    elif isinstance(error, FileNotFoundError):  # /proc says so
        folder = path if path.is_dir() else path.parent
        why, hint = f"nothing can be made in {folder}", "give a place where you may write"
    else:
        why, hint = error.strerror or str(error), "give a place where you may write, with space left"
    return OutputError(f"cannot write {path}: {why}", hint=hint)
