"""Control tables of Dynamixel X servos, as data: a new model is one row of ``MODELS``.

One table is shared by the series.  Each model and firmware adds a few differences.  Names are those
of the manual in snake_case.

Source: ROBOTIS e-manual (ROBOTIS-GIT/emanual), control table pages docs/en/dxl/x/*.md and the texts
they include, _includes/en/dxl/control_table_*.md.  Motors: _data/dxl_x_info.yml (stall torque,
stall current and no load speed at the recommended voltage), read on 2026-11-22.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from robot_ik.hardware.registers import (
    TICKS_PER_REVOLUTION,
    ControlTable,
    Motor,
    OperatingMode,
    Register,
)

VELOCITY_UNIT = 0.229 * 2.0 * math.pi / 60.0
"""One unit of the velocity registers: 0.229 rev/min, in rad/s."""

ACCELERATION_UNIT = 214.577 * 2.0 * math.pi / 3600.0
"""One unit of the acceleration registers: 214.577 rev/min^2, in rad/s^2."""

BAUD_RATES: Mapping[int, int] = MappingProxyType(
    {
        0: 9_600,
        1: 57_600,
        2: 115_200,
        3: 1_000_000,
        4: 2_000_000,
        5: 3_000_000,
        6: 4_000_000,
        7: 4_500_000,
    }
)
"""Value of the Baud Rate register -> bit/s."""

HARDWARE_ERRORS: Mapping[int, str] = MappingProxyType(
    {
        0: "input_voltage",
        2: "overheating",
        3: "motor_encoder",
        4: "electrical_shock",
        5: "overload",
    }
)
"""Bit of Hardware Error Status and Shutdown -> name."""

EEPROM_END = 64
"""Address of the first register that is lost without power."""

TRIPPED = -1
"""Value of Bus Watchdog after it ran out."""

POSITION_MODE_HOMING = TICKS_PER_REVOLUTION // 4
"""Ticks of Homing Offset beyond which servos in position mode ignore it.

ROBOTIS-GIT/emanual _includes/en/dxl/control_table_homingoffset.md.
"""

HOMING_FIXES = (
    'mode = "extended_position" (the offset counts there); or Homing Offset 0 in the servo, and '
    "the zero in zero_ticks: robot-ik servo calibrate"
)
"""What to do about such an offset."""

RETURN_READ = 1
"""Status Return Level of a servo that answers pings and reads."""

RETURN_ALL = 2
"""Status Return Level of a servo that answers everything."""


def hardware_error_names(value: int) -> tuple[str, ...]:
    """Names of the bits set in Hardware Error Status; unused bits appear as ``bit1`` and so on."""
    return tuple(HARDWARE_ERRORS.get(bit, f"bit{bit}") for bit in range(8) if value >> bit & 1)


# name, address, size, access (s = signed, r = read only), unit, initial, minimum, maximum.
# None as initial: depends on the servo's state.  Addresses below 64 are EEPROM.
Row = tuple[str, int, int, str, str, int | None, int, int]
Changes = Mapping[str, Mapping[str, object]]
SHARED: tuple[Row, ...] = (
    ("model_number", 0, 2, "r", "", None, 0, 65535),
    ("model_information", 2, 4, "r", "", 0, 0, 2**32 - 1),
    ("firmware_version", 6, 1, "r", "", 48, 0, 255),
    ("id", 7, 1, "", "", 1, 0, 252),
    ("baud_rate", 8, 1, "", "code", 1, 0, 7),
    ("return_delay_time", 9, 1, "", "2 us", 250, 0, 254),
    ("drive_mode", 10, 1, "", "bits", 0, 0, 255),
    ("operating_mode", 11, 1, "", "code", 3, 0, 16),
    ("secondary_id", 12, 1, "", "", 255, 0, 255),
    ("protocol_type", 13, 1, "", "", 2, 1, 2),
    ("homing_offset", 20, 4, "s", "tick", 0, -1_044_479, 1_044_479),
    ("moving_threshold", 24, 4, "", "0.229 rev/min", 10, 0, 1023),
    ("temperature_limit", 31, 1, "", "1 C", 80, 0, 100),
    ("max_voltage_limit", 32, 2, "", "0.1 V", 160, 31, 160),
    ("min_voltage_limit", 34, 2, "", "0.1 V", 95, 31, 160),
    ("pwm_limit", 36, 2, "", "0.113 %", 885, 0, 885),
    ("current_limit", 38, 2, "", "2.69 mA", 1193, 0, 1193),
    ("velocity_limit", 44, 4, "", "0.229 rev/min", 200, 0, 2047),
    ("max_position_limit", 48, 4, "", "tick", 4095, 0, 4095),
    ("min_position_limit", 52, 4, "", "tick", 0, 0, 4095),
    ("startup_configuration", 60, 1, "", "bits", 0, 0, 3),
    ("shutdown", 63, 1, "", "bits", 52, 0, 255),
    ("torque_enable", 64, 1, "", "", 0, 0, 1),
    ("led", 65, 1, "", "", 0, 0, 1),
    ("status_return_level", 68, 1, "", "", 2, 0, 2),
    ("registered_instruction", 69, 1, "r", "", 0, 0, 1),
    ("hardware_error_status", 70, 1, "r", "bits", 0, 0, 255),
    ("velocity_i_gain", 76, 2, "", "", 1920, 0, 16383),
    ("velocity_p_gain", 78, 2, "", "", 100, 0, 16383),
    ("position_d_gain", 80, 2, "", "", 0, 0, 16383),
    ("position_i_gain", 82, 2, "", "", 0, 0, 16383),
    ("position_p_gain", 84, 2, "", "", 800, 0, 16383),
    ("feedforward_2nd_gain", 88, 2, "", "", 0, 0, 16383),
    ("feedforward_1st_gain", 90, 2, "", "", 0, 0, 16383),
    ("bus_watchdog", 98, 1, "s", "20 ms", 0, 0, 127),
    ("goal_pwm", 100, 2, "s", "0.113 %", None, -885, 885),
    ("goal_current", 102, 2, "s", "2.69 mA", None, -1193, 1193),
    ("goal_velocity", 104, 4, "s", "0.229 rev/min", None, -2047, 2047),
    ("profile_acceleration", 108, 4, "", "214.577 rev/min^2 or ms", 0, 0, 32767),
    ("profile_velocity", 112, 4, "", "0.229 rev/min or ms", 0, 0, 32767),
    ("goal_position", 116, 4, "s", "tick", None, -1_048_575, 1_048_575),
    ("realtime_tick", 120, 2, "r", "ms", None, 0, 32767),
    ("moving", 122, 1, "r", "", 0, 0, 1),
    ("moving_status", 123, 1, "r", "bits", None, 0, 255),
    ("present_pwm", 124, 2, "rs", "0.113 %", None, -885, 885),
    ("present_current", 126, 2, "rs", "2.69 mA", None, -32768, 32767),
    ("present_velocity", 128, 4, "rs", "0.229 rev/min", None, -(2**31), 2**31 - 1),
    ("present_position", 132, 4, "rs", "tick", None, -(2**31), 2**31 - 1),
    ("velocity_trajectory", 136, 4, "rs", "0.229 rev/min", None, -(2**31), 2**31 - 1),
    ("position_trajectory", 140, 4, "rs", "tick", None, -(2**31), 2**31 - 1),
    ("present_input_voltage", 144, 2, "r", "0.1 V", None, 0, 65535),
    ("present_temperature", 146, 1, "r", "1 C", None, 0, 255),
    ("backup_ready", 147, 1, "r", "", 0, 0, 1),
)

EXTERNAL_PORTS: tuple[Row, ...] = (
    ("external_port_mode_1", 56, 1, "", "code", 3, 0, 3),
    ("external_port_mode_2", 57, 1, "", "code", 3, 0, 3),
    ("external_port_mode_3", 58, 1, "", "code", 3, 0, 3),
    ("external_port_data_1", 152, 2, "", "", 0, 0, 4095),
    ("external_port_data_2", 154, 2, "", "", 0, 0, 4095),
    ("external_port_data_3", 156, 2, "", "", 0, 0, 4095),
)
"""The three pins of the 540 class; nothing is connected to those of a virtual servo."""

REVERSE = 0b0001
"""Bit of Drive Mode: position, goal and position limits count the other way."""

SLAVE = 0b0010
"""Bit of Drive Mode: the servo follows a master by cable."""

TIME_BASED = 0b0100
"""Bit of Drive Mode: the profile registers are times."""

TORQUE_BY_GOAL = 0b1000
"""Bit of Drive Mode: a goal switches torque on."""


@dataclass(frozen=True)
class Indirect:
    """One block of indirect registers.

    Attributes:
        addresses: Of Indirect Address k; ``data``: of Indirect Data k.
        count: How many.
        below: The block is there in firmware older than this; ``since``: from this one on.
    """

    addresses: int
    data: int
    count: int
    since: int = 0
    below: int = 256


@dataclass(frozen=True)
class Size:
    """What models of one size have in common.

    Attributes:
        firmware: Version of the virtual servos; their Firmware Version register.
        indirect: Blocks of indirect registers.
        since: Register or ability -> first firmware that has it.  Abilities: ``reverse``,
            ``slave``,
            ``time_based``, ``torque_by_goal`` (bits of Drive Mode), ``fast_read``, ``backup``,
            ``guarded_reset`` (ignores a broadcast factory reset of everything), ``clear`` (the
            instruction).
        fastest: Largest Velocity Limit, 0.229 rev/min; ``current_unit``: of the current registers.
        changed: Register name -> fields of ``Register`` that differ from the shared table.
        added: Registers beyond it.
    """

    firmware: int
    indirect: tuple[Indirect, ...]
    since: Mapping[str, int]
    fastest: int = 1023
    current_unit: str = "2.69 mA"
    changed: Changes = field(default_factory=dict)
    added: tuple[Row, ...] = ()


# They came together.
_LATEST = ("torque_by_goal", "startup_configuration", "backup_ready", "backup", "fast_read")

# What the manual leaves open: Model Information has no value in it (0 here), External Port Data no
# initial value and no range (0, 0..4095).  Velocity Limit began larger before firmware 42
# (XM430-W350: 350 for 200).
SIZE_430 = Size(
    firmware=48,
    indirect=(Indirect(168, 224, 28), Indirect(578, 634, 28)),
    since={
        **dict.fromkeys(("drive_mode", "bus_watchdog", "reverse"), 38),
        **dict.fromkeys(("time_based", "guarded_reset", "clear"), 42),
        **dict.fromkeys(_LATEST, 45),
    },
)
SIZE_540 = replace(SIZE_430, since={**SIZE_430.since, "slave": 38}, added=EXTERNAL_PORTS)
SIZE_330 = Size(
    firmware=52,
    # ROBOTIS-GIT/dynamixel_hardware_interface, param/dxl_model/x?330_*.model against
    # x?330_*_fw52.model.
    # That there were 20 of them before firmware 52 is assumed.
    indirect=(Indirect(168, 224, 20, below=52), Indirect(168, 208, 20, since=52)),
    since={
        **dict.fromkeys(("reverse", "time_based"), 0),
        **dict.fromkeys(("guarded_reset", "clear"), 42),
        **dict.fromkeys(_LATEST, 46),
    },
    fastest=2047,
    current_unit="1 mA",
    changed={
        "baud_rate": {"maximum": 6},
        "protocol_type": {"minimum": 2, "maximum": 22},
        "temperature_limit": {"initial": 70},
    },
    added=(("pwm_slope", 62, 1, "", "1.977 mV/ms", 140, 1, 255),),
)
SIZE_330_12V = replace(SIZE_330, added=(("pwm_slope", 62, 1, "", "3.955 mV/ms", 255, 1, 255),))

_CURRENT = ("current_limit", "goal_current", "present_current")
_LOAD: Row = ("present_load", 126, 2, "rs", "0.1 %", None, -1000, 1000)


@dataclass(frozen=True)
class Model:
    """How a model differs from the shared table.

    Attributes:
        number: What Model Number reads.
        size: What it shares with others of its size.
        motor: What it can do.
        supply: Nominal supply, V.
        voltage: Max and Min Voltage Limit at first, and the range of both, 0.1 V.
        velocity: Velocity Limit at first, 0.229 rev/min.
        current: Largest current, counts; None: it measures its load, and no current.
        gains: At first: velocity I and P, position D, I and P.
        initial: Register name -> another initial value.
    """

    number: int
    size: Size
    motor: Motor
    supply: float
    voltage: tuple[int, int, int, int]
    velocity: int
    current: int | None
    gains: tuple[int, int, int, int, int] = (1920, 100, 0, 0, 800)
    initial: Mapping[str, int] = field(default_factory=dict)

    @property
    def modes(self) -> tuple[int, ...]:
        """Values of ``OperatingMode`` that it has."""
        return (1, 3, 4, 16) if self.current is None else (0, 1, 3, 4, 5, 16)

    @property
    def rows(self) -> tuple[Row, ...]:
        """Its registers, before what is changed in them."""
        if self.current is not None:
            return (*SHARED, *self.size.added)
        return (*(row for row in SHARED if row[0] not in _CURRENT), _LOAD, *self.size.added)

    @property
    def changed(self) -> Changes:
        """Register name -> fields of ``Register`` that differ from the shared table."""
        longest, shortest, lowest, highest = self.voltage
        fastest = self.size.fastest
        current = self.current or 0
        unit = self.size.current_unit
        gains = zip(_GAINS, self.gains, strict=True)
        return {
            **self.size.changed,
            "max_voltage_limit": {"initial": longest, "minimum": lowest, "maximum": highest},
            "min_voltage_limit": {"initial": shortest, "minimum": lowest, "maximum": highest},
            "velocity_limit": {"initial": self.velocity, "maximum": fastest},
            "goal_velocity": {"minimum": -fastest, "maximum": fastest},
            "current_limit": {"initial": current, "maximum": current, "unit": unit},
            "goal_current": {"minimum": -current, "maximum": current, "unit": unit},
            "present_current": {"unit": unit},
            **{f"{name}_gain": {"initial": value} for name, value in gains},
            **{name: {"initial": value} for name, value in self.initial.items()},
        }


_GAINS = ("velocity_i", "velocity_p", "position_d", "position_i", "position_p")


# The models of the X series: what differs from the shared table.  A new model is one row here.
#
# Source: ROBOTIS e-manual (ROBOTIS-GIT/emanual), docs/en/dxl/x/<model>.md, one page a model (of
# XL430-W250, XM540-W150 and XC430-W150 the newer docs/kr/dxl/x/<model>.md); all read on 2026-11-22.
# Addresses and sizes agree with a second source: ROBOTIS-GIT/dynamixel_hardware_interface
# param/dxl_model/<model>.model, db2b9038.
# Values are those of the firmware that ``Size`` names: before firmware 42 Velocity Limit was larger
# (_includes/en/dxl/control_table_vellimit.md), and pages of that time have an Acceleration Limit,
# register 40.

_METAL = (160, 95, 95, 160)
_SIX_VOLTS = (160, 60, 60, 160)
_FIVE = (70, 35, 31, 70)
_TWELVE = (140, 55, 55, 140)

MODELS: Mapping[str, Model] = {
    "XL430-W250": Model(
        1060,
        SIZE_430,
        Motor(1.4, 1.3, 57.0, 11.1),
        12.0,
        (140, 60, 60, 140),
        265,
        None,
        (1000, 100, 4000, 0, 640),
        {"temperature_limit": 72},
    ),
    "XC430-W150": Model(
        1070,
        SIZE_430,
        Motor(1.6, 1.4, 106.0, 12.0),
        12.0,
        _SIX_VOLTS,
        460,
        None,
        (1920, 100, 0, 0, 460),
        {"moving_threshold": 20},
    ),
    "XC430-W240": Model(
        1080,
        SIZE_430,
        Motor(1.9, 1.4, 70.0, 12.0),
        12.0,
        _SIX_VOLTS,
        306,
        None,
        (1920, 100, 0, 0, 700),
    ),
    "XM430-W210": Model(1030, SIZE_430, Motor(3.0, 2.3, 77.0, 12.0), 12.0, _METAL, 330, 1193),
    "XM430-W350": Model(1020, SIZE_430, Motor(4.1, 2.3, 46.0, 12.0), 12.0, _METAL, 200, 1193),
    "XH540-W150": Model(1110, SIZE_540, Motor(7.1, 4.9, 70.0, 12.0), 12.0, _METAL, 300, 2047),
    "XM540-W150": Model(1130, SIZE_540, Motor(7.3, 4.4, 53.0, 12.0), 12.0, _METAL, 230, 2047),
    "XM540-W270": Model(1120, SIZE_540, Motor(10.6, 4.4, 30.0, 12.0), 12.0, _METAL, 128, 2047),
    # Position I Gain 400 is on the page of the XL330-M077 alone.  It may be a misprint.
    "XL330-M077": Model(
        1190,
        SIZE_330,
        Motor(0.215, 1.47, 383.0, 5.0),
        5.0,
        _FIVE,
        1620,
        1750,
        (400, 40, 0, 400, 400),
        {"shutdown": 53},
    ),
    "XL330-M288": Model(
        1200,
        SIZE_330,
        Motor(0.52, 1.47, 103.0, 5.0),
        5.0,
        _FIVE,
        445,
        1750,
        (1600, 180, 0, 0, 400),
        {"shutdown": 53},
    ),
    "XC330-M181": Model(
        1230,
        SIZE_330,
        Motor(0.60, 1.80, 129.0, 5.0, sensed_at_supply=True),
        5.0,
        _FIVE,
        545,
        2352,
        (1400, 100, 500, 0, 1200),
    ),
    "XC330-M288": Model(
        1240,
        SIZE_330,
        Motor(0.93, 1.80, 81.0, 5.0, sensed_at_supply=True),
        5.0,
        _FIVE,
        350,
        2352,
        (1600, 50, 500, 0, 1100),
    ),
    "XC330-T181": Model(
        1210,
        SIZE_330_12V,
        Motor(0.76, 0.80, 104.0, 11.1, sensed_at_supply=True),
        12.0,
        _TWELVE,
        510,
        910,
        (1200, 40, 0, 0, 900),
    ),
    "XC330-T288": Model(
        1220,
        SIZE_330_12V,
        Motor(0.92, 0.80, 65.0, 11.1, sensed_at_supply=True),
        12.0,
        _TWELVE,
        320,
        910,
        (1200, 40, 0, 0, 900),
    ),
}


def _register(row: Row) -> Register:
    name, address, size, flags, unit, initial, minimum, maximum = row
    return Register(
        name,
        address,
        size,
        writable="r" not in flags,
        signed="s" in flags,
        unit=unit,
        eeprom=address < EEPROM_END,
        initial=initial,
        minimum=minimum,
        maximum=maximum,
    )


def _indirect(blocks: list[Indirect]) -> Iterator[Register]:
    """Indirect Address k initially points at Indirect Data k (itself); it may point at RAM only."""
    last = max(block.data + block.count for block in blocks) - 1
    pairs = [(b.addresses + 2 * k, b.data + k) for b in blocks for k in range(b.count)]
    for number, (address, data) in enumerate(pairs, 1):
        yield _register((f"indirect_address_{number}", address, 2, "", "address", data, 64, last))
        yield _register((f"indirect_data_{number}", data, 1, "", "", 0, 0, 255))


_DRIVE_BITS = {
    "reverse": REVERSE,
    "slave": SLAVE,
    "time_based": TIME_BASED,
    "torque_by_goal": TORQUE_BY_GOAL,
}
_ABILITIES = ("fast_read", "backup", "guarded_reset", "clear")


def build_table(model: str, row: Model, firmware: int | None = None) -> ControlTable:
    """Return the control table of a model.

    Args:
        model: Name.
        row: What is particular to it.
        firmware: Version; None: the version of ``Size.firmware``.
    """
    size = row.size
    firmware = size.firmware if firmware is None else firmware
    missing = {name for name, since in size.since.items() if firmware < since}
    registers = {r.name: r for r in map(_register, row.rows) if r.name not in missing}
    bits = sum(
        bit for name, bit in _DRIVE_BITS.items() if name in size.since and name not in missing
    )
    own: dict[str, Mapping[str, object]] = {
        "model_number": {"initial": row.number},
        "firmware_version": {"initial": firmware},
        "drive_mode": {"maximum": bits},
    }
    for name, change in (*row.changed.items(), *own.items()):
        if name in registers:
            registers[name] = replace(registers[name], **change)  # type: ignore[arg-type]
    blocks = [b for b in size.indirect if b.since <= firmware < b.below]
    every = sorted((*registers.values(), *_indirect(blocks)), key=lambda register: register.address)
    return ControlTable(
        model,
        row.number,
        firmware,
        MappingProxyType({register.name: register for register in every}),
        tuple(OperatingMode(mode) for mode in row.modes),
        row.supply,
        row.motor,
        frozenset(ability for ability in _ABILITIES if ability not in missing),
        family="dynamixel_x",
        baud_codes=BAUD_RATES,
        position_mode_homing=POSITION_MODE_HOMING,
    )


X_TABLES: Mapping[str, ControlTable] = MappingProxyType(
    {model: build_table(model, row) for model, row in MODELS.items()}
)
"""Model name -> its control table with the firmware this project assumes."""

X_SERIES = X_TABLES["XM430-W350"]
"""For registers that have the same address in every model: torque, errors, measurements."""
