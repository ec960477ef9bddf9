"""The report of a script, as JSON and as JUnit XML.

On virtual time the report does not depend on the speed of the machine: equal runs give equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree

from robot_ik.files import plain
from robot_ik.script.state import FAILED, NOT_RUN, PASSED, StepResult

#: Version of the JSON object. It is raised when a field changes its meaning.
SCHEMA = 1
#: Attributes of a report that the JSON object contains, in this order.
REPORT_KEYS = (
    "script",
    "file",
    "robot",
    "bus",
    "seed",
    "passed",
    "interrupted",
    "virtual_time",
    "seconds",
    "counters",
)
#: Attributes of a step that the JSON object contains, in this order.
STEP_KEYS = ("name", "do", "outcome", "seconds", "found", "numbers")


@dataclass
class ScriptReport:
    """The result of one run of a script.

    Attributes:
        script: Name of the script.
        file: File of the script.
        robot: Name of the robot.
        bus: ``sim``, ``pty`` or a serial port.
        seed: Random seed of the run.
        virtual_time: Whether the seconds are those of the simulation.
        steps: One result for each step, and a last one for leaving the arm.
        seconds: Time from the first step to the last on the run's clock.
        counters: Counters of the bus during the steps, without connecting and leaving.
        interrupted: Whether an exception or a signal ended the run early.
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
        """Whether all steps passed."""
        return all(step.outcome == PASSED for step in self.steps)

    def count(self, outcome: str) -> int:
        """Return the number of steps with an outcome."""
        return sum(step.outcome == outcome for step in self.steps)


def json_report(report: ScriptReport) -> Mapping[str, Any]:
    """Return the report as an object that JSON can hold."""
    facts: dict[str, Any] = plain({key: getattr(report, key) for key in REPORT_KEYS})
    rows = [plain({key: getattr(step, key) for key in STEP_KEYS}) for step in report.steps]
    facts["steps"] = rows
    for row in (facts, *rows):
        row["seconds"] = round(row["seconds"], 6)
    return {"schema": SCHEMA, **facts}


def junit_report(report: ScriptReport) -> bytes:
    """Return the report as JUnit XML with one test case for each step.

    The dialect is that of pytest and Jenkins. Host and time of day are left out, because they
    differ between equal runs.
    """
    root = ElementTree.Element("testsuites")
    name = f"robot_ik.{report.script}"
    suite = _add_element(
        root,
        "testsuite",
        name=name,
        tests=len(report.steps),
        failures=report.count(FAILED),
        errors=0,
        skipped=report.count(NOT_RUN),
        time=f"{report.seconds:.6f}",
    )

    properties = _add_element(suite, "properties")
    for key in ("file", "robot", "bus", "seed"):
        _add_element(properties, "property", name=key, value=getattr(report, key))

    for number, step in enumerate(report.steps, start=1):
        title = f"{number:02d} {step.name}"
        seconds = f"{step.seconds:.6f}"
        case = _add_element(suite, "testcase", classname=name, name=title, time=seconds)
        if step.outcome == FAILED:
            failure = _add_element(case, "failure", message=step.found, type=step.do)
            failure.text = _valid_xml(step.found)
        elif step.outcome == NOT_RUN:
            _add_element(case, "skipped", message="not run")
        elif step.found:
            _add_element(case, "system-out").text = _valid_xml(step.found)

    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _add_element(
    parent: ElementTree.Element, tag: str, **attributes: object
) -> ElementTree.Element:
    """Append an element to ``parent`` and return it."""
    valid = {key: _valid_xml(str(value)) for key, value in attributes.items()}
    return ElementTree.SubElement(parent, tag, valid)


def _valid_xml(text: str) -> str:
    """Return the text with a question mark for each character that XML 1.0 cannot hold."""
    return "".join(character if _is_valid(character) else "?" for character in text)


def _is_valid(character: str) -> bool:
    return character in "\t\n\r" or (character >= " " and character not in "\ufffe\uffff")
