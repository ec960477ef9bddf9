"""A child process drives an arm on a pty and is ended in every way.

The judges are the registers of the virtual servos, which are in this process.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock
from tests.hardware.family_arms import FAMILIES, START, arm_text, family_config

CHILD = """
import itertools, signal, sys
import numpy as np
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig

port, file, policy, end = sys.argv[1:5]
# As at a terminal, whatever the test run itself was started from.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGTERM, signal.SIG_DFL)
arm = open_arm(ArmConfig.load(file), port, on_exit=policy)

def drive(ticks):
    home = arm.read().q
    for k in ticks:  # as fast as the bus goes: nearly always inside a transaction
        if k == 20:
            print("moving", flush=True)
        arm.send(home + 0.1 * np.sin(0.01 * k), 0.01 * k)

if end == "forgotten":  # no `with`, no close
    arm.connect()
    arm.enable()
    drive(range(30))
    raise RuntimeError("forgotten")
if end == "rounds":
    # A second signal may come after the arm has given the handlers back.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, frame: None)
    for line in sys.stdin:
        try:
            with arm:
                arm.enable()
                drive(itertools.count())
        except KeyboardInterrupt:
            print("interrupted", arm.exit_report.ok, flush=True)
        except SystemExit as error:
            print("exit", error.code, arm.exit_report.ok, flush=True)
    sys.exit(0)
with arm:
    arm.enable()
    drive(range(30) if end in ("normal", "raise") else itertools.count())
    if end == "raise":
        raise RuntimeError("on purpose")
print("handlers", signal.getsignal(signal.SIGINT) is signal.default_int_handler,
      signal.getsignal(signal.SIGTERM) == signal.SIG_DFL, flush=True)
"""


@pytest.fixture
def family() -> str:
    """Servo family of the arm. A test may name another one."""
    return "dynamixel_x"


@pytest.fixture
def arm_config(family):
    return family_config(family)


@pytest.fixture
def arm_path(family, tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text(arm_text(family), encoding="utf-8")
    return path


@pytest.fixture
def served(arm_config, goal_recorder, real_time):
    with PtyPort(VirtualBus.from_config(arm_config, RealClock(), start=START)) as port:
        goal_recorder.watch(port.bus, arm_config)
        yield port


@pytest.fixture
def child(served, arm_path):
    started = []

    def start(policy: str, end: str) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-c", CHILD, served.path, str(arm_path), policy, end],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            pipe.close()


def torque(served) -> list[bool]:
    return [servo.torque for servo in served.bus.servos]


def wait_for(process, line: str) -> None:
    assert process.stdout.readline().strip() == line, process.stderr.read()


@pytest.mark.parametrize("end", ["normal", "raise", "forgotten"])
def test_without_a_signal_every_servo_is_off_at_the_end(served, child, end):
    process = child("torque_off", end)
    out, err = process.communicate()
    assert process.returncode == (0 if end == "normal" else 1), err
    assert "moving" in out
    assert torque(served) == [False] * 6
    if end == "normal":
        assert "handlers True True" in out  # restored
    else:
        assert "RuntimeError" in err


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, -2), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_switches_every_servo_off_and_keeps_its_exit_code(served, child, number, code):
    process = child("torque_off", "signal")
    wait_for(process, "moving")
    assert torque(served) == [True] * 6
    process.send_signal(number)
    _, err = process.communicate()
    assert process.returncode == code, err
    assert torque(served) == [False] * 6


def test_hold_keeps_torque_and_pose_when_killed_softly(served, child, arm_config):
    process = child("hold", "signal")
    wait_for(process, "moving")
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert torque(served) == [True] * 6
    here = served.bus.true_angles(arm_config)
    assert np.abs(here - START).max() < 0.15
    time.sleep(0.3)
    assert torque(served) == [True] * 6
    assert (served.bus.true_angles(arm_config) == here).all()


def test_park_returns_to_the_start_first(served, child, arm_config):
    process = child("park", "signal")
    wait_for(process, "moving")
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert torque(served) == [False] * 6
    assert np.abs(served.bus.true_angles(arm_config) - START).max() < 0.02


def test_after_sigkill_the_bus_watchdog_stops_the_arm(served, child, arm_config):
    process = child("torque_off", "signal")
    wait_for(process, "moving")
    process.kill()
    process.communicate()
    time.sleep(0.4)
    here = served.bus.true_angles(arm_config)
    assert torque(served) == [True] * 6  # it holds: no program is left to release it
    assert [servo.memory.values["bus_watchdog"] for servo in served.bus.servos] == [-1] * 6
    time.sleep(0.2)
    assert (served.bus.true_angles(arm_config) == here).all()


def kill_at_random(served, child, config, policy: str, rounds: int, seed: int) -> None:
    """Signals at random points of transactions; in every other round an impatient second one."""
    rng = random.Random(seed)
    process = child(policy, "rounds")
    for k in range(rounds):
        stood = served.bus.true_angles(config)  # where this round is enabled
        print("go", file=process.stdin, flush=True)
        wait_for(process, "moving")
        time.sleep(rng.uniform(0.0, 0.02))
        number = rng.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
        process.send_signal(number)
        if k % 2:
            time.sleep(rng.uniform(0.0, 0.004))
            process.send_signal(number)
        said = process.stdout.readline().split()
        # Torque first, words later: look at the servos before believing the child.
        left_on = policy == "hold"
        assert torque(served) == [left_on] * 6, (k, said, process.stderr.read() if not said else "")
        code = {signal.SIGTERM: "143", signal.SIGHUP: "129"}.get(number)
        assert said == (["interrupted", "True"] if code is None else ["exit", code, "True"]), said
        here = served.bus.true_angles(config)
        if policy == "hold" and config.family.capabilities.bus_watchdog:
            assert [servo.register("bus_watchdog") for servo in served.bus.servos] == [0] * 6
        if policy == "park" and not k % 2:  # an impatient second signal ends the parking
            assert np.abs(here - stood).max() < 0.02
    process.stdin.close()
    assert process.wait() == 0


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("policy", "rounds"), [("torque_off", 10), ("park", 4), ("hold", 4)])
def test_a_signal_at_any_point_of_a_transaction_ends_as_the_policy_says(
    served, child, arm_config, policy, rounds
):
    kill_at_random(served, child, arm_config, policy, rounds, seed=19)


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("policy", ["torque_off", "park", "hold"])
def test_a_signal_at_any_point_of_a_transaction_two_hundred_times(
    served, child, arm_config, policy
):
    kill_at_random(served, child, arm_config, policy, rounds=200, seed=1)


@pytest.mark.parametrize("policy", ["torque_off", "park"])
def test_a_servo_that_dies_with_the_signal_keeps_no_other_on(served, child, policy):
    process = child(policy, "signal")
    wait_for(process, "moving")
    served.bus.servo(3).silent = True
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert torque(served) == [False, False, True, False, False, False]


def test_a_cable_pulled_with_the_signal_does_not_hang_the_program(served, child):
    process = child("park", "signal")
    wait_for(process, "moving")
    served.bus.inject(Fault("port_unplugged"))
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate()
    assert process.returncode in (1, 143), err


FORGOTTEN = """
import signal, sys
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig

arm = open_arm(ArmConfig.load(sys.argv[1]), "sim")
arm.connect()
arm.enable()
write = arm.bus.sync_write

def with_a_signal(register, values):
    arm.bus.sync_write = write
    signal.raise_signal(signal.SIGHUP)
    write(register, values)

arm.bus.sync_write = with_a_signal
"""


def test_a_signal_while_a_forgotten_arm_is_left_is_no_failure(arm_path):
    words = [sys.executable, "-c", FORGOTTEN, str(arm_path)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.stderr == "the program ended without closing its arm\n"
