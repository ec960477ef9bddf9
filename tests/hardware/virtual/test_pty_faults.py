"""Faults behind a real port, as the official SDK meets them."""

from __future__ import annotations

import os
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, COMM_SUCCESS, PacketHandler, PortHandler

from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock
from tests.waiting import wait_for

SDK = PacketHandler(2.0)
PRESENT = 132
pytestmark = pytest.mark.usefixtures("real_time")


@contextmanager
def opened(path: str) -> Iterator[PortHandler]:
    port = PortHandler(path)
    assert port.setBaudRate(1_000_000)
    try:
        yield port
    finally:
        port.closePort()


def test_the_port_is_pulled_and_comes_back_under_its_link(
    arm_bus: VirtualBus, tmp_path: Path
) -> None:
    link = tmp_path / "arm"
    with PtyPort(arm_bus, link) as pty:
        before = pty.path
        with opened(str(link)) as port:
            # a busy machine may be late once
            wait_for(lambda: SDK.ping(port, 1)[1] == COMM_SUCCESS)
            arm_bus.inject(Fault("port_unplugged"))  # while the port sleeps
            wait_for(lambda: not os.path.lexists(link))
            with pytest.raises((serial.SerialException, OSError, termios.error)):
                for _ in range(10):
                    SDK.ping(port, 1)
                    port.is_using = False
        arm_bus.unplugged = False
        wait_for(lambda: os.path.lexists(link))
        with opened(str(link)) as port:
            wait_for(lambda: SDK.ping(port, 1)[1] == COMM_SUCCESS)
        assert before  # the name of the new one may be another; the link is the same
    assert not os.path.lexists(link)


def test_a_scheduled_unplugging_happens_without_a_request(
    arm_config: ArmConfig, tmp_path: Path
) -> None:
    bus = VirtualBus.from_config(arm_config, RealClock())
    link = tmp_path / "arm"
    with PtyPort(bus, link):
        bus.inject(Fault("port_unplugged", at_s=0.2, for_s=0.2))
        wait_for(lambda: not os.path.lexists(link))
        wait_for(lambda: os.path.lexists(link))


def test_two_servos_with_one_id_are_corrupt_to_the_sdk(pty: PtyPort, arm_bus: VirtualBus) -> None:
    arm_bus.servo(1).rotate_by_hand(700.0)
    arm_bus.inject(Fault("id", 2, 1))
    with opened(pty.path) as port:
        results = {SDK.read4ByteTxRx(port, 1, PRESENT)[1] for _ in range(8)}
        assert results <= {COMM_RX_CORRUPT, COMM_RX_TIMEOUT}
        assert SDK.ping(port, 3)[1] == COMM_SUCCESS


def test_a_late_answer_comes_with_the_next_request(pty: PtyPort, arm_bus: VirtualBus) -> None:
    with opened(pty.path) as port:
        arm_bus.inject(Fault("late", value=1.0, for_packets=1))
        assert SDK.read4ByteTxRx(port, 1, PRESENT)[1] == COMM_RX_TIMEOUT
        # The SDK takes the first answer of that servo, which is the one to the question before.
        assert SDK.read2ByteTxRx(port, 2, 144) == (120, COMM_SUCCESS, 0)


def test_return_delay_is_spent(pty: PtyPort, arm_bus: VirtualBus) -> None:
    arm_bus.servo(1).memory.set("return_delay_time", 254)
    for id in (2, 3, 4, 5, 6):
        arm_bus.servo(id).memory.set("return_delay_time", 0)
    found = {}
    with opened(pty.path) as port:
        for id in (1, 2):
            begin = time.monotonic()
            for _ in range(20):
                assert SDK.ping(port, id)[1] == COMM_SUCCESS
            found[id] = (time.monotonic() - begin) / 20
    assert found[1] >= 508e-6


def test_power_loss_and_its_return(pty: PtyPort, arm_bus: VirtualBus) -> None:
    with opened(pty.path) as port:
        assert SDK.write1ByteTxRx(port, 1, 64, 1) == (COMM_SUCCESS, 0)
        arm_bus.inject(Fault("supply", value=0.0))
        assert SDK.ping(port, 1)[1] == COMM_RX_TIMEOUT
        arm_bus.inject(Fault("supply", value=12.0))
        assert SDK.read1ByteTxRx(port, 1, 64) == (0, COMM_SUCCESS, 0)
        arm_bus.inject(Fault("supply", value=9.0))  # too low for them, and enough to say so
        assert SDK.read1ByteTxRx(port, 1, 70) == (1, COMM_SUCCESS, 0x80)
