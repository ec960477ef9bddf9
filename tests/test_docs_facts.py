"""What the documentation states, held to the program: tables, the first screen, the map of the packages."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from robot_ik.cli import main as cli

# The helpers lie beside this file; they are nobody's package.
_spec = importlib.util.spec_from_file_location("doc_pages", Path(__file__).with_name("doc_pages.py"))
assert _spec is not None and _spec.loader is not None
pages: Any = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = pages  # dataclasses look it up
_spec.loader.exec_module(pages)
ROOT, PAGES, blocks, prose, named, script = (
    pages.ROOT,
    pages.PAGES,
    pages.blocks,
    pages.prose,
    pages.named,
    pages.script,
)


# ------------------------------------------------------------------------- tables from the program


def test_tables_are_what_the_program_says() -> None:
    tables = script("tables")
    used = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        used |= {m[2] for m in tables.PLACE.finditer(text)}
        assert tables.filled(text) == text, f"{named(page)} is out of date: python docs/make/tables.py"
    assert used == set(tables.TABLES)


# -------------------------------------------------------------------------------- the first screen


def test_the_first_screen_has_one_picture_and_two_commands() -> None:
    page = ROOT / "README.md"
    head = "\n".join(page.read_text(encoding="utf-8").splitlines()[:30])
    assert re.findall(r"^make [\w-]+", head, re.MULTILINE) == ["make reach", "make test"]
    (picture,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", head)
    assert 20_000 < (ROOT / picture).stat().st_size < 400 * 1024


def test_make_reach_prints_what_the_readme_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = [block for block in blocks(ROOT / "README.md") if block.text.startswith("reach ")]
    assert cli.main(["reach", "--out", str(tmp_path / "run")]) == 0
    printed = capsys.readouterr().out

    def labels(text: str) -> list[str]:
        return [m[0].strip() for m in re.finditer(r"^[a-z][\w ]*?(?=  )", text, re.MULTILINE)]

    wanted = labels(shown.text)
    assert wanted == labels(printed[printed.index("reach ") :])
    assert {"goal", "solver", "read back", "camera", "result"} <= set(wanted)
    # What the camera sees does not depend on the machine, but for rounding.
    for line in (r"^marker 7 .*", r"^ +true at .*", r"^goal .*"):
        one, other = (re.findall(r"-?\d+\.\d+", re.findall(line, t, re.M)[0]) for t in (shown.text, printed))
        assert [float(x) for x in one] == pytest.approx([float(x) for x in other], abs=0.11), line
    # Both of the picture's captions and the files are named.
    assert {p.name for p in (tmp_path / "run").iterdir()} == {"reach.png", "trajectory.csv", "summary.json"}


def test_the_keys_of_the_summary_are_those_of_the_page(tmp_path: Path) -> None:
    assert cli.main(["reach", "--bus", "sim", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    page = prose(ROOT / "docs" / "start" / "reach.md")
    rows = re.findall(r"^\| `([\w.]+)`", page[page.index("## summary.json") :], re.MULTILINE)
    reported = {row.split(".")[0] for row in rows}
    assert reported == set(summary)
    for row in rows:
        if "." in row:
            first, second = row.split(".")
            assert second in summary[first], row


def test_contributors_are_told_every_target_of_make() -> None:
    (phony,) = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    reported = set(re.findall(r"`make ([\w-]+)", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")))
    assert set(phony.split()) - {"FORCE", "help", "reach", "clean"} == reported


# ------------------------------------------------------------------------------------- the site


def test_the_api_page_lists_every_public_name() -> None:
    import robot_ik as rik

    page = (ROOT / "docs" / "reference" / "api.rst").read_text(encoding="utf-8")
    listed = re.findall(r"^\.\. auto(?:class|function|data|exception):: (\w+)$", page, re.MULTILINE)
    assert sorted(listed) == sorted(name for name in rik.__all__ if name != "__version__")
    for module, name in re.findall(r"^\.\. auto\w+:: (robot_ik\.[\w.]+)\.(\w+)$", page, re.MULTILINE):
        assert hasattr(importlib.import_module(module), name), f"{module}.{name}"


# ------------------------------------------------------------------------------- the architecture


@pytest.mark.parametrize(
    ("contract_id", "package", "first"),
    [
        ("layers", "", "cli"),
        ("camera-layers", "robot_ik.camera.", "synthetic.datasets"),
        ("hardware-layers", "robot_ik.hardware.", "health"),
    ],
)
def test_the_layers_drawn_are_the_layers_checked(contract_id: str, package: str, first: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    (contract,) = [c for c in project["tool"]["importlinter"]["contracts"] if c["id"] == contract_id]
    (drawn,) = [b for b in blocks(ROOT / "docs" / "architecture.md") if b.text.startswith(first)]
    lines = [line.split("   ")[0] for line in drawn.text.splitlines()]
    drawn_names = [re.findall(r"[\w.]+", line) for line in lines]
    here = {p.stem for p in (ROOT / "robot_ik").iterdir()} | {"hardware", "models"}
    checked = [
        [name.removeprefix(package) for name in re.findall(r"[\w.]+", line) if package or name in here]
        for line in contract["layers"]
    ]
    assert drawn_names == [names for names in checked if names and names != ["__main__"]]


def test_every_package_and_page_is_on_the_map() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (tree,) = [b.text for b in blocks(ROOT / "README.md") if b.text.startswith("robot_ik/")]
    reported = set(re.findall(r"[\w.]+/|\w+\.py", tree))
    packages = {p.parent.name + "/" for p in (ROOT / "robot_ik").glob("*/__init__.py")}
    folders = {"robot_ik/", "hardware/", "models/", "tests/", "examples/", "docs/"}
    assert packages | folders <= reported, sorted((packages | folders) - reported)
    here = {p.name for p in (ROOT / "robot_ik").iterdir()} | {p.name for p in ROOT.iterdir()}
    here |= {p.name for p in (ROOT / "hardware").iterdir()}
    assert {name.rstrip("/") for name in reported} <= here, sorted(reported)
    index = ROOT / "docs" / "index.md"
    assert "(docs/index.md)" in readme
    listed = {
        (index.parent / link).resolve()
        for link in re.findall(r"^\* \[.*?\]\((\S+)\)", prose(index), re.MULTILINE)
    }
    methods = ROOT / "docs" / "reference" / "solvers"  # their overview leads to them
    for page in (page for page in PAGES[1:] if page.parent != methods):
        assert page == index or page in listed, f"docs/index.md does not lead to {named(page)}"
