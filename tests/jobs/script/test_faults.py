"""Scripts and faults: what slips, sticks, goes away and comes back."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from robot_ik.jobs.script import (
    ScriptReport,
)

Run = Callable[..., ScriptReport]


def outcomes(report: ScriptReport) -> list[str]:
    return [step.outcome for step in report.steps]


def test_a_shaft_that_slips_is_seen_only_by_its_true_place(play: Run) -> None:
    slipped = """
[[steps]]
do = "inject"
kind = "zero_offset"
joint = "joint2"
value = 3.0
[[steps]]
do = "expect"
keyframe = "home"
[[steps]]
do = "expect"
keyframe = "home"
shafts = true
"""
    report = play(slipped)
    assert outcomes(report)[:3] == ["passed", "passed", "failed"]
    # 3 degrees of the servo are 2 of the joint, behind its belt of 1.5:1
    assert report.steps[2].numbers["joint_off_deg"] == pytest.approx(2.0, abs=0.1)


def test_a_stuck_joint_ends_the_move_in_time(play: Run) -> None:
    report = play("""
[[steps]]
do = "inject"
kind = "stuck"
joint = "joint1"
[[steps]]
do = "joints"
joints_deg = {joint1 = 6.0}
time_limit_s = 1.5
""")
    assert outcomes(report)[:2] == ["passed", "failed"]
    assert "not arrived: joint1 6.0" in report.steps[1].found
    assert report.steps[1].seconds == pytest.approx(1.5, abs=0.011)


def test_a_fault_comes_when_it_should_and_goes_when_it_should(play: Run) -> None:
    report = play("""
[[steps]]
do = "inject"
kind = "silent"
joint = "joint3"
in_s = 0.2
for_s = 0.05
[[steps]]
do = "wait"
seconds = 0.5
[[steps]]
do = "inject"
kind = "silent"
joint = "joint3"
in_s = 0.2
[[steps]]
do = "wait"
seconds = 1.0
raises = "MotorFaultError"
[[steps]]
do = "expect"
joint = "joint3"
cause = "no_status"
step_seconds = [0.2, 0.45]
[[steps]]
do = "clear"
kind = "silent"
""")
    assert report.passed, report.steps
    assert report.counters["timeouts"] > 0
    assert report.steps[5].numbers["cleared"] == 1  # the first has gone by itself


def test_a_fault_that_is_cleared_before_its_time_does_not_come(play: Run) -> None:
    report = play("""
[[steps]]
do = "inject"
kind = "overload"
in_s = 0.2
[[steps]]
do = "clear"
[[steps]]
do = "wait"
seconds = 0.5
""")
    assert report.passed


def test_an_arm_that_cannot_be_left_safely_fails_the_run(play: Run) -> None:
    report = play('[[steps]]\ndo = "inject"\nkind = "port_unplugged"')
    assert outcomes(report) == ["passed", "failed"]
    assert "torque may be ON" in report.steps[-1].found and not report.passed


def test_recovering_needs_a_fault_and_its_cause_gone(play: Run) -> None:
    assert "there is no fault" in play('[[steps]]\ndo = "recover"').steps[0].found
    report = play("""
[[steps]]
do = "inject"
kind = "supply"
value = 3.0
[[steps]]
do = "wait"
seconds = 0.1
raises = "HardwareError"
[[steps]]
do = "recover"
""")
    assert outcomes(report)[:3] == ["passed", "passed", "failed"]
    assert "Error: " in report.steps[2].found
