"""Our contestant, loaded the way the side-by-side harness loads contestants."""

from __future__ import annotations

import importlib
import pkgutil
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from robot_ik.bench import contestant
from robot_ik.bench.judge import Judge
from robot_ik.bench.plain_model import plain_mjcf
from robot_ik.bench.problems import make_set
from robot_ik.robot import load_robot

# What the harness's contestants/base.py says of a contestant.
BASE = """
class Contestant:
    name = about = settings = ""
    dists = ()
    tol_pos, tol_ori = 1e-6, 1e-6
    n_solutions = None
    def fk(self, q):
        return None
"""


@pytest.fixture
def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """Name -> class, found as the harness's ``discover`` finds them."""
    folder = tmp_path / "contestants"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "base.py").write_text(BASE, encoding="utf-8")
    shutil.copy(contestant.__file__, folder / "robot_ik_contestant.py")
    monkeypatch.syspath_prepend(str(tmp_path))
    package = importlib.import_module("contestants")
    base = importlib.import_module("contestants.base").Contestant
    classes = {}
    for module in pkgutil.iter_modules(package.__path__):
        if module.name != "base":
            loaded = importlib.import_module(f"contestants.{module.name}")
            for one in vars(loaded).values():
                mine = isinstance(one, type) and issubclass(one, base)
                if mine and one.name and one.__module__ == loaded.__name__:
                    classes[one.name] = one
    yield classes
    for name in [name for name in sys.modules if name.partition(".")[0] == "contestants"]:
        del sys.modules[name]


def test_contestants_are_found_and_solve(found: dict[str, Any]) -> None:
    assert set(found) == {"robot_ik", "robot_ik_lm", "robot_ik_analytic"}
    arm = load_robot("puma560")
    problems, judge = make_set("cold", arm, 20), Judge(arm)
    theirs = SimpleNamespace(name="puma560", mjcf=lambda: plain_mjcf(arm, {"ee": arm.tool}))
    for kind in found.values():
        one = kind()
        assert one.setup(theirs) is not False
        for target in problems.targets:
            q = one.solve(target.copy(), arm.home.copy())
            metres, radians = judge.miss(q, target)
            assert metres <= 1e-6 and radians <= 1e-6 and judge.inside(q)
        np.testing.assert_allclose(one.fk(arm.home), judge.pose(arm.home), atol=1e-12)


def test_four_goals_are_met_at_once(tmp_path: Path) -> None:
    figure = load_robot("humanoid")
    limbs = ("left_hand", "right_hand", "left_foot", "right_foot")
    sites = dict(zip(contestant.FourGoals.sites(), limbs, strict=True))
    (tmp_path / "model.xml").write_text(plain_mjcf(figure, sites), encoding="utf-8")
    one = contestant.FourGoals()
    one.setup(SimpleNamespace(work=str(tmp_path)))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data, rng = mujoco.MjData(model), np.random.default_rng(2)

    def hands_and_feet(q: np.ndarray) -> np.ndarray:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        return np.array([data.site(name).xpos for name in sites])

    for _ in range(5):
        wanted = hands_and_feet(figure.clip(figure.home + 0.4 * (figure.sample(rng) - figure.home)))
        q = one.solve(wanted, figure.home.copy())
        assert np.linalg.norm(hands_and_feet(q) - wanted, axis=1).max() <= 1e-4
        assert figure.outside(q) == [] and one.it > 0
