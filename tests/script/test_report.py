"""Reports of scripts as JSON, and as JUnit XML with the elements that pytest writes."""

from __future__ import annotations

import re
from collections.abc import Callable
from xml.etree import ElementTree

import pytest

import robot_ik as rik
from robot_ik.script import ScriptReport, json_report
from robot_ik.script.report import junit_report
from robot_ik.script.state import StepResult

Run = Callable[..., ScriptReport]


def shape(root: ElementTree.Element) -> dict[str, set[str]]:
    """Return the names of the attributes by parent and element."""
    attributes: dict[str, set[str]] = {root.tag: set(root.attrib)}
    for parent in root.iter():
        for child in parent:
            place = f"{parent.tag}/{child.tag}"
            attributes.setdefault(place, set()).update(child.attrib)
    return attributes


pytest_plugins = ["pytester"]


def test_junit_has_the_elements_of_pytest(pytester: pytest.Pytester) -> None:
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
    options = ("-o", "junit_logging=system-out", "-p", "no:cacheprovider")
    pytester.runpytest("--junitxml=pytest.xml", *options)
    reference = shape(ElementTree.parse(pytester.path / "pytest.xml").getroot())

    steps = [
        StepResult("good", "wait", "passed", 0.5, "found"),
        StepResult("bad \x00 <&>", "expect", "failed", 0.1, 'not "it" ]]> \x1b'),
        StepResult("left out", "hold"),
    ]
    report = ScriptReport("trial", "trial.toml", "puma560", "sim", 3, True, steps, 0.6)
    root = ElementTree.fromstring(junit_report(report))

    # All schemas of JUnit XML allow the type of a failure. Pytest leaves it out.
    reference["testcase/failure"].add("type")
    for place, attributes in shape(root).items():
        assert attributes <= reference[place], place

    suite = root[0]
    counts = [suite.get(key) for key in ("tests", "failures", "errors", "skipped")]
    assert counts == ["3", "1", "0", "1"]
    names = [case.get("name") for case in suite.iter("testcase")]
    assert names == ["01 good", "02 bad ? <&>", "03 left out"]
    failure = suite.find("testcase/failure")
    assert failure is not None
    assert failure.text == 'not "it" ]]> ?'


def test_reports_contain_steps_seconds_and_counters(play: Run) -> None:
    report = play('[[steps]]\ndo = "wait"\nseconds = 0.25')
    facts = json_report(report)
    assert facts["schema"] == 1
    assert facts["passed"] is True
    assert facts["seconds"] == 0.25
    assert [row["do"] for row in facts["steps"]] == ["wait", "leave"]
    assert facts["counters"]["cycles"] == 25
    assert re.search(r'time="0\.250000"', junit_report(report).decode())
    assert rik.load_robot("tabletop_puma").name == facts["robot"]
