"""The documentation against the program: blocks run, and names exist.

The blocks of README.md and docs/ run from top to bottom, in an empty folder for each page:

* ```python blocks run in one namespace a page. Blocks with `append=FILE` do not run:
  tests/test_extend.py runs them.
* ```sh blocks: `robot-ik …` must exit 0, or with the code of a comment `# exit 1`. With ` &` it
  runs beside the rest and must end on SIGTERM without an error. Of a line that names /dev/…, and of
  all lines of a block ```sh options, only the options are checked, because other tests run these
  slow commands. `make X` must be a target, `python FILE` an example.
* a block that begins with ```xml file=NAME is written to that file first.
* ```json and ```toml blocks parse.
"""

from __future__ import annotations

import contextlib
import json
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import tomllib
import types
from functools import cache
from pathlib import Path

import pytest

from robot_ik.commands import main as cli
from tests.doc_pages import OTHERS, PAGES, ROOT, SHOWN, blocks, named, prose

#: Longest line of Markdown, characters.
MARKDOWN_WIDTH = 100
TEXT_BLOCK = re.MULTILINE | re.DOTALL
#: Page with the files of the desk arm, which other pages use.
OWN_ROBOT = ROOT / "docs" / "start" / "own_robot.md"
FIRST_PHOTO = ROOT / "docs" / "start" / "camera.md"


@pytest.mark.parametrize(
    "title", ["class GradientDescent", "class LoggedBus", "class Reachable(JsonOption)"]
)
def test_the_modules_of_the_recipes_pass_the_linter(title: str) -> None:
    page = ROOT / "docs" / "how-to" / "extend.md"
    (code,) = [
        block.text for block in blocks(page) if block.language == "python" and title in block.text
    ]
    ruff = [
        sys.executable,
        "-m",
        "ruff",
        "check",
        "--quiet",
        "--stdin-filename",
        "robot_ik/recipe.py",
        "-",
    ]
    run = subprocess.run(ruff, input=code, capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stdout


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_the_blocks_of_a_page_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, real_time: None
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # a block may import the file of an earlier block
    give(page, tmp_path)
    module = types.ModuleType(f"docs_{page.stem}")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # dataclasses look it up
    beside: list[subprocess.Popen[str]] = []
    try:
        for block in blocks(page):
            assert block.language in SHOWN, (
                f"{named(page)}:{block.line}: a block of {block.language!r}"
            )
            if block.file:
                Path(block.file).parent.mkdir(parents=True, exist_ok=True)
                Path(block.file).write_text(block.text, encoding="utf-8")
            if block.language == "python" and "append=" not in block.note:
                # The empty lines give a traceback the line number of the page.
                padded = "\n" * (block.line - 1) + block.text
                exec(compile(padded, str(page), "exec", dont_inherit=True), module.__dict__)
            elif block.language == "sh":
                for line in commands_of(block.text):
                    run_line(
                        line,
                        f"{named(page)}:{block.line}",
                        beside,
                        only_options=block.note == "options",
                    )
            elif block.language == "toml":
                tomllib.loads(block.text)
            elif block.language == "json":
                json.loads(block.text)
    finally:
        for process in beside:
            process.send_signal(signal.SIGTERM)
    assert [process.wait() for process in beside] == [0] * len(beside)


def commands_of(text: str) -> list[str]:
    """Return the lines of a block. A line that ends in a backslash continues on the next one."""
    return re.sub(r"\\\n\s*", "", text).splitlines()


def give(page: Path, folder: Path) -> None:
    """Write the files that a page expects: an arm file, a model, a photograph and its camera."""
    text = page.read_text(encoding="utf-8")
    if "my_arm.toml" in text:
        (folder / "my_arm.toml").write_bytes(
            (ROOT / "models" / "puma560" / "arm.toml").read_bytes()
        )
    if "path/to/arm.xml" in text:
        (model,) = [block for block in blocks(OWN_ROBOT) if block.file.endswith("desk_arm.xml")]
        (folder / "path" / "to").mkdir(parents=True)
        (folder / "path" / "to" / "arm.xml").write_text(model.text, encoding="utf-8")
    if "desk_arm/arm.toml" in text and page != OWN_ROBOT:
        (folder / "desk_arm").mkdir()
        for block in blocks(OWN_ROBOT):
            if block.file:
                (folder / block.file).write_text(block.text, encoding="utf-8")
    if re.search(r'"photo\.png"|detect photo\.png|locate photo\.png', text) and page != FIRST_PHOTO:
        for name, content in photograph().items():
            (folder / name).write_bytes(content)


@cache
def photograph() -> dict[str, bytes]:
    """Return the photograph and the calibration that the page of the first camera creates."""
    (block,) = [b for b in blocks(FIRST_PHOTO) if 'imwrite("photo.png"' in b.text]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        exec(
            compile(block.text, str(FIRST_PHOTO), "exec", dont_inherit=True), {"__name__": "photo"}
        )
        return {name: Path(name).read_bytes() for name in ("photo.png", "camera.yaml")}


def run_line(
    line: str, where: str, beside: list[subprocess.Popen[str]], *, only_options: bool
) -> None:
    command, _, comment = line.partition("#")
    words = shlex.split(command)
    if ">" in words:  # the output goes to a file
        words = words[: words.index(">")]
    where += f": {line}"
    if not words:
        return
    if words[0] == "make":
        assert words[1] in targets(), where
        if words[1] == "reach" and len(words) > 2:
            check_options(["reach", *shlex.split(words[2].removeprefix("ARGS="))], where)
        return
    if words[0] == "python":
        is_package = words[1] == "-m" and (ROOT / words[2].replace(".", "/")).is_dir()
        assert is_package or (ROOT / words[1]).is_file(), where
        return
    assert words[0] == "robot-ik", f"{where}: no check exists for this command"
    if only_options or "/dev/" in command:
        check_options(words[1:], where)
    elif words[-1] == "&":
        child = [sys.executable, "-m", "robot_ik", *words[1:-1]]
        beside.append(subprocess.Popen(child, stdout=subprocess.PIPE, text=True))
        out = beside[-1].stdout
        assert out is not None and out.readline(), where  # the command prints its port when ready
    else:
        match = re.search(r"exit (\d)", comment)
        exit_code = int(match[1]) if match else 0
        assert cli.main(words[1:]) == exit_code, where


def check_options(words: list[str], where: str) -> None:
    from robot_ik.errors import OptionError

    try:
        cli.parse_command(words)
    except OptionError as error:
        pytest.fail(f"{where}: {error}")


def targets() -> set[str]:
    found = re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    return set(found)


def slug(heading: str) -> str:
    kept = re.sub(r"[^\w\- ]", "", heading.strip().lower())
    return kept.replace(" ", "-")


@pytest.mark.parametrize("page", PAGES + OTHERS, ids=named)
def test_links_lead_to_existing_pages_and_headings(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        linked_file = (page.parent / path).resolve() if path else page
        assert linked_file.exists(), f"{named(page)}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", prose(linked_file), re.MULTILINE)
            assert anchor in map(slug, headings), f"{named(page)}: {target}"


@pytest.mark.parametrize("page", PAGES + OTHERS, ids=named)
def test_lines_have_at_most_100_characters(page: Path) -> None:
    """Except for tables, pictures, and blocks whose text is not code."""
    kept = re.sub(r"^```text\n.*?^```$", "", page.read_text(encoding="utf-8"), flags=TEXT_BLOCK)
    lines = [line for line in kept.splitlines() if not line.lstrip().startswith(("|", "!["))]
    assert [line for line in lines if len(line) > MARKDOWN_WIDTH] == []


@pytest.mark.parametrize("page", PAGES + OTHERS, ids=named)
def test_files_named_in_the_text_exist(page: Path) -> None:
    suffix = re.compile(r"\.(py|toml|md|xml|txt|png|jpg|urdf|yaml|run)$|/$")
    written = {block.file for block in blocks(page)}
    for name in re.findall(r"(?<!`)`([\w.\-/]+)`(?!`)", prose(page)):
        is_created = name.startswith(("runs/", "/")) or "/" not in name or name in written
        if is_created or not suffix.search(name):
            continue
        assert (ROOT / name).exists() or (page.parent / name).exists(), f"{named(page)}: {name}"


def helps() -> dict[str, str]:
    import io

    def help_of(*words: str) -> str:
        stream = io.StringIO()
        with contextlib.redirect_stdout(stream):
            cli.main([*words, "--help"])
        return stream.getvalue()

    texts: dict[str, str] = {}
    for name in cli.command_names():
        first = name.split()[0]
        texts[first] = texts.get(first, "") + help_of(*name.split())
    return texts


def test_commands_and_options_named_in_the_text_exist() -> None:
    texts = helps()
    options = set(re.findall(r"--[a-z][\w.-]*", " ".join(texts.values()))) | {
        "--version",
        "--debug",
    }
    for page in PAGES + OTHERS:
        for code in re.findall(r"`([^`\n]+)`", prose(page)):
            words = code.split()
            if words[0] == "python":  # a script with options of its own
                continue
            if words[0] == "make" and len(words) > 1:
                assert words[1] in targets(), f"{named(page)}: {code}"
            if words[0] == "robot-ik" and len(words) > 1:
                assert words[1] in texts or words[1] in options, f"{named(page)}: {code}"
            known = (
                texts[words[1]]
                if words[0] == "robot-ik" and words[1:2] and words[1] in texts
                else options
            )
            for flag in re.findall(r"(?<!\S)--[a-z][\w.-]*", code):
                assert flag in known or flag == "--help", f"{named(page)}: {code}"


def test_the_pages_name_every_public_name_and_no_other() -> None:
    import robot_ik as rik

    everything = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for page in PAGES:
        for name in re.findall(r"\brik\.([A-Za-z_]\w*)", page.read_text(encoding="utf-8")):
            assert hasattr(rik, name), f"{named(page)}: rik.{name}"
    names = [name for name in rik.__all__ if not name.startswith("_")]
    missing = [name for name in names if not re.search(rf"\b{name}\b", everything)]
    assert not missing, f"public, and on no page: {missing}"


@pytest.mark.parametrize("page", PAGES + OTHERS, ids=named)
def test_pages_contain_no_paths_of_a_machine(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"/(home|root|work|Users)/|127\.0\.0\.1", text)
    assert not re.search(r"pypi|simple/|--index-url|--extra-index", text, re.IGNORECASE)
