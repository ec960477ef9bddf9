"""The built site: it is complete, and a browser can read it.

`make docs` installs Sphinx. The site is built once for this file.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.doc_pages import ROOT

for package in ("furo", "myst_parser", "sphinx", "sphinx_copybutton"):
    pytest.importorskip(package, reason="needs the extra docs (make docs)")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built without a warning."""
    folder = tmp_path_factory.mktemp("site")
    options = ["-E", "-W", "--keep-going", "-q", "-d", str(folder / "doctrees"), "-c", "docs"]
    command = [sys.executable, "-m", "sphinx", *options, ".", str(folder / "html")]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return folder / "html"


def text_of(page: Path) -> str:
    """Return the text of a page without its tags."""

    class Reader(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.parts: list[str] = []

        def handle_data(self, data: str) -> None:
            self.parts.append(data)

    reader = Reader()
    reader.feed(page.read_text(encoding="utf-8"))
    return "".join(reader.parts)


def test_the_api_page_has_every_public_name_and_its_fields(site: Path) -> None:
    import robot_ik as rik

    page = (site / "docs" / "reference" / "api.html").read_text(encoding="utf-8")
    anchors = set(re.findall(r'id="(robot_ik\.[\w.]+)"', page))
    for name in rik.__all__:
        if name.startswith("__"):
            continue
        value: Any = getattr(rik, name)
        assert f"robot_ik.{name}" in anchors, name
        if not (inspect.isclass(value) and dataclasses.is_dataclass(value)):
            continue
        described = " ".join(text_of_entry(page, f"robot_ik.{name}").split())
        for field in dataclasses.fields(value):
            if field.init and not field.name.startswith("_"):
                assert re.search(rf"\b{field.name}\b", described), f"{name}.{field.name}"


def text_of_entry(page: str, anchor: str) -> str:
    """Return the part of the API page from an anchor to the next class or function."""
    start = page.index(f'id="{anchor}"')
    following = re.compile(r'<dl class="py (class|function|exception|data)">')
    match = following.search(page, start)
    return page[start : match.start() if match else None]


def test_the_api_page_has_no_artefacts_of_docstrings(site: Path) -> None:
    text = text_of(site / "docs" / "reference" / "api.html")
    for artefact in ("TYPE:", "Type:", "DEFAULT:", ":class:", ":func:", ":meth:", "`_"):
        assert artefact not in text, text[text.index(artefact) - 200 :][:300]
    # A section that was not recognised stays as text.
    for section in ("Args:", "Attributes:"):
        assert not re.search(rf"^{section}$", text, re.MULTILINE), section


def test_the_page_of_commands_has_the_help_of_each(site: Path) -> None:
    from robot_ik.commands import main as cli

    page = site / "docs" / "reference" / "cli.html"
    headings = set(re.findall(r"<h2>([^<]+)<", page.read_text(encoding="utf-8")))
    text = text_of(page)
    for rows in cli.GROUPS.values():
        for row in rows:
            assert row.name in headings
            assert f"robot-ik {row.name}" in text


def test_every_page_has_a_picture_text_and_no_broken_picture(site: Path) -> None:
    for page in site.rglob("*.html"):
        for tag in re.findall(r"<img [^>]*>", page.read_text(encoding="utf-8")):
            source = re.findall(r'src="([^"]+)"', tag)[0]
            if not source.startswith(("data:", "http")):
                assert (page.parent / source).is_file(), f"{page.name}: {source}"
            assert 'alt="' in tag, f"{page.name}: {tag}"


def test_the_menu_has_all_parts(site: Path) -> None:
    page = (site / "docs" / "index.html").read_text(encoding="utf-8")
    captions = re.findall(r'<span class="caption-text">([^<]+)</span>', page)
    assert captions == ["Tutorial", "How-to", "Reference", "Theory", "Project"]
    assert re.search(r'<li class="toctree-l1"><a[^>]*README.html">README</a>', page)
    for file in ("mark.svg", "logo_light.svg", "logo_dark.svg", "site.css"):
        assert (site / "_static" / file).is_file()


def test_the_root_leads_to_the_landing_page(site: Path) -> None:
    assert "url=docs/index.html" in (site / "index.html").read_text(encoding="utf-8")


def test_read_the_docs_builds_as_make_does() -> None:
    config = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text(encoding="utf-8"))
    (build,) = [line for line in config["build"]["commands"] if "sphinx" in line]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (made,) = re.findall(r"-m sphinx (.*) -d build/doctrees (-c docs \.) ", makefile)
    assert " ".join(made) in build
    # `python -m sphinx` imports the checkout, in which only an editable install finds all packages.
    assert any(
        "pip install" in line and "--editable" in line for line in config["build"]["commands"]
    )
    workflow = yaml.safe_load(
        (ROOT / ".github" / "workflows" / "docs.yml").read_text(encoding="utf-8")
    )
    steps = [step.get("run", "") for step in workflow["jobs"]["build"]["steps"]]
    assert "make docs" in steps
