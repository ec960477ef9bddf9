"""What pydantic finds wrong in a ``Table``, as one sentence with file, key, what is allowed, close names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from pydantic import ValidationError

from robot_ik.errors import ConfigError, did_you_mean
from robot_ik.reading import WrongKey, key_text, shown

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo
    from pydantic_core import ErrorDetails


class TableError(ValueError):
    """What pydantic found wrong in one table, and the keys of such a table."""

    def __init__(self, error: ValidationError, keys: Mapping[str, FieldInfo]) -> None:
        super().__init__(str(error))
        self.error, self.keys = error, keys


def config_error(error: ValidationError, file: Path | str) -> ConfigError:
    """What pydantic finds wrong in a file; an unknown key goes first, for it often explains a missing one."""
    found = sorted(_wrong_keys(error), key=lambda row: not row[0])
    first = found[0][1]
    more = f"and {len(found) - 1} more to correct after this" if len(found) > 1 else ""
    first.hint = "\n".join(filter(None, (first.hint, more)))
    return first.in_file(file)


def _wrong_keys(
    error: ValidationError, table: TableError | None = None, at: tuple[int | str, ...] = ()
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
        if isinstance(cause, TableError):
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


def _unknown_key(name: str, table: TableError | None) -> WrongKey:
    if table is None:
        return WrongKey("unknown key")
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
