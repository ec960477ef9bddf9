"""One joint and its servo: the only change between radians and ticks.

``ticks = zero_ticks + direction * ratio * q / (2 pi) * 4096``; outside this package angles are radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from robot_ik.hardware.control_table import (
    MULTI_TURN_TICKS,
    TICKS_PER_TURN,
    ControlTable,
    OperatingMode,
    control_table,
)

MODES = {"position": OperatingMode.POSITION, "extended_position": OperatingMode.EXTENDED_POSITION}
"""Word in the arm file -> operating mode."""
MODE_TICKS = {
    OperatingMode.POSITION: (0, TICKS_PER_TURN - 1),
    OperatingMode.EXTENDED_POSITION: (-MULTI_TURN_TICKS, MULTI_TURN_TICKS),
}
"""Operating mode -> smallest and largest goal, ticks."""


@dataclass(frozen=True)
class JointMap:
    """One joint and its servo.

    Attributes:
        name: Joint name in the model; ``id``, ``model``, ``mode``: of its servo.
        direction: +1 or -1; ``zero_ticks``: servo position at q = 0; ``ratio``: servo turns per joint turn.
        lower, upper: Range allowed in software, rad at the joint.
        velocity, acceleration: Caps, rad/s and rad/s^2 at the joint.
    """

    name: str
    id: int
    model: str
    mode: OperatingMode
    direction: int
    zero_ticks: int
    ratio: float
    lower: float
    upper: float
    velocity: float
    acceleration: float

    @property
    def table(self) -> ControlTable:
        """Control table of the servo."""
        return control_table(self.model)

    @property
    def ticks_per_radian(self) -> float:
        """Signed: negative where servo and joint turn in opposite directions."""
        return self.direction * self.ratio * TICKS_PER_TURN / (2.0 * math.pi)

    @property
    def resolution(self) -> float:
        """Joint angle of one tick, rad, positive."""
        return 1.0 / abs(self.ticks_per_radian)

    def to_ticks(self, q: float) -> int:
        """Nearest servo position of a joint angle in rad; not clipped."""
        return round(self.zero_ticks + self.ticks_per_radian * q)

    def to_radians(self, ticks: float) -> float:
        """Joint angle, rad, of a servo position; not clipped."""
        return (ticks - self.zero_ticks) / self.ticks_per_radian

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest, largest q, rad: software range and what the mode can reach.  Empty if lower > upper."""
        ends = sorted(self.to_radians(ticks) for ticks in MODE_TICKS[self.mode])
        return max(self.lower, ends[0]), min(self.upper, ends[1])

    @property
    def ticks_range(self) -> tuple[int, int]:
        """Smallest and largest goal, ticks: ``to_ticks`` of any q within ``limits`` lies inside."""
        first, last = sorted(self.to_ticks(q) for q in self.limits)
        return first, last
