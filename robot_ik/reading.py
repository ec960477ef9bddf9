"""Files that people write or hand over: read whole, and checked before anybody uses what is in them.

What a parser says of text that is none, of nesting without end or of numbers without end becomes a
``ConfigError`` with file and key, once for all readers.
"""

from __future__ import annotations

import codecs
import csv
import json
import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from robot_ik.errors import ConfigError, did_you_mean

LARGEST_FILE = 256 * 2**20
"""Bytes; a recording of an hour has a tenth of it."""

LARGEST_NUMBER = 1e15
"""Of any unit that a file can have: beyond it a double no longer resolves a tenth."""

DEEPEST = 32
"""Tables and lists within each other; files of this program have six."""

_LONG_INTEGER = re.compile(r"[0-9][0-9_]{4000,}")  # Python reads no integers above 4,300 digits
NESTED = re.compile(rf"(?:[\[{{]\s*){{{DEEPEST}}}")
"""Brackets that open one within the other."""
_KEY = re.compile(r"""([\w.-]{1,60})["']?\s*[=:]""")


def read_text(path: Path, what: str, hint: str = "", *, errors: str = "strict") -> str:
    """The text of a file that somebody named; ``what`` it should be is for the message: "the arm file".

    ``hint`` says what to try if there is none, ``errors`` what to do about bytes that are no UTF-8.

    Raises:
        ConfigError: It is not there, may not be read, has no end, or is no text.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(LARGEST_FILE + 1)
        if len(data) <= LARGEST_FILE:
            data = data.removeprefix(codecs.BOM_UTF8)  # Windows' Notepad may put it there
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


def read_json(path: Path, what: str) -> Any:
    """The content of a JSON file; arguments and errors as of ``read_text`` and ``parse_json``."""
    return parse_json(read_text(path, what), path)


def read_csv(path: Path, what: str) -> list[list[str]]:
    """The rows of a CSV file; raises as ``read_text``, or where a cell is longer than the reader takes."""
    rows = csv.reader(read_text(path, what).splitlines())
    try:
        return list(rows)
    except csv.Error as error:
        raise ConfigError(f"not valid CSV: {error}", file=path, key=f"line {rows.line_num}") from None


def is_number(text: str) -> bool:
    """Whether ``float`` reads it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def parse_toml(text: str, file: Path | str) -> dict[str, Any]:
    """The tables of a TOML text; errors as of ``parse``."""
    content: dict[str, Any] = parse(text, file, "TOML", tomllib.loads)
    return content


def parse_json(text: str, file: Path | str) -> Any:
    """The content of a JSON text; errors as of ``parse``."""
    return parse(text, file, "JSON", json.loads)


def parse(text: str, file: Path | str, language: str, parser: Callable[[str], Any]) -> Any:
    """What a parser makes of a text, where every number and every string of it can be used.

    ``file`` and ``language`` ("YAML") are for messages.

    Raises:
        ConfigError: The text is not of that language; it is nested deeper than ``DEEPEST``; a number is not
            finite, larger than ``LARGEST_NUMBER``, or an integer of more than 64 bits; a string no Unicode.
    """
    try:
        content = parser(text)
    except RecursionError:
        match = NESTED.search(text)
        keys = _KEY.findall(text[: match.start()][-10_000:]) if match else []
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
    """What is wrong with a number or a string, and what would be right."""
    if isinstance(value, float) and not abs(value) <= LARGEST_NUMBER:
        return f"{value!r} is not right", f"finite numbers up to {LARGEST_NUMBER:g}"
    if isinstance(value, int) and value.bit_length() >= 64:
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


class WrongKey(ValueError):
    """What is wrong with a key (seen from the table that raises it), raised where the file is not known.

    ``tables.check_table`` adds the file.
    """

    def __init__(self, problem: str, key: str = "", allowed: str = "", hint: str = "") -> None:
        super().__init__(
            f"{key}: {problem}; allowed: {allowed}".removeprefix(": ").removesuffix("; allowed: ")
        )
        self.problem, self.key, self.allowed, self.hint = problem, key, allowed, hint

    @classmethod
    def unknown(cls, what: str, name: object, known: Iterable[str], key: str = "") -> WrongKey:
        """A name that does not exist; the close ones are named."""
        names = list(known)
        return cls(
            f"no {what} is called {shown(name)}", key, ", ".join(names), did_you_mean(str(name), names)
        )

    def within(self, location: tuple[int | str, ...], table: str = "") -> WrongKey:
        """The same, seen from farther out."""
        parts = (*location, self.key) if self.key else location
        key = key_text(parts)
        return WrongKey(
            self.problem, f"{table}.{key}" if table and key else table or key, self.allowed, self.hint
        )

    def in_file(self, file: Path | str) -> ConfigError:
        """The error for people."""
        return ConfigError(self.problem, file=file, key=self.key, allowed=self.allowed, hint=self.hint)
