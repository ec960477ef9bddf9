"""Torque, goals and motion of an arm whose program was killed, for every servo family."""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from robot_ik.errors import BusCorruptError, BusTimeoutError
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import RealClock, VirtualClock
from tests.waiting import wait_for

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals and SIGKILL")

ROBOTS = ("so101", "koch_v11")
ON_ORPHAN = ("hold", "torque_off")
ON_EXIT = ("torque_off", "hold", "park")

STILL = 0.05
"""s in which a resting shaft does not move."""

GOAL_TOLERANCE = 4.0
"""Ticks between a shaft and its goal at rest."""

KILLS = 2000
"""Kills of the soak."""

LONGEST_DELAY = 0.4
"""s after torque has come on within which a program is killed."""


class Programs:
    """Starts programs of ``killed_program.py``."""

    def __init__(self) -> None:
        script = str(Path(__file__).with_name("killed_program.py"))
        self._process = subprocess.Popen(
            [sys.executable, script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def ask(self, line: str) -> str:
        """Send a line and return the next one."""
        print(line, file=self._process.stdin, flush=True)
        return self.answer()

    def answer(self) -> str:
        """Return the next line."""
        return self._process.stdout.readline().strip()

    def close(self) -> None:
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()


@pytest.fixture(scope="module")
def programs() -> Iterator[Programs]:
    opened = Programs()
    yield opened
    opened.close()


@contextmanager
def served(robot: str) -> Iterator[tuple[VirtualBus, str]]:
    """Virtual servos of a robot on a pty, and the name of the port."""
    from robot_ik.hardware.virtual.pty import PtyPort  # not on Windows

    bus = VirtualBus.from_config(ArmConfig.load(robot), RealClock())
    with PtyPort(bus) as port:
        yield bus, port.path


def torque(bus: VirtualBus) -> list[bool]:
    with bus.lock:
        return [servo.torque for servo in bus.servos]


def shafts(bus: VirtualBus) -> list[float]:
    with bus.lock:
        return [servo.true_ticks for servo in bus.servos]


def goals(bus: VirtualBus) -> list[int]:
    with bus.lock:
        return [servo.register("goal_position") for servo in bus.servos]


def wait_for_last_goals(robot: str, port: str) -> None:
    """Wait until the servos have received all that a killed program had written.

    A reply to a later ping shows it. An incomplete packet of the program may spoil some pings.
    """
    config = ArmConfig.load(robot)
    bus = SerialBus(port, config.baud, config.family.protocol)
    bus.open()

    def answers() -> bool:
        with contextlib.suppress(BusTimeoutError, BusCorruptError):
            bus.ping(config.servo_ids[0])
            return True
        return False

    wait_for(answers, "the servos do not answer after the program was killed")
    bus.close()


def wait_for_rest(bus: VirtualBus) -> None:
    """Wait until no shaft moves any more."""

    def is_still() -> bool:
        before = shafts(bus)
        time.sleep(STILL)
        return shafts(bus) == before

    wait_for(is_still, "the shafts do not come to rest")


def kill_one(
    programs: Programs, robot: str, on_orphan: str, on_exit: str, delay: float
) -> list[str] | None:
    """Kill a program ``delay`` s after torque has come on.

    Returns:
        What was broken; None if the program failed before its torque came on.
    """
    violations = []
    with served(robot) as (bus, port):
        pid = int(programs.ask(f"{robot} {port} {on_orphan} {on_exit}").split()[1])
        if programs.answer() != "torque":
            assert programs.ask("") == "ended"
            return None
        time.sleep(delay)
        os.kill(pid, signal.SIGKILL)
        assert programs.ask("") == "ended"
        at_kill = shafts(bus)
        if on_orphan == "torque_off":
            # The request of the guardian comes behind the last goals.
            wait_for(lambda: not any(torque(bus)), "torque stays on after the program was killed")
            last_goals = goals(bus)
            wait_for_rest(bus)
        else:
            wait_for_last_goals(robot, port)
            last_goals = goals(bus)
            wait_for_rest(bus)
            if not all(torque(bus)):
                violations.append(f"torque {torque(bus)} although on_orphan is hold")
            if goals(bus) != last_goals:
                violations.append(f"goals moved from {last_goals} to {goals(bus)}")
        for before, after, goal in zip(at_kill, shafts(bus), last_goals, strict=True):
            lower = min(before, goal) - GOAL_TOLERANCE
            upper = max(before, goal) + GOAL_TOLERANCE
            if not lower <= after <= upper:
                violations.append(f"a shaft went from {before} to {after}; its goal was {goal}")
    return violations


@pytest.mark.parametrize("on_orphan", ON_ORPHAN)
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_killed_program_leaves_its_arm_as_on_orphan_says(programs, robot, on_orphan):
    violations = None
    while violations is None:
        violations = kill_one(programs, robot, on_orphan, "torque_off", 0.1)
    assert violations == []


@pytest.mark.soak
def test_two_thousand_random_kills(programs):
    rng = random.Random(0)
    cases = itertools.cycle(itertools.product(ROBOTS, ON_ORPHAN, ON_EXIT))
    violations = []
    kills = 0
    failed = 0
    for robot, on_orphan, on_exit in cases:
        broken = kill_one(programs, robot, on_orphan, on_exit, rng.uniform(0.0, LONGEST_DELAY))
        if broken is None:  # on a busy machine a servo may seem to be absent
            failed += 1
            assert failed < KILLS
            continue
        kills += 1
        violations += [f"kill {kills}, {robot}, {on_orphan}, {on_exit}: {text}" for text in broken]
        if kills == KILLS:
            break
    assert violations == []


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_program_that_leaves_its_arm_in_order_ends_its_guardian(robot):
    with served(robot) as (bus, port):
        config = replace(
            ArmConfig.load(robot), uncalibrated=False, file=None, on_orphan="torque_off"
        )
        with open_arm(config, port, on_exit="hold") as arm:
            arm.enable()
            guardian = arm._guardian.pid
            os.kill(guardian, 0)
        assert all(torque(bus))
        with pytest.raises(ProcessLookupError):
            os.kill(guardian, 0)


def test_a_forked_child_does_not_keep_the_guardian_from_acting():
    reader, writer = os.pipe()
    request = b"torque off"
    code = (
        "import os, sys, time\n"
        "from robot_ik.hardware.guardian import Guardian\n"
        f"guardian = Guardian({writer}, {request!r})\n"
        "if os.fork() == 0:\n"
        "    os.close(1)\n"
        "    time.sleep(600)\n"
        "print(os.getpid(), flush=True)\n"
        "time.sleep(600)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        pass_fds=[writer],
        start_new_session=True,
        text=True,
    )
    try:
        process.stdout.readline()
        process.kill()
        process.wait()
        assert os.read(reader, len(request)) == request
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.stdout.close()
        os.close(reader)
        os.close(writer)


def test_simulated_servos_in_this_process_have_no_guardian():
    config = replace(ArmConfig.load("so101"), on_orphan="torque_off")
    bus = VirtualBus.from_config(config, VirtualClock())
    with open_arm(config, "sim", virtual_bus=bus) as arm:
        arm.enable()
        assert arm._guardian is None


def test_the_arm_file_keeps_on_orphan():
    config = replace(ArmConfig.load("so101"), on_orphan="torque_off")
    assert ArmConfig.parse(config.to_toml()).on_orphan == "torque_off"
