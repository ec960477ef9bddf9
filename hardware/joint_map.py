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

from robot_ik.hardware.control_table import (
    IDS,
    MULTI_TURN_TICKS,
    TICKS_PER_REVOLUTION,
    ControlTable,
    OperatingMode,
    control_table,
)
from robot_ik.hardware.servo import RANGE_TOLERANCE_TICKS as RANGE_TOLERANCE_TICKS
from robot_ik.hardware.servo import Direct, Gear, Joint, Pinion, Servo, SwingArm
from robot_ik.tables import Positive

POSITION_MODE_HOMING = TICKS_PER_REVOLUTION // 4
"""Ticks of Homing Offset (register 20) beyond which servos in position mode ignore it
(ROBOTIS-GIT/emanual _includes/en/dxl/control_table_homingoffset.md)."""
HOMING_FIXES = (
    'mode = "extended_position" (the offset counts there); or Homing Offset 0 in the servo, and the zero in '
    "zero_ticks: robot-ik servo calibrate"
)

TWIST = 0.1
"""rad (of a slide's pinion) between the two servos of one joint beyond which they fight, or one slips."""

ARM, GRIPPER = "arm", "gripper"
"""Groups: of the joints that make up q, and of those that grip."""


ServoId = Annotated[int, Field(ge=IDS[0], le=IDS[-1])]
Sign = Literal[1, -1]
"""Which way a servo counts."""
Ticks = Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)]
_Gain = Annotated[int, Field(ge=0, le=16383)]

# Former names, for the tests of the previous layout.
SwingArm.distance = SwingArm._distance  # type: ignore[attr-defined]
SwingArm.angle = SwingArm._horn_angle  # type: ignore[attr-defined]
SwingArm.lead = lambda self, distance: self.lever(distance) * self.ratio  # type: ignore[attr-defined]
SwingArm.ends = property(lambda self: self.value_range)  # type: ignore[attr-defined]
SwingArm.reach = property(lambda self: self.horn_range)  # type: ignore[attr-defined]


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
    def gear(self) -> Gear:
        """What lies between servo shaft and joint."""
        if self.horn is not None and self.rod is not None:
            return SwingArm(self.horn, self.rod, self.ratio)
        return Direct(self.ratio) if self.pinion is None else Pinion(self.pinion, self.ratio)

    @cached_property
    def servo(self) -> Servo:
        """The servo of this row."""
        return Servo(
            self.id, self.model, self.mode.name.lower(), self.direction, self.zero_ticks, self.reverse,
            self.shadow_of,
        )  # fmt: skip

    @cached_property
    def joint(self) -> Joint:
        """The joint of this row with all its servos."""
        return Joint(
            self.name, self.gear, tuple(row.servo for row in self.servos), self.lower, self.upper,
            self.velocity, self.acceleration, self.group,
        )  # fmt: skip

    @property
    def swing(self) -> SwingArm | None:
        """Horn and rod that move a slide."""
        return self.gear if isinstance(self.gear, SwingArm) else None

    @property
    def slides(self) -> bool:
        """It is measured in metres."""
        return self.gear.unit == "m"

    @property
    def levers(self) -> tuple[float, float]:
        """Least and most that a radian of the last gear is at the joint within its range: 1 rad, or m."""
        least, most = self.joint.levers
        return least * self.ratio, most * self.ratio

    @property
    def lever(self) -> float:
        """The most that a radian of the last gear is at the joint within its range: 1 rad, or m."""
        return self.levers[1]

    def lever_at(self, q: float) -> float:
        """What a radian of the last gear is at the joint where it stands at ``q``."""
        return self.gear.lever(q) * self.ratio

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

    @property
    def resolution(self) -> float:
        """The most that one tick is at the joint within its range, rad (m), positive."""
        return self.joint.resolution

    @property
    def ticks_per_unit(self) -> float:
        """The most ticks that a radian (metre) of the joint is within its range, positive."""
        return 1.0 / (abs(self.servo.angle_per_tick) * self.joint.levers[0])

    def ticks_per(self, q: float) -> float:
        """Ticks of a radian (metre) of the joint at ``q``; negative where the servo turns the other way."""
        return 1.0 / (self.servo.angle_per_tick * self.gear.lever(q))

    def position(self, q: float) -> float:
        """Servo position, ticks and parts of them, of a joint value in rad (m of a slide); not clipped."""
        return self.joint.position(self.servo, q)

    def to_ticks(self, q: float) -> int:
        """Nearest servo position of a joint value in rad (m of a slide); not clipped."""
        return round(self.position(q))

    def to_radians(self, ticks: float) -> float:
        """Joint value, rad (m of a slide), of a servo position; not clipped."""
        return self.joint.value(self.servo, ticks)

    def ticks_between(self, a: float, b: float) -> float:
        """How far the servo turns between two joint values, ticks."""
        return abs(self.position(a) - self.position(b))

    def goal(self, q: float) -> int:
        """Servo position to be sent for a joint value, rad (m)."""
        return self.joint.goal(self.servo, q)

    def lost_revolutions(self, ticks: int) -> int:
        """Whole revolutions of the servo that are to be added to a reading; 0: it may stand where it says."""
        return self.joint.lost_revolutions(self.servo, ticks)

    @property
    def reach(self) -> tuple[float, float]:
        """Smallest and largest q, rad (m), that mode and gear allow."""
        return self.joint.reach(self.servo)

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest, largest q, rad (m): software range and what the mode reaches.  Empty if lower > upper."""
        return self.joint.limits

    @cached_property
    def ticks_range(self) -> tuple[int, int]:
        """Smallest and largest goal, ticks: their values lie within ``limits``.  Empty if first > last."""
        return self.joint.ticks_range(self.servo)
