"""Late replies are no values: an arm with late servos, and what a bus does about them.

Random calls are in `test_wrong_replies.py`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import random
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from robot_ik.errors import BusCorruptError, BusTimeoutError
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.late_replies import UnansweredRequests
from robot_ik.hardware.registers import Register
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock
from tests.hardware.family_arms import FAMILIES, family_config

TABLE = X_TABLES["XM430-W350"]
NO_REGISTER = Register("undefined", 700, 4)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    """The script, imported."""
    path = Path(__file__).parents[2] / "docs" / "make" / "measure_wrong_replies.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look it up
    spec.loader.exec_module(module)
    return module


def test_an_arm_works_or_reports_that_servos_do_not_answer(arm_config, script):
    """One request of twelve is late: no register is taken for another, and the report is true."""
    started = 0
    for seed in range(25):
        servos = VirtualBus.from_config(arm_config, VirtualClock())
        scenario = script.Scenario((34, 150), late_share=0.08)
        bus = script.WrongBus(servos, scenario, random.Random(seed))
        arm = Arm(arm_config, bus)
        with contextlib.suppress(BusTimeoutError, BusCorruptError), arm:
            arm.enable()
            before = servos.true_angles(arm_config)
            for _ in range(30):
                arm.clock.sleep_until(arm.clock.now() + 0.01)
                arm.send(arm.read().q, arm.clock.now())
            assert (
                np.abs(servos.true_angles(arm_config) - before).max() <= 2.0 * arm.resolution.max()
            )
            started += 1
        report = arm.exit_report
        assert not any(servo.torque for servo in servos.servos) or not (report and report.ok)
    assert started > 15


@pytest.fixture
def sim() -> SimBus:
    clock = VirtualClock()
    sim = SimBus(VirtualBus([VirtualServo("XM430-W350", 1, clock)], clock), retries=0)
    sim.open()
    return sim


def late_answer(sim: SimBus, register: Register) -> None:
    """Read a register whose reply comes after the read was given up."""
    sim.virtual_bus.inject(Fault("late", value=1.0))
    with pytest.raises(BusTimeoutError):
        sim.read(1, register)
    sim.virtual_bus.clear()


def test_a_late_error_number_refuses_no_later_request(sim):
    """``read_all`` takes what the arm file expects for a register that older firmware refuses."""
    late_answer(sim, NO_REGISTER)
    assert sim.read(1, TABLE["firmware_version"]).data == TABLE["firmware_version"].initial
    late_answer(sim, NO_REGISTER)
    status = sim.sync_read([1], TABLE["firmware_version"])[1]
    assert status.error == 0 and status.data in (None, TABLE["firmware_version"].initial)


def test_a_read_never_returns_the_value_from_before_a_write(sim):
    """Torque is confirmed by reading it again: a reply from before must not confirm it."""
    torque = TABLE["torque_enable"]
    late_answer(sim, torque)
    sim.virtual_bus.servo(1).memory.set("torque_enable", 1)
    assert sim.read(1, torque).data == 1
    late_answer(sim, torque)
    sim.virtual_bus.servo(1).memory.set("torque_enable", 0)
    assert sim.sync_read([1], torque)[1].data == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_a_late_reply_that_lacks_a_byte_is_no_value(family):
    """Late and a byte short, a reply of two bytes is as long as the next one of one byte."""
    config = family_config(family)
    servos = VirtualBus.from_config(config, VirtualClock())
    sim = SimBus(servos, config.family.protocol, retries=0)
    sim.open()
    table = config.drives[0].servo.table
    late_answer(sim, dataclasses.replace(table["present_input_voltage"], size=2))
    ((packet, sent),) = servos.wire.held
    servos.wire.held = [(servos.side.shortened(packet), sent)]
    reads = {1: table["torque_enable"]}
    assert sim.exchange(table["goal_position"], {}, reads)[1].data == 0


def test_a_call_waits_only_where_a_late_reply_could_be_mistaken(sim):
    late_answer(sim, TABLE["goal_position"])
    begin = sim.clock.now()
    sim.read(1, TABLE["torque_enable"])
    sim.exchange(TABLE["goal_position"], {1: 5}, {1: TABLE["present_position"]})
    assert sim.clock.now() == begin
    assert sim.read(1, TABLE["goal_position"]).data == 5
    assert sim.clock.now() > begin


@pytest.mark.parametrize("late_size", range(3, 8))
def test_no_length_is_asked_for_that_a_late_reply_has_or_would_have_without_a_byte(late_size):
    unanswered = UnansweredRequests()
    unanswered.add([(1, late_size)], 0.0)
    register = Register("asked", 132, 4)
    (widened,) = unanswered.widen({1: register}, uniform=False).values()
    assert widened.size >= register.size
    assert widened.size not in (late_size, late_size - 1)
