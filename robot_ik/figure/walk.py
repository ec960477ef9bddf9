"""Walking: feet that roll, the centre of mass above them, and frames of the whole body.

A foot rolls on its true sole (``soles.Sole``), so that it neither slips nor sinks by construction.
In the air its lowest point follows the same curve with a clearance. The centre of mass is planned
over a zero-moment point under the feet and corrected by the dynamics of the whole body
(``balance``). The pelvis is as high as the legs allow. Human data: ``docs/theory/figure.md``.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.balance import compensate, plan_center, zero_moment_points
from robot_ik.figure.curves import clamped_curve, decay, monotone_curve, smooth
from robot_ik.figure.figure import DT, GRAVITY, SIDES, Figure
from robot_ik.figure.footprints import Footprint
from robot_ik.figure.frames import FrameRows, Frames
from robot_ik.figure.gait import AIR, FLAT, HEEL, TOE, WALK, WALKING, Gait
from robot_ik.geometry import axis_rotations
from robot_ik.motion.timing import minimum_jerk
from robot_ik.ports import Array

_STIFFNESS = {
    "*": 0.02,
    "torso*": 3.0,
    "pelvis*": 3.0,
    # The two pitches of the spine have nearly the same axis. Without this weight they rotate far
    # against each other for a small roll.
    "torso_pitch": 10.0,
    "pelvis_pitch": 10.0,
    "head*": 3.0,
    "*shoulder*": 3.0,
    "*elbow*": 3.0,
    "*wrist*": 3.0,
    "*clavicle*": 3.0,
    "*toe*": 1e5,
}
"""Weights of the posture in a walk, by patterns of joint names."""

_FLAT_PITCH = 1e-4
"""A sole with a smaller pitch is flat, rad."""

_TOE_STEP = 1e-3
"""Time step of the derivatives of the toes' bend at toe off, s."""

_STOOD = -9.0
"""Time of the strike of a foot that stands at the start, s."""


@dataclass
class _Footfall:
    """One stance phase of a foot.

    Attributes:
        print: Footprint of the foot.
        strike: Time of the heel strike, s.
        off: Time of toe off, s. Infinite for the last footfall.
        first: Whether the phase is the first of the foot.
        last: Whether it is the last of the foot.
        share: Length of the step before it, as a share of a whole step.
    """

    print: Footprint
    strike: float
    off: float
    first: bool
    last: bool
    share: float

    @property
    def strike_share(self) -> float:
        """Pitch at the strike as a share of that of a whole step. A short step lands flatter."""
        return min(WALKING.last_strike if self.last else 1.0, self.share)

    def off_share(self, following: _Footfall) -> float:
        """Return the pitch at toe off for the following footfall, as a share of a whole step."""
        largest = WALKING.first_off if self.first else 1.0
        return min(largest, WALKING.min_off + (1.0 - WALKING.min_off) * following.share)


class _Plan:
    """Times and positions of feet, zero-moment point and centre of mass, for all frames.

    Args:
        figure: The figure.
        prints: Footsteps, alternating sides after the first two.
        gait: Parameters of the gait.
        x: (2,) centre of mass at the start.
    """

    def __init__(self, figure: Figure, prints: Sequence[Footprint], gait: Gait, x: Array) -> None:
        self.figure = figure
        self.prints = prints
        self.gait = gait
        self.lifts = [WALKING.begin + k * gait.time for k in range(len(prints) - 2)]
        self.strikes = [lift + gait.time - gait.double for lift in self.lifts]
        self.end = self.strikes[-1] + WALKING.settle
        self.times = np.arange(1, int(self.end / DT) + 1, dtype=np.float64) * DT
        self.omega = float(np.sqrt(GRAVITY / figure.center(figure.home)[2]))
        self.falls = self._footfalls()
        self.com, self.zmp = plan_center(self._pressure_nodes(), x, self.omega, self.times)

        count = len(self.times)
        self.foot_positions = np.empty((2, count, 3))
        self.yaw = np.empty((2, count))
        self.pitch = np.empty((2, count))
        self.toes = np.zeros((2, count))
        self.contact = np.full((2, count), FLAT)
        for side in (0, 1):
            self._plan_foot(side)
        self.phase, self.activity = self._phases()

    @property
    def cycle(self) -> float:
        """Time of two steps, s."""
        return 2 * self.gait.time

    @property
    def rise_time(self) -> float:
        """Time from the rise of the heel until toe off, s."""
        return (WALKING.stance - self.gait.rise) * 2 * self.gait.time

    def _footfalls(self) -> tuple[list[_Footfall], list[_Footfall]]:
        """Return the footfalls of the left and of the right foot."""
        falls: tuple[list[_Footfall], list[_Footfall]] = ([], [])
        prints = self.prints
        for k, footprint in enumerate(prints):
            of_side = falls[footprint.side]
            previous = of_side[-1].print if of_side else footprint
            if of_side:
                of_side[-1].off = self.lifts[k - 2]
            way = float(np.hypot(footprint.x - previous.x, footprint.y - previous.y))
            of_side.append(
                _Footfall(
                    print=footprint,
                    strike=self.strikes[k - 2] if k > 1 else _STOOD,
                    off=np.inf,
                    first=k < 2,
                    last=k >= len(prints) - 2,
                    share=min(1.0, way / (2 * self.gait.length)),
                )
            )
        return falls

    def _pressure_nodes(self) -> list[tuple[float, Array]]:
        """Return nodes of the zero-moment point.

        It moves along the sole in single support and across in double support.
        """
        gait = self.gait
        prints = self.prints
        stand = WALKING.stand_pressure
        standing = next(p for p in prints[:2] if p.side != prints[2].side)

        # It is above the standing foot before the heel of the other leaves the floor.
        nodes = [
            (0.0, standing.ahead(stand)),
            (WALKING.begin - self.rise_time, standing.ahead(stand)),
        ]
        for k in range(len(prints) - 2):
            support = prints[k + 1] if k else standing
            is_last = k == len(prints) - 3
            start = stand if k == 0 else gait.pressure_start
            end = WALKING.last_pressure if is_last else gait.pressure_end
            nodes.append((self.lifts[k], support.ahead(start)))
            if not is_last:
                # It is at the toes when the heel leaves the floor.
                heel_off = self.lifts[k + 1] - self.rise_time
                if self.lifts[k] + 0.02 < heel_off < self.strikes[k] - 0.02:
                    nodes.append((heel_off, support.ahead(end)))
            nodes.append((self.strikes[k], support.ahead(end)))
        middle = (prints[-1].ahead(stand) + prints[-2].ahead(stand)) / 2
        nodes.append((self.strikes[-1] + WALKING.stop_time, middle))
        nodes.append((self.end, middle))
        return nodes

    def _plan_foot(self, side: int) -> None:
        """Write position, yaw, pitch, bend of the toes and contact of one foot at all times."""
        gait = self.gait
        t = self.times
        falls = self.falls[side]
        strike_pitch = -np.radians(gait.strike_deg)
        off_pitch = np.radians(gait.off_deg)
        xy = np.empty((len(t), 2))
        yaw = np.empty(len(t))
        pitch = np.zeros(len(t))
        clearance = np.zeros(len(t))
        in_air = np.zeros(len(t), dtype=bool)
        for i, fall in enumerate(falls):
            after_strike = t >= fall.strike
            xy[after_strike] = (fall.print.x, fall.print.y)
            yaw[after_strike] = fall.print.yaw
            pitch[after_strike] = 0.0
            if not fall.first:
                # The sole falls from its pitch at the strike until it is flat.
                flat_time = fall.strike + gait.flat * 2 * gait.time
                u = np.clip((t - fall.strike) / (flat_time - fall.strike), 0.0, 1.0)
                share = 1 - minimum_jerk(u) - gait.drop * u * (1 - u) ** 3 * (1 + 3 * u)
                pitch[after_strike] = (strike_pitch * fall.strike_share * share)[after_strike]
            if not np.isfinite(fall.off):
                continue

            # The sole rolls over the toes, swings, and comes to its pitch at the next strike.
            following = falls[i + 1]
            rise = fall.off - self.rise_time
            swing = following.strike - fall.off
            top = off_pitch * fall.off_share(following)
            knots = np.array(
                [
                    rise,
                    fall.off,
                    fall.off + WALKING.toe_turn * swing,
                    fall.off + gait.level_share * swing,
                    following.strike,
                ]
            )
            values = np.array(
                [
                    0.0,
                    top,
                    top * gait.peak,
                    gait.level_pitch * top,
                    strike_pitch * following.strike_share,
                ]
            )
            end_slope = -values[-1] * gait.drop / (gait.flat * 2 * gait.time)
            rolling = (t > rise) & (t < following.strike)
            pitch[rolling] = clamped_curve(knots, values, t[rolling], end_slope)
            swinging = (t >= fall.off) & (t < following.strike)
            s = (t[swinging] - fall.off) / swing
            xy[swinging], yaw[swinging] = self._swing(side, fall, following, s)
            clearance[swinging] = gait.lift * _arc(s, gait.lift_power, gait.fall_power)
            in_air[swinging] = True

            # The toes stay level while the sole rolls. Then they continue with its speed and
            # straighten.
            self.toes[side, rolling] = np.maximum(pitch, 0.0)[rolling]
            h = _TOE_STEP
            around = clamped_curve(knots, values, fall.off + np.array([-h, 0.0, h]), end_slope)
            speed = (around[2] - around[0]) / (2 * h)
            acceleration = float(np.diff(around, n=2)[0]) / h**2
            offset = decay(
                around[1:2], np.array([speed]), gait.level_time, np.array([acceleration])
            )
            loose = swinging & (t > fall.off)
            self.toes[side, loose] = np.maximum(offset(t[loose] - fall.off)[:, 0], 0.0)

        rolled, height = self.figure.feet[SIDES[side]].sole.stand(pitch)
        z = self._without_jolts(falls, height + clearance)
        forward = np.column_stack([np.cos(yaw), np.sin(yaw)])
        self.foot_positions[side] = np.column_stack([xy + rolled[:, None] * forward, z])
        self.yaw[side] = yaw
        self.pitch[side] = pitch
        self.contact[side] = np.select(
            [in_air, pitch < -_FLAT_PITCH, pitch > _FLAT_PITCH], [AIR, HEEL, TOE], FLAT
        )

    def _without_jolts(self, falls: Sequence[_Footfall], z: Array) -> Array:
        """Return heights (n,) of a foot, smoothed in the air.

        The lowest point of a foot passes from toe to heel in the air, which makes a jolt.
        """
        smoothed = smooth(z, WALKING.soften / (self.times[1] - self.times[0]))
        share = np.zeros(len(z))
        for fall, following in itertools.pairwise(falls):
            if np.isfinite(fall.off):
                u = (self.times - fall.off) / (following.strike - fall.off)
                share += minimum_jerk(u / WALKING.soften_in) * minimum_jerk(
                    (1 - u) / WALKING.soften_out
                )
        return z + share * (smoothed - z)

    def _swing(
        self, side: int, fall: _Footfall, following: _Footfall, s: Array
    ) -> tuple[Array, Array]:
        """Return positions (k, 2) and yaws (k,) of a swinging foot at shares (k,) of its swing.

        It goes from print to print by a cosine, and around the standing foot where the straight
        path passes too near.
        """
        gait = self.gait
        share = 0.5 - 0.5 * np.cos(np.pi * (s - gait.late * s * (1 - s)))
        share = share - gait.arrive * s**5 * (1 - s) - gait.depart * s**2 * (1 - s) ** 4
        start = np.array([fall.print.x, fall.print.y])
        displacement = np.array([following.print.x, following.print.y]) - start
        standing = (f for f in self.falls[1 - side] if f.strike <= fall.off + 1e-9)
        other = max(standing, key=lambda f: f.strike).print
        aside = np.array([-np.sin(other.yaw), np.cos(other.yaw)]) * (1 - 2 * side)
        other_xy = np.array([other.x, other.y])
        length2 = max(displacement @ displacement, 1e-9)
        u = float(np.clip((other_xy - start) @ displacement / length2, 0.0, 1.0))
        distance = float((start + u * displacement - other_xy) @ aside)
        bulge = max(0.0, gait.gap - distance)
        xy = start + displacement * share[:, None]
        xy += aside * (bulge * 64 * (share * (1 - share)) ** 3)[:, None]
        return xy, fall.print.yaw + (following.print.yaw - fall.print.yaw) * share

    def _phases(self) -> tuple[Array, Array]:
        """Return the phase (n,) in cycles and the activity (n,) between 0 and 1.

        Left strikes have whole phases. The activity is 0 at rest and 1 while the figure walks.
        """
        strikes = np.array(self.strikes)
        span = 4 * self.gait.time
        phase = 0.5 * (np.arange(len(strikes)) - self.prints[2].side)
        knots = np.concatenate([[strikes[0] - span], strikes, [strikes[-1] + span]])
        phases = np.concatenate([[phase[0] - 2], phase, [phase[-1] + 2]])
        begins = minimum_jerk((self.times - WALKING.begin + 0.2) / 0.7)
        ends = minimum_jerk((self.times - strikes[-1] + 0.2) / 0.7)
        return np.interp(self.times, knots, phases), begins * (1 - ends)

    def trunk(self) -> tuple[Array, Array, Array]:
        """Return rotations of pelvis and chest (n, 3, 3), and the heading (n,)."""
        gait = self.gait
        heading = self.yaw.mean(axis=0)
        angle = 2 * np.pi * self.phase
        size = self.activity * gait.swing_deg / 15.0
        yaw = np.radians(gait.turn_deg) * size * np.cos(angle)
        sway = np.radians(WALKING.sway_deg) * size * np.sin(angle - 0.35)
        tilt = np.radians(WALKING.tilt_deg) * self.activity
        lean = np.radians(gait.lean_deg) * self.activity
        pelvis = (
            axis_rotations("z", heading - yaw)
            @ axis_rotations("x", sway)
            @ axis_rotations("y", tilt)
        )
        chest = (
            axis_rotations("z", heading + 0.8 * yaw)
            @ axis_rotations("x", 0.15 * sway)
            @ axis_rotations("y", lean)
        )
        return pelvis, chest, heading

    def _nearness_to_toe_off(self, side: int) -> Array:
        """Return how near in time (n,) a foot is to toe off, between 0 and 1."""
        offs = [fall.off for fall in self.falls[side] if np.isfinite(fall.off)]
        gaps = np.abs(self.times[:, None] - np.array([*offs, np.inf])).min(axis=1)
        return minimum_jerk(1.0 - gaps / WALKING.leaving_time)

    def pelvis_height(self, pelvis: Array, pelvis_xy: Array, knee_deg: float) -> Array:
        """Return the largest heights (n,) of the pelvis at which the knees keep a bend.

        The heights follow one wave per step.

        Args:
            pelvis: (n, 3, 3) rotations of the pelvis.
            pelvis_xy: (n, 2) positions of the pelvis.
            knee_deg: Smallest bend of the knees, degrees.
        """
        gait = self.gait
        t = self.times
        top = self._leg_height(pelvis, pelvis_xy, knee_deg)
        stand = float(self.figure.pose(self.figure.home, self.figure.pelvis)[0][2])
        top = np.minimum(top, stand)
        dips = np.array(self.strikes) + gait.dip
        dips = np.concatenate([[dips[0] - gait.time], dips])

        def wave(times: Array, k: int) -> Array:
            w = 0.5 - 0.5 * np.cos(2 * np.pi * (times - dips[k]) / gait.time)
            return np.asarray(gait.bob * w * (1 + gait.broad * (1 - w)))

        # Under the wave lies a slow curve through the largest possible heights of the dips.
        lows = []
        for k, dip in enumerate(dips):
            near = np.abs(t - dip) <= 0.6 * gait.time
            lows.append(float((top[near] - wave(t[near], k)).min()))
        begin = [-1.0, min(0.0, dips[0] - 0.3)]
        knots = np.concatenate([begin, dips, [dips[-1] + 0.9, dips[-1] + 5]])
        base = monotone_curve(knots, np.array([top[0], top[0], *lows, top[0], top[0]]), t)
        rate = 1.0 / (t[1] - t[0])
        z = smooth(base, 0.12 * rate) + self.activity * wave(t, 0)

        # Where the sum is still too high it is lowered smoothly.
        excess = np.maximum(0.0, z - top)
        radius = int(0.1 * rate)
        padded = np.pad(excess, radius, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * radius + 1)
        return np.asarray(z - smooth(windows.max(axis=1), 0.06 * rate))

    def _leg_height(self, pelvis: Array, pelvis_xy: Array, knee_deg: float) -> Array:
        """Return the heights (n,) of the pelvis that both legs allow."""
        top = np.full(len(self.times), np.inf)
        for side, name in enumerate(SIDES):
            foot = self.figure.feet[name]
            extra_deg = max(0.0, WALKING.leaving_deg - knee_deg)
            bend = np.radians(knee_deg + extra_deg * self._nearness_to_toe_off(side))
            leg2 = foot.thigh**2 + foot.shank**2 + 2 * foot.thigh * foot.shank * np.cos(bend)
            rotation = axis_rotations("z", self.yaw[side]) @ axis_rotations("y", self.pitch[side])
            ankle = self.foot_positions[side] + rotation @ foot.ankle
            hip = pelvis @ foot.hip
            across2 = ((ankle[:, :2] - pelvis_xy - hip[:, :2]) ** 2).sum(axis=1)
            reach = np.sqrt(np.maximum(leg2 - across2, 0.3))
            top = np.minimum(top, ankle[:, 2] - hip[:, 2] + reach)
        return top


def _arc(s: Array, rising: float, falling: float) -> Array:
    """Return a curve from 0 up to 1 and down to 0 over s from 0 to 1, by a power on each side."""
    top = rising / (rising + falling)
    return np.asarray((s / top) ** rising * ((1 - s) / (1 - top)) ** falling)


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk from rest to rest.

    Attributes:
        start: (nq,) first pose.
        gait: Parameters of the gait.
        frames: Frames, and the errors of their hard rows.
        contact: (n, 2) AIR, HEEL, FLAT or TOE of each foot.
        zmp: (n, 2) planned zero-moment point.
        prints: Footprints. The feet stand on the first two at the start.
        strikes: Times of the heel strikes, s.
        falls: By side, footprint, time of the strike and time of toe off, s.
    """

    start: Array
    gait: Gait
    frames: Frames
    contact: NDArray[np.int64]
    zmp: Array
    prints: tuple[Footprint, ...]
    strikes: tuple[float, ...]
    falls: tuple[tuple[tuple[Footprint, float, float], ...], ...]


def walk(figure: Figure, q: Array, prints: Sequence[Footprint], gait: Gait = WALK) -> Walk:
    """Return a walk over footprints, to rest on the last two.

    Args:
        figure: The figure.
        q: (nq,) standing still on the first two footprints.
        prints: Footsteps, alternating sides after the first two.
        gait: Parameters of the gait.
    """
    plan = _Plan(figure, prints, gait, figure.center(q)[:2])
    shift = np.zeros_like(plan.com)
    pelvis, _, heading = plan.trunk()
    offset = -WALKING.pelvis_behind * axis_rotations("z", heading)[:, :2, 0]

    # The first two passes determine the position of the pelvis relative to the centre of mass.
    height = plan.pelvis_height(pelvis, plan.com + shift + offset, WALKING.learning_knee_deg)
    frames = _solve(plan, q, height, shift)
    offset = figure.poses(frames.q, figure.pelvis)[0][:, :2] - plan.com - shift
    knee_deg = gait.knee_deg + WALKING.learning_extra_deg
    height = plan.pelvis_height(pelvis, plan.com + shift + offset, knee_deg)
    frames = _solve(plan, q, height, shift)

    for round_number in range(1 + WALKING.corrections):
        offset = figure.poses(frames.q, figure.pelvis)[0][:, :2] - plan.com - shift
        if round_number > 0:
            shift = shift + _correction(plan, frames.q)
        height = plan.pelvis_height(pelvis, plan.com + shift + offset, gait.knee_deg)
        frames = _solve(plan, q, height, shift)
    return Walk(
        start=q,
        gait=gait,
        frames=frames,
        contact=plan.contact.T.copy(),
        zmp=plan.zmp,
        prints=tuple(prints),
        strikes=tuple(plan.strikes),
        falls=tuple(
            tuple((fall.print, fall.strike, fall.off) for fall in falls) for falls in plan.falls
        ),
    )


def _correction(plan: _Plan, q: Array) -> Array:
    """Return the shift (n, 2) of the centre of mass that corrects the zero-moment point."""
    figure = plan.figure
    points, force = zero_moment_points(figure, q)
    largest = WALKING.largest_error
    error = smooth(np.clip(points - plan.zmp, -largest, largest), WALKING.error_time / DT)
    error[:2] = 0.0
    error[-2:] = 0.0

    # ω² is (g + z'') / z. The vertical acceleration counts up to half of g.
    weights = np.clip(force / (figure.mass * GRAVITY), 0.5, 1.5)
    share = smooth(weights, WALKING.error_time / DT)
    return compensate(error, plan.omega**2 * share)


def _solve(plan: _Plan, q: Array, height: Array, shift: Array) -> Frames:
    """Return the frames of a plan.

    Args:
        plan: The plan.
        q: (nq,) first pose.
        height: (n,) heights of the pelvis.
        shift: (n, 2) shift of the planned centre of mass.
    """
    figure = plan.figure
    t = plan.times
    rows = FrameRows(figure, len(t))
    rotations = axis_rotations("z", plan.yaw) @ axis_rotations("y", plan.pitch)
    rows.feet({side: (plan.foot_positions[k], rotations[k]) for k, side in enumerate(SIDES)})
    rows.center(plan.com + shift, axes="xy")

    # The first pose changes gradually into that of the walk.
    begin = minimum_jerk(t / 0.5)
    pelvis, chest, heading = plan.trunk()
    rows.orientation(figure.pelvis, pelvis, 60.0 * begin + 1e-3)
    rows.orientation(figure.trunk, chest, 60.0 * begin + 1e-3)
    first_height = float(figure.pose(q, figure.pelvis)[0][2])
    z = first_height + (height - first_height) * begin
    rows.position(figure.pelvis, np.column_stack([0 * z, 0 * z, z]), 2000.0, axes="z")
    if figure.gaze is not None:
        eyes, rotation = figure.pose(q, figure.gaze)
        distance = WALKING.gaze_distance
        eye_height = np.full(len(t), eyes[2])
        first_target = np.column_stack([plan.com, eye_height]) + distance * rotation[:, 0]
        target = distance * axis_rotations("z", heading)[:, :, 0]
        target += np.column_stack([plan.com, eye_height - WALKING.gaze_drop])
        share = minimum_jerk(t / 0.8)[:, None]
        rows.aim(first_target + (target - first_target) * share, 5.0)
    return rows.solve(_posture(plan, q, begin), figure.stiffnesses(_STIFFNESS), q)


def _posture(plan: _Plan, q: Array, begin: Array) -> Array:
    """Return postures (n, nq): from the first pose to home, with swinging arms.

    Args:
        plan: The plan.
        q: (nq,) first pose.
        begin: (n,) share of the posture of the walk, between 0 and 1.
    """
    figure = plan.figure
    swing = np.radians(plan.gait.swing_deg)
    activity = plan.activity

    # An arm is in front when the heel of the other side strikes.
    wave = np.cos(2 * np.pi * plan.phase + 0.15)
    moves: dict[str, Array] = {}
    for name, side_wave in zip(SIDES, (-wave, wave), strict=True):
        moves[f"{name}_shoulder_pitch"] = activity * (swing * side_wave - 0.7 * swing)
        moves[f"{name}_elbow_pitch"] = activity * (1.3 * swing + 0.77 * swing * side_wave)
    swung = figure.home + figure.posture(moves, np.zeros((len(wave), figure.robot.nq)))
    postures = q + (swung - q) * begin[:, None]
    for side, name in enumerate(SIDES):
        toes = figure.feet[name].toes
        if toes is not None:
            postures[:, toes[0]] = plan.toes[side]
    return np.asarray(postures)
