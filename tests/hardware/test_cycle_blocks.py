"""The bytes that a control cycle reads from a servo, by the capabilities of its family."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import StopAt

SHORT = 7
"""Bytes of Torque Enable, Present Velocity (lower two) and Present Position of Dynamixel X."""

WITH_HEALTH = 12
"""The same with current, temperature and supply."""


@contextmanager
def read_sizes(config: ArmConfig) -> Iterator[tuple[Arm, list[set[int]]]]:
    """Yield an enabled arm, and the sizes of the registers of every exchange."""
    sizes: list[set[int]] = []
    with open_arm(config, "sim", on_exit="torque_off") as arm:
        exchange = arm.bus.exchange

        def noted(register, values, reads, within=None):
            sizes.append({read.size for read in reads.values()})
            return exchange(register, values, reads, within)

        arm.bus.exchange = noted
        arm.enable()
        yield arm, sizes


def move(arm: Arm) -> None:
    for _ in range(3):
        arm.clock.sleep_until(arm.clock.now() + 0.01)
        arm.send(arm.read().q, arm.clock.now())


def test_a_family_with_indirect_addresses_is_read_in_seven_bytes(arm_config):
    with read_sizes(arm_config) as (arm, sizes):
        move(arm)
    assert arm_config.family.capabilities.indirect_addresses
    assert sizes
    assert set.union(*sizes) == {SHORT}


def test_one_servo_a_cycle_is_read_with_its_health_if_joints_have_thresholds(arm_config):
    first = replace(arm_config.joints[0], stop_at=StopAt(temperature_c=60))
    config = replace(arm_config, joints=(first, *arm_config.joints[1:]))
    with read_sizes(config) as (arm, sizes):
        move(arm)
    assert set.union(*sizes) == {SHORT, WITH_HEALTH}


def test_a_family_without_indirect_addresses_is_never_asked_for_them(monkeypatch):
    config = ArmConfig.load("so101")
    family = config.family
    assert not family.capabilities.indirect_addresses

    def short_block(*_arguments, **_options):
        pytest.fail("the family has no indirect addresses")

    monkeypatch.setattr(type(family), "short_block", short_block)
    plain = family.plain_block(config.servos[0].table).register
    with read_sizes(config) as (arm, sizes):
        move(arm)
    assert set.union(*sizes) == {plain.size}
