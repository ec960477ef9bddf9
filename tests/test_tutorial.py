"""The tutorial: six pages, a picture for each step, and commands that work on their servos.

tests/test_docs.py runs the blocks of the pages. The commands of the page about a real arm name a
serial port; here they run on virtual servos behind a pseudo terminal.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from robot_ik.commands.main import main
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus, home_of
from robot_ik.hardware.virtual.sts3215 import VirtualSts3215
from robot_ik.ports import RealClock
from tests.doc_pages import ROOT, blocks, named, prose

pytest_plugins = ["pytester"]

TUTORIAL = ROOT / "docs" / "start"
PAGES = sorted(TUTORIAL.glob("*.md"))
PICTURE = re.compile(r"!\[[^\]]+\]\(([^)]+)\)")
REAL_PORT = "/dev/ttyACM0"


def test_the_index_lists_the_six_pages_in_their_order() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\* \[(\d)\. ([^\]]+)\]\(start/(\w+\.md)\)", index, re.MULTILINE)
    assert [int(number) for number, _, _ in listed] == [1, 2, 3, 4, 5, 6]
    assert {name for _, _, name in listed} == {page.name for page in PAGES}
    for number, title, name in listed:
        lines = (TUTORIAL / name).read_text(encoding="utf-8").splitlines()
        assert lines[0] == f"# {number}. {title}"
        assert any(line.startswith(f"This is page {number} of 6") for line in lines)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_step_has_a_picture(page: Path) -> None:
    steps = re.split(r"^## (?=Step)", prose(page), flags=re.MULTILINE)[1:]
    assert len(steps) >= 3
    for step in steps:
        own_text = step.split("\n## ")[0]
        pictures = PICTURE.findall(own_text)
        assert pictures, f"{named(page)}: {own_text.splitlines()[0]}"
        for picture in pictures:
            assert (page.parent / picture).is_file(), f"{named(page)}: {picture}"


def test_every_picture_of_the_tutorial_is_on_a_page() -> None:
    used = {Path(p).name for page in PAGES for p in PICTURE.findall(prose(page))}
    drawn = {file.name for file in (ROOT / "docs" / "images" / "start").iterdir()}
    assert drawn <= used


# Page 4, on virtual servos


@contextmanager
def port_of(bus: VirtualBus) -> Iterator[str]:
    """Serve virtual servos on a port that accepts only their baud rate."""
    from robot_ik.hardware.virtual.pty import PtyPort  # not on Windows

    with PtyPort(bus, match_baud=True) as port:
        yield port.path


def commands(word: str) -> list[list[str]]:
    """Return the words of the commands of page 4 that begin with ``robot-ik`` and a word."""
    lines = [
        line
        for block in blocks(TUTORIAL / "real_arm.md")
        if block.language == "sh"
        for line in block.text.splitlines()
    ]
    found = [shlex.split(line)[1:] for line in lines if line.startswith(f"robot-ik {word} ")]
    assert found, word
    return found


def run(words: list[str], port: str) -> None:
    """Run a command of page 4 on another port."""
    assert main([port if word == REAL_PORT else word for word in words]) == 0, words


def write_lerobot_file(file: Path, config: ArmConfig, bus: VirtualBus) -> None:
    """Write the calibration of the servos as LeRobot does."""
    rows = {}
    for joint in config.joints:
        lower, upper = (joint.nearest_ticks(angle) for angle in joint.limits)
        rows[joint.name] = {
            "id": joint.servo.id,
            "drive_mode": 0,
            "homing_offset": bus.servo(joint.servo.id).values["homing_offset"],
            "range_min": min(lower, upper),
            "range_max": max(lower, upper),
        }
    file.write_text(json.dumps(rows), encoding="utf-8")


@pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")
def test_the_ids_of_page_four(real_time: None) -> None:
    config = ArmConfig.load("so101")
    setups = commands("servo setup")
    ids = {joint.name: joint.servo.id for joint in config.joints}
    assert sorted(words[-1] for words in setups) == sorted(ids)
    for words in (setups[0], setups[-1]):  # each searches all rates and ids, which takes seconds
        clock = RealClock()
        bus = VirtualBus([VirtualSts3215(1, clock)], clock)
        with port_of(bus) as port:
            run(words, port)
        assert bus.servos[0].id == ids[words[-1]]


@pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")
def test_the_commands_of_page_four_after_the_ids(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, real_time: None
) -> None:
    monkeypatch.chdir(tmp_path)
    config = ArmConfig.load("so101")
    bus = VirtualBus.from_config(config, RealClock(), home_of(config))
    write_lerobot_file(tmp_path / "follower.json", config, bus)
    with port_of(bus) as port:
        run(*commands("servo scan"), port)
        (from_lerobot,) = [c for c in commands("servo calibrate") if "--from-lerobot" in c]
        run(from_lerobot, port)
        assert not ArmConfig.load("my_so101.toml").uncalibrated
        run(*commands("servo monitor"), port)
        run(*commands("servo move"), port)
    assert Path("my_so101.calibration.toml").is_file()


# Page 6


def test_the_tests_of_page_six_pass(pytester: pytest.Pytester) -> None:
    for page in (TUTORIAL / "own_robot.md", TUTORIAL / "test_your_program.md"):
        for block in blocks(page):
            if block.file:
                file = pytester.path / block.file
                file.parent.mkdir(exist_ok=True)
                file.write_text(block.text, encoding="utf-8")
    options = (
        "-p",
        "robot_ik.pytest_plugin",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:hypothesispytest",
    )
    result = pytester.runpytest_subprocess(*options)
    result.assert_outcomes(passed=2)


# The robot of an arm file


def desk_arm(folder: Path) -> Path:
    """Write the files of the desk arm and return its arm file."""
    for block in blocks(TUTORIAL / "own_robot.md"):
        if block.file:
            file = folder / block.file
            file.parent.mkdir(exist_ok=True)
            file.write_text(block.text, encoding="utf-8")
    return folder / "desk_arm" / "arm.toml"


def test_the_model_of_an_arm_file_is_found_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = ArmConfig.load(desk_arm(tmp_path))
    monkeypatch.chdir("/")
    assert Path(config.robot_source) == tmp_path / "desk_arm" / "desk_arm.xml"
    assert home_of(config) == pytest.approx({"pan": 0.3, "lift": 0.4, "elbow": 0.5})


def test_without_a_model_beside_it_the_path_counts_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = desk_arm(tmp_path)
    moved = shutil.move(file, tmp_path / "elsewhere.toml")
    monkeypatch.chdir(tmp_path / "desk_arm")
    assert ArmConfig.load(moved).robot_source == "desk_arm.xml"


def test_a_folder_does_not_hide_a_robot_of_the_catalogue(tmp_path: Path) -> None:
    (tmp_path / "so101").mkdir()
    arm = (ROOT / "models" / "so101" / "arm.toml").read_text(encoding="utf-8")
    (tmp_path / "arm.toml").write_text(arm, encoding="utf-8")
    assert ArmConfig.load(tmp_path / "arm.toml").robot_source == "so101"
