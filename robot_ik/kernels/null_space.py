"""Secondary aims φ of the null space, and the part of them that leaves the goals alone.

Liégeois (Automatic supervisory control of the configuration and behavior of multibody mechanisms, IEEE
T-SMC 7(12), 1977): d = J⁺ e + (I − J⁺J) φ, φ the slope of what is wanted besides the goals.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.couplings import follow
from robot_ik.kernels.jacobian_step import AT_BOUND, volume
from robot_ik.kernels.jit import outlined
from robot_ik.kernels.kinematics import integrate
from robot_ik.kernels.linalg import svd
from robot_ik.kernels.loop import copy, measure
from robot_ik.kernels.residuals import goal_jacobian
from robot_ik.kernels.rotation_rows import rotation_back
from robot_ik.kernels.tree import BALL, FREE

# What the null space is used for; ``AIMS[code]`` is the name of the option.
AIMS = ("none", "rest", "limits", "manipulability")
NONE, REST, LIMITS, MANIPULABILITY = range(4)

# Half the distance, rad or m, over which the slope of the manipulability is taken.
_PROBE = 1e-4
# Half a range of this size, rad or m, is none.
_UNLIMITED = 1e9


@outlined
def towards(tree, dofs, q, rest, dq, aim):
    """aim = rest ⊖ q, the way to ``rest`` (nq,) in the tangent of q; ``dq`` (nv,) is work space."""
    kind, qadr, vadr = tree.kind, tree.qadr, tree.vadr
    for k in range(kind.shape[0]):
        a, v = qadr[k], vadr[k]
        if kind[k] < BALL:
            dq[v] = rest[a] - q[a]
            continue
        if kind[k] == FREE:
            for i in range(3):
                dq[v + i] = rest[a + i] - q[a + i]
            a, v = a + 3, v + 3
        dq[v], dq[v + 1], dq[v + 2] = rotation_back(q, a, rest[a], rest[a + 1], rest[a + 2], rest[a + 3])
    for u in range(dofs.shape[0]):
        aim[u] = dq[dofs[u]]


@outlined
def off_limits(tree, dofs, q, dq, aim):
    """aim = (middle − q) / half range: where the limits are far; unlimited joints have no aim.

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
    for u in range(dofs.shape[0]):
        aim[u] = dq[dofs[u]]


@outlined
def manipulability(tree, goal, work):
    """Yoshikawa's measure at the pose in work.world, of the weighted Jacobian of all goals."""
    for r in range(work.residual.shape[0]):
        work.residual[r] = 0.0  # the geometric Jacobian, which knows of no target
    goal_jacobian(tree, goal, work, work.frames)
    svd(work.jacobian, work.left, work.sigma, work.right)
    return volume(work.sigma)


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
        work.aim[u] = goal.ease[u] * slope
    measure(tree, goal, work)


@outlined
def set_aim(tree, goal, work, code, gain):
    """work.aim = gain · φ, no longer than the residual; call before ``prepare``, after ``measure``.

    The bound lets the null motion die with the residual: it moves the tool in second order, and a
    constant one would keep the goal from ever being met to many decimals.
    """
    aim, q = work.aim, work.q
    ease = goal.ease
    if code == REST:
        towards(tree, goal.dofs, q, work.rest, work.dq, aim)
        for u in range(aim.shape[0]):
            aim[u] /= ease[u]
    elif code == LIMITS:
        off_limits(tree, goal.dofs, q, work.dq, aim)
        for u in range(aim.shape[0]):
            aim[u] *= ease[u]
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
    """Drops what the aim asks of joints that stand at a bound and would leave it, or are pinned."""
    for u in range(work.aim.shape[0]):
        a = work.aim[u]
        leaves = (a < 0.0 and work.low[u] > -AT_BOUND) or (a > 0.0 and work.high[u] < AT_BOUND)
        if leaves or work.side[u] != 0:
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
