"""Tables that people write in files: what pydantic finds wrong in them, as one sentence for people.

The sentence names file and key, says what is allowed and which name is close.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar, get_args, get_origin, get_type_hints

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

from robot_ik.errors import ConfigError, did_you_mean
from robot_ik.reading import FORMER, key_text, read_toml, shown

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo
    from pydantic_core import ErrorDetails


class WrongKey(ValueError):
    """What is wrong with a key (seen from the table that raises it), raised where the file is not known.

    ``check_table`` adds the file.
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


class _TableError(ValueError):
    """What pydantic found wrong in one table, and the keys of such a table."""

    def __init__(self, error: ValidationError, keys: Mapping[str, FieldInfo]) -> None:
        super().__init__(str(error))
        self.error, self.keys = error, keys


class Table(BaseModel):
    """A table of a file that people write.

    Unknown keys are errors, and values of another type: an integer is no boolean, text in quotes no number.
    Subclasses check what concerns several keys in validators that raise ``WrongKey``.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @model_validator(mode="wrap")
    @classmethod
    def _say_which(cls, data: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        keys = {info.alias or name: info for name, info in cls.model_fields.items()}
        for key in keys.keys() & data.keys() if isinstance(data, dict) else ():
            choices = get_args(keys[key].annotation) if get_origin(keys[key].annotation) is Literal else ()
            if isinstance(data[key], bool) and choices:  # which pydantic takes for 1 or 0 there
                raise WrongKey(f"{data[key]} is not right", key, ", ".join(map(str, choices)))
        try:
            return validate(data)
        except ValidationError as error:
            raise _TableError(error, keys) from None


def keys_of(made: type[Any]) -> PlainValidator:
    """Annotation of a dataclass whose fields are the keys of a table; it raises ``WrongKey`` itself."""
    hints = get_type_hints(made, include_extras=True)
    keys: dict[str, Any] = {
        row.name: (hints[row.name], ... if row.default is MISSING else row.default) for row in fields(made)
    }
    table = create_model(made.__name__, __base__=Table, **keys)

    def validate(data: Any) -> Any:
        return data if isinstance(data, made) else made(**dict(table.model_validate(data)))

    return PlainValidator(validate)


def chosen(choose: Callable[[dict[str, Any]], type[Table]]) -> PlainValidator:
    """Annotation of a table whose class ``choose`` finds from what stands in it, or raises ``WrongKey``."""

    def validate(data: Any) -> Table:
        if isinstance(data, Table):
            return data
        if not isinstance(data, dict):
            raise WrongKey(f"{shown(data)} is not right", allowed="a table")
        return choose(data).model_validate(data)

    return PlainValidator(validate)


Item = TypeVar("Item")
# Tables are frozen, so lists are kept as tuples; what is in them is as strict as everything else.
Several = Annotated[tuple[Item, ...], Field(strict=False)]
Pair = Annotated[tuple[float, float], Field(strict=False, description="2 numbers")]
Position = Annotated[tuple[float, float, float], Field(strict=False, description="3 numbers")]


def _not_zero(wxyz: tuple[float, ...]) -> tuple[float, ...]:
    if not any(wxyz):
        raise WrongKey("a quaternion of zeros is no orientation", allowed="w x y z, not all zero")
    return wxyz


Wxyz = Annotated[
    tuple[float, float, float, float],
    Field(strict=False, description="4 numbers, w x y z"),
    AfterValidator(_not_zero),
]
Made = TypeVar("Made", bound=Table)


def check_table(model: type[Made], data: Any, file: Path | str) -> Made:
    """The content of a file, as a parser made it; raises ``ConfigError`` where a key is not right."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise config_error(error, file) from None


def read_table(model: type[Made], path: Path, what: str, hint: str = "") -> Made:
    """A TOML file with every key checked; arguments and errors as of ``read_toml`` and ``check_table``."""
    return check_table(model, read_toml(path, what, hint), path)


def config_error(error: ValidationError, file: Path | str) -> ConfigError:
    """What pydantic finds wrong in a file; an unknown key goes first, for it often explains a missing one."""
    found = sorted(_wrong_keys(error), key=lambda row: not row[0])
    first = found[0][1]
    more = f"and {len(found) - 1} more to correct after this" if len(found) > 1 else ""
    first.hint = "\n".join(filter(None, (first.hint, more)))
    return first.in_file(file)


def _wrong_keys(
    error: ValidationError, table: _TableError | None = None, at: tuple[int | str, ...] = ()
) -> Iterator[tuple[bool, WrongKey]]:
    """All of it, with whether the key is unknown."""
    details = error.errors(include_url=False)
    for detail in details:
        if detail["type"] == "too_short" and any(len(d["loc"]) > len(detail["loc"]) for d in details):
            continue  # because of items that are wrong
        inside = tuple(part for k, part in enumerate(detail["loc"]) if not k or not _is_type(part))
        short = detail["type"] == "missing" and isinstance(inside[-1], int)  # a list of too few items
        inside = inside[:-1] if short else inside
        where = (*at, *inside)
        cause = detail.get("ctx", {}).get("error")
        if isinstance(cause, _TableError):
            yield from _wrong_keys(cause.error, cause, where)
        elif isinstance(cause, WrongKey):
            yield False, cause.within(where)
        elif detail["type"] == "extra_forbidden":
            yield True, _unknown_key(str(where[-1]), table).within(where)
        else:
            missing = detail["type"] == "missing" and not short
            problem = "this key is missing" if missing else f"{shown(detail['input'])} is not right"
            field = table.keys.get(str(inside[0])) if table and len(inside) == 1 else None
            allowed = (field and _range(field)) or ("a value" if missing else _sentence(detail))
            yield False, WrongKey(problem, key_text(where), allowed)


def _is_type(part: int | str) -> bool:
    """Whether pydantic says which of several types it tried, which is no key."""
    return isinstance(part, str) and (part in ("str", "int", "float", "bool") or "[" in part)


def _unknown_key(name: str, table: _TableError | None) -> WrongKey:
    if table is None:
        return WrongKey("unknown key")
    if (now := FORMER.get(name)) in table.keys:
        return WrongKey(f"the key {name} is called {now} now", allowed=str(now))
    return WrongKey(f"unknown key {shown(name)}", "", ", ".join(table.keys), did_you_mean(name, table.keys))


def _sentence(detail: ErrorDetails) -> str:
    """What would be right: pydantic's sentence cut to that."""
    if detail["type"] in ("dict_type", "model_type", "list_type", "tuple_type"):
        return "a table" if detail["type"] in ("dict_type", "model_type") else "a list"
    if detail["type"] == "bool_type":
        return "true or false"
    text = detail["msg"]
    for start in ("Input should be ", "String should have ", "Value should "):
        text = text.removeprefix(start)
    return text.replace("a valid ", "a ", 1)


def _range(field: FieldInfo) -> str:
    """What a key takes: its description, else its range, e.g. ``0..252``; empty where neither is said."""
    rows = [field, *(row for part in get_args(field.annotation) for row in getattr(part, "__metadata__", ()))]
    for row in rows:  # of a key that may be left out, the others are those of what it takes
        if getattr(row, "description", None):
            return str(row.description)
    items = [item for row in rows for item in getattr(row, "metadata", ())]
    bounds = {
        name: f"{sign}{getattr(item, name):.10g}"
        for name, sign in (("gt", "> "), ("ge", ">= "), ("le", "<= "))
        for item in items
        if getattr(item, name, None) is not None
    }
    text = " and ".join(bounds.values())
    if "ge" in bounds and "le" in bounds:
        text = f"{bounds['ge'].removeprefix('>= ')}..{bounds['le'].removeprefix('<= ')}"
    multiples = [item.multiple_of for item in items if getattr(item, "multiple_of", None) is not None]
    return text + (f", a multiple of {multiples[-1]}" if multiples else "")
