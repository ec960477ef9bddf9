"""S12's table: reachable targets, the parameters of the thesis, and parameters that reach all."""

from __future__ import annotations

import dataclasses
import importlib.util

import mujoco
import numpy as np
import pytest

from robot_ik.bench.theses import s12
from robot_ik.budget import Budget
from robot_ik.errors import MissingExtraError
from robot_ik.goals import PositionGoal
from robot_ik.problem import Problem
from robot_ik.theses import table_4_1

FEW = 15


@pytest.fixture(scope="module")
def report() -> s12.S12Report:
    return s12.run_s12(s12.S12Report(frames=FEW))


def test_lm_and_auto_reach_all_targets(report: s12.S12Report) -> None:
    assert report.passed, report.failures
    for case in table_4_1.CASES:
        for name in s12.MUST_PASS:
            assert report.tracks["best", name, case.number].solved == FEW


@pytest.mark.parametrize("case", table_4_1.CASES, ids=lambda case: case.title)
def test_witnesses_are_inside_the_limits_and_targets_move(case: table_4_1.ArmCase) -> None:
    arm = table_4_1.make_arm(case.limited)
    bends = [k for k, name in enumerate(arm.joints) if not name.endswith("twist")]
    assert np.all(arm.upper[bends] == (np.radians(45.0) if case.limited else np.inf))
    witnesses = s12.make_witnesses(arm, case, 1001 if case.curve else 40, 0)
    assert not any(arm.outside(q) for q in witnesses)
    points = np.array([arm.measure(q).position for q in witnesses[:: 10 if case.curve else 1]])
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if case.curve:
        np.testing.assert_allclose(points[-1], points[0], atol=1e-12)  # closed
        assert steps.min() > 0.1 and steps.max() < 1.0  # ten frames apart
        np.testing.assert_allclose(
            arm.measure(witnesses[100], "segment2").position, [0, 0, 1], atol=1e-12
        )
        # Segments 2 … 7, bent by 20° each: the closed form at the crossing of the wave.
        bends = np.radians(20.0) * np.arange(1, 7)
        assert points[0, 2] == pytest.approx(1.0 + np.cos(bends).sum())
        assert np.hypot(*points[0, :2]) == pytest.approx(np.sin(bends).sum())
    else:
        assert np.median(steps) > 1.0


@pytest.mark.parametrize(
    ("name", "case"), [(n, c) for n in table_4_1.METHODS[1:] for c in (table_4_1.CASES[1],)]
)
def test_a_step_with_the_parameters_of_the_thesis_equals_its_formula(
    name: str, case: table_4_1.ArmCase
) -> None:
    """One step of each Jacobian method against the formulas of the thesis, by NumPy and MuJoCo."""
    arm = table_4_1.make_arm(case.limited)
    rng = np.random.default_rng(8)
    q = arm.sample(rng)
    target = arm.measure(arm.sample(rng)).position
    goal = PositionGoal("tip", target)
    problem = Problem(
        arm,
        goal,
        solver=s12.make_method("same", name),
        tolerance=s12.TOLERANCE,
        budget=Budget(iterations=1, restarts=0),
    )
    step = problem.solve(q).q - q
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_comPos(arm.model, data)
    jacobian = np.zeros((3, arm.model.nv))
    # The point of the last segment that is at the target now: t in place of s.
    mujoco.mj_jac(arm.model, data, jacobian, None, target, arm.model.body("segment7").id)
    e = target - arm.measure(q).position
    if name == "transpose":
        jje = jacobian @ jacobian.T @ e
        wanted = (e @ jje) / (jje @ jje) * jacobian.T @ e
    elif name == "pseudoinverse":
        wanted = np.linalg.pinv(jacobian) @ e
    else:
        wanted = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1.1**2 * np.eye(3), e)
    wanted = 0.01 * wanted
    assert abs(wanted).max() < np.pi / 16.0  # so that the cap of dls is not at work
    np.testing.assert_allclose(step, wanted, rtol=1e-6, atol=1e-12)


def test_the_parameters_of_the_thesis_allow_no_restarts(report: s12.S12Report) -> None:
    for (variant, name, number), track in report.tracks.items():
        if variant != "best":
            assert track.iterations <= table_4_1.ITERATIONS and track.restarts == 0, (
                variant,
                name,
                number,
            )
    # α as the share of a step leaves 37 % of the way after 100 steps, so random targets are missed.
    assert report.tracks["same", "pseudoinverse", 2].share < 0.2
    assert report.tracks["degrees", "pseudoinverse", 2].share > 0.8
    sweeps = report.tracks["same", "ccd", 2]
    assert table_4_1.iterations_of("ccd", 3.0) == 21.0
    assert s12.s12_cells(report)["same", "ccd", 2]["n"] == 7 * sweeps.iterations


def test_the_table_of_the_thesis_is_complete(report: s12.S12Report) -> None:
    cells = s12.s12_cells(report)
    assert sum(column == "S12" for column, _, _ in cells) == 16
    assert cells["S12", "pseudoinverse", 4] == {"milliseconds": 51.9, "n": 88, "solved": 0.29}


def test_summary_and_picture(report: s12.S12Report) -> None:
    pytest.importorskip("matplotlib")
    summary = s12.s12_summary(report)
    assert summary["passed"] and len(summary["cases"]) == 4
    assert len(summary["tracks"]) == 16 + len(report.tracks) == 16 + 4 * (4 + 3 + 6)
    picture = s12.s12_picture(report)
    assert picture.startswith(b"\x89PNG") and len(picture) > 20_000


def test_without_matplotlib_the_picture_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="plots"):
        s12.s12_picture(s12.S12Report())


def test_one_missed_target_fails_the_report(report: s12.S12Report) -> None:
    worse = dict(report.tracks)
    worse["best", "lm", 4] = dataclasses.replace(worse["best", "lm", 4], solved=FEW - 1)
    assert dataclasses.replace(report, tracks=worse).failures == [("lm", 4)]
    assert not dataclasses.replace(report, tracks=worse).passed
    worse = dict(report.tracks)  # a method that is only reported may miss
    worse["best", "ccd", 4] = dataclasses.replace(worse["best", "ccd", 4], solved=0)
    assert dataclasses.replace(report, tracks=worse).passed


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(3))
def test_the_whole_table(seed: int) -> None:
    found = s12.run_s12(s12.S12Report(seed=seed))
    assert found.passed, found.failures
