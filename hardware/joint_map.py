"""One joint and its servo: the only change between radians (metres, where a joint slides) and ticks.

``ticks = zero_ticks + direction * ratio * angle / (2 pi) * 4096``; the angle of the last gear is q of a
hinge, q over the radius of the pinion of a slide on a rack, ``SwingArm.angle(q)`` of a finger on a horn and a
rod.  Outside this package angles are radians, ways metres.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Annotated, Literal

from pydantic import Field

from robot_ik.config import Positive
from robot_ik.hardware.control_table import (
    IDS,
    MULTI_TURN_TICKS,
    RADIANS_PER_TICK,
    TICKS_PER_REVOLUTION,
    ControlTable,
    OperatingMode,
    control_table,
)

POSITION_MODE_HOMING = TICKS_PER_REVOLUTION // 4
"""Ticks of Homing Offset (register 20) beyond which servos in position mode ignore it
(ROBOTIS-GIT/emanual _includes/en/dxl/control_table_homingoffset.md)."""
HOMING_FIXES = (
    'mode = "extended_position" (the offset counts there); or Homing Offset 0 in the servo, and the zero in '
    "zero_ticks: robot-ik servo calibrate"
)

RANGE_TOLERANCE_TICKS = 60
"""About 5 degrees beyond a range: backlash and a soft stop, not a lost revolution."""

TWIST = 0.1
"""rad (of a slide's pinion) between the two servos of one joint beyond which they fight, or one slips."""

ARM, GRIPPER = "arm", "gripper"
"""Groups: of the joints that make up q, and of those that grip."""


ServoId = Annotated[int, Field(ge=IDS[0], le=IDS[-1])]
Sign = Literal[1, -1]
"""Which way a servo counts."""
Ticks = Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)]
_Gain = Annotated[int, Field(ge=0, le=16383)]

LEAST_LEAD = 0.1
"""m of a finger for a radian of its horn, over the length of the horn: nearer to a dead centre a motor would
have to turn ever faster for the same speed of the finger, and its position says ever less."""


@dataclass(frozen=True)
class SwingArm:
    """A horn and a rod that push a finger along a slide: the gripper of the Interbotix X-Series.

    The finger's distance from the middle is ``d = h sin a + sqrt(L^2 - h^2 cos^2 a)``
    (Interbotix/interbotix_xs_driver src/xs_driver.cpp, ``convert_angular_position_to_linear``).  It is used
    between its dead centres; beyond, the law goes on straight: no finger is there, but a reading there still
    says on which side it is, and how far.

    Attributes:
        horn: h, m; ``rod``: L, m, at least ``horn``.
    """

    horn: float
    rod: float

    @cached_property
    def reach(self) -> tuple[float, float]:
        """Smallest and largest angle of the horn in use, rad, on whole degrees."""
        ends = []
        for way in (-1, 1):
            degrees = 0
            while self._lead(math.radians(degrees + way)) >= LEAST_LEAD * self.horn:
                degrees += way
            ends.append(math.radians(degrees))
        return ends[0], ends[1]

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Where the finger is then, m."""
        return self.distance(self.reach[0]), self.distance(self.reach[1])

    def distance(self, angle: float) -> float:
        """m of the finger from the middle, where the horn stands at ``angle``, rad."""
        a = min(max(angle, self.reach[0]), self.reach[1])
        return self.horn * math.sin(a) + self._rod_along_slide(a) + (angle - a) * self._lead(a)

    def angle(self, distance: float) -> float:
        """The inverse of ``distance``: ``sin a = (d^2 + h^2 - L^2) / (2 d h)``."""
        d = min(max(distance, self.ends[0]), self.ends[1])
        if d != distance:
            a = self.reach[d > self.ends[0]]
            return a + (distance - d) / self._lead(a)
        # d - (L^2 - h^2) / d: the same, and no 0 / 0 where horn and rod are equal and d is 0.
        rest = (self.rod - self.horn) * (self.rod + self.horn)
        sine = (d - (rest / d if rest else 0.0)) / (2.0 * self.horn)
        return math.asin(min(max(sine, -1.0), 1.0))

    def lead(self, distance: float) -> float:
        """m of the finger for a radian of the horn, where the finger is."""
        return self._lead(min(max(self.angle(distance), self.reach[0]), self.reach[1]))

    def _rod_along_slide(self, a: float) -> float:
        """Of the rod along the slide, m."""
        return math.sqrt(max(self.rod**2 - (self.horn * math.cos(a)) ** 2, 0.0))

    def _lead(self, a: float) -> float:
        along = self._rod_along_slide(a)
        if along <= 0.0:  # horn and rod are equal and fold up: from here on outwards d = 2 h sin a
            return 2.0 * self.horn if a >= 0.0 else 0.0
        return self.horn * math.cos(a) * (1.0 + self.horn * math.sin(a) / along)


@dataclass(frozen=True)
class Gains:
    """Table ``[joints.gains]``: register values of a position controller; None: as the servo has it."""

    position_p: _Gain | None = None
    position_i: _Gain | None = None
    position_d: _Gain | None = None
    velocity_p: _Gain | None = None
    velocity_i: _Gain | None = None
    feedforward_1: _Gain | None = None
    feedforward_2: _Gain | None = None

    @property
    def registers(self) -> dict[str, int]:
        """Name of the register -> value, of those given."""
        given = {key: value for key, value in asdict(self).items() if value is not None}
        return {f"{_NUMBERED.get(key, key)}_gain": value for key, value in given.items()}


_NUMBERED = {"feedforward_1": "feedforward_1st", "feedforward_2": "feedforward_2nd"}


@dataclass(frozen=True)
class StopAt:
    """Table ``[joints.stop_at]``: where an arm stops before a servo of it shuts down; None: never.

    Attributes:
        load_percent: Of what the motor can give, for servos that measure that and no current.
        current_ma: Motor current.
        temperature_c: Degrees Celsius.
    """

    load_percent: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    current_ma: Positive | None = None
    temperature_c: Positive | None = None


@dataclass(frozen=True)
class Twin:
    """Table ``[joints.twin]``: the other servo of a joint that two of them turn.

    Attributes:
        id: Its own, also where it listens to the first one's goals.
        direction, zero_ticks: As of the first one; with ``shadow`` they are the first one's.
        shadow: Its Secondary ID is the id of the first: it hears what is written to that one.  If it sits
            the other way round, it is reversed by its own Drive Mode.
        reverse: As of the first one; None: not, and of a shadow as it is found.
    """

    id: ServoId
    direction: Sign = 1
    zero_ticks: Ticks = TICKS_PER_REVOLUTION // 2
    shadow: bool = False
    reverse: bool | None = None


@dataclass(frozen=True)
class JointMap:
    """One joint and its servo.

    Attributes:
        name: Joint name in the model; ``id``, ``model``, ``mode``: of its servo.
        direction: +1 or -1; ``zero_ticks``: servo position at q = 0; ``ratio``: servo per joint
            revolutions.
        lower, upper: Range allowed in software, rad at the joint.
        velocity, acceleration: Caps, rad/s and rad/s^2 at the joint (of a slide all four are in m).
        current: Largest motor current, mA, in current-based position mode; None: the servo's own limit.
        twin: The other servo, where two turn this joint.
        shadow_of: Id of the first servo, where this row stands for its shadow.
        pinion: Radius of the pinion that moves a slide, m; ``horn``, ``rod``: of ``SwingArm``.  None: hinge.
        group: ``arm``: part of q; another, such as ``gripper``: held, and moved by its name.
        reverse: Bit 0 of its Drive Mode, set by the arm's maker; ticks are those that it then counts.  None:
            as it is found.
        gains, stop_at: See there.
        current_limit: Current Limit of the servo, mA; None: as it is.
        profile_velocity, profile_acceleration: Of its profile, rad/s and rad/s^2 at the joint (m); None: as
            the caps ask for.
    """

    name: str
    id: int
    model: str
    mode: OperatingMode
    direction: Sign
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
    reverse: bool | None = False
    horn: float | None = None
    rod: float | None = None
    gains: Gains = Gains()
    current_limit: float | None = None
    profile_velocity: float | None = None
    profile_acceleration: float | None = None
    stop_at: StopAt = StopAt()

    @cached_property
    def swing(self) -> SwingArm | None:
        """Horn and rod that move a slide."""
        return None if self.horn is None or self.rod is None else SwingArm(self.horn, self.rod)

    @property
    def slides(self) -> bool:
        """It is measured in metres."""
        return self.pinion is not None or self.swing is not None

    @cached_property
    def levers(self) -> tuple[float, float]:
        """Least and most that a radian of the last gear is at the joint within its range: 1 rad, or m."""
        if self.swing is None:
            lever = 1.0 if self.pinion is None else self.pinion
            return lever, lever
        low, high = (min(max(q, self.reach[0]), self.reach[1]) for q in (self.lower, self.upper))
        leads = [self.lever_at(low + k / 64 * (high - low)) for k in range(65)]
        return min(leads), max(leads)

    @property
    def lever(self) -> float:
        """The most that a radian of the last gear is at the joint within its range: 1 rad, or m."""
        return self.levers[1]

    def lever_at(self, q: float) -> float:
        """What a radian of the last gear is at the joint where it stands at ``q``."""
        return self.lever if self.swing is None else self.swing.lead(q)

    @property
    def unit(self) -> str:
        """In what people read of it: ``deg`` or ``mm``."""
        return "mm" if self.slides else "deg"

    @property
    def per_unit(self) -> float:
        """One degree in rad, one millimetre in m."""
        return 1e-3 if self.slides else math.radians(1.0)

    def text(self, q: float, digits: int = 1) -> str:
        """``q`` for people: ``12.3 deg``, ``4.5 mm``."""
        return f"{q / self.per_unit:.{digits}f} {self.unit}"

    @property
    def servos(self) -> tuple[JointMap, ...]:
        """This joint by each servo that turns it: itself, and the second one under its own id."""
        other = self.twin
        if other is None:
            return (self,)
        second = replace(self, id=other.id, twin=None, reverse=other.reverse)
        if other.shadow:
            return (self, replace(second, shadow_of=self.id))
        own = replace(second, direction=other.direction, zero_ticks=other.zero_ticks)
        return (self, replace(own, reverse=bool(other.reverse)))

    @property
    def table(self) -> ControlTable:
        return control_table(self.model)

    @cached_property
    def _step(self) -> float:
        """rad of the last gear of one tick, signed."""
        return self.direction * RADIANS_PER_TICK / self.ratio

    @cached_property
    def _scale(self) -> float:
        """Ticks of a radian (metre) of a joint without a bent gear, signed."""
        return 1.0 / (self._step * self.lever)

    @property
    def resolution(self) -> float:
        """The most that one tick is at the joint within its range, rad (m), positive."""
        return abs(self._step) * self.lever

    @property
    def ticks_per_unit(self) -> float:
        """The most ticks that a radian (metre) of the joint is within its range, positive."""
        return 1.0 / (abs(self._step) * self.levers[0])

    def ticks_per(self, q: float) -> float:
        """Ticks of a radian (metre) of the joint at ``q``; negative where the servo turns the other way."""
        return 1.0 / (self._step * self.lever_at(q))

    def position(self, q: float) -> float:
        """Servo position, ticks and parts of them, of a joint value in rad (m of a slide); not clipped."""
        if self.swing is None:
            return self.zero_ticks + q * self._scale
        return self.zero_ticks + self.swing.angle(q) / self._step

    def to_ticks(self, q: float) -> int:
        """Nearest servo position of a joint value in rad (m of a slide); not clipped."""
        return round(self.position(q))

    def to_radians(self, ticks: float) -> float:
        """Joint value, rad (m of a slide), of a servo position; not clipped."""
        angle = (ticks - self.zero_ticks) * self._step
        return angle * self.lever if self.swing is None else self.swing.distance(angle)

    def ticks_between(self, a: float, b: float) -> float:
        """How far the servo turns between two joint values, ticks."""
        return abs(self.position(a) - self.position(b))

    def goal(self, q: float) -> int:
        """Servo position to be sent for a joint value, rad (m).

        Of a value within ``limits`` the nearest whose own value is within them too; beyond them (a joint that
        was found outside and is on its way back) the nearest.
        """
        ticks = self.to_ticks(q)
        first, last = self.ticks_range
        if first <= ticks <= last:
            return ticks
        lower, upper = self.limits
        return min(max(ticks, first), last) if lower <= q <= upper else ticks

    def lost_revolutions(self, ticks: int) -> int:
        """Whole revolutions of the servo that are to be added to a reading; 0: it may stand where it says.

        A reading outside the range that lies inside it a revolution further on is a lost revolution, not a
        joint outside: led back to its range it would go on in the wrong direction.  A shaft that was wound up
        by hand reads the same, so nothing is added by itself.
        """
        first, last = self.ticks_range
        outside = max(first - ticks, ticks - last)
        if self.mode == OperatingMode.POSITION or outside <= RANGE_TOLERANCE_TICKS:
            return 0
        revolutions = round(((first + last) / 2 - ticks) / TICKS_PER_REVOLUTION)
        there = ticks + TICKS_PER_REVOLUTION * revolutions
        single_revolution = last - first < TICKS_PER_REVOLUTION
        inside = single_revolution and first - RANGE_TOLERANCE_TICKS <= there <= last + RANGE_TOLERANCE_TICKS
        return revolutions if inside or outside > TICKS_PER_REVOLUTION / 2 else 0

    @cached_property
    def reach(self) -> tuple[float, float]:
        """Smallest and largest q, rad (m), that mode and gear allow."""
        single = self.mode == OperatingMode.POSITION
        goals = (0, TICKS_PER_REVOLUTION - 1) if single else (-MULTI_TURN_TICKS, MULTI_TURN_TICKS)
        ends = sorted(self.to_radians(ticks) for ticks in goals)
        if self.swing is not None:
            ends = [max(ends[0], self.swing.ends[0]), min(ends[1], self.swing.ends[1])]
        return ends[0], ends[1]

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Smallest, largest q, rad (m): software range and what the mode reaches.  Empty if lower > upper."""
        reaches = [servo.reach for servo in self.servos]
        return max(self.lower, *(r[0] for r in reaches)), min(self.upper, *(r[1] for r in reaches))

    @cached_property
    def ticks_range(self) -> tuple[int, int]:
        """Smallest and largest goal, ticks: their values lie within ``limits``.  Empty if first > last."""
        lower, upper = self.limits
        ends = []
        for q, inwards in ((lower, 1), (upper, -1)):
            ticks = self.to_ticks(q)
            if not lower <= self.to_radians(ticks) <= upper:
                ticks += inwards * self.direction
            ends.append(ticks)
        return (ends[0], ends[1]) if self.direction > 0 else (ends[1], ends[0])
