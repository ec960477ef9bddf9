"""The models of the X series: what each has otherwise than the shared table.  A new model is one row here.

Source: ROBOTIS e-manual (ROBOTIS-GIT/emanual), docs/en/dxl/x/<model>.md, one page a model (of XL430-W250,
XM540-W150 and XC430-W150 the newer docs/kr/dxl/x/<model>.md); all read on 2026-11-22.  Addresses and sizes
agree with a second source: ROBOTIS-GIT/dynamixel_hardware_interface param/dxl_model/<model>.model, db2b9038.
Values are those of the firmware that ``Family`` names: before firmware 42 Velocity Limit was larger
(_includes/en/dxl/control_table_vellimit.md), and pages of that time have an Acceleration Limit, register 40.
"""

from __future__ import annotations

from collections.abc import Mapping

from robot_ik.hardware import control_table_motors as motors
from robot_ik.hardware.control_table_data import (
    EXTERNAL_PORTS,
    FAMILY_330,
    FAMILY_430,
    FAMILY_540,
    Family,
    Model,
    Row,
)
from robot_ik.hardware.control_table_motors import Motor

# Values of Operating Mode: 0 current, 1 velocity, 3 position, 4 extended, 5 current-based position, 16 PWM.
_CURRENT_MODES = (0, 1, 3, 4, 5, 16)

Changes = dict[str, Mapping[str, object]]


def _voltage(initial: tuple[int, int], lowest: int, highest: int) -> Changes:
    """Max and Min Voltage Limit, 0.1 V."""
    span = {"minimum": lowest, "maximum": highest}
    return {
        "max_voltage_limit": {"initial": initial[0], **span},
        "min_voltage_limit": {"initial": initial[1], **span},
    }


def _velocity(initial: int, highest: int) -> Changes:
    """Velocity Limit and Goal Velocity, 0.229 rev/min."""
    return {
        "velocity_limit": {"initial": initial, "maximum": highest},
        "goal_velocity": {"minimum": -highest, "maximum": highest},
    }


def _current(highest: int, unit: str) -> Changes:
    """Current Limit (which starts at its maximum), Goal Current and Present Current."""
    return {
        "current_limit": {"initial": highest, "maximum": highest, "unit": unit},
        "goal_current": {"minimum": -highest, "maximum": highest, "unit": unit},
        "present_current": {"unit": unit},
    }


def _gains(velocity_i: int, velocity_p: int, position_d: int, position_i: int, position_p: int) -> Changes:
    return {
        "velocity_i_gain": {"initial": velocity_i},
        "velocity_p_gain": {"initial": velocity_p},
        "position_d_gain": {"initial": position_d},
        "position_i_gain": {"initial": position_i},
        "position_p_gain": {"initial": position_p},
    }


def _metal(
    number: int,
    family: Family,
    motor: Motor,
    current: int,
    velocity: int,
    added: tuple[Row, ...] = (),
) -> Model:
    """XM430, XM540 and XH540."""
    changed = {
        **_voltage((160, 95), 95, 160),
        **_velocity(velocity, 1023),
        **_current(current, "2.69 mA"),
        **_gains(1920, 100, 0, 0, 800),
    }
    return Model(number, family, _CURRENT_MODES, 12.0, motor, changed, added)


def _without_current(
    number: int, motor: Motor, volts: Changes, velocity: int, gains: Changes, own: Changes | None = None
) -> Model:
    """XL430 and XC430: they measure their load, and no current."""
    changed = {**volts, **_velocity(velocity, 1023), **gains, **(own or {})}
    load: Row = ("present_load", 126, 2, "rs", "0.1 %", None, -1000, 1000)
    removed = ("current_limit", "goal_current", "present_current")
    return Model(number, FAMILY_430, (1, 3, 4, 16), 12.0, motor, changed, (load,), removed)


def _small(
    number: int,
    motor: Motor,
    supply: float,
    volts: Changes,
    current: int,
    velocity: int,
    slope: tuple[int, str],
    shutdown: int,
    gains: Changes,
    notes: tuple[str, ...] = (),
) -> Model:
    """XL330 and XC330."""
    changed = {
        "baud_rate": {"maximum": 6},
        "protocol_type": {"minimum": 2, "maximum": 22},
        "temperature_limit": {"initial": 70},
        "shutdown": {"initial": shutdown},
        **volts,
        **_velocity(velocity, 2047),
        **_current(current, "1 mA"),
        **gains,
    }
    added: tuple[Row, ...] = (("pwm_slope", 62, 1, "", slope[1], slope[0], 1, 255),)
    return Model(number, FAMILY_330, _CURRENT_MODES, supply, motor, changed, added, notes=notes)


_FIVE_VOLTS = _voltage((70, 35), 31, 70)
_TWELVE_VOLTS = _voltage((140, 55), 55, 140)
_SLOPE_5, _SLOPE_12 = (140, "1.977 mV/ms"), (255, "3.955 mV/ms")

MODELS: Mapping[str, Model] = {
    "XL430-W250": _without_current(
        1060,
        motors.XL430_W250,
        _voltage((140, 60), 60, 140),
        265,
        _gains(1000, 100, 4000, 0, 640),
        {"temperature_limit": {"initial": 72}},
    ),
    "XC430-W150": _without_current(
        1070,
        motors.XC430_W150,
        _voltage((160, 60), 60, 160),
        460,
        _gains(1920, 100, 0, 0, 460),
        {"moving_threshold": {"initial": 20}},
    ),
    "XC430-W240": _without_current(
        1080, motors.XC430_W240, _voltage((160, 60), 60, 160), 306, _gains(1920, 100, 0, 0, 700)
    ),
    "XM430-W210": _metal(1030, FAMILY_430, motors.XM430_W210, 1193, 330),
    "XM430-W350": _metal(1020, FAMILY_430, motors.XM430_W350, 1193, 200),
    "XH540-W150": _metal(1110, FAMILY_540, motors.XH540_W150, 2047, 300, EXTERNAL_PORTS),
    "XM540-W150": _metal(1130, FAMILY_540, motors.XM540_W150, 2047, 230, EXTERNAL_PORTS),
    "XM540-W270": _metal(1120, FAMILY_540, motors.XM540_W270, 2047, 128, EXTERNAL_PORTS),
    "XL330-M077": _small(
        1190,
        motors.XL330_M077,
        5.0,
        _FIVE_VOLTS,
        1750,
        1620,
        _SLOPE_5,
        53,
        _gains(400, 40, 0, 400, 400),
        notes=("Position I Gain 400 is what its page says, alone of all models; it may be a slip.",),
    ),
    "XL330-M288": _small(
        1200, motors.XL330_M288, 5.0, _FIVE_VOLTS, 1750, 445, _SLOPE_5, 53, _gains(1600, 180, 0, 0, 400)
    ),
    "XC330-M181": _small(
        1230, motors.XC330_M181, 5.0, _FIVE_VOLTS, 2352, 545, _SLOPE_5, 52, _gains(1400, 100, 500, 0, 1200)
    ),
    "XC330-M288": _small(
        1240, motors.XC330_M288, 5.0, _FIVE_VOLTS, 2352, 350, _SLOPE_5, 52, _gains(1600, 50, 500, 0, 1100)
    ),
    "XC330-T181": _small(
        1210, motors.XC330_T181, 12.0, _TWELVE_VOLTS, 910, 510, _SLOPE_12, 52, _gains(1200, 40, 0, 0, 900)
    ),
    "XC330-T288": _small(
        1220, motors.XC330_T288, 12.0, _TWELVE_VOLTS, 910, 320, _SLOPE_12, 52, _gains(1200, 40, 0, 0, 900)
    ),
}
