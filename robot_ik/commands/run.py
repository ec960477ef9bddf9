"""``robot-ik run``: run a scripted test on an arm, and report as table, JSON and JUnit XML."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.text import Text

from robot_ik.commands.options import (
    BUS_HELP,
    BUS_METAVAR,
    OUTPUT,
    OUTPUT_GROUP,
    ArmName,
    JsonOption,
    OverwriteOption,
    RecordFile,
    RobotName,
)
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from robot_ik.script import Script, ScriptReport

SERVO_LOG = "robot_ik.hardware"
"""Log of the servos."""

STYLES = {"passed": "green", "failed": "bold red", "not run": "dim"}
"""Style of each outcome of a step."""


@dataclass(frozen=True)
class Run(JsonOption, OverwriteOption):
    """Run a script of steps on an arm: motions, faults, and what must be true then.

    Without a script, the bundled scripts are listed. On simulated servos (sim) time is virtual:
    the run is as fast as the machine allows, and equal runs give equal reports. The same script
    runs behind a real pty and on your servos, where no fault can be injected.

        robot-ik run overload
        robot-ik run my_test.toml --bus /dev/ttyUSB0 --arm my_arm.toml --junit result.xml

    Exit code 1: a step failed. On Ctrl-C the report of the steps so far is written.
    """

    script: Annotated[str, Parameter(name="NAME|FILE")] = ""
    """Script, or name of a bundled one."""
    _: KW_ONLY
    bus: Annotated[
        str, Parameter(alias="--port", metavar=BUS_METAVAR, help=f"Servo bus. {BUS_HELP}.")
    ] = "sim"
    robot: RobotName = ""
    arm: ArmName = ""
    seed: Annotated[
        int | None,
        Parameter(
            metavar="N",
            help="Random seed. The same seed gives the same result. Default: the script's.",
        ),
    ] = None
    junit: Annotated[Path | None, Parameter(metavar="FILE.xml", group=OUTPUT_GROUP), OUTPUT] = None
    """Write the report as JUnit XML, for build servers."""
    record: RecordFile = None

    def run(self, terminal: Terminal = QUIET) -> RunReport | ScriptList:
        """Run the script, or list the bundled ones.

        Raises:
            RobotIkError: The script or the environment is wrong. No step was run.
        """
        from robot_ik.hardware import bus_row
        from robot_ik.script import ScriptRequest, ScriptRun, load_script, shipped

        if not self.script:
            if replace(self, json=False) != Run():
                hint = f"bundled scripts: {', '.join(shipped())}"
                raise OptionError("NAME|FILE", "no script is named", "a script", hint=hint)
            return ScriptList({name: load_script(file) for name, file in shipped().items()})
        script = load_script(self.script)
        arm = Path(self.arm) if self.arm else None
        request = ScriptRequest(self.bus, self.robot, arm, self.seed, self.record)
        run = ScriptRun(script, request)
        report = RunReport(run.report)
        # The script orders the faults of simulated servos, and the report shows them.
        quiet = silenced(SERVO_LOG) if bus_row(self.bus).virtual else contextlib.nullcontext()
        try:
            with quiet:
                run.run(terminal.progress)
        finally:
            if report.has_begun:  # an interrupted run writes its report, too
                self._write(report)
                terminal.show(report)
        return report

    def _write(self, report: RunReport) -> None:
        from robot_ik.files import write_atomically
        from robot_ik.script.report import junit_report

        if self.junit is not None:
            write_atomically(self.junit, junit_report(report.script))


@dataclass(frozen=True, eq=False)
class RunReport(Report):
    """The results of the steps."""

    script: ScriptReport

    @property
    def ok(self) -> bool:
        return self.script.passed

    @property
    def has_begun(self) -> bool:
        """Whether a step was run."""
        return self.script.count("not run") < len(self.script.steps)

    def tables(self) -> Iterable[Any]:
        report = self.script
        rows = []
        for number, step in enumerate(report.steps, start=1):
            seconds = "" if step.outcome == "not run" else f"{step.seconds:.2f}"
            outcome = Text(step.outcome, style=STYLES[step.outcome])
            rows.append((number, step.name, outcome, seconds, step.found))
        yield table("step", "what", "result", "s", "found", rows=rows)
        verdict = "interrupted" if report.interrupted else "PASSED" if report.passed else "FAILED"
        passed = f"{report.count('passed')} of {len(report.steps)} steps"
        time = f"{report.seconds:.2f} s of {'virtual ' if report.virtual_time else ''}time"
        arm = f"{report.robot} on {report.bus}, seed {report.seed}"
        style = "bold green" if report.passed else "bold red"
        yield Text(f"{report.script}: {verdict}  {passed}, {time}, {arm}", style=style)

    def facts(self) -> Mapping[str, Any]:
        from robot_ik.script import json_report

        return json_report(self.script)


@dataclass(frozen=True, eq=False)
class ScriptList(Report):
    """The bundled scripts."""

    scripts: Mapping[str, Script]

    def tables(self) -> Iterable[Any]:
        rows = [(name, script.about) for name, script in self.scripts.items()]
        yield table("script", "what it does", rows=rows)

    def facts(self) -> dict[str, Any]:
        rows = [{"name": name, "about": script.about} for name, script in self.scripts.items()]
        return {"scripts": rows}


@contextlib.contextmanager
def silenced(name: str) -> Iterator[None]:
    """Silence a log, unless everything is logged (``--debug``)."""
    log = logging.getLogger(name)
    before = log.level
    if not log.isEnabledFor(logging.DEBUG):
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)
