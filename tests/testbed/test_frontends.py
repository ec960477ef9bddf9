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
from robot_ik.commands.main import main
from robot_ik.errors import ConfigError, MissingExtraError
from robot_ik.jobs.testbed import film, film_in_process
from robot_ik.testbed.arrangement import INSTANCE_COLOURS
from robot_ik.testbed.commands import (
    CommandLog,
    MoveGoal,
    SetCount,
    SetMethod,
    SetSpeed,
    Start,
)
from robot_ik.testbed.frontends.recorder import Recorder
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.loop import last_view, replayed
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

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
    numbers = tmp_path / "bed.csv"
    seen: list[float] = []
    view = film(
        SCRIPT,
        out,
        numbers=numbers,
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
    ground = int((frames[-1].min(axis=-1) > 190).sum())
    assert 0.3 < ground / (240 * 320) < 0.95, "no robot"
    with numbers.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1 + 2 * 19 and {row["method"] for row in rows[4:]} == {"dls", "ccd"}
    assert float(rows[-1]["error_m"]) == view.instances[1].error


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


def test_a_log_without_a_length_is_no_film(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    CommandLog(Start("tabletop_puma"), ()).save(tmp_path / "a.jsonl")
    assert main(["video", str(tmp_path / "a.jsonl"), str(tmp_path / "a.png")]) == 2
    assert "--seconds" in capsys.readouterr().err
    assert main(["video", str(tmp_path / "a.png")]) == 2
    assert main(["video", "--seconds", "1", "--count", "3", str(tmp_path / "a.png")]) == 2
    assert main(["video", str(tmp_path / "a.jsonl"), str(tmp_path / "a.png"), "--count", "2"]) == 2
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            "view --seconds 0",
            "--seconds: 0 s; allowed: above 0, at most 1000000 (default: until Ctrl-C)",
        ),
        (
            "video --seconds 0 a.png",
            "--seconds: 0 s; allowed: above 0, at most 1000000 (default: as long as",
        ),
        (
            "view --arm tabletop_puma",
            "--arm: tabletop_puma is for servos, and no bus is named; allowed",
        ),
        (
            "view --on-exit hold",
            "--on-exit: hold is for servos, and no bus is named; allowed: with",
        ),
        (
            "view --bus sim --viewer recorder",
            "--bus: the recorder moves no servos; allowed: with --viewer",
        ),
    ],
)
def test_what_would_be_ignored_is_refused(
    words: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == 2
    assert text in capsys.readouterr().err


def test_a_replay_says_whether_it_ends_in_the_same_bits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wanted: str
) -> None:
    good = tmp_path / "good.jsonl"
    bad = tmp_path / "bad.jsonl"
    CommandLog(SCRIPT.start, SCRIPT.commands, SCRIPT.ticks, wanted).save(good)
    CommandLog(SCRIPT.start, SCRIPT.commands, SCRIPT.ticks, "0" * 32).save(bad)
    assert main(["view", "--replay", str(good)]) == 0
    assert "the same bits" in capsys.readouterr().err
    assert main(["view", "--replay", str(bad)]) == 1
    assert "other bits" in capsys.readouterr().err
    assert main(["view", "--replay", str(tmp_path / "none.jsonl")]) == 2
    assert main(["view", "--replay", str(good), "--count", "2"]) == 2


def test_view_opens_the_page_writes_its_log_and_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser", reason="needs the extra web")
    log = tmp_path / "log.jsonl"
    arguments = (
        "view --robot tabletop_puma --no-open --no-camera --port 8720 --viewer browser "
        "--seconds 0.5 --log"
    )
    assert main([*arguments.split(), str(log)]) == 0
    assert "http://127.0.0.1:87" in capsys.readouterr().out
    again = CommandLog.load(log)
    assert again.start.robot == "tabletop_puma" and again.digest
    assert main([*arguments.split(), str(log)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*arguments.split(), str(log), "--overwrite"]) == 0


def test_view_shows_the_robot_of_the_arm_that_is_named(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs the extra web")
    log = tmp_path / "log.jsonl"
    words = (
        "view --bus sim --arm puma560 --no-open --no-camera --port 8725 --viewer browser "
        "--seconds 0.2"
    )
    assert main([*words.split(), "--log", str(log)]) == 0
    assert CommandLog.load(log).start.robot == "puma560"


def test_a_film_of_the_recorder_is_overwritten_only_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "testbed.mp4").write_text("mine")
    arguments = ["view", "--robot", "tabletop_puma", "--viewer", "recorder", "--seconds", "0.02"]
    assert main(arguments) == 2
    assert (
        "--overwrite" in capsys.readouterr().err
        and (tmp_path / "testbed.mp4").read_text() == "mine"
    )
    assert main([*arguments, "--overwrite", "--log", "log.jsonl"]) == 0
    assert (tmp_path / "testbed.mp4").stat().st_size > 1000
    assert (
        main(["view", "--replay", "log.jsonl"]) == 0 and "the same bits" in capsys.readouterr().err
    )


def test_view_that_is_ended_from_outside_writes_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="needs the extra web")
    from robot_ik.cli import view

    def ended(*_: object) -> None:
        raise SystemExit(143)

    monkeypatch.setattr(view, "_loop", ended)
    log = tmp_path / "log.jsonl"
    words = "view --robot tabletop_puma --no-open --no-camera --port 8730 --viewer browser"
    assert main([*words.split(), "--log", str(log)]) == 143
    assert CommandLog.load(log).start.robot == "tabletop_puma"


@pytest.mark.parametrize("suffix", [".gif", ""])
def test_a_film_that_is_interrupted_says_what_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    if suffix:
        pytest.importorskip("av", reason="needs the extra video")
    drawn: list[View] = []
    draw = Recorder.draw

    def interrupted(self: Recorder, view: View) -> object:
        drawn.append(view)
        if len(drawn) > 3:
            raise KeyboardInterrupt
        return draw(self, view)

    monkeypatch.setattr(Recorder, "draw", interrupted)
    out = tmp_path / f"film{suffix}"
    small = ["--robot", "tabletop_puma", "--seconds", "2", "--size", "96", "64"]
    assert main(["video", str(out), *small]) == 130
    assert f"kept until here: {out}" in capsys.readouterr().err.replace("\n", "") and out.exists()


def test_the_viewer_is_chosen_and_said(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from robot_ik.camera.drawing.probe import Probe
    from robot_ik.cli import view

    monkeypatch.setattr(view, "find_spec", lambda name: name)
    assert view.choose_viewer("auto") == "browser"
    monkeypatch.setattr(view, "find_spec", lambda name: None)
    monkeypatch.setattr(view, "probe_display", lambda timeout: Probe(True, "display opened"))
    assert view.choose_viewer("auto") == "window"
    assert "robot-ik-testbed[web]" in capsys.readouterr().err
    monkeypatch.setattr(view, "probe_display", lambda timeout: Probe(False, "no display"))
    assert view.choose_viewer("auto") == "recorder"
    assert "recorder" in capsys.readouterr().err
    with pytest.raises(MissingExtraError, match="viser"):
        view.choose_viewer("browser")


def test_wrong_options_of_view_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", "--count", "3", "--no-open"]) == 2
    assert main(["view", "--robot", "puma561", "--no-open"]) == 2
    for wrong, said in (
        ("--method lm ccd", "2 methods for 1 robot"),
        ("--method newton", "newton"),
        ("--method dls lm ccd sdls bfgs", "methods"),
        ("--seed -5", "seed"),
        ("--seconds -1", "--seconds"),
        ("--port 99999", "99999"),
        ("--host 192.0.2.1", "192.0.2.1"),
    ):
        arguments = f"view --robot tabletop_puma --viewer browser --no-open --no-camera {wrong}"
        assert main(arguments.split()) == 2
        assert said in capsys.readouterr().err
    assert main(["view", "--bus", "sim", "--robot", "panda", "--no-open"]) == 2
    said = capsys.readouterr().err
    assert (
        "panda: comes without an arm file" in said and "puma560" in said and "arm.toml" not in said
    )
