"""The notebooks run, and their stored outputs are those of their cells."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from tests.doc_pages import ROOT, script

pytest.importorskip("matplotlib", reason="needs the extra plots")
pytest.importorskip("viser", reason="needs the extra web")
notebooks = script("notebooks")

FILES = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def kinds(content: dict[str, Any]) -> list[list[str]]:
    """Return the MIME types that each cell shows."""
    cells = []
    for cell in content["cells"]:
        shown = []
        for output in cell.get("outputs", ()):
            shown += list(output["data"]) if "data" in output else [output["name"]]
        cells.append(shown)
    return cells


def test_there_are_two() -> None:
    assert [file.stem for file in FILES] == ["compare_methods", "solve_and_look"]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_notebook_runs_and_shows_its_stored_output(file: Path) -> None:
    stored = json.loads(file.read_text(encoding="utf-8"))
    fresh = copy.deepcopy(stored)
    namespace = notebooks.run_notebook(fresh, file.stem)
    assert kinds(fresh) == kinds(stored), "run: python docs/make/notebooks.py"
    assert sum("image/png" in shown for shown in kinds(fresh)) >= 1
    assert '<iframe src="http://127.0.0.1:' in namespace["page"]._repr_html_()


def test_the_last_expression_of_a_cell_is_its_value() -> None:
    namespace: dict[str, Any] = {}
    assert notebooks.run_cell("x = 2\nprint('two')\nx + 1", "cell", namespace) == ("two\n", 3)
    assert notebooks.run_cell("y = x", "cell", namespace) == ("", None)


def test_a_failing_cell_ends_the_run() -> None:
    cell = {"cell_type": "code", "metadata": {}, "source": ["1 / 0"]}
    with pytest.raises(ZeroDivisionError):
        notebooks.run_notebook({"cells": [cell]}, "wrong")
