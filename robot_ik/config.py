"""Reading of files that people write (TOML, JSON and CSV), and checks of their tables.

All errors are ``ConfigError`` with the file, the key, the allowed values and close names. A table
is a pydantic model that derives from ``Table``.
"""

from __future__ import annotations

import codecs
import csv
import json
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args, get_origin, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PlainValidator,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from robot_ik.errors import ConfigError, did_you_mean

LARGEST_FILE = 256 * 2**20
"""Bytes. A recording of one hour needs a tenth of this."""

LARGEST_NUMBER = 1e15
"""In any unit. A larger double does not resolve 0.1."""

MAXIMUM_DEPTH = 32
"""Levels of nested tables and lists. The deepest file of this package has six."""

LONGEST_VALUE = 60
"""Characters of a value in a message. Longer values are cut."""

Item = TypeVar("Item")
Model = TypeVar("Model", bound=BaseModel)


def read_text(path: Path, what: str, hint: str = "", *, errors: str = "strict") -> str:
    """Read a text file of at most ``LARGEST_FILE`` bytes.

    Args:
        path: The file.
        what: The kind of file, for the message: "the arm file".
        hint: What to try if the file cannot be read.
        errors: Treatment of bytes that are not UTF-8, as for ``bytes.decode``.

    Raises:
        ConfigError: The file is missing, not readable, too large, or not text.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(LARGEST_FILE + 1)
        if len(data) <= LARGEST_FILE:
            data = data.removeprefix(codecs.BOM_UTF8)  # Notepad on Windows writes this mark
            return data.decode("utf-8", errors).replace("\r\n", "\n").replace("\r", "\n")
        reason = f"it has more than {LARGEST_FILE >> 20} MiB"
    except UnicodeDecodeError:
        reason = "it is not text in UTF-8"
    except OSError as error:
        reason = error.strerror or str(error)
    except ValueError as error:  # the name contains a null character
        reason = str(error)
    raise ConfigError(f"{what} cannot be read: {reason}", file=path, hint=hint)


def read_toml(path: Path, what: str, hint: str = "") -> dict[str, Any]:
    """Read a TOML file. Arguments and errors as for ``read_text`` and ``parse``."""
    return parse_toml(read_text(path, what, hint), path)


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file. Arguments and errors as for ``read_text`` and ``parse``."""
    return parse_json(read_text(path, what), path)


def read_csv(path: Path, what: str) -> list[list[str]]:
    """Read the rows of a CSV file. Arguments as for ``read_text``.

    Raises:
        ConfigError: As for ``read_text``, or a cell is too long for the reader.
    """
    rows = csv.reader(read_text(path, what).splitlines())
    try:
        return list(rows)
    except csv.Error as error:
        problem = f"not valid CSV: {error}"
        raise ConfigError(problem, file=path, key=f"line {rows.line_num}") from error


def parse_toml(text: str, file: Path | str) -> dict[str, Any]:
    """Return the tables of a TOML text. Errors as for ``parse``."""
    tables: dict[str, Any] = parse(text, file, "TOML", tomllib.loads)
    return tables


def parse_json(text: str, file: Path | str) -> Any:
    """Return the content of a JSON text. Errors as for ``parse``."""
    return parse(text, file, "JSON", json.loads)


def parse(text: str, file: Path | str, language: str, parser: Callable[[str], Any]) -> Any:
    """Parse a text and check that every value in it can be used and printed.

    Args:
        text: The text.
        file: The file, for messages.
        language: The language, for messages: "YAML".
        parser: Returns the content of the text. Its error is passed on in the ``ConfigError``.

    Raises:
        ConfigError: The text is not valid; a number is not finite or beyond ``LARGEST_NUMBER``;
            a string is not Unicode; values are nested deeper than ``MAXIMUM_DEPTH``.
    """
    try:
        content = parser(text)
    except Exception as error:  # no parser documents a closed list of errors
        reason = " ".join(str(error).split())
        raise ConfigError(f"not valid {language}: {reason}", file=file) from error
    try:
        _check_values(content, ())
    except KeyProblem as problem:
        raise problem.in_file(file) from None
    return content


def _check_values(value: Any, location: tuple[int | str, ...]) -> None:
    """Raise ``KeyProblem`` for values that no later check could report safely."""
    if isinstance(value, dict | list):
        if len(location) >= MAXIMUM_DEPTH:
            allowed = f"{MAXIMUM_DEPTH} levels"
            raise KeyProblem("nested too deep", key_text(location[:2]), allowed)
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in pairs:
            _check_values(key, location)
            _check_values(item, (*location, key))
    elif isinstance(value, int | float):
        if not abs(value) <= LARGEST_NUMBER:  # NaN too
            allowed = f"finite numbers up to {LARGEST_NUMBER:g}"
            raise KeyProblem(f"{shown(value)} is not right", key_text(location), allowed)
    elif isinstance(value, str):
        try:
            value.encode("utf-8")
        except UnicodeEncodeError as error:
            raise KeyProblem(f"{shown(value)}: {error.reason}", key_text(location)) from error


def is_number(text: str) -> bool:
    """Return whether ``float`` reads the text."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def shown(value: object) -> str:
    """Return the ``repr`` of a value for a message, cut after ``LONGEST_VALUE`` characters."""
    return _cut(repr(value))


def key_text(location: Iterable[int | str]) -> str:
    """Return the place of a value: ``("joints", 2, "id")`` is ``joints[2].id``."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    printable = text.encode("utf-8", "backslashreplace").decode("utf-8")
    return _cut(printable.removeprefix("."))


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 1] + "…"


class KeyProblem(ValueError):
    """A wrong key, raised where the file is not known. ``check_table`` adds the file.

    Attributes:
        problem: What is wrong.
        key: Dotted key, seen from the table that raises the error. Empty for the table itself.
        allowed: What is allowed.
        hint: What to try.
    """

    def __init__(self, problem: str, key: str = "", allowed: str = "", hint: str = "") -> None:
        text = f"{key}: {problem}" if key else problem
        super().__init__(f"{text}; allowed: {allowed}" if allowed else text)
        self.problem = problem
        self.key = key
        self.allowed = allowed
        self.hint = hint

    @classmethod
    def unknown(cls, what: str, name: object, known: Iterable[str], key: str = "") -> KeyProblem:
        """Return the problem of an unknown name, with close names as the hint."""
        names = list(known)
        hint = did_you_mean(str(name), names)
        return cls(f"no {what} is called {shown(name)}", key, ", ".join(names), hint)

    def within(self, location: tuple[int | str, ...], table: str = "") -> KeyProblem:
        """Return the same problem with its key seen from an outer table."""
        key = key_text((*location, self.key) if self.key else location)
        key = ".".join(filter(None, (table, key)))
        return KeyProblem(self.problem, key, self.allowed, self.hint)

    def in_file(self, file: Path | str) -> ConfigError:
        """Return the ``ConfigError`` of this problem in a file."""
        return ConfigError(
            self.problem, file=file, key=self.key, allowed=self.allowed, hint=self.hint
        )


class _TableError(ValueError):
    """The errors that pydantic found in one table, and the keys of this table."""

    def __init__(self, error: ValidationError, keys: Mapping[str, FieldInfo]) -> None:
        super().__init__(str(error))
        self.error = error
        self.keys = keys


class Table(BaseModel):
    """A table of a file. Unknown keys and values of another type are errors.

    Subclasses check what concerns several keys in validators that raise ``KeyProblem``.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @model_validator(mode="wrap")
    @classmethod
    def _validate_with_keys(cls, data: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        keys = {info.alias or name: info for name, info in cls.model_fields.items()}
        if isinstance(data, dict):
            for key in keys.keys() & data.keys():
                kind = keys[key].annotation
                if isinstance(data[key], bool) and get_origin(kind) is Literal:
                    # A Literal[1] takes True, because True == 1.
                    choices = ", ".join(map(str, get_args(kind)))
                    raise KeyProblem(f"{data[key]} is not right", key, choices)
        try:
            return validate(data)
        except ValidationError as error:
            raise _TableError(error, keys) from None


def keys_of(kind: type[Any]) -> PlainValidator:
    """Return the annotation of a dataclass whose fields are the keys of a table.

    The dataclass checks its values and raises ``KeyProblem``.
    """
    hints = get_type_hints(kind, include_extras=True)
    keys: dict[str, Any] = {
        item.name: (hints[item.name], ... if item.default is MISSING else item.default)
        for item in fields(kind)
    }
    table = create_model(kind.__name__, __base__=Table, **keys)

    def validate(data: Any) -> Any:
        return data if isinstance(data, kind) else kind(**dict(table.model_validate(data)))

    return PlainValidator(validate)


def chosen(choose: Callable[[dict[str, Any]], type[Table]]) -> PlainValidator:
    """Return the annotation of a table whose class depends on its content.

    Args:
        choose: Returns the class for a table, or raises ``KeyProblem``.
    """

    def validate(data: Any) -> Table:
        if isinstance(data, Table):
            return data
        if not isinstance(data, dict):
            raise KeyProblem(f"{shown(data)} is not right", allowed="a table")
        return choose(data).model_validate(data)

    return PlainValidator(validate)


def check_table(model: type[Model], data: Any, file: Path | str) -> Model:
    """Return a parsed table as a model. Raise ``ConfigError`` if a key is wrong."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise config_error(error, file) from None


def read_table(model: type[Model], path: Path, what: str, hint: str = "") -> Model:
    """Read a TOML file and check it. Arguments and errors as for ``read_toml``, ``check_table``."""
    return check_table(model, read_toml(path, what, hint), path)


def config_error(error: ValidationError, file: Path | str) -> ConfigError:
    """Return the first problem that pydantic found in a file, unknown keys first.

    An unknown key often explains a missing key.
    """
    problems = sorted(_problems(error), key=lambda pair: not pair[0])
    first = problems[0][1]
    if len(problems) > 1:
        more = f"and {len(problems) - 1} more to correct after this"
        first.hint = "\n".join(filter(None, (first.hint, more)))
    return first.in_file(file)


def _problems(
    error: ValidationError, table: _TableError | None = None, outer: tuple[int | str, ...] = ()
) -> Iterator[tuple[bool, KeyProblem]]:
    """Yield each problem, and whether it is an unknown key."""
    details = error.errors(include_url=False)
    for detail in details:
        kind = detail["type"]
        depth = len(detail["loc"])
        if kind == "too_short" and any(len(other["loc"]) > depth for other in details):
            continue  # the items that are reported as wrong are missing from the list
        inner = tuple(part for k, part in enumerate(detail["loc"]) if k == 0 or not _is_type(part))
        short_list = kind == "missing" and isinstance(inner[-1], int)
        if short_list:
            inner = inner[:-1]
        location = (*outer, *inner)
        cause = detail.get("ctx", {}).get("error")
        if isinstance(cause, _TableError):
            yield from _problems(cause.error, cause, location)
        elif isinstance(cause, KeyProblem):
            yield False, cause.within(location)
        elif kind == "extra_forbidden":
            name = str(location[-1])
            known = table.keys if table else {}
            hint = did_you_mean(name, known)
            problem = KeyProblem(f"unknown key {shown(name)}", "", ", ".join(known), hint)
            yield True, problem.within(location)
        else:
            field = table.keys.get(str(inner[0])) if table and len(inner) == 1 else None
            allowed = _field_text(field) if field else ""
            if kind == "missing" and not short_list:
                text = "this key is missing"
                allowed = allowed or "a value"
            else:
                text = f"{shown(detail['input'])} is not right"
                allowed = allowed or _allowed_text(detail)
            yield False, KeyProblem(text, key_text(location), allowed)


def _is_type(part: int | str) -> bool:
    """Return whether a part of a location is the name of a type in a union, which is not a key."""
    return isinstance(part, str) and (part in ("str", "int", "float", "bool") or "[" in part)


def _allowed_text(detail: ErrorDetails) -> str:
    """Return what pydantic allows: its sentence without the first words."""
    names = {
        "dict_type": "a table",
        "model_type": "a table",
        "list_type": "a list",
        "tuple_type": "a list",
        "bool_type": "true or false",
    }
    if detail["type"] in names:
        return names[detail["type"]]
    text = detail["msg"]
    for start in ("Input should be ", "String should have ", "Value should "):
        text = text.removeprefix(start)
    return text.replace("a valid ", "a ", 1)


def _field_text(field: FieldInfo) -> str:
    """Return the description of a key, else its range (``0..252``), else an empty text."""
    rows: list[Any] = [field]
    for part in get_args(field.annotation):  # an optional key has its type beside None
        rows += getattr(part, "__metadata__", ())
    for row in rows:
        if getattr(row, "description", None):
            return str(row.description)
    limits = [item for row in rows for item in getattr(row, "metadata", ())]
    bounds = {
        name: f"{getattr(limit, name):.10g}"
        for name in ("gt", "ge", "le")
        for limit in limits
        if getattr(limit, name, None) is not None
    }
    if bounds.keys() >= {"ge", "le"}:
        text = f"{bounds['ge']}..{bounds['le']}"
    else:
        signs = {"gt": ">", "ge": ">=", "le": "<="}
        text = " and ".join(f"{signs[name]} {value}" for name, value in bounds.items())
    for limit in limits:
        if getattr(limit, "multiple_of", None) is not None:
            text += f", a multiple of {limit.multiple_of}"
    return text


def _check_quaternion(wxyz: tuple[float, ...]) -> tuple[float, ...]:
    if not any(wxyz):
        raise KeyProblem("a zero quaternion is not an orientation", allowed="w x y z, not all zero")
    return wxyz


# Types of keys. Tables are frozen, so lists become tuples. Their items are checked as strictly as
# everything else.
SchemaVersion = Annotated[Literal[1], Field(alias="schema", description="1")]
"""Key ``schema`` of every file. The field is not called so, because pydantic uses that name."""
Positive = Annotated[float, Field(gt=0.0)]
Word = Annotated[str, Field(min_length=1)]
Several = Annotated[tuple[Item, ...], Field(strict=False)]
Pair = Annotated[tuple[float, float], Field(strict=False, description="2 numbers")]
Position = Annotated[tuple[float, float, float], Field(strict=False, description="3 numbers")]
Wxyz = Annotated[
    tuple[float, float, float, float],
    Field(strict=False, description="4 numbers, w x y z"),
    AfterValidator(_check_quaternion),
]
