"""Every servo model that this project knows, of every family."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType

from robot_ik.config import KeyProblem
from robot_ik.errors import ConfigError
from robot_ik.hardware.families.dynamixel_x_table import MODELS as X_MODELS
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES, build_table
from robot_ik.hardware.families.feetech_sts_table import STS_TABLES
from robot_ik.hardware.registers import IDS, ControlTable

CONTROL_TABLES: Mapping[str, ControlTable] = MappingProxyType({**X_TABLES, **STS_TABLES})
"""Model name -> control table with the firmware that this project assumes."""

BAUD_RATES: tuple[int, ...] = tuple(
    sorted({rate for table in CONTROL_TABLES.values() for rate in table.baud_rates})
)
"""Every rate that some servo knows, bit/s."""


def model_by_number(number: int) -> ControlTable | None:
    """Return the table of a model by its Model Number register; None if it is not known here."""
    return next((table for table in CONTROL_TABLES.values() if table.number == number), None)


def model_name(number: int) -> str:
    """Return the name of a model by its Model Number register, e.g. for an error message."""
    table = model_by_number(number)
    return table.model if table else f"model number {number}"


def require_id(id: int, key: str) -> None:
    """Check that a servo can have this id.

    Args:
        id: Servo id.
        key: Option that names it, for the error.

    Raises:
        ConfigError: It cannot.
    """
    if id not in IDS:
        raise ConfigError(
            f"{id} is no servo id", file="command line", key=key, allowed=f"0..{IDS[-1]}"
        )


@lru_cache(maxsize=64)
def control_table(model: str, firmware: int | None = None) -> ControlTable:
    """Return the table of a model.

    Args:
        model: Name.
        firmware: Version; None: the version that this project assumes.

    Raises:
        ConfigError: No such model here, or no such firmware.
    """
    if model not in CONTROL_TABLES:
        raise KeyProblem.unknown("servo model", model, CONTROL_TABLES).in_file("control_table")
    if firmware is None or model not in X_MODELS:
        return CONTROL_TABLES[model]
    if not 1 <= firmware <= 255:
        raise ConfigError(
            f"no firmware has the number {firmware}", file="control_table", allowed="1..255"
        )
    return build_table(model, X_MODELS[model], firmware)
