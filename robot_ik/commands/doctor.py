"""``robot-ik doctor``: check the parts that robot_ik needs on this machine, and advise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.text import Text

from robot_ik.commands.arms import load_arm, open_port
from robot_ik.commands.options import BUS_HELP, BUS_METAVAR, ArmName, JsonOption
from robot_ik.commands.tables import plural, table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.hardware.checks import NOTE, OK, PROBLEM

if TYPE_CHECKING:
    from robot_ik.hardware.checks import CheckRow

STYLES = {OK: "green", NOTE: "yellow", PROBLEM: "bold red"}
"""Style of each status."""


@dataclass(frozen=True, kw_only=True)
class Doctor(JsonOption):
    """Check this machine: versions, OpenGL, display, serial ports and cameras.

    The checks take some seconds. Nothing moves. No serial port is opened except that of --bus.
    OpenGL, the display and the cameras are tried in child processes.

    Exit code 2: a part that robot_ik needs does not work. Notes concern parts that you may not
    need.
    """

    bus: Annotated[
        str,
        Parameter(
            alias="--port",
            metavar=BUS_METAVAR,
            help=f"Servo bus. {BUS_HELP}. Default: none; no servo is checked.",
        ),
    ] = ""
    arm: ArmName = "tabletop_puma"

    def run(self, terminal: Terminal = QUIET) -> DoctorReport:
        """Run all checks."""
        from robot_ik.commands.doctor_checks import CHECKS, run_checks

        # An unknown name is reported before the checks.
        config = load_arm(self.arm) if self.bus else None
        with terminal.busy("checking this machine"):
            rows = run_checks(CHECKS)
        if config is not None:
            from robot_ik.hardware.health import servo_rows

            busy = terminal.busy(f"checking the servos on {self.bus}")
            with busy, open_port(self.bus, self.arm) as port:
                rows += servo_rows(port, config)
        return DoctorReport(rows)


@dataclass(frozen=True, eq=False)
class DoctorReport(Report):
    """The results of the checks."""

    rows: Sequence[CheckRow]

    @property
    def problems(self) -> int:
        """Number of parts that robot_ik needs and that do not work."""
        return sum(row.status == PROBLEM for row in self.rows)

    @property
    def ok(self) -> bool:
        return not self.problems

    @property
    def exit_code(self) -> int:
        return 0 if self.ok else 2  # the environment is wrong

    def tables(self) -> Iterable[Any]:
        cells = [
            (row.what, Text(row.status, style=STYLES[row.status]), row.found, row.do)
            for row in self.rows
        ]
        yield table("what", "is", "found", "what to do", rows=cells)
        if self.ok:
            yield Text("\nnothing required is broken", style="green")
        else:
            yield Text(f"\n{plural(self.problems, 'problem')}: see what to do", style="bold red")

    def facts(self) -> dict[str, Any]:
        return {"ok": self.ok, "rows": [asdict(row) for row in self.rows]}
