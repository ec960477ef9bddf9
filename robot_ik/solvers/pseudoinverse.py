"""Pseudoinverse: d = J⁺ e + (I − J⁺J) φ, with a stated cut-off of small singular values.

Whitney (Resolved motion rate control of manipulators, IEEE T-MMS 10(2), 1969); null space after Liégeois
(Automatic supervisory control of the configuration and behavior of multibody mechanisms, IEEE T-SMC 7(12),
1977): φ is the slope of what is wanted besides the goals.  Goal halving is Aho's (Implementation of
articulated mechanisms in computer animation, 2000, section 4.6): a step that does not land near enough to
its (sub)goal is undone and half the way tried.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels import jacobian_step as steps
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.kinematics import difference, follow, integrate
from robot_ik.kernels.linalg import pushed_out
from robot_ik.kernels.loop import advance, apply_step, begin, copy, measure, proceed
from robot_ik.kernels.residuals import goal_jacobian, open_goals
from robot_ik.kernels.tree import BALL, FREE, open_tree
from robot_ik.kernels.workspace import POLISHING, open_work
from robot_ik.solvers.legacy_base import option, options_of
from robot_ik.solvers.families import JacobianSolver

# What the null space is used for; ``AIMS[code]`` is the name of the option.
AIMS = ("none", "rest", "limits", "manipulability")
NONE, REST, LIMITS, MANIPULABILITY = range(4)

# Half the distance, rad or m, over which the slope of the manipulability is taken.
_PROBE = 1e-4
# Half a range of this size, rad or m, is none.
_UNLIMITED = 1e9


@outlined
def off_limits(tree, q, dq):
    """dq = (middle − q) / half range: where the limits are far; unlimited joints have no aim.

    Liégeois's −½ Σ ((q − middle) / half)² rises that way, each joint measured by its own range.  A ball's
    middle is no rotation at all, and half its range the angle of its cone.
    """
    kind, qadr, vadr, lower, upper = tree.kind, tree.qadr, tree.vadr, tree.lower, tree.upper
    for k in range(kind.shape[0]):
        a, v = qadr[k], vadr[k]
        if kind[k] < BALL:
            half = 0.5 * (upper[v] - lower[v])
            # Not isfinite: x − x of a computed x is folded to 0 under ``reassoc`` (seen with LLVM 22).
            limited = 0.0 < half < _UNLIMITED
            dq[v] = (0.5 * (upper[v] + lower[v]) - q[a]) / half if limited else 0.0
            continue
        if kind[k] == FREE:
            dq[v] = dq[v + 1] = dq[v + 2] = 0.0
            a, v = a + 3, v + 3
        dq[v] = dq[v + 1] = dq[v + 2] = 0.0
        if 0.0 < upper[v] < math.pi:
            sign = -2.0 if q[a] >= 0.0 else 2.0
            norm = math.sqrt(q[a + 1] ** 2 + q[a + 2] ** 2 + q[a + 3] ** 2)
            scale = 1.0 if norm < 1e-9 else math.atan2(norm, abs(q[a])) / norm
            for i in range(3):
                dq[v + i] = sign * scale * q[a + 1 + i] / upper[v]


@outlined
def manipulability(tree, goal, work):
    """Yoshikawa's measure at the pose in work.world, of the weighted Jacobian of all goals."""
    for r in range(work.residual.shape[0]):
        work.residual[r] = 0.0  # the geometric Jacobian, which knows of no target
    goal_jacobian(tree, goal, work, work.frames)
    steps.svd(work.jacobian, work.left, work.sigma, work.right)
    return steps.volume(work.sigma)


@outlined
def dexterous(tree, goal, work):
    """aim = ∇w, the slope of the manipulability, by central differences; work.q stays as it is."""
    dofs, dq = goal.dofs, work.dq
    copy(work.q, work.accepted)
    for v in range(dq.shape[0]):
        dq[v] = 0.0
    for u in range(dofs.shape[0]):
        slope = 0.0
        for side in (-_PROBE, _PROBE):
            dq[dofs[u]] = side
            integrate(tree, work.nodes, work.q, dq)
            follow(tree, work.q)
            measure(tree, goal, work)
            slope += manipulability(tree, goal, work) / (2.0 * side)
            copy(work.accepted, work.q)
        dq[dofs[u]] = 0.0
        work.aim[u] = goal.joint_scale[u] * slope
    measure(tree, goal, work)


@outlined
def set_aim(tree, goal, work, code, gain):
    """work.aim = gain · φ, no longer than the residual; call before ``prepare``, after ``measure``.

    The bound lets the null motion die with the residual: it moves the tool in second order, and a
    constant one would keep the goal from ever being met to many decimals.
    """
    aim, q = work.aim, work.q
    joint_scale = goal.joint_scale
    if code == REST:
        difference(tree, q, work.rest, work.dq)
        for u in range(aim.shape[0]):
            aim[u] = work.dq[goal.dofs[u]] / joint_scale[u]
    elif code == LIMITS:
        off_limits(tree, q, work.dq)
        for u in range(aim.shape[0]):
            aim[u] = work.dq[goal.dofs[u]] * joint_scale[u]
    elif code == MANIPULABILITY:
        dexterous(tree, goal, work)
    else:
        for u in range(aim.shape[0]):
            aim[u] = 0.0
        return
    length, square = 0.0, 0.0
    for u in range(aim.shape[0]):
        length += (gain * aim[u]) ** 2
    for r in range(work.residual.shape[0]):
        square += work.residual[r] ** 2
    if length > square:
        gain *= math.sqrt(square / length)
    for u in range(aim.shape[0]):
        aim[u] *= gain


@outlined
def keep_aim_inside(work):
    """Drops what the aim asks of joints that stand at a bound and would leave it, or are fixed."""
    for u in range(work.aim.shape[0]):
        if work.side[u] != 0 or pushed_out(work.low[u], work.high[u], work.aim[u]) != 0:
            work.aim[u] = 0.0


@outlined
def add_null_motion(work, cutoff):
    """work.step += (I − J⁺J) aim, from the singular vectors that the pseudoinverse uses."""
    sigma, right, aim, step = work.sigma, work.right, work.aim, work.step
    for i in range(sigma.shape[0]):
        if not sigma[i] > cutoff * sigma[0]:
            continue
        part = 0.0
        for u in range(aim.shape[0]):
            part += right[i, u] * aim[u]
        for u in range(step.shape[0]):
            step[u] -= part * right[i, u]
    for u in range(step.shape[0]):
        step[u] += aim[u]


@dataclass(frozen=True)
class Pseudoinverse(JacobianSolver):
    """The shortest step that solves the linear model; fast near a solution, rough near singularities."""

    cutoff: float = option(
        1e-4, "singular values below this share of the largest count as zero", low=1e-12, high=1.0,
        usual=(0.0, 0.1),
    )  # fmt: skip
    aim: str = option("none", "what the null space is used for", choices=AIMS)
    aim_gain: float = option(0.2, "share of the aim in each step", low=0.0, high=1e3, usual=(0.0, 1.0))
    halvings: int = option(
        0, "times a step may be halved until it lands; 0: never", low=0, high=60, usual=(0, 20)
    )
    landing: float = option(0.1, "how far from its subgoal a step may land", low=1e-9, high=1e3, unit="rad")

    name: ClassVar[str] = "pseudoinverse"
    title: ClassVar[str] = "pseudoinverse by singular values, with null-space motion"
    source: ClassVar[str] = "Whitney 1969; Liégeois 1977; goal halving: Aho 2000"

    def kernel(self) -> Callable[..., None]:
        return pseudoinverse


open_options = options_of(Pseudoinverse)


@outlined
def pseudo_step(tree, goal, work, options):
    """work.step = J⁺ e + (I − J⁺J) φ; joints that stand at a bound and would leave it are taken out.

    Returns the share of the step that limits and caps have left.
    """
    set_aim(tree, goal, work, options.aim, options.aim_gain)
    steps.prepare(tree, goal, work, options.clamp, options.alternative)
    extra = math.sqrt(steps.extra_damping(work))
    # The last descent ends where nothing is left to win, in the directions that were cut off as well.
    cutoff = 0.0 if work.state[POLISHING] > 0 else options.cutoff
    steps.fix_pushed_by_gradient(work)
    keep_aim_inside(work)
    for _ in range(work.step.shape[0] + 1):
        steps.svd(work.jacobian, work.left, work.sigma, work.right)
        steps.filtered_step(work, cutoff, extra)
        add_null_motion(work, cutoff)
        if not steps.fix_pushed_by_step(work):
            break
    share = steps.keep_inside(work)
    return share * steps.cap(work, options.gain, options.max_step)


@outlined
def halve(tree, goal, work, share, halvings, landing):
    """Shortens work.step until it lands within ``landing`` of its subgoal; leaves q where it was.

    ``share`` is what the step is of the full one; the subgoal takes as much of the wanted residual away.
    A step that does not land after ``halvings`` halvings is taken as short as it has become, or not at
    all if it leads uphill.
    """
    residual, wanted, before, step = work.residual, work.wanted, work.rhs, work.step
    m, n = residual.shape[0], step.shape[0]
    old = 0.0
    for r in range(m):
        before[r] = residual[r]
        old += 0.5 * residual[r] * residual[r]
    copy(work.q, work.accepted)
    for tries in range(halvings + 1):
        apply_step(tree, goal, work.nodes, step, work.dq, work.q)
        measure(tree, goal, work)
        copy(work.accepted, work.q)
        off, new = 0.0, 0.0
        for r in range(m):
            off += (residual[r] - before[r] + share * wanted[r]) ** 2
            new += 0.5 * residual[r] * residual[r]
        if off <= landing * landing:
            return
        if tries == halvings:
            for u in range(n):
                step[u] *= 1.0 if new < old else 0.0
            return
        share *= 0.5
        for u in range(n):
            step[u] *= 0.5


@kernel
def pseudoinverse(tree, goals, work, options):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    options = open_options(options)
    begin(tree, goal, work)
    halvings, landing = options.halvings, options.landing
    while proceed(tree, goal, work):
        share = pseudo_step(tree, goal, work, options)
        if halvings > 0:
            halve(tree, goal, work, share, halvings, landing)
        advance(tree, goal, work)
