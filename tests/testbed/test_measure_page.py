"""`docs/make/measure_page.py`: what it prints, and that its client sees what the page sends."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks.quantity import Quantity
from robot_ik.testbed.commands import Start
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session

pytest.importorskip("viser", reason="needs the extra web")
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer
from tests.doc_pages import script
from tests.waiting import LONG

bench = script("measure_page")


def test_values_beyond_their_target_or_not_measured_are_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        Quantity("good", 0.5, "ms", 1.0),
        Quantity("missed", 9.0, "s", 8.0),
        Quantity("not there", float("nan"), "s", 8.0, missing="no browser"),
    ]

    def measure(seconds: float, say: object) -> Iterator[Quantity]:
        yield from rows

    monkeypatch.setattr(bench, "measure_page", measure)
    monkeypatch.setattr(sys, "argv", ["measure_page.py"])
    assert bench.main() == 1
    text = capsys.readouterr().out
    assert "0.5 ms" in text and "FAIL" in text and "no browser" in text
    rows.pop(1)
    assert bench.main() == 1 and "FAIL" not in capsys.readouterr().out
    rows.pop()
    assert bench.main() == 0


def test_its_client_drags_the_ball_and_sees_the_arm_move() -> None:
    stop = threading.Event()
    positions = ((0.2, 0.05, 0.1), (0.2, -0.05, 0.1))
    with (
        Session(Start("tabletop_puma"), beside=False) as session,
        Page(session, PageServer(port=8670)) as page,
    ):
        loop = threading.Thread(target=run, args=(session, page.draw, stop))
        loop.start()
        try:
            with bench.PageClient(page.url) as client:
                # A machine that has no kernels yet compiles them first.
                end = time.monotonic() + LONG
                moved = False
                received = 0
                drags = 0
                while not (
                    moved and any(np.allclose(session.ball.position, one) for one in positions)
                ):
                    assert time.monotonic() < end, f"moved: {moved}, ball: {session.ball.position}"
                    # Again and again: the first packet may come when the arm is already there.
                    client.drag_ball(positions[drags % 2])
                    drags += 1
                    until = time.monotonic() + 1.0
                    while not moved and time.monotonic() < until:
                        size, moved = client.receive(0.2)
                        received += size
            assert received > 50_000, "meshes come with the first packets"
        finally:
            stop.set()
            loop.join()
