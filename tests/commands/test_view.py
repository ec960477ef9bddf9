"""``robot-ik view``: its options, the page and the window, replays and videos."""

from __future__ import annotations

import csv
import webbrowser
from pathlib import Path
from typing import Any

import cv2
import pytest

from robot_ik.camera.drawing import probe
from robot_ik.camera.drawing.probe import Probe
from robot_ik.commands import view
from robot_ik.commands.terminal import Terminal
from robot_ik.commands.view import View, choose_viewer, parse_host
from robot_ik.errors import MissingExtraError, OptionError
from robot_ik.testbed.commands import CommandLog, MoveGoal, SetMethod, Start
from robot_ik.testbed.frontends.recorder import Recorder
from robot_ik.testbed.loop import last_view
from robot_ik.testbed.presets import PRESETS
from robot_ik.testbed.session import Session
from tests.waiting import wait_for

SCRIPT = CommandLog(
    Start("tabletop_puma", 2),
    ((4, SetMethod(1, "ccd")), (20, MoveGoal((0.2, 0.05, 0.1)))),
    ticks=40,
)
SMALL = ("--size", "96", "64")


@pytest.fixture(scope="module")
def digest() -> str:
    return last_view(SCRIPT).digest()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses that the command opens in the system's browser."""
    pytest.importorskip("viser", reason="needs the extra web")
    addresses: list[str] = []
    monkeypatch.setattr(webbrowser, "open", addresses.append)
    return addresses


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--arm tabletop_puma", "--arm: for servos, and no bus is named; allowed: with --bus"),
        ("--on-exit hold", "--on-exit: for servos, and no bus is named"),
        ("--bus sim --video a.png --seconds 1", "--bus: a video moves no servos"),
        ("--viewer window --video a.png --seconds 1", "--viewer: a video needs no viewer"),
        ("--host 127.0.0.1 --video a.png --seconds 1", "--host: a video needs no viewer"),
        ("--video a.png", "--seconds: the video has no duration; allowed: --seconds S"),
        ("--record a.csv", "--record: there is no video; allowed: with --video FILE"),
        ("--size 96 64", "--size: there is no video"),
        ("--rate 10", "--rate: there is no video"),
        ("--viewer window --host 127.0.0.1", "--host: MuJoCo's window has no address"),
        ("--preset arkineman --robot lion", "--robot: given with --preset"),
        ("--preset arkineman --solver lm", "--solver: given with --preset"),
        ("--preset arkinemann --host 127.0.0.1", "there is no preset 'arkinemann'"),
        ("--solver lm dls ccd", "--solver: 3 solvers; allowed: 1, 2 or 4"),
        ("--robot puma561 --host 127.0.0.1", "puma560"),
        ("--host 127.0.0.1:http", "--host: cannot read '127.0.0.1:http'; allowed: ADDR or ADDR:P"),
    ],
)
def test_options_that_would_be_ignored_are_refused(
    words: str, text: str, robot_ik: Any, opened: list[str], tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    run = robot_ik("view", *words.split())
    run.assert_one_screen_error()
    assert text in run.err
    assert not opened and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--solver newton", "newton"),
        ("--seed -5", "seed"),
        ("--frame nose", "nose"),
        ("--joints joint9", "joint9"),
    ],
)
def test_a_wrong_value_ends_the_command(
    words: str, text: str, robot_ik: Any, opened: list[str]
) -> None:
    pytest.importorskip("viser", reason="needs the extra web")
    run = robot_ik("view", "--robot", "tabletop_puma", "--host", "127.0.0.1:8740", *words.split())
    assert run.code == 2 and text in run.err, run


@pytest.mark.parametrize("host", ["127.0.0.1:99999", "127.0.0.1:0", "192.0.2.1"])
def test_an_address_that_cannot_be_used_is_named(
    host: str, robot_ik: Any, opened: list[str]
) -> None:
    run = robot_ik("view", "--robot", "tabletop_puma", "--host", host)
    run.assert_one_screen_error()
    assert f"cannot listen at {host}" in run.err and "--host" in run.err


def test_a_robot_without_an_arm_file_has_no_servos(robot_ik: Any, opened: list[str]) -> None:
    run = robot_ik("view", "--bus", "sim", "--robot", "panda", "--host", "127.0.0.1:8741")
    assert run.code == 2
    assert "panda: comes without an arm file" in run.err and "puma560" in run.err


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("", ("127.0.0.1", 8080)),
        ("0.0.0.0", ("0.0.0.0", 8080)),
        ("lab-pc:9000", ("lab-pc", 9000)),
        ("::1", ("::1", 8080)),
        ("[::1]", ("::1", 8080)),
        ("[::1]:9000", ("::1", 9000)),
    ],
)
def test_an_address_has_an_optional_port(text: str, address: tuple[str, int]) -> None:
    assert parse_host(text) == address


@pytest.mark.parametrize("text", [":9000", "lab-pc:", "lab-pc:-1", "[]:9000"])
def test_a_malformed_address_is_refused(text: str) -> None:
    with pytest.raises(OptionError, match="ADDR or ADDR:PORT"):
        parse_host(text)


def test_view_opens_the_page_writes_its_log_and_ends(
    tmp_path: Path, robot_ik: Any, opened: list[str]
) -> None:
    log = tmp_path / "log.jsonl"
    words = ("view", "--robot", "tabletop_puma", "--host", "127.0.0.1:8720", "--seconds", 0.5)
    run = robot_ik(*words, "--log", log)
    assert run.code == 0 and "the testbed is at http://127.0.0.1:87" in run.out
    assert not opened
    again = CommandLog.load(log)
    assert again.start.robot == "tabletop_puma" and again.digest
    run = robot_ik(*words, "--log", log)
    run.assert_one_screen_error()
    assert "--overwrite" in run.err
    assert robot_ik(*words, "--log", log, "--overwrite").code == 0


def test_the_page_is_opened_unless_only_its_address_is_given(
    robot_ik: Any, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view, "DEFAULT_PORT", 8742)
    words = ("view", "--robot", "tabletop_puma", "--seconds", "0.05")
    assert robot_ik(*words).code == 0
    assert len(opened) == 1 and opened[0].startswith("http://127.0.0.1:874")
    assert robot_ik(*words, "--host", "127.0.0.1:8742").code == 0
    assert len(opened) == 1
    assert robot_ik(*words, "--host", "127.0.0.1:8742", "--viewer", "browser").code == 0
    assert len(opened) == 2


def test_what_a_session_begins_with(tmp_path: Path, robot_ik: Any, opened: list[str]) -> None:
    log = tmp_path / "log.jsonl"
    words = ("view", "--host", "127.0.0.1:8725", "--seconds", "0.05", "--overwrite", "--log", log)
    for options, start in (
        (("--bus", "sim", "--arm", "puma560"), Start("puma560")),
        (("--bus", "sim"), Start("tabletop_puma")),
        (
            ("--robot", "humanoid", "--frame", "left_hand", "--base", "torso", "--seed", "3"),
            Start("humanoid", seed=3, tool="left_hand", base="torso"),
        ),
        (
            ("--joints", "joint1", "joint2", "joint3", "--solver", "lm", "dls"),
            Start("puma560", 2, ("lm", "dls"), joints=("joint1", "joint2", "joint3")),
        ),
    ):
        run = robot_ik(*words, *options)
        assert run.code == 0, run
        assert CommandLog.load(log).start == start


def test_a_preset_sets_the_robot_and_its_first_commands(
    tmp_path: Path, robot_ik: Any, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_until_taken(session: Session, *_: object) -> None:
        def taken() -> bool:
            session.tick()
            return len(session.log().commands) == len(PRESETS["arkineman"].commands)

        wait_for(taken)

    monkeypatch.setattr(view, "run_until_end", run_until_taken)
    log = tmp_path / "log.jsonl"
    words = ("--host", "127.0.0.1:8727", "--log", log)
    assert robot_ik("view", "--preset", "ARKineMan", *words).code == 0
    preset = PRESETS["arkineman"]
    session = CommandLog.load(log)
    assert session.start.robot == preset.robot
    assert tuple(command for _, command in session.commands) == preset.commands


def test_a_signal_does_not_lose_the_log(
    tmp_path: Path, robot_ik: Any, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(*_: object) -> None:
        raise SystemExit(143)

    monkeypatch.setattr(view, "run_until_end", end)
    log = tmp_path / "log.jsonl"
    run = robot_ik("view", "--robot", "tabletop_puma", "--host", "127.0.0.1:8730", "--log", log)
    assert run.code == 143
    assert CommandLog.load(log).start.robot == "tabletop_puma"


def test_ctrl_c_is_the_end_of_a_session(
    robot_ik: Any, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from robot_ik.testbed import loop

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "run", interrupt)
    run = robot_ik("view", "--robot", "tabletop_puma", "--host", "127.0.0.1:8732")
    assert (run.code, run.err) == (0, "")


def test_a_replay_ends_in_the_same_bits_or_the_command_fails(
    tmp_path: Path, robot_ik: Any, digest: str
) -> None:
    file = tmp_path / "log.jsonl"
    for wanted, code, verdict in (
        (digest, 0, "2 commands, 40 ticks: the same bits"),
        ("0" * 32, 1, "2 commands, 40 ticks: other bits"),
        ("", 0, "the log has no digest to compare with"),
    ):
        CommandLog(SCRIPT.start, SCRIPT.commands, SCRIPT.ticks, wanted).save(file)
        run = robot_ik("view", "--replay", file)
        assert run.code == code and verdict in run.out
        assert ("the versions of robot_ik or numba" in run.err) == (code == 1)
    assert "ccd" in run.out and "tabletop_puma 2" in run.out
    robot_ik("view", "--replay", tmp_path / "none.jsonl").assert_one_screen_error()


@pytest.mark.parametrize(
    "options",
    [
        "--solver lm",
        "--robot lion",
        "--preset arkineman",
        "--seed 3",
        "--seconds 1",
        "--log b.jsonl",
        "--viewer window",
        "--host 127.0.0.1",
    ],
)
def test_a_log_decides_what_its_replay_does(options: str, tmp_path: Path, robot_ik: Any) -> None:
    file = tmp_path / "log.jsonl"
    SCRIPT.save(file)
    run = robot_ik("view", "--replay", file, *options.split())
    run.assert_one_screen_error()
    assert f"{options.split()[0]}: " in run.err


def test_a_replay_is_filmed_and_compared(tmp_path: Path, robot_ik: Any, digest: str) -> None:
    log = tmp_path / "log.jsonl"
    out = tmp_path / "last.png"
    record = tmp_path / "rows.csv"
    CommandLog(SCRIPT.start, SCRIPT.commands, SCRIPT.ticks, digest).save(log)
    words = ("view", "--replay", log, "--video", out, *SMALL, "--record", record, "--rate", 20)
    run = robot_ik(*words)
    assert run.code == 0, run
    assert f"{out}: 0.7 s of tabletop_puma" in run.out and "the same bits" in run.out
    assert cv2.imread(str(out)).shape == (64, 96, 3)
    with record.open() as file:
        rows = [row for row in csv.DictReader(file) if row["robot"] == "1"]
    assert len(rows) == 14, "20 pictures a second of 40 ticks"
    cut = robot_ik(*words, "--seconds", "0.1", "--overwrite")
    assert cut.code == 0 and "bits" not in cut.out, "the end was not reached"


def test_a_log_without_a_length_is_no_video(tmp_path: Path, robot_ik: Any) -> None:
    log = tmp_path / "a.jsonl"
    CommandLog(Start("tabletop_puma"), ()).save(log)
    run = robot_ik("view", "--replay", log, "--video", tmp_path / "a.png")
    run.assert_one_screen_error()
    assert "--seconds" in run.err and not (tmp_path / "a.png").exists()


def test_a_video_has_a_log_that_repeats_it(tmp_path: Path, robot_ik: Any) -> None:
    log = tmp_path / "log.jsonl"
    words = ("--robot", "tabletop_puma", "--solver", "lm", "dls", "--seconds", "0.1", *SMALL)
    run = robot_ik("view", *words, "--video", tmp_path / "a.png", "--log", log)
    assert run.code == 0, run
    run = robot_ik("view", "--replay", log)
    assert run.code == 0 and "the same bits" in run.out
    assert CommandLog.load(log).start.methods == ("lm", "dls")


def test_an_existing_video_is_kept(tmp_path: Path, robot_ik: Any) -> None:
    out = tmp_path / "a.png"
    out.write_text("precious")
    words = ("view", "--robot", "tabletop_puma", "--seconds", "0.1", *SMALL, "--video", out)
    run = robot_ik(*words)
    run.assert_one_screen_error()
    assert "--overwrite" in run.err and out.read_text() == "precious"
    assert robot_ik(*words, "--overwrite").code == 0
    assert cv2.imread(str(out)).shape == (64, 96, 3)


@pytest.mark.parametrize("suffix", [".gif", ""])
def test_an_interrupted_video_is_named(
    tmp_path: Path, robot_ik: Any, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    if suffix:
        pytest.importorskip("av", reason="needs the extra video")
    drawn: list[object] = []
    draw = Recorder.draw

    def interrupted(self: Recorder, session_view: Any) -> object:
        drawn.append(session_view)
        if len(drawn) > 3:
            raise KeyboardInterrupt
        return draw(self, session_view)

    monkeypatch.setattr(Recorder, "draw", interrupted)
    out = tmp_path / f"film{suffix}"
    run = robot_ik("view", "--robot", "tabletop_puma", "--seconds", "2", *SMALL, "--video", out)
    assert run.code == 130 and out.exists()
    assert run.err.endswith(f"kept until here: {out}\ninterrupted\n")


def machine(monkeypatch: pytest.MonkeyPatch, *, page: bool, display: bool) -> None:
    """Simulate a machine with or without the extra ``web`` and a display."""
    found = Probe(display, "display opened" if display else "no display")
    monkeypatch.setattr(view, "find_spec", lambda name: name if page else None)
    monkeypatch.setattr(probe, "probe_display", lambda timeout: found)


def test_the_front_end_is_that_of_the_machine(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = Terminal()
    machine(monkeypatch, page=True, display=True)
    assert choose_viewer(None, terminal) == "browser"
    assert choose_viewer("window", terminal) == "window"
    assert capsys.readouterr().err == ""
    machine(monkeypatch, page=False, display=True)
    assert choose_viewer(None, terminal) == "window"
    assert "robot-ik-testbed[web]" in capsys.readouterr().err
    with pytest.raises(MissingExtraError, match="viser"):
        choose_viewer("browser", terminal)


def test_a_machine_without_page_and_display_films(
    tmp_path: Path, robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("av", reason="needs the extra video")
    monkeypatch.chdir(tmp_path)
    machine(monkeypatch, page=False, display=False)
    words = ("view", "--robot", "tabletop_puma", "--seconds", "0.02")
    out = tmp_path / "testbed.mp4"
    out.write_text("mine")
    run = robot_ik(*words)
    assert run.code == 2 and "--overwrite" in run.err and out.read_text() == "mine"
    run = robot_ik(*words, "--overwrite")
    assert run.code == 0 and "there is no display" in run.err and out.stat().st_size > 1000
    run = robot_ik("view", "--bus", "sim")
    run.assert_one_screen_error()
    assert "--bus: a video moves no servos" in run.err


def test_view_from_python(tmp_path: Path) -> None:
    out = tmp_path / "a.png"
    report = View(robot="tabletop_puma", seconds=0.1, video=out, size=(96, 64)).run()
    assert report.ok and out.exists()
    assert report.facts()["robot"] == "tabletop_puma"
    assert report.facts()["same"] is None
