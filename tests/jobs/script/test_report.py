"""What a script leaves behind: JSON, and JUnit XML in the form of pytest's own."""

from __future__ import annotations

import re
from collections.abc import Callable
from xml.etree import ElementTree

import pytest

import robot_ik as rik
from robot_ik.jobs.script import (
    ScriptReport,
    json_report,
)
from robot_ik.jobs.script.report import junit_report
from robot_ik.jobs.script.state import StepResult

Run = Callable[..., ScriptReport]


def shape(root: ElementTree.Element) -> dict[str, set[str]]:
    """Element with its parent -> attributes."""
    found: dict[str, set[str]] = {root.tag: set(root.attrib)}
    for parent in root.iter():
        for child in parent:
            found.setdefault(f"{parent.tag}/{child.tag}", set()).update(child.attrib)
    return found


pytest_plugins = ["pytester"]


def test_junit_has_the_form_of_pytests_own(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        def test_good(record_testsuite_property):
            record_testsuite_property("bus", "sim")
            print("found")

        def test_bad():
            assert False

        def test_left_out():
            pytest.skip("not run")
        """
    )
    pytester.runpytest("--junitxml=own.xml", "-o", "junit_logging=system-out", "-p", "no:cacheprovider")
    own = shape(ElementTree.parse(pytester.path / "own.xml").getroot())
    steps = [
        StepResult("good", "wait", "passed", 0.5, "found"),
        StepResult("bad \x00 <&>", "expect", "failed", 0.1, 'not "it" ]]> \x1b'),
        StepResult("left out", "hold"),
    ]
    report = ScriptReport("trial", "trial.toml", "puma560", "sim", 3, True, steps, 0.6)
    root = ElementTree.fromstring(junit_report(report))
    ours = shape(root)
    for place, attributes in ours.items():
        known = own[place] | ({"type"} if place == "testcase/failure" else set())  # allowed by every schema
        assert attributes <= known, place
    suite = root[0]
    assert [suite.get(key) for key in ("tests", "failures", "errors", "skipped")] == ["3", "1", "0", "1"]
    assert [case.get("name") for case in suite.iter("testcase")] == ["01 good", "02 bad ? <&>", "03 left out"]
    failure = suite.find("testcase/failure")
    assert failure is not None and failure.text == 'not "it" ]]> ?'


def test_reports_tell_all(play: Run) -> None:
    report = play('[[steps]]\ndo = "wait"\nseconds = 0.25')
    said = json_report(report)
    assert said["schema"] == 1 and said["passed"] is True and said["seconds"] == 0.25
    assert [row["do"] for row in said["steps"]] == ["wait", "leave"]
    assert said["counters"]["cycles"] == 25
    assert re.search(r'time="0\.250000"', junit_report(report).decode())
    assert rik.load_robot("tabletop_puma").name == said["robot"]
