"""``robot-ik doctor``: one table of what this machine can do, with what to do about the rest."""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass
from typing import Annotated

from rich.text import Text
from tyro.conf import arg

from robot_ik.catalogue import SERVO_ROBOT
from robot_ik.cli import checks, console, device_checks

#: Version of the JSON object; raised when a field changes its meaning.
SCHEMA = 1

CHECKS: list[checks.Check] = [
    checks.check_python,
    checks.check_packages,
    checks.check_mujoco,
    checks.check_opencv,
    checks.check_kernels,
    checks.check_user_gl,
    functools.partial(checks.check_gl, "egl"),
    functools.partial(checks.check_gl, "osmesa"),
    checks.check_display,
    device_checks.check_serial,
    device_checks.check_cameras,
    checks.check_terminal,
]

_STYLE = {checks.OK: "green", checks.NOTE: "yellow", checks.PROBLEM: "bold red"}


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
        from robot_ik.cli.servo_link import load_arm

        config = load_arm(options.arm)  # a wrong name is told at once
    with console.busy("looking at this machine"):
        rows = checks.run_checks(CHECKS)
    if config is not None:
        from robot_ik.cli.servo_checks import servo_rows

        with console.busy(f"asking the servos on {options.bus}"):
            rows += servo_rows(options.bus, config)
    problems = [row for row in rows if row.status == checks.PROBLEM]
    if options.json:
        console.print_json({"schema": SCHEMA, "ok": not problems, "rows": [asdict(row) for row in rows]})
    else:
        _print_table(rows, len(problems))
    return console.WRONG_INPUT if problems else console.DONE


def _print_table(rows: list[checks.Row], problems: int) -> None:
    screen = console.out()
    shown = console.table("what", "is", "found", "what to do")
    for row in rows:
        shown.add_row(
            Text(row.what), Text(row.status, style=_STYLE[row.status]), Text(row.found), Text(row.do)
        )
    screen.print(shown)
    verdict = "nothing required is broken" if not problems else f"{problems} problem(s): see what to do"
    screen.print(Text("\n" + verdict, style="green" if not problems else "bold red"))
