"""Shared parts of the Jacobian methods: clamped residual, bounds, largest change of a joint.

A step is computed as follows. The method supplies the middle line:

    prepare(tree, goals, search, box, clamp, alternative)
    fix_pushed_by_gradient(search, box)
    for _ in range(search.step.shape[0] + 1):
        ...                              # writes search.step from box.jacobian and box.residual
        if fix_pushed_by_step(search, box) < 0:
            break
    keep_inside(box, search.step)
    limit(search.step, gain, max_step)

A *fixed* joint is at its bound, and the step would move it beyond. Its column is zero, so that the
other joints make up for it and it does not limit them. Joints inside their range are never fixed.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.kernels.linalg import AT_BOUND, pushed_out
from robot_ik.kernels.residuals import clamp_residual, goal_jacobian
from robot_ik.kernels.search import POLISH, step_bounds

# Damping per length of the residual that the first failed step of the polish adds.
_POLISH_DAMPING = 0.1

# Singular vectors of the Jacobian, see ``linalg.svd``. With l = min(m, u).
SINGULAR = Layout("Singular", left="table l m", sigma="floats l", right="table l u")


@outlined
def prepare(tree, goals, search, box, clamp, alternative):
    """Write the Jacobian, the clamped residual and the bounds at q to ``box``.

    The polish uses no alternative Jacobian and clamps all goals by the same factor, so it ends at a
    minimum of the cost.
    """
    polishing = search.phase == POLISH
    goal_jacobian(tree, goals, search, alternative and not polishing, box.jacobian)
    clamp_residual(goals, search.residual, clamp, polishing, box.residual)
    step_bounds(tree, goals, search.q, box.lower, box.upper)


@inlined
def fix_joint(box, u):
    """Remove joint ``u`` from this step."""
    box.side[u] = 1
    for r in range(box.residual.shape[0]):
        box.jacobian[r, u] = 0.0


@outlined
def fix_pushed_by_gradient(search, box):
    """Write box.gradient; fix the joints at a bound that it pushes out (Kuhn and Tucker).

    The gradient of a fixed joint is zero.
    """
    search.pressed = 0
    for u in range(box.gradient.shape[0]):
        box.side[u] = 0
        slope = 0.0
        for r in range(box.residual.shape[0]):
            slope += box.jacobian[r, u] * box.residual[r]
        box.gradient[u] = slope
        if pushed_out(box.lower[u], box.upper[u], slope) != 0:
            fix_joint(box, u)
            box.gradient[u] = 0.0
            search.pressed += 1


@outlined
def fix_pushed_by_step(search, box):
    """Fix the joint at a bound that search.step pushes out most; return it, or -1 if there is none.

    One joint is fixed at a time. The steps of the remaining joints still reduce the cost.
    """
    worst = -1
    farthest = AT_BOUND
    for u in range(search.step.shape[0]):
        outward = 0.0
        if box.lower[u] > -AT_BOUND:
            outward = -search.step[u]
        if box.upper[u] < AT_BOUND:
            outward = max(outward, search.step[u])
        if outward > farthest:
            worst = u
            farthest = outward
    if worst >= 0:
        fix_joint(box, worst)
        search.pressed += 1
    return worst


@outlined
def keep_inside(box, step):
    """Clip ``step`` in place to the bounds; return the share of it that is left.

    If clipping single joints would raise the cost, the whole step is shortened. Else the share
    is 1.
    """
    columns = step.shape[0]
    share = 1.0
    for u in range(columns):
        if box.side[u] != 0:
            step[u] = 0.0
        elif step[u] > box.upper[u]:
            share = min(share, box.upper[u] / step[u])
        elif step[u] < box.lower[u]:
            share = min(share, box.lower[u] / step[u])
    if share >= 1.0:
        return 1.0
    before = 0.0
    after = 0.0
    for r in range(box.residual.shape[0]):
        left = box.residual[r]
        before += left * left
        for u in range(columns):
            left -= box.jacobian[r, u] * min(max(step[u], box.lower[u]), box.upper[u])
        after += left * left
    if after < before:
        share = 1.0
    for u in range(columns):
        step[u] = min(max(share * step[u], box.lower[u]), box.upper[u])
    return share


@outlined
def limit(step, gain, max_step):
    """Scale ``step`` in place by ``gain``, but no joint beyond ``max_step``; return the scale."""
    largest = 0.0
    for u in range(step.shape[0]):
        largest = max(largest, abs(gain * step[u]))
    share = gain * max_step / largest if largest > max_step else gain
    for u in range(step.shape[0]):
        step[u] *= share
    return share


@inlined
def shorten_in_polish(search):
    """Scale search.step by the share that the polish takes: less after each bad step."""
    if search.phase == POLISH:
        for u in range(search.step.shape[0]):
            search.step[u] *= search.step_share


@inlined
def polish_damping(search):
    """Return the λ² that a method can add in the polish in place of ``shorten_in_polish``.

    More damping shortens the next step and turns it towards the steepest descent. Near a
    stretched-out arm a shorter step of the same direction would stay at the same cost.
    """
    if search.phase != POLISH:
        return 0.0
    return _POLISH_DAMPING * math.sqrt(2.0 * search.cost) * (1.0 / search.step_share - 1.0)


@outlined
def filtered_step(box, singular, cutoff, damping, step):
    """Write Σ σ/(σ² + λ²) (u·e) v over σ > cutoff σ₁ to ``step``, from the singular vectors.

    λ = 0 is the pseudoinverse, λ > 0 damped least squares (Buss 2004, sections 4 and 6).
    """
    sigma = singular.sigma
    for u in range(step.shape[0]):
        step[u] = 0.0
    for i in range(sigma.shape[0]):
        s = sigma[i]
        if not s > cutoff * sigma[0]:
            continue
        part = 0.0
        for r in range(box.residual.shape[0]):
            part += singular.left[i, r] * box.residual[r]
        part *= s / (s * s + damping * damping)
        for u in range(step.shape[0]):
            step[u] += part * singular.right[i, u]
