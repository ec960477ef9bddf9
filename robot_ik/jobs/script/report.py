"""What came out of a script: for people, as JSON, and as JUnit XML.

On virtual time nothing in it depends on the machine's speed: equal runs give equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree

from robot_ik.files import plain
from robot_ik.jobs.script.state import FAILED, NOT_RUN, PASSED, StepResult

SCHEMA = 1
"""Version of the JSON object; raised when a field changes its meaning."""


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
    suites, name = ElementTree.Element("testsuites"), f"robot_ik.{report.script}"

    def add(parent: ElementTree.Element, tag: str, **attributes: object) -> ElementTree.Element:
        clean = {key: _xml(str(value)) for key, value in attributes.items()}
        return ElementTree.SubElement(parent, tag, clean)

    failed, left_out = report.count(FAILED), report.count(NOT_RUN)
    suite = add(
        suites, "testsuite", name=name, tests=len(report.steps), failures=failed, errors=0, skipped=left_out,
        time=f"{report.seconds:.6f}",
    )  # fmt: skip
    properties = add(suite, "properties")
    for key in ("file", "robot", "bus", "seed"):
        add(properties, "property", name=key, value=getattr(report, key))
    for number, step in enumerate(report.steps, start=1):
        title = f"{number:02d} {step.name}"
        case = add(suite, "testcase", classname=name, name=title, time=f"{step.seconds:.6f}")
        if step.outcome == FAILED:
            add(case, "failure", message=step.found, type=step.do).text = _xml(step.found)
        elif step.outcome == NOT_RUN:
            add(case, "skipped", message="not run")
        elif step.found:
            add(case, "system-out").text = _xml(step.found)
    ElementTree.indent(suites)
    text: bytes = ElementTree.tostring(suites, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _xml(text: str) -> str:
    """Without the control characters that XML 1.0 cannot hold."""
    return "".join(c if c in "\t\n\r" or (c >= " " and c not in "\ufffe\uffff") else "?" for c in text)
