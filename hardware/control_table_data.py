"""The registers of the X series and the shape of what differs by model: rows only.

Source: ROBOTIS e-manual (ROBOTIS-GIT/emanual), control table pages docs/en/dxl/x/*.md and the texts they
include, _includes/en/dxl/control_table_*.md.  ``control_table_models`` holds the models.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from robot_ik.hardware.control_table_motors import Motor

# name, address, size, access (s = signed, r = read only), unit, initial, minimum, maximum.
# None as initial: depends on the servo's state.  Addresses below 64 are EEPROM.
Row = tuple[str, int, int, str, str, int | None, int, int]
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
class Family:
    """What models of one size have in common.

    Attributes:
        firmware: Version of the virtual servos; their Firmware Version register.
        indirect: Blocks of indirect registers.
        since: Register or ability -> first firmware that has it.  Abilities: ``reverse``, ``slave``,
            ``time_based``, ``torque_by_goal`` (bits of Drive Mode), ``fast_read``, ``backup``,
            ``guarded_reset`` (ignores a broadcast factory reset of everything).
        baud_codes: Values its Baud Rate register takes.
        notes: What the manual leaves open, and what is assumed.
    """

    firmware: int
    indirect: tuple[Indirect, ...]
    since: Mapping[str, int]
    baud_codes: tuple[int, ...]
    notes: tuple[str, ...] = ()


FAMILY_430 = Family(
    firmware=48,
    indirect=(Indirect(168, 224, 28), Indirect(578, 634, 28)),
    since={
        "drive_mode": 38,
        "bus_watchdog": 38,
        "reverse": 38,
        "time_based": 42,
        "guarded_reset": 42,
        "torque_by_goal": 45,
        "startup_configuration": 45,
        "backup_ready": 45,
        "backup": 45,
        "fast_read": 45,
    },
    baud_codes=tuple(range(8)),
    notes=(
        "Velocity Limit had a larger initial value before firmware 42 (XM430-W350: 350 for 200).",
        "Model Information has no value in the manual: 0.",
    ),
)
FAMILY_540 = Family(
    FAMILY_430.firmware,
    FAMILY_430.indirect,
    {**FAMILY_430.since, "slave": 38},
    FAMILY_430.baud_codes,
    (*FAMILY_430.notes, "External Port Data: the manual gives no initial value and no range: 0, 0..4095."),
)
FAMILY_330 = Family(
    firmware=52,
    # ROBOTIS-GIT/dynamixel_hardware_interface, param/dxl_model/x?330_*.model against x?330_*_fw52.model.
    indirect=(Indirect(168, 224, 20, below=52), Indirect(168, 208, 20, since=52)),
    since={
        "reverse": 0,
        "time_based": 0,
        "guarded_reset": 42,
        "torque_by_goal": 46,
        "startup_configuration": 46,
        "backup_ready": 46,
        "backup": 46,
        "fast_read": 46,
    },
    baud_codes=tuple(range(7)),
    notes=(
        "Indirect Data before firmware 52: that there were 20 of them is assumed.",
        "Model Information has no value in the manual: 0.",
    ),
)


@dataclass(frozen=True)
class Model:
    """How a model differs from the shared table.

    Attributes:
        number: What Model Number reads.
        family: What it shares with others of its size.
        modes: Operating modes it has.
        supply: Nominal supply, V.
        motor: What it can do.
        changed: Register name -> fields of ``Register`` that differ; ``added``, ``removed``: whole registers.
        notes: What the manual leaves open, and what is assumed.
    """

    number: int
    family: Family
    modes: tuple[int, ...]
    supply: float
    motor: Motor
    changed: Mapping[str, Mapping[str, object]]
    added: tuple[Row, ...] = ()
    removed: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())
