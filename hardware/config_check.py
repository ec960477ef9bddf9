"""What no single key of an arm file can tell: models, modes, rates, currents, duplicates, empty ranges."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from robot_ik.errors import ConfigError
from robot_ik.hardware.control_table import ControlTable, OperatingMode, control_table
from robot_ik.hardware.joint_map import JointMap
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS, least_watchdog_ms

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
        _check_currents(joint, table, at, file)
        _check_stops(joint, table, at, file)
        _check_caps(joint, at, file)
        _check_range(joint, at, file)


def _check_watchdogs(config: ArmConfig, file: Path | str) -> None:
    """The heartbeat must act before the servos stop by themselves, or a held arm sinks a little each time."""
    if not config.watchdog_ms or not config.stale_ms:
        return
    period = 1.0 / config.rate_hz
    least = least_watchdog_ms(config.stale_ms, period)
    if config.watchdog_ms < least:
        if config.stale_ms == config.watchdog_ms // 2:  # not named: it grows with the watchdog
            while least < least_watchdog_ms(least // 2, period):
                least += WATCHDOG_UNIT_MS
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


def _check_currents(joint: JointMap, table: ControlTable, at: str, file: Path | str) -> None:
    unit = current_unit(table)
    limits: tuple[tuple[str, float | None], ...] = (
        ("current_limit_ma", joint.current_limit),
        ("stop_at.current_ma", joint.stop_at.current_ma),
    )
    if not unit and any(value is not None for _, value in limits):
        raise ConfigError(
            f"{joint.model} measures no current",
            file=file,
            key=f"{at}.{next(key for key, value in limits if value is not None)}",
            allowed="a model that does; load_percent in [joints.stop_at] for this one",
        )
    most = table["goal_current"].maximum * unit if unit else 0.0
    if joint.current is not None:
        if joint.mode != OperatingMode.CURRENT_BASED_POSITION:
            raise ConfigError(
                f"mode {joint.mode.name.lower()} of {joint.name!r} takes no current",
                file=file,
                key=f"{at}.current_ma",
                allowed='mode = "current_based_position"',
            )
        limits = (*limits, ("current_ma", joint.current))
    for key, value in limits:
        ceiling = most if key == "current_limit_ma" or joint.current_limit is None else joint.current_limit
        if value is not None and not unit <= value <= ceiling:
            raise ConfigError(
                f"{value:g} mA is no current of a {joint.model}"
                + (f" limited to {ceiling:g} mA" if ceiling < most else ""),
                file=file,
                key=f"{at}.{key}",
                allowed=f"{unit:g} to {ceiling:g}",
            )


def _check_stops(joint: JointMap, table: ControlTable, at: str, file: Path | str) -> None:
    """Thresholds that a servo can say something about, above what it may do and below what shuts it down."""
    stop = joint.stop_at
    if stop.current_ma is not None and joint.current is not None and stop.current_ma <= joint.current:
        raise ConfigError(
            f"{joint.name!r} may press with {joint.current:g} mA (current_ma) and would stop the arm by it",
            file=file,
            key=f"{at}.stop_at.current_ma",
            allowed=f"> {joint.current:g}",
        )
    if stop.load_percent is not None and "present_load" not in table:
        raise ConfigError(
            f"{joint.model} measures its current, and no load",
            file=file,
            key=f"{at}.stop_at.load_percent",
            allowed="current_ma",
        )
    hottest = table["temperature_limit"].initial or 0
    if stop.temperature_c is not None and not stop.temperature_c < hottest:
        raise ConfigError(
            f"a {joint.model} has shut down at {stop.temperature_c:g} C",
            file=file,
            key=f"{at}.stop_at.temperature_c",
            allowed=f"< {hottest}, its Temperature Limit",
        )


def _check_caps(joint: JointMap, at: str, file: Path | str) -> None:
    """Caps are finite, and the servo's own profile does not cut them."""
    for key in ("velocity", "acceleration"):
        cap, own = getattr(joint, key), getattr(joint, f"profile_{key}")
        if not 0.0 < cap < math.inf:
            at_key = f"{at}.{key}_{joint.unit}"
            raise ConfigError(f"{cap} is no cap", file=file, key=at_key, allowed="a number > 0")
        if own is not None and not cap <= own < math.inf:
            raise ConfigError(
                f"the servo of {joint.name!r} could not follow: its profile is slower than the joint's cap",
                file=file,
                key=f"{at}.profile_{key}_{joint.unit}",
                allowed=f">= {key}_{joint.unit} = {cap / joint.per_unit:g}",
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
    if joint.swing is not None and not joint.reach[0] <= joint.lower < joint.upper <= joint.reach[1]:
        raise ConfigError(
            f"a horn of {1e3 * joint.swing.horn:g} mm and a rod of {1e3 * joint.swing.rod:g} mm do not take "
            f"{joint.name!r} from {joint.text(joint.lower, 2)} to {joint.text(joint.upper, 2)}",
            file=file,
            key=f"{at}.lower_mm" if joint.lower < joint.reach[0] else f"{at}.upper_mm",
            allowed="{:.2f} to {:.2f} mm".format(*(q / joint.per_unit for q in joint.reach)),
        )
    lower, upper = joint.limits
    if not lower < upper:
        ends = [q / joint.per_unit for q in joint.reach]
        raise ConfigError(
            f"nothing of the range of {joint.name!r} can be reached in mode {joint.mode.name.lower()}",
            file=file,
            key=f"{at}.lower_{joint.unit}",
            allowed=f"{ends[0]:.1f} to {ends[1]:.1f} {joint.unit}",
            hint='use mode = "extended_position", or another zero_ticks',
        )
    for servo in joint.servos:
        first, last = servo.ticks_range
        if first > last or upper - lower < joint.resolution:
            raise ConfigError(
                f"the range of {joint.name!r} is narrower than one tick of its servo",
                file=file,
                key=f"{at}.lower_{joint.unit}",
                allowed=f"at least {joint.text(joint.resolution, 4)} from lower to upper",
            )
