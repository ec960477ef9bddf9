"""Walking: gaits, footprints, feet that roll, the centre of mass over them, and frames of the whole body.

A foot rolls on its true sole (``figure.Sole``), so that it neither slips nor sinks by construction; in the
air its lowest point follows the same curve with a clearance.  The centre of mass is planned over a
zero-moment point under the feet and corrected four times by the whole body's own dynamics (``balance``).  The
pelvis goes as high as legs let it.  Human numbers: ``docs/theory/figure.md``.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.balance import (
    clamped_curve,
    compensate,
    decay,
    monotone_curve,
    plan_center,
    smooth,
    zero_moment_slices,
)
from robot_ik.figure.figure import DT, GRAVITY, SIDES, Figure
from robot_ik.figure.frames import FrameRows, Frames, Slices, at_once
from robot_ik.geometry import axis_rotations
from robot_ik.motion.timing import minimum_jerk
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
    """Where the feet stand at q; their yaws differ by no more than π, also where a figure faces backwards."""
    found: list[Footprint] = []
    for side, name in enumerate(SIDES):
        (x, y, _), matrix = figure.pose(q, figure.feet[name].frame)
        yaw = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
        yaw += 2 * np.pi * round((found[0].yaw - yaw) / (2 * np.pi)) if found else 0.0
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


# ------------------------------------------------------------------------------------------
# A walk over footprints.

AIR, HEEL, FLAT, TOE = range(4)
CONTACTS = ("air", "heel", "flat", "toe")

# Share of the cycle that a foot stands (Schwartz et al. 2008: 60 to 61 %).
_STANCE = 0.61
# Before the first step, and after the last strike, s: the body needs some e^{-ωt} to come to rest.
_LEAN, _SETTLE = 0.75, 1.4
# A knee bends so far at least, degrees, as its foot leaves the floor, within so long before and after, s: a
# straight one would have to bend at once.
_LEAVING_DEG, _LEAVING = 27.0, 0.08
# Pitch of the sole as a foot leaves the floor for a step of no length, as a share of that for a whole one.
_LEAST_OFF = 0.45
# Rounds of the dynamics filter.
_CORRECTIONS = 4
# Heights of a foot in the air are smoothed over so long, s, but for these shares of the swing at its ends.
_EASE, _EASE_IN, _EASE_OUT = 0.025, 0.3, 0.25


@dataclass
class _Footfall:
    print: Footprint
    strike: float
    off: float
    first: bool
    last: bool
    share: float  # of a whole step, of the one that led here

    @property
    def heel(self) -> float:
        """Pitch of the sole as it strikes, as a share of that of a whole step: a short one lands flatter."""
        return min(0.3 if self.last else 1.0, self.share)

    def roll(self, after: _Footfall) -> float:
        """Pitch of the sole as it leaves the floor for ``after``, as a share of that for a whole step."""
        return min(0.75 if self.first else 1.0, _LEAST_OFF + (1.0 - _LEAST_OFF) * after.share)


class _Plan:
    """Times and positions of feet, zero-moment point and centre of mass, of all frames at once."""

    def __init__(self, figure: Figure, prints: Sequence[Footprint], gait: Gait, x: Array) -> None:
        self.figure, self.prints, self.gait = figure, prints, gait
        steps = len(prints) - 2
        self.lifts = [_LEAN + k * gait.time for k in range(steps)]
        self.strikes = [t + gait.time - gait.double for t in self.lifts]
        self.end = self.strikes[-1] + _SETTLE
        self.times = np.arange(1, int(self.end / DT) + 1, dtype=np.float64) * DT
        self.omega = float(np.sqrt(GRAVITY / figure.center(figure.home)[2]))
        self.falls: tuple[list[_Footfall], list[_Footfall]] = ([], [])
        for k, at in enumerate(prints):
            mine = self.falls[at.side]
            if mine:
                mine[-1].off = self.lifts[k - 2]
            strike = self.strikes[k - 2] if k > 1 else -9.0
            was = mine[-1].print if mine else at
            share = min(1.0, float(np.hypot(at.x - was.x, at.y - was.y)) / (2 * gait.length))
            mine.append(_Footfall(at, strike, np.inf, k < 2, k >= len(prints) - 2, share))
        self.com, self.zmp = plan_center(self._pressure(), x, self.omega, self.times)
        self.foot_positions = np.empty((2, len(self.times), 3))
        self.yaw, self.pitch = np.empty((2, len(self.times))), np.empty((2, len(self.times)))
        self.toes = np.zeros((2, len(self.times)))
        self.contact = np.full((2, len(self.times)), FLAT)
        for side in (0, 1):
            self._foot(side)
        self.phase, self.going = self._phases()

    def _pressure(self) -> list[tuple[float, Array]]:
        """Nodes of the zero-moment point: along the sole while on one foot, across while on both."""
        gait, prints = self.gait, self.prints
        standing = next(p for p in prints[:2] if p.side != prints[2].side)
        # Over the standing foot before the other's heel leaves the floor.
        nodes = [(0.0, standing.on(0.03)), (_LEAN - (_STANCE - gait.rise) * 2 * gait.time, standing.on(0.03))]
        for k in range(len(prints) - 2):
            under, last = (prints[k + 1] if k else standing), k == len(prints) - 3
            begin = 0.03 if k == 0 else gait.pressure[0]
            end = 0.05 if last else gait.pressure[1]
            nodes.append((self.lifts[k], under.on(begin)))
            if not last:  # at the toes when the heel leaves the floor
                heel_off = self.lifts[k + 1] - (_STANCE - gait.rise) * 2 * gait.time
                if self.lifts[k] + 0.02 < heel_off < self.strikes[k] - 0.02:
                    nodes.append((heel_off, under.on(end)))
            nodes.append((self.strikes[k], under.on(end)))
        middle = (prints[-1].on(0.03) + prints[-2].on(0.03)) / 2
        return [*nodes, (self.strikes[-1] + 0.35, middle), (self.end, middle)]

    def _foot(self, side: int) -> None:
        """Place, yaw, pitch, bend of the toes and contact of one foot at all times."""
        gait, t, falls = self.gait, self.times, self.falls[side]
        sole = self.figure.feet[SIDES[side]].sole
        on, off_ = -np.radians(gait.strike_deg), np.radians(gait.off_deg)
        xy, yaw, pitch = np.empty((len(t), 2)), np.empty(len(t)), np.zeros(len(t))
        clear, air = np.zeros(len(t)), np.zeros(len(t), dtype=bool)
        for i, fall in enumerate(falls):
            here = t >= fall.strike
            xy[here], yaw[here] = (fall.print.x, fall.print.y), fall.print.yaw
            pitch[here] = 0.0
            if not fall.first:
                low = fall.strike + gait.flat * 2 * gait.time
                u = np.clip((t - fall.strike) / (low - fall.strike), 0.0, 1.0)
                left = 1 - minimum_jerk(u) - gait.drop * u * (1 - u) ** 3 * (1 + 3 * u)
                pitch[here] = (on * fall.heel * left)[here]
            if not np.isfinite(fall.off):
                continue
            after = falls[i + 1]
            rise, swing = fall.off - (_STANCE - gait.rise) * 2 * gait.time, after.strike - fall.off
            top = off_ * fall.roll(after)
            settled, part = gait.leveled
            knots = np.array(
                [rise, fall.off, fall.off + 0.14 * swing, fall.off + settled * swing, after.strike]
            )
            values = np.array([0.0, top, top * gait.peak, part * top, on * after.heel])
            rolling = (t > rise) & (t < after.strike)
            drop = -values[-1] * gait.drop / (gait.flat * 2 * gait.time)
            pitch[rolling] = clamped_curve(knots, values, t[rolling], drop)
            away = (t >= fall.off) & (t < after.strike)
            s = (t[away] - fall.off) / swing
            xy[away], yaw[away] = self._swing(side, fall, after, s)
            clear[away], air[away] = gait.lift * _arc(s, *gait.arch), True
            self.toes[side, rolling] = np.maximum(pitch, 0.0)[rolling]
            h = 1e-3  # toes stay level while the sole rolls, then go on with its speed and straighten
            around = clamped_curve(knots, values, fall.off + np.array([-h, 0.0, h]), drop)
            slope = (around[2] - around[0]) / (2 * h), float(np.diff(around, n=2)[0]) / h**2
            loose = away & (t > fall.off)
            offset = decay(around[1:2], np.array([slope[0]]), gait.level_time, np.array([slope[1]]))
            self.toes[side, loose] = np.maximum(offset(t[loose] - fall.off)[:, 0], 0.0)
        rolled, height = sole.stand(pitch)
        up = self._eased(falls, height + clear)
        forward = np.column_stack([np.cos(yaw), np.sin(yaw)])
        self.foot_positions[side] = np.column_stack([xy + rolled[:, None] * forward, up])
        self.yaw[side], self.pitch[side] = yaw, pitch
        self.contact[side] = np.select([air, pitch < -1e-4, pitch > 1e-4], [AIR, HEEL, TOE], FLAT)

    def _eased(self, falls: Sequence[_Footfall], up: Array) -> Array:
        """Heights (n,) of a foot whose lowest point passes from toe to heel in the air without a jolt."""
        soft, share = smooth(up, _EASE / (self.times[1] - self.times[0])), np.zeros(len(up))
        for fall, after in itertools.pairwise(falls):
            if np.isfinite(fall.off):
                u = (self.times - fall.off) / (after.strike - fall.off)
                share += minimum_jerk(u / _EASE_IN) * minimum_jerk((1 - u) / _EASE_OUT)
        return up + share * (soft - up)

    def _swing(self, side: int, fall: _Footfall, after: _Footfall, s: Array) -> tuple[Array, Array]:
        """From print to print by a cosine, round the standing foot where the chord comes too near it."""
        share = 0.5 - 0.5 * np.cos(np.pi * (s - self.gait.late * s * (1 - s)))
        share = share - self.gait.arrive * s**5 * (1 - s) - self.gait.depart * s**2 * (1 - s) ** 4
        start = np.array([fall.print.x, fall.print.y])
        displacement = np.array([after.print.x, after.print.y]) - start
        standing = (f for f in self.falls[1 - side] if f.strike <= fall.off + 1e-9)
        other = max(standing, key=lambda f: f.strike).print
        beside = np.array([-np.sin(other.yaw), np.cos(other.yaw)]) * (1 - 2 * side)
        to = np.array([other.x, other.y])
        u = float(np.clip((to - start) @ displacement / max(displacement @ displacement, 1e-9), 0.0, 1.0))
        bulge = max(0.0, self.gait.gap - float((start + u * displacement - to) @ beside))
        out = start + displacement * share[:, None]
        out += beside * (bulge * 64 * (share * (1 - share)) ** 3)[:, None]
        return out, fall.print.yaw + (after.print.yaw - fall.print.yaw) * share

    def _phases(self) -> tuple[Array, Array]:
        """Phase of the gait in cycles (left strikes are whole numbers), and how much it walks, 0 to 1."""
        strikes, span = np.array(self.strikes), 4 * self.gait.time
        phase = 0.5 * (np.arange(len(strikes)) - self.prints[2].side)
        knots = np.concatenate([[strikes[0] - span], strikes, [strikes[-1] + span]])
        lin = np.interp(self.times, knots, np.concatenate([[phase[0] - 2], phase, [phase[-1] + 2]]))
        going = minimum_jerk((self.times - _LEAN + 0.2) / 0.7)
        return lin, going * (1 - minimum_jerk((self.times - strikes[-1] + 0.2) / 0.7))

    def trunk(self) -> tuple[Array, Array, Array]:
        """Rotations of pelvis and chest (n, 3, 3), and the heading (n,)."""
        heading = self.yaw.mean(axis=0)
        angle, size = 2 * np.pi * self.phase, self.going * self.gait.swing_deg / 15.0
        yaw = np.radians(self.gait.turn_deg) * size * np.cos(angle)
        lean = np.radians(4.0) * size * np.sin(angle - 0.35)
        tilt, bow = np.radians(4.0) * self.going, np.radians(self.gait.lean_deg) * self.going
        pelvis = axis_rotations("z", heading - yaw) @ axis_rotations("x", lean) @ axis_rotations("y", tilt)
        chest = (
            axis_rotations("z", heading + 0.8 * yaw)
            @ axis_rotations("x", 0.15 * lean)
            @ axis_rotations("y", bow)
        )
        return pelvis, chest, heading

    def _leaving(self, side: int) -> Array:
        """(n,) how near in time a foot is to leaving the floor, 0 to 1."""
        offs = [fall.off for fall in self.falls[side] if np.isfinite(fall.off)]
        away = np.abs(self.times[:, None] - np.array([*offs, np.inf])).min(axis=1)
        return minimum_jerk(1.0 - away / _LEAVING)

    def pelvis_height(self, pelvis: Array, pelvis_xy: Array, knee_deg: float) -> Array:
        """The highest pelvis, at (n, 2), that leaves the knees bent by that, as one wave a step."""
        gait, t = self.gait, self.times
        top = np.full(len(t), np.inf)
        for side, name in enumerate(SIDES):
            foot = self.figure.feet[name]
            bent = np.radians(knee_deg + max(0.0, _LEAVING_DEG - knee_deg) * self._leaving(side))
            leg = foot.thigh**2 + foot.shank**2 + 2 * foot.thigh * foot.shank * np.cos(bent)
            matrix = axis_rotations("z", self.yaw[side]) @ axis_rotations("y", self.pitch[side])
            ankle, hip = self.foot_positions[side] + matrix @ foot.ankle, pelvis @ foot.hip
            flat = ((ankle[:, :2] - pelvis_xy - hip[:, :2]) ** 2).sum(axis=1)
            top = np.minimum(top, ankle[:, 2] - hip[:, 2] + np.sqrt(np.maximum(leg - flat, 0.3)))
        stand = float(self.figure.pose(self.figure.home, self.figure.pelvis)[0][2])
        top = np.minimum(top, stand)
        dips = np.array(self.strikes) + gait.dip
        dips = np.concatenate([[dips[0] - gait.time], dips])

        def wave(at: Array, k: int) -> Array:
            w = 0.5 - 0.5 * np.cos(2 * np.pi * (at - dips[k]) / gait.time)
            return np.asarray(gait.bob * w * (1 + gait.broad * (1 - w)))

        low = []
        for k, dip in enumerate(dips):
            near = np.abs(t - dip) <= 0.6 * gait.time
            low.append(float((top[near] - wave(t[near], k)).min()))
        knots = np.concatenate([[-1.0, min(0.0, dips[0] - 0.3)], dips, [dips[-1] + 0.9, dips[-1] + 5]])
        base = monotone_curve(knots, np.array([top[0], top[0], *low, top[0], top[0]]), t)
        rate = 1.0 / (t[1] - t[0])
        z = smooth(base, 0.12 * rate) + self.going * wave(t, 0)
        over = np.maximum(0.0, z - top)
        reach = int(0.1 * rate)
        padded = np.pad(over, reach, mode="edge")
        widest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
        return np.asarray(z - smooth(widest, 0.06 * rate))


def _arc(s: Array, rising: float, falling: float) -> Array:
    """From 0 up to 1 and down to 0 over s of 0 to 1, by a power at each end."""
    top = rising / (rising + falling)
    return np.asarray((s / top) ** rising * ((1 - s) / (1 - top)) ** falling)


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk from rest to rest."""

    start: Array  # (nq,) where it began
    gait: Gait
    frames: Frames  # and how well their hard rows hold
    contact: NDArray[np.int64]  # (n, 2) AIR, HEEL, FLAT or TOE of each foot
    zmp: Array  # (n, 2) planned zero-moment point
    prints: tuple[Footprint, ...]  # the first two where the feet stood
    strikes: tuple[float, ...]  # times of the heel strikes, s
    falls: tuple[tuple[tuple[Footprint, float, float], ...], ...]  # print, strike, off, by side


# The spine's two pitches are all but the same axis: against each other they rotate far for a little roll.
_STIFF = {"*": 0.02, "torso*": 3.0, "pelvis*": 3.0, "torso_pitch": 10.0, "pelvis_pitch": 10.0, "head*": 3.0}
_STIFF |= {f"*{part}*": 3.0 for part in ("shoulder", "elbow", "wrist", "clavicle")} | {"*toe*": 1e5}


def walk_slices(figure: Figure, q: Array, prints: Sequence[Footprint], gait: Gait = WALK) -> Slices[Walk]:
    """A whole walk over ``prints``, from ``q``, which stands on the first two, to rest on the last two.

    Args:
        figure: Who walks.
        q: (nq,) standing still.
        prints: Footsteps, alternating sides after the first two.
        gait: How.
    """
    yield  # the plan, which takes as long as two of the other slices, comes second of a frame's two
    plan = _Plan(figure, prints, gait, figure.center(q)[:2])
    yield
    shift = np.zeros_like(plan.com)
    pelvis, _, heading = plan.trunk()
    offset = -0.012 * axis_rotations("z", heading)[:, :2, 0]
    frames: Frames | None = None
    # The first passes learn where the pelvis is beside the centre of mass.
    knees = [22.0, gait.knee_deg + 4.0] + [gait.knee_deg] * (1 + _CORRECTIONS)
    for k, knee in enumerate(knees):
        if frames is not None and k > 2:
            points, force = yield from zero_moment_slices(figure, frames.q)
            error = smooth(np.clip(points - plan.zmp, -0.12, 0.12), 0.02 / DT)
            error[:2], error[-2:] = 0.0, 0.0
            # (g + z'') / z: the body's own acceleration counts, up to a third of g.
            share = smooth(np.clip(force / (figure.mass * GRAVITY), 0.5, 1.5), 0.02 / DT)
            shift = shift + compensate(error, plan.omega**2 * share)
        height = plan.pelvis_height(pelvis, plan.com + shift + offset, knee)
        frames = yield from _solve(plan, q, height, shift)
        offset = figure.poses(frames.q, figure.pelvis)[0][:, :2] - plan.com - shift
    if frames is None:
        raise RuntimeError("no pass of the walk was solved")
    falls = tuple(tuple((f.print, f.strike, f.off) for f in side) for side in plan.falls)
    contact, strikes = plan.contact.T.copy(), tuple(plan.strikes)
    return Walk(q, gait, frames, contact, plan.zmp, tuple(prints), strikes, falls)


walk = at_once(walk_slices)


def _solve(plan: _Plan, q: Array, height: Array, shift: Array) -> Slices[Frames]:
    figure, go = plan.figure, plan.going
    rows = FrameRows(figure, len(plan.times))
    matrices = axis_rotations("z", plan.yaw) @ axis_rotations("y", plan.pitch)
    rows.feet({side: (plan.foot_positions[k], matrices[k]) for k, side in enumerate(SIDES)})
    rows.center(plan.com + shift, axes="xy")
    pelvis, chest, heading = plan.trunk()
    # What it does not come from at once: the pose it begins in goes over into the walk.
    start = minimum_jerk(plan.times / 0.5)
    rows.orientation(figure.pelvis, pelvis, 60.0 * start + 1e-3)
    rows.orientation(figure.trunk, chest, 60.0 * start + 1e-3)
    here = float(figure.pose(q, figure.pelvis)[0][2])
    z = here + (height - here) * start
    rows.position(figure.pelvis, np.column_stack([0 * z, 0 * z, z]), 2000.0, axes="z")
    if figure.gaze is not None:
        eyes, matrix = figure.pose(q, figure.gaze)
        before = np.column_stack([plan.com, np.full(len(z), eyes[2])]) + 3.0 * matrix[:, 0]
        forward = 3.0 * axis_rotations("z", heading)[:, :, 0]
        forward += np.column_stack([plan.com, np.full(len(z), eyes[2] - 0.2)])
        seen = before + (forward - before) * minimum_jerk(plan.times / 0.8)[:, None]
        rows.aim(seen, 5.0)
    posture = _posture(plan, q, start, go)
    return (yield from rows.slices(posture, figure.stiffnesses(_STIFF), q))


def _posture(plan: _Plan, q: Array, start: Array, go: Array) -> Array:
    """(n, nq): from the pose it stood in to home with swinging arms and level toes."""
    figure = plan.figure
    swing = np.radians(plan.gait.swing_deg)
    # An arm is foremost when the other side's heel strikes.
    wave = np.cos(2 * np.pi * plan.phase + 0.15)
    moves: dict[str, Array] = {}
    for name, mine in zip(SIDES, (-wave, wave), strict=True):
        moves[f"{name}_shoulder_pitch"] = go * (swing * mine - 0.7 * swing)
        moves[f"{name}_elbow_pitch"] = go * (1.3 * swing + 0.77 * swing * mine)
    swung = figure.home + figure.posture(moves, np.zeros((len(wave), figure.robot.nq)))
    postures = q + (swung - q) * start[:, None]
    for side, name in enumerate(SIDES):
        toes = figure.feet[name].toes
        if toes is not None:
            postures[:, toes[0]] = plan.toes[side]
    return np.asarray(postures)
