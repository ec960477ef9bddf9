"""What no single key of an arm file can tell: models, modes, rates, currents, duplicates, empty ranges."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from robot_ik.errors import ConfigError
from robot_ik.hardware.control_table import ControlTable, OperatingMode, control_table
from robot_ik.hardware.joint_map import MODE_TICKS, JointMap
from robot_ik.hardware.watchdogs import least_watchdog_ms

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig


def check_arm(config: ArmConfig, file: Path | str) -> None:
    """Checks an arm as a whole.

    Args:
        config: The arm.
        file: For messages.

    Raises:
        ConfigError: With file, key and what would be right.
    """
    _check_watchdogs(config, file)
    names: dict[str, int] = {}
    ids: dict[int, str] = {}
    for k, joint in enumerate((*config.joints, *config.aside)):
        at = f"joints[{k}]"
        table = _table(joint, at, file)
        _check_model(config, joint, table, at, file)
        if joint.name in names:
            raise ConfigError(
                f"joint {joint.name!r} is already joints[{names[joint.name]}]", file=file, key=f"{at}.name"
            )
        names[joint.name] = k
        for place, servo in zip((at, f"{at}.twin"), joint.servos, strict=False):
            if servo.id in ids:
                raise ConfigError(f"id {servo.id} is already {ids[servo.id]}", file=file, key=f"{place}.id")
            ids[servo.id] = place
        _check_current(joint, table, at, file)
        _check_range(joint, at, file)


def _check_watchdogs(config: ArmConfig, file: Path | str) -> None:
    """The heartbeat must act before the servos stop by themselves, or a held arm sinks a little each time."""
    if not config.watchdog_ms or not config.stale_ms:
        return
    least = least_watchdog_ms(config.stale_ms, 1.0 / config.rate_hz)
    if config.watchdog_ms < least:
        raise ConfigError(
            f"the servos would stop by themselves after {config.watchdog_ms} ms, before the program can hold "
            f"them (stale_ms = {config.stale_ms} at {config.rate_hz:g} Hz)",
            file=file,
            key="bus.watchdog_ms",
            allowed=f"{least} or more, or a shorter stale_ms; 0: no bus watchdog",
        )


def current_unit(table: ControlTable) -> float:
    """mA of one count of the current registers; 0 where there are none."""
    return float(table["goal_current"].unit.split()[0]) if "goal_current" in table else 0.0


def _table(joint: JointMap, at: str, file: Path | str) -> ControlTable:
    try:
        return control_table(joint.model)
    except ConfigError as error:
        raise ConfigError(
            f"unknown servo model {joint.model!r}",
            file=file,
            key=f"{at}.model",
            allowed=error.allowed,
            hint=error.hint,
        ) from None


def _check_model(config: ArmConfig, joint: JointMap, table: ControlTable, at: str, file: Path | str) -> None:
    if joint.mode not in table.modes:
        raise ConfigError(
            f"{joint.model} has no mode {joint.mode.name.lower()}",
            file=file,
            key=f"{at}.mode",
            allowed=", ".join(m.name.lower() for m in table.modes),
        )
    if config.baud not in table.baud_rates:
        raise ConfigError(
            f"{joint.model} ({joint.name}) cannot talk at {config.baud} bits/s",
            file=file,
            key="bus.baud",
            allowed=", ".join(map(str, table.baud_rates)),
        )


def _check_current(joint: JointMap, table: ControlTable, at: str, file: Path | str) -> None:
    if joint.current is None:
        return
    if joint.mode != OperatingMode.CURRENT_BASED_POSITION:
        raise ConfigError(
            f"mode {joint.mode.name.lower()} of {joint.name!r} takes no current",
            file=file,
            key=f"{at}.current_ma",
            allowed='mode = "current_based_position"',
        )
    most = table["goal_current"].maximum * current_unit(table)
    if not current_unit(table) <= joint.current <= most:
        raise ConfigError(
            f"{joint.current:g} mA is no current of a {joint.model}",
            file=file,
            key=f"{at}.current_ma",
            allowed=f"{current_unit(table):g} to {most:g}",
        )


def _check_range(joint: JointMap, at: str, file: Path | str) -> None:
    if not joint.lower < joint.upper:
        raise ConfigError(
            f"the range of {joint.name!r} is empty: {joint.lower / joint.per_unit:g} to "
            f"{joint.upper / joint.per_unit:g} {joint.unit}",
            file=file,
            key=f"{at}.lower_{joint.unit}",
            allowed=f"lower_{joint.unit} < upper_{joint.unit}",
        )
    for key, value in (("velocity", joint.velocity), ("acceleration", joint.acceleration)):
        if not 0.0 < value < math.inf:
            at_key = f"{at}.{key}_{joint.unit}"
            raise ConfigError(f"{value} is no cap", file=file, key=at_key, allowed="a number > 0")
    lower, upper = joint.limits
    if not lower < upper:
        ends = sorted(joint.to_radians(t) / joint.per_unit for t in MODE_TICKS[joint.mode])
        raise ConfigError(
            f"nothing of the range of {joint.name!r} can be reached in mode {joint.mode.name.lower()}",
            file=file,
            key=f"{at}.lower_{joint.unit}",
            allowed=f"{ends[0]:.1f} to {ends[1]:.1f} {joint.unit}",
            hint='use mode = "extended_position", or another zero_ticks',
        )
