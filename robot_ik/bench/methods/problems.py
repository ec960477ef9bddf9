"""Seeded problem sets: poses of a robot's tool, each made from joint angles that meet it.

The same robot, count and seed give the same numbers.  ``cold`` and ``warm`` are made as the well-known
comparisons of libraries make them: uniform joint samples from home, and a smooth path in small steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE
from robot_ik.ports import Array
from robot_ik.robot import Robot

#: Beyond a limit or a tolerance by so little is rounding, not an error (rad, m, or share of the tolerance).
SLACK = 1e-9
#: Largest step of the tool between two warm poses: the pace of a slow hand at 100 Hz.
WARM_METRES, WARM_RADIANS = 0.005, math.radians(0.5)
#: A joint of the set ``limits`` is within this share of its range from an end of it.
NEAR_LIMIT = 0.01
#: A Jacobian counts as singular when its smallest singular value is below this share of the largest.
SINGULAR = 1e-9
#: How far outside the ball that holds all reachable points the targets of ``unreachable`` lie, in radii.
BEYOND = (1.05, 3.0)

_AMPLITUDE = {HINGE: 0.5, SLIDE: 0.5, BALL: 0.3, FREE: 0.1}  # of a warm path: rad or m
_NEWTON_STEPS = 40
_TRIES = 20  # samples that may fail for each one kept …
_GIVE_UP = 6  # … and in a row at the beginning: such a robot is hardly ever singular


@dataclass(frozen=True, eq=False)
class ProblemSet:
    """Targets for the tool, with the joint angles they were made from.

    Attributes:
        targets: (n, 4, 4) poses in the world.
        witnesses: (n, nq) joint angles inside the limits that meet them; (0, nq) if nothing can.
        first: (nq,) where the first solve starts.
        tracking: Whether each solve starts at the solution before it; otherwise all start at ``first``.
        reason: Why there are no problems, if there are none.
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
    """``count`` problems of one kind, a key of ``SETS``, for the tool; equal seeds give equal numbers.

    The set is empty, with a reason, where the robot cannot have such problems.
    """
    # A stream of its own for each kind: asking for one set more changes no other.
    rng = np.random.default_rng([seed, *name.encode()])
    return SETS[name](robot, count, rng)


def _reachable(name: str, robot: Robot, witnesses: list[Array], reason: str = "") -> ProblemSet:
    targets = np.array([robot.measure(q).matrix for q in witnesses]).reshape(-1, 4, 4)
    angles = np.array(witnesses).reshape(-1, robot.nq)
    return ProblemSet(name, targets, angles, robot.home, reason="" if witnesses else reason)


def cold(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Poses of uniform joint samples; every solve starts at home."""
    return _reachable("cold", robot, [robot.sample(rng) for _ in range(count)])


def limits(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """As ``cold``, but half of the limited joints, or one, stand within 1 % of their range from its end."""
    tree = robot.tree
    limited = [k for k in range(tree.size) if tree.kind[k] != FREE and np.isfinite(robot.upper[tree.vadr[k]])]
    if not limited:
        return _reachable("limits", robot, [], "no joint has limits")
    found = []
    for _ in range(count):
        q = robot.sample(rng)
        chosen = [k for k in limited if rng.random() < 0.5] or [limited[int(rng.integers(len(limited)))]]
        for k in chosen:
            a, v, share = int(tree.qadr[k]), int(tree.vadr[k]), NEAR_LIMIT * rng.random()
            low, high = float(robot.lower[v]), float(robot.upper[v])
            if tree.kind[k] == BALL:
                half = 0.5 * high * (1.0 - share)
                axis = q[a + 1 : a + 4] / np.linalg.norm(q[a + 1 : a + 4])
                q[a], q[a + 1 : a + 4] = math.cos(half), math.sin(half) * axis
            else:
                inward = share * (high - low)
                q[a] = low + inward if rng.random() < 0.5 else high - inward
        found.append(q)
    return _reachable("limits", robot, found)


def unreachable(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Poses outside the ball that the tool cannot leave: nothing can reach them."""
    ball = robot.reach()
    targets = []
    for _ in range(count):
        if ball is None:
            break
        centre, radius = ball
        pose = robot.measure(robot.sample(rng)).matrix
        direction = pose[:3, 3] - centre
        pose[:3, 3] = centre + direction / np.linalg.norm(direction) * radius * rng.uniform(*BEYOND)
        targets.append(pose)
    reason = "" if targets else "nothing is out of its reach: the base floats, or a slide has no end"
    empty = np.empty((0, robot.nq))
    return ProblemSet("unreachable", np.array(targets).reshape(-1, 4, 4), empty, robot.home, reason=reason)


# ------------------------------------------------------------------------------------- singular


def singular(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Poses whose joint angles make the Jacobian of the tool lose a rank; every solve starts at home."""
    chain = robot.tree.ancestors(robot.attachment()[0])
    if robot.tree.kind[chain[0]] == FREE:
        return _reachable("singular", robot, [], "a floating base is never singular")
    rank = max(int(np.linalg.matrix_rank(robot.jacobian(robot.sample(rng)), tol=1e-6)) for _ in range(5))
    found: list[Array] = []
    for tried in range(_TRIES * count):
        if len(found) == count or (tried == _GIVE_UP and not found):
            break
        q = _to_singular(robot, robot.sample(rng), rank)
        if q is not None:
            found.append(q)
    return _reachable("singular", robot, found, "no singular joint angles were found inside the limits")


def _to_singular(robot: Robot, q: Array, rank: int) -> Array | None:
    """The singular joint angles near ``q``, by Newton's method on the smallest singular value, or None."""
    for _ in range(_NEWTON_STEPS):
        left, sigma, right = np.linalg.svd(robot.jacobian(q), full_matrices=False)
        if sigma[rank - 1] < SINGULAR * sigma[0]:
            return q if not robot.outside(q) else None
        slope = _slope(robot, q, left[:, rank - 1], right[rank - 1])
        length = float(slope @ slope)
        if length < 1e-12:
            return None
        step = -sigma[rank - 1] / length * slope
        # A long step leaves the neighbourhood in which the slope means anything.
        step *= min(1.0, 0.5 / float(np.linalg.norm(step)))
        q = robot.clip(robot.integrate(q, step))
    return None


def _slope(robot: Robot, q: Array, u: Array, v: Array) -> Array:
    """(nv,) change of the singular value u·J·v per unit of each dof, by central differences."""
    h, slope = 1e-5, np.zeros(robot.nv)
    for i in range(robot.nv):
        dq = np.zeros(robot.nv)
        dq[i] = h
        forward = robot.jacobian(robot.integrate(q, dq))
        back = robot.jacobian(robot.integrate(q, -dq))
        slope[i] = u @ (forward - back) @ v / (2.0 * h)
    return slope


# ----------------------------------------------------------------------------------------- warm


def warm(robot: Robot, count: int, rng: np.random.Generator) -> ProblemSet:
    """Poses along a smooth joint path about home, each at most 5 mm and 0.5° from the one before it."""
    path = _path(robot, rng)
    t, dt = 0.0, 0.02
    pose, first = robot.measure(path(0.0)), path(0.0)
    targets: list[Array] = []
    witnesses: list[Array] = []
    while len(targets) < count:
        for _ in range(60):  # until the step is just as long as it may be
            there = robot.measure(path(t + dt))
            metres, radians = there.distance(pose)
            ratio = max(metres / WARM_METRES, radians / WARM_RADIANS)  # of the longest that is allowed
            if 0.98 < ratio <= 1.0:
                break
            dt *= min(1.5, 0.99 / ratio) if ratio > 0.0 else 1.5
        t, pose = t + dt, there
        targets.append(there.matrix)
        witnesses.append(path(t))
    return ProblemSet("warm", np.array(targets).reshape(-1, 4, 4), np.array(witnesses), first, tracking=True)


def _path(robot: Robot, rng: np.random.Generator) -> Callable[[float], Array]:
    tree = robot.tree
    amplitude = np.array([_AMPLITUDE[int(tree.kind[k])] for k in tree.dof_node])
    middle = robot.home.copy()
    for k in range(tree.size):
        a, v = int(tree.qadr[k]), int(tree.vadr[k])
        span = robot.upper[v] - robot.lower[v]
        if tree.kind[k] in (HINGE, SLIDE) and np.isfinite(span):
            amplitude[v] = min(amplitude[v], 0.45 * span)
            margin = amplitude[v] + 1e-3 * span
            middle[a] = np.clip(middle[a], robot.lower[v] + margin, robot.upper[v] - margin)
    index = np.arange(robot.nv)
    pace, phase = 1.0 + 0.37 * np.sqrt(index + 1.0), 0.9 * index + rng.uniform(0.0, 2.0 * math.pi)
    return lambda t: robot.clip(robot.integrate(middle, amplitude * np.sin(pace * t + phase)))


#: Every kind of problem set, by name.
SETS: dict[str, Callable[[Robot, int, np.random.Generator], ProblemSet]] = {
    "cold": cold,
    "warm": warm,
    "singular": singular,
    "limits": limits,
    "unreachable": unreachable,
}
