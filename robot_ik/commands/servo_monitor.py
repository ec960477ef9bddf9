"""``robot-ik servo monitor``: watch the servos of an arm."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.text import Text

from robot_ik.commands.arms import load_arm, open_servo_bus
from robot_ik.commands.options import BusOptions, JsonOption, SampleRate
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.schedule import Schedule, regular

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.hardware.health import ServoState

COLUMNS = (
    "joint",
    "id",
    "position",
    "velocity",
    "current",
    "supply",
    "temp",
    "torque",
    "errors",
)
"""Columns of the table of servo states."""


@dataclass(frozen=True, kw_only=True)
class ServoMonitor(BusOptions, JsonOption):
    """Watch position, velocity, current, voltage, temperature, torque and errors of the servos.

    Moves nothing. Runs until Ctrl-C, or for --count samples. With --json each sample is one JSON
    object on one line.

    Exit code 1: a servo did not answer in the last sample.
    """

    rate: SampleRate = 10.0
    count: Annotated[int | None, Parameter(metavar="N", validator=Number(gte=1))] = None
    """Number of samples. Default: until Ctrl-C."""

    def run(self, terminal: Terminal = QUIET) -> ServoMonitorReport:
        """Read and show one sample after the other."""
        from robot_ik.hardware.health import read_states  # NumPy

        config = load_arm(self.arm)
        states: Sequence[ServoState] = ()
        with open_servo_bus(self.bus, config) as bus, _display(terminal) as show:
            begin = bus.clock.now()
            for _ in Schedule(bus.clock).ticks(regular(self.rate, self.count)):
                states = read_states(bus, config.drives)
                show(round(bus.clock.now() - begin, 6), states)
        return ServoMonitorReport(states)


@dataclass(frozen=True, eq=False)
class ServoMonitorReport(Report):
    """The last sample. All samples were printed during the run."""

    streamed: ClassVar[bool] = True
    states: Sequence[ServoState]

    @property
    def ok(self) -> bool:
        return all(state.answered for state in self.states)

    def tables(self) -> Iterable[Table]:
        yield states_table(self.states)

    def facts(self) -> dict[str, Any]:
        return {"servos": [asdict(state) for state in self.states]}


def states_table(states: Iterable[ServoState]) -> Table:
    """Return one sample as a table."""
    return table(*COLUMNS, rows=map(_row, states))


@contextlib.contextmanager
def _display(terminal: Terminal) -> Iterator[Callable[[float, Sequence[ServoState]], None]]:
    """Yield a function that shows a sample: JSON lines, a table that is redrawn, or tables."""
    if terminal.json:
        yield lambda time, states: terminal.print_json_line(
            {
                "schema": ServoMonitorReport.SCHEMA,
                "time": time,
                "servos": [asdict(state) for state in states],
            }
        )
    elif terminal.quiet or not terminal.console.is_terminal:
        yield lambda _time, states: terminal.print(states_table(states))
    else:
        from rich.live import Live

        terminal.end_progress()
        with Live(console=terminal.console, auto_refresh=False) as live:
            yield lambda _time, states: live.update(states_table(states), refresh=True)


def _row(state: ServoState) -> tuple[object, ...]:
    if state.position_mm is not None or state.velocity_mm is not None:  # a slide
        position = _number(state.position_mm, " mm", 2)
        velocity = _number(state.velocity_mm, " mm/s", 1)
    else:
        position = _number(state.position_deg, "°", 2)
        velocity = _number(state.velocity_deg, " °/s", 1)
    effort = _number(state.current_ma, " mA", 0)
    if state.load_percent is not None:
        effort = _number(state.load_percent, " % load", 0)
    errors = ", ".join(state.errors) or ("none" if state.answered else "no answer")
    style = "bold red" if state.errors or not state.answered else "green"
    return (
        state.joint,
        state.id,
        position,
        velocity,
        effort,
        _number(state.voltage, " V", 1),
        _number(state.temperature, " C", 0),
        "-" if state.torque is None else "ON" if state.torque else "off",
        Text(errors, style=style),
    )


def _number(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value:z.{digits}f}{unit}"
