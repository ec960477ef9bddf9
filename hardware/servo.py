"""Servos and joints: the only place where joint values become servo ticks, and ticks joint values.

    joint value  --gear-->  shaft angle  --servo-->  ticks

A joint value is in rad (hinge) or m (slide).  A shaft angle is in rad at the output shaft of the
servo.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal, NamedTuple, Protocol

from pydantic import Field

from robot_ik.config import Positive
from robot_ik.hardware.models import control_table
from robot_ik.hardware.registers import (
    IDS,
    MULTI_TURN_TICKS,
    TICKS_PER_REVOLUTION,
    ControlTable,
    OperatingMode,
)

ARM = "arm"
"""Group of the joints that carry the tool."""

GRIPPER = "gripper"
"""Group of the joints that grip."""

OpenEnd = Literal["lower", "upper"]
"""End of the range of a gripper's joint at which the gripper is open."""

Sign = Literal[1, -1]
"""Direction in which a servo counts."""

Unit = Literal["rad", "m"]
"""Unit of a joint value."""

ServoId = Annotated[int, Field(ge=IDS[0], le=IDS[-1])]
"""Id of a servo on its bus."""

Ticks = Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)]
"""Position of a servo."""

RANGE_TOLERANCE_TICKS = 60
"""About 5 degrees.  A reading may lie this far outside the range: backlash and a soft stop."""

TWIST = 0.1
"""rad at the last gear wheel.

Two servos of one joint that differ by more fight each other, or one of them slips.
"""

DEAD_CENTRE_SHARE = 0.1
"""Smallest finger travel per radian of a swing arm, over the length of its horn.

Nearer to a dead centre the servo would have to turn ever faster for the same speed of the finger.
"""

Gain = Annotated[int, Field(ge=0, le=16383)]
"""Value of a gain register."""

LEVER_SAMPLES = 65
"""Number of positions at which the levers of a bent gear are compared."""


class Gear(Protocol):
    """What lies between the output shaft of a servo and a joint.

    Attributes:
        ratio: Servo revolutions per revolution of the last gear wheel.
        unit: Unit of the joint value: ``"rad"`` or ``"m"``.
        value_range: Smallest and largest joint value that the gear allows.
    """

    @property
    def ratio(self) -> float: ...

    @property
    def unit(self) -> Unit: ...

    @property
    def value_range(self) -> tuple[float, float]: ...

    def shaft_angle(self, value: float) -> float:
        """Return the shaft angle at a joint value."""
        ...

    def joint_value(self, angle: float) -> float:
        """Return the joint value at a shaft angle."""
        ...

    def lever(self, value: float, /) -> float:
        """Return the change of the joint value per rad of the shaft, at a joint value.

        Positive.
        """
        ...


@dataclass(frozen=True)
class Direct:
    """A hinge: the servo turns it directly or through gear wheels.

    Attributes:
        ratio: Servo revolutions per joint revolution.
    """

    ratio: float = 1.0

    unit: ClassVar[Unit] = "rad"
    value_range: ClassVar[tuple[float, float]] = (-math.inf, math.inf)

    def shaft_angle(self, value: float) -> float:
        return self.ratio * value

    def joint_value(self, angle: float) -> float:
        return angle / self.ratio

    def lever(self, _value: float, /) -> float:
        return 1.0 / self.ratio


@dataclass(frozen=True)
class Pinion:
    """A slide: a pinion on the servo moves a rack.

    Attributes:
        radius: Pitch radius of the pinion, m.
        ratio: Servo revolutions per pinion revolution.
    """

    radius: float
    ratio: float = 1.0

    unit: ClassVar[Unit] = "m"
    value_range: ClassVar[tuple[float, float]] = (-math.inf, math.inf)

    def shaft_angle(self, value: float) -> float:
        return self.ratio * value / self.radius

    def joint_value(self, angle: float) -> float:
        return angle / self.ratio * self.radius

    def lever(self, _value: float, /) -> float:
        return self.radius / self.ratio


@dataclass(frozen=True)
class SwingArm:
    """A slide: a horn on the servo and a rod push a finger, as in the Interbotix X-Series gripper.

    The finger is ``d = h sin a + sqrt(L^2 - h^2 cos^2 a)`` from the middle, with the horn at angle
    ``a`` (Interbotix/interbotix_xs_driver src/xs_driver.cpp,
    ``convert_angular_position_to_linear``). The law holds between the dead centres.  Beyond them it
    continues as a straight line, so that a reading outside still tells on which side the finger is
    and how far.

    Attributes:
        horn: Length h of the horn, m.
        rod: Length L of the rod, m; at least ``horn``.
        ratio: Servo revolutions per horn revolution.
    """

    horn: float
    rod: float
    ratio: float = 1.0

    unit: ClassVar[Unit] = "m"

    @cached_property
    def horn_range(self) -> tuple[float, float]:
        """Smallest and largest usable angle of the horn, rad, in whole degrees."""
        return self._last_usable_angle(-1), self._last_usable_angle(1)

    @cached_property
    def value_range(self) -> tuple[float, float]:
        lower, upper = self.horn_range
        return self.distance(lower), self.distance(upper)

    def shaft_angle(self, value: float) -> float:
        return self.ratio * self.horn_angle(value)

    def joint_value(self, angle: float) -> float:
        return self.distance(angle / self.ratio)

    def lever(self, value: float) -> float:
        lower, upper = self.horn_range
        angle = min(max(self.horn_angle(value), lower), upper)
        return self._travel_per_radian(angle) / self.ratio

    def _last_usable_angle(self, step: int) -> float:
        degrees = 0
        shortest = DEAD_CENTRE_SHARE * self.horn
        while self._travel_per_radian(math.radians(degrees + step)) >= shortest:
            degrees += step
        return math.radians(degrees)

    def distance(self, angle: float) -> float:
        """Return the joint value at a horn angle, m."""
        lower, upper = self.horn_range
        inside = min(max(angle, lower), upper)
        distance = self.horn * math.sin(inside) + self._rod_along_slide(inside)
        return distance + (angle - inside) * self._travel_per_radian(inside)

    def horn_angle(self, distance: float) -> float:
        """Return the horn angle at a joint value: ``sin a = (d^2 + h^2 - L^2) / (2 d h)``."""
        lower, upper = self.value_range
        inside = min(max(distance, lower), upper)
        if inside != distance:
            end = self.horn_range[1] if distance > upper else self.horn_range[0]
            return end + (distance - inside) / self._travel_per_radian(end)
        # Written as d - (L^2 - h^2) / d, without 0 / 0 for equal lengths at d = 0.
        difference = (self.rod - self.horn) * (self.rod + self.horn)
        sine = (inside - (difference / inside if difference else 0.0)) / (2.0 * self.horn)
        return math.asin(min(max(sine, -1.0), 1.0))

    def _rod_along_slide(self, angle: float) -> float:
        return math.sqrt(max(self.rod**2 - (self.horn * math.cos(angle)) ** 2, 0.0))

    def _travel_per_radian(self, angle: float) -> float:
        along = self._rod_along_slide(angle)
        if along <= 0.0:
            # Horn and rod have one length and fold up: from here outwards d = 2 h sin a.
            return 2.0 * self.horn if angle >= 0.0 else 0.0
        return self.horn * math.cos(angle) * (1.0 + self.horn * math.sin(angle) / along)


@dataclass(frozen=True)
class Gains:
    """Table ``[joints.gains]``: register values of the servo's controllers; None: not changed."""

    position_p: Gain | None = None
    position_i: Gain | None = None
    position_d: Gain | None = None
    velocity_p: Gain | None = None
    velocity_i: Gain | None = None
    feedforward_1: Gain | None = None
    feedforward_2: Gain | None = None

    @property
    def registers(self) -> dict[str, int]:
        """Register name -> value, of the gains that are given."""
        ordinals = {"feedforward_1": "feedforward_1st", "feedforward_2": "feedforward_2nd"}
        given = {key: value for key, value in asdict(self).items() if value is not None}
        return {f"{ordinals.get(key, key)}_gain": value for key, value in given.items()}


@dataclass(frozen=True)
class StopAt:
    """Table ``[joints.stop_at]``: where an arm stops before a servo shuts down; None: never.

    Attributes:
        load_percent: Share of the motor's torque, for servos that measure load and no current.
        current_ma: Motor current, mA.
        temperature_c: Temperature, degrees Celsius.
    """

    load_percent: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    current_ma: Positive | None = None
    temperature_c: Positive | None = None


@dataclass(frozen=True)
class Servo:
    """One servo on a bus.

    Attributes:
        id: Id on the bus.
        model: Name of a control table, e.g. ``"XL330-M288"`` or ``"STS3215"``.
        mode: Operating mode.
        direction: +1: ticks increase with the shaft angle; -1: they decrease.
        zero_ticks: Present Position at shaft angle 0.
        reverse: Whether the servo's own direction bit is set; None: not checked.
        primary_id: Id whose goals this servo obeys as well (Dynamixel Secondary ID); None: its own
            only.
        current_limit: Largest motor current, mA, written to the servo; None: not changed.
        gains: Controller gains, written to the servo.
    """

    id: int
    model: str
    mode: OperatingMode = OperatingMode.EXTENDED_POSITION
    direction: Sign = 1
    zero_ticks: int = TICKS_PER_REVOLUTION // 2
    reverse: bool | None = False
    primary_id: int | None = None
    current_limit: float | None = None
    gains: Gains = Gains()

    @property
    def table(self) -> ControlTable:
        """Control table of the model."""
        return control_table(self.model)

    @cached_property
    def angle_per_tick(self) -> float:
        """Shaft angle of one tick, rad, signed."""
        return self.direction * 2.0 * math.pi / TICKS_PER_REVOLUTION

    @property
    def is_single_turn(self) -> bool:
        """Whether the mode allows goals within one revolution only."""
        return self.mode == OperatingMode.POSITION

    @property
    def presses(self) -> bool:
        """Whether the servo presses with a limited current instead of insisting on its goal."""
        return self.mode == OperatingMode.CURRENT_BASED_POSITION

    @property
    def goal_range(self) -> tuple[int, int]:
        """Smallest and largest goal that the operating mode allows, ticks."""
        if self.is_single_turn:
            return 0, TICKS_PER_REVOLUTION - 1
        return -MULTI_TURN_TICKS, MULTI_TURN_TICKS

    def position(self, angle: float) -> float:
        """Return the position at a shaft angle, in ticks and fractions; not clipped."""
        return self.zero_ticks + angle / self.angle_per_tick

    def angle(self, ticks: float) -> float:
        """Return the shaft angle at a position, rad; not clipped."""
        return (ticks - self.zero_ticks) * self.angle_per_tick


@dataclass(frozen=True)
class Joint:
    """A joint of the robot and the servos that move it.

    Joint values are in rad for a hinge and in m for a slide.  Methods that take a servo use the
    first one by default.

    Attributes:
        name: Joint name in the model.
        gear: From the servos' shafts to the joint.
        servos: One servo, or two that turn the joint together.  The first one measures the joint.
        lower: Smallest joint value that the arm file allows.
        upper: Largest joint value that the arm file allows.
        velocity: Speed limit, rad/s or m/s.
        acceleration: Acceleration limit, rad/s^2 or m/s^2.
        group: ``"arm"``: carries the tool; ``"gripper"``: fingers.
        current: Largest current in current-based position mode, mA; None: the servo's own limit.
        profile_velocity: Speed of the servos' profile at the joint; None: follows ``velocity``.
        profile_acceleration: The same for the acceleration; None: follows ``acceleration``.
        stop_at: Thresholds at which the arm stops.
        open_end: End of the range at which a gripper is open. Not used for joints of the arm.
    """

    name: str
    gear: Gear
    servos: tuple[Servo, ...]
    lower: float
    upper: float
    velocity: float
    acceleration: float
    group: str = ARM
    current: float | None = None
    profile_velocity: float | None = None
    profile_acceleration: float | None = None
    stop_at: StopAt = StopAt()
    open_end: OpenEnd = "upper"

    @property
    def servo(self) -> Servo:
        """The servo that measures the joint."""
        return self.servos[0]

    @property
    def slides(self) -> bool:
        """Whether the joint value is in metres."""
        return self.gear.unit == "m"

    @property
    def unit(self) -> str:
        """Unit in messages and in the arm file: ``deg`` or ``mm``."""
        return "mm" if self.slides else "deg"

    @property
    def per_unit(self) -> float:
        """One degree in rad, or one millimetre in m."""
        return 1e-3 if self.slides else math.radians(1.0)

    def text(self, value: float, digits: int = 1) -> str:
        """Return a joint value for messages: ``12.3 deg``, ``4.5 mm``."""
        return f"{value / self.per_unit:.{digits}f} {self.unit}"

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest joint value: arm file, gear and operating modes together.

        The range is empty if the first value is larger than the second.
        """
        lower = self.lower
        upper = self.upper
        for servo in self.servos:
            first, last = self.reach(servo)
            lower = max(lower, first)
            upper = min(upper, last)
        return lower, upper

    def at_opening(self, opening: float) -> float:
        """Return the joint value of a gripper at an opening from 0 (closed) to 1 (open)."""
        lower, upper = self.limits
        closed, opened = (lower, upper) if self.open_end == "upper" else (upper, lower)
        # Exact at both ends: a goal outside the limits would be refused.
        return (1.0 - opening) * closed + opening * opened

    @cached_property
    def levers(self) -> tuple[float, float]:
        """Smallest and largest lever of the gear within the range, per rad of the shaft."""
        first, last = self.gear.value_range
        lower = min(max(self.lower, first), last)
        upper = min(max(self.upper, first), last)
        step = (upper - lower) / (LEVER_SAMPLES - 1)
        samples = [self.gear.lever(lower + k * step) for k in range(LEVER_SAMPLES)]
        return min(samples), max(samples)

    @property
    def lever(self) -> float:
        """Largest change of the joint value per rad of the last gear wheel: 1 rad for a hinge."""
        return self.levers[1] * self.gear.ratio

    def lever_at(self, value: float) -> float:
        """Return the change of the joint value per rad of the last gear wheel, at a joint value."""
        return self.gear.lever(value) * self.gear.ratio

    @cached_property
    def resolution(self) -> float:
        """Largest change of the joint value per tick within the range."""
        return self.levers[1] * abs(self.servo.angle_per_tick)

    @cached_property
    def ticks_per_unit(self) -> float:
        """Largest number of ticks per rad or m of the joint within the range."""
        return 1.0 / (self.levers[0] * abs(self.servo.angle_per_tick))

    def ticks_per(self, value: float, servo: Servo | None = None) -> float:
        """Return the ticks per rad or m at a joint value; negative if the servo counts down."""
        servo = servo or self.servo
        return 1.0 / (servo.angle_per_tick * self.gear.lever(value))

    def reach(self, servo: Servo | None = None) -> tuple[float, float]:
        """Return the smallest and largest joint value that gear and operating mode allow."""
        servo = servo or self.servo
        ends = sorted(self.value(ticks, servo) for ticks in servo.goal_range)
        first, last = self.gear.value_range
        return max(ends[0], first), min(ends[1], last)

    def position(self, value: float, servo: Servo | None = None) -> float:
        """Return the servo position at a joint value, in ticks and fractions; not clipped."""
        return (servo or self.servo).position(self.gear.shaft_angle(value))

    def nearest_ticks(self, value: float, servo: Servo | None = None) -> int:
        """Return the nearest servo position at a joint value, ticks; not clipped."""
        return round(self.position(value, servo))

    def value(self, ticks: float, servo: Servo | None = None) -> float:
        """Return the joint value at a servo position; not clipped."""
        return self.gear.joint_value((servo or self.servo).angle(ticks))

    def ticks_between(self, first: float, second: float) -> float:
        """Return how far the servo turns between two joint values, ticks."""
        return abs(self.position(first) - self.position(second))

    def goal(self, value: float, servo: Servo | None = None) -> int:
        """Return the goal of a servo for a joint value, ticks.

        A value within the limits gives the nearest goal whose own value is within the limits.  A
        value outside gives the nearest goal: a joint that was found outside its limits must be able
        to move back.
        """
        servo = servo or self.servo
        ticks = round(servo.position(self.gear.shaft_angle(value)))
        lower, upper = self.limits
        if lower <= value <= upper:
            first, last = self.ticks_range(servo)
            return min(max(ticks, first), last)
        return ticks

    def ticks_range(self, servo: Servo | None = None) -> tuple[int, int]:
        """Return the smallest and largest goal whose joint values lie within the limits.

        The range is empty if the first value is larger than the second.
        """
        return self._ticks_ranges[(servo or self.servo).id]

    @cached_property
    def _ticks_ranges(self) -> Mapping[int, tuple[int, int]]:
        return {servo.id: self._ticks_range(servo) for servo in self.servos}

    def _ticks_range(self, servo: Servo) -> tuple[int, int]:
        ends = []
        lower, upper = self.limits
        for value, inwards in ((lower, 1), (upper, -1)):
            ticks = round(self.position(value, servo))
            if not lower <= self.value(ticks, servo) <= upper:
                ticks += inwards * servo.direction
            ends.append(ticks)
        return (ends[0], ends[1]) if servo.direction > 0 else (ends[1], ends[0])

    def lost_revolutions(self, ticks: int, servo: Servo | None = None) -> int:
        """Return the whole revolutions by which a reading is too small; 0: it is plausible.

        A multi-turn servo forgets its revolutions without power.  A reading outside the range that
        lies inside the range some revolutions further is a lost revolution.  A shaft that was
        turned by hand reads the same, so the caller must not correct it silently.
        """
        servo = servo or self.servo
        first, last = self.ticks_range(servo)
        outside = max(first - ticks, ticks - last)
        if servo.is_single_turn or outside <= RANGE_TOLERANCE_TICKS:
            return 0
        revolutions = round(((first + last) / 2 - ticks) / TICKS_PER_REVOLUTION)
        corrected = ticks + TICKS_PER_REVOLUTION * revolutions
        is_unique = last - first < TICKS_PER_REVOLUTION
        is_inside = first - RANGE_TOLERANCE_TICKS <= corrected <= last + RANGE_TOLERANCE_TICKS
        is_far = outside > TICKS_PER_REVOLUTION / 2
        return revolutions if is_far or (is_unique and is_inside) else 0


class Drive(NamedTuple):
    """One servo and the joint that it moves."""

    joint: Joint
    servo: Servo

    @property
    def name(self) -> str:
        """Joint name."""
        return self.joint.name

    @property
    def id(self) -> int:
        """Servo id."""
        return self.servo.id

    @property
    def label(self) -> str:
        """Joint and servo for messages."""
        return f"joint {self.joint.name!r} (servo id {self.servo.id})"

    @property
    def is_shadow(self) -> bool:
        """Whether the servo obeys the goals of another servo."""
        return self.servo.primary_id is not None

    def value(self, ticks: float) -> float:
        """Return the joint value at a position of this servo."""
        return self.joint.value(ticks, self.servo)

    def position(self, value: float) -> float:
        """Return the position of this servo at a joint value, in ticks and fractions."""
        return self.joint.position(value, self.servo)

    @property
    def ticks_range(self) -> tuple[int, int]:
        """Smallest and largest goal of this servo, ticks."""
        return self.joint.ticks_range(self.servo)
