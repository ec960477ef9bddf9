"""Runs of scripts: the bundled scripts, the failures of steps, and the equality of runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.camera.latest_goals import LatestGoals
from robot_ik.errors import ConfigError
from robot_ik.hardware.limiter import SafetyLimiter
from robot_ik.script import (
    ScriptReport,
    ScriptRequest,
    ScriptRun,
    json_report,
    load_script,
    run_script,
    shipped,
)
from robot_ik.script.report import junit_report

Run = Callable[..., ScriptReport]


def outcomes(report: ScriptReport) -> list[str]:
    return [step.outcome for step in report.steps]


def results(report: ScriptReport) -> tuple[str, bytes, list[bytes]]:
    """Return the JSON report, the JUnit report and the planned joint values of a run."""
    plans = [step.trajectory.q.tobytes() for step in report.steps if step.trajectory is not None]
    return str(json_report(report)), junit_report(report), plans


@pytest.mark.parametrize("name", shipped())
def test_bundled_scripts_pass_and_repeat_to_the_bit(name: str) -> None:
    assert len(shipped()) == 7
    first = run_script(load_script(shipped()[name]))
    assert first.passed, [step for step in first.steps if step.outcome != "passed"]
    if name == "tracking_marker":
        # This script renders seventy pictures. Another test repeats a shorter one.
        return
    second = run_script(load_script(shipped()[name]))
    assert results(first) == results(second)


@pytest.mark.parametrize("name", shipped())
def test_only_scripts_without_simulated_steps_are_accepted_on_a_real_port(name: str) -> None:
    """The check opens no port."""

    def prepare() -> None:
        ScriptRun(load_script(shipped()[name]), ScriptRequest(bus="/dev/none"))

    if name in ("out_of_reach", "pick_and_place"):
        prepare()
    else:
        with pytest.raises(ConfigError, match=r"--bus sim or pty|robot-ik reach"):
            prepare()


def test_a_script_with_a_camera_repeats_to_the_bit(play: Run) -> None:
    steps = """
[[steps]]
do = "marker"
tolerance_mm = 3.0
tolerance_deg = 2.0
"""
    head = "marker_at = [0.17, -0.04, 0.0, 190.0]"
    first = play(steps, head, seed=3)
    second = play(steps, head, seed=3)
    assert first.passed, first.steps
    assert results(first) == results(second)
    assert 0.0 < first.steps[0].numbers["seen_off_mm"] < 3.0


def test_follow_measures_the_error_to_the_true_marker(
    play: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a camera that stopped, the arm is at its goal, but the marker has moved on."""

    class StoppedCamera(LatestGoals):
        first: Any = None

        def poll(self, now: float) -> Any:
            self.first = self.first or super().poll(now)
            return self.first

    monkeypatch.setattr("robot_ik.workcell.vision.LatestGoals", StoppedCamera)
    steps = """
[[steps]]
do = "marker"
tolerance_mm = 3.0
tolerance_deg = 2.0
[[steps]]
do = "follow"
path = "marker"
seconds = 4.0
"""
    report = play(steps, "marker_at = [0.17, -0.04, 0.0, 190.0]", seed=3)
    assert outcomes(report) == ["passed", "failed", "passed"], report.steps
    assert "lost the goal" in report.steps[1].found
    assert report.steps[1].numbers["behind_worst_mm"] > 15.0


def test_the_seed_determines_the_random_faults(play: Run) -> None:
    steps = """
[[steps]]
do = "inject"
kind = "drop"
value = 0.05
[[steps]]
do = "wait"
seconds = 0.5
"""
    retries = [play(steps, seed=seed).counters["retries"] for seed in (1, 1, 2, 3)]
    assert retries[0] == retries[1] > 0
    assert len(set(retries)) > 1


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        (
            'do = "expect"\nkeyframe = "home"\njoints_deg = {joint1 = 5.0}',
            "joint1 5.00° off instead of at most",
        ),
        ('do = "expect"\nposition = [0.2, 0.0, 0.2]', "mm off instead of at most 2.00 mm"),
        ('do = "expect"\nstate = "fault"', "state enabled instead of fault"),
        ('do = "expect"\nerror = "HardwareError"', "no error instead of HardwareError"),
        ('do = "expect"\nstatus = "CONVERGED"', "solver not run instead of CONVERGED"),
        ('do = "expect"\nrun_seconds = [1.0, 2.0]', "run 0.000 s instead of 1 … 2 s"),
        ('do = "position"\nposition = [0.9, 0.0, 0.2]', "NotConvergedError"),
        ('do = "wait"\nseconds = 0.1\nraises = "MotorFaultError"', "no error came"),
        ('do = "joints"\njoints_deg = {joint1 = 90.0}\ntime_limit_s = 0.2', "nothing was sent"),
        ('do = "wait"\nseconds = 0.5\ntime_limit_s = 0.2', "took 0.50 s, allowed 0.20 s"),
        (
            'do = "position"\nposition = [0.9, 0.0, 0.2]\nraises = "MotorFaultError"',
            "(MotorFaultError was expected)",
        ),
    ],
)
def test_a_failed_step_reports_the_reason_and_ends_the_run(
    steps: str, message: str, play: Run
) -> None:
    report = play(f'[[steps]]\n{steps}\n[[steps]]\ndo = "hold"')
    assert outcomes(report) == ["failed", "not run", "passed"]
    assert message in report.steps[0].found
    assert not report.steps[0].found.endswith("; ")
    assert not report.passed


def test_follow_a_circle_then_hold_then_move(play: Run) -> None:
    report = play("""
[[steps]]
do = "position"
position = [0.19, 0.0, 0.15]
[[steps]]
do = "follow"
path = "circle"
seconds = 1.5
center = [0.17, 0.0, 0.15]
radius = 0.02
period = 3.0
catch_up_s = 0.5
tolerance_mm = 6.0
[[steps]]
do = "hold"
[[steps]]
do = "expect"
state = "hold"
status = "CONVERGED"
[[steps]]
do = "line"
by = [0.0, 0.0, 0.02]
""")
    assert report.passed, report.steps
    assert report.steps[1].numbers["ticks"] == 150
    assert report.steps[1].numbers["behind_worst_mm"] > 0.01


GRIPPER = """
<mujoco model="holder"><worldbody>
<body name="turn" pos="0 0 .1"><joint name="waist" axis="0 0 1" range="-120 120"/>
 <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/>
<body name="jaw" pos=".2 0 0"><joint name="jaw" axis="0 0 1" range="-10 50"/>
 <geom type="capsule" fromto="0 0 0 .05 0 0" size=".01"/></body>
<site name="tip" pos=".25 0 0"/></body></worldbody></mujoco>
"""
GRIPPER_ARM = """
schema = 1
name = "holder"
robot = "holder.xml"
[[joints]]
name = "waist"
id = 1
model = "XM430-W350"
lower_deg = -120.0
upper_deg = 120.0
velocity_deg = 90.0
acceleration_deg = 360.0
[[joints]]
name = "jaw"
id = 2
model = "XM430-W350"
lower_deg = -10.0
upper_deg = 50.0
velocity_deg = 90.0
acceleration_deg = 360.0
"""


def test_grip_moves_only_the_joints_of_the_gripper(tmp_path: Path) -> None:
    (tmp_path / "holder.xml").write_text(GRIPPER)
    (tmp_path / "robot.toml").write_text(
        'schema = 1\ntitle = "Holder"\nmodel = "holder.xml"\ntool = "tip"\n[groups]\n'
        'arm = ["waist"]\ngripper = ["jaw"]\n'
    )
    (tmp_path / "arm.toml").write_text(GRIPPER_ARM)
    (tmp_path / "grip.toml").write_text("""
schema = 1
name = "grip"
robot = "holder.xml"
[[steps]]
do = "grip"
opening = 0.75
[[steps]]
do = "expect"
joints_deg = { jaw = 35.0, waist = 0.0 }
tolerance_deg = 0.2
[[steps]]
do = "position"
position = [0.0, 0.25, 0.1]
[[steps]]
do = "expect"
joints_deg = { jaw = 35.0, waist = 90.0 }
""")
    report = run_script(load_script(tmp_path / "grip.toml"))
    assert report.passed, report.steps


BLOCK = """physics = true
[[objects]]
name = "block"
position = [0.19, 0.05, 0.015]
size_mm = [20.0, 20.0, 30.0]
"""


def test_grip_fails_if_it_holds_nothing(play: Run) -> None:
    report = play("""
[[steps]]
do = "grip"
opening = 0.0
held = true
""")
    assert "0.0 mm, nothing is held" in report.steps[0].found
    assert not report.passed


def test_expect_measures_the_width_between_the_fingers(play: Run) -> None:
    report = play("""
[[steps]]
do = "grip"
width_mm = 25.0
[[steps]]
do = "expect"
width_mm = 20.0
""")
    assert outcomes(report)[:2] == ["passed", "failed"]
    assert report.steps[1].numbers["width_off_mm"] == pytest.approx(5.0, abs=0.2)


def test_expect_measures_the_position_of_an_object(play: Run) -> None:
    steps = """
[[steps]]
do = "expect"
object = "block"
position = [0.19, 0.05, 0.015]
tolerance_mm = 1.0
[[steps]]
do = "expect"
object = "block"
position = [0.19, 0.05, 0.055]
tolerance_mm = 1.0
"""
    report = play(steps, head=BLOCK)
    assert outcomes(report)[:2] == ["passed", "failed"]
    assert report.steps[1].numbers["off_mm"] == pytest.approx(40.0, abs=0.5)


def test_physics_bends_the_arm_under_its_weight(play: Run) -> None:
    steps = """
[[steps]]
do = "joints"
joints_deg = {joint2 = 30.0}
[[steps]]
do = "wait"
seconds = 0.2
[[steps]]
do = "expect"
joints_deg = {joint2 = 30.0}
shafts = true
tolerance_deg = 5.0
"""
    rigid = play(steps, head="physics = false").steps[2].numbers["joint_off_deg"]
    bent = play(steps, head="physics = true").steps[2].numbers["joint_off_deg"]
    assert rigid < 0.1 < bent


def test_a_script_sends_the_same_commands_in_process_and_on_a_pty(
    play: Run, monkeypatch: pytest.MonkeyPatch, real_time: None
) -> None:
    """Plans are equal to the bit, and commands that the limiter does not change to 1e-9 rad."""
    # Limited joint values and whether the limiter changed them, by the commanded joint values.
    ticks: dict[bytes, tuple[np.ndarray, bool]] = {}
    step = SafetyLimiter.step

    def recorded_step(self: SafetyLimiter, state: object, command: object, dt: float) -> object:
        limited = step(self, state, command, dt)  # type: ignore[arg-type]
        # The trajectory has six joints. The finger is an auxiliary servo.
        commanded = np.asarray(command)[:6].tobytes()
        ticks.setdefault(commanded, (np.array(limited[0].q), bool(limited[1])))
        return limited

    monkeypatch.setattr(SafetyLimiter, "step", recorded_step)
    steps = """
[[steps]]
do = "joints"
joints_deg = {joint1 = 4.0, joint3 = -160.0}
[[steps]]
do = "position"
position = [0.16, -0.03, 0.13]
[[steps]]
do = "line"
by = [0.0, 0.0, 0.015]
"""

    def run_on(bus: str) -> tuple[ScriptReport, dict[bytes, tuple[np.ndarray, bool]]]:
        ticks.clear()
        report = play(steps, head="speed = 0.15", bus=bus)
        assert report.passed, report.steps
        return report, dict(ticks)

    sim, sim_ticks = run_on("sim")
    pty, pty_ticks = run_on("pty")

    agreed = 0
    planned = 0
    for sim_step, pty_step in zip(sim.steps[:3], pty.steps[:3], strict=True):
        assert sim_step.trajectory is not None
        assert pty_step.trajectory is not None
        assert sim_step.trajectory.q.tobytes() == pty_step.trajectory.q.tobytes()
        assert sim_step.trajectory.times.tobytes() == pty_step.trajectory.times.tobytes()
        for q in sim_step.trajectory.q:
            planned += 1
            sim_tick = sim_ticks.get(q.tobytes())
            pty_tick = pty_ticks.get(q.tobytes())
            if sim_tick is None or pty_tick is None or sim_tick[1] or pty_tick[1]:
                continue
            np.testing.assert_allclose(sim_tick[0], pty_tick[0], rtol=0.0, atol=1e-9)
            agreed += 1

    # In virtual time no tick is late, so the limiter changes no command.
    assert not any(was_limited for _, was_limited in sim_ticks.values())
    # On a busy machine ticks of the pty are late, and the limiter changes their commands.
    assert agreed > 0.3 * planned > 20, (agreed, planned)
