"""A new STS3215 gets its id and baud rate, over a real port and through the command line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from robot_ik.commands.main import main
from robot_ik.errors import ArmStateError, ConfigError
from robot_ik.hardware.discovery import scan
from robot_ik.hardware.servo_setup import set_up
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.sts3215 import VirtualSts3215
from robot_ik.ports import RealClock
from tests.waiting import wait_for

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals")

FACTORY_BAUD = 1_000_000
OTHER_BAUD = 500_000


@contextmanager
def served(*ids: int) -> Iterator[tuple[VirtualBus, str]]:
    """Virtual servos that hear their own baud rate only, and the name of their port."""
    from robot_ik.hardware.virtual.pty import PtyPort  # not on Windows

    clock = RealClock()
    bus = VirtualBus([VirtualSts3215(id, clock) for id in ids], clock)
    with PtyPort(bus, match_baud=True) as port:
        yield bus, port.path


def test_a_new_servo_gets_id_and_rate_and_keeps_them(real_time):
    with served(1) as (bus, port):
        found = set_up(port, 6, OTHER_BAUD, model="STS3215", bauds=[FACTORY_BAUD])
        assert (found.id, found.baud, found.model) == (1, FACTORY_BAUD, "STS3215")
        servo = bus.servos[0]
        wait_for(lambda: servo.values["lock"] == 1, "the EEPROM is not locked again")
        servo.power_cycle()
        assert (servo.id, servo.baud) == (6, OTHER_BAUD)
        assert servo.values["return_delay_time"] == 0
        (again,) = scan(port, [FACTORY_BAUD, OTHER_BAUD])
        assert (again.id, again.baud, again.family.name) == (6, OTHER_BAUD, "feetech_sts")


def test_a_servo_with_torque_is_not_set_up(real_time):
    with served(1) as (bus, port):
        bus.servos[0].set_register("torque_enable", 1)
        with pytest.raises(ArmStateError, match="torque"):
            set_up(port, 6, FACTORY_BAUD, bauds=[FACTORY_BAUD])
        assert bus.servos[0].id == 1


def test_a_rate_that_the_model_does_not_know_is_refused(real_time):
    with served(1) as (_, port), pytest.raises(ConfigError, match="no baud rate of 2000000"):
        set_up(port, 6, 2_000_000, bauds=[FACTORY_BAUD])


def test_two_new_servos_with_one_id_are_seen(real_time):
    with served(1, 1) as (_, port):
        assert any(servo.shared for servo in scan(port, [FACTORY_BAUD]))


def test_the_command_sets_up_a_joint_of_the_arm_file(real_time, capsys):
    with served(1) as (bus, port):
        code = main(["servo", "setup", "--bus", port, "--arm", "so101", "--joint", "gripper"])
        assert code == 0, capsys.readouterr().err
        assert bus.servos[0].id == 6
