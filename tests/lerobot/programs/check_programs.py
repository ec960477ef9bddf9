"""LeRobot's own programs, unmodified, on simulated arms. Run by ``make lerobot``."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from robot_ik.hardware import pty_port, simulated_servos
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.lerobot.calibration import nominal, save
from robot_ik.ports import RealClock

HERE = Path(__file__).parent
PROGRAMS = Path(sys.executable).parent
TIMEOUT = 600.0
"""s. A program imports PyTorch first, which takes a minute on a busy machine."""

ATTEMPTS = 3
"""Attempts of a program. LeRobot waits 50 ms for a reply, and a busy machine may take longer."""
NO_REPLY = ("There is no status packet", "Missing motor IDs")

SWING_TICKS = 300
"""Distance by which every shaft is moved to and fro by hand."""
SWING_PERIOD = 0.3
"""s between two of its moves."""

ARM = ("--robot.type=robot_ik_arm", "--robot.arm=so101", "--robot.id=test")
DISCOVER = "--robot.discover_packages_path=robot_ik.lerobot"
WAVE = ("--teleop.type=wave", "--teleop.discover_packages_path=wave_teleoperator")
CAMERA = "--robot.cameras={front: {type: robot_ik_scene, width: 320, height: 240, fps: 30}}"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Return an environment whose LeRobot files are in the folder of the test."""
    return dict(
        os.environ,
        HF_LEROBOT_HOME=str(tmp_path / "lerobot"),
        HF_HUB_OFFLINE="1",
        PYTHONPATH=str(HERE),
        PYTHONUNBUFFERED="1",
        OPENBLAS_NUM_THREADS="1",
    )


def run(environment: dict[str, str], program: str, *arguments: str) -> str:
    """Run a program of LeRobot to its end, and return what it printed."""
    completed = subprocess.run(
        [str(PROGRAMS / program), *arguments],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=TIMEOUT,
    )
    assert completed.returncode == 0, completed.stdout[-4000:]
    return completed.stdout


def test_calibrate_writes_lerobots_file(environment: dict[str, str], tmp_path: Path) -> None:
    folder = tmp_path / "calibration"
    run(environment, "lerobot-calibrate", *ARM, f"--robot.calibration_dir={folder}")
    rows = json.loads((folder / "test.json").read_text())
    assert rows["shoulder_pan"]["id"] == 1


def test_teleoperate(environment: dict[str, str]) -> None:
    text = run(
        environment,
        "lerobot-teleoperate",
        *ARM,
        DISCOVER,
        *WAVE,
        "--fps=30",
        "--teleop_time_s=3",
    )
    assert "Teleop loop time" in text


def test_record_and_replay_a_dataset(environment: dict[str, str], tmp_path: Path) -> None:
    dataset = ("--dataset.repo_id=test/wave", f"--dataset.root={tmp_path / 'dataset'}")
    run(
        environment,
        "lerobot-record",
        *ARM,
        DISCOVER,
        CAMERA,
        *WAVE,
        *dataset,
        "--dataset.single_task=wave",
        "--dataset.num_episodes=2",
        "--dataset.episode_time_s=3",
        "--dataset.reset_time_s=1",
        "--dataset.fps=15",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )
    info = json.loads((tmp_path / "dataset" / "meta" / "info.json").read_text())
    assert info["total_episodes"] == 2
    assert info["total_frames"] >= 30
    assert info["features"]["observation.images.front"]["shape"] == [240, 320, 3]
    assert "shoulder_pan.pos" in info["features"]["action"]["names"]
    run(
        environment,
        "lerobot-replay",
        *ARM,
        DISCOVER,
        *dataset,
        "--dataset.episode=0",
        "--play_sounds=false",
    )


def test_interrupted_teleoperation_leaves_the_servos_without_torque(
    environment: dict[str, str], tmp_path: Path
) -> None:
    config = ArmConfig.load("so101")
    save(tmp_path / "test.json", nominal(config))
    servos = simulated_servos(config, RealClock(), {name: 0.0 for name in config.names})
    with pty_port()(servos) as port:
        arguments = (f"--robot.port={port.path}", f"--robot.calibration_dir={tmp_path}")
        command = ["lerobot-teleoperate", *ARM, *arguments, DISCOVER, *WAVE, "--fps=30"]
        with started(environment, *command, "--teleop_time_s=600") as program:
            wait_for_text(program, "Teleop loop time")
            assert servos.servo(1).register("torque_enable") == 1
            program.send_signal(signal.SIGINT)
            text = program.communicate(timeout=TIMEOUT)[0]
    assert "Traceback" not in text, text[-4000:]
    assert [servos.servo(id).register("torque_enable") for id in config.servo_ids] == [0] * 6
    assert all(abs(value) < 0.05 for value in servos.true_angles(config.chain))


@pytest.mark.parametrize("kind", ["robot", "teleop"])
def test_unmodified_so101_calibrates_virtual_servos(
    environment: dict[str, str], tmp_path: Path, kind: str
) -> None:
    device = "so101_follower" if kind == "robot" else "so101_leader"
    config = ArmConfig.load("so101")
    options = {"type": device, "id": "test", "calibration_dir": tmp_path}
    for _ in range(ATTEMPTS):
        servos = simulated_servos(config, RealClock())
        with pty_port()(servos) as port, moved_by_hand(servos, config) as moves:
            arguments = [f"--{kind}.{key}={value}" for key, value in options.items()]
            arguments.append(f"--{kind}.port={port.path}")
            with started(environment, "lerobot-calibrate", *arguments) as program:
                text = answer_questions(program, moves)
        if program.returncode == 0 or not any(words in text for words in NO_REPLY):
            break
    assert program.returncode == 0, text[-4000:]
    rows = json.loads((tmp_path / "test.json").read_text())
    assert list(rows) == list(config.names)
    for name, row in rows.items():
        joint = config.joint(name)
        offset = servos.servo(joint.servo.id).register("homing_offset")
        assert row["homing_offset"] == offset


def answer_questions(program: subprocess.Popen[str], moves: threading.Semaphore) -> str:
    """Answer the questions of ``lerobot-calibrate``, and return what it printed."""
    text = wait_for_text(program, "middle of its range of motion")
    with contextlib.suppress(BrokenPipeError):
        press_enter(program)
        text += wait_for_text(program, "MIN")
        wait_for_moves(moves)
        press_enter(program)
    return text + program.communicate(timeout=TIMEOUT)[0]


@contextlib.contextmanager
def started(
    environment: dict[str, str], program: str, *arguments: str
) -> Iterator[subprocess.Popen[str]]:
    """Start a program of LeRobot, and kill it at the end of the block."""
    process = subprocess.Popen(
        [str(PROGRAMS / program), *arguments],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        bufsize=1,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def press_enter(program: subprocess.Popen[str]) -> None:
    """Write an empty line to the standard input of a program."""
    assert program.stdin is not None
    program.stdin.write("\n")
    program.stdin.flush()


def wait_for_text(program: subprocess.Popen[str], text: str) -> str:
    """Read the output of a program until a text or the end comes, and return it.

    A question has no end of line, so the output is read letter by letter.
    """
    assert program.stdout is not None
    output = ""
    while text not in output:
        letter = program.stdout.read(1)
        if not letter:
            break
        output += letter
    return output


@contextlib.contextmanager
def moved_by_hand(servos: VirtualBus, config: ArmConfig) -> Iterator[threading.Semaphore]:
    """Move the shafts of servos without torque to and fro. The semaphore counts the moves."""
    finished = threading.Event()
    moves = threading.Semaphore(0)

    def move() -> None:
        step = SWING_TICKS
        while not finished.wait(SWING_PERIOD):
            for id in config.servo_ids:
                servos.servo(id).rotate_by_hand(step)
            step = -step
            moves.release()

    thread = threading.Thread(target=move)
    thread.start()
    try:
        yield moves
    finally:
        finished.set()
        thread.join()


def wait_for_moves(moves: threading.Semaphore) -> None:
    """Wait for four more moves of the shafts: every joint goes to and fro twice."""
    while moves.acquire(blocking=False):
        pass
    for _ in range(4):
        moves.acquire()
