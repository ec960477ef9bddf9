"""One script of commands, every front end: the same view; and what the recorder writes."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import ConfigError
from robot_ik.testbed.arrangement import INSTANCE_COLOURS
from robot_ik.testbed.commands import (
    CommandLog,
    MoveGoal,
    SetCount,
    SetMethod,
    SetSpeed,
    Start,
)
from robot_ik.testbed.filming import film, film_in_process
from robot_ik.testbed.frontends.recorder import Recorder
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.loop import last_view, replayed
from robot_ik.testbed.session import Session

SCRIPT = CommandLog(
    Start("tabletop_puma"),
    (
        (2, SetCount(2)),
        (4, SetMethod(1, "ccd")),
        (10, SetSpeed(2.0)),
        (20, MoveGoal((0.2, 0.05, 0.1))),
    ),
    ticks=40,
)


def drawn(make: Callable[[Session], Any]) -> str:
    """Digest of the script's last view, each view drawn by a front end."""
    front: Any = None
    try:
        for session in replayed(SCRIPT):
            front = front or make(session)
            front.draw(session.view())
        return session.view().digest()
    finally:
        if hasattr(front, "close"):
            front.close()


@pytest.fixture(scope="module")
def wanted() -> str:
    return last_view(SCRIPT).digest()


def test_the_same_script_gives_the_same_view_in_the_recorder(wanted: str) -> None:
    assert drawn(lambda session: Recorder(session, (64, 48))) == wanted


def test_the_same_script_gives_the_same_view_in_the_browser(wanted: str) -> None:
    pytest.importorskip("viser", reason="needs the extra web")
    from robot_ik.testbed.frontends.browser import Page
    from robot_ik.testbed.frontends.page_server import PageServer

    assert drawn(lambda session: Page(session, PageServer(port=8710))) == wanted


def test_no_key_means_two_things() -> None:
    for column in ("code", "window"):
        keys = [getattr(key, column) for key in KEYMAP if getattr(key, column)]
        assert len(set(keys)) == len(keys)


def test_the_key_for_methods_goes_through_all_of_them() -> None:
    key = next(key for key in KEYMAP if key.about.startswith("next method"))
    method = "dls"
    seen = set()
    for _ in rik.SOLVERS:
        command = key.command(SimpleNamespace(instances=[SimpleNamespace(method=method)]))  # type: ignore
        assert isinstance(command, SetMethod)
        seen.add(method := command.method)
    assert seen == set(rik.SOLVERS)


def near(image: Any, colour: tuple[int, int, int], within: int = 40) -> int:
    """Number of pixels (RGB) near a colour."""
    return int((np.abs(image.astype(int) - colour).max(axis=-1) < within).sum())


def ball_pixels(image: Any) -> int:
    """Number of orange pixels (RGB): the ball is shaded, so only its hue is that of the goal."""
    hue, saturation, value = cv2.split(cv2.cvtColor(image, cv2.COLOR_RGB2HSV))
    return int(((abs(hue.astype(int) - 14) <= 5) & (saturation > 150) & (value > 80)).sum())


def test_a_film_is_read_back_and_shows_the_robot_moving(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="needs the extra video")
    out = tmp_path / "bed.mp4"
    record = tmp_path / "bed.csv"
    seen: list[float] = []
    view = film(
        SCRIPT,
        out,
        record=record,
        size=(320, 240),
        rate_hz=30.0,
        progress=lambda phase, share: seen.append(share),
    )
    assert view.tick == 40 and seen == [k / 40 for k in range(1, 41)]
    with av.open(str(out)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 20 and frames[0].shape == (240, 320, 3)
    assert np.abs(frames[-1].astype(int) - frames[3].astype(int)).max() > 60
    assert ball_pixels(frames[-1]) > 20, "no ball"
    assert near(frames[-1], INSTANCE_COLOURS[1], 60) > 20, "no second instance"
    with record.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1 + 2 * 19
    assert {row["method"] for row in rows[4:]} == {"dls", "ccd"}
    assert float(rows[-1]["error_m"]) == view.instances[1].error
    ground = int((frames[-1].min(axis=-1) > 190).sum())
    assert 0.3 < ground / (240 * 320) < 0.95, "no robot"


def test_a_film_is_made_by_another_process(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="needs the extra video")
    log = CommandLog(Start("tabletop_puma"), (), ticks=8)
    file = tmp_path / "film.mp4"
    file.write_bytes(film_in_process(log))
    with av.open(str(file)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 4
    with pytest.raises(ConfigError):
        film_in_process(CommandLog(Start("tabletop_puma"), ()))


def test_a_gif_is_written(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="needs the extra video")
    film(SCRIPT, tmp_path / "a.gif", size=(96, 64), seconds=0.2)
    with av.open(str(tmp_path / "a.gif")) as container:
        assert sum(1 for _ in container.decode(video=0)) == 6
