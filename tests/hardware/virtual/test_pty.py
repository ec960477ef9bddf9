"""The virtual bus over a real pty, driven by the official SDK."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import serial
from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)

from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.protocol import Instruction, build
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock, VirtualClock
from tests.waiting import LONG, wait_for

SDK = PacketHandler(2.0)
TORQUE = 64
GOAL = 116
PRESENT = 132
ERROR_STATUS = 70
WATCHDOG = 98
pytestmark = pytest.mark.usefixtures("real_time")


def _open(pty: PtyPort, baud: int = 1_000_000) -> Iterator[PortHandler]:
    port = PortHandler(pty.path)
    assert port.setBaudRate(baud)  # opens it too
    yield port
    port.closePort()


@pytest.fixture
def port(pty: PtyPort) -> Iterator[PortHandler]:
    yield from _open(pty)


def _signed(value: int) -> int:
    return value - 2**32 if value >= 2**31 else value


def test_ping_and_broadcast_ping(port: PortHandler) -> None:
    assert SDK.ping(port, 4) == (1060, COMM_SUCCESS, 0)
    found, result = SDK.broadcastPing(port)
    assert result == COMM_SUCCESS
    assert {id: model for id, (model, _) in found.items()} == {
        1: 1020,
        2: 1020,
        3: 1020,
        4: 1060,
        5: 1060,
        6: 1020,
    }


def test_a_free_id_gets_no_reply(port: PortHandler) -> None:
    assert SDK.ping(port, 77)[1] == COMM_RX_TIMEOUT


def test_a_servo_moves_to_its_goal(
    port: PortHandler, clock: VirtualClock, arm_bus: VirtualBus, arm_config: ArmConfig
) -> None:
    assert SDK.write1ByteTxRx(port, 1, TORQUE, 1) == (COMM_SUCCESS, 0)
    assert SDK.write4ByteTxRx(port, 1, GOAL, 3000) == (COMM_SUCCESS, 0)
    assert SDK.read4ByteTxRx(port, 1, PRESENT) == (2048, COMM_SUCCESS, 0)
    clock.sleep_until(clock.now() + 5.0)
    assert SDK.read4ByteTxRx(port, 1, PRESENT) == (3000, COMM_SUCCESS, 0)
    q = (3000 - 2048) / 4096 * 2 * 3.141592653589793
    assert arm_bus.true_angles(arm_config)[0] == pytest.approx(q, abs=1e-12)


def test_negative_goals_are_signed_on_the_wire(port: PortHandler, clock: VirtualClock) -> None:
    SDK.write1ByteTxRx(port, 1, TORQUE, 1)
    assert SDK.write4ByteTxRx(port, 1, GOAL, 2**32 - 5000) == (COMM_SUCCESS, 0)
    clock.sleep_until(clock.now() + 10.0)
    assert _signed(SDK.read4ByteTxRx(port, 1, PRESENT)[0]) == -5000


@pytest.mark.parametrize("fast", [False, True])
def test_sync_write_and_both_sync_reads(port: PortHandler, clock: VirtualClock, fast: bool) -> None:
    ids = range(1, 7)
    torque = GroupSyncWrite(port, SDK, TORQUE, 1)
    goals = GroupSyncWrite(port, SDK, GOAL, 4)
    for id in ids:
        assert torque.addParam(id, [1])
        assert goals.addParam(id, list((1000 + 100 * id).to_bytes(4, "little")))
    assert torque.txPacket() == goals.txPacket() == COMM_SUCCESS
    SDK.ping(port, 1)  # a sync write has no reply: wait until it was read before time moves
    clock.sleep_until(clock.now() + 5.0)
    reader = GroupSyncRead(port, SDK, PRESENT, 4)
    for id in ids:
        assert reader.addParam(id)
    assert (reader.fastSyncRead() if fast else reader.txRxPacket()) == COMM_SUCCESS
    assert [reader.getData(id, PRESENT, 4) for id in ids] == [1000 + 100 * id for id in ids]


def test_reg_write_waits_for_the_action(port: PortHandler, clock: VirtualClock) -> None:
    SDK.write1ByteTxRx(port, 1, TORQUE, 1)
    assert SDK.regWriteTxRx(port, 1, GOAL, 4, list((2500).to_bytes(4, "little"))) == (
        COMM_SUCCESS,
        0,
    )
    clock.sleep_until(clock.now() + 5.0)
    assert SDK.read4ByteTxRx(port, 1, PRESENT)[0] == 2048
    SDK.action(port, 254)  # the SDK waits for no reply, so send it to all: a broadcast has none
    SDK.ping(port, 1)
    clock.sleep_until(clock.now() + 5.0)
    assert SDK.read4ByteTxRx(port, 1, PRESENT)[0] == 2500


def test_overload_is_seen_and_reboot_clears_it(port: PortHandler, arm_bus: VirtualBus) -> None:
    SDK.write1ByteTxRx(port, 3, TORQUE, 1)
    arm_bus.inject(Fault("overload", 3))
    assert SDK.read1ByteTxRx(port, 3, ERROR_STATUS) == (1 << 5, COMM_SUCCESS, 0x80)
    assert SDK.read1ByteTxRx(port, 3, TORQUE) == (0, COMM_SUCCESS, 0x80)
    arm_bus.clear()
    assert SDK.reboot(port, 3)[0] == COMM_SUCCESS
    assert SDK.read1ByteTxRx(port, 3, ERROR_STATUS) == (0, COMM_SUCCESS, 0)


def test_stuffing_both_ways_with_the_sdk(port: PortHandler) -> None:
    # Indirect Data 1..6 (XM430: from 224) take any byte.
    data = [0xFF, 0xFF, 0xFD, 0xFF, 0xFF, 0xFD]
    assert SDK.writeTxRx(port, 1, 224, len(data), data) == (COMM_SUCCESS, 0)
    assert SDK.readTxRx(port, 1, 224, len(data)) == (data, COMM_SUCCESS, 0)


@pytest.mark.parametrize("client,heard", [(1_000_000, True), (57_600, False), (4_000_000, False)])
def test_match_baud(arm_bus: VirtualBus, client: int, heard: bool) -> None:
    with PtyPort(arm_bus, match_baud=True) as pty:
        for port in _open(pty, client):
            assert pty.client_baud() == client
            assert (SDK.ping(port, 1)[1] == COMM_SUCCESS) is heard


def test_every_servo_keeps_its_own_rate(arm_bus: VirtualBus) -> None:
    with PtyPort(arm_bus, match_baud=True) as pty:
        for port in _open(pty, 1_000_000):
            # answered at the old rate
            assert SDK.write1ByteTxRx(port, 2, 8, 1) == (COMM_SUCCESS, 0)
            assert SDK.ping(port, 2)[1] == COMM_RX_TIMEOUT
            assert SDK.ping(port, 1)[1] == COMM_SUCCESS
        for port in _open(pty, 57_600):
            assert SDK.ping(port, 2)[1] == COMM_SUCCESS


def test_a_client_that_never_reads_does_not_stop_the_bus(pty: PtyPort, arm_bus: VirtualBus) -> None:
    arm_bus.servo(1).memory.set("return_delay_time", 0)  # or it takes half a millisecond a reply
    with serial.Serial(pty.path, 1_000_000, write_timeout=LONG) as deaf:
        for _ in range(3000):
            deaf.write(build(1, Instruction.PING))
        deaf.write(build(254, Instruction.WRITE, b"\x41\x00\x01"))  # LED of all
        wait_for(lambda: arm_bus.servo(1).memory.values["led"] == 1)
    for port in _open(pty):
        assert SDK.ping(port, 1)[1] == COMM_SUCCESS


def test_bus_watchdog_freezes_the_shaft_when_the_client_is_gone(arm_config: ArmConfig) -> None:
    bus = VirtualBus.from_config(arm_config, RealClock())
    with PtyPort(bus) as pty:
        for port in _open(pty):
            assert SDK.write1ByteTxRx(port, 1, TORQUE, 1) == (COMM_SUCCESS, 0)
            assert SDK.write4ByteTxRx(port, 1, 112, 20) == (COMM_SUCCESS, 0)  # slow: 313 ticks/s
            assert SDK.write1ByteTxRx(port, 1, WATCHDOG, 25) == (COMM_SUCCESS, 0)
            assert SDK.write4ByteTxRx(port, 1, GOAL, 20_000) == (COMM_SUCCESS, 0)
        time.sleep(0.8)
        frozen = bus.servo(1).true_ticks
        time.sleep(0.2)
        assert bus.servo(1).true_ticks == frozen > 2048.0
        for port in _open(pty):
            assert SDK.read1ByteTxRx(port, 1, WATCHDOG)[0] == 255
            assert SDK.write4ByteTxRx(port, 1, GOAL, 3000) == (COMM_SUCCESS, 4)  # data range
            assert SDK.read1ByteTxRx(port, 1, TORQUE)[0] == 1
            assert SDK.write1ByteTxRx(port, 1, WATCHDOG, 0) == (COMM_SUCCESS, 0)
            assert SDK.write4ByteTxRx(port, 1, GOAL, 3000) == (COMM_SUCCESS, 0)
