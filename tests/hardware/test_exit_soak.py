"""Signals from another process at any moment, and a sender that stalls.

The judges are registers that the SDK reads afterwards, and goals that were recorded on the wire.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from dynamixel_sdk import COMM_SUCCESS, PacketHandler, PortHandler

from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.protocol import Parser
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock

SDK = PacketHandler(2.0)
TORQUE = 64
WATCHDOG = 98

RUNS = """
import json, signal, sys, time
from robot_ik.errors import HardwareError
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.leaving import ExitReport

port, file, policy = sys.argv[1:]
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, lambda number, frame: None)  # signals while no torque is on
arm = open_arm(ArmConfig.load(file), port, on_exit=policy)

def life(home):
    arm.enable()
    for k in range(5):
        arm.send(home + 0.001 * k, 0.01 * k)
    arm.move_to(home + 0.03)

for line in sys.stdin:
    begin, ended = time.monotonic(), "normally"
    try:
        if line.strip() == "with":
            with arm:
                life(arm.read().q)
        else:
            arm.connect()
            try:
                life(arm.read().q)
            finally:
                arm.close()
    except (KeyboardInterrupt, SystemExit, HardwareError) as error:
        ended = type(error).__name__
    report = arm.exit_report or ExitReport("not connected")
    row = {"ended": ended, "done": report.done, "ok": report.ok, "parked": report.parked,
           "seconds": time.monotonic() - begin, "open": arm.bus.is_open}
    print(json.dumps(row), flush=True)
"""


@pytest.fixture
def served(arm_config, start):
    with PtyPort(VirtualBus.from_config(arm_config, RealClock(), start=start)) as port:
        yield port


def registers(path: str, address: int) -> list[int]:
    """One byte of every servo, by the plain SDK."""
    port = PortHandler(path)
    assert port.openPort() and port.setBaudRate(1_000_000)
    try:
        values = []
        for id in range(1, 7):
            for _ in range(20):  # it polls, and the servos live in this process too
                value, result, _ = SDK.read1ByteTxRx(port, id, address)
                if result == COMM_SUCCESS:
                    break
            assert result == COMM_SUCCESS, (id, result)
            values.append(value)
        return values
    finally:
        port.closePort()


def violations(served, arm_path, policy: str, runs: int, seed: int) -> list[str]:
    rng = random.Random(seed)
    words = [sys.executable, "-c", RUNS, served.path, str(arm_path), policy]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    found: list[str] = []
    with subprocess.Popen(words, **pipes) as child:
        try:
            usual = 1.0
            missed = 0
            for k in range(-1, runs):
                print("with" if k % 2 else "finally", file=child.stdin, flush=True)
                sent = []
                if k >= 0:  # the first one tells how long it takes
                    time.sleep(rng.uniform(0.0, 1.05 * usual))
                    sent = [rng.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP])]
                    child.send_signal(sent[0])
                said = json.loads(child.stdout.readline())
                if k < 0:
                    usual = said["seconds"]
                torque = registers(served.path, TORQUE)
                armed = registers(served.path, WATCHDOG)
                # On a busy machine the arm may not connect. Then no torque was switched on.
                if said["done"] == "not connected":
                    missed += 1
                    continue
                wanted = [1] * 6 if said["done"] == "hold" else [0] * 6
                right = said["ok"] and not said["open"] and torque == wanted and armed == [0] * 6
                if said["ended"] == "normally":
                    right &= said["done"] == ("hold" if policy == "hold" else "torque_off")
                if not right:
                    found.append(f"run {k}, {sent}: {said}, torque {torque}, watchdogs {armed}")
            child.stdin.close()
            assert child.wait() == 0 and missed <= 0.05 * runs
        finally:
            child.kill()
    return found


@pytest.mark.parametrize("policy", ["torque_off", "park", "hold"])
def test_a_signal_from_another_process_leaves_the_arm_as_promised(served, arm_path, policy):
    assert violations(served, arm_path, policy, 6, seed=5) == []


@pytest.mark.soak
@pytest.mark.timeout(2400)
@pytest.mark.parametrize("policy", ["torque_off", "park", "hold"])
def test_six_hundred_and_seventy_signals_leave_the_arm_as_promised(served, arm_path, policy):
    assert violations(served, arm_path, policy, 670, seed=11) == []


SENDER = """
import json, sys, time
import numpy as np
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig

port, file, seconds = sys.argv[1:]
sends = []
with open_arm(ArmConfig.load(file), port) as arm:
    arm.enable()
    print("moving", flush=True)
    end = time.monotonic() + float(seconds)
    k, far = 0, 1.2
    while time.monotonic() < end:
        k += 1
        before = time.monotonic()
        arm.send(np.full(6, far if k // 150 % 2 else -far), 0.01 * k)  # a clock that never waits
        sends.append([before, time.monotonic()])
        time.sleep(max(0.01 - (time.monotonic() - before), 0.0))
print(json.dumps(sends), flush=True)
"""


def record_goals(bus: VirtualBus, config) -> list[tuple[float, np.ndarray]]:
    """Times and rad of all goals that reach the servos together, from the packets themselves."""
    rows: list[tuple[float, np.ndarray]] = []
    parser = Parser()
    respond = bus.respond
    maps = {joint.servo.id: joint for joint in config.joints}

    def recorded(data, baud=None):
        for packet in parser.feed(data, time.monotonic()):
            q = {}
            if packet.instruction == 0x93:  # Bulk Write: id, address, length, data
                at = 0
                params = packet.params
                while at < len(params):
                    address, size = (
                        int.from_bytes(params[at + i : at + i + 2], "little") for i in (1, 3)
                    )
                    if address == 116:
                        ticks = int.from_bytes(
                            params[at + 5 : at + 5 + size], "little", signed=True
                        )
                        q[params[at]] = maps[params[at]].value(ticks)
                    at += 5 + size
            elif packet.instruction == 0x83 and packet.params[:2] == b"\x74\x00":  # Sync Write
                for at in range(4, len(packet.params), 5):
                    ticks = int.from_bytes(packet.params[at + 1 : at + 5], "little", signed=True)
                    q[packet.params[at]] = maps[packet.params[at]].value(ticks)
            if len(q) == len(maps):
                rows.append((time.monotonic(), np.array([q[id] for id in maps])))
        return respond(data, baud)

    bus.respond = recorded
    return rows


def worst_travel(served, arm_path, config, seconds: float) -> float:
    """Largest travel on the wire over any window of 0.1 s or more, over what the caps allow."""
    rows = record_goals(served.bus, config)
    rng = random.Random(2)
    words = [sys.executable, "-c", SENDER, served.path, str(arm_path), str(seconds)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout.readline().strip() == "moving"
            end = time.monotonic() + seconds - 0.5
            while time.monotonic() < end:
                time.sleep(rng.uniform(0.05, 0.4))
                child.send_signal(signal.SIGSTOP)  # wherever it is: before, in or behind a packet
                time.sleep(rng.uniform(0.0, 0.35))
                child.send_signal(signal.SIGCONT)
            sends = json.loads(child.stdout.readline())
            assert child.wait() == 0
        finally:
            child.kill()
    times = np.array([t for t, _ in rows])
    goals = np.array([q for _, q in rows])
    # How long before its packet a step can have been computed: the longest of the sends around that
    # time.
    begins, ends = np.array(sends).T
    delay = np.array(
        [
            max(float((ends - begins)[(begins <= t) & (t <= ends)].max(initial=0.0)), 0.0)
            for t in times
        ]
    )
    worst = 0.0
    for k in range(len(rows)):
        later = times >= times[k] + 0.1
        allowed = (
            (times[later] - times[k] + delay[k] + 0.01)[:, None] * config.velocity * (1 + 1e-6)
        )
        travel = np.abs(goals[later] - goals[k]) - 2.0 * config.resolution
        if travel.size:
            worst = max(worst, float((travel / allowed).max()))
    assert len(rows) > 20 * seconds
    return worst


def test_a_stalled_sender_moves_nothing_faster_than_its_caps(served, arm_path, arm_config):
    assert 0.3 < worst_travel(served, arm_path, arm_config, 3.0) <= 1.0


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_a_stalled_sender_moves_nothing_faster_than_its_caps_in_a_minute(
    served, arm_path, arm_config
):
    assert 0.3 < worst_travel(served, arm_path, arm_config, 60.0) <= 1.0
