"""The X series: its registers, what differs by model, and its motors; rows only.

Source: ROBOTIS e-manual (ROBOTIS-GIT/emanual), control table pages docs/en/dxl/x/*.md and the texts they
include, _includes/en/dxl/control_table_*.md.  Below them: models, motors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

# ------------------------------------------------------------------------------------------
# What the motors of the X series can do: the manual's specification tables, as data.
#
# Source: ROBOTIS e-manual, _data/dxl_x_info.yml (stall torque, stall current and no load speed at the
# recommended voltage), read on 2026-11-22.


@dataclass(frozen=True)
class Motor:
    """A motor with its gear, seen at the output shaft.

    Attributes:
        stall_torque: N m, and ``stall_current``, A, at ``volts``.
        no_load_rpm: rev/min at ``volts``.
        volts: At which these were measured, V.
        sensed_at_supply: Present Current is what the supply gives, not what flows through the motor.
    """

    stall_torque: float
    stall_current: float
    no_load_rpm: float
    volts: float
    sensed_at_supply: bool = False

    @property
    def torque_per_ampere(self) -> float:
        """N m at the shaft for an ampere through the motor; gear friction is in it."""
        return self.stall_torque / self.stall_current

    def stall_at(self, volts: float) -> float:
        """Stall torque, N m, at another supply."""
        return self.stall_torque * volts / self.volts

    @property
    def no_load_speed(self) -> float:
        """rad/s at ``volts``."""
        return self.no_load_rpm * (2.0 * math.pi / 60.0)


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

REVERSE, SLAVE, TIME_BASED, TORQUE_BY_GOAL = 0b0001, 0b0010, 0b0100, 0b1000
"""Bits of Drive Mode."""


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
class ServoFamily:
    """What models of one size have in common.

    Attributes:
        firmware: Version of the virtual servos; their Firmware Version register.
        indirect: Blocks of indirect registers.
        since: Register or ability -> first firmware that has it.  Abilities: ``reverse``, ``slave``,
            ``time_based``, ``torque_by_goal`` (bits of Drive Mode), ``fast_read``, ``backup``,
            ``guarded_reset`` (ignores a broadcast factory reset of everything), ``clear`` (the instruction).
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

# What the manual leaves open: Model Information has no value in it (0 here), External Port Data no initial
# value and no range (0, 0..4095).  Velocity Limit began larger before firmware 42 (XM430-W350: 350 for 200).
FAMILY_430 = ServoFamily(
    firmware=48,
    indirect=(Indirect(168, 224, 28), Indirect(578, 634, 28)),
    since={
        **dict.fromkeys(("drive_mode", "bus_watchdog", "reverse"), 38),
        **dict.fromkeys(("time_based", "guarded_reset", "clear"), 42),
        **dict.fromkeys(_LATEST, 45),
    },
)
FAMILY_540 = replace(FAMILY_430, since={**FAMILY_430.since, "slave": 38}, added=EXTERNAL_PORTS)
FAMILY_330 = ServoFamily(
    firmware=52,
    # ROBOTIS-GIT/dynamixel_hardware_interface, param/dxl_model/x?330_*.model against x?330_*_fw52.model.
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
FAMILY_330_12V = replace(FAMILY_330, added=(("pwm_slope", 62, 1, "", "3.955 mV/ms", 255, 1, 255),))

_CURRENT = ("current_limit", "goal_current", "present_current")
_LOAD: Row = ("present_load", 126, 2, "rs", "0.1 %", None, -1000, 1000)


@dataclass(frozen=True)
class Model:
    """How a model differs from the shared table.

    Attributes:
        number: What Model Number reads.
        family: What it shares with others of its size.
        motor: What it can do.
        supply: Nominal supply, V.
        voltage: Max and Min Voltage Limit at first, and the range of both, 0.1 V.
        velocity: Velocity Limit at first, 0.229 rev/min.
        current: Largest current, counts; None: it measures its load, and no current.
        gains: At first: velocity I and P, position D, I and P.
        initial: Register name -> another initial value.
    """

    number: int
    family: ServoFamily
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
            return (*SHARED, *self.family.added)
        return (*(row for row in SHARED if row[0] not in _CURRENT), _LOAD, *self.family.added)

    @property
    def changed(self) -> Changes:
        """Register name -> fields of ``Register`` that differ from the shared table."""
        longest, shortest, lowest, highest = self.voltage
        fastest, current, unit = self.family.fastest, self.current or 0, self.family.current_unit
        gains = zip(_GAINS, self.gains, strict=True)
        return {
            **self.family.changed,
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


# ------------------------------------------------------------------------------------------
# The models of the X series: what each has otherwise than the shared table.  A new model is one row here.
#
# Source: ROBOTIS e-manual (ROBOTIS-GIT/emanual), docs/en/dxl/x/<model>.md, one page a model (of XL430-W250,
# XM540-W150 and XC430-W150 the newer docs/kr/dxl/x/<model>.md); all read on 2026-11-22.  Addresses and sizes
# agree with a second source: ROBOTIS-GIT/dynamixel_hardware_interface param/dxl_model/<model>.model,
# db2b9038.
# Values are those of the firmware that ``ServoFamily`` names: before firmware 42 Velocity Limit was larger
# (_includes/en/dxl/control_table_vellimit.md), and pages of that time have an Acceleration Limit,
# register 40.

_METAL, _SIX_VOLTS = (160, 95, 95, 160), (160, 60, 60, 160)
_FIVE, _TWELVE = (70, 35, 31, 70), (140, 55, 55, 140)

MODELS: Mapping[str, Model] = {
    "XL430-W250": Model(
        1060, FAMILY_430, Motor(1.4, 1.3, 57.0, 11.1), 12.0, (140, 60, 60, 140), 265, None,
        (1000, 100, 4000, 0, 640), {"temperature_limit": 72},
    ),
    "XC430-W150": Model(
        1070, FAMILY_430, Motor(1.6, 1.4, 106.0, 12.0), 12.0, _SIX_VOLTS, 460, None,
        (1920, 100, 0, 0, 460), {"moving_threshold": 20},
    ),
    "XC430-W240": Model(
        1080, FAMILY_430, Motor(1.9, 1.4, 70.0, 12.0), 12.0, _SIX_VOLTS, 306, None, (1920, 100, 0, 0, 700)
    ),
    "XM430-W210": Model(1030, FAMILY_430, Motor(3.0, 2.3, 77.0, 12.0), 12.0, _METAL, 330, 1193),
    "XM430-W350": Model(1020, FAMILY_430, Motor(4.1, 2.3, 46.0, 12.0), 12.0, _METAL, 200, 1193),
    "XH540-W150": Model(1110, FAMILY_540, Motor(7.1, 4.9, 70.0, 12.0), 12.0, _METAL, 300, 2047),
    "XM540-W150": Model(1130, FAMILY_540, Motor(7.3, 4.4, 53.0, 12.0), 12.0, _METAL, 230, 2047),
    "XM540-W270": Model(1120, FAMILY_540, Motor(10.6, 4.4, 30.0, 12.0), 12.0, _METAL, 128, 2047),
    "XL330-M077": Model(  # Position I Gain 400 is what its page says, alone of all; it may be a misprint
        1190, FAMILY_330, Motor(0.215, 1.47, 383.0, 5.0), 5.0, _FIVE, 1620, 1750,
        (400, 40, 0, 400, 400), {"shutdown": 53},
    ),
    "XL330-M288": Model(
        1200, FAMILY_330, Motor(0.52, 1.47, 103.0, 5.0), 5.0, _FIVE, 445, 1750,
        (1600, 180, 0, 0, 400), {"shutdown": 53},
    ),
    "XC330-M181": Model(
        1230, FAMILY_330, Motor(0.60, 1.80, 129.0, 5.0, sensed_at_supply=True), 5.0, _FIVE, 545, 2352,
        (1400, 100, 500, 0, 1200),
    ),
    "XC330-M288": Model(
        1240, FAMILY_330, Motor(0.93, 1.80, 81.0, 5.0, sensed_at_supply=True), 5.0, _FIVE, 350, 2352,
        (1600, 50, 500, 0, 1100),
    ),
    "XC330-T181": Model(
        1210, FAMILY_330_12V, Motor(0.76, 0.80, 104.0, 11.1, sensed_at_supply=True), 12.0, _TWELVE, 510, 910,
        (1200, 40, 0, 0, 900),
    ),
    "XC330-T288": Model(
        1220, FAMILY_330_12V, Motor(0.92, 0.80, 65.0, 11.1, sensed_at_supply=True), 12.0, _TWELVE, 320, 910,
        (1200, 40, 0, 0, 900),
    ),
}  # fmt: skip
