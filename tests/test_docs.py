"""The documentation, held to the program: what it shows is run, what it names is there.

In README.md and docs/, top to bottom, in an empty folder for each page:

* ```python blocks run, one after the other, in one namespace a page;
* ```sh blocks: `robot-ik …` runs through the command line and must exit 0, or as a comment `# exit 1` says;
  with ` &` it runs beside the rest and must end well on SIGTERM; of a line that names /dev/…, and of all in
  a block ```sh options (slow, and run by tests of their own), only the options are checked; `make X` must be
  a target; `python FILE` must be an example;
* a block whose first line says ```xml file=NAME is written to that file first;
* ```json and ```toml blocks parse.
"""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import signal
import subprocess
import sys
import tomllib
import types
from dataclasses import dataclass
from pathlib import Path

import pytest

from robot_ik.cli import main as cli

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs").glob("*/*.md"))]
#: Pages of other rooms whose links and names are checked, too.
OTHERS = [ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "models").glob("*/README.md"))]
FENCE = re.compile(r"^```(\w*) *([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHOWN = {"python", "sh", "xml", "toml", "json", "text"}


@dataclass(frozen=True)
class Block:
    language: str
    note: str
    text: str
    line: int

    @property
    def file(self) -> str:
        found = re.search(r"file=(\S+)", self.note)
        return found[1] if found else ""


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [Block(m[1], m[2], m[3], text.count("\n", 0, m.start()) + 2) for m in FENCE.finditer(text)]


def prose(page: Path) -> str:
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


# ------------------------------------------------------------------------------- blocks are run


@pytest.mark.timeout(300)  # a cold cache compiles the solvers first
@pytest.mark.parametrize("page", PAGES, ids=named)
def test_what_a_page_shows_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    give(page.read_text(encoding="utf-8"), tmp_path)
    module = types.ModuleType(f"docs_{page.stem}")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # dataclasses look it up
    beside: list[subprocess.Popen[str]] = []
    try:
        for block in blocks(page):
            assert block.language in SHOWN, f"{named(page)}:{block.line}: a block of {block.language!r}"
            if block.file:
                Path(block.file).parent.mkdir(parents=True, exist_ok=True)
                Path(block.file).write_text(block.text, encoding="utf-8")
            if block.language == "python":
                padded = "\n" * (block.line - 1) + block.text  # so that a traceback names the page's line
                exec(compile(padded, str(page), "exec", dont_inherit=True), module.__dict__)
            elif block.language == "sh":
                for line in block.text.splitlines():
                    run_line(
                        line, f"{named(page)}:{block.line}", beside, only_options=block.note == "options"
                    )
            elif block.language == "toml":
                tomllib.loads(block.text)
            elif block.language == "json":
                json.loads(block.text)
    finally:
        for process in beside:
            process.send_signal(signal.SIGTERM)
    assert [process.wait(timeout=20) for process in beside] == [0] * len(beside)


def give(text: str, folder: Path) -> None:
    """What a page takes for granted that a reader has: an arm file, a model."""
    if "my_arm.toml" in text:
        (folder / "my_arm.toml").write_bytes((ROOT / "models" / "puma560" / "arm.toml").read_bytes())
    if "path/to/arm.xml" in text:
        (model,) = [b for b in blocks(ROOT / "docs" / "recipes.md") if b.file.endswith("desk_arm.xml")]
        (folder / "path" / "to").mkdir(parents=True)
        (folder / "path" / "to" / "arm.xml").write_text(model.text, encoding="utf-8")


def run_line(line: str, where: str, beside: list[subprocess.Popen[str]], *, only_options: bool) -> None:
    command, _, comment = line.partition("#")
    words = shlex.split(command)
    where += f": {line}"
    if not words:
        return
    if words[0] == "make":
        assert words[1] in targets(), where
        if words[1] == "reach" and len(words) > 2:
            check_options(["reach", *shlex.split(words[2].removeprefix("ARGS="))], where)
        return
    if words[0] == "python":
        assert (ROOT / words[1]).is_file(), where
        return
    assert words[0] == "robot-ik", f"{where}: nobody knows how to check this"
    if only_options or "/dev/" in command:
        check_options(words[1:], where)
    elif words[-1] == "&":
        child = [sys.executable, "-m", "robot_ik", *words[1:-1]]
        beside.append(subprocess.Popen(child, stdout=subprocess.PIPE, text=True))
        out = beside[-1].stdout
        assert out is not None and out.readline(), where  # it says its port when it is ready
    else:
        wanted = int(found[1]) if (found := re.search(r"exit (\d)", comment)) else 0
        assert cli.main(words[1:]) == wanted, where


def check_options(words: list[str], where: str) -> None:
    import tyro

    command = cli.COMMANDS[words[0]]
    kind = getattr(importlib.import_module(command.module), command.options)
    try:
        tyro.cli(kind, args=words[1:])
    except SystemExit as error:
        pytest.fail(f"{where}: {error}")


def targets() -> set[str]:
    found = re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    return set(found)


# ------------------------------------------------------------------------- what it names is there


def slug(heading: str) -> str:
    kept = re.sub(r"[^\w\- ]", "", heading.strip().lower())
    return kept.replace(" ", "-")


@pytest.mark.parametrize("page", PAGES + OTHERS, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f"{named(page)}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", prose(there), re.MULTILINE)
            assert anchor in map(slug, headings), f"{named(page)}: {target}"


@pytest.mark.parametrize("page", PAGES + OTHERS, ids=named)
def test_files_named_in_the_text_exist(page: Path) -> None:
    suffix = re.compile(r"\.(py|toml|md|xml|txt|png|jpg|urdf|yaml|run)$|/$")
    for name in re.findall(r"(?<!`)`([\w.\-/]+)`(?!`)", prose(page)):
        made = name.startswith(("runs/", "/")) or "/" not in name
        if made or not suffix.search(name):
            continue
        assert (ROOT / name).exists() or (page.parent / name).exists(), f"{named(page)}: {name}"


def helps() -> dict[str, str]:
    import contextlib
    import io

    def asked(*words: str) -> str:
        stream = io.StringIO()
        with contextlib.redirect_stdout(stream):
            cli.main([*words, "--help"])
        return stream.getvalue()

    found = {}
    for name in cli.COMMANDS:
        text = asked(name)
        subcommands = re.findall(r"• ([a-z][a-z-]*) ", text)
        found[name] = " ".join([text, *(asked(name, subcommand) for subcommand in subcommands)])
    return found


def test_commands_and_options_named_in_the_text_exist() -> None:
    texts = helps()
    options = set(re.findall(r"--[a-z][\w.-]*", " ".join(texts.values()))) | {"--version", "--debug"}
    for page in PAGES + OTHERS:
        for code in re.findall(r"`([^`\n]+)`", prose(page)):
            words = code.split()
            if words[0] == "make" and len(words) > 1:
                assert words[1] in targets(), f"{named(page)}: {code}"
            if words[0] == "robot-ik" and len(words) > 1:
                assert words[1] in texts or words[1] in options, f"{named(page)}: {code}"
            known = (
                texts[words[1]] if words[0] == "robot-ik" and words[1:2] and words[1] in texts else options
            )
            for flag in re.findall(r"(?<!\S)--[a-z][\w.-]*", code):
                assert flag in known, f"{named(page)}: {code}"


def test_public_names_are_told_and_told_names_are_public() -> None:
    import robot_ik as rik

    everything = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for page in PAGES:
        for name in re.findall(r"\brik\.([A-Za-z_]\w*)", page.read_text(encoding="utf-8")):
            assert hasattr(rik, name), f"{named(page)}: rik.{name}"
    names = [name for name in rik.__all__ if not name.startswith("_")]
    untold = [name for name in names if not re.search(rf"\b{name}\b", everything)]
    assert not untold, f"public, and on no page: {untold}"


@pytest.mark.parametrize("page", PAGES + OTHERS, ids=named)
def test_pages_belong_to_no_machine(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"/(home|root|work|Users)/|127\.0\.0\.1", text)
    assert not re.search(r"pypi|simple/|--index-url|--extra-index", text, re.IGNORECASE)


# ------------------------------------------------------------------------- tables from the program


def script(name: str) -> types.ModuleType:
    """A program of docs/."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look it up
    spec.loader.exec_module(module)
    return module


def test_tables_are_what_the_program_says() -> None:
    tables = script("make_tables")
    used = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        used |= {m[2] for m in tables.PLACE.finditer(text)}
        assert tables.filled(text) == text, f"{named(page)} is out of date: python docs/make_tables.py"
    assert used == set(tables.TABLES)


# -------------------------------------------------------------------------------- the first screen


def test_the_first_screen_has_one_picture_and_two_commands() -> None:
    page = ROOT / "README.md"
    head = "\n".join(page.read_text(encoding="utf-8").splitlines()[:30])
    assert re.findall(r"^make [\w-]+", head, re.MULTILINE) == ["make reach", "make test"]
    (picture,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", head)
    assert 20_000 < (ROOT / picture).stat().st_size < 400 * 1024


@pytest.mark.timeout(300)
def test_make_reach_prints_what_the_readme_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = [block for block in blocks(ROOT / "README.md") if block.text.startswith("reach ")]
    assert cli.main(["reach", "--out", str(tmp_path / "run")]) == 0
    printed = capsys.readouterr().out

    def labels(text: str) -> list[str]:
        return [m[0].strip() for m in re.finditer(r"^[a-z][\w ]*?(?=  )", text, re.MULTILINE)]

    wanted = labels(shown.text)
    assert wanted == labels(printed[printed.index("reach ") :])
    assert {"goal", "solver", "read back", "camera", "result"} <= set(wanted)
    # Both of the picture's captions and the files are told by name.
    assert {p.name for p in (tmp_path / "run").iterdir()} == {"reach.png", "trajectory.csv", "summary.json"}


def test_the_keys_of_the_summary_are_those_of_the_page(tmp_path: Path) -> None:
    assert cli.main(["reach", "--bus", "sim", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    page = prose(ROOT / "docs" / "reach.md")
    rows = re.findall(r"^\| `([\w.]+)`", page[page.index("## summary.json") :], re.MULTILINE)
    told = {row.split(".")[0] for row in rows}
    assert told == set(summary)
    for row in rows:
        if "." in row:
            first, second = row.split(".")
            assert second in summary[first], row


# ------------------------------------------------------------------------------- the architecture


def test_the_layers_drawn_are_the_layers_checked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    (contract,) = [c for c in project["tool"]["importlinter"]["contracts"] if c["id"] == "layers"]
    (drawn,) = [b for b in blocks(ROOT / "docs" / "architecture.md") if b.text.startswith("cli")]
    lines = [line.split("   ")[0] for line in drawn.text.splitlines()]
    drawn_names = [re.findall(r"\w+", line) for line in lines]
    rooms = {p.stem for p in (ROOT / "robot_ik").iterdir()} | {"hardware", "models"}
    checked = [[name for name in re.findall(r"\w+", line) if name in rooms] for line in contract["layers"]]
    assert drawn_names == [names for names in checked if names and names != ["__main__"]]


def test_every_package_and_page_is_on_the_map() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (tree,) = [b.text for b in blocks(ROOT / "README.md") if b.text.startswith("robot_ik/")]
    told = set(re.findall(r"[\w.]+/|\w+\.py", tree))
    rooms = {p.parent.name + "/" for p in (ROOT / "robot_ik").glob("*/__init__.py")}
    folders = {"robot_ik/", "hardware/", "models/", "tests/", "examples/", "docs/"}
    assert rooms | folders <= told, sorted((rooms | folders) - told)
    here = {p.name for p in (ROOT / "robot_ik").iterdir()} | {p.name for p in ROOT.iterdir()}
    here |= {p.name for p in (ROOT / "hardware").iterdir()}
    assert {name.rstrip("/") for name in told} <= here, sorted(told)
    for page in (page for page in PAGES[1:] if page.parent == ROOT / "docs"):
        assert f"docs/{page.name}" in readme, f"README does not lead to {page.name}"
