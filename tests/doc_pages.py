"""The pages of the documentation and their blocks, for the tests of the docs."""

from __future__ import annotations

import importlib.util
import re
import sys
import types
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Other pages whose links and names are checked.
OTHERS = [
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "models").glob("*/README.md")),
]
FENCE = re.compile(r"^```(\w*) *([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHOWN = {"python", "sh", "xml", "toml", "json", "text"}


@dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes:
        language: First word of the fence.
        note: The other words of the fence.
        text: Content.
        line: Number of the first line of the content.
    """

    language: str
    note: str
    text: str
    line: int

    @property
    def file(self) -> str:
        """Path in a note ``file=PATH``; empty without one."""
        match = re.search(r"file=(\S+)", self.note)
        return match[1] if match else ""


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(m[1], m[2], m[3], text.count("\n", 0, m.start()) + 2) for m in FENCE.finditer(text)
    ]


def prose(page: Path) -> str:
    """Return a page without its blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def named(page: Path) -> str:
    """Return the path of a page relative to the repository."""
    return str(page.relative_to(ROOT))


def script(name: str) -> types.ModuleType:
    """Return a script of docs/make as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "make" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look it up
    spec.loader.exec_module(module)
    return module
