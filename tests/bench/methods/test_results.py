"""Results of a run: consistent numbers, a file that is read back, and pictures."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_ik.bench.methods.plots import draw
from robot_ik.bench.methods.results import Cell, Results
from robot_ik.errors import MissingExtraError
from robot_ik.files import json_text


def cell(results: Results, solver: str, robot: str, name: str) -> Cell:
    (found,) = [c for c in results.cells if (c.solver, c.robot, c.set) == (solver, robot, name)]
    return found


def test_the_file_is_read_back_equal(results: Results) -> None:
    assert results.complete and len(results.cells) == 3 * 2 * 3
    assert Results.model_validate_json(json_text(results.model_dump(mode="json"))) == results


def test_numbers_of_a_cell_are_consistent(results: Results) -> None:
    for one in results.cells:
        lists = (
            one.success,
            one.position_error,
            one.angle_error,
            one.iterations,
            one.restarts,
            one.status,
        )
        assert {len(x) for x in lists} == {one.count}
        assert bool(one.skipped) != bool(one.count)
        assert all(t > 0 for t in one.microseconds)
        if one.count:
            assert min(one.microseconds) <= one.microsecond("median") <= one.microsecond(99.0)
    for solver in ("analytic", "lm"):
        puma = cell(results, solver, "puma560", "cold")
        assert puma.rate == 1.0 and puma.goal == "pose" and max(puma.position_error) <= 1e-4
    bones = cell(results, "triangulation", "puma560", "cold")
    assert bones.goal == "position" and not any(bones.angle_error)
    assert "panda" in cell(results, "analytic", "panda", "cold").skipped
    far = cell(results, "lm", "puma560", "unreachable")
    assert far.rate == 0.0 and set(far.status) == {"UNREACHABLE"} and min(far.position_error) > 1e-3
    warm = cell(results, "lm", "puma560", "warm")
    assert warm.rate == 1.0 and warm.jumps == 0 and 0 < warm.largest_step < 0.2


def test_errors_of_curves_fall(results: Results) -> None:
    curves = {(c.solver, c.robot): c for c in results.curves}
    assert ("analytic", "puma560") not in curves  # a formula has no steps
    lm = curves["lm", "puma560"].error
    assert lm[0] > 1e-2 and lm[-1] <= 1e-4


def test_plots_have_coloured_lines(folder: Path) -> None:
    names = {file.name for file in folder.glob("*.png")}
    assert names == {
        f"{kind}-{robot}.png"
        for kind in ("success", "convergence")
        for robot in ("puma560", "panda")
    }
    for name in names:
        picture = cv2.imread(str(folder / name))
        assert min(picture.shape[:2]) > 300
        colourful = np.ptp(picture.astype(int), axis=2) > 60  # lines; axes and letters are grey
        assert colourful.sum() > 500


def test_growth_is_drawn(results: Results) -> None:
    from robot_ik.bench.methods.results import Growth

    points = [
        Growth(solver="lm", across=across, size=n, step_us=float(n))
        for across in ("joints", "goals")
        for n in (1, 2, 4)
    ]
    pictures = draw(results.model_copy(update={"growth": points, "cells": [], "curves": []}))
    assert list(pictures) == ["growth.png"]
    picture = cv2.imdecode(np.frombuffer(pictures["growth.png"], np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and (np.ptp(picture.astype(int), axis=2) > 60).sum() > 300


def test_without_matplotlib_the_error_has_the_install_command(
    results: Results, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"robot-ik-testbed\[plots\]"):
        draw(results)


def test_the_kernels_grow() -> None:
    from robot_ik.bench.methods import growth
    from robot_ik.robot import load_robot

    bound = growth.lower_bound(load_robot("puma560"))
    assert bound.joints == 6 and 0.0 < bound.forward_us < 50.0 and bound.jacobian_us > 0.0
    chain = growth.hinge_chain(9)
    assert chain.nv == 9 and chain.forward(chain.home).position == pytest.approx((0, 0, 2.0))
