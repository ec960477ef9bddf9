"""Gaits, and the footprints of a walk: where the feet are put, one after the other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from robot_ik.figure.figure import SIDES, Figure
from robot_ik.ports import Array

# A foot rotates by so much in a step at most, rad: legs do not cross, and the outer knee does not stretch.
_STEP_TURN = np.radians(22.0)


@dataclass(frozen=True)
class Gait:
    """How it walks.  Lengths m, times s, angles degrees; flat and rise are shares of the cycle.

    Attributes:
        length, width: Of a step; distance of the feet's lines.
        time, double: From strike to strike, and of that on both feet.
        strike_deg, off_deg: Sole's pitch at heel strike (toes up) and at toe off.
        peak: Largest pitch as a multiple of that at toe off.
        flat, rise: When the sole is flat, and when the heel leaves the floor.
        drop: How fast the sole falls at its strike, as a share of its mean speed until it is flat.
        leveled: When in the swing the sole is all but level, and its pitch then as a share of that at toe
            off.
        lift, arch: Clearance of the lowest point in mid swing; powers by which it comes and goes: the less,
            the longer it lasts.
        level_time: In which the toes straighten after they left the floor.
        gap: Least distance of the swinging foot from the line of the standing one.
        knee_deg: Least bend of the knees.
        toe_out_deg: Toes outwards.
        pressure: Zero-moment point under the foot, from and to, before the ankle.
        dip, bob, broad: When the pelvis is lowest after a strike, how far it goes up and down, and how much
            longer it is up than down.
        late: How much later than by a cosine the foot arrives: one that waits before its strike holds the
            hips down.
        depart: How softly the foot leaves: 2.47 with no acceleration, 0 as a cosine.
        arrive: Speed of the foot at its strike as a share of its mean speed in the air: heels strike while
            they still move.
        turn_deg: Of the pelvis about the vertical, to the side of the foremost leg.
        lean_deg: Of the chest forwards.
        swing_deg: Of the arms.
    """

    length: float = 0.62531
    width: float = 0.08042
    time: float = 0.56303
    double: float = 0.09387
    strike_deg: float = 11.63986
    off_deg: float = 45.89719
    peak: float = 1.41342
    flat: float = 0.11029
    drop: float = 0.27861
    rise: float = 0.43639
    leveled: tuple[float, float] = (0.5568, 0.15208)
    lift: float = 0.02781
    arch: tuple[float, float] = (2.35311, 2.22706)
    level_time: float = 0.36806
    gap: float = 0.11
    knee_deg: float = 12.15722
    toe_out_deg: float = 5.0
    pressure: tuple[float, float] = (0.04256, 0.1669)
    dip: float = -0.02876
    bob: float = 0.02804
    broad: float = 0.23502
    late: float = -0.29299
    depart: float = 2.08331
    arrive: float = 0.16313
    turn_deg: float = 4.55665
    lean_deg: float = 3.0
    swing_deg: float = 15.0


WALK = Gait()
"""Found by evolution strategies (CMA-ES) against the figures of ``robot-ik bench figure``."""
SHUFFLE = replace(
    WALK, length=0.3, time=0.62, double=0.16, strike_deg=0.0, off_deg=14.0, peak=1.1, rise=0.5, lift=0.045,
    knee_deg=12.0, toe_out_deg=0.0, pressure=(0.03, 0.05), bob=0.0, swing_deg=4.0, width=0.095, flat=0.069,
    leveled=(0.6, 0.1), arch=(3.0, 3.0), level_time=0.3,
    dip=0.006, broad=0.0, late=0.014, depart=0.0, arrive=0.0, turn_deg=4.5, lean_deg=-0.4,
)  # fmt: skip
"""Small steps to any side, and turning on the spot."""


@dataclass(frozen=True)
class Footprint:
    """Where a foot stands: the frame on the sole under the ankle, seen from above."""

    side: int
    x: float
    y: float
    yaw: float

    def on(self, forward: float) -> Array:
        """(2,) a point so far forward of the ankle."""
        return np.array([self.x + forward * np.cos(self.yaw), self.y + forward * np.sin(self.yaw)])


def print_of(stance: Array, side: int, half: float, toe_out: float = 0.0) -> Footprint:
    """The print of a foot ``half`` beside the middle ``stance`` (x, y, heading)."""
    sign = 1 - 2 * side
    x, y, heading = stance
    return Footprint(
        side, x - sign * half * np.sin(heading), y + sign * half * np.cos(heading), heading + sign * toe_out
    )


def prints_of(figure: Figure, q: Array) -> tuple[Footprint, Footprint]:
    """Where the feet stand at q."""
    found = []
    for side, name in enumerate(SIDES):
        (x, y, _), matrix = figure.pose(q, figure.feet[name].frame)
        yaw = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
        found.append(Footprint(side, float(x), float(y), yaw))
    return found[0], found[1]


def stance_of(left: Footprint, right: Footprint) -> Array:
    """(3,) x, y, heading of the middle."""
    heading = left.yaw + wrapped(right.yaw - left.yaw) / 2
    return np.array([(left.x + right.x) / 2, (left.y + right.y) / 2, heading])


def wrapped(angle: float) -> float:
    """The same angle from -π to π."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def walk_prints(
    figure: Figure, start: tuple[Footprint, Footprint], goal: Array, gait: Gait = WALK
) -> list[Footprint]:
    """Footsteps along a curve to a stance a metre or more away, rotated by a right angle at most.

    The first step is shorter and so is the last; the foot inside the turn begins, so that legs do not cross.
    """
    a, half = stance_of(*start), figure.apart
    b = np.array([goal[0], goal[1], a[2] + wrapped(goal[2] - a[2])])
    d = float(np.linalg.norm(b[:2] - a[:2]))
    u = np.linspace(0.0, 1.0, 400)[:, None]
    ta, tb = (d * np.array([np.cos(p[2]), np.sin(p[2])]) for p in (a, b))
    curve = (2 * u**3 - 3 * u**2 + 1) * a[:2] + (u**3 - 2 * u**2 + u) * ta
    curve += (3 * u**2 - 2 * u**3) * b[:2] + (u**3 - u**2) * tb
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    tangent = np.gradient(curve, axis=0)
    yaw = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    yaw += a[2] - yaw[0]
    # Whole steps, as long as they may be or as far rotated, but for the first and the last, which make up the
    # rest: 0.8 to 1.8 steps together.
    paces = np.maximum(np.diff(s) / gait.length, np.abs(np.diff(yaw)) / _STEP_TURN)
    pace = np.concatenate([[0.0], np.cumsum(paces)])
    n = max(2, int(np.ceil(pace[-1] + 0.2)))
    share = np.ones(n)
    rest = pace[-1] - (n - 2)
    share[0], share[-1] = 0.55 * rest, 0.45 * rest
    share = np.cumsum(share) / share.sum() * pace[-1]
    ways = np.diff(np.interp(share, pace, s), prepend=0.0)
    foot = 0 if np.interp(share[0], pace, yaw) > yaw[0] else 1
    out = list(start)
    for k in range(n):
        last = k == n - 1
        middle = b if last else np.array([np.interp(share[k], pace, v) for v in (*curve.T, yaw)])
        # Feet that hardly pass each other keep farther apart.
        lateral = half + (gait.width / 2 - half) * min(1.0, (ways[k] / gait.length) ** 2)
        width, toes = (half, 0.0) if last else (lateral, np.radians(gait.toe_out_deg))
        out.append(print_of(middle, foot, width, toes))
        foot = 1 - foot
    out.append(print_of(b, foot, half))
    return out


def shuffle_prints(figure: Figure, start: tuple[Footprint, Footprint], goal: Array) -> list[Footprint]:
    """Small steps to a stance nearby: to any side, and turning on the spot, at most 30 degrees a step.

    The foot on the side of the motion goes first and the other follows beside it, so that legs never cross.
    """
    a, half = stance_of(*start), figure.apart
    angle, displacement = wrapped(goal[2] - a[2]), np.asarray(goal[:2]) - a[:2]
    c, s = np.cos(a[2]), np.sin(a[2])
    forward, lateral = c * displacement[0] + s * displacement[1], -s * displacement[0] + c * displacement[1]
    paces = max(abs(angle) / np.radians(30.0), float(np.hypot(forward / 0.3, lateral / 0.2)))
    n = max(1, int(np.ceil(paces - 1e-6)))
    foot = 0 if (lateral if abs(lateral) > 0.03 else angle) > 0 else 1
    out = list(start)
    for k in range(1, n + 1):
        middle = np.array([*(a[:2] + displacement * k / n), a[2] + angle * k / n])
        out += [print_of(middle, side, half) for side in (foot, 1 - foot)]
    return out
