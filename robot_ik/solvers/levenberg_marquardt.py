"""Levenberg-Marquardt with joint limits as constraints of each step: the default numeric method.

Each step minimises ½ ‖J d − r‖² + ½ λ ‖d‖² inside the joint limits (an active-set solve), with λ in
proportion to the cost, as Chan & Lawrence (General inverse kinematics with the error damped
pseudoinverse, ICRA 1988) have it; a step that made things worse is taken back and λ raised
(Marquardt 1963).  Short tries from random starts replace long ones that creep.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from robot_ik.kernels import jit
from robot_ik.kernels.couplings import follow
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.levels import (
    better,
    keep_levels,
    leave_level,
    level_costs,
    level_met,
    restore,
    stacked_step,
)
from robot_ik.kernels.linalg import box_step, normal_equations
from robot_ik.kernels.loop import (
    advance,
    apply_step,
    begin,
    copy,
    draw,
    measure,
    proceed,
    record,
    room,
)
from robot_ik.kernels.residuals import goal_jacobian, open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import (
    ACCEPTED,
    BEST_COST,
    BLOCKED,
    CONVERGED,
    COST,
    DAMPING,
    FIRST_STEPS,
    ITERATION_LIMIT,
    ITERATIONS,
    MAX_ITERATIONS,
    MAX_RESTARTS,
    NO_LIMIT,
    PRESSED,
    RESTARTS,
    RUNNING,
    SLICE_END,
    STAGE,
    STALLED,
    STALLS,
    STATUS,
    TRY_STEPS,
    UNREACHABLE,
    open_work,
)
from robot_ik.problem import Problem
from robot_ik.solvers.base import Answers, IterativeSolver, option

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LevenbergMarquardt(IterativeSolver):
    """Damped Gauss-Newton inside the joint limits; adaptive damping, seeded restarts."""

    # Chosen for the fewest steps, mean and 99th percentile, on 3000 cold poses each of PUMA 560, UR5e and
    # Panda; of 30 000 such poses two needed more than 200 restarts, none 500.
    restarts: int = option(1000, "random restarts when a try stalls", low=0, high=100_000)
    try_steps: int = option(20, "steps granted to a try from a random point", low=1, high=100_000)
    progress: float = option(0.1, "smallest drop of the cost that counts as progress", low=0.0, high=1.0)
    damping: float = option(0.1, "damping per unit of cost at the start of a try", low=1e-9, high=1e3)
    increase: float = option(4.0, "factor on the damping when a step failed", low=1.01, high=100.0)
    decrease: float = option(0.7, "factor on the damping when a step helped", low=0.01, high=1.0)
    least: float = option(0.05, "smallest damping per unit of cost", low=0.0, high=1e3)
    floor: float = option(1e-12, "damping that always remains", low=0.0, high=1.0)

    name: ClassVar[str] = "lm"
    title: ClassVar[str] = "Levenberg-Marquardt inside the joint limits, with restarts"
    parts: ClassVar[bool] = True
    honours: ClassVar[frozenset[str]] = frozenset({"couplings", "stiffness", "priorities"})
    source: ClassVar[str] = "Marquardt 1963; Chan & Lawrence, ICRA 1988"

    def kernel(self) -> Callable[..., None]:
        return lm

    def kernel_for(self, problem: Problem) -> Callable[..., None]:
        return lm_levels if "priorities" in problem.features else lm

    def parameters(self) -> tuple[float, ...]:
        return (self.floor, self.damping, self.increase, self.decrease, self.least)

    def solve_many(self, problem: Problem, targets: Array, starts: Array, answers: Answers) -> None:
        self.require_support(problem)
        if problem.budget.seconds is not None:
            super().solve_many(problem, targets, starts, answers)  # a clock can be read in Python only
            return
        jit.announce(lm_many, f"batches of solver {self.name!r}")
        self._set_state(problem)
        lm_many(
            problem.robot.tree.handle, problem.handle, problem.work, self._options,
            problem.arrays["state"].copy(), problem.rows_out_of_reach(targets), targets, starts,
            answers.q, answers.status, answers.miss,
        )  # fmt: skip


@outlined
def lm_step(tree, goal, work, options):
    """One damped Gauss-Newton step inside the limits; a step that made things worse is taken back first."""
    state, value, normal, damped = work.state, work.value, work.normal, work.damped
    floor, first, increase, decrease, least = options[0], options[1], options[2], options[3], options[4]
    n = work.gradient.shape[0]
    if value[COST] < value[ACCEPTED]:
        value[DAMPING] = first if state[TRY_STEPS] == 0 else max(value[DAMPING] * decrease, least)
        value[ACCEPTED] = value[COST]
        copy(work.q, work.accepted)
        goal_jacobian(tree, goal, work, work.frames)
        normal_equations(work.jacobian, work.residual, normal, work.gradient)
    else:
        value[DAMPING] *= increase
        value[COST] = value[ACCEPTED]
        copy(work.accepted, work.q)
    damping = value[DAMPING] * value[COST] + floor
    for i in range(n):
        for j in range(i):
            damped[i, j] = normal[i, j]
        damped[i, i] = normal[i, i] + damping
    room(tree, goal, work)
    pressed = box_step(
        damped, work.gradient, work.low, work.high, work.step, work.rhs, work.free, work.side, work.factor
    )
    if pressed < 0:  # not positive definite to working precision: more damping
        value[DAMPING] = value[DAMPING] * increase + 1e-9
        for i in range(n):
            work.step[i] = 0.0
    else:
        state[PRESSED] = pressed


@kernel
def lm(tree, goals, work, options):
    """Runs until ``proceed`` says stop; options: floor, start, increase, decrease, least."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        lm_step(tree, goal, work, options)
        advance(tree, goal, work)


@kernel
def lm_many(tree, goals, work, options, fresh, beyond, targets, starts, q, status, miss):
    """One solve for each row of targets (n, 12), starts (n, nq): fills q (n, nq), status (n,), miss (n, 2).

    ``fresh`` is the state a solve begins with; ``beyond`` (n,) says whose target is proven out of reach.
    """
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    target, start, state, now, best = goal.target, work.start, work.state, work.miss, work.best
    for row in range(targets.shape[0]):
        for i in range(12):
            target[0, i] = targets[row, i]
        for i in range(start.shape[0]):
            start[i] = starts[row, i]
        copy(fresh, state)
        if beyond[row]:
            state[MAX_RESTARTS], state[FIRST_STEPS] = 0, NO_LIMIT
        begin(tree, goal, work)
        while proceed(tree, goal, work):
            lm_step(tree, goal, work, options)
            advance(tree, goal, work)
        copy(best, work.q)
        measure(tree, goal, work)
        for i in range(best.shape[0]):
            q[row, i] = best[i]
        status[row] = UNREACHABLE if beyond[row] and state[STATUS] != CONVERGED else state[STATUS]
        miss[row, 0], miss[row, 1] = now[0, 0], now[0, 1]


# Steps without progress before a level is left as it is, and the share of its cost that counts as progress.
_LEVEL_PATIENCE, _LEVEL_PROGRESS = 8, 1e-6


@outlined
def level_step(tree, goal, work, options):
    """One step of the level that is being served; taken back unless it helps and harms no earlier level."""
    state, value = work.state, work.value
    floor, increase, decrease, least = options[0], options[2], options[3], options[4]
    stage = state[STAGE]
    before = work.level_cost[stage]
    copy(work.q, work.accepted)
    pressed = stacked_step(tree, goal, work, stage, value[DAMPING] * before + floor)
    apply_step(tree, goal, work.nodes, work.step, work.dq, work.q)
    measure(tree, goal, work)
    level_costs(goal, work, work.level_cost)
    helped = restore(tree, goal, work, stage) and work.level_cost[stage] < before
    if helped:
        state[PRESSED] = pressed
        value[DAMPING] = max(value[DAMPING] * decrease, least)
        state[STALLS] = 0 if work.level_cost[stage] < before * (1.0 - _LEVEL_PROGRESS) else state[STALLS] + 1
    else:
        copy(work.accepted, work.q)
        measure(tree, goal, work)
        level_costs(goal, work, work.level_cost)
        value[DAMPING] *= increase
        state[STALLS] += 1
    state[ITERATIONS] += 1
    if work.trace.shape[0] > 0:
        record(state, value, work.miss, work.trace)


@outlined
def end_try(tree, goal, work):
    """After the last level: done, another random start, or the best of all; the first level decides.

    Later levels are served from where the first one was met: nothing starts anew for them.
    """
    state, levels = work.state, work.level_cost.shape[0]
    for level in range(state[STAGE], levels):
        leave_level(goal, work, level)
    if better(work, levels):
        keep_levels(work)
        work.value[BEST_COST] = work.value[COST]
    met = True
    for level in range(levels):
        met = met and work.level_bar[level] < 0.0
    if met:
        state[STATUS] = CONVERGED
    elif state[ITERATIONS] >= state[MAX_ITERATIONS]:
        state[STATUS] = ITERATION_LIMIT
    elif work.level_best[0] < 0.0 or state[RESTARTS] >= state[MAX_RESTARTS]:
        state[STATUS] = BLOCKED if state[PRESSED] > 0 else STALLED
    else:
        state[RESTARTS] += 1
        draw(tree, work.nodes, work.start, state, work.q)
        follow(tree, work.q)
        measure(tree, goal, work)
        level_costs(goal, work, work.level_cost)
        state[STAGE] = 0


@kernel
def lm_levels(tree, goals, work, options):
    """``lm`` for goals of several priorities; options as there."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    state, levels = work.state, work.level_cost.shape[0]
    if state[STATUS] != RUNNING:
        begin(tree, goal, work)
        level_costs(goal, work, work.level_cost)
        for level in range(levels):
            work.level_best[level] = math.inf
        work.value[DAMPING] = options[1]
    while state[STATUS] == RUNNING and state[ITERATIONS] < state[SLICE_END]:
        stage = state[STAGE]
        if stage >= levels or state[ITERATIONS] >= state[MAX_ITERATIONS]:
            end_try(tree, goal, work)
            continue
        if level_met(goal, work, stage) or state[STALLS] >= _LEVEL_PATIENCE:
            leave_level(goal, work, stage)
            restore(tree, goal, work, stage + 1)
            state[STAGE], state[STALLS] = stage + 1, 0
            work.value[DAMPING] = options[1]
            continue
        level_step(tree, goal, work, options)
