"""Configuration of Sphinx: the site of the pages and of the docstrings of public names.

`make docs` builds build/site. The source folder is the root of the checkout, so links between
README, docs/ and models/ are the same in the files, on the site and in any viewer of Markdown.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import re
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

from robot_ik import __version__
from robot_ik.commands import main as cli

project = "robot_ik"
copyright = "the robot_ik contributors"
version = __version__
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]

root_doc = "docs/index"
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
include_patterns = ["docs/**", "*.md", "models/*/README.md", "models/THIRD_PARTY.md"]
# Sphinx walks the source folder. It need not enter these.
exclude_patterns = [
    "**/.*",
    "build",
    "dist",
    "runs",
    "robot_ik",
    "hardware",
    "tests",
    "examples",
    "docs/images",
    "docs/make",
    "docs/notebooks",
    "docs/static",
]

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
html_static_path = ["static"]
html_css_files = ["site.css"]
html_favicon = "static/mark.svg"
html_theme_options = {
    "light_logo": "logo_light.svg",
    "dark_logo": "logo_dark.svg",
    "sidebar_hide_name": True,
    "source_repository": "https://github.com/robot-ik/robot-ik-testbed/",
    "source_branch": "main",
    "source_directory": "",
    "light_css_variables": {
        "color-brand-primary": "#2563eb",
        "color-brand-content": "#1d4ed8",
    },
    "dark_css_variables": {
        "color-brand-primary": "#7cb0ff",
        "color-brand-content": "#8fbcff",
    },
}

#: Pages whose children are the files of a folder.
CHILDREN = {"docs/reference/solvers": "solvers/*", "docs/reference/robots": "../../models/*/README"}
#: Pages that are not in the menu.
OUTSIDE = ("SECURITY", "CODE_OF_CONDUCT", "models/THIRD_PARTY")
#: First entry of the menu.
FIRST = "README <../README>"
#: Width of the help of a command, characters.
HELP_COLUMNS = 82


def add_toctrees(_app: Sphinx, name: str, source: list[str]) -> None:
    """Add the menu: the lists of links in docs/index.md, and the children above."""
    if name == root_doc:
        source[0] += toctree([FIRST], [])
        for part in source[0].split("\n## ")[1:]:
            links = re.findall(r"^\* \[.*?\]\((\S+)\.(?:md|rst)\)", part, re.MULTILINE)
            source[0] += toctree(links, [f":caption: {part.splitlines()[0]}"])
    elif name in CHILDREN:
        source[0] += toctree([CHILDREN[name]], [":glob:"])
    elif name in OUTSIDE:
        source[0] = "---\norphan: true\n---\n" + source[0]


def add_helps(_app: Sphinx, name: str, source: list[str]) -> None:
    """Add the help of every command, as the program prints it."""
    if name == "docs/reference/cli":
        for rows in cli.GROUPS.values():
            for row in rows:
                text = help_of(row.name.split())
                source[0] += f"\n## {row.name}\n\n```text\n{text}```\n"


def help_of(words: list[str]) -> str:
    """Return what `robot-ik WORDS --help` prints.

    Raises:
        ExtensionError: The command failed.
    """
    os.environ["COLUMNS"] = str(HELP_COLUMNS)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        if cli.main([*words, "--help"]):
            raise ExtensionError(f"robot-ik {' '.join(words)} --help failed")
    return out.getvalue()


def shorten_signatures(
    _app: Sphinx,
    what: str,
    _name: str,
    documented: object,
    _options: object,
    _signature: str,
    returned: str,
) -> tuple[str, str] | None:
    """Return the signature of a command without the help of its options, None for other objects."""
    module = getattr(documented, "__module__", "")
    if what != "class" or not module.startswith("robot_ik.commands"):
        return None
    fields = dataclasses.fields(documented)
    options = ", ".join(f"{field.name}={field.default!r}" for field in fields if field.init)
    return f"(*, {options})", returned


def toctree(pages: list[str], options: list[str]) -> str:
    """Return a hidden table of contents."""
    return "\n".join(["", ":::{toctree}", ":hidden:", *options, "", *pages, ":::", ""])


def add_front_page(app: Sphinx, failure: Exception | None) -> None:
    """Write the page at the root of the site. It leads to the index."""
    if failure is not None:
        return
    target = f"{root_doc}.html"
    head = f'<!doctype html><meta http-equiv="refresh" content="0; url={target}">'
    page = f'{head}<a href="{target}">Docs</a>\n'
    (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Connect the functions above to the events of Sphinx."""
    app.connect("source-read", add_toctrees)
    app.connect("source-read", add_helps)
    app.connect("autodoc-process-signature", shorten_signatures)
    app.connect("build-finished", add_front_page)
