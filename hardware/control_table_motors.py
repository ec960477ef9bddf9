"""What the motors of the X series can do: the manual's specification tables, as data.

Source: ROBOTIS e-manual, _data/dxl_x_info.yml (stall torque, stall current, no load speed, gear ratio and
standby current at the recommended voltage), read on 2026-11-22.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

RPM = 2.0 * math.pi / 60.0
"""One revolution a minute, rad/s."""


@dataclass(frozen=True)
class Motor:
    """A motor with its gear, seen at the output shaft.

    Attributes:
        stall_torque: N m, and ``stall_current``, A, at ``volts``.
        no_load_rpm: rev/min at ``volts``.
        volts: At which these were measured, V.
        gear_ratio: Turns of the motor for one of the shaft.
        standby: Current without torque, A.
        sensed_at_supply: Present Current is what the supply gives, not what flows through the motor.
    """

    stall_torque: float
    stall_current: float
    no_load_rpm: float
    volts: float
    gear_ratio: float
    standby: float
    sensed_at_supply: bool = False

    @property
    def torque_per_ampere(self) -> float:
        """N m at the shaft for an ampere through the motor; gear friction is in it."""
        return self.stall_torque / self.stall_current

    @property
    def no_load_speed(self) -> float:
        """rad/s at ``volts``."""
        return self.no_load_rpm * RPM


XL330_M077 = Motor(0.215, 1.47, 383.0, 5.0, 77.5, 0.017)
XL330_M288 = Motor(0.52, 1.47, 103.0, 5.0, 288.4, 0.017)
XC330_M181 = Motor(0.60, 1.80, 129.0, 5.0, 180.62, 0.017, sensed_at_supply=True)
XC330_M288 = Motor(0.93, 1.80, 81.0, 5.0, 288.35, 0.017, sensed_at_supply=True)
XC330_T181 = Motor(0.76, 0.80, 104.0, 11.1, 180.62, 0.017, sensed_at_supply=True)
XC330_T288 = Motor(0.92, 0.80, 65.0, 11.1, 288.35, 0.017, sensed_at_supply=True)
XL430_W250 = Motor(1.4, 1.3, 57.0, 11.1, 258.5, 0.052)
XC430_W150 = Motor(1.6, 1.4, 106.0, 12.0, 159.59, 0.046)
XC430_W240 = Motor(1.9, 1.4, 70.0, 12.0, 245.22, 0.046)
XM430_W210 = Motor(3.0, 2.3, 77.0, 12.0, 212.6, 0.040)
XM430_W350 = Motor(4.1, 2.3, 46.0, 12.0, 353.5, 0.040)
XM540_W150 = Motor(7.3, 4.4, 53.0, 12.0, 152.3, 0.040)
XM540_W270 = Motor(10.6, 4.4, 30.0, 12.0, 272.5, 0.040)
XH540_W150 = Motor(7.1, 4.9, 70.0, 12.0, 152.3, 0.040)
