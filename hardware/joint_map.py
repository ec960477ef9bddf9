"""One joint and its servo: the only change between radians (metres, where a joint slides) and ticks.

``ticks = zero_ticks + direction * ratio * q / lever / (2 pi) * 4096``; ``lever`` is 1 for a hinge and the
radius of the pinion, in metres, for a slide on a rack.  Outside this package angles are radians, ways metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from robot_ik.hardware.control_table import (
    MULTI_TURN_TICKS,
    TICKS_PER_TURN,
    ControlTable,
    OperatingMode,
    control_table,
)

MODES = {
    "position": OperatingMode.POSITION,
    "extended_position": OperatingMode.EXTENDED_POSITION,
    "current_based_position": OperatingMode.CURRENT_BASED_POSITION,
}
"""Word in the arm file -> operating mode."""
MODE_TICKS = {
    OperatingMode.POSITION: (0, TICKS_PER_TURN - 1),
    OperatingMode.EXTENDED_POSITION: (-MULTI_TURN_TICKS, MULTI_TURN_TICKS),
    OperatingMode.CURRENT_BASED_POSITION: (-MULTI_TURN_TICKS, MULTI_TURN_TICKS),
}
"""Operating mode -> smallest and largest goal, ticks."""

ARM = "arm"
"""Group of the joints that make up q."""


@dataclass(frozen=True)
class Twin:
    """The other servo of a joint that two of them turn.

    Attributes:
        id: Its own, also where it listens to the first one's goals.
        direction, zero_ticks: As of the first one; with ``shadow`` they are the first one's.
        shadow: Its Secondary ID is the id of the first: it hears what is written to that one.  If it sits
            the other way round, it is reversed by its own Drive Mode.
    """

    id: int
    direction: int = 1
    zero_ticks: int = TICKS_PER_TURN // 2
    shadow: bool = False


@dataclass(frozen=True)
class JointMap:
    """One joint and its servo.

    Attributes:
        name: Joint name in the model; ``id``, ``model``, ``mode``: of its servo.
        direction: +1 or -1; ``zero_ticks``: servo position at q = 0; ``ratio``: servo turns per joint turn.
        lower, upper: Range allowed in software, rad at the joint.
        velocity, acceleration: Caps, rad/s and rad/s^2 at the joint (of a slide all four are in m).
        current: Largest motor current, mA, in current-based position mode; None: the servo's own limit.
        twin: The other servo, where two turn this joint.
        shadow_of: Id of the first servo, where this row stands for its shadow.
        pinion: Radius of the pinion that moves a slide, m; None: a hinge.
        group: ``arm``: part of q; another, such as ``gripper``: held, and moved by its name.
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
    current: float | None = None
    twin: Twin | None = None
    shadow_of: int | None = None
    pinion: float | None = None
    group: str = ARM

    @property
    def lever(self) -> float:
        """What a radian of the last gear is at the joint: 1 rad, or so many metres of a slide."""
        return 1.0 if self.pinion is None else self.pinion

    @property
    def unit(self) -> str:
        """In what people are told of it: ``deg`` or ``mm``."""
        return "deg" if self.pinion is None else "mm"

    @property
    def per_unit(self) -> float:
        """One degree in rad, one millimetre in m."""
        return math.radians(1.0) if self.pinion is None else 1e-3

    def text(self, q: float, digits: int = 1) -> str:
        """``q`` for people: ``12.3 deg``, ``4.5 mm``."""
        return f"{q / self.per_unit:.{digits}f} {self.unit}"

    @property
    def servos(self) -> tuple[JointMap, ...]:
        """This joint by each servo that turns it: itself, and the second one under its own id."""
        other = self.twin
        if other is None:
            return (self,)
        if other.shadow:
            return (self, replace(self, id=other.id, twin=None, shadow_of=self.id))
        own = {"direction": other.direction, "zero_ticks": other.zero_ticks}
        return (self, replace(self, id=other.id, twin=None, **own))  # type: ignore[arg-type]

    @property
    def table(self) -> ControlTable:
        """Control table of the servo."""
        return control_table(self.model)

    @property
    def ticks_per_radian(self) -> float:
        """Of the joint (per metre of a slide); negative where servo and joint turn in opposite directions."""
        return self.direction * self.ratio * TICKS_PER_TURN / (2.0 * math.pi) / self.lever

    @property
    def resolution(self) -> float:
        """Joint angle of one tick, rad (m), positive."""
        return 1.0 / abs(self.ticks_per_radian)

    def to_ticks(self, q: float) -> int:
        """Nearest servo position of a joint value in rad (m of a slide); not clipped."""
        return round(self.zero_ticks + self.ticks_per_radian * q)

    def to_radians(self, ticks: float) -> float:
        """Joint value, rad (m of a slide), of a servo position; not clipped."""
        return (ticks - self.zero_ticks) / self.ticks_per_radian

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest, largest q, rad (m): software range and what the mode reaches.  Empty if lower > upper."""
        lower, upper = self.lower, self.upper
        for servo in self.servos:
            ends = sorted(servo.to_radians(ticks) for ticks in MODE_TICKS[self.mode])
            lower, upper = max(lower, ends[0]), min(upper, ends[1])
        return lower, upper

    @property
    def ticks_range(self) -> tuple[int, int]:
        """Smallest and largest goal, ticks: ``to_ticks`` of any q within ``limits`` lies inside."""
        first, last = sorted(self.to_ticks(q) for q in self.limits)
        return first, last
