"""A running arm is stopped by a second process without its port, by a key, or by a thread."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import stat
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from robot_ik.errors import HardwareError, StopRequestedError
from robot_ik.hardware import open_arm, stop_file
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.stop_file import StopFile, running_arms, runtime_folder
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock
from tests.waiting import wait_for

PRIVATE = """
from pathlib import Path
from robot_ik.hardware import stop_file
stop_file.FOLDER = Path({folder!r})
"""
"""Programs of these tests do not meet those of other tests, which run at the same time."""

PROGRAM = (
    PRIVATE
    + """
import sys
from robot_ik.commands.main import main
sys.exit(main())
"""
)

CHILD = """
import itertools, signal, sys, time
import numpy as np
from robot_ik.errors import HardwareError, StopRequestedError
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig

port, file, way = sys.argv[1:]
try:
    with open_arm(ArmConfig.load(file), port) as arm:
        arm.enable()
        home = arm.read().q
        for k in itertools.count():
            arm.send(home + 0.3 * np.sin(0.02 * k), 0.01 * k)
            time.sleep(0.01)
            if k == 20:
                print("moving", flush=True)
                if way == "idle":
                    time.sleep(600.0)
except StopRequestedError as error:
    print(error, flush=True)
    print(arm.exit_report.done, flush=True)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A runtime folder of this test alone."""
    monkeypatch.setattr(stop_file, "FOLDER", tmp_path / "running")
    return stop_file.FOLDER


@pytest.fixture
def served(arm_config, start, real_time):
    with PtyPort(VirtualBus.from_config(arm_config, RealClock(), start=start)) as port:
        yield port


@pytest.fixture
def child(served, arm_path, folder):
    started = []

    def begin(way: str = "busy") -> subprocess.Popen:
        code = PRIVATE.format(folder=str(folder)) + CHILD
        words = [sys.executable, "-c", code, served.path, str(arm_path), way]
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout.readline().strip() == "moving"
        return process

    yield begin
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def stop(*words: str) -> subprocess.CompletedProcess:
    code = PROGRAM.format(folder=str(stop_file.FOLDER))
    command = [sys.executable, "-c", code, "stop", *words]
    return subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)


def torque(served) -> list[bool]:
    return [servo.torque for servo in served.bus.servos]


@pytest.mark.parametrize("way", ["busy", "idle"])
def test_a_running_arm_stops_holds_and_is_left_holding(served, child, arm_config, way):
    process = child(way)
    done = stop("--bus", served.path)
    assert done.returncode == 0, done.stderr
    assert "holds with torque ON" in done.stdout
    here = served.bus.true_angles(arm_config)
    time.sleep(0.3)
    assert (
        np.abs(served.bus.true_angles(arm_config) - here).max() < 2e-3
        and torque(served) == [True] * 6
    )
    if way == "busy":
        said, _ = process.communicate()
        assert "stopped on request" in said and said.splitlines()[-1] == "hold"
        assert torque(served) == [True] * 6  # on_exit is torque_off; a person asked to hold


def test_torque_off_asks_first_and_then_lets_go(served, child):
    child()
    refused = stop("--torque-off")
    assert refused.returncode == 2 and "--yes" in refused.stderr and torque(served) == [True] * 6
    done = stop("--torque-off", "--yes")
    assert done.returncode == 0 and "torque is off" in done.stdout
    assert torque(served) == [False] * 6


def test_without_a_running_arm_the_exit_code_is_1(served, child):
    assert stop().returncode == 1
    process = child()
    assert stop("--bus", "/dev/null").returncode == 1  # another port
    assert process.poll() is None
    process.kill()
    process.wait()
    assert running_arms() == [] and stop().returncode == 1
    # The files of the dead program were removed.
    assert [path.name for path in runtime_folder().iterdir()] == []


def test_an_arm_that_cannot_confirm_is_no_success(served, child):
    child("idle")  # the heartbeat has found the fault by then, and obeys all the same
    served.bus.servo(3).silent = True
    done = stop()
    assert done.returncode == 1 and "joint3" in done.stdout


def test_a_stop_without_an_answer_is_no_success_and_stays_in_force(served, child):
    process = child()
    process.send_signal(signal.SIGSTOP)
    (arm,) = running_arms(served.path)
    ok, text = arm.stop(timeout=0.2)
    assert not ok and "no answer" in text and "stops when its program continues" in text
    process.send_signal(signal.SIGCONT)
    said, _ = process.communicate()
    assert "stopped on request" in said and said.splitlines()[-1] == "hold"
    assert torque(served) == [True] * 6


def test_a_program_that_ends_before_it_answers_is_no_success(served, child, folder):
    process = child()
    process.send_signal(signal.SIGSTOP)
    (arm,) = running_arms(served.path)
    answers = []
    asking = threading.Thread(target=lambda: answers.append(arm.stop(timeout=60.0)))
    asking.start()
    wait_for(arm.stem.with_suffix(".stop").exists)
    process.kill()
    process.wait()
    asking.join()
    ((ok, text),) = answers
    assert not ok and "closed the arm or ended" in text
    assert running_arms() == [] and list(folder.iterdir()) == []


@pytest.mark.parametrize("variable", ["XDG_RUNTIME_DIR", "TMPDIR", "HOME"])
def test_every_program_of_a_user_looks_into_the_same_folder(tmp_path, variable):
    """Programs of cron, a service or ``su`` have no variables of a desktop."""
    code = "from robot_ik.hardware.stop_file import FOLDER; print(FOLDER)"
    base = {name: value for name, value in os.environ.items() if name != variable}
    folders = {
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env).stdout
        for env in (base, base | {variable: str(tmp_path)})
    }
    (folder,) = folders
    assert folder.strip()


def test_the_runtime_folder_is_this_users_alone(tmp_path, folder):
    assert runtime_folder() == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o755)
    assert stat.S_IMODE(runtime_folder().stat().st_mode) == 0o700
    os.rmdir(folder)
    folder.symlink_to(tmp_path)
    with pytest.raises(HardwareError, match="not a folder of this user"):
        runtime_folder()


def test_the_folder_of_another_user_is_refused(monkeypatch):
    runtime_folder()
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.raises(HardwareError, match="not a folder of this user"):
        runtime_folder()


@pytest.fixture
def open_files():
    """Opens the files of arms as their programs do, and closes them."""
    opened = []

    def begin(name: str) -> StopFile:
        file = StopFile(name)
        opened.append(file)
        file.open("/dev/null")
        return file

    yield begin
    for file in opened:
        file.close()


def test_a_look_at_any_moment_of_opening_does_not_lose_the_arm(open_files, folder, monkeypatch):
    """Another program locks what it finds for a moment, to see whether it is a dead program's."""
    flock = fcntl.flock
    looks = []

    def with_a_look(file: int, how: int) -> None:
        held = [os.open(path, os.O_RDWR) for path in folder.glob("*.arm")]
        for other in held:
            flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        looks.append(held)
        try:
            flock(file, how)
        finally:
            for other in held:
                os.close(other)

    with monkeypatch.context() as patch:
        patch.setattr(fcntl, "flock", with_a_look)
        open_files("lever")
    assert looks
    for _ in range(2):
        assert [arm.name for arm in running_arms()] == ["lever"]


def test_arms_that_open_while_others_look_are_all_found(open_files, folder):
    over = threading.Event()

    def look() -> None:
        while not over.is_set():
            running_arms()

    lookers = [threading.Thread(target=look) for _ in range(2)]
    for looker in lookers:
        looker.start()
    try:
        names = {f"arm {k}" for k in range(50)}
        for name in names:
            open_files(name)
        assert {arm.name for arm in running_arms()} == names
    finally:
        over.set()
        for looker in lookers:
            looker.join()


def test_what_a_killed_program_left_goes_when_the_next_arm_opens(open_files, folder):
    living = open_files("living")
    (stem,) = (path.with_suffix("") for path in folder.glob("*.arm"))
    for ending in (".arm", ".lock", ".stop", ".done"):
        (folder / f"dead{ending}").write_text("{}")
    stem.with_suffix(".stop").write_text("{}")
    open_files("next")
    assert not list(folder.glob("dead.*"))
    assert {arm.name for arm in running_arms()} == {"living", "next"}
    assert living.requested() == "hold"


def test_old_files_of_ended_programs_are_removed(folder):
    runtime_folder()
    for ending in (".lock", ".stop", ".done"):
        for name in ("old", "new"):
            (folder / f"{name}{ending}").write_text("{}")
        os.utime(folder / f"old{ending}", (0.0, 0.0))
    running_arms()
    assert {path.stem for path in folder.iterdir()} == {"new"}


def test_what_is_no_arms_is_left_alone_and_hides_no_arm(open_files, folder, tmp_path):
    open_files("lever")
    (folder / "folder.arm").mkdir()
    (folder / "folders.arm").mkdir()
    (folder / "folders.lock").mkdir()
    (folder / "garbage.arm").write_bytes(b"\xff\x00")
    target = tmp_path / "target"
    target.write_text("keep")
    for ending in (".arm", ".lock"):
        (folder / f"link{ending}").symlink_to(target)
    assert [arm.name for arm in running_arms()] == ["lever"]
    assert target.read_text() == "keep" and (folder / "folder.arm").is_dir()


def test_a_file_that_is_open_stays_with_its_request_when_the_arm_is_enabled_again(open_files):
    file = open_files("lever")
    (arm,) = running_arms()
    arm.stem.with_suffix(".stop").write_text(json.dumps({"policy": "torque_off"}))
    file.open("/dev/null")
    assert file.requested() == "torque_off" and running_arms() == [arm]


def test_an_arm_whose_port_came_back_under_another_name_is_found_by_either(open_files, tmp_path):
    port = tmp_path / "by-id"
    port.symlink_to("/dev/null")
    file = StopFile("lever")
    file.open(str(port))
    port.unlink()
    port.symlink_to("/dev/zero")
    assert [arm.name for arm in running_arms(str(port))] == ["lever"]
    assert [arm.name for arm in running_arms("/dev/zero")] == ["lever"] and running_arms(
        "/dev/null"
    ) == []
    file.close()


def test_without_a_folder_the_arm_runs_and_the_log_says_so(folder, caplog):
    folder.write_text("")
    file = StopFile("lever")
    file.open("/dev/null")
    assert "robot-ik stop cannot reach this arm" in caplog.text
    assert file.requested() is None
    file.close()


def test_whatever_a_request_says_the_arm_stops(arm_config, start, real_time):
    with open_arm(arm_config, "pty", start=start) as arm:
        arm.enable()
        (running,) = running_arms()
        assert running.port == os.path.realpath(arm.bus.port)
        running.stem.with_suffix(".stop").write_text("{")
        with pytest.raises(StopRequestedError):
            for k in range(200):
                arm.send(start, 0.01 * k)
                time.sleep(0.001)
    assert arm.exit_report.done == "hold"
    answer = json.loads(running.stem.with_suffix(".done").read_text())
    assert answer["ok"] and not running.stem.with_suffix(".arm").exists()


def test_another_thread_can_request_a_stop_and_a_reset_continues(arm, stream, smooth, start):
    arm.enable()
    stream(arm, smooth(start, start + 0.2, 0.4)[:20])
    thread = threading.Thread(target=arm.request_stop)
    thread.start()
    thread.join()
    with pytest.raises(
        StopRequestedError, match="\nto go on give the command again; in a program reset"
    ):
        stream(arm, [start] * 3)
    assert (
        arm.state is ArmState.FAULT and [s.torque for s in arm.bus.virtual_bus.servos] == [True] * 6
    )
    with pytest.raises(StopRequestedError):
        arm.move_to(start)
    arm.reset_fault()
    arm.enable()
    stream(arm, [start] * 3)
    arm.close()
    assert arm.exit_report.done == "torque_off"


def test_a_stop_during_a_parking_ends_it_and_the_arm_holds(arm_config, start, stream, smooth):
    with open_arm(arm_config, "sim", start=start, on_exit="park") as arm:
        arm.enable()
        stream(arm, smooth(start, start + 0.4, 1.0))
        exchange = arm.bus.exchange

        def asked(register, values, reads, within=None):
            if arm.state is ArmState.MOVING:
                arm.request_stop()
            return exchange(register, values, reads, within)

        arm.bus.exchange = asked
    assert arm.exit_report.done == "hold" and arm.exit_report.ok and not arm.exit_report.parked


def test_space_stops_a_servo_command_that_moves(served, arm_path, arm_config, start, folder):
    master, slave = pty.openpty()
    words = [
        "servo",
        "move",
        "joint1=60",
        "--speed",
        "0.05",
        "--bus",
        served.path,
        "--arm",
        str(arm_path),
    ]
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(folder=str(folder)), *words],
        stdin=slave,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: __import__("fcntl").ioctl(0, __import__("termios").TIOCSCTTY, 0),
    )
    try:
        moved = served.bus.true_angles(arm_config)[0] + 0.02
        wait_for(lambda: served.bus.true_angles(arm_config)[0] >= moved, "it does not move")
        os.write(master, b"x ")
        said, _ = process.communicate()
    finally:
        process.kill()
        os.close(master)
        os.close(slave)
    assert process.returncode == 1, said
    assert "stopped on request" in said and "it holds with torque ON" in said
    # No other program had requested a stop.
    assert "answering" not in said and not list(runtime_folder().iterdir())
    assert torque(served) == [True] * 6
    assert served.bus.true_angles(arm_config)[0] < np.radians(50.0)
