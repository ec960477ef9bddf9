"""Calibration by hand of simulated servos behind a real port, compared with their true angles."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.commands.terminal import QUIET
from robot_ik.errors import HardwareError, OptionError
from robot_ik.hardware.calibration_file import Calibration
from robot_ik.hardware.config import ArmConfig

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")

Hand = Callable[[str, Callable[[], object]], None]
JOINTS = ("joint1", "joint2", "joint3")


def test_zeros_directions_and_ranges_are_found(
    good_hand: Any, calibrate: Any, desk: Any, robot_ik: Any, tmp_path: Path
) -> None:
    run = calibrate(good_hand())
    assert run.code == 0, run.err
    mine = ArmConfig.load(tmp_path / "mine.toml")
    for joint, true in zip(mine.joints, desk.config.joints, strict=True):
        assert joint.servo.direction == true.servo.direction
        assert joint.servo.zero_ticks == pytest.approx(true.servo.zero_ticks, abs=2)
        assert np.degrees([joint.lower, joint.upper]) == pytest.approx([-95, 95], abs=0.3)
    # With the calibration the true angles of the arm are those of its goals.
    run = robot_ik(
        "servo",
        "move",
        20,
        -30,
        40,
        "--bus",
        desk.port,
        "--arm",
        tmp_path / "mine.toml",
        "--speed",
        1,
    )
    assert run.code == 0, run.err
    assert np.degrees(desk.bus.true_angles(desk.config)) == pytest.approx([20, -30, 40], abs=0.4)


def test_the_file_has_all_that_was_found(
    good_hand: Any, calibrate: Any, desk: Any, tmp_path: Path
) -> None:
    desk.servo(2).memory.set("homing_offset", 40)
    assert calibrate(good_hand()).code == 0
    path = tmp_path / "mine.calibration.toml"
    raw = tomllib.loads(path.read_text())
    assert raw["schema"] == 1 and raw["arm"] == "three servos"
    second = raw["joints"][1]
    assert (second["name"], second["id"], second["model"]) == ("joint2", 2, "XL430-W250")
    assert (second["drive_mode"], second["homing_offset"], second["direction"]) == (0, 40, -1)
    assert second["range_min"] == pytest.approx(1040 - 95 * 2 * 4096 / 360, abs=3)
    assert second["range_max"] == pytest.approx(1040 + 95 * 2 * 4096 / 360, abs=3)
    assert (second["urdf_lower"], second["urdf_upper"]) == (-110.0, 110.0)
    again = tmp_path / "again.calibration.toml"
    loaded = Calibration.load(path)
    loaded.save(again)
    assert again.read_text() == path.read_text()


def test_zeros_taken_in_another_pose(
    good_hand: Any, calibrate: Any, desk: Any, tmp_path: Path
) -> None:
    run = calibrate(good_hand(pose=(0, 45, -30)), "--pose", "joint2=45", "joint3=-30")
    assert run.code == 0, run.err
    for joint, true in zip(
        ArmConfig.load(tmp_path / "mine.toml").joints, desk.config.joints, strict=True
    ):
        assert joint.servo.zero_ticks == pytest.approx(true.servo.zero_ticks, abs=2)


def failing(run: Any, tmp_path: Path, *parts: str) -> None:
    run.assert_one_screen_error(code=1)
    for part in parts:
        assert part in run.err
    assert (
        not (tmp_path / "mine.toml").exists() and not (tmp_path / "mine.calibration.toml").exists()
    )


def test_a_joint_that_was_not_swept(
    good_hand: Any, calibrate: Any, desk: Any, tmp_path: Path
) -> None:
    hand = good_hand()
    failing(
        calibrate(lambda text, sample: None if text[0] == "1" else hand(text, sample)),
        tmp_path,
        "joint1",
    )


def test_a_sweep_across_the_turns_end(
    good_hand: Any, calibrate: Any, desk: Any, tmp_path: Path
) -> None:
    desk.servo(3).rotate_by_hand(-900)  # its horn sits so that -95 degrees are below tick 0
    failing(calibrate(good_hand()), tmp_path, "joint3", "half a revolution", "extended_position")


@pytest.mark.parametrize("folds", [False, True])
def test_ticks_that_wrap_inside_the_range_are_unwrapped(folds: bool, desk: Any) -> None:
    from robot_ik.hardware.calibration import Sweep

    sweep = Sweep(desk.config, {1: 4000, 2: 4000, 3: 100})
    for tick in (4050, 4099, 4150):
        sweep.take({1: tick % 4096 if folds else tick, 2: tick, 3: (100 - (tick - 4000)) % 4096})
    assert sweep.high[1] == 4150 and sweep.low[1] == 4000
    assert sweep.low[3] == -50 and sweep.now == {1: 4150, 2: 4150, 3: -50}


def test_a_limp_servo_that_counts_beyond_its_turn_is_taken_as_with_torque(desk: Any) -> None:
    from robot_ik.hardware.calibration import Sweep

    assert Sweep(desk.config, {1: 4096 + 7, 2: 5000, 3: -1}).now == {1: 7, 2: 5000, 3: 4095}


def test_a_hand_that_does_not_hold_still(
    good_hand: Any, calibrate: Any, desk: Any, tmp_path: Path
) -> None:
    hand = good_hand()
    bus = desk.bus

    def restless(text: str, sample: Callable[[], object]) -> None:
        hand(text, sample)
        if text[0] == "2":
            from robot_ik.hardware.virtual.faults import Fault

            for k in range(1, 40):  # for two seconds, whenever the zero is taken
                bus.inject(Fault("turn", id=2, value=30.0, at_s=0.05 * k))

    failing(calibrate(restless), tmp_path, "joint2", "still")


def test_the_wrong_joint_is_wiggled(
    good_hand: Any, calibrate: Any, desk: Any, tmp_path: Path
) -> None:
    hand = good_hand()
    swapped = {"joint1": "joint3", "joint3": "joint1", "joint2": "joint2"}

    def crossed(text: str, sample: Callable[[], object]) -> None:
        if text[0] == "3":
            desk.turn(swapped[next(name for name in JOINTS if name in text)], 10.0)
        else:
            hand(text, sample)

    failing(calibrate(crossed), tmp_path, "'joint3' turned instead of 'joint1'")


def test_nothing_is_wiggled(good_hand: Any, calibrate: Any, desk: Any, tmp_path: Path) -> None:
    hand = good_hand()
    failing(
        calibrate(lambda t, s: None if t[0] == "3" else hand(t, s)),
        tmp_path,
        "joint1",
        "did not turn",
    )


def test_a_zero_that_is_half_a_turn_off(
    good_hand: Any, calibrate: Any, desk: Any, tmp_path: Path
) -> None:
    run = calibrate(good_hand(reach=40), "--pose", "joint1=110")
    failing(run, tmp_path, "joint1", "range, deg", "-100.0 .. 100.0")


def test_torque_must_be_off(good_hand: Any, calibrate: Any, desk: Any) -> None:
    for servo in desk.bus.servos:
        servo.memory.set("return_delay_time", 0)  # otherwise connect() refuses to change it
    desk.servo(2).memory.set("torque_enable", 1)
    run = calibrate(good_hand())
    run.assert_one_screen_error()
    assert "torque of joint2 is on: the arm cannot be moved by hand" in run.err


def test_steps_end_with_enter_and_are_repeated_at_a_terminal(
    good_hand: Any, desk: Any, nominal: Path, tmp_path: Path
) -> None:
    keys, terminal = os.openpty()
    command = [sys.executable, "-m", "robot_ik", "servo", "calibrate", str(tmp_path / "mine.toml")]
    child = subprocess.Popen(
        [*command, "--bus", desk.port, "--arm", str(nominal)],
        stdin=terminal,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    hand = good_hand()
    forgetful = True
    lines = []
    assert child.stderr is not None
    try:
        for line in child.stderr:
            lines.append(line)
            if line[0] in "123":
                if not (forgetful and line.startswith("3.2")):
                    hand(line, lambda: time.sleep(0.03))
                forgetful = forgetful and not line.startswith("3.2")
                os.write(keys, b"\n")
        assert child.wait() == 0
    finally:
        child.kill()
        child.communicate()
        os.close(keys)
        os.close(terminal)
    assert sum(line.startswith("3.2") for line in lines) == 2
    assert any("joint 'joint2' did not turn" in line for line in lines) and any(
        "once more" in x for x in lines
    )
    mine = ArmConfig.load(tmp_path / "mine.toml")
    assert [j.servo.direction for j in mine.joints] == [1, -1, 1]


def test_an_input_that_ends_too_early(monkeypatch: pytest.MonkeyPatch) -> None:
    from robot_ik.commands.prompts import Prompts
    from robot_ik.ports import RealClock

    reader, writer = os.pipe()
    with open(reader) as typed:
        monkeypatch.setattr(sys, "__stdin__", typed)
        prompts = Prompts(QUIET, RealClock(), period=0.001)
        os.close(writer)
        for _ in range(2):
            with pytest.raises(HardwareError, match="Enter cannot be pressed"):
                prompts.step("turn it", lambda: None)
        with pytest.raises(OptionError, match="Enter cannot be pressed"):
            Prompts(QUIET, RealClock())


@pytest.mark.parametrize(
    ("name", "out", "remedy"),
    [("calibrate", "mine.toml", "a terminal"), ("record", "wave.csv", "--seconds S")],
)
def test_a_command_that_cannot_be_ended_sends_nothing(
    robot_ik: Any,
    desk: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    out: str,
    remedy: str,
) -> None:
    with open(os.devnull) as empty:
        monkeypatch.setattr(sys, "__stdin__", empty)
        run = robot_ik("servo", name, tmp_path / out, *desk.at)
    run.assert_one_screen_error()
    assert "Enter cannot be pressed" in run.err and remedy in run.err
    assert desk.bus.schedule.packets == 0 and not (tmp_path / out).exists()


def test_steps_that_take_a_time() -> None:
    from robot_ik.commands.prompts import Prompts
    from robot_ik.ports import VirtualClock

    clock = VirtualClock()
    seen = []
    Prompts(QUIET, clock, 2.0, 0.5).step("turn it", lambda: seen.append(clock.now()))
    assert seen == [0.0, 0.5, 1.0, 1.5, 2.0]
