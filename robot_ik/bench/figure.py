"""The figure's motion judged by MuJoCo alone: true shapes, inverse dynamics, contacts of its own.

It knows the model, the frames, their rate and which contact each foot claims; nothing of how they were
planned.
"""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.abilities import Abilities
from robot_ik.figure.actions import take
from robot_ik.figure.balance import derivatives, hull_margin, zero_moment_points
from robot_ik.figure.decide import Decider
from robot_ik.figure.figure import DT, GRAVITY, RATE, SIDES, Figure, lowest_points, shape_points
from robot_ik.figure.frames import FrameRows
from robot_ik.figure.gait import (
    AIR,
    FLAT,
    SHUFFLE,
    Walk,
    prints_of,
    shuffle_prints,
    walk,
    walk_prints,
)
from robot_ik.figure.jump import jump
from robot_ik.figure.poses import touches_itself
from robot_ik.figure.session import FigureSession
from robot_ik.jobs.quantity import Quantity
from robot_ik.ports import Array

NORM_DEG: Mapping[str, tuple[float, ...]] = {
    "hip": (35.8, 32.8, 22.5, 11.4, 1.6, -5.3, -0.9, 17.9, 32.0, 36.7, 35.5),
    "knee": (5.6, 18.6, 16.5, 10.1, 6.2, 11.6, 33.9, 58.2, 49.8, 18.7, 5.4),
    "ankle": (-2.1, -2.1, 5.2, 8.6, 11.1, 10.4, -13.8, -11.2, 1.1, 1.0, -2.3),
}
"""Flexion each 10 % of the cycle from heel strike, free speed: Schwartz, Rozumalski & Trost, J. Biomech.
41:1639, 2008."""

# A shape this near to the floor supports the figure, m.
_NEAR = 0.003
# A zero-moment point is evaluated from this share of the weight on.
_MIN_FORCE = 0.2


@dataclass(frozen=True)
class MotionMeasure:
    """What MuJoCo says of some frames; lengths in mm, speeds in rad/s, forces in body weights.

    Attributes:
        frames: How many.
        slip: Of the touching point of the sole from a frame to the next.
        drift: Of a foot that stays flat.
        penetration: Of the feet's shapes in the floor.
        inside, close: Share of supported frames with the zero-moment point inside, and within 10 mm.
        worst: Margin of the zero-moment point, negative outside.
        force: Least and largest vertical force of the floor.
        outside_limits, too_fast: Frames with a joint beyond its limits, or beyond a speed limit.
        self_contact: Frames with a self-contact.
        jump: Largest change of a joint's speed from frame to frame.
        knee_speed: Largest of the knees.
    """

    frames: int
    slip: float
    drift: float
    penetration: float
    inside: float
    close: float
    worst: float
    force: tuple[float, float]
    outside_limits: int
    too_fast: int
    self_contact: int
    jump: float
    knee_speed: float


@dataclass(frozen=True)
class _Soles:
    """Lowest points of both feet's shapes in every frame, in the world, and all that may touch the floor."""

    height: list[Array]  # (n, g) of each side
    point: list[Array]  # (n, g, 3)
    body: list[NDArray[np.int64]]  # (g,)
    ends: list[Array]  # (n, k, 3)
    position: Array  # (n, nbody, 3) of all bodies
    matrix: Array  # (n, nbody, 3, 3) of all bodies


def _soles(figure: Figure, q: Array) -> _Soles:
    model = figure.model
    position, matrix = np.empty((len(q), model.nbody, 3)), np.empty((len(q), model.nbody, 3, 3))
    for i, row in enumerate(q):
        data = figure.at(row)
        position[i], matrix[i] = data.xpos, data.xmat.reshape(-1, 3, 3)
    heights, points, bodies, ends = [], [], [], []
    for name in SIDES:
        h, p, b, e = [], [], [], []
        for body, geoms in figure.feet[name].parts:
            low, local = lowest_points(model, list(geoms), matrix[:, body, 2, :])
            h.append(low + position[:, body, 2:3])
            p.append(np.einsum("nij,ngj->ngi", matrix[:, body], local) + position[:, None, body])
            b += [body] * len(geoms)
            shapes = np.concatenate([shape_points(model, g, matrix[:, body, 2, :]) for g in geoms])
            e.append(np.einsum("nij,knj->nki", matrix[:, body], shapes) + position[:, None, body])
        ends.append(np.concatenate(e, axis=1))
        heights.append(np.concatenate(h, axis=1))
        points.append(np.concatenate(p, axis=1))
        bodies.append(np.array(b))
    return _Soles(heights, points, bodies, ends, position, matrix)


def measure_motion(
    figure: Figure, q: Array, contact: NDArray[np.int64], speeds: str = "daily"
) -> MotionMeasure:
    """Judges frames (n, nq) and the contacts (n, 2) that they claim."""
    soles = _soles(figure, q)
    zmp, force = zero_moment_points(figure, q)
    weight = force / (figure.mass * GRAVITY)
    _, _, forward = derivatives(figure, q)
    margins: list[float] = []
    for i in range(1, len(q) - 1):
        near = [
            ends[i][ends[i, :, 2] < _NEAR, :2]
            for side, ends in enumerate(soles.ends)
            if contact[i, side] != AIR
        ]
        under = np.concatenate(near) if near else np.zeros((0, 2))
        if len(under) and weight[i] > _MIN_FORCE:
            margins.append(hull_margin(under, zmp[i]))
    slip, drift = _slip_and_drift(soles, contact)
    low = min(float(h.min()) for h in soles.height)
    hinges = q[:, 7:]
    lower, upper = figure.robot.lower[6:], figure.robot.upper[6:]
    limit = figure.speeds[speeds]
    knees = [figure.addresses(joint)[1] for joint in figure.robot.joints if "knee" in joint]
    change = np.abs(np.diff(forward[:-1, 6:], axis=0))
    m = np.array(margins) if margins else np.array([np.inf])
    return MotionMeasure(
        frames=len(q), slip=1e3 * slip, drift=1e3 * drift, penetration=1e3 * max(0.0, -low),
        inside=float((m >= 0).mean()), close=float((m >= -0.01).mean()), worst=1e3 * float(m.min()),
        force=(float(weight[1:-1].min()), float(weight[1:-1].max())),
        outside_limits=int(((hinges < lower - 1e-6) | (hinges > upper + 1e-6)).any(axis=1).sum()),
        too_fast=int((np.abs(forward) > limit * (1 + 1e-6)).any(axis=1).sum()),
        self_contact=sum(touches_itself(figure, row[None]) for row in q),
        jump=float(change.max(initial=0.0)), knee_speed=float(np.abs(forward[:, knees]).max(initial=0.0)),
    )  # fmt: skip


def _slip_and_drift(soles: _Soles, contact: NDArray[np.int64]) -> tuple[float, float]:
    """Largest displacement of a material point that touches from frame to frame, and of a flat foot."""
    slip, drift, position, matrix = 0.0, 0.0, soles.position, soles.matrix
    for side in (0, 1):
        since = None
        for i in range(len(position) - 1):
            if contact[i, side] == AIR or contact[i + 1, side] == AIR:
                since = None
                continue
            g = int(soles.height[side][i].argmin())
            body, point = int(soles.body[side][g]), soles.point[side][i, g]
            local = matrix[i, body].T @ (point - position[i, body])
            after = position[i + 1, body] + matrix[i + 1, body] @ local
            slip = max(slip, float(np.linalg.norm((after - point)[:2])))
            foot = int(soles.body[side][0])
            if contact[i, side] != FLAT:
                since = None
            elif since is None:
                since = position[i, foot, :2]
            else:
                drift = max(drift, float(np.linalg.norm(position[i, foot, :2] - since)))
    return slip, drift


@dataclass(frozen=True)
class GaitMeasure:
    """A walk beside the norms.

    Attributes:
        curves_deg: (11,) flexion each 10 % of the cycle, mean of the middle strides, by joint.
        correlation, rms_deg: With ``NORM_DEG``.
        step, cadence, speed, stance: m, 1/min, m/s, share of the cycle.
        vertical, lateral: Range of the pelvis, mm.
        clearance: Least height of the sole in mid swing, mm.
    """

    curves_deg: Mapping[str, Array]
    correlation: Mapping[str, float]
    rms_deg: Mapping[str, float]
    step: float
    cadence: float
    speed: float
    stance: float
    vertical: float
    lateral: float
    clearance: float


def measure_gait(figure: Figure, walk: Walk) -> GaitMeasure:
    """Joint curves over the middle strides and the numbers of the steps.

    A straight walk along x of 4 m or more.
    """
    q, strikes = walk.frames.q, walk.strikes
    times = np.arange(1, len(q) + 1, dtype=np.float64) * DT
    strides: dict[str, list[Array]] = {joint: [] for joint in NORM_DEG}
    stance: list[float] = []
    for side, name in enumerate(SIDES):
        falls = walk.falls[side]
        for (_, strike, off), (_, after, ends) in itertools.pairwise(falls):
            if strike < strikes[1] or not np.isfinite(ends):
                continue
            at = strike + np.linspace(0, 1, 11) * (after - strike)
            stance.append((off - strike) / (after - strike))
            for joint, rows in strides.items():
                rows.append(
                    np.interp(at, times, np.degrees(q[:, figure.addresses(f"{name}_{joint}_pitch")[0]]))
                )
    curves = {joint: np.mean(rows, axis=0) for joint, rows in strides.items()}
    norm = {joint: np.array(values) for joint, values in NORM_DEG.items()}
    middle = (times >= strikes[2]) & (times <= strikes[min(4, len(strikes) - 2)])
    pelvis, _ = figure.poses(q[middle], figure.pelvis)
    center = _centers(figure, q[middle])
    prints = np.array([(p.x, p.y) for p in walk.prints])
    return GaitMeasure(
        curves_deg=curves,
        correlation={j: float(np.corrcoef(c, norm[j])[0, 1]) for j, c in curves.items()},
        rms_deg={j: float(np.sqrt(np.mean((c - norm[j]) ** 2))) for j, c in curves.items()},
        step=float(np.linalg.norm(np.diff(prints[3:-2], axis=0), axis=1).mean()),
        cadence=60.0 / float(np.diff(strikes).mean()),
        speed=float(np.linalg.norm((center[-1] - center[0])[:2]) / (times[middle][-1] - times[middle][0])),
        stance=float(np.mean(stance)),
        vertical=1e3 * float(np.ptp(pelvis[:, 2])),
        lateral=1e3 * float(np.ptp(pelvis[:, 1])),
        clearance=1e3 * _clearance(figure, walk, times),
    )


def _clearance(figure: Figure, walk: Walk, times: Array) -> float:
    """Least height of a swinging sole between 30 and 80 % of the swings of whole steps, m."""
    low = np.inf
    for side, falls in enumerate(walk.falls):
        for (_, _, off), (_, strike, ends) in itertools.pairwise(falls):
            if not np.isfinite(ends):
                continue
            share = (times - off) / (strike - off)
            swing = np.flatnonzero((share > 0.3) & (share < 0.8))
            low = min(low, float(_soles(figure, walk.frames.q[swing]).height[side].min()))
    return low


MotionRow = tuple[str, Quantity]
"""What was measured of a motion, and the motion."""


def _motion_rows(name: str, m: MotionMeasure) -> list[MotionRow]:
    touching = 0.01 * m.frames if name == "bend" else 0
    return [
        (name, Quantity("slip of the touching point per frame", m.slip, "mm", most=0.1)),
        (name, Quantity("drift of a flat foot", m.drift, "mm", most=0.1)),
        (name, Quantity("penetration of shapes", m.penetration, "mm", most=0.5)),
        (name, Quantity("zero-moment point inside", 100 * m.inside, "%", least=95)),
        (name, Quantity("zero-moment point within 10 mm", 100 * m.close, "%", least=98)),
        (name, Quantity("zero-moment point, worst", m.worst, "mm", least=-60)),
        (name, Quantity("frames beyond joint limits", m.outside_limits, most=0)),
        (name, Quantity("frames beyond speed limits", m.too_fast, most=0)),
        (name, Quantity("frames with self-contact", m.self_contact, most=touching)),
    ]


def measure_walks(figure: Figure) -> Iterator[MotionRow]:
    """Straight on, along a curve, to the side, and on the spot."""
    start = prints_of(figure, figure.home)
    straight = walk(figure, figure.home, walk_prints(figure, start, np.array([5.0, 0.0, 0.0])))
    m = measure_motion(figure, straight.frames.q, straight.contact)
    yield from _motion_rows("walk", m)
    yield "walk", Quantity("least vertical force", m.force[0], "body weights", least=0.7)
    yield "walk", Quantity("largest vertical force", m.force[1], "body weights", most=1.3)
    yield "walk", Quantity("fastest knee", m.knee_speed, "rad/s", most=7.0)
    g = measure_gait(figure, straight)
    for joint, least, most in (("hip", 0.97, 6.0), ("knee", 0.96, 8.0), ("ankle", 0.94, 7.0)):
        yield "walk", Quantity(f"{joint}: correlation with the norm", g.correlation[joint], least=least)
        yield "walk", Quantity(f"{joint}: RMS from the norm", g.rms_deg[joint], "deg", most=most)
    yield "walk", Quantity("speed", g.speed, "m/s", least=1.1, most=1.25)
    yield "walk", Quantity("step", g.step, "m", least=0.62, most=0.72)
    yield "walk", Quantity("cadence", g.cadence, "1/min", least=100, most=113)
    yield "walk", Quantity("stance", 100 * g.stance, "%", least=58, most=65)
    yield "walk", Quantity("pelvis up and down", g.vertical, "mm", least=25, most=50)
    yield "walk", Quantity("pelvis to the sides", g.lateral, "mm", least=30, most=65)
    yield "walk", Quantity("least height of the sole in mid swing", g.clearance, "mm", least=10, most=25)
    curve = walk(figure, figure.home, walk_prints(figure, start, np.array([3.0, 2.0, np.pi / 3])))
    small = {"side steps": (0.0, 0.6, 0.0), "turn on the spot": (0.0, 0.0, np.pi)}
    walks = {"curve": curve} | {
        name: walk(figure, figure.home, shuffle_prints(figure, start, np.array(goal)), SHUFFLE)
        for name, goal in small.items()
    }
    for name, found in walks.items():
        yield from _motion_rows(name, measure_motion(figure, found.frames.q, found.contact))


def measure_hands(abilities: Abilities, count: int, seed: int) -> Iterator[MotionRow]:
    """Seeded balls that are reached, bent or jumped for; the worst of each."""
    figure, decider, rng = abilities.figure, Decider(abilities), np.random.default_rng(seed)
    found: dict[str, list[tuple[MotionMeasure, float]]] = {"reach": [], "bend": [], "jump": []}
    for _ in range(60 * count):
        if all(len(rows) >= count for rows in found.values()):
            break
        ball = rng.uniform([0.15, -0.5, 0.1], [0.6, 0.5, 2.5])
        decision = decider.decide(ball)
        if decision.action not in found or decision.arm is None or len(found[decision.action]) >= count:
            continue
        if decision.action == "jump":
            motion = jump(figure, figure.home, ball, decision.arm, decision.speed or 0.0)
        else:
            end = abilities.pose(decision.action, ball, decision.arm).q
            motion = take(figure, figure.home, ball, decision.arm, decision.action, end=end)
        hand = figure.hands[decision.arm]
        error = [float(np.linalg.norm(figure.robot.measure(row, hand).position - ball)) for row in motion.q]
        measure = measure_motion(figure, motion.q, motion.contact, motion.speeds)
        found[decision.action].append((measure, min(error) if decision.action == "jump" else error[-1]))
    for name, rows in found.items():
        ms = [m for m, _ in rows]
        yield name, Quantity("balls", len(ms), least=count)
        yield (
            name,
            Quantity("hand from the ball, worst", 1e3 * max(error for _, error in rows), "mm", most=5.0),
        )
        least = 90.0 if name == "jump" else 100.0
        inside = 100 * float(np.mean([m.inside for m in ms]))
        yield name, Quantity("zero-moment point inside", inside, "%", least=least)
        yield name, Quantity("slip of the touching point per frame", max(m.slip for m in ms), "mm", most=0.1)
        yield name, Quantity("penetration of shapes", max(m.penetration for m in ms), "mm", most=0.5)
        beyond = sum(m.outside_limits + m.too_fast for m in ms)
        yield name, Quantity("frames beyond joint or speed limits", beyond, most=0)
        share = 100 * sum(m.self_contact for m in ms) / sum(m.frames for m in ms)
        yield name, Quantity("frames with self-contact", share, "%", most=1.0 if name == "bend" else 0.0)


def measure_times(abilities: Abilities) -> Iterator[MotionRow]:
    """Processor time of a frame of a walk, of a decision, and of a frame of a session."""
    yield from _peer_rows(abilities.figure)
    rng = np.random.default_rng(0)
    near = rng.uniform([0.3, -0.4, 0.9], [0.5, 0.4, 1.5], (40, 3))
    # The box of the judged balls: most are at an edge of what it reaches, or beyond.
    around = rng.uniform([-0.3, -0.9, 0.05], [1.0, 0.9, 2.9], (60, 3))
    spent = _decision_times(abilities, near)
    yield "time", Quantity("a decision, balls before the chest", float(spent.mean()), "ms", most=3.0)
    spent = _decision_times(abilities, around)
    yield "time", Quantity("a decision, balls anywhere around it", float(spent.mean()), "ms", most=3.0)
    yield "time", Quantity("a decision, longest", float(spent.max()), "ms", most=1000.0 / RATE)
    yield from _session_times(abilities)


def _decision_times(abilities: Abilities, balls: Array) -> Array:
    """(n,) processor time of each decision, ms."""
    decider, spent = Decider(abilities), []
    decider.decide(balls[0])
    for ball in balls:
        began = time.thread_time()
        decider.decide(ball)
        spent.append(1e3 * (time.thread_time() - began))
    return np.array(spent)


def _peer_rows(figure: Figure) -> Iterator[MotionRow]:
    """Frames of a walk with the same goals by the figure's solver and by mink, where that is installed."""
    if figure.gaze is None:
        return
    prints = walk_prints(figure, prints_of(figure, figure.home), np.array([2.5, 0.0, 0.0]))
    goals = FrameGoals.of(figure, walk(figure, figure.home, prints).frames.q, figure.gaze)
    q, ours = by_figure(figure, goals)
    what = "the same goals, feet and centre of mass within"
    worst = 1e3 * goals.worst_error(figure, q)
    yield "peer", Quantity(f"{what}, this solver", worst, "mm", most=1e3 * PEER_ERROR)
    yield "peer", Quantity("a frame of a walk, this solver", 1e6 * ours, "us", most=200)
    if any(importlib.util.find_spec(name) is None for name in ("mink", PEER_SOLVER)):  # no part needs them
        absent = "mink is not installed: pip install mink daqp"
        yield "peer", Quantity("times as fast as mink", np.nan, least=5.0, missing=absent)
        return
    q, theirs, steps = by_mink(figure, goals)
    yield "peer", Quantity(f"{what}, mink", 1e3 * goals.worst_error(figure, q), "mm")
    yield "peer", Quantity(f"a frame, mink ({PEER_SOLVER}), steps", steps)
    yield "peer", Quantity("a frame of a walk, mink", 1e6 * theirs, "us")
    yield "peer", Quantity("times as fast as mink", theirs / ours, least=5.0)


def _session_times(abilities: Abilities) -> Iterator[MotionRow]:
    """Of a walk to a ball 5 m away and the reach there: frames that plan, and those that do not."""
    session = FigureSession(abilities)
    session.set_ball((5.0, 0.5, 1.2))
    planned: list[float] = []
    played: list[float] = []
    while session.busy and len(planned) + len(played) < 1200:
        planning = session.planning
        began = time.thread_time()
        frame = session.step()
        spent = 1e3 * (time.thread_time() - began)
        plans = planning or session.planning or frame.phase < 2.0 / 60.0
        (planned if plans else played).append(spent)
    yield "time", Quantity("a frame that is played, p99", float(np.quantile(played, 0.99)), "ms", most=1.0)
    yield "time", Quantity("a frame that plans, longest", max(planned), "ms", most=1000.0 / RATE)


def measure_figure(abilities: Abilities, count: int = 20, seed: int = 0) -> Iterator[MotionRow]:
    """All rows, one after the other."""
    yield from measure_walks(abilities.figure)
    yield from measure_hands(abilities, count, seed)
    yield from measure_times(abilities)


# ------------------------------------------------------------------------------------------
# Frames of a walk with equal goals by the figure's solver and by mink: errors first, then time.
#
# Both get, frame by frame, the poses of the feet, the centre of mass over the floor, the pelvis (rotation and
# height), the rotation of the chest, gaze and a posture, read off a solved walk, and begin where their frame
# before ended.  mink weighs all rows; it steps until feet and centre of mass are within ``PEER_ERROR``.


PEER_ERROR = 1e-4
"""Of feet and centre of mass, m and rad."""
PEER_SOLVER = "daqp"
"""QP solver of mink."""
PEER_STEPS = 20
"""Largest number of steps of mink in a frame."""
COSTS = {
    "feet": 100.0, "center": 100.0, "pelvis": 3.0, "height": 20.0, "chest": 3.0, "gaze": 1.0, "posture": 0.1,
}  # fmt: skip
"""mink's: square roots of weights that count as much as the figure's own."""
_AHEAD = 3.0  # m: the point that the eyes follow


@dataclass(frozen=True, eq=False)
class FrameGoals:
    """(n, …) goals of the frames (n, nq) of a walk, read off these: positions and rotations."""

    q: Array
    feet: dict[str, tuple[Array, Array]]
    center: Array
    pelvis: tuple[Array, Array]
    chest: Array
    gaze_target: Array

    @classmethod
    def of(cls, figure: Figure, q: Array, gaze: str) -> FrameGoals:
        """Read off frames; ``gaze``: the frame that looks."""
        eyes, matrix = figure.poses(q, gaze)
        feet = {foot.frame: figure.poses(q, foot.frame) for foot in figure.feet.values()}
        pelvis, chest = figure.poses(q, figure.pelvis), figure.poses(q, figure.trunk)[1]
        return cls(q, feet, _centers(figure, q), pelvis, chest, eyes + _AHEAD * matrix[:, :, 0])

    def worst_error(self, figure: Figure, q: Array) -> float:
        """Largest error of feet and centre of mass in frames (n, nq), by MuJoCo, m or rad."""
        worst = float(np.abs(_centers(figure, q) - self.center)[:, :2].max())
        for frame, (position, matrix) in self.feet.items():
            there, rotation = figure.poses(q, frame)
            worst = max(worst, float(np.abs(there - position).max()), float(np.abs(rotation - matrix).max()))
        return worst


def _centers(figure: Figure, q: Array) -> Array:
    """(n, 3) centres of mass."""
    return np.array([figure.center(row) for row in q])


def by_figure(figure: Figure, goals: FrameGoals) -> tuple[Array, float]:
    """(n, nq) by the figure's solver, and seconds of processor time a frame.

    Feet and centre of mass are needed, the rest is weighed.
    """
    rows = FrameRows(figure, len(goals.q))
    rows.feet({side: goals.feet[foot.frame] for side, foot in figure.feet.items()})
    rows.center(goals.center, axes="xy")
    rows.orientation(figure.pelvis, goals.pelvis[1], 60.0)
    rows.orientation(figure.trunk, goals.chest, 60.0)
    rows.position(figure.pelvis, goals.pelvis[0], 2000.0, axes="z")
    rows.aim(goals.gaze_target, 5.0)
    stiffness = figure.stiffnesses({"*": 0.02, "*toe*": 1e3})
    seconds, q = 0.0, goals.q
    for _ in range(2):  # the first one may have to compile
        began = time.thread_time()
        q = rows.solve(goals.q, stiffness, figure.home, speeds=None).q
        seconds = (time.thread_time() - began) / len(goals.q)
    return q, seconds


def by_mink(figure: Figure, goals: FrameGoals) -> tuple[Array, float, float]:
    """(n, nq) by mink's tasks with the same goals; seconds of processor time and steps a frame."""
    mink: Any = importlib.import_module("mink")
    tasks, aims = _mink_tasks(mink, figure, goals)
    configuration = mink.Configuration(figure.model)
    configuration.update(figure.home)
    limits, q, steps = [mink.ConfigurationLimit(figure.model)], np.empty_like(goals.q), 0
    began = time.thread_time()
    for k in range(len(q)):
        for task, targets in zip(tasks, aims, strict=True):
            task.set_target(targets[k])
        for _ in range(PEER_STEPS):
            velocity = mink.solve_ik(configuration, tasks, 1.0, PEER_SOLVER, damping=1e-6, limits=limits)
            configuration.integrate_inplace(velocity, 1.0)
            steps += 1
            if max(float(np.abs(task.compute_error(configuration)).max()) for task in tasks[:3]) < PEER_ERROR:
                break
        q[k] = configuration.q
    return q, (time.thread_time() - began) / len(q), steps / len(q)


def _mink_tasks(mink: Any, figure: Figure, goals: FrameGoals) -> tuple[list[Any], list[Any]]:
    """Tasks, the needed ones first, and the targets of each, frame by frame."""
    free = np.zeros(3)

    def frame(name: str, position: Any, matrix: float) -> Any:
        sites = {figure.model.site(k).name for k in range(figure.model.nsite)}
        return mink.FrameTask(name, "site" if name in sites else "body", position, matrix)

    def poses(position: Array, matrix: Array) -> list[Any]:
        return [
            mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(r), p)
            for p, r in zip(position, matrix, strict=True)
        ]

    still = np.broadcast_to(free, goals.center.shape)
    pairs: list[tuple[Any, Any]] = [
        (frame(name, COSTS["feet"], COSTS["feet"]), poses(*pose)) for name, pose in goals.feet.items()
    ]
    pairs += [
        (mink.ComTask([COSTS["center"], COSTS["center"], 0.0]), goals.center),
        (frame(figure.pelvis, [0.0, 0.0, COSTS["height"]], COSTS["pelvis"]), poses(*goals.pelvis)),
        (frame(figure.trunk, free, COSTS["chest"]), poses(still, goals.chest)),
        (
            mink.LookAtTask(figure.gaze, "site", axis=(1.0, 0.0, 0.0), cost=COSTS["gaze"]),
            goals.gaze_target,
        ),
        (mink.PostureTask(figure.model, cost=COSTS["posture"]), goals.q),
    ]
    return [task for task, _ in pairs], [targets for _, targets in pairs]
