"""Control table of the Feetech STS3215, as data.

Sources:

* [MT] Feetech, ST3215 memory table V3.7 ("ST3215 memory register map-EN.xls", Waveshare).
* [LR] huggingface/lerobot 7427f31, src/lerobot/motors/feetech/tables.py: addresses, sizes, sign
  bits.
* [SDK] ftservo/FTServo_Python a203373, scservo_sdk/sms_sts.py: addresses, sign bit 15 of the
  position.

Register names are the names that the driver uses for every family.  The comment gives the manual's
name where it differs.  Numbers of two bytes are little-endian.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from robot_ik.hardware.registers import ControlTable, Motor, OperatingMode, Register

BAUD_RATES: Mapping[int, int] = MappingProxyType(
    {
        0: 1_000_000,
        1: 500_000,
        2: 250_000,
        3: 128_000,
        4: 115_200,
        5: 76_800,
        6: 57_600,
        7: 38_400,
    }
)
"""Baud Rate register -> bits per second [MT, SDK].

[LR] differs from code 5 on: 57600, 38400, 19200.
"""

EEPROM_END = 40
"""Address of the first register that is lost without power [MT]."""

READ_ONLY = False
WRITABLE = True

BIT_10 = 10
BIT_11 = 11
BIT_15 = 15

# name, address, size, writable, sign bit, unit, initial value, minimum, maximum
_ROWS = (
    ("firmware_major", 0, 1, READ_ONLY, None, "", 3, 0, 255),
    ("firmware_version", 1, 1, READ_ONLY, None, "", 10, 0, 255),  # minor version
    ("endianness", 2, 1, READ_ONLY, None, "", 0, 0, 1),
    # servo major and minor version: 9, 3
    ("model_number", 3, 2, READ_ONLY, None, "", 777, 0, 65535),
    ("id", 5, 1, WRITABLE, None, "", 1, 0, 253),
    ("baud_rate", 6, 1, WRITABLE, None, "code", 0, 0, 7),
    # [LR] says 250 from the factory, [MT] 0
    ("return_delay_time", 7, 1, WRITABLE, None, "2 us", 250, 0, 254),
    ("status_return_level", 8, 1, WRITABLE, None, "", 1, 0, 1),  # response status level
    ("min_position_limit", 9, 2, WRITABLE, None, "tick", 0, 0, 4094),
    ("max_position_limit", 11, 2, WRITABLE, None, "tick", 4095, 0, 4095),
    ("temperature_limit", 13, 1, WRITABLE, None, "1 C", 70, 0, 100),
    ("max_voltage_limit", 14, 1, WRITABLE, None, "0.1 V", 80, 0, 254),
    ("min_voltage_limit", 15, 1, WRITABLE, None, "0.1 V", 40, 0, 254),
    ("max_torque_limit", 16, 2, WRITABLE, None, "0.1 %", 1000, 0, 1000),
    ("phase", 18, 1, WRITABLE, None, "bits", 12, 0, 254),
    ("unloading_condition", 19, 1, WRITABLE, None, "bits", 44, 0, 254),
    ("led_alarm_condition", 20, 1, WRITABLE, None, "bits", 47, 0, 254),
    ("position_p_gain", 21, 1, WRITABLE, None, "", 32, 0, 254),
    ("position_d_gain", 22, 1, WRITABLE, None, "", 32, 0, 254),
    ("position_i_gain", 23, 1, WRITABLE, None, "", 0, 0, 254),
    ("minimum_startup_force", 24, 2, WRITABLE, None, "0.1 %", 16, 0, 1000),
    ("cw_dead_zone", 26, 1, WRITABLE, None, "tick", 1, 0, 32),
    ("ccw_dead_zone", 27, 1, WRITABLE, None, "tick", 1, 0, 32),
    ("protection_current", 28, 2, WRITABLE, None, "6.5 mA", 500, 0, 511),
    ("angular_resolution", 30, 1, WRITABLE, None, "", 1, 1, 100),
    ("homing_offset", 31, 2, WRITABLE, BIT_11, "tick", 0, -2047, 2047),  # position correction
    ("operating_mode", 33, 1, WRITABLE, None, "code", 0, 0, 3),
    ("protective_torque", 34, 1, WRITABLE, None, "1 %", 20, 0, 254),
    ("protection_time", 35, 1, WRITABLE, None, "10 ms", 200, 0, 254),
    ("overload_torque", 36, 1, WRITABLE, None, "1 %", 80, 0, 254),
    ("velocity_p_gain", 37, 1, WRITABLE, None, "", 10, 0, 254),
    ("overcurrent_time", 38, 1, WRITABLE, None, "10 ms", 200, 0, 254),
    ("velocity_i_gain", 39, 1, WRITABLE, None, "", 10, 0, 254),
    ("torque_enable", 40, 1, WRITABLE, None, "", 0, 0, 128),
    ("acceleration", 41, 1, WRITABLE, None, "100 tick/s^2", 0, 0, 254),
    ("goal_position", 42, 2, WRITABLE, BIT_15, "tick", 0, -32767, 32767),
    ("goal_time", 44, 2, WRITABLE, None, "", 0, 0, 1000),
    ("goal_velocity", 46, 2, WRITABLE, BIT_15, "tick/s", 0, -32767, 32767),
    ("torque_limit", 48, 2, WRITABLE, None, "0.1 %", 1000, 0, 1000),
    ("lock", 55, 1, WRITABLE, None, "", 0, 0, 1),
    ("present_position", 56, 2, READ_ONLY, BIT_15, "tick", None, -32767, 32767),
    ("present_velocity", 58, 2, READ_ONLY, BIT_15, "tick/s", None, -32767, 32767),
    ("present_load", 60, 2, READ_ONLY, BIT_10, "0.1 %", None, -1000, 1000),
    ("present_input_voltage", 62, 1, READ_ONLY, None, "0.1 V", None, 0, 255),
    ("present_temperature", 63, 1, READ_ONLY, None, "1 C", None, 0, 255),
    ("registered_instruction", 64, 1, READ_ONLY, None, "", 0, 0, 1),  # asynchronous write flag
    ("hardware_error_status", 65, 1, READ_ONLY, None, "bits", 0, 0, 255),  # servo status
    ("moving", 66, 1, READ_ONLY, None, "", 0, 0, 1),
    ("present_current", 69, 2, READ_ONLY, BIT_15, "6.5 mA", None, -500, 500),
    ("goal_position_2", 71, 2, READ_ONLY, BIT_15, "tick", None, -32767, 32767),
    ("moving_threshold", 80, 1, READ_ONLY, None, "tick/s", 10, 0, 255),
    ("velocity_unit", 82, 1, READ_ONLY, None, "", 1, 0, 255),
    ("velocity_limit", 84, 1, READ_ONLY, None, "50 tick/s", 68, 0, 255),
    ("acceleration_limit", 85, 1, WRITABLE, None, "100 tick/s^2", 254, 0, 254),  # [LR] writes it
    ("acceleration_multiplier", 86, 1, READ_ONLY, None, "", 2, 0, 255),
)


@dataclass(frozen=True)
class StsModel:
    """One servo model.

    Attributes:
        number: What Model Number reads.
        supply: Nominal supply, V. Variants for 12 V have the same number: the servo's own voltage
            limits count.
        motor: Motor with its gear.
        voltage_limit: Max Voltage Limit from the factory, 0.1 V.
    """

    number: int
    supply: float
    motor: Motor
    voltage_limit: int = 80


STS_MODELS: Mapping[str, StsModel] = MappingProxyType(
    {
        # Stall torque 19.5 kg cm at 7.4 V; 46 rev/min measured (TheRobotStudio/SO-ARM100#134).
        "STS3215": StsModel(777, 7.4, Motor(1.91, 2.5, 46.0, 7.4)),
    }
)
"""Model name -> model.  All of them have the registers above."""


def build_table(model: str, row: StsModel) -> ControlTable:
    """Return the control table of a model."""
    initial_values = {"model_number": row.number, "max_voltage_limit": row.voltage_limit}
    registers = {}
    for name, address, size, writable, sign_bit, unit, initial, minimum, maximum in _ROWS:
        registers[name] = Register(
            name,
            address,
            size,
            writable=writable,
            unit=unit,
            eeprom=address < EEPROM_END,
            initial=initial_values.get(name, initial),
            minimum=minimum,
            maximum=maximum,
            sign_bit=sign_bit,
        )
    return ControlTable(
        model=model,
        number=row.number,
        firmware=10,
        registers=MappingProxyType(registers),
        modes=(OperatingMode.POSITION,),
        supply=row.supply,
        motor=row.motor,
        abilities=frozenset(),
        family="feetech_sts",
        baud_codes=BAUD_RATES,
    )


STS_TABLES: Mapping[str, ControlTable] = MappingProxyType(
    {model: build_table(model, row) for model, row in STS_MODELS.items()}
)

STS3215 = STS_TABLES["STS3215"]
