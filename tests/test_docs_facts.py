"""Facts of the documentation against the program: tables, first screen, map of the packages."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.util
import json
import re
import tomllib
from pathlib import Path

import pytest
from PIL import Image

from robot_ik.commands import main as cli
from tests.doc_pages import PAGES, ROOT, blocks, named, prose, script

#: Suffixes of files that may contain an install line.
TEXTS = {".py", ".md", ".toml", ".rst", ".yml", ".txt"}


def test_tables_equal_those_of_the_program() -> None:
    tables = script("tables")
    used = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        used |= {m[2] for m in tables.PLACE.finditer(text)}
        assert tables.filled(text) == text, (
            f"{named(page)} is out of date: python docs/make/tables.py"
        )
    assert used == set(tables.TABLES)


# The first screen


FOLD = "\n## More\n"
#: Most words of the README above the fold.
FOLD_WORDS = 450
#: Largest moving picture that a page may load, bytes.
MOVING_PICTURE_BYTES = 3_000_000
#: The opening phrase of the project, with its full stop.
TAGLINE = "Inverse kinematics for robot arms in Python, from camera to servo."


def test_the_first_screen_has_one_picture_and_the_first_commands() -> None:
    head, fold, _ = (ROOT / "README.md").read_text(encoding="utf-8").partition(FOLD)
    assert fold
    assert len(head.split()) <= FOLD_WORDS
    commands = re.findall(r"^(?:make|robot-ik) [\w-]+", head, re.MULTILINE)
    assert commands == ["make reach", "robot-ik view"]
    (picture,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", head)
    assert 20_000 < (ROOT / picture).stat().st_size < MOVING_PICTURE_BYTES
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert picture.removeprefix("docs/") in index
    with Image.open(ROOT / picture) as film:
        assert film.n_frames >= 30


def test_the_tagline_is_the_same_everywhere(capsys: pytest.CaptureFixture[str]) -> None:
    import robot_ik as rik

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert cli.main(["--help"]) == 0
    described = {
        "README.md": (ROOT / "README.md").read_text(encoding="utf-8").splitlines()[2],
        "docs/index.md": (ROOT / "docs" / "index.md").read_text(encoding="utf-8").splitlines()[2],
        "pyproject.toml": project["description"],
        "robot-ik --help": capsys.readouterr().out.splitlines()[2],
        "robot_ik": (rik.__doc__ or "").splitlines()[0],
    }
    assert set(described.values()) == {TAGLINE}, described


def test_the_numbers_of_the_readme_are_those_of_the_tables() -> None:
    from robot_ik.hardware.virtual.faults import FAULTS

    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    head = " ".join(readme.partition(FOLD)[0].split())
    comparison = (ROOT / "docs" / "reference" / "comparison.md").read_text(encoding="utf-8")
    pattern = r"^\| cold PUMA 560, any method: mean \|.*? `robot_ik` ([\d.]+) \| ([\d.]+) \|$"
    ((mean, ratio),) = re.findall(pattern, comparison, re.MULTILINE)
    assert f"takes {mean} µs on average, {ratio} of the time" in head
    pattern = r"^\| out of reach, closed form: median \|.*? `robot_ik_analytic` ([\d.]+) \|"
    (proof,) = re.findall(pattern, comparison, re.MULTILINE)
    assert f"a median of {proof} µs" in head
    assert f"{len(FAULTS)} kinds of faults" in head
    markers = r"^\| a 50 mm marker at 0\.3 / 0\.6 / 1\.0 m, RMS \| [\d.]+ / ([\d.]+) / "
    (middle,) = re.findall(markers, readme, re.MULTILINE)
    assert f"{middle} mm RMS for a 50 mm marker at 0.6 m" in head


def test_the_output_of_make_reach_equals_that_of_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], real_time: None
) -> None:
    page = ROOT / "docs" / "reference" / "reach.md"
    (shown,) = [block for block in blocks(page) if block.text.startswith("reach ")]
    assert cli.main(["reach", "--out", str(tmp_path / "run")]) == 0
    printed = capsys.readouterr().out

    def labels(text: str) -> list[str]:
        return [m[0].strip() for m in re.finditer(r"^[a-z][\w ]*?(?=  )", text, re.MULTILINE)]

    def numbers(text: str, line: str) -> list[float]:
        return [float(x) for x in re.findall(r"-?\d+\.\d+", re.findall(line, text, re.M)[0])]

    readme_labels = labels(shown.text)
    assert readme_labels == labels(printed[printed.index("reach ") :])
    assert {"goal", "solver", "read back", "camera", "result"} <= set(readme_labels)
    # The measurements of the camera differ between machines by rounding only.
    for line in (r"^marker 7 .*", r"^ +true at .*", r"^goal .*"):
        assert numbers(shown.text, line) == pytest.approx(numbers(printed, line), abs=0.11), line
    assert {p.name for p in (tmp_path / "run").iterdir()} == {
        "reach.png",
        "trajectory.csv",
        "summary.json",
    }


def test_the_keys_of_the_summary_are_those_of_the_page(tmp_path: Path) -> None:
    """Every key, and every key of a table in it unless the page refers to another table."""
    assert cli.main(["reach", "--bus", "sim", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    page = prose(ROOT / "docs" / "reference" / "reach.md")
    cells = re.findall(r"^\| (`[^|]*`) \|", page[page.index("## summary.json") :], re.MULTILINE)
    reported: dict[str, set[str]] = {}
    for cell in cells:
        first = ""
        for key in re.findall(r"`([\w.]+)`", cell):
            first = key.partition(".")[0] or first
            reported.setdefault(first, set()).update(key.split(".")[1:])
    assert set(reported) == set(summary)
    for key, inner in reported.items():
        if isinstance(summary[key], dict) and key not in ("robot", "by_camera"):
            assert inner == set(summary[key]), key
    assert set(summary["by_camera"]) == set(summary["read_back"])


def test_the_page_states_the_error_of_a_slipped_horn(tmp_path: Path) -> None:
    assert (
        cli.main(
            ["reach", "--bus", "sim", "--fault", "zero-offset:joint2=2", "--out", str(tmp_path)]
        )
        == 1
    )
    summary = json.loads((tmp_path / "summary.json").read_text())
    measured = 1e3 * summary["by_camera"]["position_m"]
    page = (ROOT / "docs" / "reference" / "reach.md").read_text(encoding="utf-8")
    (line,) = [row for row in page.splitlines() if "zero-offset:joint2=2" in row]
    assert float(re.findall(r"(\d+) mm", line)[-1]) == pytest.approx(measured, abs=1.0), line


def test_the_extras_on_the_page_are_those_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    page = (ROOT / "docs" / "how-to" / "install.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)
    assert set(listed) == set(project["optional-dependencies"]) - {"dev", "docs"}


def test_every_page_names_the_same_versions_of_python() -> None:
    make_venv = (ROOT / ".ci" / "make_venv").read_text()
    oldest, newest = (
        int(minor) for minor in re.findall(r"(?:oldest|newest)='\(3, (\d+)\)'", make_venv)
    )
    for page in ("README.md", "CONTRIBUTING.md", "docs/how-to/install.md"):
        stated = re.findall(
            r"Python 3\.(\d+) to 3\.(\d+)", (ROOT / page).read_text(encoding="utf-8")
        )
        assert stated and set(stated) == {(str(oldest), str(newest))}, page
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    classified = re.findall(r"Python :: 3\.(\d+)", "\n".join(project["classifiers"]))
    assert classified == [str(minor) for minor in range(oldest, newest + 1)]
    assert project["requires-python"] == f">=3.{oldest}"


def test_a_system_that_was_not_tried_is_not_a_classifier() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    untried = "macOS and Windows have not been tried" in readme
    assert untried != any("MacOS" in row for row in project["classifiers"])


def test_no_install_line_names_the_distribution_of_another_project() -> None:
    """``robot-ik`` on the package index also installs a package ``robot_ik``."""
    folders = ("robot_ik", "hardware", "models", "docs", "examples", "tests", ".ci", ".github")
    files = [
        file for folder in folders for file in (ROOT / folder).rglob("*") if file.suffix in TEXTS
    ]
    files += [file for file in ROOT.iterdir() if file.suffix in TEXTS]
    foreign = re.compile(
        r"pip install (?:-\S+ )*[\"']?robot[_-]ik(?!-testbed|\w)|robot[_-]ik\[\w+\]"
    )
    found = {named(file): foreign.findall(file.read_text(encoding="utf-8")) for file in files}
    assert {name: lines for name, lines in found.items() if lines} == {}


def test_the_arms_with_an_arm_file_are_counted_and_named() -> None:
    arms = {file.parent.name for file in (ROOT / "models").glob("*/arm.toml")}
    start = (ROOT / "docs" / "start" / "own_robot.md").read_text(encoding="utf-8")
    numbers = ("four", "five", "six", "seven", "eight", "nine", "ten")
    assert f"{numbers[len(arms) - 4].capitalize()} bundled robots have one" in start
    page = (ROOT / "docs" / "reference" / "arms.md").read_text(encoding="utf-8")
    assert [name for name in arms if name not in page] == []


def test_the_comparison_states_the_hinges_of_the_humanoid() -> None:
    import robot_ik as rik

    robot = rik.load_robot("humanoid")
    page = (ROOT / "docs" / "reference" / "comparison.md").read_text(encoding="utf-8")
    assert f" {robot.nv - 6} hinges and a floating base" in page  # no balls, one free joint


def test_every_goal_on_the_page_can_be_imported() -> None:
    import robot_ik as rik

    page = (ROOT / "docs" / "reference" / "goals.md").read_text(encoding="utf-8")
    names = set(re.findall(r"^\| `(\w+Goal)\(", page, re.MULTILINE))
    assert names >= {"PoseGoal", "PosePriorGoal"}
    for name in names - set(rik.__all__):
        (module,) = re.findall(rf"`from (robot_ik\.\w+) import {name}`", page)
        assert hasattr(importlib.import_module(module), name)


def test_the_citation_has_the_version_and_the_address() -> None:
    import robot_ik as rik

    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"\nversion: {rik.__version__}\n" in citation
    assert f"\nrepository-code: {project['urls']['Homepage']}\n" in citation


def test_contributing_lists_every_target_of_make() -> None:
    (phony,) = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    reported = set(
        re.findall(r"`make ([\w-]+)", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    )
    assert set(phony.split()) - {"FORCE", "help", "reach", "clean"} == reported


def test_contributing_lists_the_steps_of_ci() -> None:
    (steps,) = re.findall(
        r"^for step in (.*); do$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE
    )
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| `bash \.ci/run` \|(.*)\|$", contributing, re.MULTILINE)
    assert re.findall(r"`([\w-]+)`", row) == [*steps.split(), "test"]


def test_the_api_page_lists_every_public_name() -> None:
    import robot_ik as rik

    page = (ROOT / "docs" / "reference" / "api.rst").read_text(encoding="utf-8")
    listed = re.findall(r"^\.\. auto(?:class|function|data|exception):: (\w+)$", page, re.MULTILINE)
    assert sorted(listed) == sorted(name for name in rik.__all__ if name != "__version__")
    for module, name in re.findall(
        r"^\.\. auto\w+:: (robot_ik\.[\w.]+)\.(\w+)$", page, re.MULTILINE
    ):
        assert hasattr(importlib.import_module(module), name), f"{module}.{name}"


@pytest.mark.parametrize(
    ("contract_id", "package", "first"),
    [
        ("layers", "", "commands"),
        ("camera-layers", "robot_ik.camera.", "synthetic.sources"),
        ("hardware-layers", "robot_ik.hardware.", "health"),
    ],
)
def test_the_drawn_layers_are_those_of_the_import_contract(
    contract_id: str, package: str, first: str
) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    (contract,) = [
        c for c in project["tool"]["importlinter"]["contracts"] if c["id"] == contract_id
    ]
    (drawn,) = [b for b in blocks(ROOT / "docs" / "architecture.md") if b.text.startswith(first)]
    lines = [line.split("   ")[0] for line in drawn.text.splitlines()]
    drawn_names = [re.findall(r"[\w.]+", line) for line in lines]
    here = {p.stem for p in (ROOT / "robot_ik").iterdir()} | {"hardware", "models"}
    checked = [
        [
            name.removeprefix(package)
            for name in re.findall(r"[\w.]+", line)
            if package or name in here
        ]
        for line in contract["layers"]
    ]
    assert drawn_names == [names for names in checked if names and names != ["__main__"]]


def test_every_package_and_page_is_on_the_map() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    page = ROOT / "docs" / "architecture.md"
    (tree,) = [block.text for block in blocks(page) if block.text.startswith("robot_ik/")]
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
    methods = ROOT / "docs" / "reference" / "solvers"  # their overview links to them
    for page in (page for page in PAGES[1:] if page.parent != methods):
        assert page == index or page in listed, f"docs/index.md does not lead to {named(page)}"


# The page of symptoms


def _rendered_strings() -> list[str]:
    """Return every string in the code, with `…` in place of each formatted value."""
    texts = []
    for folder in ("robot_ik", "hardware"):
        for file in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    texts.append(node.value)
                elif isinstance(node, ast.JoinedStr):
                    parts = [
                        str(part.value) if isinstance(part, ast.Constant) else "…"
                        for part in node.values
                    ]
                    texts.append("".join(parts))
    return texts


def test_the_symptoms_are_messages_of_the_program() -> None:
    page = prose(ROOT / "docs" / "how-to" / "troubleshooting.md")
    cells = re.findall(r"^\|([^|]*`[^|`]+`[^|]*)\|", page, re.MULTILINE)
    shown = [text for cell in cells for text in re.findall(r"`([^`]+)`", cell) if " " in text]
    assert len(shown) >= 12
    known = "\n".join(_rendered_strings())
    pieces = {piece.strip(" ,.'") for text in shown for piece in re.split("[…:;]", text)}
    unknown = {piece for piece in pieces if piece and piece not in known}
    assert not unknown


def test_the_page_of_symptoms_has_every_status() -> None:
    import robot_ik as rik

    page = prose(ROOT / "docs" / "how-to" / "troubleshooting.md")
    failures = {status.name for status in rik.Status} - {"CONVERGED"}
    assert {name for name in failures if f"`{name}`" not in page} == set()


# The page of the theses


def test_the_options_on_the_page_of_the_theses_exist() -> None:
    import robot_ik as rik

    page = prose(ROOT / "docs" / "theory" / "theses.md")
    rows = [row for row in page.splitlines() if row.startswith("|")]
    commands = re.findall(r"`robot-ik solve --solver (\w+)(?: --set (\w+)=([\w.]+))?`", page)
    assert len(commands) >= 15
    for solver, option, _ in commands:
        fields = {field.name for field in dataclasses.fields(rik.SOLVERS[solver])}
        assert not option or option in fields, (solver, option)
    for row in rows:
        cell = row.split("|")[2]
        names = re.findall(r"`(\w+)`", cell)
        if not names or names[0] not in rik.SOLVERS:
            continue
        known = set(rik.SOLVERS)
        for name in names:
            if name in rik.SOLVERS:
                known |= {field.name for field in dataclasses.fields(rik.SOLVERS[name])}
        assert set(names) <= known, row
