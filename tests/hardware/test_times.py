"""Faults are noticed after the times of the docs, on a clock that only waiting moves."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from robot_ik.errors import BusTimeoutError, MotorFaultError
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.bus import Counters
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.hardware.serial_port import SleepingPortHandler
from robot_ik.hardware.simulated import InProcessPort
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.ports import VirtualClock
from tests.hardware.family_arms import FAMILIES, IDS, START, family_config

DOCS = Path(__file__).parents[2] / "docs" / "reference"


class WaitingPort(InProcessPort):
    """Waits on the servos' clock as a serial port does: for bytes, and for missing replies."""

    def __init__(self, bus: VirtualBus, clock: VirtualClock, baud: int, counters: Counters) -> None:
        super().__init__(bus, "waiting", baud, counters)
        self.seconds_per_byte = 10.0 / baud
        self._clock = clock

    def _pass(self, seconds: float) -> None:
        self._clock.sleep_until(self._clock.now() + max(seconds, 0.0))

    def getCurrentTime(self) -> float:
        return 1000.0 * self._clock.now()

    def writePort(self, packet: Sequence[int] | bytes) -> int:
        self._pass(len(packet) * self.seconds_per_byte)
        return super().writePort(packet)

    def receive(self, deadline: float, expected: float | None = None) -> bytes:
        data = super().receive(deadline)
        self._pass(len(data) * self.seconds_per_byte if data else deadline - self._clock.now())
        return data

    def readPort(self, length: int) -> bytes:
        data = super().readPort(length)
        left = (self.packet_timeout - self.getTimeSinceStart()) / 1000.0
        self._pass(len(data) * self.seconds_per_byte if data or length <= 0 else left + 1e-6)
        return data

    def drain(self, quiet: float) -> None:
        while self.receive(self._clock.now() + quiet):
            pass

    # those of a real port
    setPacketTimeout = SleepingPortHandler.setPacketTimeout
    setPacketTimeoutMillis = SleepingPortHandler.setPacketTimeoutMillis
    isPacketTimeout = SleepingPortHandler.isPacketTimeout


def _arm(config: ArmConfig, start: Any) -> Arm:
    clock = VirtualClock()
    servos = VirtualBus.from_config(config, clock, start=start)

    class WaitingBus(SerialBus):
        real = False
        virtual_bus = servos

        def _make_handler(self) -> WaitingPort:
            return WaitingPort(servos, clock, self.baud, self.counters)

    bus = WaitingBus("waiting", config.baud, config.family.protocol, clock=clock)
    arm = Arm(config, bus)
    arm.connect()
    arm.enable()
    return arm


def _drive(arm: Arm, start: Any, cycles: int) -> None:
    begin = arm.clock.now()
    for k in range(1, cycles + 1):
        arm.clock.sleep_until(begin + k / arm.config.rate_hz)
        arm.send(start, arm.clock.now())


def _seconds_to_fault(
    config: ArmConfig, start: Any, *, everyone: bool = False
) -> tuple[float, float]:
    """s from the last reply to the moment silence is looked into, and to the fault."""
    arm = _arm(config, start)
    _drive(arm, start, 20)
    last = arm.clock.now()
    arm.bus.virtual_bus.inject(
        *(
            Fault("silent", id=id)
            for id in (config.servo_ids if everyone else config.servo_ids[2:3])
        )
    )
    looked: list[float] = []
    read = arm.bus.read

    def watched(id: int, register: Any) -> Any:
        looked.append(arm.clock.now())
        return read(id, register)

    arm.bus.read = watched
    with pytest.raises(BusTimeoutError if everyone else MotorFaultError):
        _drive(arm, start, 200)
    times = looked[0] - last, arm.clock.now() - last
    arm.close()
    return times


def _said(page: str, pattern: str) -> list[float]:
    """Numbers that a page states."""
    words = (DOCS / page).read_text(encoding="utf-8").split()
    found = re.search(pattern, " ".join(words))
    assert found is not None, f"{page} does not say: {pattern}"
    return [float(number) for number in found.groups()]


@pytest.mark.parametrize("everyone", [False, True])
@pytest.mark.parametrize("family", FAMILIES)
def test_silence_is_noticed_and_a_fault_when_the_docs_say(family: str, everyone: bool) -> None:
    noticed, *times = _said(
        "safety.md",
        r"noticed ([\d.]+) s after its last reply and is a fault after ([\d.]+) s, "
        r"Feetech STS ([\d.]+) s \(at 1 Mbit/s\)\. At 57 600 baud the fault comes after "
        r"([\d.]+) s, Feetech STS ([\d.]+) s",
    )
    faults = times[FAMILIES.index(family) :: len(FAMILIES)]
    for baud, fault in zip((1_000_000, 57_600), faults, strict=True):
        config = dataclasses.replace(family_config(family), baud=baud)
        looked, given_up = _seconds_to_fault(config, START, everyone=everyone)
        assert given_up == pytest.approx(fault, abs=0.015)
        if baud == 1_000_000:
            assert looked == pytest.approx(noticed, abs=0.01)


def test_in_process_silence_is_a_fault_when_the_docs_say(arm: Arm, start: Any) -> None:
    (said,) = _said("hardware.md", r"a silent servo \(([\d.]+) s on virtual time")
    arm.enable()
    _drive(arm, start, 20)
    last = arm.clock.now()
    arm.bus.virtual_bus.inject(Fault("silent", id=3))
    with pytest.raises(MotorFaultError):
        _drive(arm, start, 100)
    assert arm.clock.now() - last == pytest.approx(said, abs=0.011)  # a cycle is 0.01 s


@pytest.mark.parametrize("policy", ["torque_off", "hold"])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_mute_bus_is_given_up_when_the_docs_say(family: str, policy: str) -> None:
    times = _said("safety.md", r"leaving takes at most ([\d.]+) s, Feetech STS ([\d.]+) s")
    longest = times[FAMILIES.index(family)]
    arm = _arm(dataclasses.replace(family_config(family), on_exit=policy), START)
    _drive(arm, START, 20)
    arm.bus.virtual_bus.inject(*(Fault("silent", id=id) for id in IDS))
    begin = arm.clock.now()
    arm.close()
    assert longest - 0.3 <= arm.clock.now() - begin <= longest
    assert arm.exit_report is not None and len(arm.exit_report.unverified) == 6


def test_the_sim_and_a_wire_give_the_same_answers(arm_config: ArmConfig, start: Any) -> None:
    arm = _arm(arm_config, start)
    _drive(arm, start, 50)
    counters = arm.bus.counters
    assert (counters.timeouts, counters.retries, counters.corrupt, counters.late) == (0, 0, 0, 0)
    assert arm.read().q == pytest.approx(start, abs=0.01)
    arm.close()
