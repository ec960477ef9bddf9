"""The performance pages have the numbers of docs/performance.json."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

from robot_ik.commands.main import parse_command

DOCS = Path(__file__).parents[2] / "docs"


def test_tables_equal_the_measurements() -> None:
    spec = importlib.util.spec_from_file_location("performance", DOCS / "make" / "performance.py")
    assert spec is not None and spec.loader is not None
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    data = json.loads((DOCS / "performance.json").read_text(encoding="utf-8"))
    text = ""
    for page in pages.PAGES:
        there = page.read_text(encoding="utf-8")
        assert pages.filled(there, data) == there, (
            f"{page.name} is out of date: python docs/make/performance.py"
        )
        text += there
    assert {m[2] for m in pages.PLACE.finditer(text)} == set(pages.TABLES)
    for name in pages.PICTURES.values():
        assert f"(../images/{name})" in text and (DOCS / "images" / name).is_file()


def test_the_commands_that_measure_the_page_are_commands() -> None:
    spec = importlib.util.spec_from_file_location(
        "measure_performance", DOCS / "make" / "measure_performance.py"
    )
    assert spec is not None and spec.loader is not None
    measure = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(measure)
    for arguments in measure.BENCHES.values():
        name, _ = parse_command([*arguments.split(), "--overwrite", "--out", "results"])
        assert name == "bench"
