"""An arm on a wire with every fault at a low rate: it follows, and its books agree."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.wire import SPOILS
from robot_ik.ports import VirtualClock

MARGIN = 1.05


def drive(config, start, cycles: int, rate: float = 1e-3) -> list[int]:
    """``cycles`` at 100 Hz; bytes of memory in use at ten moments."""
    clock = VirtualClock()
    bus = VirtualBus.from_config(config, clock, start=start)
    memory = []
    followed = 0
    with open_arm(config, "sim", virtual_bus=bus) as arm:
        arm.enable()
        bus.reseed(5)
        bus.inject(*(Fault(name, value=rate) for name in SPOILS))
        begin = clock.now()
        tracemalloc.start()
        for k in range(cycles):
            now = begin + 0.01 * (k + 1)
            clock.sleep_until(now)
            wanted = start + 0.3 * np.sin(0.5 * (now - begin)) * np.array([1, -1, 1, -1, 1, -1])
            arm.send(wanted, now)
            measured = arm.read().q
            true = bus.true_angles(config)
            fresh = arm.ages == 0.0
            followed += fresh.all()
            # A measured value is true, or older by its age: the speed of a shaft is limited.
            assert (
                np.abs(measured - true)
                <= arm.resolution + MARGIN * 1.5 * config.velocity * arm.ages
            ).all()
            assert np.abs(true - wanted).max() < 0.03
            if k % max(cycles // 10, 1) == 0:
                memory.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        counters = arm.bus.counters
        assert arm.state is ArmState.ENABLED and arm.reports.sent == cycles
        assert counters.asked == counters.answered + counters.refused + counters.timeouts
        assert counters.corrupt > 0 and counters.late >= 0 and counters.retries > 0
        assert followed >= 0.9 * cycles
        bus.clear()
    assert arm.exit_report.ok
    return memory


def test_five_seconds_with_every_fault_of_the_wire(arm_config, start):
    drive(arm_config, start, 500, rate=3e-3)


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_ten_minutes_with_every_fault_of_the_wire(arm_config, start):
    memory = drive(arm_config, start, 60_000)
    assert memory[-1] - memory[1] < 200_000  # bytes
