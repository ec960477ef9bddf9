"""The memory of a virtual servo: the rules of the manual for every register."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.registers import OperatingMode, Register
from robot_ik.hardware.virtual.protocol import ErrorCode

EXTENDED = OperatingMode.EXTENDED_POSITION


def fits(register: Register, value: int) -> bool:
    """The bytes of the register can say this value at all."""
    try:
        register.encode(value)
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("model", X_TABLES)
def test_every_register_starts_as_the_manual_says(
    model: str, make_bench: Callable[..., Any]
) -> None:
    bench = make_bench(model)
    own = {"id", "baud_rate", "operating_mode"}
    for register in bench.servo.table:
        if register.initial is not None and register.name not in own:
            assert bench.read(register.name) == register.initial, register.name
    assert bench.read("goal_position") == bench.read("present_position") == 2048


@pytest.mark.parametrize("model", X_TABLES)
def test_every_register_keeps_its_range_and_access(
    model: str, make_bench: Callable[..., Any]
) -> None:
    bench = make_bench(model)
    for register in bench.servo.table:
        # Pointers would redirect the data registers behind them; the others have rules of their
        # own, tested below.
        if register.name.startswith(
            ("indirect_address", "goal_", "operating", "drive", "torque", "bus_")
        ):
            continue
        if not register.writable:
            value = bench.read(register.name)
            assert bench.write(register.name, value) == ErrorCode.ACCESS, register.name
            continue
        for value in (register.minimum, register.maximum):
            assert bench.write(register.name, value) == ErrorCode.NONE, register.name
            assert bench.read(register.name) == value
        for value in (register.minimum - 1, register.maximum + 1):
            if fits(register, value):
                assert bench.write(register.name, value) == ErrorCode.DATA_RANGE, register.name
                assert bench.read(register.name) == register.maximum


def test_eeprom_is_locked_while_torque_is_on(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(torque_enable=1)
    assert bench.write("return_delay_time", 0) == ErrorCode.ACCESS
    assert bench.read("return_delay_time") == 250
    assert bench.write("led", 1) == ErrorCode.NONE
    bench.set(torque_enable=0, return_delay_time=0)
    assert bench.read("return_delay_time") == 0


@pytest.mark.parametrize(
    "address,data,error",
    [
        (116, b"\x00\x08", ErrorCode.DATA_LENGTH),  # half of goal position
        (117, b"\x00\x08\x00\x00", ErrorCode.DATA_LENGTH),  # begins inside it
        (116, b"", ErrorCode.DATA_LENGTH),
        (148, b"\x00", ErrorCode.ACCESS),  # no register
        (5000, b"\x00", ErrorCode.ACCESS),  # no memory
        (132, b"\x00\x08\x00\x00", ErrorCode.ACCESS),  # present position
        (65, b"\x02", ErrorCode.DATA_RANGE),
    ],
)
def test_wrong_writes_change_nothing(
    address: int, data: bytes, error: ErrorCode, make_bench: Callable[..., Any]
) -> None:
    bench = make_bench()
    before = bench.servo.read(0, 148)
    assert bench.servo.write(address, data) == error
    assert bench.servo.read(0, 148) == before


def test_one_write_over_several_registers_is_all_or_nothing(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    good = b"".join(v.to_bytes(4, "little") for v in (30, 40, 3000))
    assert bench.servo.write(108, good) == ErrorCode.NONE
    names = ("profile_acceleration", "profile_velocity", "goal_position")
    assert [bench.read(n) for n in names] == [30, 40, 3000]
    bad = b"".join(v.to_bytes(4, "little") for v in (31, 41, 5000))
    assert bench.servo.write(108, bad) == ErrorCode.DATA_LIMIT
    assert [bench.read(n) for n in names] == [30, 40, 3000]


@pytest.mark.parametrize("address,length", [(148, 4), (662, 1), (0, 0), (600, 100)])
def test_reads_of_nothing_are_refused(
    address: int, length: int, make_bench: Callable[..., Any]
) -> None:
    data, error = make_bench().servo.read(address, length)
    assert data == b"" and error != ErrorCode.NONE


@pytest.mark.parametrize("model", X_TABLES)
def test_indirect_data_are_other_registers(model: str, make_bench: Callable[..., Any]) -> None:
    bench = make_bench(model)
    present = bench.servo.table["present_position"]
    goal = bench.servo.table["goal_position"]
    for k in range(4):
        bench.set(
            **{
                f"indirect_address_{k + 1}": present.address + k,
                f"indirect_address_{k + 5}": goal.address + k,
            }
        )
    first = bench.servo.table["indirect_data_1"].address
    data, error = bench.servo.read(first, 8)
    assert error == ErrorCode.NONE
    assert (present.decode(data[:4]), goal.decode(data[4:])) == (2048, 2048)
    assert bench.servo.write(first + 4, goal.encode(2222)) == ErrorCode.NONE
    assert bench.read("goal_position") == 2222
    assert bench.servo.write(first + 4, goal.encode(9999)) == ErrorCode.DATA_LIMIT
    assert bench.servo.write(first, present.encode(0)) == ErrorCode.ACCESS


def test_one_turn_mode_obeys_the_position_limits_and_extended_does_not(
    make_bench: Callable[..., Any],
) -> None:
    bench = make_bench()
    bench.set(min_position_limit=1000, max_position_limit=3000)
    assert bench.write("goal_position", 999) == ErrorCode.DATA_LIMIT
    assert bench.write("goal_position", 3001) == ErrorCode.DATA_LIMIT
    bench.set(operating_mode=EXTENDED)
    for goal in (-1_048_575, 999, 1_048_575):
        assert bench.write("goal_position", goal) == ErrorCode.NONE
    assert bench.write("goal_position", 1_048_576) == ErrorCode.DATA_RANGE


@pytest.mark.parametrize(
    "name,limit", [("goal_velocity", 200), ("goal_pwm", 885), ("goal_current", 1193)]
)
def test_goals_end_at_the_limit_registers(
    name: str, limit: int, make_bench: Callable[..., Any]
) -> None:
    bench = make_bench()
    assert bench.write(name, limit) == bench.write(name, -limit) == ErrorCode.NONE
    bench.set(**{name.removeprefix("goal_") + "_limit": limit - 10})
    assert bench.write(name, limit) == bench.write(name, -limit) == ErrorCode.DATA_LIMIT
    assert bench.read(name) == -limit


def test_drive_mode_has_the_bits_of_the_model(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    # the slave bit is for larger servos
    assert bench.write("drive_mode", 2) == ErrorCode.DATA_RANGE
    assert bench.write("drive_mode", 13) == ErrorCode.NONE


def test_torque_by_goal(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(drive_mode=8, goal_position=3000)
    assert bench.read("torque_enable") == 1
    bench.wait(5.0)
    assert bench.read("present_position") == 3000
    bench.servo.inject_error("overload")
    bench.set(goal_position=1000)
    assert bench.read("torque_enable") == 0


@pytest.mark.parametrize("model,last", [("XM430-W350", 661), ("XL330-M288", 227)])
def test_an_indirect_address_points_into_ram(
    model: str, last: int, make_bench: Callable[..., Any]
) -> None:
    bench = make_bench(model)
    for address in (0, 63, last + 1, 65535):
        assert bench.write("indirect_address_1", address) == ErrorCode.DATA_RANGE
    bench.set(indirect_address_1=150)  # a gap between registers
    assert (
        bench.write("indirect_data_1", 77) == ErrorCode.ACCESS
        and bench.read("indirect_data_1") == 0
    )


@pytest.mark.parametrize(
    "model,mode,error",
    [
        ("XM430-W350", 0, ErrorCode.NONE),
        ("XM430-W350", 2, ErrorCode.DATA_RANGE),
        ("XM430-W350", 5, ErrorCode.NONE),
        ("XL430-W250", 5, ErrorCode.DATA_RANGE),  # the model has no current sensor
        ("XL430-W250", 4, ErrorCode.NONE),
    ],
)
def test_modes(model: str, mode: int, error: ErrorCode, make_bench: Callable[..., Any]) -> None:
    assert make_bench(model).write("operating_mode", mode) == error


def test_a_mode_change_resets_gains_and_profile(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(
        profile_velocity=50, profile_acceleration=7, position_p_gain=900, operating_mode=EXTENDED
    )
    names = ("profile_velocity", "profile_acceleration", "position_p_gain")
    assert [bench.read(n) for n in names] == [0, 0, 800]


@pytest.mark.parametrize(
    "offset,mode,reading",
    [
        (500, OperatingMode.POSITION, 2548),
        (-1024, OperatingMode.POSITION, 1024),
        (1025, OperatingMode.POSITION, 2048),  # beyond a quarter revolution: ignored
        (1025, EXTENDED, 3073),
        (-9000, EXTENDED, -6952),
    ],
)
def test_homing_offset(
    offset: int, mode: OperatingMode, reading: int, make_bench: Callable[..., Any]
) -> None:
    bench = make_bench(mode=mode)
    bench.set(homing_offset=offset)
    assert bench.read("present_position") == reading
    assert bench.servo.true_ticks == 2048.0  # nothing turned
    bench.set(torque_enable=1, goal_position=reading + 100)
    bench.wait(5.0)
    assert bench.servo.true_ticks == 2148.0


def test_reverse_turns_the_other_way(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED, position_ticks=100)
    bench.set(drive_mode=1)
    assert bench.read("present_position") == -100
    bench.set(torque_enable=1, profile_velocity=100, goal_position=-100 + 500)
    bench.wait(0.1)
    assert bench.read("present_velocity") > 0
    bench.wait(5.0)
    assert (bench.read("present_position"), bench.servo.true_ticks) == (400, -400.0)


def test_one_turn_mode_reads_within_a_turn(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED, position_ticks=-100)
    assert bench.read("present_position") == -100
    bench.set(operating_mode=OperatingMode.POSITION)
    assert bench.read("present_position") == 3996
    assert bench.servo.true_ticks == -100.0
    assert make_bench(position_ticks=4095.7).read("present_position") == 0
