"""Writing files completely or not at all, and converting values to JSON and TOML."""

from __future__ import annotations

import dataclasses
import datetime
import json
import math
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robot_ik.errors import OutputError

FILE_MODE = 0o644
"""Permissions of written files: all users may read them."""


def timestamp() -> str:
    """Return the time in UTC to the second, in ISO 8601."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file beside ``path``, then rename it to ``path``.

    Raises:
        OutputError: The folder is missing or not writable. A former file is unchanged.
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise unwritable(path, error) from error
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(name, FILE_MODE)  # mkstemp makes private files
        os.replace(name, path)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        Path(name).unlink(missing_ok=True)


def make_folder(path: Path) -> Path:
    """Create a folder and its parents, and check that files can be written to it.

    Raises:
        OutputError: The folder cannot be made, or no file can be written to it.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise unwritable(path, error) from error
    return path


def unwritable(path: Path, error: OSError) -> OutputError:
    """Return the error for a path that cannot be written, with the reason and a hint."""
    file = next((place for place in (path, *path.parents) if place.is_file()), None)
    if isinstance(error, IsADirectoryError):
        reason = "it is a folder"
        hint = "give the name of a file in it"
    elif file is not None and isinstance(error, FileExistsError | NotADirectoryError):
        reason = f"{file} is a file, not a folder"
        hint = "give the name of a folder, or a new name"
    elif isinstance(error, FileNotFoundError) and not path.parent.is_dir():
        reason = f"there is no folder {path.parent}"
        hint = "create the folder first, or give another one"
    elif isinstance(error, FileNotFoundError):  # in /proc
        folder = path if path.is_dir() else path.parent
        reason = f"no file can be made in {folder}"
        hint = "give a folder where you may write"
    else:
        reason = error.strerror or str(error)
        hint = "give a folder where you may write, with space left"
    return OutputError(f"cannot write {path}: {reason}", hint=hint)


def plain(value: Any) -> Any:
    """Return a value that JSON can hold.

    Arrays and tuples become lists. Numbers that are not finite become None. A dataclass becomes a
    dictionary of its fields. Values of other types become their text.
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return {name: plain(getattr(value, name)) for name in names}
    return str(value)


def json_text(value: Any, indent: str = "", *, ascii: bool = False) -> str:
    """Return JSON with objects over several lines and lists of simple values on one line.

    Args:
        value: A value as ``plain`` returns it.
        indent: Indentation of the first line.
        ascii: Whether other characters are escaped.
    """

    def text(item: Any) -> str:
        return json_text(item, indent + "  ", ascii=ascii)

    separator = f"\n{indent}  "
    if isinstance(value, dict) and value:
        rows = ",".join(f"{separator}{text(key)}: {text(item)}" for key, item in value.items())
        return f"{{{rows}\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        rows = ",".join(separator + text(item) for item in value)
        return f"[{rows}\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=ascii)


def toml_value(value: Any) -> str:
    """Return text, numbers and lists of them in TOML."""
    # JSON and TOML differ for these values in one control character only.
    return json_text(plain(value)).replace("\x7f", "\\u007f")
