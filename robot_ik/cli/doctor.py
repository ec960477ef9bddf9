"""``robot-ik doctor``: one table of what this machine can do, with what to do about the rest."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

from rich.text import Text
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.environment import NOTE, OK, PROBLEM, CheckRow
from robot_ik.jobs import doctor
from robot_ik.robot_file import SERVO_ROBOT

#: Version of the JSON object; raised when a field changes its meaning.
SCHEMA = 1
_STYLE = {OK: "green", NOTE: "yellow", PROBLEM: "bold red"}


@dataclass(frozen=True)
class DoctorOptions:
    """Looks at this machine: versions, OpenGL, display, serial ports, cameras; with --bus at servos, too.

    Takes a few seconds, moves nothing, opens no serial port but that of --bus. OpenGL, the display and the
    cameras are tried in child processes. Exit code 0 when everything that robot_ik needs works, else 2;
    notes are about things that you may never need.
    """

    bus: Annotated[str, arg(metavar="PORT", help_behavior_hint="(default: none)")] = ""
    """Also ask the servos on this port: who is missing or doubled, firmware, supply, errors, delays."""
    arm: Annotated[str, arg(metavar="FILE|NAME")] = SERVO_ROBOT
    """For --bus: which servos should be there (an arm file, or a robot that has one)."""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(options: DoctorOptions) -> int:
    """Prints the report; 0 when nothing required is broken, else 2."""
    config = None
    if options.bus:
        from robot_ik.cli.connection import load_arm

        config = load_arm(options.arm)  # a wrong name is reported at once
    with console.busy("looking at this machine"):
        rows = doctor.run_checks(doctor.CHECKS)
    if config is not None:
        from robot_ik.hardware.health import servo_rows

        with console.busy(f"asking the servos on {options.bus}"):
            rows += servo_rows(options.bus, config)
    problems = [row for row in rows if row.status == PROBLEM]
    if options.json:
        console.print_json({"schema": SCHEMA, "ok": not problems, "rows": [asdict(row) for row in rows]})
    else:
        _print_table(rows, len(problems))
    return console.WRONG_INPUT if problems else console.DONE


def _print_table(rows: list[CheckRow], problems: int) -> None:
    screen = console.out()
    shown = console.table("what", "is", "found", "what to do")
    for row in rows:
        shown.add_row(
            Text(row.what), Text(row.status, style=_STYLE[row.status]), Text(row.found), Text(row.do)
        )
    screen.print(shown)
    verdict = "nothing required is broken" if not problems else f"{problems} problem(s): see what to do"
    screen.print(Text("\n" + verdict, style="green" if not problems else "bold red"))
