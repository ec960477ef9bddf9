"""What no single key of an arm file shows: models, modes, rates, currents, duplicates, ranges."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from robot_ik.config import KeyProblem
from robot_ik.hardware.models import CONTROL_TABLES
from robot_ik.hardware.registers import ControlTable
from robot_ik.hardware.servo import Joint, SwingArm
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS, min_watchdog_ms

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig

LONGEST_NAME = 100
"""Characters of the name of a joint or a group."""

SMALLEST_VELOCITY = 1e-3
"""deg/s (mm/s).  A velocity limit below it is a mistake of units."""

LARGEST_VELOCITY = 1e5
"""deg/s (mm/s).  The Profile Velocity register ends at 45,000 deg/s of the servo."""

SMALLEST_ACCELERATION = 1e-3
"""deg/s^2 (mm/s^2).  An acceleration limit below it is a mistake of units."""

LARGEST_ACCELERATION = 1e6
"""deg/s^2 (mm/s^2).  The Profile Acceleration register ends at 700,000 deg/s^2 of the servo."""


def check_arm(config: ArmConfig) -> None:
    """Check an arm as a whole.

    Raises:
        ConfigError: With file, key and what is allowed.
    """
    key = ""
    try:
        names: dict[str, str] = {}
        ids: dict[int, str] = {}
        for index, joint in enumerate(config.joints):
            key = f"joints[{index}]"
            _check_model(config, joint)
            _check_names(joint)
            _check_unique(joint, key, names, ids)
            table = joint.servo.table
            if config.baud not in table.baud_rates:
                rates = ", ".join(map(str, table.baud_rates))
                problem = f"{table.model} ({joint.name}) has no baud rate of {config.baud} bits/s"
                key = ""
                raise KeyProblem(problem, "bus.baud", rates)
            _check_currents(joint, table)
            _check_stops(joint, table)
            _check_speeds(joint)
            _check_range(joint)
        key = ""
        _check_watchdogs(config)
    except KeyProblem as wrong:
        raise wrong.within((), key).in_file(config.file or config.name) from None


def _check_model(config: ArmConfig, joint: Joint) -> None:
    model = joint.servo.model
    if model not in CONTROL_TABLES:
        raise KeyProblem.unknown("servo model", model, CONTROL_TABLES, "model")
    table = joint.servo.table
    first = config.joints[0].servo
    if table.family != first.table.family:
        problem = f"{model} and {first.model} speak different protocols"
        raise KeyProblem(problem, "model", "servos of one family on one bus")
    mode = joint.servo.mode
    if mode not in table.modes:
        modes = ", ".join(mode.name.lower() for mode in table.modes)
        raise KeyProblem(f"{model} has no mode {mode.name.lower()}", "mode", modes)


def _check_unique(joint: Joint, key: str, names: dict[str, str], ids: dict[int, str]) -> None:
    """Check that no other joint has this name and no other servo these ids, and add them."""
    if joint.name in names:
        raise KeyProblem(f"joint {joint.name!r} is already {names[joint.name]}", "name")
    names[joint.name] = key
    for id_key, servo in zip(("id", "twin.id"), joint.servos, strict=False):
        if servo.id in ids:
            raise KeyProblem(f"id {servo.id} is already {ids[servo.id]}", id_key)
        ids[servo.id] = f"{key}.{id_key}".removesuffix(".id")


def _check_watchdogs(config: ArmConfig) -> None:
    """Check that the heartbeat acts before the servos stop by themselves.

    Otherwise an arm that is held sinks a little each time.
    """
    if not config.watchdog_ms:
        return
    if not config.family.capabilities.bus_watchdog:
        why = config.family.unprotected_exit
        problem = f"{config.joints[0].servo.model} servos have no bus watchdog: {why}"
        raise KeyProblem(problem, "bus.watchdog_ms", "0: no bus watchdog")
    if not config.stale_ms:
        return
    period = 1.0 / config.rate_hz
    smallest = min_watchdog_ms(config.stale_ms, period)
    if config.watchdog_ms < smallest:
        # stale_ms is not in the file. Its default grows with the watchdog.
        if config.stale_ms == config.watchdog_ms // 2:
            while smallest < min_watchdog_ms(smallest // 2, period):
                smallest += WATCHDOG_UNIT_MS
        raise KeyProblem(
            f"the servos would stop by themselves after {config.watchdog_ms} ms, before the "
            f"program can hold them (stale_ms = {config.stale_ms} at {config.rate_hz:g} Hz)",
            "bus.watchdog_ms",
            f"{smallest} or more, or a shorter stale_ms; 0: no bus watchdog",
        )


def _check_currents(joint: Joint, table: ControlTable) -> None:
    unit = table.current_unit
    current_limit = joint.servo.current_limit
    limits = {"current_limit_ma": current_limit, "stop_at.current_ma": joint.stop_at.current_ma}
    named = [key for key, value in limits.items() if value is not None]
    if not unit and named:
        allowed = "a model that does; load_percent in [joints.stop_at] for this one"
        raise KeyProblem(f"{table.model} measures no current", named[0], allowed)
    maximum = table.largest_current
    if joint.current is not None:
        if not joint.servo.presses:
            mode = joint.servo.mode.name.lower()
            problem = f"mode {mode} of {joint.name!r} takes no current"
            raise KeyProblem(problem, "current_ma", 'mode = "current_based_position"')
        limits["current_ma"] = joint.current
    for key, value in limits.items():
        is_limited = key != "current_limit_ma" and current_limit is not None
        ceiling = current_limit if is_limited and current_limit is not None else maximum
        if value is not None and not unit <= value <= ceiling:
            limited = f" limited to {ceiling:g} mA" if ceiling < maximum else ""
            problem = f"{value:g} mA is no current of a {table.model}{limited}"
            raise KeyProblem(problem, key, f"{unit:g} to {ceiling:g}")


def _check_stops(joint: Joint, table: ControlTable) -> None:
    """Check that thresholds are measured, above what the servo may do, below its shutdown."""
    stop = joint.stop_at
    may_press = joint.current
    if stop.current_ma is not None and may_press is not None and stop.current_ma <= may_press:
        raise KeyProblem(
            f"{joint.name!r} may press with {may_press:g} mA (current_ma) and would stop the arm "
            "by it",
            "stop_at.current_ma",
            f"> {may_press:g}",
        )
    if stop.load_percent is not None and "present_load" not in table:
        problem = f"{table.model} measures its current, and no load"
        raise KeyProblem(problem, "stop_at.load_percent", "current_ma")
    hottest = table["temperature_limit"].initial or 0
    if stop.temperature_c is not None and not stop.temperature_c < hottest:
        problem = f"a {table.model} has shut down at {stop.temperature_c:g} C"
        raise KeyProblem(problem, "stop_at.temperature_c", f"< {hottest}, its Temperature Limit")


def _check_names(joint: Joint) -> None:
    """Check that names fit on a line of a terminal and have no control characters."""
    for key in ("name", "group"):
        name = getattr(joint, key)
        if len(name) > LONGEST_NAME:
            problem = f"{name[:20]!r}… has {len(name):,} characters"
            raise KeyProblem(problem, key, f"up to {LONGEST_NAME}")
        if not name.isprintable():
            problem = f"{name!r} has characters that cannot be printed"
            raise KeyProblem(problem, key, "printable characters")


def _check_speeds(joint: Joint) -> None:
    """Check that a servo can reach the speed limits, and that its own profile allows them."""
    ranges = {
        "velocity": (SMALLEST_VELOCITY, LARGEST_VELOCITY),
        "acceleration": (SMALLEST_ACCELERATION, LARGEST_ACCELERATION),
    }
    for key, (smallest, largest) in ranges.items():
        limit = getattr(joint, key)
        profile = getattr(joint, f"profile_{key}")
        value = limit / joint.per_unit
        if not smallest <= value <= largest:
            problem = f"{value:g} is no cap"
            raise KeyProblem(problem, f"{key}_{joint.unit}", f"{smallest:g} to {largest:g}")
        if profile is not None and not limit <= profile < math.inf:
            raise KeyProblem(
                f"the servo of {joint.name!r} could not follow: its profile is slower than the "
                "joint's cap",
                f"profile_{key}_{joint.unit}",
                f">= {key}_{joint.unit} = {value:g}",
            )


def _check_range(joint: Joint) -> None:
    unit = joint.unit
    per_unit = joint.per_unit
    if not joint.lower < joint.upper:
        span = f"{joint.lower / per_unit:g} to {joint.upper / per_unit:g} {unit}"
        problem = f"the range of {joint.name!r} is empty: {span}"
        raise KeyProblem(problem, f"lower_{unit}", f"lower_{unit} < upper_{unit}")
    reach = joint.reach()
    ends = [value / per_unit for value in reach]
    gear = joint.gear
    if isinstance(gear, SwingArm) and not reach[0] <= joint.lower < joint.upper <= reach[1]:
        raise KeyProblem(
            f"a horn of {1e3 * gear.horn:g} mm and a rod of {1e3 * gear.rod:g} mm do not take "
            f"{joint.name!r} from {joint.text(joint.lower, 2)} to {joint.text(joint.upper, 2)}",
            "lower_mm" if joint.lower < reach[0] else "upper_mm",
            f"{ends[0]:.2f} to {ends[1]:.2f} mm",
        )
    lower, upper = joint.limits
    if not lower < upper:
        raise KeyProblem(
            f"nothing of the range of {joint.name!r} can be reached in mode "
            f"{joint.servo.mode.name.lower()}",
            f"lower_{unit}",
            f"{ends[0]:.1f} to {ends[1]:.1f} {unit}",
            'use mode = "extended_position", or another zero_ticks',
        )
    for servo in joint.servos:
        first, last = joint.ticks_range(servo)
        if first > last or upper - lower < joint.resolution:
            problem = f"the range of {joint.name!r} is narrower than one tick of its servo"
            allowed = f"at least {joint.text(joint.resolution, 4)} from lower to upper"
            raise KeyProblem(problem, f"lower_{unit}", allowed)
