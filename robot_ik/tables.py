"""Tables that people write in files, checked by pydantic; ``table_errors`` says what is wrong in them."""

from __future__ import annotations

from collections.abc import Callable
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

from robot_ik.reading import WrongKey, read_toml, shown


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
            from robot_ik.table_errors import TableError  # most files are right

            raise TableError(error, keys) from None


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
SchemaVersion = Annotated[Literal[1], Field(alias="schema", description="1")]
"""Key ``schema`` of every file; the field is called otherwise because pydantic's base class has that name."""
Positive = Annotated[float, Field(gt=0.0)]
Word = Annotated[str, Field(min_length=1)]
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
Made = TypeVar("Made", bound=BaseModel)


def check_table(model: type[Made], data: Any, file: Path | str) -> Made:
    """The content of a file, as a parser made it; raises ``ConfigError`` where a key is not right."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        from robot_ik.table_errors import config_error

        raise config_error(error, file) from None


def read_table(model: type[Made], path: Path, what: str, hint: str = "") -> Made:
    """A TOML file with every key checked; arguments and errors as of ``read_toml`` and ``check_table``."""
    return check_table(model, read_toml(path, what, hint), path)
