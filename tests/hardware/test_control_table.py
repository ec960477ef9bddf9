"""Control tables against a second transcription of the manual and the SDK's codes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.errors import ConfigError
from robot_ik.hardware.families.dynamixel_x_table import (
    ACCELERATION_UNIT,
    BAUD_RATES,
    HARDWARE_ERRORS,
    VELOCITY_UNIT,
    X_TABLES,
    hardware_error_names,
)
from robot_ik.hardware.models import control_table, model_by_number
from robot_ik.hardware.registers import RADIANS_PER_TICK, OperatingMode, Register

# The manual's table, X series: address size name initial; s after the size: signed; r: read only;
# "-": no fixed value.
MANUAL = """
0 2r model_number -              | 2 4r model_information -     | 6 1r firmware_version -
7 1 id 1                         | 8 1 baud_rate 1               | 9 1 return_delay_time 250
10 1 drive_mode 0                | 11 1 operating_mode 3         | 12 1 secondary_id 255
13 1 protocol_type 2             | 20 4s homing_offset 0         | 24 4 moving_threshold -
31 1 temperature_limit -         | 32 2 max_voltage_limit -      | 34 2 min_voltage_limit -
36 2 pwm_limit 885               | 44 4 velocity_limit -         | 48 4 max_position_limit 4095
52 4 min_position_limit 0        | 60 1 startup_configuration 0  | 63 1 shutdown -
64 1 torque_enable 0             | 65 1 led 0                    | 68 1 status_return_level 2
69 1r registered_instruction 0   | 70 1r hardware_error_status 0 | 76 2 velocity_i_gain -
78 2 velocity_p_gain -           | 80 2 position_d_gain -        | 82 2 position_i_gain -
84 2 position_p_gain -           | 88 2 feedforward_2nd_gain 0   | 90 2 feedforward_1st_gain 0
98 1s bus_watchdog 0             | 100 2s goal_pwm -             | 104 4s goal_velocity -
108 4 profile_acceleration 0     | 112 4 profile_velocity 0      | 116 4s goal_position -
120 2r realtime_tick -           | 122 1r moving 0               | 123 1r moving_status -
124 2rs present_pwm -            | 128 4rs present_velocity -    | 132 4rs present_position -
136 4rs velocity_trajectory -    | 140 4rs position_trajectory - | 144 2r present_input_voltage -
146 1r present_temperature -     | 147 1r backup_ready 0
"""

# Per model: number, temperature, max/min voltage, current limit, velocity limit, shutdown, velocity
# I/P, position D/I/P, highest baud code, last indirect data.
MODELS = {
    "XL430-W250": (1060, 72, 140, 60, None, 265, 52, 1000, 100, 4000, 0, 640, 7, 661),
    "XM430-W210": (1030, 80, 160, 95, 1193, 330, 52, 1920, 100, 0, 0, 800, 7, 661),
    "XC430-W150": (1070, 80, 160, 60, None, 460, 52, 1920, 100, 0, 0, 460, 7, 661),
    "XC430-W240": (1080, 80, 160, 60, None, 306, 52, 1920, 100, 0, 0, 700, 7, 661),
    "XM430-W350": (1020, 80, 160, 95, 1193, 200, 52, 1920, 100, 0, 0, 800, 7, 661),
    "XH540-W150": (1110, 80, 160, 95, 2047, 300, 52, 1920, 100, 0, 0, 800, 7, 661),
    "XM540-W150": (1130, 80, 160, 95, 2047, 230, 52, 1920, 100, 0, 0, 800, 7, 661),
    "XM540-W270": (1120, 80, 160, 95, 2047, 128, 52, 1920, 100, 0, 0, 800, 7, 661),
    "XL330-M077": (1190, 70, 70, 35, 1750, 1620, 53, 400, 40, 0, 400, 400, 6, 227),
    "XL330-M288": (1200, 70, 70, 35, 1750, 445, 53, 1600, 180, 0, 0, 400, 6, 227),
    "XC330-M181": (1230, 70, 70, 35, 2352, 545, 52, 1400, 100, 500, 0, 1200, 6, 227),
    "XC330-M288": (1240, 70, 70, 35, 2352, 350, 52, 1600, 50, 500, 0, 1100, 6, 227),
    "XC330-T181": (1210, 70, 140, 55, 910, 510, 52, 1200, 40, 0, 0, 900, 6, 227),
    "XC330-T288": (1220, 70, 140, 55, 910, 320, 52, 1200, 40, 0, 0, 900, 6, 227),
}


def _manual() -> list[tuple[str, int, int, bool, bool, int | None]]:
    rows = []
    for cell in MANUAL.replace("\n", "|").split("|"):
        if cell.strip():
            address, kind, name, initial = cell.split()[:4]
            value = None if initial == "-" else int(initial)
            rows.append((name, int(address), int(kind[0]), "r" not in kind, "s" in kind, value))
    return rows


@pytest.mark.parametrize("model", MODELS)
def test_shared_registers_are_the_manual_s(model: str) -> None:
    table = X_TABLES[model]
    for name, address, size, writable, signed, initial in _manual():
        register = table[name]
        assert (register.address, register.size, register.writable, register.signed) == (
            address,
            size,
            writable,
            signed,
        ), name
        assert register.eeprom == (address < 64)
        if initial is not None:
            assert register.initial == initial, name
    own = {"current_limit", "goal_current", "present_current", "present_load"}
    own.add("pwm_slope")
    own.update(f"external_port_{what}_{k}" for what in ("mode", "data") for k in (1, 2, 3))
    listed = {name for name, *_ in _manual()}
    assert {r.name for r in table if not r.name.startswith("indirect")} - own == listed


@pytest.mark.parametrize("model", MODELS)
def test_what_differs_by_model_is_the_manual_s(model: str) -> None:
    table = X_TABLES[model]
    assert table["moving_threshold"].initial == (20 if model == "XC430-W150" else 10)
    names = "model_number temperature_limit max_voltage_limit min_voltage_limit current_limit"
    names += " velocity_limit"
    names += (
        " shutdown velocity_i_gain velocity_p_gain position_d_gain position_i_gain position_p_gain"
    )
    found = tuple(table[n].initial if n in table else None for n in names.split())
    assert (*found, table["baud_rate"].maximum, table.size - 1) == MODELS[model]
    assert table.number == MODELS[model][0]
    assert model_by_number(table.number) is table


def test_registers_only_some_models_have() -> None:
    xl430, xm430, xl330 = (X_TABLES[m] for m in ("XL430-W250", "XM430-W350", "XL330-M288"))
    assert "goal_current" not in xl430 and "current_limit" not in xl430
    assert xl430["present_load"].address == xm430["present_current"].address == 126
    for table in X_TABLES.values():  # register 40, Acceleration Limit, went with firmware 42
        assert not any(r.address <= 40 < r.end for r in table)
    assert xl330["pwm_slope"].initial == 140 and "pwm_slope" not in xm430
    for table, last, data in ((xl430, 56, 634 + 27), (xm430, 56, 634 + 27), (xl330, 20, 208 + 19)):
        assert table[f"indirect_data_{last}"].address == data
        assert table[f"indirect_address_{last}"].initial == data
        assert f"indirect_data_{last + 1}" not in table
    assert xm430["indirect_address_29"].address == 578


def test_every_model_of_the_manual_is_there_once() -> None:
    assert set(X_TABLES) == set(MODELS)
    numbers = [table.number for table in X_TABLES.values()]
    assert len(set(numbers)) == len(numbers)
    ports = {name for name, table in X_TABLES.items() if "external_port_mode_1" in table}
    assert ports == {"XH540-W150", "XM540-W150", "XM540-W270"}
    without_current = {name for name, table in X_TABLES.items() if "present_load" in table}
    assert without_current == {"XL430-W250", "XC430-W150", "XC430-W240"}
    assert all(
        OperatingMode.CURRENT_BASED_POSITION not in X_TABLES[n].modes for n in without_current
    )


@pytest.mark.parametrize("model", X_TABLES)
def test_limits_of_a_model_agree(model: str) -> None:
    table = X_TABLES[model]
    for name in ("velocity", "pwm", "current"):
        if f"{name}_limit" in table:
            limit = table[f"{name}_limit"]
            goal = table[f"goal_{name}"]
            assert (goal.minimum, goal.maximum, goal.unit) == (
                -limit.maximum,
                limit.maximum,
                limit.unit,
            )
    motor = table.motor
    units = {"1 mA": 1.0, "2.69 mA": 2.69, None: 1.0}[
        table["current_limit"].unit if "current_limit" in table else None
    ]
    if "current_limit" in table:  # the manual lets at least the stall current through
        assert table["current_limit"].maximum * units >= 1000 * motor.stall_current
    # Velocity Limit lies above the no load speed, but not far.
    assert 0.7 < table["velocity_limit"].initial * 0.229 / motor.no_load_rpm < 2.0
    assert 0.2 < motor.stall_torque / motor.stall_current < 3.0 or model == "XL330-M077"


def test_firmware_decides_what_is_there() -> None:
    new, old, older = (control_table("XM430-W350", firmware) for firmware in (45, 44, 37))
    bits = [table["drive_mode"].maximum for table in (new, old)]
    assert bits == [0b1101, 0b0101] and "drive_mode" not in older
    assert "startup_configuration" in new and "startup_configuration" not in old
    assert "backup_ready" in new and "bus_watchdog" in old and "bus_watchdog" not in older
    assert new.abilities == {"fast_read", "backup", "guarded_reset", "clear"}
    assert old.abilities == {"guarded_reset", "clear"}
    # the 540 class can be a slave
    assert control_table("XM540-W270")["drive_mode"].maximum == 0b1111
    assert old["firmware_version"].initial == 44
    small = (
        control_table("XL330-M288"),
        control_table("XL330-M288", 51),
        control_table("XL330-M288", 45),
    )
    assert [t["indirect_data_1"].address for t in small] == [208, 224, 224]
    assert [t["indirect_address_1"].maximum for t in small] == [227, 243, 243]
    assert "backup" in small[1].abilities and "backup" not in small[2].abilities
    with pytest.raises(ConfigError, match="firmware"):
        control_table("XM430-W350", 0)


@pytest.mark.parametrize("model", X_TABLES)
def test_registers_do_not_overlap_and_start_within_their_range(model: str) -> None:
    end = 0
    for register in X_TABLES[model]:
        assert register.address >= end, register.name
        end = register.end
        register.encode(register.minimum), register.encode(register.maximum)  # they fit
        if register.initial is not None and register.writable:
            assert register.minimum <= register.initial <= register.maximum, register.name


def test_the_manual_s_codes() -> None:
    assert BAUD_RATES == {
        0: 9600,
        1: 57600,
        2: 115200,
        3: 1000000,
        4: 2000000,
        5: 3000000,
        6: 4000000,
        7: 4500000,
    }
    assert 4_500_000 not in X_TABLES["XL330-M288"].baud_rates
    assert 4_500_000 in X_TABLES["XM430-W350"].baud_rates
    assert hardware_error_names(0) == ()
    assert hardware_error_names(0b100101) == ("input_voltage", "overheating", "overload")
    assert hardware_error_names(0b10) == ("bit1",)
    assert set(HARDWARE_ERRORS) == {0, 2, 3, 4, 5}


def test_units_of_the_manual() -> None:
    assert pytest.approx(0.0015339808, rel=1e-7) == RADIANS_PER_TICK
    assert pytest.approx(0.023981, abs=5e-7) == VELOCITY_UNIT
    assert pytest.approx(0.374505, abs=5e-6) == ACCELERATION_UNIT


def _register(size: int, signed: bool) -> Register:
    return Register("x", 0, size, True, signed, "", False, 0, 0, 0)


@given(st.sampled_from([1, 2, 4]), st.booleans(), st.data())
def test_values_survive_their_bytes(size: int, signed: bool, data: st.DataObject) -> None:
    register = _register(size, signed)
    raw = data.draw(st.binary(min_size=size, max_size=size))
    value = register.decode(raw)
    assert register.encode(value) == raw
    by_hand = sum(byte << 8 * k for k, byte in enumerate(raw))
    if signed and by_hand >> (8 * size - 1):
        by_hand -= 1 << 8 * size
    assert value == by_hand


@pytest.mark.parametrize(
    "size,signed,value",
    [(1, False, 256), (1, False, -1), (2, True, 32768), (4, True, -(2**31) - 1)],
)
def test_values_that_do_not_fit_are_refused(size: int, signed: bool, value: int) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        _register(size, signed).encode(value)


def test_bytes_of_another_length_are_refused() -> None:
    for raw in (b"", b"\x00", b"\x00\x00\x00"):
        with pytest.raises(ValueError, match="2 bytes"):
            _register(2, False).decode(raw)


def test_unknown_names_come_with_close_ones() -> None:
    with pytest.raises(KeyError, match="present_position"):
        X_TABLES["XM430-W350"]["present_positon"]
    with pytest.raises(ConfigError, match="XM430-W350"):
        control_table("XM430-W35")
    assert model_by_number(12) is None


def test_tables_cannot_be_changed() -> None:
    table = X_TABLES["XM430-W350"]
    with pytest.raises(TypeError):
        table.registers["id"] = table["led"]  # type: ignore[index]
    with pytest.raises(AttributeError):
        table["id"].address = 3  # type: ignore[misc]
