"""``robot-ik run``: a scripted test run, and its report as table, JSON and JUnit XML."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.text import Text
from tyro.conf import Positional

from robot_ik.cli import console
from robot_ik.cli.arguments import Overwrite, RecordFile, robot_argument, single, wrong
from robot_ik.cli.connection import bus_argument
from robot_ik.jobs.results import claimed

if TYPE_CHECKING:
    from robot_ik.jobs.script import Script, ScriptReport

_SERVOS = "robot_ik.hardware"  # their log
_STYLE = {"passed": "green", "failed": "bold red", "not run": "dim"}


@dataclass(frozen=True)
class RunOptions:
    """Runs a script of steps on an arm: moves, waits, faults, and what must be true then.

    On simulated servos (sim) time is virtual: as fast as the machine allows, and equal runs give equal
    reports. The same script runs behind a real pty (pty) and on your servos (a port); there nothing can be
    broken on purpose. Without a script: those that come along.

    Exit code 0: every step passed. 1: one failed. 2: wrong script or environment. 130: interrupted.
    """

    script: Positional[Annotated[str, single("[FILE.toml|NAME]")]] = ""
    """The script, or the name of one that comes along."""
    bus: Annotated[str, bus_argument()] = "sim"
    robot: Annotated[str, robot_argument("the script's")] = ""
    arm: Annotated[Path | None, single("FILE|NAME", "the script's")] = None
    """Servo ids, signs, zeros and limits: a file, or a robot's."""
    seed: Annotated[int | None, single("N", "the script's")] = None
    """Of random faults, of restarts and of the synthetic camera's noise."""
    junit: Annotated[Path | None, single("FILE", "none")] = None
    """Write the report as JUnit XML, for build servers."""
    json: Annotated[Path | None, single("FILE|-", "none")] = None
    """Write the report as JSON; with - it goes to stdout instead of the table."""
    record: RecordFile = None
    overwrite: Overwrite = False


def run(options: RunOptions) -> int:
    """Runs the script; 0 passed, 1 not."""
    from robot_ik.jobs.script import load_script, shipped

    if not options.script:
        if options != RunOptions():
            hint = f"scripts that come along: {', '.join(shipped())}"
            raise wrong("FILE.toml|NAME", "no script is named, so nothing was run", "a script", hint)
        rows = [(name, load_script(file).about) for name, file in shipped().items()]
        console.show(console.table("script", "what it does", rows=rows))
        return console.DONE
    script = load_script(options.script)
    files = [file for file in (options.junit, options.json) if str(file) != "-"]
    if files[0] is not None and len(files) == 2 and files[0] == files[1]:
        raise wrong("--json", f"{files[0]} is the file of --junit, too", "a name of its own")
    with claimed(*files, options.record, overwrite=options.overwrite):
        return _run(script, options)


def _run(script: Script, options: RunOptions) -> int:
    from robot_ik.hardware import bus_row
    from robot_ik.jobs.script import ScriptRequest, ScriptRun

    this = ScriptRun(
        script, ScriptRequest(options.bus, options.robot, options.arm, options.seed, options.record)
    )
    # What simulated servos complain of was ordered, and the report says it.
    told = not bus_row(options.bus).virtual or logging.getLogger(_SERVOS).isEnabledFor(logging.DEBUG)
    try:
        with console.progress() as bar, console.log_levels({} if told else {_SERVOS: logging.CRITICAL}):
            this.run(console.shares_on(bar, script.name))
    finally:
        if this.report.count("not run") < len(this.report.steps):  # an interrupted run leaves its report, too
            _report(this.report, options)
    return console.DONE if this.report.passed else console.NOT_ACHIEVED


def _report(report: ScriptReport, options: RunOptions) -> None:
    from robot_ik.files import write_atomically
    from robot_ik.jobs.results import save_json
    from robot_ik.jobs.script import json_report
    from robot_ik.jobs.script.report import junit_report

    if options.junit is not None:
        write_atomically(options.junit, junit_report(report))
    if str(options.json) == "-":
        console.print_json(json_report(report))
        return
    if options.json is not None:
        save_json(options.json, json_report(report))
    rows = [
        (
            number, step.name, Text(step.outcome, style=_STYLE[step.outcome]),
            "" if step.outcome == "not run" else f"{step.seconds:.2f}", step.found,
        )
        for number, step in enumerate(report.steps, start=1)
    ]  # fmt: skip
    console.show(console.table("step", "what", "result", "s", "found", rows=rows))
    kind = "virtual " if report.virtual_time else ""
    verdict = "interrupted" if report.interrupted else "PASSED" if report.passed else "FAILED"
    console.result(
        f"{report.script}: {verdict}  {report.count('passed')} of {len(report.steps)} steps, "
        f"{report.seconds:.2f} s of {kind}time, {report.robot} on {report.bus}, seed {report.seed}",
        "bold green" if report.passed else "bold red",
    )
