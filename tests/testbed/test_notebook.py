"""The page in a frame: in a notebook on this machine, and in no other page."""

from __future__ import annotations

import http.server
import threading
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

pytest.importorskip("viser", reason="needs the extra web")
from robot_ik.testbed.commands import Start
from robot_ik.testbed.frontends.gate import response_headers
from robot_ik.testbed.frontends.notebook import NotebookPage
from tests.doc_pages import script

measure_page = script("measure_page")

PATIENCE = 120_000
"""ms: a browser without a GPU on a busy machine."""


@contextmanager
def notebook_server(body: str) -> Iterator[str]:
    """Serve a page with a body on this machine, as a notebook server does."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(f"<!doctype html><body>{body}</body>".encode())

        def log_message(self, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://localhost:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def chromium(require: Callable[..., str]) -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright (the extra dev)")
    path = require("browser", "opens the page")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(measure_page.CHROMIUM))
        yield browser
        browser.close()


def test_a_notebook_on_this_machine_shows_the_page(chromium: Any) -> None:
    with (
        NotebookPage(Start("tabletop_puma"), port=8680) as page,
        notebook_server(page._repr_html_()) as address,
    ):
        window = chromium.new_page()
        window.goto(address)
        frame = window.frame_locator("iframe")
        frame.get_by_text("STOP", exact=True).first.wait_for(timeout=PATIENCE)
        frame.get_by_text("ball met").first.wait_for(timeout=PATIENCE)  # a view has come
        window.close()


def test_only_pages_of_this_machine_may_frame_it() -> None:
    with (
        NotebookPage(Start("tabletop_puma"), port=8682) as page,
        urllib.request.urlopen(page.url) as answer,
    ):
        policy = answer.headers["Content-Security-Policy"]
        assert "frame-ancestors http://localhost:* http://127.0.0.1:*;" in policy
        assert "X-Frame-Options" not in answer.headers


def test_by_default_no_page_may_frame_it() -> None:
    headers = response_headers()
    assert headers["X-Frame-Options"] == "DENY"
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]


def test_a_closed_page_can_be_closed_again() -> None:
    page = NotebookPage(Start("tabletop_puma"), port=8684)
    page.close()
    page.close()
