"""The pages of the methods: one for each row of ``SOLVERS``, with tables, picture, measurements."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from robot_ik import load_robot
from robot_ik.solvers import SOLVERS
from tests.doc_pages import ROOT, script

DOCS = ROOT / "docs"
METHODS = DOCS / "reference" / "solvers"
PLOTS = DOCS / "images" / "solvers"
HEADINGS = [
    "Formula and source",
    "Differences from the sources",
    "When to use it, and when not",
    "Convergence",
    "Options",
    "Solve rates",
]


@pytest.mark.parametrize("name", list(SOLVERS))
def test_every_method_has_a_page_with_its_tables_and_its_picture(name: str) -> None:
    page = METHODS / f"{name}.md"
    assert page.is_file(), (
        f"docs/reference/solvers/{name}.md is missing; the others show what it holds"
    )
    text = page.read_text(encoding="utf-8")
    assert text.startswith(f"# {name}: ")
    for table in ("method", "options", "floors"):
        assert f"<!-- table: {table} {name} -->\n" in text, (
            f"{page.name} has no table of its {table}"
        )
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert headings == HEADINGS
    picture = PLOTS / f"{name}.png"
    assert f"(../../images/solvers/{name}.png)" in text
    assert picture.is_file(), f"python docs/make/plots.py {name}"
    assert 3_000 < picture.stat().st_size < 40 * 1024
    overview = METHODS.with_suffix(".md").read_text(encoding="utf-8")
    assert f"(solvers/{name}.md)" in overview


def test_pages_and_pictures_are_of_existing_methods() -> None:
    assert {page.stem for page in METHODS.iterdir()} == set(SOLVERS)
    assert {picture.stem for picture in PLOTS.iterdir()} == set(SOLVERS)


def test_measured_tables_have_a_row_for_every_supporting_method() -> None:
    measure = script("measurements")
    found = {}
    for page in measure.PAGES:
        for place in measure.PLACE.finditer(page.read_text(encoding="utf-8")):
            found[place[2]] = re.findall(r"^\| \[`(\w+)`\]", place[3], re.MULTILINE)
    assert set(found) == set(measure.MEASURED)
    able = list(measure.methods())
    assert {"lm", "analytic"} <= set(able)
    assert found == {"convergence": list(SOLVERS), "targets": able, "path": able}, (
        "python docs/make/measurements.py"
    )


def test_poses_called_singular_are_singular() -> None:
    measure = script("measurements")
    robot = load_robot("puma560")
    for kind in ("wrist", "elbow", "both"):
        for q, start in measure.singular_cases(robot, kind, 5):
            sigma, beside = (np.linalg.svd(robot.jacobian(v), compute_uv=False) for v in (q, start))
            assert sigma[-1] < 1e-9, (kind, sigma)
            assert beside[-1] > 1e-6 and not robot.outside(q) and not robot.outside(start)


def test_a_picture_is_drawn_reproducibly(tmp_path: Path) -> None:
    pytest.importorskip(
        "matplotlib", reason="pictures need the extra: pip install 'robot-ik-testbed[plots]'"
    )
    plots = script("plots")
    for name in ("a", "b"):
        plots.draw("dls", tmp_path / f"{name}.png", count=3)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    few = plots.curves("lm", plots.TASKS[0], 3)
    assert few is not None and (few.steps > 0).all()
    for residual, steps in zip(few.residuals, few.steps, strict=True):
        assert len(residual) == steps + 1 and residual[-1] < 1e-5 < residual[0]
    assert plots.curves("triangulation", plots.TASKS[0], 3) is None  # no poses
