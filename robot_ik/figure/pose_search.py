"""Search for poses with a hand at a ball: from a natural posture, and from poses nearby.

All balls here are given in the frame of the stance, as in ``poses``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot_ik.figure.figure import Figure, cached_per_figure
from robot_ik.figure.frames import FrameRows, Frames
from robot_ik.figure.hull import inset
from robot_ik.figure.poses import (
    BALANCE_MARGIN,
    BEND,
    FLOOR_CLEARANCE,
    PALM_TOLERANCE,
    REACH,
    FigurePose,
    checked_pose,
    limits_of,
    lowest_body,
    natural_pose,
    support,
    touches_itself,
)
from robot_ik.ports import Array


@dataclass(frozen=True)
class SearchOptions:
    """Parameters of the search.

    Attributes:
        near: If a hand stays nearer than this to a ball, other start poses are tried, m.
        max_lean_error: A hand that stays farther away does not get nearer by leaning, m.
        abduction: Angle of the elbow away from the body where bodies touch, rad.
        swivels: Such angles that the search tries, rad.
        random_starts: Number of random poses from which the search begins.
        starts_before_miss: A quick search ends after failures from this many poses.
        quick_budget: Steps of a quick search from all its poses.
        max_steps: Steps from one pose.
        quick_steps: Steps from one pose in a quick search.
        misses: (steps, distance in m). A quick search ends where the hand is farther away than
            the distance after that many steps.
        damping: Damping of the first step.
        largest_damping: The search ends above this damping.
        patience: The search ends after this many steps without progress.
        progress: A step that leaves more than this share of the error makes no progress.
        feet_weight: Weight of the feet.
        hand_weight: Weight of the hand, of balance and of the floor.
        feet_factor: Factor of the squared error of the feet in the merit.
        floor_factor: Factor of the depth below the floor in the merit.
    """

    near: float = 0.02
    max_lean_error: float = 0.3
    abduction: float = 0.7
    swivels: tuple[float, ...] = (0.7, 1.2)
    random_starts: int = 6
    starts_before_miss: int = 3
    quick_budget: int = 90
    max_steps: int = 60
    quick_steps: int = 45
    misses: tuple[tuple[int, float], ...] = ((3, 0.12), (4, 0.06), (8, 0.02))
    damping: float = 1.0
    largest_damping: float = 1e3
    patience: int = 3
    progress: float = 0.97
    feet_weight: float = 3e4
    hand_weight: float = 300.0
    feet_factor: float = 10.0
    floor_factor: float = 10.0


SEARCH = SearchOptions()
"""The parameters of all searches."""


def find_pose(
    figure: Figure, ball: Array, arm: str, kind: str, starts: Array | None = None
) -> FigurePose:
    """Return the pose with the hand nearest to a ball.

    The natural pose is tried first. If it is not admissible, poses from ``starts`` are tried, and
    one without self-contact is preferred. Without ``starts`` the search takes a hundred times as
    long: it stretches the natural pose as far as balance allows, swivels the arm, and begins from
    random poses.

    Args:
        figure: The figure.
        ball: (3,) the ball.
        arm: Side of the hand.
        kind: ``reach`` or ``bend``.
        starts: (n, nq) poses that reach balls nearby, the nearest first.
    """
    natural = natural_pose(figure, ball, arm, kind)
    if starts is None:
        if not natural.violation or natural.error > SEARCH.max_lean_error:
            return natural
        return _search_widely(figure, ball, arm, kind, natural)
    if not natural.violation:
        if not touches_itself(figure, natural.q[None]):
            return natural
        wide = natural_pose(figure, ball, arm, kind, abduction=SEARCH.abduction)
        if not wide.violation and not touches_itself(figure, wide.q[None]):
            return wide
    refined = best_pose(figure, ball, arm, kind, starts, prefer_untouched=True)
    if refined is None:
        return natural
    if not refined.violation:
        return refined
    is_better = natural.violation and refined.error < natural.error
    return refined if is_better else natural


def best_pose(
    figure: Figure,
    ball: Array,
    arm: str,
    kind: str,
    starts: Array,
    *,
    quick: bool = False,
    prefer_untouched: bool = False,
) -> FigurePose | None:
    """Return the first admissible pose that short steps find, or the one with the least error.

    Args:
        figure: The figure.
        ball: (3,) the ball.
        arm: Side of the hand.
        kind: ``reach`` or ``bend``.
        starts: (n, nq) poses from which the steps begin.
        quick: End early if a ball is out of reach, since starts nearby give the same result. The
            error of the pose is then too large.
        prefer_untouched: Prefer a pose without self-contact.

    Returns:
        None without starts.
    """
    best: FigurePose | None = None
    refiner = _refiner(figure, arm, kind)
    steps = 0
    for k, start in enumerate(starts):
        pose = refiner.refine(start, ball, quick=quick)
        steps += refiner.steps
        if pose.violation.endswith("floor"):
            pose = refiner.refine(pose.q, ball, quick=quick, above_floor=True)
            steps += refiner.steps
        is_better = best is None or (
            bool(best.violation) and (not pose.violation or pose.error < best.error)
        )
        if is_better:
            best = pose
        if prefer_untouched and not pose.violation:
            if touches_itself(figure, pose.q[None]):
                continue
            return pose
        is_missed = pose.error > SEARCH.near or (
            pose.error > PALM_TOLERANCE and k >= SEARCH.starts_before_miss
        )
        if not pose.violation or (quick and (is_missed or steps > SEARCH.quick_budget)):
            break
    return best


def _search_widely(
    figure: Figure, ball: Array, arm: str, kind: str, natural: FigurePose
) -> FigurePose:
    """Return the first admissible pose of a wide search, or the one with the least error."""
    best = natural
    searches = (
        (_stretched_poses, np.inf),
        (_swivelled_poses, PALM_TOLERANCE),
        (_poses_from_random_starts, SEARCH.near),
    )
    for search, largest_error in searches:
        if best.error > largest_error:
            continue
        for pose in search(figure, ball, arm, kind, natural, best):
            if not pose.violation:
                return pose
            best = min(best, pose, key=lambda candidate: candidate.error)
    return best


def _stretched_poses(
    figure: Figure, ball: Array, arm: str, kind: str, natural: FigurePose, _best: FigurePose
) -> Iterator[FigurePose]:
    """Yield poses from the natural one, stretched as far as balance allows."""
    refiner = _refiner(figure, arm, kind)
    yield refiner.refine(natural.q, ball)
    for share in (1.0, 0.3) if kind == BEND else (1.0,):
        start = natural_pose(figure, ball, arm, kind, center_weight=0.5, bend_share=share)
        yield refiner.refine(start.q, ball)


def _swivelled_poses(
    figure: Figure, ball: Array, arm: str, kind: str, _natural: FigurePose, best: FigurePose
) -> Iterator[FigurePose]:
    """Yield poses with the elbow away from the body, or the hand flat above the floor."""
    refiner = _refiner(figure, arm, kind)
    is_low = best.violation.endswith("floor")
    for abduction in (0.0,) if is_low else SEARCH.swivels:
        pose = natural_pose(figure, ball, arm, kind, abduction=abduction, palm_down=is_low)
        is_promising = pose.violation and pose.error < SEARCH.max_lean_error
        yield refiner.refine(pose.q, ball) if is_promising else pose


def _poses_from_random_starts(
    figure: Figure, ball: Array, arm: str, kind: str, _natural: FigurePose, _best: FigurePose
) -> Iterator[FigurePose]:
    """Yield poses from random ones."""
    refiner = _refiner(figure, arm, kind)
    rng = np.random.default_rng(0)
    for _ in range(SEARCH.random_starts):
        yield refiner.refine(_random_pose(figure, kind, rng), ball)


def _random_pose(figure: Figure, kind: str, rng: np.random.Generator) -> Array:
    """Return a random pose (nq,) about home, or between home and deeply bent."""
    lower, upper = limits_of(figure, kind)
    bend = float(rng.uniform(0.0, 1.0)) if kind == BEND else 0.0
    q = figure.home + bend * (figure.bent - figure.home)
    q[:2] = figure.home[:2]
    q[3:7] = figure.home[3:7]
    spread = (0.25 if kind == REACH else 0.5) * rng.normal(size=len(q) - 7)
    q[7:] = np.clip(q[7:] + spread, lower[6:], upper[6:])

    # No constraint keeps the toes from the floor.
    for foot in figure.feet.values():
        if foot.toes is not None:
            q[foot.toes[0]] = figure.home[foot.toes[0]]
    return np.asarray(q)


@dataclass(frozen=True, eq=False)
class _Merit:
    """The errors of a pose.

    Attributes:
        error: Error of hand, feet, balance and floor together. The search reduces it.
        feet: Largest error of the feet, m or rad.
        center_goal: (2,) required position of the centre of mass. None if balance is kept.
        floor_goal: Node and pose (12,) of the point below the floor, or None.
    """

    error: float
    feet: float
    center_goal: Array | None
    floor_goal: tuple[int, Array] | None


class _PoseRefiner:
    """Moves the hand to a ball from a pose nearby by damped steps that each reduce the error.

    The damping is that of Levenberg and Marquardt (Nocedal & Wright, *Numerical Optimization*,
    section 10.3). The posture goal is the current pose. The centre of mass is free while it is
    far enough inside the soles, and is held at their border otherwise. On request, bodies below
    the floor are held above it.

    Attributes:
        steps: Steps of the last call.
    """

    def __init__(self, figure: Figure, arm: str, kind: str) -> None:
        self.figure = figure
        self.arm = arm
        self.steps = 0
        rows = FrameRows(figure, 1)
        rows.feet(figure.feet_at_home, SEARCH.feet_weight)
        rows.position(figure.hands[arm], np.zeros(3), SEARCH.hand_weight)
        rows.center(np.zeros(3), 0.0, axes="xy")
        # The last row holds the lowest point above the floor. Its frame is set in every step.
        above_floor = np.array([0.0, 0.0, FLOOR_CLEARANCE])
        rows.position(figure.hands[arm], above_floor, 0.0, axes="z")
        self._toes = [foot.toes[0] for foot in figure.feet.values() if foot.toes is not None]
        self._even = figure.stiffnesses({"*": 1.0})
        self._toe_stiffness = figure.stiffnesses({"*": 0.0, "*toe*": 1e4})
        limits = limits_of(figure, kind)
        self._prepared = rows.prepare(figure.home, self._even, limits=limits, speeds=None)
        self._solved = Frames(
            np.empty((1, figure.robot.nq)), np.empty(1), np.empty(1, dtype=np.int64)
        )
        # The solver leaves its last poses and centre of mass in these arrays.
        arrays = self._prepared.body.arrays
        self._poses = arrays["pose"]
        self._center = arrays["center"]
        self._node = arrays["node"]
        self._local = arrays["local"]
        self._feet = np.array(
            [
                np.concatenate([position, rotation.ravel()])
                for position, rotation in figure.feet_at_home.values()
            ]
        )
        self._hand_row = 2 * len(self._feet)
        self._center_row = self._hand_row + 1

    def refine(
        self, start: Array, ball: Array, *, quick: bool = False, above_floor: bool = False
    ) -> FigurePose:
        """Return the pose nearest to a ball (3,) that steps from ``start`` (nq,) find.

        Args:
            start: (nq,) the pose from which the steps begin.
            ball: (3,) the ball.
            quick: End early where the ball is out of reach.
            above_floor: Hold all bodies above the floor.
        """
        prepared = self._prepared
        prepared.target[0, self._hand_row, :3] = ball
        q = np.array(start, dtype=float)
        q[self._toes] = self.figure.home[self._toes]
        prepared.solve(self._solved, 0, 1, q, q, 0, 0.0, 0.0)  # no step: evaluates the start
        merit = self._merit(ball, q, above_floor)
        damping = SEARCH.damping
        gains = [0.0]
        repeated = False
        for step in range(1, (SEARCH.quick_steps if quick else SEARCH.max_steps) + 1):
            self.steps = step
            candidate = self._step(q, merit, damping)
            new = self._merit(ball, candidate, above_floor)
            if new.error < merit.error:
                gains.append(new.error / merit.error)
                q = candidate
                merit = new
                repeated = False
                damping = max(0.2 * damping, 1e-4)
                is_met = merit.error < 0.4 * PALM_TOLERANCE and merit.feet < 3e-5
                if is_met and merit.center_goal is None:
                    break
            elif not repeated and (new.center_goal is not None or new.floor_goal is not None):
                # The step crossed a border. The next one goes along it.
                merit = _Merit(merit.error, merit.feet, new.center_goal, new.floor_goal)
                repeated = True
            else:
                damping *= 5.0
            recent = gains[-SEARCH.patience :]
            is_stalled = len(gains) > SEARCH.patience and min(recent) > SEARCH.progress
            is_missed = quick and any(
                step >= count and merit.error > distance for count, distance in SEARCH.misses
            )
            is_unmet = merit.error > PALM_TOLERANCE
            if damping > SEARCH.largest_damping or (is_unmet and (is_stalled or is_missed)):
                break
        return checked_pose(self.figure, q, ball, self.arm, merit.feet)

    def _step(self, q: Array, merit: _Merit, damping: float) -> Array:
        """Return the pose (nq,) after one damped step from ``q`` (nq,)."""
        prepared = self._prepared
        prepared.weight[0, self._center_row] = 0.0
        if merit.center_goal is not None:
            prepared.weight[0, self._center_row] = SEARCH.hand_weight
            prepared.target[0, self._center_row, :2] = merit.center_goal
        prepared.weight[0, -1] = 0.0
        if merit.floor_goal is not None:
            prepared.weight[0, -1] = SEARCH.hand_weight
            self._node[-1], self._local[-1] = merit.floor_goal
        prepared.body.arrays["stiffness"][:] = damping * self._even + self._toe_stiffness
        prepared.posture[0] = q
        prepared.solve(self._solved, 0, 1, q, q, 1, 0.0, 0.0)
        return self._solved.q[0].copy()

    def _merit(self, ball: Array, q: Array, above_floor: bool) -> _Merit:
        """Return the errors of the solver's last pose ``q`` (nq,)."""
        normal, offset = support(self.figure)
        center = self._center[:2]
        feet = float(np.abs(self._poses[0 : self._hand_row : 2] - self._feet).max())
        margin = float((normal @ center - offset).min())
        imbalance = max(0.0, BALANCE_MARGIN + 0.0005 - margin)
        away = self._poses[self._hand_row, :3] - ball
        height = np.inf
        if above_floor:
            body, point, height = lowest_body(self.figure, self.figure.data_at(q))
        depth = SEARCH.floor_factor * min(height, 0.0)
        squares = away @ away + imbalance**2 + SEARCH.feet_factor * feet**2 + depth**2
        center_goal = None
        if imbalance:
            center_goal = inset(normal, offset, center, BALANCE_MARGIN + 0.001)
        floor_goal = None
        if height < FLOOR_CLEARANCE:
            floor_goal = self._node_and_pose(body, point)
        return _Merit(float(np.sqrt(squares)), feet, center_goal, floor_goal)

    def _node_and_pose(self, body: int, point: Array) -> tuple[int, Array]:
        """Return the solver's node and pose (12,) of a point (3,) of a body."""
        node, local = self.figure.robot.attachment(body)
        pose = np.zeros(12)
        pose[:3] = local[:3] + local[3:].reshape(3, 3) @ point
        return node, pose


_refiner = cached_per_figure(_PoseRefiner)
