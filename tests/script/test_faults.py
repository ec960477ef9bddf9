"""Scripts that inject faults: their effect, their begin and their end, and the recovery."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from robot_ik.script import ScriptReport

Run = Callable[..., ScriptReport]


def outcomes(report: ScriptReport) -> list[str]:
    return [step.outcome for step in report.steps]


def test_only_the_true_shaft_position_shows_a_slipped_shaft(play: Run) -> None:
    steps = """
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
    report = play(steps)
    assert outcomes(report)[:3] == ["passed", "passed", "failed"]
    # The belt of 1.5:1 turns the joint by 2 degrees for 3 degrees of the servo.
    assert report.steps[2].numbers["joint_off_deg"] == pytest.approx(2.0, abs=0.1)


def test_a_move_with_a_stuck_joint_fails_at_its_time_limit(play: Run) -> None:
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


def test_a_fault_begins_after_in_s_and_ends_after_for_s(play: Run) -> None:
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
    # The first fault ended by itself.
    assert report.steps[5].numbers["cleared"] == 1


def test_a_fault_cleared_before_its_begin_has_no_effect(play: Run) -> None:
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
    assert "torque may be ON" in report.steps[-1].found
    assert not report.passed


def test_recover_fails_without_a_fault(play: Run) -> None:
    report = play('[[steps]]\ndo = "recover"')
    assert "there is no fault" in report.steps[0].found


def test_recover_fails_while_the_cause_persists(play: Run) -> None:
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
