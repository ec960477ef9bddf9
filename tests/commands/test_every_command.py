"""Properties of every command: signals, closed pipes, poor terminals, files, wrong options."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import re
import signal
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, get_type_hints

import cv2
import numpy as np
import pytest

from robot_ik.camera import device
from robot_ik.camera.device import CameraDevice
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.commands import main as main_module
from robot_ik.commands.main import GROUPS, make_app
from robot_ik.commands.options import OUTPUT, FolderOption
from robot_ik.commands.terminal import Terminal
from robot_ik.commands.usage import command_app, explain, option_owners
from robot_ik.geometry import Pose
from robot_ik.hardware import ports, stop_file
from robot_ik.hardware.config import ArmConfig
from robot_ik.motion import Trajectory
from tests.doc_pages import script

LINES = {
    "solve": "--goal -0.4 -0.1 0.7",
    "reach": "--bus sim --goal -0.42 -0.08 0.80",
    "plan": "--goal -0.4 -0.1 0.7",
    "reachability": "--cell 0.5 --directions 2 --rolls 1",
    "run": "overload",
    "view": "--robot tabletop_puma --video view.png --seconds 0.05 --size 96 64",
    "servo scan": "--bus sim --baud 1000000",
    "servo ports": "",
    "servo setup": "--joint joint1 --bus sim --arm one.toml --from-baud 1000000",
    "servo calibrate": "mine.toml --bus sim --arm one.toml --from-lerobot one.json",
    "servo monitor": "--bus sim --count 1",
    "servo move": "joint1=5 --bus sim",
    "ar": "--seconds 0.05 --size 640 480",
    "servo torque": "off --bus sim",
    "servo reset-fault": "--bus sim",
    "servo record": "wave.csv --bus sim --seconds 0.02",
    "servo replay": "motion.csv --bus sim --arm one.toml",
    "teleop": "--leader so101 --leader-bus sim --follower so101 --follower-bus sim --seconds 0.1",
    "stop": "",
    "figure": "--ball 0.45 -0.25 1.3",
    "robots": "puma560",
    "bench": "--solver lm --robot puma560 --problems cold --count 5",
    "solvers": "dls",
    "camera list": "",
    "camera print": "marker",
    "camera calibrate": "synthetic:charuco?frames=19&seed=7 --views 6",
    "camera detect": "photo.png",
    "camera locate": "photo.png --intrinsics lens.yaml --board marker:7:50",
    "camera handeye": "--views 4",
    "camera verify": "--views 4",
    "doctor": "",
    "completion": "bash",
}
"""Command -> arguments of a short run without hardware that succeeds."""

ENDLESS = ("sim-bus",)
"""Commands that a signal ends in order. They have such tests of their own."""

COMMANDS = [row for rows in GROUPS.values() for row in rows if row.name not in ENDLESS]
NAMES = [row.name for row in COMMANDS]
UNWRITABLE = "/proc/robot_ik"
"""A folder that even root cannot make."""


def command_class(name: str) -> Any:
    """Return the class of a command."""
    return command_app(make_app(), name).default_command


def output_options(name: str) -> list[str]:
    """Return the options of a command that name a file or a folder to write."""
    command = command_class(name)
    hints = get_type_hints(command, include_extras=True)
    names = [
        item.name
        for item in fields(command)
        if OUTPUT in getattr(hints[item.name], "__metadata__", ()) and item.kw_only
    ]
    if issubclass(command, FolderOption):
        names.append("out")
    return ["--" + option.replace("_", "-") for option in names]


OUTPUTS = [(name, option) for name in NAMES for option in output_options(name)]


class FakeArm(NamedTuple):
    """An arm that another program drives."""

    name: str = "arm"
    port: str = "/dev/ttyUSB0"
    pid: int = 1

    def stop(self, policy: str) -> tuple[bool, str]:
        """Confirm the stop."""
        return True, f"{policy}: confirmed"


@pytest.fixture(autouse=True)
def _desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each test in a folder with an arm file, on a machine with a port and a running arm."""
    monkeypatch.chdir(tmp_path)
    config = ArmConfig.generic("one", ["joint1"], [-2.0], [2.0])
    config.save(tmp_path / "one.toml")
    Trajectory([0.0, 0.1], [[0.0], [0.05]], ("joint1",)).save_csv(tmp_path / "motion.csv")
    motor = {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 1000, "range_max": 3000}
    (tmp_path / "one.json").write_text(json.dumps({"joint1": motor}))
    port = SimpleNamespace(device="/dev/ttyUSB0", description="U2D2", vid=1, pid=2)
    monkeypatch.setattr(ports, "serial_ports", lambda: [port])
    monkeypatch.setattr(stop_file, "running_arms", lambda _port: [FakeArm()])


@pytest.fixture(scope="module")
def photo() -> bytes:
    """A photograph of marker 7, as a PNG file."""
    pose = Pose((0.0, 0.0, 0.5), (0.0, 1.0, 0.0, 0.0))
    rng = np.random.default_rng(0)
    image = render_markers(STANDARD_CAMERA, {7: (0.05, pose)}, rng, dictionary="DICT_5X5_50")
    return cv2.imencode(".png", image)[1].tobytes()


@pytest.fixture(autouse=True)
def _camera(tmp_path: Path, photo: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a photograph and its calibration into the folder, and a camera on the machine."""
    monkeypatch.chdir(tmp_path)
    Path("photo.png").write_bytes(photo)
    STANDARD_CAMERA.save("lens.yaml")
    webcam = CameraDevice(0, "/dev/video0", "HD Webcam", "", usable=True, pictures=True)
    monkeypatch.setattr(device, "find_cameras", lambda: (webcam,))


def test_every_command_has_a_line() -> None:
    assert set(LINES) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("number", "code", "text"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")],
)
def test_a_signal_during_a_run(
    name: str, number: int, code: int, text: str, robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal comes when the command reports for the first time."""
    sent = []

    def send(*_: object) -> None:
        if not sent:
            sent.append(number)
            os.kill(os.getpid(), number)

    real_busy = Terminal.busy

    @contextlib.contextmanager
    def busy(*arguments: Any) -> Iterator[None]:
        with real_busy(*arguments):
            send()
            yield

    monkeypatch.setattr(Terminal, "busy", busy)
    for method in ("progress", "print", "print_json_line", "end_progress", "show"):
        real = getattr(Terminal, method)
        wrapped = lambda *arguments, real=real: (send(), real(*arguments))  # noqa: E731
        monkeypatch.setattr(Terminal, method, wrapped)
    run = robot_ik(*name.split(), *LINES[name].split())
    assert run.code == code, run
    assert run.err.splitlines()[-1] == text and "Traceback" not in run.err
    assert not list(Path().rglob("*.lock"))


class ClosedPipe(io.StringIO):
    """A standard output with a closed reader."""

    def write(self, text: str) -> int:
        raise BrokenPipeError

    flush = write  # type: ignore[assignment]


@pytest.mark.parametrize("name", NAMES)
def test_a_closed_pipe_is_quiet(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdout", ClosedPipe())
    code = main_module.main([*name.split(), *LINES[name].split()])
    err = capsys.readouterr().err
    assert code == 128 + signal.SIGPIPE, err
    assert "Traceback" not in err and "error" not in err


@pytest.mark.parametrize("name", NAMES)
def test_a_narrow_ascii_output_without_a_terminal(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    streams = {}
    for stream in ("stdout", "stderr"):
        streams[stream] = io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)
        monkeypatch.setattr(sys, stream, streams[stream])
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.setenv("COLUMNS", "60")
    code = main_module.main([*name.split(), *LINES[name].split()])
    out, err = (stream.buffer.getvalue().decode("ascii") for stream in streams.values())  # type: ignore[attr-defined]
    assert code == 0, (out, err)
    assert "\x1b" not in out + err
    # "deg" and "..." are longer than the characters they stand for. A verdict is never folded.
    wide = [line for line in out.splitlines() if "  " in line.strip() and len(line) > 72]
    assert len(wide) <= 1 or name == "completion", out


@pytest.mark.parametrize("name", NAMES)
def test_a_narrow_ascii_help(name: str, robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    run = robot_ik(*name.split(), "--help")
    assert run.code == 0 and run.err == ""
    assert max(map(len, run.out.splitlines())) <= 60


@pytest.mark.parametrize("name", NAMES)
def test_descriptions_of_options_are_paragraphs(name: str, robot_ik: Any) -> None:
    for panel in robot_ik(*name.split(), "--help").out.split("╭")[1:]:
        continued = re.findall(r"^│( {9,})\S", panel, re.MULTILINE)
        assert len(set(map(len, continued))) <= 1, panel


@pytest.mark.parametrize(("name", "option"), OUTPUTS)
def test_an_unwritable_folder_is_refused_before_the_run(
    name: str, option: str, robot_ik: Any
) -> None:
    line = [*name.split(), *LINES[name].split(), option, f"{UNWRITABLE}/file.csv"]
    run = robot_ik(*line)
    run.assert_one_screen_error()
    assert UNWRITABLE in run.err


@pytest.mark.parametrize(("name", "option"), OUTPUTS)
def test_an_existing_output_is_kept(name: str, option: str, robot_ik: Any, tmp_path: Path) -> None:
    target = tmp_path / "results"
    if option == "--out" and issubclass(command_class(name), FolderOption):
        target.mkdir()
        file = target / "notes.txt"
    else:
        file = target
    file.write_text("precious")
    run = robot_ik(*name.split(), *LINES[name].split(), option, target)
    run.assert_one_screen_error()
    assert "--overwrite" in run.err and file.read_text() == "precious"


def test_an_option_of_another_command_draws_no_suggestion() -> None:
    app = make_app()
    owners = option_owners(app, NAMES)
    foreign = [
        (name, flag)
        for name in NAMES
        for flag, commands in owners.items()
        if name not in commands and flag.startswith("--")
    ]
    for name, flag in foreign[::7]:  # 7 is prime to the number of commands, so all flags are tried
        with pytest.raises(main_module.CycloptsError) as caught:
            app.parse_args([*name.split(), flag, "1"])
        text = str(explain(caught.value, NAMES, lambda: owners))
        assert "did you mean" not in text, (name, flag, text)
    assert len(foreign) > 700


WORDS = (
    *(
        "--",
        "-",
        "=",
        "--=",
        "-x",
        "-1",
        "--goal=",
        "--goal=1",
        "nan",
        "inf",
        "1e400",
        "--1",
        "-h=",
    ),
    *("'", '"', "\\", "\t", "\x7f", "ä", "关", "🦾", "a" * 300, "%s", "{}", "[bold]", "$HOME", "*"),
    *(
        "--no-json",
        "--json=maybe",
        "--json",
        "--speed",
        "--seed",
        "0x10",
        "1_000",
        "1,5",
        "--help=",
    ),
    *(
        "none",
        "None",
        "true",
        "--bus",
        "sim",
        "--robot",
        "puma560",
        "--set",
        "a=",
        "=b",
        "--_",
        "-",
    ),
)


@pytest.mark.parametrize("seed", range(4))
def test_hostile_lines_are_one_sentence(
    seed: int, robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """100 random lines a seed. A line that happens to be right is not run."""
    monkeypatch.setattr(main_module, "_run", lambda *_, **__: 0)
    rng = random.Random(seed)
    refused = 0
    for _ in range(100):
        words = rng.choice(NAMES).split() if rng.random() < 0.8 else []
        words += rng.choices(WORDS, k=rng.randint(1, 5))
        run = robot_ik(*words)
        assert run.code in (0, 2), (words, run)
        if run.code == 0 or run.out:
            continue
        refused += 1
        assert run.err.startswith("error: "), (words, run)
        assert len(run.err.splitlines()) <= 2, (words, run)
        assert not re.search(r"Traceback|bug in robot_ik|<class|Cyclopts|\[bold ", run.err), words
    assert refused > 60


def test_a_flag_has_one_meaning_and_the_page_lists_it() -> None:
    meanings: defaultdict[str, set[str]] = defaultdict(set)
    rows = script("tables").flag_rows()
    for flag, meaning, _ in rows:
        meanings[flag].add(meaning)
    several = {flag: texts for flag, texts in meanings.items() if len(texts) > 1}
    assert not several
