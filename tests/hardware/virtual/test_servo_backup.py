"""Backups of the control table, what a servo does at power on, and firmware that cannot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.protocol import ErrorCode, Instruction, build, build_status
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock

STORE = bytes.fromhex("FFFFFD00 01 0800 20 01 4354524C 16F5")
# The manual prints 92 F5 as the checksum of this one; the SDK's own CRC says otherwise.
RESTORE = build(1, Instruction.CONTROL_TABLE_BACKUP, b"\x02CTRL")
Make = Callable[..., Any]


def _bus(model: str = "XC330-T288", **options: Any) -> VirtualBus:
    clock = VirtualClock()
    return VirtualBus([VirtualServo(model, 1, clock, **options)], clock)


def test_the_manual_s_packet_stores_and_its_sibling_restores() -> None:
    bus = _bus()
    memory = bus.servo(1).memory
    memory.set("position_p_gain", 777)
    memory.set("return_delay_time", 3)
    assert bus.handle(STORE) == build_status(1, 0)
    assert memory.values["backup_ready"] == 1
    memory.set("return_delay_time", 99)
    memory.set("position_p_gain", 1)
    assert bus.handle(RESTORE) == build_status(1, 0)
    assert memory.values["return_delay_time"] == 3
    # EEPROM only, and then a reboot: gains are at their defaults again, the backup is still there.
    assert (memory.values["position_p_gain"], memory.values["backup_ready"]) == (900, 1)


def test_no_backup_with_torque_and_none_to_restore() -> None:
    bus = _bus()
    assert bus.handle(RESTORE) == build_status(1, ErrorCode.RESULT_FAIL)
    bus.servo(1).write(64, b"\x01")
    assert bus.handle(STORE) == build_status(1, ErrorCode.RESULT_FAIL)
    assert bus.handle(build(1, Instruction.CONTROL_TABLE_BACKUP, b"\x03CTRL")) == build_status(
        1, ErrorCode.DATA_RANGE
    )


def test_startup_configuration(make_bench: Make) -> None:
    bench = make_bench()
    bench.set(
        startup_configuration=0b10, position_p_gain=500, profile_velocity=33, indirect_address_1=132
    )
    bench.servo.reboot()
    assert bench.read("position_p_gain") == 800  # there is no backup yet
    bench.set(position_p_gain=500, profile_velocity=33, indirect_address_1=132, led=1)
    assert bench.servo.control_table_backup(b"\x01CTRL") == ErrorCode.NONE
    bench.servo.reboot()
    names = ("position_p_gain", "profile_velocity", "indirect_address_1", "led", "torque_enable")
    assert [bench.read(n) for n in names] == [500, 33, 132, 0, 0]
    bench.set(startup_configuration=0b01)
    bench.servo.rotate_by_hand(300.0)
    bench.servo.switch(on=False)
    assert not bench.servo.torque and bench.servo.deaf
    bench.servo.switch(on=True)
    bench.wait(1.0)
    assert (
        bench.servo.torque and bench.read("present_position") == bench.read("goal_position") == 2348
    )


def test_power_loss_forgets_what_is_not_eeprom(make_bench: Make) -> None:
    bench = make_bench()
    bench.set(led=1, return_delay_time=9, profile_velocity=5)
    assert bench.servo.reg_write(65, b"\x00") == ErrorCode.NONE
    bench.servo.switch(on=False)
    bench.servo.switch(on=True)
    found = [
        bench.read(n)
        for n in ("led", "return_delay_time", "profile_velocity", "registered_instruction")
    ]
    assert found == [0, 9, 0, 0]
    assert bench.servo.action() == ErrorCode.INSTRUCTION


def test_old_firmware_knows_no_backup_and_no_fast_read() -> None:
    bus = _bus("XM430-W350", firmware=44)
    assert bus.handle(STORE) == build_status(1, ErrorCode.INSTRUCTION)
    read = b"\x84\x00\x04\x00\x01"
    assert bus.handle(build(254, Instruction.FAST_SYNC_READ, read)) == b""
    assert bus.handle(build(254, Instruction.SYNC_READ, read)) != b""
    assert bus.handle(build(1, Instruction.PING))[-3] == 44
    older = _bus("XM430-W350", firmware=37)
    assert older.handle(build(1, Instruction.READ, b"\x62\x00\x01\x00")) == build_status(
        1, ErrorCode.ACCESS
    )
    assert older.handle(build(254, Instruction.FACTORY_RESET, b"\xff")) == b""
    assert older.servo(1).baud == 57_600  # it was obeyed: the guard came with firmware 42
    assert _bus("XM430-W350").servo(1).baud == 1_000_000


@settings(max_examples=60, deadline=None)
@given(
    model=st.sampled_from(sorted(X_TABLES)),
    writes=st.lists(st.tuples(st.integers(0, 670), st.binary(max_size=8)), max_size=25),
)
def test_memory_is_bytes_with_rules(model: str, writes: list[tuple[int, bytes]]) -> None:
    """An array of bytes is the judge: accepted writes are there, refused ones changed nothing."""
    table = X_TABLES[model]
    memory = Memory(table)
    plain = {r.name: r.initial or 0 for r in table}
    for address, data in writes:
        values, error = memory.parse_write(address, data)
        assert bool(values) == (not error)
        for register, value in values:
            assert register.writable and register.minimum <= value <= register.maximum
            memory.set(register.name, value)
            plain[register.name] = value
        if not error and address + len(data) <= memory.first_indirect:
            assert memory.read(address, len(data)) == (data, ErrorCode.NONE)
    assert memory.values == plain
    for register in table:
        if not register.name.startswith("indirect_data"):
            raw, error = memory.read(register.address, register.size)
            assert not error and register.decode(raw) == plain[register.name]


@pytest.mark.parametrize("option,kept", [(0xFF, (1, 1)), (1, (7, 1)), (2, (7, 3))])
def test_factory_reset_keeps_the_requested_registers(option: int, kept: tuple[int, int]) -> None:
    bus = _bus()
    bus.servo(1).memory.set("id", 7)
    reply = bus.handle(build(7, Instruction.FACTORY_RESET, bytes([option])))
    assert reply == build_status(7, 0)
    memory = bus.servos[0].memory
    assert (memory.values["id"], memory.values["baud_rate"]) == kept
