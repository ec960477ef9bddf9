"""Levenberg-Marquardt with joint limits as constraints of each step: the default numeric method.

Each step minimises ½ ‖J d − r‖² + ½ λ ‖d‖² inside the joint limits (an active-set solve), with λ in
proportion to the cost, as Chan & Lawrence (General inverse kinematics with the error damped
pseudoinverse, ICRA 1988) have it; a step that made things worse is taken back and λ raised
(Marquardt 1963).  Short tries from random starts, each the best of a few draws, replace long ones
that creep; in these a joint with a range of 2π wraps around rather than stop at its limit.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numba import types
from numpy.typing import NDArray

from robot_ik.kernels import jit, residuals
from robot_ik.kernels import workspace as ws
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.kinematics import dof_axis
from robot_ik.kernels.linalg import box_step, normal_equations, row_products, row_step
from robot_ik.kernels.loop import advance, begin, copy, give_row, measure, proceed, step_bounds, take_row
from robot_ik.kernels.residuals import clamp_residual, curvature, goal_jacobian, open_goals
from robot_ik.kernels.tree import HINGE, SLIDE, open_tree
from robot_ik.legacy_problem import LegacyProblem as Problem, Budget # Budget, Problem
from robot_ik.solvers.legacy_base import BatchResult, IterativeSolver, Run, option, options_of

Array = NDArray[np.float64]

# Beyond so many joints ``second_order`` costs more than the steps that it saves: it grows with the cube.
_MOST_JOINTS = 64
_NO_CLAMP = 1e6
# In the last descent the exact Hessian makes the steps.  They need little damping, and show when there is no
# more to gain: a share of the cost, of which rounding leaves some 1e-15.
_EXACT_DECREASE = 0.1
_NOTHING_LEFT = 1e-13


@pure
def has_second_order(tree, goal):
    """Whether ``second_order`` serves a problem: some hinges and slides, whole goals, nothing coupled."""
    if goal.coupled.shape[0] > 0 or goal.dofs.shape[0] > _MOST_JOINTS:
        return False
    for g in range(goal.kind.shape[0]):
        if goal.kind[g] == residuals.PARTIAL:
            return False
    for u in range(goal.dofs.shape[0]):
        joint = tree.kind[tree.dof_node[goal.dofs[u]]]
        if joint != HINGE and joint != SLIDE:
            return False
    return True


@outlined
def second_order(tree, goal, work, out):
    """Hessian of ½ |r|² less JᵀJ into the lower triangle of ``out`` (nu, nu); r and J are in the work space.

    Gauss-Newton leaves it out.  It vanishes with the residual; near the nearest point to a goal that cannot
    be met it decides how quickly a descent ends: without it each step takes off a fixed share of the way.
    Of two joints that move a goal the one with the smaller index is nearer to the root, a its axis.  A hinge
    there rotates the other's column of the position, v: ∂²p = a × v.  Of a rotation, with unit axes a, b,
    and φ = log(R_target Rᵀ), the Hessian of ½ |φ|² is a·b + k ((φ·a)(φ·b) − |φ|² a·b) − ½ φ·(a × b), as
    follows from φ' = −J_r⁻¹(φ) ω and b' = a × b (k of ``curvature``).
    """
    kinds, vadr, dof_node, joint_scale = tree.kind, tree.vadr, tree.dof_node, goal.joint_scale
    world, residual, jacobian = work.world, work.residual, work.jacobian
    n = goal.dofs.shape[0]
    for i in range(n):
        for j in range(i + 1):
            out[i, j] = 0.0
    for g in range(goal.kind.shape[0]):
        what, row, weight = goal.kind[g], goal.row[g], goal.weight[g, 1]
        angle_row = row if what == residuals.ORIENTATION else row + 3
        ex, ey, ez, fx, fy, fz, k, square = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if what != residuals.ORIENTATION:
            ex, ey, ez = residual[row], residual[row + 1], residual[row + 2]
        if what != residuals.POSITION and weight > 0.0:
            s = 1.0 / weight
            fx, fy, fz = s * residual[angle_row], s * residual[angle_row + 1], s * residual[angle_row + 2]
            k, square = curvature(fx, fy, fz), fx * fx + fy * fy + fz * fz
        for j in range(n):
            node = dof_node[goal.dofs[j]]
            if goal.moves[g, j] == 0:
                continue
            ax, ay, az, rotational = dof_axis(kinds, world, node, goal.dofs[j] - vadr[node])
            if not rotational:
                continue
            s = joint_scale[j]
            # e · (a × v) = v · (e × a), and φ · (a × b) = b · (φ × a).
            px, py, pz = s * (ey * az - ez * ay), s * (ez * ax - ex * az), s * (ex * ay - ey * ax)
            qx, qy, qz = fy * az - fz * ay, fz * ax - fx * az, fx * ay - fy * ax
            along = fx * ax + fy * ay + fz * az
            for i in range(j, n):
                if goal.moves[g, i] == 0:
                    continue
                if what != residuals.ORIENTATION:
                    out[i, j] -= px * jacobian[row, i] + py * jacobian[row + 1, i] + pz * jacobian[row + 2, i]
                if what == residuals.POSITION:
                    continue
                other = dof_node[goal.dofs[i]]
                bx, by, bz, other_rotational = dof_axis(kinds, world, other, goal.dofs[i] - vadr[other])
                if not other_rotational:
                    continue
                cosine = ax * bx + ay * by + az * bz
                hessian = cosine + k * (along * (fx * bx + fy * by + fz * bz) - square * cosine)
                hessian -= 0.5 * (qx * bx + qy * by + qz * bz)
                product = 0.0
                for r in range(angle_row, angle_row + 3):
                    product += jacobian[r, i] * jacobian[r, j]
                out[i, j] += weight * weight * s * joint_scale[i] * hessian - product


@dataclass(frozen=True)
class LevenbergMarquardt(IterativeSolver):
    """Damped Gauss-Newton inside the joint limits; adaptive damping, seeded restarts."""

    # Chosen for the least work, mean and 99th percentile, on 4000 cold poses each of PUMA 560, UR5e and
    # Panda; of 30 000 others two needed more than 200 restarts, none 600.
    restarts: int = option(1000, "random restarts when a try stalls", low=0, high=100_000)
    draws: int = option(5, "random points of which a try takes the best", low=1, high=1000)
    try_steps: int = option(30, "steps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(2, "steps without progress before a try is given up", low=1, high=1000)
    progress: float = option(0.3, "smallest drop of the cost that counts as progress", low=0.0, high=1.0)
    damping: float = option(
        0.2, "damping per unit of cost at the start of a try", low=1e-9, high=1e3, usual=(0.0, 2.0)
    )
    increase: float = option(
        10.0, "factor on the damping when a step failed", low=1.01, high=100.0, usual=(1.0, 20.0)
    )
    decrease: float = option(
        0.7, "factor on the damping when a step helped", low=0.01, high=1.0, usual=(0.0, 1.0)
    )
    least: float = option(0.02, "smallest damping per unit of cost", low=0.0, high=1e3)
    stride: float = option(
        1.2, "largest change of a joint in one step", low=1e-3, high=100.0, unit="rad, m", usual=(0.0, 3.0)
    )
    floor: float = option(1e-12, "damping that always remains", low=0.0, high=1.0)
    clamp: float = option(
        _NO_CLAMP, "longest residual of a goal taken in one step", low=1e-3, high=_NO_CLAMP, unit="rad"
    )
    gain: float = option(1.0, "share of each step that is taken", low=1e-6, high=2.0, usual=(0.0, 2.0))
    alternative: bool = option(False, "Jacobian at the target in place of the frame (alternative Jacobian)")

    name: ClassVar[str] = "lm"
    title: ClassVar[str] = "Levenberg-Marquardt inside the joint limits, with restarts"
    partial_goals: ClassVar[bool] = True
    capabilities: ClassVar[frozenset[str]] = frozenset({"couplings", "stiffness", "priorities", "soft"})
    source: ClassVar[str] = "Marquardt 1963; Chan & Lawrence, ICRA 1988"

    def kernel(self) -> Callable[..., None]:
        return lm

    def kernel_for(self, problem: Problem) -> Callable[..., None]:
        if not problem.has_levels:
            return lm
        from robot_ik.kernels.priorities import lm_levels  # which few problems need

        return lm_levels

    def unsupported(self, problem: Problem) -> str:
        guided = self.clamp < _NO_CLAMP or self.gain != 1.0 or self.alternative
        if guided and problem.has_levels:
            return "goals of different priorities, or soft ones, together with clamp, gain or alternative"
        return super().unsupported(problem)

    def tables(self, problem: Problem) -> tuple[Any, ...]:
        options = self.option_values
        if problem.has_levels:
            from robot_ik.kernels.priorities import LEVEL_OPTIONS

            options = np.array([getattr(self, name) for name in LEVEL_OPTIONS], dtype=float)
        return (problem.run_table(options),)

    def attempt_many(
        self, problem: Problem, targets: Array, starts: Array, results: BatchResult, budget: Budget
    ) -> None:
        run: Run = self.load(problem)
        if budget.seconds is not None:
            super().attempt_many(problem, targets, starts, results, budget)  # only Python can read a clock
            return
        jit.announce(lm_many, f"batches of solver {self.name!r}")
        fresh, value = self.fresh_state(budget, problem.seed)
        run.value[...] = value
        (address,) = run.arguments
        lm_many(
            address, fresh, targets, starts,
            results.q, results.status, results.miss, results.iterations, results.restarts,
        )  # fmt: skip


open_options = options_of(LevenbergMarquardt)


@pure
def stride_bounds(tree, goal, work, stride):
    """``step_bounds``, but no more than ``stride`` at once; in later tries joints may wrap around."""
    step_bounds(tree, goal, work)
    low, high, around = work.low, work.high, may_wrap(tree, work)
    for u in range(low.shape[0]):
        most = stride / goal.joint_scale[u]
        if around and can_wrap(tree, goal.dofs[u]):
            low[u], high[u] = -most, most
        else:
            low[u], high[u] = max(low[u], -most), min(high[u], most)


@pure
def may_wrap(tree, work):
    """Whether joints may wrap around: not where others follow, nor in the tries that stay near the start."""
    return work.state[ws.RESTARTS] > 0 and work.state[ws.POLISHING] == 0 and tree.coupled.shape[0] == 0


@pure
def can_wrap(tree, v):
    """Whether a joint has a whole revolution between its limits, so that wrapping loses no pose."""
    span = tree.upper[v] - tree.lower[v]
    return span >= 2.0 * math.pi and span < math.inf and tree.kind[tree.dof_node[v]] == HINGE


@pure
def wrap_around(tree, goal, work):
    """Where a step leads a joint past its limit, it goes on a whole revolution before."""
    for u in range(work.step.shape[0]):
        v = goal.dofs[u]
        if can_wrap(tree, v):
            joint_scale = goal.joint_scale[u]
            there = work.q[tree.qadr[tree.dof_node[v]]] + joint_scale * work.step[u]
            if there > tree.upper[v]:
                work.step[u] -= 2.0 * math.pi / joint_scale
            elif there < tree.lower[v]:
                work.step[u] += 2.0 * math.pi / joint_scale


@outlined
def lm_step(tree, goal, work, options):
    """One damped Gauss-Newton step inside the limits; a step that made things worse is taken back first.

    ``alternative`` and ``clamp`` are as in ``jacobian_step.prepare``.
    """
    state, value, normal, damped = work.state, work.value, work.normal, work.damped
    jacobian, gradient, low, high, step = work.jacobian, work.gradient, work.low, work.high, work.step
    wanted, last = work.wanted, state[ws.POLISHING] > 0
    floor, first, least = options.floor, options.damping, options.least
    increase, decrease = options.increase, options.decrease
    m, n = jacobian.shape
    exact = last and has_second_order(tree, goal)
    if value[ws.COST] < value[ws.ACCEPTED]:
        if exact:
            decrease, least = _EXACT_DECREASE, 0.0
        value[ws.DAMPING] = first if state[ws.TRY_STEPS] == 0 else max(value[ws.DAMPING] * decrease, least)
        value[ws.ACCEPTED] = value[ws.COST]
        copy(work.q, work.accepted)
        goal_jacobian(tree, goal, work, goal.target if options.alternative and not last else work.frames)
        copy(work.residual, wanted)  # a step that is taken back leaves another residual behind
        if options.clamp < _NO_CLAMP:
            clamp_residual(goal, work.residual, wanted, options.clamp, last)
        if exact:
            second_order(tree, goal, work, work.metric)
        if m < n and not exact:
            row_products(jacobian, wanted, goal.hits, goal.hit_count, normal, gradient)
        else:
            normal_equations(jacobian, wanted, normal, gradient)
    else:
        value[ws.DAMPING] *= increase
        value[ws.COST] = value[ws.ACCEPTED]
        copy(work.accepted, work.q)
    damping = value[ws.DAMPING] * value[ws.COST] + floor
    stride_bounds(tree, goal, work, options.stride)
    if exact:
        pressed = exact_step(work, damping)
    elif m < n:
        pressed = row_step(
            jacobian, wanted, normal, gradient, damping, low, high,
            goal.hits, goal.hit_count, step, work.free, work.side, work.factor, work.rhs,
        )  # fmt: skip
    else:
        for i in range(n):
            for j in range(i):
                damped[i, j] = normal[i, j]
            damped[i, i] = normal[i, i] + damping
        pressed = box_step(damped, gradient, low, high, step, work.free, work.side, work.factor)
    if pressed < 0:  # not positive definite to working precision: more damping
        value[ws.DAMPING] = value[ws.DAMPING] * increase + 1e-9
        for i in range(n):
            step[i] = 0.0
        return
    state[ws.PRESSED] = pressed
    if may_wrap(tree, work):
        wrap_around(tree, goal, work)
    for i in range(n):
        step[i] *= options.gain


@pure
def exact_step(work, damping):
    """The step to the exact Hessian where that is positive definite, else that of Gauss-Newton.

    Where it promises next to nothing the descent is over: its patience is spent at once.
    """
    normal, damped, low, high, step = work.normal, work.damped, work.low, work.high, work.step
    pressed = types.int64(-1)
    for second in (1.0, 0.0):
        if pressed < 0:
            for i in range(step.shape[0]):
                for j in range(i + 1):
                    damped[i, j] = normal[i, j] + second * work.metric[i, j]
                damped[i, i] += damping
            pressed = box_step(damped, work.gradient, low, high, step, work.free, work.side, work.factor)
    promised = 0.0
    for i in range(step.shape[0]):
        promised += work.gradient[i] * step[i]
    if pressed >= 0 and promised < _NOTHING_LEFT * work.value[ws.COST]:
        work.state[ws.STALLS] = ws.NO_LIMIT
    return pressed


@kernel
def lm(run):
    """Runs until ``proceed`` says stop."""
    run = ws.open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), ws.open_work(run.work)
    options = open_options(run.options)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        lm_step(tree, goal, work, options)
        advance(tree, goal, work)


@kernel
def lm_many(run, fresh, targets, starts, q, status, miss, iterations, restarts):
    """One solve for each row of targets (n, 12), starts (n, nq), from the state ``fresh``.

    Fills q (n, nq), status (n,), miss (n, 2), iterations (n,), restarts (n,).
    """
    run = ws.open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), ws.open_work(run.work)
    options = open_options(run.options)
    state = work.state
    for row in range(targets.shape[0]):
        take_row(goal, work, targets, starts, row)
        copy(fresh, state)
        begin(tree, goal, work)
        while proceed(tree, goal, work):
            lm_step(tree, goal, work, options)
            advance(tree, goal, work)
        status[row], restarts[row] = state[ws.STATUS], state[ws.RESTARTS]
        if status[row] != ws.CONVERGED:  # else it has just been measured
            copy(work.best, work.q)
            measure(tree, goal, work)
            if state[ws.ANY_UNREACHABLE] == 1:
                status[row] = ws.UNREACHABLE
        give_row(work, q, miss, iterations, row)
