"""Sphinx: the site of these pages and of the docstrings of public names.  `make docs` builds build/site.

The source folder is the root of the checkout, so that the links between README, docs/ and models/ are the
same in the files, on the site and in any viewer of Markdown.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

from robot_ik import __version__
from robot_ik.commands import main as cli

project = "robot_ik"
release = version = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]

root_doc = "docs/index"
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
include_patterns = ["docs/**", "*.md", "models/*/README.md", "models/THIRD_PARTY.md"]
# Sphinx walks the whole source folder; these it need not enter.
exclude_patterns = [
    "**/.*", "build", "dist", "runs", "robot_ik", "hardware", "tests", "examples", "docs/make", "docs/images",
]  # fmt: skip

myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike")}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# Names of attributes are looked up in all classes, and many have a `velocity`.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_title = "robot_ik"
html_copy_source = False

#: Pages whose children are the files of a folder.
CHILDREN = {"docs/reference/solvers": "solvers/*", "docs/reference/robots": "../../models/*/README"}
#: Pages that are not in the menu.
OUTSIDE = ("README", "SECURITY", "CODE_OF_CONDUCT", "models/THIRD_PARTY")


def add_toctrees(app: Sphinx, name: str, source: list[str]) -> None:
    """The menu: the lists of links in docs/index.md, and the children above."""
    if name == root_doc:
        after = []
        for part in source[0].split("\n## ")[1:]:
            links = re.findall(r"^\* \[.*?\]\((\S+)\.(?:md|rst)\)", part, re.MULTILINE)
            after.append(toctree(links, f":caption: {part.splitlines()[0]}"))
        source[0] += "".join(after)
    elif name in CHILDREN:
        source[0] += toctree([CHILDREN[name]], ":glob:")
    elif name in OUTSIDE:
        source[0] = "---\norphan: true\n---\n" + source[0]


def add_helps(app: Sphinx, name: str, source: list[str]) -> None:
    """The help of every command, as the program prints it."""
    if name == "docs/reference/cli":
        for rows in cli.GROUPS.values():
            for row in rows:
                text = help_of(row.name.split())
                source[0] += f"\n## {row.name}\n\n```text\n{text}```\n"


def help_of(words: list[str]) -> str:
    """What `robot-ik WORDS --help` prints, 82 columns wide."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        os.environ["COLUMNS"] = "82"
        if cli.main([*words, "--help"]):
            raise ExtensionError(f"robot-ik {' '.join(words)} --help failed")
    return out.getvalue()


def toctree(pages: list[str], option: str) -> str:
    """A hidden table of contents."""
    return "\n".join(["", ":::{toctree}", ":hidden:", option, "", *pages, ":::", ""])


def add_front_page(app: Sphinx, failure: Exception | None) -> None:
    """The root of the site leads to the index."""
    if failure is None:
        there = f"{root_doc}.html"
        page = (
            f'<!doctype html><meta http-equiv="refresh" content="0; url={there}"><a href="{there}">Docs</a>\n'
        )
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Sphinx calls it."""
    app.connect("source-read", add_toctrees)
    app.connect("source-read", add_helps)
    app.connect("build-finished", add_front_page)
