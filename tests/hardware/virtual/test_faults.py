"""Where virtual servos truly stand, and their faults, one servo or a whole arm of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from robot_ik.errors import ConfigError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault, joint_offset, make_fault
from robot_ik.hardware.virtual.protocol import Instruction, build
from robot_ik.ports import VirtualClock

PRESENT = X_TABLES["XM430-W350"]["present_position"]


def test_zero_offset_does_not_show_on_the_bus(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.servo.zero_offset_ticks = 22.75
    assert bench.read("present_position") == 2048
    bench.set(torque_enable=1, goal_position=3000)
    bench.wait(5.0)
    assert bench.read("present_position") == 3000
    assert bench.servo.true_ticks == 3022.75


def test_a_stuck_shaft_reports_where_it_is(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(torque_enable=1, profile_velocity=50, goal_position=4000)
    bench.wait(0.5)
    bench.servo.stuck = True
    held = bench.servo.true_ticks
    bench.wait(10.0)
    assert bench.servo.true_ticks == held
    assert bench.read("present_position") == round(held)
    assert bench.read("position_trajectory") == 4000
    assert bench.read("moving_status") & 0b1001 == 0b1000  # not in position, following error
    bench.servo.stuck = False
    assert bench.servo.true_ticks == held
    bench.wait(10.0)
    assert bench.read("present_position") == 4000


def test_from_config_stands_at_the_start(arm_config: ArmConfig, clock: VirtualClock) -> None:
    start = np.array([0.3, -0.2, 0.1, 1.0, -1.0, 0.5])
    bus = VirtualBus.from_config(arm_config, clock, start)
    for joint, q, servo in zip(arm_config.joints, start, bus.servos, strict=True):
        assert servo.id == joint.servo.id and servo.table.model == joint.servo.model
        assert servo.memory.values["operating_mode"] == joint.servo.mode
        assert servo.baud == arm_config.baud
        assert not servo.torque
        assert servo.shaft.reading == joint.nearest_ticks(q)
    assert np.abs(bus.true_angles(arm_config) - start).max() <= arm_config.resolution.max() / 2
    with pytest.raises(ConfigError):
        VirtualBus.from_config(arm_config, clock, [0.0])
    with pytest.raises(ConfigError):
        VirtualBus.from_config(arm_config, clock, [np.nan] * 6)


def test_zero_offset_by_joint_moves_the_truth_only(
    arm_config: ArmConfig, arm_bus: VirtualBus, sim: SimBus
) -> None:
    before = sim.sync_read(arm_config.servo_ids, PRESENT)
    honest = arm_bus.true_angles(arm_config)
    # joint2 is reversed, joint3 is geared: the offset is one of the joint all the same
    offsets = {"joint2": 2.0, "joint3": -1.0}
    arm_bus.inject(
        *(joint_offset(arm_config.joint(name), degrees) for name, degrees in offsets.items())
    )
    assert sim.sync_read(arm_config.servo_ids, PRESENT) == before
    moved = np.degrees(arm_bus.true_angles(arm_config) - honest)
    assert moved == pytest.approx([0, 2, -1, 0, 0, 0], abs=1e-9)
    arm_bus.clear()
    assert arm_bus.true_angles(arm_config) == pytest.approx(honest)


def test_faults_name_what_exists(arm_config: ArmConfig, arm_bus: VirtualBus) -> None:
    with pytest.raises(ConfigError, match="joint2"):
        make_fault(arm_config, kind="stuck", joint="join2")
    with pytest.raises(KeyError, match="join2"):
        arm_bus.inject(Fault("stuck", joint="join2"))
    with pytest.raises(KeyError, match="99"):
        arm_bus.inject(Fault("silent", 99))
    with pytest.raises(ValueError, match=r"0\.\.1"):
        Fault("corrupt", value=1.5)
    with pytest.raises(ConfigError, match="corrupt"):
        make_fault(arm_config, kind="corupt", value=0.1)


def test_a_fault_names_its_servo_by_id_or_joint(arm_config: ArmConfig, arm_bus: VirtualBus) -> None:
    arm_bus.inject(
        Fault("silent", joint="joint2"), Fault("silent", arm_config.joint("joint4").servo.id)
    )
    assert [servo.id for servo in arm_bus.servos if servo.silent] == [2, 4]


def test_wire_faults_repeat_with_their_seed(arm_config: ArmConfig) -> None:
    def run(seed: int) -> list[bytes]:
        bus = VirtualBus.from_config(arm_config, VirtualClock(), seed=seed)
        bus.inject(Fault("corrupt", value=0.3), Fault("drop", value=0.3))
        return [bus.handle(build(254, Instruction.PING)) for _ in range(20)]

    assert run(1) == run(1) != run(2)
