"""Pseudoinverse: d = J⁺ e + (I − J⁺J) φ, with a cut-off of small singular values.

Whitney (Resolved motion rate control of manipulators, IEEE T-MMS 10(2), 1969). The null space
follows Liégeois (Automatic supervisory control of the configuration and behavior of multibody
mechanisms, IEEE T-SMC 7(12), 1977): φ is the gradient of a secondary objective. Goal halving
is Aho's (Implementation of articulated mechanisms in computer animation, 2000, section 4.6): a step
that does not end near its subgoal is undone, and half of it is tried.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from robot_ik.geometry import Array
from robot_ik.kernels.block import Layout
from robot_ik.kernels.jacobian_step import (
    SINGULAR,
    filtered_step,
    fix_pushed_by_gradient,
    fix_pushed_by_step,
    keep_inside,
    limit,
    polish_damping,
    prepare,
)
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.kinematics import difference
from robot_ik.kernels.linalg import BOX_PROBLEM, pushed_out, svd
from robot_ik.kernels.search import POLISH, advance, apply_step, begin, copy, measure, proceed
from robot_ik.kernels.tree import BALL, FREE
from robot_ik.solvers.iterative import GuidedSolver, run_layout
from robot_ik.solvers.options import option, options_layout

if TYPE_CHECKING:
    from robot_ik.problem import Problem

# Objective of the null space: the index in the choices of the option.
AIMS = ("none", "rest", "limits")
NONE, REST, LIMITS = range(3)

# A joint with half a range beyond this, rad or m, has no limits.
_UNLIMITED = 1e9
# A quaternion with a smaller vector part than this is the identity.
_NO_ROTATION = 1e-9
# Largest distance of the end of a halved step from its subgoal, in units of the residual (rad).
_SUBGOAL_ERROR = 0.1


@dataclass(frozen=True)
class Pseudoinverse(GuidedSolver):
    """The shortest step that solves the linear model; large steps near singularities."""

    cutoff: float = option(
        1e-4,
        "singular values below this share of the largest count as zero",
        lower=1e-12,
        upper=1.0,
        usual=(0.0, 0.1),
    )
    aim: str = option("none", "what the null space is used for", choices=AIMS)
    aim_gain: float = option(
        0.2, "share of the aim in each step", lower=0.0, upper=1e3, usual=(0.0, 1.0)
    )
    halvings: int = option(
        0,
        "times a step may be halved until it ends near its subgoal",
        lower=0,
        upper=60,
        usual=(0, 20),
    )

    name: ClassVar[str] = "pseudoinverse"
    title: ClassVar[str] = "pseudoinverse by singular values, with null-space motion"
    source: ClassVar[str] = "Whitney 1969; Liégeois 1977; goal halving: Aho 2000"

    def work_arrays(self, problem: Problem) -> dict[str, Array]:
        return {"home": problem.robot.home.copy()}


OPTIONS = options_layout(Pseudoinverse)
# With m rows of the residual, u columns, nq coordinates.
WORK = Layout(
    "PseudoinverseWork",
    box=BOX_PROBLEM,
    singular=SINGULAR,
    aim="floats u",  # the motion φ that the null space should make
    accepted="floats nq",  # q before a step is tried
    before="floats m",  # residual before a step is tried
    home="floats",  # (nq,) of the robot
)
RUN = run_layout("PseudoinverseRun", WORK, OPTIONS)
open_run = RUN.open


# The aim of the null space


@outlined
def set_aim(tree, goals, search, home, aim, code, gain):
    """Write gain · φ at q to ``aim``, shortened to the length of the residual.

    So the null motion vanishes with the residual. It moves the tool in second order, so a constant
    null motion would keep the error from becoming very small.
    """
    if code == NONE:
        for u in range(aim.shape[0]):
            aim[u] = 0.0
        return
    if code == REST:
        difference(tree, search.q, home, search.dq)
        for u in range(aim.shape[0]):
            aim[u] = search.dq[goals.dofs[u]] / goals.joint_scale[u]
    else:
        away_from_limits(tree, search.q, search.dq)
        for u in range(aim.shape[0]):
            aim[u] = search.dq[goals.dofs[u]] * goals.joint_scale[u]
    aim_square = 0.0
    for u in range(aim.shape[0]):
        aim_square += (gain * aim[u]) ** 2
    square = 0.0
    for r in range(search.residual.shape[0]):
        square += search.residual[r] ** 2
    if aim_square > square:
        gain *= math.sqrt(square / aim_square)
    for u in range(aim.shape[0]):
        aim[u] *= gain


@outlined
def away_from_limits(tree, q, dq):
    """Write (middle − q) / half range to ``dq``; joints without limits have no aim.

    Liégeois's −½ Σ ((q − middle) / half)² rises that way, each joint measured by its range. The
    middle of a ball joint is no rotation, and half its range is the angle of its cone.
    """
    for k in range(tree.kind.shape[0]):
        joint = tree.kind[k]
        a = tree.qadr[k]
        v = tree.vadr[k]
        if joint < BALL:
            half = 0.5 * (tree.upper[v] - tree.lower[v])
            # Not isfinite: fast math folds x − x of a computed x to 0.
            limited = 0.0 < half < _UNLIMITED
            dq[v] = (0.5 * (tree.upper[v] + tree.lower[v]) - q[a]) / half if limited else 0.0
            continue
        if joint == FREE:
            for i in range(3):
                dq[v + i] = 0.0
            a += 3
            v += 3
        for i in range(3):
            dq[v + i] = 0.0
        if 0.0 < tree.upper[v] < math.pi:
            sign = -2.0 if q[a] >= 0.0 else 2.0
            sine = math.sqrt(q[a + 1] ** 2 + q[a + 2] ** 2 + q[a + 3] ** 2)
            scale = 1.0 if sine < _NO_ROTATION else math.atan2(sine, abs(q[a])) / sine
            for i in range(3):
                dq[v + i] = sign * scale * q[a + 1 + i] / tree.upper[v]


@outlined
def keep_aim_inside(box, aim):
    """Write 0 to ``aim`` for a joint that is fixed, or at a bound that the aim would exceed."""
    for u in range(aim.shape[0]):
        if box.side[u] != 0 or pushed_out(box.lower[u], box.upper[u], aim[u]) != 0:
            aim[u] = 0.0


@outlined
def add_null_motion(singular, cutoff, aim, step):
    """Add (I − J⁺J) φ to ``step``, from the singular vectors that the pseudoinverse uses."""
    sigma = singular.sigma
    for i in range(sigma.shape[0]):
        if not sigma[i] > cutoff * sigma[0]:
            continue
        part = 0.0
        for u in range(aim.shape[0]):
            part += singular.right[i, u] * aim[u]
        for u in range(step.shape[0]):
            step[u] -= part * singular.right[i, u]
    for u in range(step.shape[0]):
        step[u] += aim[u]


# The step


@outlined
def pseudoinverse_step(tree, goals, search, work, options):
    """Write J⁺ e + (I − J⁺J) φ to search.step, without the joints that leave their limits.

    Returns the share of the step that limits and the largest change of a joint have left.
    """
    box = work.box
    singular = work.singular
    set_aim(tree, goals, search, work.home, work.aim, options.aim, options.aim_gain)
    prepare(tree, goals, search, box, options.clamp, options.alternative)
    damping = math.sqrt(polish_damping(search))
    # The polish also descends in the directions that were cut off.
    cutoff = 0.0 if search.phase == POLISH else options.cutoff
    fix_pushed_by_gradient(search, box)
    keep_aim_inside(box, work.aim)
    for _ in range(search.step.shape[0] + 1):
        svd(box.jacobian, singular.left, singular.sigma, singular.right)
        filtered_step(box, singular, cutoff, damping, search.step)
        add_null_motion(singular, cutoff, work.aim, search.step)
        fixed = fix_pushed_by_step(search, box)
        if fixed < 0:
            break
        work.aim[fixed] = 0.0
    search.damping = damping
    share = keep_inside(box, search.step)
    return share * limit(search.step, options.gain, options.max_step)


@outlined
def halve(tree, goals, search, work, share, halvings):
    """Halve search.step until it ends near its subgoal. Leaves q unchanged.

    ``share`` is the part of the full step. The subgoal removes the same part of the residual.
    After the last halving the step is taken if it reduces the cost.
    """
    step = search.step
    wanted = work.box.residual
    old = search.cost
    copy(search.residual, work.before)
    copy(search.q, work.accepted)
    for tries in range(halvings + 1):
        apply_step(tree, goals, search)
        measure(tree, goals, search)
        copy(work.accepted, search.q)
        error = 0.0
        for r in range(wanted.shape[0]):
            error += (search.residual[r] - work.before[r] + share * wanted[r]) ** 2
        if error <= _SUBGOAL_ERROR * _SUBGOAL_ERROR:
            return
        if tries == halvings:
            kept = 1.0 if search.cost < old else 0.0
            for u in range(step.shape[0]):
                step[u] *= kept
            return
        share *= 0.5
        for u in range(step.shape[0]):
            step[u] *= 0.5


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    begin(run.tree, run.goals, run.search)
    while proceed(run.tree, run.goals, run.search):
        share = pseudoinverse_step(run.tree, run.goals, run.search, run.work, run.options)
        if run.options.halvings > 0:
            halve(run.tree, run.goals, run.search, run.work, share, run.options.halvings)
        advance(run.tree, run.goals, run.search)
