"""The rows of the figure's benchmark: motions, hands at balls, and processor times."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.figure.gait import GaitMeasure, measure_gait
from benchmarks.figure.motion import MotionMeasure, measure_motion
from benchmarks.figure.peer import (
    QP_SOLVER,
    TOLERANCE,
    FrameGoals,
    mink_is_installed,
    solve_by_figure,
    solve_by_mink,
)
from benchmarks.quantity import Quantity
from robot_ik.figure.abilities import Abilities
from robot_ik.figure.actions import Motion, reach_ball
from robot_ik.figure.decide import Decider, Decision
from robot_ik.figure.figure import DT, RATE, Figure
from robot_ik.figure.footprints import prints_of, shuffle_prints, walk_prints
from robot_ik.figure.gait import SHUFFLE
from robot_ik.figure.jump import jump
from robot_ik.figure.session import SESSION, FigureSession
from robot_ik.figure.walk import Walk, walk
from robot_ik.ports import Array

MotionRow = tuple[str, Quantity]
"""Name of a motion, and one of its quantities."""

_REPEATS = 3
"""Number of runs. The smallest time counts, because other programs only make a run longer."""

_TRIES_PER_BALL = 60
"""Largest number of random balls for each measured ball."""

_NEAR_BALLS = ((0.3, -0.4, 0.9), (0.5, 0.4, 1.5))
"""Corners of the box of balls in front of the chest, m."""

_BALLS_AROUND = ((-0.3, -0.9, 0.05), (1.0, 0.9, 2.9))
"""Corners of the box of the judged balls, m. Most are at the edge of the reach, or beyond."""


def measure_figure(abilities: Abilities, count: int = 20, seed: int = 0) -> Iterator[MotionRow]:
    """Yield all rows.

    Args:
        abilities: Abilities of the figure.
        count: Balls that are reached, bent and jumped for.
        seed: Seed of the balls.
    """
    yield from measure_walks(abilities.figure)
    yield from measure_hands(abilities, count, seed)
    yield from measure_peer(abilities.figure)
    yield from measure_times(abilities)


def measure_walks(figure: Figure) -> Iterator[MotionRow]:
    """Yield rows of a straight walk, a curve, side steps and a turn on the spot."""
    start = prints_of(figure, figure.home)
    straight = straight_walk(figure)
    measure = measure_motion(figure, straight.frames.q, straight.contact)
    yield from motion_rows("walk", measure)
    for quantity in walk_quantities(measure, measure_gait(figure, straight)):
        yield "walk", quantity
    prints = walk_prints(figure, start, np.array([3.0, 2.0, np.pi / 3]))
    walks = {"curve": walk(figure, figure.home, prints)}
    for name, goal in (("side steps", (0.0, 0.6, 0.0)), ("turn on the spot", (0.0, 0.0, np.pi))):
        prints = shuffle_prints(figure, start, np.array(goal))
        walks[name] = walk(figure, figure.home, prints, SHUFFLE)
    for name, result in walks.items():
        yield from motion_rows(name, measure_motion(figure, result.frames.q, result.contact))


def straight_walk(figure: Figure) -> Walk:
    """Return the walk of 5 m that is measured."""
    start = prints_of(figure, figure.home)
    return walk(figure, figure.home, walk_prints(figure, start, np.array([5.0, 0.0, 0.0])))


def motion_rows(name: str, measure: MotionMeasure) -> list[MotionRow]:
    """Return the rows of every walk."""
    inside = 100 * measure.inside
    nearly_inside = 100 * measure.nearly_inside
    quantities = [
        Quantity("slip of the touching point per frame", measure.slip_mm, "mm", most=0.1),
        Quantity("drift of a flat foot", measure.drift_mm, "mm", most=0.1),
        Quantity("penetration of shapes", measure.penetration_mm, "mm", most=0.5),
        Quantity("zero-moment point inside", inside, "%", least=95),
        Quantity("zero-moment point within 10 mm", nearly_inside, "%", least=98),
        Quantity("zero-moment point, worst", measure.worst_margin_mm, "mm", least=-60),
        Quantity("frames beyond joint limits", measure.outside_limits, most=0),
        Quantity("frames beyond speed limits", measure.too_fast, most=0),
        Quantity("frames with self-contact", measure.self_contact, most=0),
    ]
    return [(name, quantity) for quantity in quantities]


def walk_quantities(measure: MotionMeasure, gait: GaitMeasure) -> list[Quantity]:
    """Return the additional rows of the straight walk."""
    quantities = [
        Quantity("least vertical force", measure.least_force, "body weights", least=0.7),
        Quantity("largest vertical force", measure.largest_force, "body weights", most=1.3),
        Quantity("fastest knee", measure.knee_speed, "rad/s", most=7.0),
    ]
    for joint, correlation, rms_deg in (
        ("hip", 0.97, 6.0),
        ("knee", 0.96, 8.0),
        ("ankle", 0.94, 7.0),
    ):
        name = f"{joint}: correlation with the norm"
        quantities.append(Quantity(name, gait.correlation[joint], least=correlation))
        name = f"{joint}: RMS from the norm"
        quantities.append(Quantity(name, gait.rms_deg[joint], "deg", most=rms_deg))
    clearance = "least height of the sole in mid swing"
    return [
        *quantities,
        Quantity("speed", gait.speed, "m/s", least=1.1, most=1.25),
        Quantity("step", gait.step, "m", least=0.62, most=0.72),
        Quantity("cadence", gait.cadence, "1/min", least=100, most=113),
        Quantity("stance", 100 * gait.stance, "%", least=58, most=65),
        Quantity("pelvis up and down", gait.vertical_mm, "mm", least=25, most=50),
        Quantity("pelvis to the sides", gait.lateral_mm, "mm", least=30, most=65),
        Quantity(clearance, gait.clearance_mm, "mm", least=10, most=25),
    ]


def measure_hands(abilities: Abilities, count: int, seed: int) -> Iterator[MotionRow]:
    """Yield rows of seeded balls that are reached, bent and jumped for: the worst of each."""
    figure = abilities.figure
    decider = Decider(abilities)
    rng = np.random.default_rng(seed)
    results: dict[str, list[tuple[MotionMeasure, float]]] = {"reach": [], "bend": [], "jump": []}
    for _ in range(_TRIES_PER_BALL * count):
        if all(len(rows) >= count for rows in results.values()):
            break
        ball = rng.uniform([0.15, -0.5, 0.1], [0.6, 0.5, 2.5])
        decision = decider.decide(ball)
        rows = results.get(decision.action)
        if rows is None or decision.arm is None or len(rows) >= count:
            continue
        motion = _motion_of(abilities, ball, decision, decision.arm)
        palm = figure.hands[decision.arm]
        errors = [
            float(np.linalg.norm(figure.robot.measure(row, palm).position - ball))
            for row in motion.q
        ]
        measure = measure_motion(figure, motion.q, motion.contact, motion.speeds)
        rows.append((measure, min(errors) if decision.action == "jump" else errors[-1]))
    for name, rows in results.items():
        for quantity in _hand_quantities(name, rows, count):
            yield name, quantity


def _motion_of(abilities: Abilities, ball: Array, decision: Decision, arm: str) -> Motion:
    """Return the motion of a decision without steps."""
    figure = abilities.figure
    if decision.action == "jump":
        return jump(figure, figure.home, ball, arm, decision.speed or 0.0)
    end = abilities.natural_pose(decision.action, ball, arm).q
    return reach_ball(figure, figure.home, ball, arm, decision.action, end=end)


def _hand_quantities(
    name: str, rows: list[tuple[MotionMeasure, float]], count: int
) -> list[Quantity]:
    """Return the rows of reaches, bends or jumps."""
    measures = [measure for measure, _ in rows]
    error_mm = 1e3 * max(error for _, error in rows)
    inside = 100 * float(np.mean([measure.inside for measure in measures]))
    slip_mm = max(measure.slip_mm for measure in measures)
    depth_mm = max(measure.penetration_mm for measure in measures)
    beyond = sum(measure.outside_limits + measure.too_fast for measure in measures)
    frames = sum(measure.frames for measure in measures)
    contact = 100 * sum(measure.self_contact for measure in measures) / frames
    least_inside = 90.0 if name == "jump" else 100.0
    most_contact = 1.0 if name == "bend" else 0.0
    return [
        Quantity("balls", len(measures), least=count),
        Quantity("hand from the ball, worst", error_mm, "mm", most=5.0),
        Quantity("zero-moment point inside", inside, "%", least=least_inside),
        Quantity("slip of the touching point per frame", slip_mm, "mm", most=0.1),
        Quantity("penetration of shapes", depth_mm, "mm", most=0.5),
        Quantity("frames beyond joint or speed limits", beyond, most=0),
        Quantity("frames with self-contact", contact, "%", most=most_contact),
    ]


def measure_peer(figure: Figure) -> Iterator[MotionRow]:
    """Yield rows of the figure's solver and of mink with the same goals."""
    if figure.gaze is None:
        return
    prints = walk_prints(figure, prints_of(figure, figure.home), np.array([2.5, 0.0, 0.0]))
    q = walk(figure, figure.home, prints).frames.q
    goals = FrameGoals.of_frames(figure, q, figure.gaze)
    q, seconds = solve_by_figure(figure, goals)
    what = "the same goals, feet and centre of mass within"
    error_mm = 1e3 * goals.largest_error(figure, q)
    yield "peer", Quantity(f"{what}, this solver", error_mm, "mm", most=1e3 * TOLERANCE)
    yield "peer", Quantity("a frame of a walk, this solver", 1e6 * seconds, "us", most=200)
    if not mink_is_installed():
        missing = f"mink is not installed: pip install mink {QP_SOLVER}"
        yield "peer", Quantity("times as fast as mink", np.nan, least=5.0, missing=missing)
        return
    q, mink_seconds, steps = solve_by_mink(figure, goals)
    yield "peer", Quantity(f"{what}, mink", 1e3 * goals.largest_error(figure, q), "mm")
    yield "peer", Quantity(f"a frame, mink ({QP_SOLVER}), steps", steps)
    yield "peer", Quantity("a frame of a walk, mink", 1e6 * mink_seconds, "us")
    yield "peer", Quantity("times as fast as mink", mink_seconds / seconds, least=5.0)


def measure_times(abilities: Abilities) -> Iterator[MotionRow]:
    """Yield processor times of decisions, of plans and of the frames of a session."""
    rng = np.random.default_rng(0)
    near = rng.uniform(*_NEAR_BALLS, (40, 3))
    around = rng.uniform(*_BALLS_AROUND, (60, 3))
    frame_ms = 1e3 * DT
    times = _decision_times(abilities, near)
    yield "time", Quantity("a decision, balls before the chest", times.mean(), "ms", most=3.0)
    times = _decision_times(abilities, around)
    yield "time", Quantity("a decision, balls anywhere around it", times.mean(), "ms", most=3.0)
    yield "time", Quantity("a decision, longest", times.max(), "ms", most=frame_ms)
    for name, plan, frames in _plans(abilities):
        share = 100 * min(_milliseconds(plan) for _ in range(_REPEATS)) / (frames * frame_ms)
        yield "time", Quantity(f"{name}, share of its {frames} frames", share, "%", most=100)
    yield from _session_times(abilities)


def _milliseconds(work: Callable[[], object]) -> float:
    """Return the processor time of a call in this thread, ms."""
    began = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - began)


def _decision_times(abilities: Abilities, balls: Array) -> Array:
    """Return the processor time (n,) of the decision for each ball, ms."""
    decider = Decider(abilities)
    runs = [
        [_milliseconds(lambda ball=ball: decider.decide(ball)) for ball in balls]  # type: ignore[misc]
        for _ in range(_REPEATS)
    ]
    return np.min(runs, axis=0)


def _plans(abilities: Abilities) -> Iterator[tuple[str, Callable[[], object], int]]:
    """Yield long plans of a session: name, plan, and the frames in which it must be ready."""
    figure = abilities.figure
    home = figure.home
    start = prints_of(figure, home)
    far = walk_prints(figure, start, np.array([8.0, 0.0, 0.0]))
    turn = shuffle_prints(figure, start, np.array([0.0, 0.0, np.pi]))
    ball = np.array([0.2, -0.2, 2.35])
    speed = abilities.take_off(ball, "right") or 0.0
    frames = SESSION.walk_lead
    yield "plan of a walk of 8 m", lambda: walk(figure, home, far), frames
    yield "plan of a turn on the spot", lambda: walk(figure, home, turn, SHUFFLE), frames
    yield "plan of a jump", lambda: jump(figure, home, ball, "right", speed), frames
    for kind, position in (("reach", (0.45, -0.25, 1.35)), ("bend", (0.45, -0.25, 0.25))):
        target = np.array(position)
        yield (
            f"plan of a {kind}",
            lambda kind=kind, target=target: reach_ball(figure, home, target, "right", kind),
            SESSION.action_lead,
        )


def _session_times(abilities: Abilities) -> Iterator[MotionRow]:
    """Yield processor times of the frames of a walk to a ball 5 m away and of the reach there."""
    planned: list[list[float]] = []
    played: list[list[float]] = []
    for _ in range(_REPEATS):
        session = FigureSession(abilities)
        session.set_ball((5.0, 0.5, 1.2))
        planned.append([])
        played.append([])
        while session.busy and len(planned[-1]) + len(played[-1]) < 20 * RATE:
            is_planning = session.planning
            began = time.thread_time()
            frame = session.step()
            milliseconds = 1e3 * (time.thread_time() - began)
            is_begin = frame.phase < 2.0 / RATE
            is_planned = is_planning or session.planning or is_begin
            (planned if is_planned else played)[-1].append(milliseconds)
    p99 = float(np.quantile(np.min(played, axis=0), 0.99))
    longest = float(np.min(planned, axis=0).max())
    yield "time", Quantity("a frame that is played, p99", p99, "ms", most=1.0)
    yield "time", Quantity("a frame that plans, longest", longest, "ms", most=1e3 * DT)
