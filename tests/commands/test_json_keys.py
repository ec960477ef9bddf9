"""`--json` of each command prints the keys of the page about JSON, and no others."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from robot_ik.commands.options import JsonOption
from tests.commands import test_every_command as every
from tests.commands.test_every_command import LINES, command_class
from tests.doc_pages import ROOT

_desk = every._desk
_camera = every._camera
photo = every.photo

PAGE = ROOT / "docs" / "reference" / "json.md"
REACH_PAGE = ROOT / "docs" / "reference" / "reach.md"

JSON_COMMANDS = [name for name in LINES if issubclass(command_class(name), JsonOption)]

OTHER_LINES = {
    "run": [""],
    "robots": [""],
    "solvers": [""],
}
"""Further lines of commands that print another object without an argument."""


@dataclass(frozen=True)
class DocumentedKey:
    """A row of the page.

    Attributes:
        path: Key with those that contain it, as ``servos[].id``.
        is_always_there: Whether the page gives no condition.
    """

    path: str
    is_always_there: bool

    def matches(self, path: str) -> bool:
        """Return whether a printed key is this one. A word in capitals matches any name."""
        pattern = re.escape(self.path)
        pattern = re.sub(r"(?<=\.)[A-Z]+$", r"[^\\[\\]]+", pattern)
        return re.fullmatch(pattern, path) is not None


def documented_keys(text: str) -> list[DocumentedKey]:
    """Return the keys in the tables of a text. ``.wxyz`` shares the parent of the key before."""
    keys = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("| ").split("|")]
        if not line.startswith("| `"):
            continue
        condition = cells[2] if len(cells) > 2 else ""
        parent = ""
        for name in re.findall(r"`([^`]+)`", cells[0]):
            path = parent + name if name.startswith(".") else name
            parent = path.rpartition(".")[0]
            keys.append(DocumentedKey(path, not condition))
    return keys


def section(name: str) -> str:
    """Return the section of a command."""
    if name == "reach":
        text = REACH_PAGE.read_text(encoding="utf-8")
        return text.partition("\n## summary.json\n")[2].partition("\n## ")[0]
    text = PAGE.read_text(encoding="utf-8")
    return text.partition(f"\n## {name}\n")[2].partition("\n## ")[0]


def documented_schema(text: str) -> int:
    """Return the version of the object that a section gives, 1 if it gives none."""
    match = re.search(r"^\| `schema` \| (\d+) \|", text, re.MULTILINE)
    return int(match[1]) if match else 1


def printed_keys(value: Any, path: str = "") -> Iterator[str]:
    """Yield the keys of a JSON object, with those that contain them."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from printed_keys(item, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        for item in value:
            yield from printed_keys(item, f"{path}[]")
    else:
        yield path


def is_documented(path: str, keys: list[DocumentedKey]) -> bool:
    """Return whether the page has a key, or keys below it that an empty or missing value hides."""
    return any(
        key.matches(path) or key.path.startswith((f"{path}.", f"{path}[")) for key in keys
    ) or any(key.matches(parent) for key in keys for parent in parents(path))


def is_printed(key: DocumentedKey, paths: set[str]) -> bool:
    """Return whether a key was printed, or a value that contains it is empty or missing."""
    for path in paths:
        if key.matches(path) or path.startswith((f"{key.path}.", f"{key.path}[")):
            return True
    return any(parent in paths for parent in parents(key.path))


def parents(path: str) -> list[str]:
    """Return the keys that contain a key: ``a[].b.c`` has ``a``, ``a[]`` and ``a[].b``."""
    return [path[: match.start()] for match in re.finditer(r"\.|\[", path)]


def test_the_page_has_a_section_for_each_command() -> None:
    headings = re.findall(r"^## (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(headings) == sorted(JSON_COMMANDS)


@pytest.mark.parametrize("name", JSON_COMMANDS)
def test_the_printed_keys_are_those_of_the_page(name: str, robot_ik: Any) -> None:
    text = section(name)
    keys = documented_keys(text)
    printed: set[str] = set()
    for line in [LINES[name], *OTHER_LINES.get(name, [])]:
        run = robot_ik(*name.split(), *line.split(), "--json")
        assert run.code == 0, run
        values = json.loads(run.out)
        assert values.pop("schema") == documented_schema(text)
        printed.update(printed_keys(values))
    assert not [path for path in sorted(printed) if not is_documented(path, keys)]
    always = [key for key in keys if key.is_always_there and key.path != "schema"]
    assert not [key.path for key in always if not is_printed(key, printed)]
