"""``robot-ik servo monitor``: what every servo says of itself, again and again."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

from rich.live import Live
from rich.table import Table
from rich.text import Text
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.servo_link import BusOptions, Link, opened
from robot_ik.files import plain

if TYPE_CHECKING:
    from robot_ik.hardware.telemetry import ServoState

FASTEST = 200.0
"""Hz."""


@dataclass(frozen=True)
class MonitorOptions(BusOptions):
    """Watches the servos: position, velocity, current, voltage, temperature, torque, errors. Moves nothing.

    Runs until Ctrl-C, or --count samples. Exit code 1 when a servo did not answer in the last one.
    """

    rate: Annotated[float, arg(metavar="HZ")] = 10.0
    """Samples a second, at most 200."""
    count: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: until Ctrl-C)")] = None
    """End after so many samples."""
    json: bool = False
    """Print one JSON object a line for each sample."""


def run_monitor(options: MonitorOptions) -> int:
    """Prints samples; 1 when somebody was silent in the last one."""
    if not 0.0 < options.rate <= FASTEST:
        raise wrong("--rate", f"{options.rate:g} Hz", f"above 0, at most {FASTEST:g}")
    if options.count is not None and options.count < 1:
        raise wrong("--count", f"{options.count} samples", "1 and more")
    with opened(options) as link:
        if options.json:
            return _lines(link, options)
        screen = console.out()
        if not screen.is_terminal:
            return _watch(link, options, lambda states: screen.print(states_table(states)))
        with Live(console=screen, auto_refresh=False) as live:
            return _watch(link, options, lambda states: live.update(states_table(states), refresh=True))


def _lines(link: Link, options: MonitorOptions) -> int:
    begin = link.clock.now()

    def show(states: Sequence[ServoState]) -> None:
        servos = [plain(asdict(state)) for state in states]
        sample = {"time": round(link.clock.now() - begin, 6), "servos": servos}
        sys.stdout.write(json.dumps(sample, allow_nan=False) + "\n")
        sys.stdout.flush()

    return _watch(link, options, show)


def _watch(link: Link, options: MonitorOptions, show: Callable[[Sequence[ServoState]], object]) -> int:
    from robot_ik.hardware.telemetry import read_states

    due, done = link.clock.now(), 0
    while True:
        states = read_states(link.bus, link.config.servos)
        show(states)
        done += 1
        if done == options.count:
            return console.DONE if all(state.answered for state in states) else console.NOT_ACHIEVED
        due = max(due + 1.0 / options.rate, link.clock.now())
        link.clock.sleep_until(due)


def states_table(states: Sequence[ServoState]) -> Table:
    """One sample as a table."""
    names = ("joint", "id", "position", "velocity", "current", "supply", "temp", "torque", "errors")
    shown = console.table(*names)
    for s in states:
        current = _number(s.current_ma, " mA", 0)
        if s.load_percent is not None:
            current = f"{round(s.load_percent)} % load"  # not -0
        errors = Text(", ".join(s.errors) or ("none" if s.answered else "no answer"))
        errors.stylize("bold red" if s.errors or not s.answered else "green")
        shown.add_row(
            s.joint,
            str(s.id),
            _either(s.position_deg, "°", s.position_mm, " mm", 2),
            _either(s.velocity_deg, " °/s", s.velocity_mm, " mm/s", 1),
            current,
            _number(s.voltage, " V", 1),
            _number(s.temperature, " C", 0),
            "-" if s.torque is None else ("ON" if s.torque else "off"),
            errors,
        )
    return shown


def _either(turn: float | None, turns: str, way: float | None, ways: str, digits: int) -> str:
    return _number(turn, turns, digits) if way is None else _number(way, ways, digits)


def _number(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}{unit}"  # + 0.0: no "-0"
