"""What a hand shows at a limp arm: how far each joint goes, and which way its servos count.

Two servos of one joint are swept together; that they turn together is checked on the way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from robot_ik.errors import HardwareError
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.control_table import TICKS_PER_TURN, OperatingMode
from robot_ik.hardware.samples import TWIST

LEAST_SWEEP = math.radians(10.0)
"""rad at the joint (at the pinion of a slide); a joint that turned by less was forgotten."""

LEAST_WIGGLE = math.radians(3.0)
"""rad at the joint; less may be a hand that touched it by chance."""

ASKED_WIGGLE = math.radians(10.0)
"""rad at the joint that a hand is asked for."""

STILL_TICKS = 12
"""About 1 degree: a held joint moves by less while its zero is taken."""

_HALF = TICKS_PER_TURN // 2


class HandError(HardwareError):
    """A hand did not do what it was asked for; it can do it again."""


class Sweep:
    """Smallest and largest position of every servo, whole turns counted here.

    Args:
        config: The arm.
        ticks: Servo id -> Present Position at the beginning.
    """

    def __init__(self, config: ArmConfig, ticks: Mapping[int, int]) -> None:
        # A limp servo in position mode may count on beyond its turn; with torque it counts within it.
        turn = {j.id: TICKS_PER_TURN for j in config.servos if j.mode == OperatingMode.POSITION}
        self._raw = {id: ticks[id] for id in config.servo_ids}
        self.now = {id: value % turn[id] if id in turn else value for id, value in self._raw.items()}
        self.low, self.high = dict(self.now), dict(self.now)

    def take(self, ticks: Mapping[int, int | None]) -> None:
        """The next reading; a step of more than half a turn is the servo starting its turn anew."""
        for id, before in self._raw.items():
            value = ticks.get(id)
            if value is None:
                continue
            step = value - before
            if abs(step) > _HALF:
                step -= round(step / TICKS_PER_TURN) * TICKS_PER_TURN
            self._raw[id] = value
            self.now[id] += step
            self.low[id] = min(self.low[id], self.now[id])
            self.high[id] = max(self.high[id], self.now[id])

    def way(self, servo: JointMap) -> float:
        """How far its joint was turned, rad (m of a slide)."""
        return (self.high[servo.id] - self.low[servo.id]) * servo.resolution


def check_sweep(config: ArmConfig, sweep: Sweep) -> None:
    """Raises ``HardwareError`` where a sweep cannot be used.

    A joint was not swept, crosses the end of its servo's turn, or its two servos did not turn together.
    """
    for joint in config.servos:
        low, high = sweep.low[joint.id], sweep.high[joint.id]
        if sweep.way(joint) < LEAST_SWEEP * joint.lever:
            which = f" (servo id {joint.id})" if joint.id not in config.ids else ""
            raise HandError(
                f"joint {joint.name!r}{which} moved by {joint.text(sweep.way(joint))} only",
                hint="sweep every joint from one stop to the other",
            )
        if joint.mode == OperatingMode.POSITION and not 0 <= low <= high < TICKS_PER_TURN:
            raise HardwareError(
                f"joint {joint.name!r} crosses the end of its servo's turn: it swept ticks {low} to {high}, "
                f"and a servo in position mode counts 0 to {TICKS_PER_TURN - 1}",
                hint='mount its horn about half a turn on, or set mode = "extended_position" in the arm file',
            )
    for joint in config.joints:
        for other in joint.servos[1:]:
            _require_together(joint, other, sweep.way(joint), sweep.way(other))


def _require_together(joint: JointMap, other: JointMap, way: float, other_way: float) -> None:
    """Raises ``HardwareError`` unless two servos of a joint have gone the same way, whatever their signs."""
    if abs(abs(way) - abs(other_way)) > TWIST * joint.lever:
        raise HardwareError(
            f"the two servos of joint {joint.name!r} do not turn together: id {joint.id} by "
            f"{joint.text(way)}, id {other.id} by {joint.text(other_way)}",
            hint="does a horn or a gear slip? do both have the ratio of the arm file?",
        )


def wiggled(
    config: ArmConfig, joint: JointMap, before: Mapping[int, int], after: Mapping[int, int]
) -> dict[int, int]:
    """Which way the servos of a joint count when it is turned in the positive direction.

    Args:
        config: The arm.
        joint: The one that was to be turned.
        before: Servo id -> ticks.
        after: The same now.

    Returns:
        Servo id -> +1 or -1, of each servo that turns this joint.

    Raises:
        HardwareError: Nothing turned, another joint did, or its two servos did not turn together.
    """
    ways = {s.id: (after[s.id] - before[s.id]) * s.resolution / s.lever for s in config.servos}
    most = max(config.servos, key=lambda servo: abs(ways[servo.id]))
    farthest = most.text(abs(ways[most.id]) * most.lever)
    own = ways[joint.id]
    if abs(ways[most.id]) < LEAST_WIGGLE:
        raise HandError(
            f"joint {joint.name!r} did not turn (most: {most.name} by {farthest})",
            hint=f"turn it by about {joint.text(ASKED_WIGGLE * joint.lever, 0)} and leave it there",
        )
    if abs(own) < LEAST_WIGGLE or (most.name != joint.name and abs(ways[most.id]) > 2.0 * abs(own)):
        raise HandError(
            f"{joint.name!r} was to be turned, and {most.name!r} did (by {farthest})",
            hint="are two ids swapped? compare cables and arm file; robot-ik servo setup changes an id",
        )
    for other in joint.servos[1:]:
        _require_together(joint, other, own * joint.lever, ways[other.id] * joint.lever)
    return {servo.id: 1 if ways[servo.id] > 0 else -1 for servo in joint.servos}


def check_shadows(config: ArmConfig, directions: Mapping[int, int], zero: Mapping[int, int]) -> None:
    """Raises ``HardwareError`` where a servo could not follow the goals of another that it listens to.

    Args:
        config: The arm.
        directions: Servo id -> +1 or -1.
        zero: Servo id -> ticks in the zero pose.
    """
    for joint in config.joints:
        for other in joint.servos[1:]:
            if other.shadow_of is None:
                continue
            if directions[other.id] != directions[joint.id]:
                raise HardwareError(
                    f"the shadow of joint {joint.name!r} (servo id {other.id}) counts the other way round",
                    hint="set bit 0 of its Drive Mode (reverse), or give it goals of its own: shadow = false",
                )
            apart = abs(zero[other.id] - zero[joint.id]) * joint.resolution
            if apart > TWIST * joint.lever:
                raise HardwareError(
                    f"the shadow of joint {joint.name!r} (servo id {other.id}) stands {joint.text(apart)} "
                    "beside the servo whose goals it takes",
                    hint="turn its horn, or give it goals of its own: shadow = false in the arm file",
                )
