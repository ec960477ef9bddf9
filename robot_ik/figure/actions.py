"""Reach, bend and rest: each a run of frames with an exact end; and how one goes over into the next.

All are computed in the frame of the feet (``Figure.stance``) and put into the world at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.balance import compensate, decay, smooth, zero_moment_slices
from robot_ik.figure.figure import DT, GRAVITY, Figure, in_stance_frame
from robot_ik.figure.frames import FrameRows, Frames, Slices, at_once
from robot_ik.figure.gait import FLAT, Footprint, Walk, walk_slices
from robot_ik.figure.poses import REACH, STIFF, find_pose, support, touches_itself
from robot_ik.geometry import axis_rotations, matrix_to_quat, quat_to_matrix, rotation_exp, rotation_log
from robot_ik.motion.timing import minimum_jerk
from robot_ik.ports import Array

# Peak speed of a hand, m/s, reaching (Flash & Hogan 1985: 0.3-0.5 m in 0.5-0.8 s) and bending; least
# durations, s.
_REACH_SPEED, _BEND_SPEED, _LEAST = 1.6, 0.7, 0.45
# Fastest glance, rad/s (head rotations take 3 to 6, a usual value).
_GLANCE = 2.5
# Cosine of the trunk's lean up to which a hand goes straight to a ball: 15 degrees.
_UPRIGHT = 0.966
# A zero-moment point so far inside the soles, m, is let be; else the frames are corrected, so often.
_INSIDE, _ROUNDS = 0.005, 3
# Frames that lose balance or change a joint's speed by more than this, rad/s a frame, are planned again so
# much slower; those that touch the body with the elbow so much farther from it, rad; so often.
_ABRUPT, _SLOWER, _AWAY, _TRIES = 1.8, 1.35, 0.35, 4
# A hand that the posture leads is drawn to its ball from this share of the path on, so strongly.
_LATE, _CLOSE = 0.8, 300.0
# How long a hand stays at its ball, s.
_HOLD = 0.2
# Self-contact is checked in every so many frames.
_CHECK_EVERY = 2
# A motion that is left decays into the next in this time, s.
BLEND = 0.4


@dataclass(frozen=True, eq=False)
class Motion:
    """Frames of an action."""

    action: str  # ``stand``, ``reach``, ``bend``, ``jump``, ``walk`` or ``rest``
    q: Array  # (n, nq)
    contact: NDArray[np.int64]  # (n, 2) what each foot does: ``gait.AIR``, ``HEEL``, ``FLAT``, ``TOE``
    miss: Array  # (n,) largest miss of what must hold, m or rad
    zmp: Array  # (n, 2) planned zero-moment point
    free: NDArray[np.bool_]  # (n,) whether the motion may be left after this frame
    speeds: str = "daily"  # set of joint speed limits that it holds

    def __len__(self) -> int:
        return len(self.q)


def to_stance(figure: Figure, q: Array) -> tuple[Array, Array]:
    """``q`` seen from the middle between its feet, and that stance (x, y, heading)."""
    stance = figure.stance(q)
    x, y = -(axis_rotations("z", -stance[2])[:2, :2] @ stance[:2])
    return figure.placed(q, x, y, -stance[2]), stance


def placed_motion(figure: Figure, motion: Motion, stance: Array) -> Motion:
    """A motion of a figure at the origin, put where its stance is."""
    matrix = axis_rotations("z", float(stance[2]))
    q = np.array([figure.placed(row, *stance) for row in motion.q])
    return replace(motion, q=q, zmp=motion.zmp @ matrix[:2, :2].T + stance[:2])


def _standing(figure: Figure, action: str, frames: Frames, center: Array, stance: Array) -> Motion:
    """Frames seen from the feet, which stay flat where the stance is."""
    n = len(frames.q)
    motion = Motion(
        action, frames.q, np.full((n, 2), FLAT), frames.miss, np.broadcast_to(center, (n, 2)),
        np.ones(n, dtype=bool),
    )  # fmt: skip
    return placed_motion(figure, motion, stance)


def _gaze(figure: Figure, rows: FrameRows, q: Array, ball: Array, t: Array, within: float = 0.45) -> None:
    """The eyes go to the ball within that time, s; a target that jumps at once would snap the neck."""
    if figure.gaze is None:
        return
    eyes, matrix = figure.pose(q, figure.gaze)
    distance = max(float(np.linalg.norm(ball - eyes)), 0.1)
    forward, to = matrix[:, 0], (ball - eyes) / distance
    angle = float(np.arccos(np.clip(forward @ to, -1.0, 1.0)))
    s = minimum_jerk(t / max(within, glance_time(figure, q, ball)))[:, None]
    # Along the arc: half way between two points that are seen in opposite directions lies the head.
    bent = angle > 1e-3
    shares = (np.sin((1 - s) * angle), np.sin(s * angle)) if bent else (1 - s, s)
    arc = shares[0] * forward + shares[1] * to
    arc = arc / np.maximum(np.linalg.norm(arc, axis=1, keepdims=True), 1e-6)
    rows.aim((eyes + distance * arc) * (1 - s) + ball * s, 8.0)


def glance_time(figure: Figure, q: Array, ball: Array | None) -> float:
    """How long the eyes take to a ball, s: a motion that ends before would stop the neck."""
    if figure.gaze is None or ball is None:
        return 0.0
    eyes, matrix = figure.pose(q, figure.gaze)
    to = (ball - eyes) / max(float(np.linalg.norm(ball - eyes)), 0.1)
    return 1.875 * float(np.arccos(np.clip(matrix[:, 0] @ to, -1.0, 1.0))) / _GLANCE


def rest_slices(figure: Figure, q: Array, *, gaze_target: Array | None = None) -> Slices[Motion]:
    """Back to standing at ease, the feet where they are."""
    start, stance = to_stance(figure, q)
    difference = figure.robot.difference(start, figure.home)[6:]
    limit = np.minimum(0.6 * figure.speeds["daily"][6:], 2.5)
    least = max(_LEAST, 1.875 * float((np.abs(difference) / limit).max()))
    seen = None if gaze_target is None else in_stance_frame(stance, gaze_target)
    least = max(least, glance_time(figure, start, seen))

    def look(rows: FrameRows, t: Array, duration: float) -> None:
        if seen is not None:
            _gaze(figure, rows, start, seen, t)

    arms = tuple(figure.hands)
    way = _Way(figure, start, figure.home, 0.1, figure.stiffnesses(STIFF), 3.0, arms, look)
    frames = yield from way.fastest(least)
    return _standing(figure, "rest", frames, figure.center_at_home[:2], stance)


def _interpolated_rotation(start: Array, end: Array, s: Array) -> Array:
    """(n, 3, 3) from one rotation to another along the shortest arc."""
    vector = rotation_log(matrix_to_quat(end @ start.T))
    return np.array([quat_to_matrix(rotation_exp(vector * share)) @ start for share in s])


@dataclass(frozen=True, eq=False)
class _Way:
    """From a pose to another, the feet where they are."""

    figure: Figure
    start: Array  # (nq,) seen from the feet
    goal: Array  # (nq,) to which the posture, the centre of mass and the trunk are led
    hold: float  # how long it is held, s
    stiffness: Array  # (nv,) of the posture
    upright: float  # weight of the trunk's rotation
    arms: Sequence[str]  # whose elbows go away from a body that they touch
    # Adds further rows for frames at times (n,), s, of a motion that takes so long, s.
    add: Callable[[FrameRows, Array, float], None]

    def fastest(self, duration: float) -> Slices[Frames]:
        """In a duration, s, or the least that keeps balance and in which no bodies touch; or the best try."""
        best: Frames | None = None
        most, abduction = (False, False, -np.inf), 0.0
        for _ in range(_TRIES):
            frames, inside, steady = yield from self._try(duration, abduction)
            touching = touches_itself(self.figure, frames.q[::_CHECK_EVERY])
            good = not touching, steady, inside
            if best is None or good > most:
                best, most = frames, good
            if steady and not touching:
                break
            duration *= 1.0 if steady else _SLOWER
            abduction += _AWAY if touching else 0.0
        if best is None:
            raise RuntimeError("no duration was tried")
        return best

    def _try(self, duration: float, abduction: float) -> Slices[tuple[Frames, float, bool]]:
        """Frames whose zero-moment point, by the whole body's dynamics, is where the weight was led.

        And how far inside the soles that point stays, m, and whether it is slow enough.
        """
        figure, start, goal = self.figure, self.start, self.goal
        t = np.arange(1, round((duration + self.hold) / DT) + 1, dtype=np.float64) * DT
        s = minimum_jerk(t / duration)
        away = abduction * 16 * (s * (1 - s)) ** 2  # on the way, elbows from the body
        rolls = {f"{side}_shoulder_roll": away for side in self.arms}
        aside = figure.posture(rolls, np.zeros((len(s), figure.robot.nq)))
        posture = start + (goal - start) * s[:, None] + aside
        trunk = figure.pose(start, figure.trunk)[1], figure.pose(goal, figure.trunk)[1]
        here, there = figure.center(start)[:2], figure.center(goal)[:2]
        center = point = here + (there - here) * s[:, None]
        normal, offset = support(figure)
        omega2 = np.full(len(t), GRAVITY / figure.center_at_home[2])
        for left in reversed(range(_ROUNDS)):
            rows = FrameRows(figure, len(t))
            rows.feet(figure.feet_at(start))
            rows.center(center, axes="xy")
            rows.orientation(figure.trunk, _interpolated_rotation(*trunk, s), self.upright)
            self.add(rows, t, duration)
            frames = yield from rows.slices(posture, self.stiffness, start)
            found, _ = yield from zero_moment_slices(figure, frames.q)
            inside = float((found[1:-1] @ normal.T - offset).min())
            if inside >= _INSIDE or not left:
                break
            error = smooth(np.clip(found - point, -0.12, 0.12), 0.02 / DT)
            error[:2], error[-2:] = 0.0, 0.0
            center = center + compensate(error, omega2)
        change = float(np.abs(np.diff(frames.q[:, 7:], n=2, axis=0)).max()) / DT  # of a joint's speed
        yield
        return frames, inside, inside >= 0.0 and change <= _ABRUPT


def take_slices(
    figure: Figure, q: Array, ball: Array, arm: str, kind: str, *, end: Array | None = None
) -> Slices[Motion]:  # fmt: skip
    """The hand to a ball, a few milliseconds at a time.

    The end is solved for first, and the posture led there: a hand that must follow its line asks too much of
    the joints on the way; this one is drawn to it.

    Args:
        figure: Who.
        q: (nq,) where it begins.
        ball: (3,) in the world.
        arm: Which hand.
        kind: ``reach``: standing, along a nearly straight line of least jerk; ``bend``: hips back.
        end: (nq,) the pose at the ball, seen from the feet (``Abilities.pose``); default: searched for.
    """
    start, stance = to_stance(figure, q)
    ball = in_stance_frame(stance, np.asarray(ball, dtype=float))
    hand = figure.pose(start, figure.hands[arm])[0]
    goal = find_pose(figure, ball, arm, kind).q if end is None else end
    # A hand that is led along a line while the trunk leans far straightens elbow and knees on the way.
    upright = kind == REACH and figure.pose(goal, figure.trunk)[1][2, 2] > _UPRIGHT
    difference = figure.robot.difference(start, goal)[6:]
    limit = np.minimum(0.75 * figure.speeds["daily"][6:], np.inf if upright else 3.0)
    slowest = 1.875 * float((np.abs(difference) / limit).max())
    length = float(np.linalg.norm(ball - hand))

    def lead(rows: FrameRows, t: Array, duration: float) -> None:
        if upright:
            s = minimum_jerk(t / duration)
            rows.position(figure.hands[arm], hand + (ball - hand) * s[:, None], 30.0 * 10.0 ** (2 * s))
        else:  # the last millimetres
            last = minimum_jerk((t / duration - _LATE) / (1 - _LATE))
            rows.position(figure.hands[arm], ball, _CLOSE * last)
        _gaze(figure, rows, start, ball, t, within=0.6 if upright else 0.7 * duration)

    # Of a minimum-jerk path: its peak speed is 15/8 of the mean.
    straight = 1.875 * length / (_REACH_SPEED if upright else _BEND_SPEED)
    least = max(_LEAST, straight, slowest, glance_time(figure, start, ball))
    stiff = figure.stiffnesses(STIFF | {"*hip_pitch": 1.0, "*knee_pitch": 1.0})
    held = 20.0 if upright else 3.0
    frames = yield from _Way(figure, start, goal, _HOLD, stiff, held, (arm,), lead).fastest(least)
    return _standing(figure, kind, frames, figure.center(goal)[:2], stance)


take = at_once(take_slices)


def walk_motion(found: Walk) -> Motion:
    """A walk as a motion; it may be left when both feet stand flat."""
    done = np.arange(1, len(found.frames.q) + 1) * DT > found.strikes[-1] + 0.5
    return Motion("walk", found.frames.q, found.contact, found.frames.miss, found.zmp, done)


def join(figure: Figure, second: Array, first: Array, motion: Motion) -> Motion:
    """``motion`` after another that was at ``second`` and then at ``first`` (nq,), without a jump.

    Where the old motion would go on to, less where the new one is, decays joint by joint with its speed; the
    feet are pinned again to what the new motion says.
    """
    n = min(len(motion), round(BLEND / DT) + 3)
    speed = figure.robot.difference(second, first) / DT
    predicted = figure.robot.integrate(first, speed * DT)
    gap = figure.robot.difference(motion.q[0], predicted)
    own = figure.robot.difference(motion.q[0], motion.q[1]) / DT if len(motion) > 1 else 0 * speed
    if n < 2 or max(np.abs(speed - own).max(), np.abs(gap).max()) < 1e-3:
        return motion
    t = np.arange(n, dtype=np.float64) * DT
    offset = decay(gap, speed - own, BLEND)(t)
    for foot in figure.feet.values():  # toes on the floor: what little they are off would press them into it
        if foot.toes is not None and abs(gap[foot.toes[1]]) < 0.1:
            offset[:, foot.toes[1]] = 0.0
    wanted = np.array(list(map(figure.robot.integrate, motion.q[:n], offset)))
    rows = FrameRows(figure, n)
    rows.feet({side: figure.poses(motion.q[:n], foot.frame) for side, foot in figure.feet.items()})
    center = np.array([figure.center(row) for row in motion.q[:n]])
    was, its = (figure.center(first) - figure.center(second)) / DT, (center[1] - center[0]) / DT
    shift = decay(figure.center(first) + was * DT - center[0], was - its, BLEND)(t)
    rows.center(center + shift, axes="xy")
    rows.orientation(figure.trunk, figure.poses(wanted, figure.trunk)[1], 1.0)
    frames = rows.solve(
        wanted, figure.stiffnesses({"*": 1.0, "*toe*": 1e5}), first, second, speeds=motion.speeds
    )
    q, miss = motion.q.copy(), motion.miss.copy()
    q[:n], miss[:n] = frames.q, frames.miss
    return replace(motion, q=q, miss=miss)


def stop_walk(figure: Figure, found: Walk, frame: int) -> Slices[Walk]:
    """A walk that begins as another and ends with the step in hand, a short one and the closing one.

    The feet move as they did until the step in hand is over, so that the other walk may be left at any frame
    until then: only the centre of mass goes over into its new plan (``join``).

    Args:
        figure: Who walks.
        found: The walk.
        frame: The last frame that is shown of it.
    """
    now = (frame + 1) * DT
    landing = next((k for k, strike in enumerate(found.strikes) if strike > now), len(found.strikes))
    keep = landing + 3  # the two where it stood, those that landed, and the one that swings
    prints = list(found.prints)
    if keep + 2 < len(prints):
        # Three quarters of the next step, from where the same foot stood; the other foot comes beside it.
        a, b, share = prints[keep - 2], prints[keep], 0.75
        x, y, yaw = a.x + (b.x - a.x) * share, a.y + (b.y - a.y) * share, a.yaw + (b.yaw - a.yaw) * share
        apart = (1 - 2 * b.side) * 2 * figure.apart
        beside = (x + apart * np.sin(yaw), y - apart * np.cos(yaw), yaw)
        prints = [*prints[:keep], Footprint(b.side, x, y, yaw), Footprint(prints[keep - 1].side, *beside)]
    return (yield from walk_slices(figure, found.start, prints, found.gait))


def rest_of(motion: Motion, frame: int) -> Motion:
    """The frames from ``frame`` on."""
    rows = {name: getattr(motion, name)[frame:] for name in ("q", "contact", "miss", "zmp", "free")}
    return replace(motion, **rows)
