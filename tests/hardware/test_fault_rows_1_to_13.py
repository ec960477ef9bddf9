"""Faults 1 to 13 of docs/reference/safety.md, one test a row by its number.

The first test checks that each of the 26 rows has a test.
"""

from __future__ import annotations

import ast
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest

from robot_ik.errors import BusTimeoutError, MotorFaultError, ServoMismatchError, ServoRefusedError
from robot_ik.hardware import discovery, open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")
PAGE = Path(__file__).parents[2] / "docs" / "reference" / "safety.md"


def test_every_fault_of_the_page_has_its_test():
    """A row without a test, or a test without a row, cannot go unnoticed."""
    rows = {}
    for file in sorted(Path(__file__).parent.glob("test_fault_rows*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_row_"):
                rows[int(node.name[-2:])] = ast.get_docstring(node)
    section = PAGE.read_text(encoding="utf-8").partition("## The 26 faults\n")[2]
    listed = re.findall(r"^\| (\d+) \| ([^|]+) \|", section, re.MULTILINE)
    assert [(int(number), name.strip()) for number, name in listed] == sorted(rows.items())
    assert sorted(rows) == list(range(1, 27))


def test_row_01(lab):
    """one servo silent for a moment"""
    with lab.arm() as arm:
        arm.enable()
        lab.drive(arm)
        arm.bus.virtual_bus.inject(Fault("silent", id=3, for_s=0.005))
        lab.drive(arm, 1)
        lab.drive(arm, 5)
        assert arm.state is ArmState.ENABLED and arm.ages.max() == 0.0
        arm.bus.virtual_bus.servo(3).silent = True
        lab.drive(arm, 1)
        # the others' data are used
        assert arm.ages[2] > 0.0 and np.delete(arm.ages, 2).max() == 0.0
        arm.bus.virtual_bus.servo(3).silent = False


def test_row_02(lab):
    """one servo silent for good"""
    with lab.arm() as arm:
        fault = lab.fault(arm, MotorFaultError, Fault("silent", id=3))
        assert (fault.joint, fault.status) == (
            "joint3",
            ("no_status",),
        ) and "servo id 3" in fault.hint
        assert arm.ages[2] <= 0.25 and all(lab.torque(arm))
    assert arm.exit_report.unverified == ("joint3",)
    assert lab.torque(arm) == [False, False, True, False, False, False]


def test_row_03(lab):
    """all servos without power"""
    with lab.arm() as arm:
        fault = lab.fault(arm, BusTimeoutError, Fault("supply", value=0.0))
        assert fault.all_servos and str(fault).startswith("no servo answers on sim")
        begin = arm.clock.now()
    assert arm.clock.now() - begin < 2.0 and len(arm.exit_report.unverified) == 6


def test_row_04(lab):
    """replies with flipped bits"""
    assert lab.follows_a_bad_wire(corrupt=0.01).bus.counters.corrupt > 0


def test_row_05(lab):
    """replies cut short, with fewer data, with none"""
    lab.follows_a_bad_wire(truncate=0.01, short=0.01, error=0.01)


def test_row_06(lab):
    """foreign bytes and packets, doubled, out of order; an echo"""
    lab.follows_a_bad_wire(garbage=0.02, duplicate=0.02, wrong_id=0.02, reorder=0.02, echo=True)


def test_row_07(lab):
    """a reply that arrives in the next cycle"""
    assert lab.follows_a_bad_wire(late=0.1).bus.counters.late > 0


def test_row_08(lab, real_time):
    """an adapter that delays bytes, servos that delay replies"""
    with lab.arm(Fault("return_delay", value=250), Fault("latency", value=4.0), on="pty") as arm:
        assert lab.registers(arm, "return_delay_time") == [0] * 6  # set at connect
        arm.enable()
        begin = time.monotonic()
        lab.drive(arm, 3)
        assert time.monotonic() - begin >= 3 * 0.004 and arm.state is ArmState.ENABLED
        assert np.abs(arm.read().q - lab.start).max() < 0.01


def test_row_09(lab, real_time):
    """another baud rate"""
    discovery.SerialBus.listening_time, waits = 0.05, discovery.SerialBus.listening_time
    bus = VirtualBus.from_config(lab.config, RealClock())
    bus.inject(Fault("baud", id=3, value=57_600))
    try:
        with PtyPort(bus, match_baud=True) as port:
            found = {
                servo.id: servo.baud for servo in discovery.scan(port.path, [57_600, 1_000_000])
            }
            with pytest.raises(
                ServoMismatchError, match=r"3  joint3: XM430-W350  missing"
            ) as caught:
                open_arm(lab.config, port.path).connect()
    finally:
        discovery.SerialBus.listening_time = waits
    assert found == {
        1: 1_000_000,
        2: 1_000_000,
        3: 57_600,
        4: 1_000_000,
        5: 1_000_000,
        6: 1_000_000,
    }
    assert "servo scan" in caught.value.hint


def test_row_10(lab):
    """two servos with one id"""
    with pytest.raises(
        ServoMismatchError, match=r"3  joint3: XM430-W350  damaged replies"
    ) as caught:
        lab.arm(Fault("id", id=4, value=3)).connect()
    assert "do two servos have that id?" in caught.value.hint
    with lab.arm() as arm:
        fault = lab.fault(arm, MotorFaultError, Fault("id", id=4, value=3))
        assert (fault.joint, fault.status) in (("joint3", ("corrupt",)), ("joint4", ("no_status",)))


def test_row_11(lab):
    """another model, a missing servo, an extra servo"""
    faults = Fault("model", id=3, value=1190), Fault("silent", id=5), Fault("extra", value=12)
    arm = lab.arm(*faults)
    with pytest.raises(ServoMismatchError) as caught:
        arm.connect()
    said = str(caught.value)
    assert re.search(r"3  joint3: XM430-W350  XL330-M077", said)
    assert re.search(r"5  joint5: XL430-W250  missing", said) and re.search(
        r"12  - +XM430-W350", said
    )
    assert not any(lab.torque(arm)) and arm.state is ArmState.DISCONNECTED


def test_row_12(lab):
    """EEPROM written under torque"""
    with lab.arm() as arm:
        arm.enable()
        packets = arm.bus.virtual_bus.schedule.upcoming
        with pytest.raises(ServoRefusedError) as caught:
            arm.bus.write(1, lab.config.joints[0].servo.table["homing_offset"], 5)
        # not repeated
        assert caught.value.code == 7 and arm.bus.virtual_bus.schedule.upcoming == packets + 1


def test_row_13(lab, make_bench):
    """a goal outside the limits"""
    with lab.arm() as arm:
        arm.enable()
        lab.stream(arm, np.tile(lab.start + np.array([9, 0, 0, 0, 0, 0]), (200, 1)))
        assert arm.reports.clipped["joint1"] > 0
        assert arm.bus.virtual_bus.true_angles(lab.config)[0] <= lab.config.upper[0]
    bench = make_bench(position_ticks=2000)
    bench.set(operating_mode=int(OperatingMode.POSITION), max_position_limit=3000)
    assert bench.write("goal_position", 3001) != 0 and bench.read("goal_position") <= 3000
