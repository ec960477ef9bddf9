"""Leaving an arm: servos without torque get no goal that would energise them."""

from __future__ import annotations

from contextlib import closing

from robot_ik.hardware import open_bus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.leaving import leave
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock

LIMP_ID = 2


def test_a_limp_servo_stays_limp_where_a_goal_switches_torque_on():
    config = ArmConfig.load("so101")
    assert config.family.capabilities.goal_enables_torque
    servos = VirtualBus.from_config(config, VirtualClock())
    for id in config.servo_ids:
        servos.servo(id).set_register("torque_enable", int(id != LIMP_ID))
    goals = {id: servos.servo(id).register("present_position") for id in config.servo_ids}
    with closing(open_bus("sim", config, virtual_bus=servos)) as bus:
        report = leave(bus, config, "hold", goals)
    name = next(drive.name for drive in config.drives if drive.id == LIMP_ID)
    assert report.limp == (name,)
    assert servos.servo(LIMP_ID).register("torque_enable") == 0
