"""Minimisation by a variable metric, projected on the active limits: G(q) = ½ |r|² over the joint box.

Zhao & Badler (Inverse kinematics positioning using nonlinear programming for highly articulated figures,
ACM Transactions on Graphics 13(4), 1994): BFGS steps d = H g, g = −∇G = Jᵀr, in a metric from which the
active linear constraints are projected (Rosen 1960; Goldfarb 1969), with a line search; so the cost never
rises within a try.  Their linear equalities between joints are kept by construction (coupled joints have
no columns of their own), their rigidity of joints is the robot's stiffness.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels.cones import carry, slope_left
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.loop import advance, begin, copy, measure, proceed
from robot_ik.kernels.metric import constrain, direction, displacement, learn, reset, slopes
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.room import apply_step
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import COST, NO_LIMIT, STALLS, TRY_STEPS, UPDATES, open_work
from robot_ik.solvers.base import IterativeSolver, option

# Points tried along one direction before it is given up.
_TRIALS = 30


@dataclass(frozen=True)
class Minimization(IterativeSolver):
    """Downhill at every step, whatever the goals are; needs no system of equations to be solved."""

    # Chosen for few steps, mean and 99th percentile, on 400 cold poses each of PUMA 560, UR5e and Panda,
    # to 1 µm and 1 µrad; curvatures of 0.1 … 0.99, tries of 30 … 150 steps and patience of 3 … 12 were tried.
    restarts: int = option(200, "random restarts when a try stalls", low=0, high=100_000)
    first_steps: int = option(150, "steps granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(150, "steps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(8, "steps without progress before a try is given up", low=1, high=1000)
    progress: float = option(0.02, "smallest drop of the cost that counts as progress", low=0.0, high=1.0)
    draws: int = option(4, "random points of which a try takes the best", low=1, high=1000)
    max_step: float = option(
        1.0, "largest change of one joint in a step", low=1e-4, high=1e6, unit="rad", usual=(0.0, 2.0)
    )
    decrease: float = option(1e-4, "share of the promised descent that a step must bring", low=1e-9, high=0.4)
    curvature: float = option(
        0.3, "share of the slope that may be left after a step", low=0.1, high=0.999, usual=(0.1, 0.999)
    )

    name: ClassVar[str] = "bfgs"
    title: ClassVar[str] = "minimisation by a variable metric (BFGS), projected on the limits"
    source: ClassVar[str] = "Zhao & Badler, ACM Transactions on Graphics 13(4), 1994"
    parts: ClassVar[bool] = True
    honours: ClassVar[frozenset[str]] = frozenset({"couplings", "stiffness"})

    def kernel(self) -> Callable[..., None]:
        return bfgs

    def parameters(self) -> tuple[float, ...]:
        return (self.max_step, self.decrease, self.curvature)


@outlined
def go(tree, goal, work, share):
    """Measures the point ``share`` of work.way from work.accepted, inside limits; returns what is promised.

    That is the descent which the slope promises for the way that is left of it at the limits.
    """
    step, low, high, way = work.step, work.low, work.high, work.way
    copy(work.accepted, work.q)
    for u in range(step.shape[0]):
        step[u] = min(max(share * way[u], low[u]), high[u])
    apply_step(tree, goal, work.nodes, step, work.dq, work.q)
    displacement(tree, goal, work)
    measure(tree, goal, work)
    promised = 0.0
    for u in range(step.shape[0]):
        promised += work.before[u] * work.moved[u]
    return promised


@outlined
def search(tree, goal, work, options, slope):
    """Goes down along work.way until enough is won and the slope has eased (Wolfe 1969).

    Returns whether a lower point was found: then work.q, work.step, work.gradient and work.moved are its own.
    A way that meets limits is bent along them, and searched for descent only.
    """
    max_step, decrease, curvature = options[0], options[1], options[2]
    cost, way = work.value[COST], work.way
    longest = 0.0
    for u in range(way.shape[0]):
        longest = max(longest, abs(way[u]))
    share = min(1.0, max_step / longest)
    good, bad = 0.0, 0.0
    for _ in range(_TRIALS):
        promised = go(tree, goal, work, share)
        won = cost - work.value[COST]
        if promised > 0.0 and won >= decrease * promised:
            slopes(tree, goal, work)
            bent = False
            for u in range(way.shape[0]):
                bent = bent or work.step[u] != share * way[u]
            if slope_left(tree, goal, work) <= curvature * slope or bent or 2.0 * share * longest > max_step:
                return True
            good = share
            share = 2.0 * share if bad == 0.0 else 0.5 * (good + bad)
        else:
            bad = share
            if good > 0.0:
                share = 0.5 * (good + bad)
            else:  # the parabola through both costs and the slope
                share *= min(max(0.5 * promised / (promised - won), 0.1), 0.5)
    if good > 0.0:
        go(tree, goal, work, good)
        slopes(tree, goal, work)
    return good > 0.0


@outlined
def bfgs_step(tree, goal, work, options):
    """work.step for one step downhill; zero, and the end of the try, where there is none."""
    state, cost = work.state, work.value[COST]
    if state[TRY_STEPS] == 0:
        slopes(tree, goal, work)
        reset(work)
    copy(work.q, work.accepted)
    for _ in range(2):
        constrain(tree, goal, work)
        slope = direction(tree, goal, work)
        copy(work.gradient, work.before)
        found = slope > 0.0 and search(tree, goal, work, options, slope)
        if found:
            carry(tree, goal, work)
            learn(work)
        copy(work.accepted, work.q)  # ``advance`` goes on from there
        work.value[COST] = cost
        if found:
            return
        if state[UPDATES] == 0:
            break
        reset(work)  # what was learned does not hold here: down the plain slope
    for u in range(work.step.shape[0]):
        work.step[u] = 0.0
    state[STALLS] = NO_LIMIT


@kernel
def bfgs(tree, goals, work, options):
    """Runs until ``proceed`` says stop; options: longest step, decrease, curvature."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        bfgs_step(tree, goal, work, options)
        advance(tree, goal, work)
