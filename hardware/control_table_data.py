"""The numbers behind ``control_table``: rows only.

Source: ROBOTIS e-manual, control table pages of XL430-W250, XM430-W350 and XL330-M288.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
    ("drive_mode", 10, 1, "", "bits", 0, 0, 13),
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
    ("velocity_limit", 44, 4, "", "0.229 rev/min", 350, 0, 2047),
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

_INDIRECT_430 = ((168, 224, 28), (578, 634, 28))
_INDIRECT_330 = ((168, 208, 20),)
# Values of Operating Mode: 0 current, 1 velocity, 3 position, 4 extended, 5 current-based position, 16 PWM.
_CURRENT_MODES = (0, 1, 3, 4, 5, 16)


@dataclass(frozen=True)
class Model:
    """How a model differs from the shared table.

    Attributes:
        number: What Model Number reads.
        modes: Operating modes it has; ``baud_codes``: values its Baud Rate register takes.
        supply: Nominal supply, V.
        indirect: Blocks of (first address register, first data register, how many).
        changed: Register name -> fields of ``Register`` that differ; ``added``, ``removed``: whole registers.
    """

    number: int
    modes: tuple[int, ...]
    baud_codes: tuple[int, ...]
    supply: float
    indirect: tuple[tuple[int, int, int], ...]
    changed: Mapping[str, Mapping[str, object]]
    added: tuple[Row, ...] = ()
    removed: tuple[str, ...] = ()


MODELS: Mapping[str, Model] = {
    "XL430-W250": Model(
        number=1060,
        modes=(1, 3, 4, 16),
        baud_codes=tuple(range(8)),
        supply=12.0,
        indirect=_INDIRECT_430,
        changed={
            "temperature_limit": {"initial": 72},
            "max_voltage_limit": {"initial": 140, "minimum": 60, "maximum": 140},
            "min_voltage_limit": {"initial": 60, "minimum": 60, "maximum": 140},
            "velocity_limit": {"initial": 265, "maximum": 1023},
            "velocity_i_gain": {"initial": 1000},
            "position_d_gain": {"initial": 4000},
            "position_p_gain": {"initial": 640},
            "goal_velocity": {"minimum": -1023, "maximum": 1023},
        },
        added=(("present_load", 126, 2, "rs", "0.1 %", None, -1000, 1000),),
        removed=("current_limit", "goal_current", "present_current"),
    ),
    "XM430-W350": Model(
        number=1020,
        modes=_CURRENT_MODES,
        baud_codes=tuple(range(8)),
        supply=12.0,
        indirect=_INDIRECT_430,
        changed={
            "max_voltage_limit": {"minimum": 95},
            "min_voltage_limit": {"minimum": 95},
            "velocity_limit": {"maximum": 1023},
            "goal_velocity": {"minimum": -1023, "maximum": 1023},
        },
        added=(("acceleration_limit", 40, 4, "", "214.577 rev/min^2", 32767, 0, 32767),),
    ),
    "XL330-M288": Model(
        number=1200,
        modes=_CURRENT_MODES,
        baud_codes=tuple(range(7)),
        supply=5.0,
        indirect=_INDIRECT_330,
        changed={
            "protocol_type": {"maximum": 22},
            "temperature_limit": {"initial": 70},
            "max_voltage_limit": {"initial": 70, "maximum": 70},
            "min_voltage_limit": {"initial": 35, "maximum": 70},
            "current_limit": {"initial": 1750, "maximum": 1750, "unit": "1 mA"},
            "goal_current": {"minimum": -1750, "maximum": 1750, "unit": "1 mA"},
            "present_current": {"unit": "1 mA"},
            "velocity_limit": {"initial": 445},
            "shutdown": {"initial": 53},
            "velocity_i_gain": {"initial": 1600},
            "velocity_p_gain": {"initial": 180},
            "position_p_gain": {"initial": 400},
            "baud_rate": {"maximum": 6},
        },
        added=(("pwm_slope", 62, 1, "", "1.977 mV/ms", 140, 1, 255),),
    ),
}
