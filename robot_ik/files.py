"""Files: read whole and checked, written whole or not at all; values in the form that JSON can hold.

All files that people write or hand over are read here: what a parser says of text that is none, of nesting
without end or of numbers without end becomes a ``ConfigError`` with file and key, once for all readers.
"""

from __future__ import annotations

import contextlib
import csv
import datetime
import errno
import json
import math
import os
import re
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from robot_ik.errors import ConfigError, OutputError

LARGEST_FILE = 256 * 2**20
"""Bytes; a recording of an hour has a tenth of it."""

LARGEST_NUMBER = 1e15
"""Of any unit that a file can have: beyond it a double no longer tells a tenth from the next."""

DEEPEST = 32
"""Tables and lists within each other; files of this program have six."""

_LONG_INTEGER = re.compile(r"[0-9][0-9_]{4000,}")  # Python reads no integers above 4,300 digits
NESTED = re.compile(rf"(?:[\[{{]\s*){{{DEEPEST}}}")
"""Brackets that open one within the other."""
_KEY = re.compile(r"""([\w.-]{1,60})["']?\s*[=:]""")


def timestamp() -> str:
    """The time in UTC, ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def read_text(path: Path, what: str, hint: str = "", *, errors: str = "strict") -> str:
    """The text of a file that somebody named.

    Args:
        path: The file.
        what: What it should be, for the message: "the arm file".
        hint: What to try if there is none.
        errors: What to do about bytes that are no UTF-8, as for ``bytes.decode``.

    Raises:
        ConfigError: It is not there, may not be read, has no end, or is no text.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(LARGEST_FILE + 1)
        if len(data) <= LARGEST_FILE:
            return data.decode("utf-8", errors).replace("\r\n", "\n").replace("\r", "\n")
        reason = f"it has more than {LARGEST_FILE >> 20} MiB"
    except UnicodeDecodeError:
        reason = "it is no text (UTF-8)"
    except OSError as error:
        reason = error.strerror or str(error)
    except ValueError as error:  # a name that no file can have
        reason = str(error)
    raise ConfigError(f"{what} cannot be read: {reason}", file=path, hint=hint)


def read_toml(path: Path, what: str, hint: str = "") -> dict[str, Any]:
    """The tables of a TOML file; arguments and errors as of ``read_text`` and ``parse_toml``."""
    return parse_toml(read_text(path, what, hint), path)


def read_json(path: Path, what: str, hint: str = "") -> Any:
    """The content of a JSON file; arguments and errors as of ``read_text`` and ``parse_json``."""
    return parse_json(read_text(path, what, hint), path)


def read_csv(path: Path, what: str) -> list[list[str]]:
    """The rows of a CSV file.

    Raises:
        ConfigError: As ``read_text``; or a cell is longer than the reader takes.
    """
    rows = csv.reader(read_text(path, what).splitlines())
    try:
        return list(rows)
    except csv.Error as error:
        raise ConfigError(f"not valid CSV: {error}", file=path, key=f"line {rows.line_num}") from None


def parse_toml(text: str, file: Path | str) -> dict[str, Any]:
    """The tables of a TOML text; ``file`` appears in errors.

    Raises:
        ConfigError: As ``parse``.
    """
    content: dict[str, Any] = parse(text, file, "TOML", tomllib.loads)
    return content


def parse_json(text: str, file: Path | str) -> Any:
    """The content of a JSON text; ``file`` appears in errors.

    Raises:
        ConfigError: As ``parse``.
    """
    return parse(text, file, "JSON", json.loads)


def parse(text: str, file: Path | str, language: str, parser: Callable[[str], Any]) -> Any:
    """What a parser makes of a text, where every number and every word of it can be used.

    Args:
        text: What the file says.
        file: For messages.
        language: Likewise: "YAML".
        parser: From the text to dicts, lists, numbers and words.

    Raises:
        ConfigError: The text is not of that language; it is nested deeper than ``DEEPEST``; a number is not
            finite, larger than ``LARGEST_NUMBER``, or an integer of more than 64 bits; a word is no Unicode.
    """
    try:
        content = parser(text)
    except RecursionError:
        place = NESTED.search(text)
        keys = _KEY.findall(text[: place.start()][-10_000:]) if place else []
        raise _too_deep(file, keys[-1] if keys else "") from None
    except MemoryError:
        raise ConfigError("too much for the memory of this machine", file=file) from None
    except Exception as error:  # parsers leave ValueErrors and more to the caller, PyYAML almost anything
        shorter = _LONG_INTEGER.sub("9" * 30, text)
        if shorter != text:
            return parse(shorter, file, language, parser)  # its integer is refused below, with its key
        raise ConfigError(f"not valid {language}: {' '.join(str(error).split())}", file=file) from None
    _require_usable(content, len(text), file)
    return content


def _require_usable(content: Any, most: int, file: Path | str) -> None:
    """Raises where a value cannot be used; ``most``: values there can be, for YAML's aliases make more."""
    waiting: list[tuple[Any, tuple[Any, ...]]] = [({"": content}, ())]
    while waiting:
        holder, path = waiting.pop()
        items: Iterable[tuple[Any, Any]] = holder.items() if isinstance(holder, dict) else enumerate(holder)
        for key, value in items:
            most -= 1
            holds = isinstance(value, (dict, list))
            if problem := _problem(key) or (None if holds else _problem(value)):
                where = key_text((*path[1:], key) if path else ())
                raise ConfigError(problem[0], file=file, key=where, allowed=problem[1])
            if holds:
                if len(path) > DEEPEST or most < -1:
                    raise _too_deep(file, key_text((*path[1:3], key)[:2]))
                waiting.append((value, (*path, key)))


def _problem(value: Any) -> tuple[str, str] | None:
    """What is wrong with a number or a word, and what would be right."""
    if isinstance(value, float):
        if math.isfinite(value) and abs(value) <= LARGEST_NUMBER:
            return None
        return f"{value!r} is not right", f"finite numbers up to {LARGEST_NUMBER:g}"
    if isinstance(value, int):
        if value.bit_length() < 64:
            return None
        return "an integer too long to be right", "integers of 64 bits"
    if isinstance(value, str) and not value.isascii():
        try:
            value.encode("utf-8")
        except UnicodeEncodeError:
            return f"{shown(value)} is no text", "Unicode without halves of surrogate pairs"
    return None


def _too_deep(file: Path | str, key: str) -> ConfigError:
    return ConfigError("nested too deep", file=file, key=shown(key, str), allowed=f"{DEEPEST} levels")


def key_text(location: Iterable[int | str]) -> str:
    """Where a value is: ``("joints", 2, "id")`` -> ``joints[2].id``."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{part}"
    return shown(text.encode("utf-8", "backslashreplace").decode("utf-8"), str)


def shown(value: object, text: Callable[[object], str] = repr) -> str:
    """A value for a message of one line, cut where it is long."""
    found = text(value)
    return found if len(found) <= 60 else found[:59] + "…"


FORMER: Mapping[str, str] = MappingProxyType(
    {
        "things": "objects",
        "thing": "object",
        "floors": "lower_bounds",
        "--phantoms": "--occluders",
        "--phantom-geoms": "--occluder-geoms",
        "--camera-place": "--camera-extrinsics",
        "--place": "--extrinsics",
    }
)
"""Keys and options of before the first release, and what they are called now; nothing reads the old ones."""


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
        paths: The files, written whole later (``write_atomically``); None: one that is not wanted.
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
    with folder_for_results(path), _locked(_opened(path), path):
        held = sorted(path.glob(own))
        if held and not overwrite:
            raise _held(path, f"it holds {held[0].name}" + (", …" if len(held) > 1 else ""))
        yield held


def _opened(folder: Path) -> int | None:
    return None if os.name == "nt" else os.open(folder, os.O_RDONLY)


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


def _held(path: Path, why: str) -> OutputError:
    return OutputError(
        f"{path} is not written to: {why}, and stays as it is",
        hint="choose another name, or give --overwrite",
    )


def _unwritable(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"cannot write {path}: {error.strerror or error}", hint="give a folder that exists or can be made"
    )
