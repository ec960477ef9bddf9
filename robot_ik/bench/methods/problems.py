"""Seeded problem sets: poses of a robot's tool, each computed from joint angles that reach it.

The same robot, count and seed give the same numbers. ``cold`` and ``warm`` follow the well-known
comparisons of libraries: uniform joint samples from home, and a smooth path in small steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE
from robot_ik.ports import Array
from robot_ik.robot import Robot

SLACK = 1e-9
"""Excess over a limit or a tolerance that is rounding (rad, m, or share of the tolerance)."""

WARM_METRES = 0.005
"""Largest distance of the tool between two warm poses, m: 0.5 m/s at 100 Hz."""

WARM_RADIANS = math.radians(0.5)
"""Largest rotation of the tool between two warm poses, rad."""

NEAR_LIMIT = 0.01
"""Share of the range within which a joint of the set ``limits`` is from an end."""

SINGULAR = 1e-9
"""Ratio of the smallest to the largest singular value below which a Jacobian is singular."""

BEYOND = (1.05, 3.0)
"""Distances of targets of ``unreachable`` from the middle of the ball in reach, in its radii."""

_AMPLITUDE = {HINGE: 0.5, SLIDE: 0.5, BALL: 0.3, FREE: 0.1}
"""Amplitude of the joints on a warm path, rad or m."""

_NEWTON_STEPS = 40
"""Largest number of steps to a singular pose."""

_LONGEST_STEP = 0.5
"""Longest of these steps, rad. A longer one leaves the neighbourhood of the slope."""

_SAMPLES = 20
"""Samples for each singular problem, at most."""

_FIRST_SAMPLES = 6
"""Samples after which the search ends if none of them led to a singular pose."""

_BISECTIONS = 60
"""Largest number of tries for the length of a warm step."""


@dataclass(frozen=True, eq=False)
class ProblemSet:
    """Targets of the tool, with the joint angles from which they were made.

    Attributes:
        name: Kind of the problems.
        targets: (n, 4, 4) poses in the world.
        witnesses: (n, nq) joint angles inside the limits that reach the targets. (0, nq) if the
            targets are unreachable.
        first: (nq,) start of the first solve.
        tracking: Whether each solve starts at the solution before. Otherwise it is ``first``.
        reason: Reason for an empty set. Empty if the set has problems.
    """

    name: str
    targets: Array
    witnesses: Array
    first: Array
    tracking: bool = False
    reason: str = ""

    def __len__(self) -> int:
        return len(self.targets)


def make_set(name: str, robot: Robot, count: int, seed: int = 0) -> ProblemSet:
    """Return problems of one kind. Equal seeds give equal numbers.

    Args:
        name: A key of ``SETS``.
        robot: The robot.
        count: Number of problems.
        seed: Seed of the problems.

    Returns:
        The problems. The set is empty, with a reason, if the robot cannot have such problems.
    """
    # Each kind has its own random stream, so that a new kind does not change the others.
    rng = np.random.default_rng([seed, *name.encode()])
    return SETS[name](robot, count, rng)


def _reachable(name: str, robot: Robot, witnesses: list[Array], reason: str = "") -> ProblemSet:
    """Return the problems of joint angles, all with their start at home."""
    targets = np.array([robot.measure(q).matrix for q in witnesses]).reshape(-1, 4, 4)
    angles = np.array(witnesses).reshape(-1, robot.nq)
    return ProblemSet(name, targets, angles, robot.home, reason="" if witnesses else reason)


def cold(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Return poses of uniform joint samples."""
    return _reachable("cold", robot, [robot.sample(rng) for _ in range(count)])


def limits(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Return poses with half of the limited joints, at least one, within 1 % of their limits."""
    tree = robot.tree
    limited = [
        k
        for k in range(tree.size)
        if tree.kind[k] != FREE and np.isfinite(robot.upper[tree.vadr[k]])
    ]
    if not limited:
        return _reachable("limits", robot, [], "no joint has limits")
    witnesses = []
    for _ in range(count):
        q = robot.sample(rng)
        chosen = [k for k in limited if rng.random() < 0.5]
        if not chosen:
            chosen = [limited[int(rng.integers(len(limited)))]]
        for k in chosen:
            _move_to_limit(robot, q, k, rng)
        witnesses.append(q)
    return _reachable("limits", robot, witnesses)


def _move_to_limit(robot: Robot, q: Array, k: int, rng: np.random.Generator) -> None:
    """Write a value near a limit of joint ``k`` into ``q`` (nq,)."""
    tree = robot.tree
    a = int(tree.qadr[k])
    v = int(tree.vadr[k])
    share = NEAR_LIMIT * rng.random()
    lower = float(robot.lower[v])
    upper = float(robot.upper[v])
    if tree.kind[k] == BALL:
        half_angle = 0.5 * upper * (1.0 - share)
        axis = q[a + 1 : a + 4] / np.linalg.norm(q[a + 1 : a + 4])
        q[a] = math.cos(half_angle)
        q[a + 1 : a + 4] = math.sin(half_angle) * axis
    else:
        inward = share * (upper - lower)
        q[a] = lower + inward if rng.random() < 0.5 else upper - inward


def unreachable(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Return poses outside the ball that the tool cannot leave. No joint angles reach them."""
    ball = robot.reach()
    targets = []
    if ball is not None:
        centre, radius = ball
        for _ in range(count):
            pose = robot.measure(robot.sample(rng)).matrix
            direction = pose[:3, 3] - centre
            direction = direction / np.linalg.norm(direction)
            pose[:3, 3] = centre + direction * radius * rng.uniform(*BEYOND)
            targets.append(pose)
    reason = (
        "" if targets else "its reach is not bounded: the base floats, or a slide has no limits"
    )
    return ProblemSet(
        "unreachable",
        np.array(targets).reshape(-1, 4, 4),
        np.empty((0, robot.nq)),
        robot.home,
        reason=reason,
    )


def singular(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Return poses whose joint angles make the Jacobian of the tool lose a rank."""
    ancestors = robot.tree.ancestors(robot.attachment()[0])
    if robot.tree.kind[ancestors[0]] == FREE:
        return _reachable("singular", robot, [], "a floating base is never singular")
    samples = [robot.jacobian(robot.sample(rng)) for _ in range(5)]
    rank = max(int(np.linalg.matrix_rank(jacobian, tol=1e-6)) for jacobian in samples)
    witnesses: list[Array] = []
    for number in range(_SAMPLES * count):
        if len(witnesses) == count or (number == _FIRST_SAMPLES and not witnesses):
            break
        q = _to_singular(robot, robot.sample(rng), rank)
        if q is not None:
            witnesses.append(q)
    reason = "no singular joint angles were found inside the limits"
    return _reachable("singular", robot, witnesses, reason)


def _to_singular(robot: Robot, q: Array, rank: int) -> Array | None:
    """Return singular joint angles (nq,) near ``q``, or None.

    It is Newton's method on the smallest singular value.
    """
    for _ in range(_NEWTON_STEPS):
        left, sigma, right = np.linalg.svd(robot.jacobian(q), full_matrices=False)
        if sigma[rank - 1] < SINGULAR * sigma[0]:
            return q if not robot.outside(q) else None
        slope = _slope(robot, q, left[:, rank - 1], right[rank - 1])
        squared = float(slope @ slope)
        if squared < 1e-12:
            return None
        step = -sigma[rank - 1] / squared * slope
        step *= min(1.0, _LONGEST_STEP / float(np.linalg.norm(step)))
        q = robot.clip(robot.integrate(q, step))
    return None


def _slope(robot: Robot, q: Array, u: Array, v: Array) -> Array:
    """Return the gradient (nv,) of the singular value u·J·v, by central differences."""
    h = 1e-5
    slope = np.zeros(robot.nv)
    for i in range(robot.nv):
        dq = np.zeros(robot.nv)
        dq[i] = h
        forward = robot.jacobian(robot.integrate(q, dq))
        backward = robot.jacobian(robot.integrate(q, -dq))
        slope[i] = u @ (forward - backward) @ v / (2.0 * h)
    return slope


def warm(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Return poses along a smooth joint path about home, in steps of at most 5 mm and 0.5°."""
    path = _path(robot, rng)
    first = path(0.0)
    pose = robot.measure(first)
    t = 0.0
    dt = 0.02
    targets: list[Array] = []
    witnesses: list[Array] = []
    while len(targets) < count:
        for _ in range(_BISECTIONS):
            candidate = robot.measure(path(t + dt))
            distance, angle = candidate.distance(pose)
            ratio = max(distance / WARM_METRES, angle / WARM_RADIANS)
            if 0.98 < ratio <= 1.0:  # nearly the longest step
                break
            dt *= min(1.5, 0.99 / ratio) if ratio > 0.0 else 1.5
        t = t + dt
        pose = candidate
        targets.append(pose.matrix)
        witnesses.append(path(t))
    return ProblemSet(
        "warm",
        np.array(targets).reshape(-1, 4, 4),
        np.array(witnesses),
        first,
        tracking=True,
    )


def _path(robot: Robot, rng: np.random.Generator) -> Callable[[float], Array]:
    """Return a smooth path of joint angles (nq,) inside the limits, as a function of time."""
    tree = robot.tree
    amplitude = np.array([_AMPLITUDE[int(tree.kind[k])] for k in tree.dof_node])
    middle = robot.home.copy()
    for k in range(tree.size):
        a = int(tree.qadr[k])
        v = int(tree.vadr[k])
        span = robot.upper[v] - robot.lower[v]
        if tree.kind[k] in (HINGE, SLIDE) and np.isfinite(span):
            amplitude[v] = min(amplitude[v], 0.45 * span)
            margin = amplitude[v] + 1e-3 * span
            middle[a] = np.clip(middle[a], robot.lower[v] + margin, robot.upper[v] - margin)
    index = np.arange(robot.nv)
    frequency = 1.0 + 0.37 * np.sqrt(index + 1.0)
    phase = 0.9 * index + rng.uniform(0.0, 2.0 * math.pi)

    def path(t: float) -> Array:
        dq = amplitude * np.sin(frequency * t + phase)
        return robot.clip(robot.integrate(middle, dq))

    return path


SETS: dict[str, Callable[[Robot, int, np.random.Generator], ProblemSet]] = {
    "cold": cold,
    "warm": warm,
    "singular": singular,
    "limits": limits,
    "unreachable": unreachable,
}
"""Every kind of problem set, by name."""
