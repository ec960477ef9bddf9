"""The pages about the camera agree with docs/camera.json, and each figure is in one place."""

from __future__ import annotations

import importlib.util
import json
import re
import types
from pathlib import Path

import pytest

from benchmarks.camera.accuracy import latency
from benchmarks.camera.rows import Effort

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(scope="module")
def pages() -> types.ModuleType:
    spec = importlib.util.spec_from_file_location(
        "camera_figures", DOCS / "make" / "camera_figures.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pages_contain_the_measured_values(pages: types.ModuleType) -> None:
    used = set()
    for page in pages.PAGES:
        text = page.read_text(encoding="utf-8")
        problem = f"{page.name} is out of date: python -m docs.make.camera_figures"
        assert pages.filled(text) == text, problem
        used |= {m[2] for m in pages.PLACE.finditer(text)}
    assert used == set(pages.TABLES)


def test_the_overlays_error_is_only_in_the_generated_tables(pages: types.ModuleType) -> None:
    for page in pages.PAGES:
        reported = pages.PLACE.sub("", page.read_text(encoding="utf-8"))
        assert not re.search(r"\b0\.\d+ px\b.*(overlay|robot on a board)", reported), page.name
        assert not re.search(r"(overlay|robot on a board).*\b0\.\d+ px\b", reported), page.name


def test_rows_that_were_not_measured_are_named_on_the_page(pages: types.ModuleType) -> None:
    data = json.loads((DOCS / "camera.json").read_text(encoding="utf-8"))
    page = (DOCS / "reference" / "camera_accuracy.md").read_text(encoding="utf-8")
    for row in pages.ROWS:
        if row.name not in data["rows"]:
            assert f"| **{row.about}** | not measured | |" in page


@pytest.mark.soak  # it measures the rows again
def test_the_remedies_are_the_current_ones() -> None:
    data = json.loads((DOCS / "camera.json").read_text(encoding="utf-8"))
    reported = {
        figure["quantity"]: figure["value"] for figure in data["rows"]["latency"]["figures"]
    }
    found = {quantity.quantity: quantity.value for quantity in latency(Effort())}
    assert list(found) == list(reported)
    assert list(found.values()) == pytest.approx(list(reported.values()), rel=0.02, abs=0.02)
