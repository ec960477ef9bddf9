"""What came out of a script: for people, as JSON, and as JUnit XML.

On virtual time nothing in it depends on the machine's speed: equal runs give equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree

from robot_ik.files import plain
from robot_ik.motion.trajectory import Trajectory

PASSED, FAILED, NOT_RUN = "passed", "failed", "not run"

SCHEMA = 1
"""Version of the JSON object; raised when a field changes its meaning."""


@dataclass
class StepResult:
    """One step, as it went.

    Attributes:
        outcome: ``passed``, ``failed`` or ``not run``.
        seconds: On the run's clock.
        found: One line: what was measured, or what went wrong; ``numbers``: the same for programs.
        trajectory: What was planned; None where nothing was.
    """

    name: str
    do: str
    outcome: str = NOT_RUN
    seconds: float = 0.0
    found: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)
    trajectory: Trajectory | None = field(default=None, repr=False)


@dataclass
class ScriptReport:
    """One run of a script.

    Attributes:
        virtual_time: Seconds are those of the simulation.
        steps: One row a step, and a last one: how the arm was left.
        seconds: On the run's clock, from the first step to the last.
        counters: Of the bus, connecting and leaving not counted.
        interrupted: Somebody ended it early.
    """

    script: str
    file: str
    robot: str
    bus: str
    seed: int
    virtual_time: bool
    steps: list[StepResult]
    seconds: float = 0.0
    counters: dict[str, int] = field(default_factory=dict)
    interrupted: bool = False

    @property
    def passed(self) -> bool:
        return all(step.outcome == PASSED for step in self.steps)

    def count(self, outcome: str) -> int:
        return sum(step.outcome == outcome for step in self.steps)


def json_report(report: ScriptReport) -> Mapping[str, Any]:
    """The report as JSON can hold it."""
    keys = ("script", "file", "robot", "bus", "seed", "passed", "interrupted", "virtual_time", "seconds")
    of_step = ("name", "do", "outcome", "seconds", "found", "numbers")
    found: dict[str, Any] = plain({key: getattr(report, key) for key in (*keys, "counters")})
    found["steps"] = [plain({key: getattr(step, key) for key in of_step}) for step in report.steps]
    for row in (found, *found["steps"]):
        row["seconds"] = round(row["seconds"], 6)
    return {"schema": SCHEMA, **found}


def junit_report(report: ScriptReport) -> bytes:
    """The report as JUnit XML (the dialect of pytest and Jenkins): a suite of one test case a step.

    Without host and time of day, which would make equal runs unequal.
    """
    suites = ElementTree.Element("testsuites")
    suite = ElementTree.SubElement(
        suites,
        "testsuite",
        name=_xml(f"robot_ik.{report.script}"),
        tests=str(len(report.steps)),
        failures=str(report.count(FAILED)),
        errors="0",
        skipped=str(report.count(NOT_RUN)),
        time=f"{report.seconds:.6f}",
    )
    properties = ElementTree.SubElement(suite, "properties")
    for key in ("file", "robot", "bus", "seed"):
        ElementTree.SubElement(properties, "property", name=key, value=_xml(str(getattr(report, key))))
    for number, step in enumerate(report.steps, start=1):
        case = ElementTree.SubElement(
            suite,
            "testcase",
            classname=_xml(f"robot_ik.{report.script}"),
            name=_xml(f"{number:02d} {step.name}"),
            time=f"{step.seconds:.6f}",
        )
        if step.outcome == FAILED:
            failure = ElementTree.SubElement(case, "failure", message=_xml(step.found), type=step.do)
            failure.text = _xml(step.found)
        elif step.outcome == NOT_RUN:
            ElementTree.SubElement(case, "skipped", message="not run")
        elif step.found:
            ElementTree.SubElement(case, "system-out").text = _xml(step.found)
    ElementTree.indent(suites)
    text: bytes = ElementTree.tostring(suites, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _xml(text: str) -> str:
    """Without the control characters that XML 1.0 cannot hold."""
    return "".join(c if c in "\t\n\r" or (c >= " " and c not in "\ufffe\uffff") else "?" for c in text)
