"""A signal at every line of an arm, on virtual time: the arm is always left.

The lines are found by running a phase once under a tracer; then the phase is run once for each
line, with the signal raised when that line is reached.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

import robot_ik.hardware
import robot_ik.signals
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock
from tests.hardware.family_arms import FAMILIES, family_config
from tests.waiting import wait_for

HARDWARE = str(Path(robot_ik.hardware.__file__).parent)
SIGNALS = robot_ik.signals.__file__
LIFE_CYCLE = {
    "arm.py",
    "arm_exit.py",
    "leaving.py",
    "signals.py",
    "stop_file.py",
    "stop_requests.py",
    "torque.py",
    "watchdogs.py",
}
Line = tuple[str, int]


def is_ours(frame: FrameType, files: set[str] | None) -> bool:
    """Return whether a function runs on the host, not in virtual servos or an import."""
    code = frame.f_code
    folder, _, file = code.co_filename.rpartition("/")
    host = folder == HARDWARE or code.co_filename == SIGNALS
    return host and (files is None or file in files) and code.co_name != "<module>"


@contextmanager
def traced(see: Callable[[Line], None], files: set[str] | None):
    """Calls ``see`` before every line of the host's side."""

    def local(frame, event, argument):
        if event == "line":
            see((frame.f_code.co_filename, frame.f_lineno))
        return local

    sys.settrace(lambda frame, event, argument: local if is_ours(frame, files) else None)
    try:
        yield
    finally:
        sys.settrace(None)


class Run:
    """One arm from connect to close, with something in one phase of it."""

    def __init__(self, config, start, policy: str, styled: str, files: set[str] | None) -> None:
        self.servos = VirtualBus.from_config(config, VirtualClock(), start=start)
        self.arm = open_arm(config, "sim", virtual_bus=self.servos, on_exit=policy)
        self.start = start
        self.styled = styled
        self.files = files

    def through(self, phase: str, see: Callable[[Line], None]) -> None:
        """The whole life of the arm; ``see`` gets the lines of one phase."""

        def step(name: str, action: Callable[[], object]) -> None:
            if name != phase:
                action()
                return
            with traced(see, self.files):
                action()

        def live() -> None:
            step("enable", self.arm.enable)
            begin = self.arm.clock.now()
            for k in range(3):
                self.arm.clock.sleep_until(begin + 0.01 * (k + 1))
                step(
                    "send",
                    lambda k=k: self.arm.send(self.start + 0.001 * k, begin + 0.01 * (k + 1)),
                )
            step("move", lambda: self.arm.move_to(self.start + 0.01))

        if self.styled == "with":
            self.arm.connect()
            exit = type(self.arm).__exit__
            try:
                live()
            except BaseException:
                error = sys.exc_info()
                step("close", lambda: exit(self.arm, *error))
                raise
            step("close", lambda: exit(self.arm, None, None, None))
        else:
            self.arm.connect()
            try:
                live()
            finally:
                step("close", self.arm.close)

    def register(self, name: str) -> list[int]:
        return [servo.register(name) for servo in self.servos.servos]


@pytest.fixture(params=FAMILIES)
def one_joint(request):
    """An arm of one servo, because many runs are made."""
    return family_config(request.param).only(["joint1"])


def lines_of(make: Callable[[], Run], phase: str) -> list[Line]:
    # the second time nothing is looked up for the first time
    make().through(phase, lambda line: None)
    lines: dict[Line, None] = {}
    make().through(phase, lambda line: lines.setdefault(line))
    return list(lines)


def check_left(run: Run, phase: str, policy: str) -> None:
    """The servos say what the report says, and the report what was promised."""
    arm = run.arm
    report = run.arm.exit_report
    assert not arm.bus.is_open and arm.state is ArmState.DISCONNECTED
    assert report is not None and report.ok
    if arm.config.family.capabilities.bus_watchdog:
        assert run.register("bus_watchdog") == [0]
    assert run.register("torque_enable") == [int(report.done == "hold")]
    if phase == "enable" and not report.parked:
        # Before it was on, while it came on, or the policy where enabling was just over.
        assert report.done in ("untouched", "torque_off", policy)
    else:
        assert report.done == ("hold" if policy == "hold" else "torque_off")
        assert report.parked == (policy == "park")
    if report.parked:
        assert np.abs(run.servos.true_angles(arm.config) - run.start).max() < 0.01


def signal_at_every_line(config, start, policy, styled, phase, files=None) -> int:
    """Alternately Ctrl-C, left to Python, and SIGTERM with a handler of the program's own."""

    def make() -> Run:
        return Run(config, start, policy, styled, files)

    lines = lines_of(make, phase)
    for k, line in enumerate(lines):
        run = make()
        number = signal.SIGINT if k % 2 else signal.SIGTERM
        where = f"{signal.Signals(number).name} at {Path(line[0]).name}:{line[1]}"
        raised: list[Line] = []
        called: list[bool] = []  # whether torque was on

        def see(here: Line, line=line, number=number, raised=raised) -> None:
            if here == line and not raised:
                raised.append(here)
                signal.raise_signal(number)

        def handler(number, frame, run=run, called=called) -> None:
            called.append(any(run.register("torque_enable")))

        before = signal.signal(signal.SIGTERM, handler)
        try:
            run.through(phase, see)
            ended = "normally"
        except (KeyboardInterrupt, SystemExit) as error:
            ended = type(error).__name__
        finally:
            after = signal.signal(signal.SIGTERM, before)
        assert raised, where
        assert after is handler and signal.getsignal(signal.SIGINT) is signal.default_int_handler, (
            where
        )
        if number == signal.SIGTERM:  # once, when the arm was left, or before it was on
            assert len(called) == 1, where
            # normally: the handler was the program's
            assert ended in ("SystemExit", "normally"), where
            early = phase == "enable" and ended == "normally"
            assert called[0] == (run.arm.exit_report.done == "hold" and not early), where
        else:
            assert ended == "KeyboardInterrupt", where
        try:
            check_left(run, phase, policy)
        except AssertionError as error:
            raise AssertionError(f"{where}: {error}") from error
    return len(lines)


STYLES = ["with", "finally"]
POLICIES = ["torque_off", "hold", "park"]


every_way = [
    pytest.mark.parametrize("styled", STYLES),
    pytest.mark.parametrize("policy", POLICIES),
]


def parametrized(*phases: str):
    def decorate(test):
        for mark in (*every_way, pytest.mark.parametrize("phase", phases)):
            test = mark(test)
        return test

    return decorate


@parametrized("enable", "close")
def test_a_signal_at_any_line_leaves_the_arm_as_promised(one_joint, start, policy, styled, phase):
    assert signal_at_every_line(one_joint, start[:1], policy, styled, phase, LIFE_CYCLE) > 20


@parametrized("move")
def test_a_signal_at_any_line_of_the_arm_while_it_moves_leaves_it_as_promised(
    one_joint, start, policy, styled, phase
):
    assert signal_at_every_line(one_joint, start[:1], policy, styled, phase, {"arm.py"}) > 10


@pytest.mark.soak
@pytest.mark.timeout(1800)
@parametrized("enable", "close", "send", "move")
def test_a_signal_at_any_line_of_all_that_runs(one_joint, start, policy, styled, phase):
    assert signal_at_every_line(one_joint, start[:1], policy, styled, phase) > 100


@pytest.fixture
def calls():
    """Signals that reached the program's own handler of SIGTERM."""
    calls: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: calls.append(number))
    yield calls
    signal.signal(signal.SIGTERM, before)


def test_an_arm_closed_by_another_thread_leaves_the_signal_to_the_programs_own_handler(
    arm_config, start, calls
):
    arm = open_arm(arm_config, "sim", start=start)
    arm.connect()
    arm.enable()
    with pytest.raises(SystemExit):
        signal.raise_signal(signal.SIGTERM)
    assert calls == []  # the arm is not left yet
    thread = threading.Thread(target=arm.close)
    thread.start()
    thread.join()
    assert arm.exit_report.ok and arm.exit_report.done == "torque_off"
    wait_for(lambda: calls == [signal.SIGTERM])
