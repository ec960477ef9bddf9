"""Scripts that run: those that come along, the ways in which a step can fail, and equal runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.camera.latest_goals import LatestGoals
from robot_ik.errors import ConfigError
from robot_ik.hardware.limiter import SafetyLimiter
from robot_ik.jobs.script import (
    ScriptReport,
    json_report,
    load_script,
    run_script,
    shipped,
)
from robot_ik.jobs.script.report import junit_report
from robot_ik.jobs.script.run import ScriptRequest, ScriptRun

Run = Callable[..., ScriptReport]


def outcomes(report: ScriptReport) -> list[str]:
    return [step.outcome for step in report.steps]


def everything(report: ScriptReport) -> tuple[str, bytes, list[bytes]]:
    """All that a run leaves, bit for bit."""
    plans = [step.trajectory.q.tobytes() for step in report.steps if step.trajectory is not None]
    return str(json_report(report)), junit_report(report), plans


@pytest.mark.parametrize("name", shipped())
def test_scripts_that_come_along_pass_and_repeat_to_the_bit(name: str) -> None:
    assert len(shipped()) == 7
    first = run_script(load_script(shipped()[name]))
    assert first.passed, [step for step in first.steps if step.outcome != "passed"]
    if name == "tracking_marker":
        return  # seventy pictures: the next test repeats a few
    assert everything(first) == everything(run_script(load_script(shipped()[name])))


@pytest.mark.parametrize("name", shipped())
def test_which_scripts_a_real_arm_can_run(name: str) -> None:
    """What breaks nothing on purpose and asks nothing that only a simulation knows; no port is opened."""

    def prepare() -> None:
        ScriptRun(load_script(shipped()[name]), ScriptRequest(bus="/dev/none"))

    if name in ("out_of_reach", "pick_and_place"):
        prepare()
    else:
        with pytest.raises(ConfigError, match=r"--bus sim or pty|robot-ik reach"):
            prepare()


def test_looking_repeats_to_the_bit(play: Run) -> None:
    steps = """
[[steps]]
do = "marker"
tolerance_mm = 3.0
tolerance_deg = 2.0
"""
    head = "marker_at = [0.17, -0.04, 0.0, 190.0]"
    first, again = (play(steps, head, seed=3) for _ in range(2))
    assert first.passed, first.steps
    assert everything(first) == everything(again)
    assert 0.0 < first.steps[0].numbers["seen_off_mm"] < 3.0


def test_following_is_judged_by_the_marker_not_by_what_the_camera_made_of_it(
    play: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera that stopped: the arm is exactly at its goal, which is where the marker was."""

    class Stopped(LatestGoals):
        first: Any = None

        def poll(self, now: float) -> Any:
            self.first = self.first or super().poll(now)
            return self.first

    monkeypatch.setattr("robot_ik.jobs.vision.LatestGoals", Stopped)
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


def test_the_seed_counts(play: Run) -> None:
    noisy = """
[[steps]]
do = "inject"
kind = "drop"
value = 0.05
[[steps]]
do = "wait"
seconds = 0.5
"""
    runs = [play(noisy, seed=seed).counters["retries"] for seed in (1, 1, 2, 3)]
    assert runs[0] == runs[1] > 0
    assert len(set(runs)) > 1


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        (
            'do = "expect"\nkeyframe = "home"\njoints_deg = {joint1 = 5.0}',
            "joint1 5.00° off instead of at most",
        ),
        ('do = "expect"\nposition = [0.2, 0.0, 0.2]', "mm off instead of at most 2.00 mm"),
        ('do = "expect"\nstate = "fault"', "state enabled instead of fault"),
        ('do = "expect"\nerror = "HardwareError"', "no error instead of HardwareError"),
        ('do = "expect"\nstatus = "CONVERGED"', "solver not asked instead of CONVERGED"),
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
def test_a_step_that_fails_says_why_and_ends_the_run(steps: str, said: str, play: Run) -> None:
    report = play(f'[[steps]]\n{steps}\n[[steps]]\ndo = "hold"')
    assert outcomes(report) == ["failed", "not run", "passed"]
    assert said in report.steps[0].found and not report.steps[0].found.endswith("; ")
    assert not report.passed


def test_circle_and_hold(play: Run) -> None:
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


def test_grip_moves_the_joints_of_the_gripper_alone(tmp_path: Path) -> None:
    (tmp_path / "holder.xml").write_text(GRIPPER)
    (tmp_path / "robot.toml").write_text(
        'schema = 1\ntitle = "Holder"\nmodel = "holder.xml"\ntool = "tip"\n[groups]\n'
        'arm = ["waist"]\ngripper = ["jaw"]\n'
    )
    arm = 'schema = 1\nname = "holder"\nrobot = "holder.xml"\n'
    for id, (name, low, high) in enumerate([("waist", -120.0, 120.0), ("jaw", -10.0, 50.0)], start=1):
        arm += f'[[joints]]\nname = "{name}"\nid = {id}\nmodel = "XM430-W350"\nlower_deg = {low}\n'
        arm += f"upper_deg = {high}\nvelocity_deg = 90.0\nacceleration_deg = 360.0\n"
    (tmp_path / "arm.toml").write_text(arm)
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


def test_a_grip_tells_what_it_holds_and_fails_where_that_is_wrong(play: Run) -> None:
    report = play('[[steps]]\ndo = "grip"\nopening = 0.0\nheld = true')
    assert "0.0 mm, nothing is held" in report.steps[0].found and not report.passed
    report = play('[[steps]]\ndo = "grip"\nwidth_mm = 25.0\n[[steps]]\ndo = "expect"\nwidth_mm = 20.0')
    assert [step.outcome for step in report.steps[:2]] == ["passed", "failed"]
    assert report.steps[1].numbers["width_off_mm"] == pytest.approx(5.0, abs=0.2)
    look = '[[steps]]\ndo = "expect"\nobject = "block"\nposition = [0.19, 0.05, {z}]\ntolerance_mm = 1.0\n'
    report = play(look.format(z=0.015) + look.format(z=0.055), head=BLOCK)
    assert [step.outcome for step in report.steps[:2]] == ["passed", "failed"]
    assert report.steps[1].numbers["off_mm"] == pytest.approx(40.0, abs=0.5)


def test_physics_bends_the_arm_under_its_weight(play: Run) -> None:
    step = '[[steps]]\ndo = "joints"\njoints_deg = {joint2 = 30.0}\n[[steps]]\ndo = "wait"\nseconds = 0.2\n'
    look = '[[steps]]\ndo = "expect"\njoints_deg = {joint2 = 30.0}\nshafts = true\ntolerance_deg = 5.0\n'
    off = [
        play(step + look, head=f"physics = {physics}").steps[2].numbers["joint_off_deg"]
        for physics in ("false", "true")
    ]
    assert off[0] < 0.1 < off[1]


def test_the_same_script_in_process_and_on_a_wire(
    play: Run, monkeypatch: pytest.MonkeyPatch, real_time: None
) -> None:
    """Plans are equal to the bit; the limiter lets the same through wherever it does not intervene."""
    ticks: dict[bytes, tuple[np.ndarray, bool]] = {}
    step = SafetyLimiter.step

    def spied(self: SafetyLimiter, state: object, command: object, dt: float) -> object:
        made = step(self, state, command, dt)  # type: ignore[arg-type]
        commanded = np.asarray(command)[:6].tobytes()  # without the finger
        ticks.setdefault(commanded, (np.array(made[0].q), bool(made[1])))
        return made

    monkeypatch.setattr(SafetyLimiter, "step", spied)
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
    seen = []
    for bus in ("sim", "pty"):
        ticks.clear()
        report = play(steps, head="speed = 0.15", bus=bus)
        assert report.passed, report.steps
        seen.append((report, dict(ticks)))
    (sim, by_sim), (pty, by_pty) = seen
    agreed = planned = 0
    for one, other in zip(sim.steps[:3], pty.steps[:3], strict=True):
        assert one.trajectory is not None and other.trajectory is not None
        assert one.trajectory.q.tobytes() == other.trajectory.q.tobytes()
        assert one.trajectory.times.tobytes() == other.trajectory.times.tobytes()
        for q in one.trajectory.q:
            planned += 1
            here, there = by_sim.get(q.tobytes()), by_pty.get(q.tobytes())
            if here is None or there is None or here[1] or there[1]:
                continue
            np.testing.assert_allclose(here[0], there[0], rtol=0.0, atol=1e-9)
            agreed += 1
    assert not any(touched for _, touched in by_sim.values())  # in virtual time every tick is on time
    assert agreed > 0.3 * planned > 20, (agreed, planned)  # on a busy machine ticks are late and are capped
