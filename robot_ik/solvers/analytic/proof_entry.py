"""The entry points of the proofs, one for each family: compiled when a goal is first missed."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from robot_ik.kernels.jit import kernel, pure
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.work import CONVERGED, UNREACHABLE
from robot_ik.solvers.analytic.form import invert, open_form
from robot_ik.solvers.analytic.geometry import Family
from robot_ik.solvers.analytic.intervals import length
from robot_ik.solvers.analytic.proof import (
    limb_is_out_of_reach,
    planar_is_out_of_reach,
    wrist_is_out_of_reach,
)
from robot_ik.solvers.analytic.proof_parallel import parallel_is_out_of_reach
from robot_ik.solvers.analytic.six_axes import centre


@pure
def aim_at(form, targets, row):
    """Moves the form's target."""
    for i in range(12):
        form.target[0, i] = targets[row, i]


@kernel
def prove_planar(goals, form, targets, status):
    """UNREACHABLE in ``status`` (n,) for those of ``targets`` (n, 12), of the missed, that are proven so."""
    form, goal = open_form(form), open_goals(goals)
    for row in range(targets.shape[0]):
        if status[row] == CONVERGED:
            continue
        aim_at(form, targets, row)
        if planar_is_out_of_reach(form.axes, form.extra, form.target, form.lower, form.upper, goal.tolerance):
            status[row] = UNREACHABLE


@kernel
def prove_wrist(goals, form, targets, status):
    """The same for a spherical wrist."""
    form, goal = open_form(form), open_goals(goals)
    lever = length(form.extra[1, 0], form.extra[1, 1], form.extra[1, 2])
    for row in range(targets.shape[0]):
        if status[row] == CONVERGED:
            continue
        aim_at(form, targets, row)
        if wrist_is_out_of_reach(
            form.axes, form.extra, form.target, form.lower, form.upper, goal.tolerance, lever
        ):
            status[row] = UNREACHABLE


@kernel
def prove_shoulder(goals, form, targets, status):
    """The same for a spherical shoulder: the lever is from the goal to it."""
    form, goal = open_form(form), open_goals(goals)
    for row in range(targets.shape[0]):
        if status[row] == CONVERGED:
            continue
        aim_at(form, targets, row)
        invert(form.target, form.inverse)
        x, y, z = centre(form.inverse, form.extra)
        if wrist_is_out_of_reach(
            form.axes, form.extra, form.inverse, form.lower, form.upper, goal.tolerance, length(x, y, z)
        ):
            status[row] = UNREACHABLE


@kernel
def prove_parallel(goals, form, targets, status):
    """The same for three parallel axes."""
    form, goal = open_form(form), open_goals(goals)
    for row in range(targets.shape[0]):
        if status[row] == CONVERGED:
            continue
        aim_at(form, targets, row)
        if parallel_is_out_of_reach(
            form.axes, form.extra, form.target, form.lower, form.upper, goal.tolerance
        ):
            status[row] = UNREACHABLE


@kernel
def prove_limb(goals, form, targets, status):
    """The same for a limb."""
    form, goal = open_form(form), open_goals(goals)
    for row in range(targets.shape[0]):
        if status[row] == CONVERGED:
            continue
        aim_at(form, targets, row)
        if limb_is_out_of_reach(form, goal.tolerance):
            status[row] = UNREACHABLE


PROOFS: dict[Family, Callable[[Any, Any, Any, Any], None]] = {
    Family.PLANAR_TWO_LINK: prove_planar,
    Family.SPHERICAL_WRIST: prove_wrist,
    Family.SPHERICAL_SHOULDER: prove_shoulder,
    Family.THREE_PARALLEL: prove_parallel,
    Family.LIMB: prove_limb,
}
