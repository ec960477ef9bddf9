"""Compiled sweep over the poses of cells: closed form, limits, collisions, manipulability."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.collision import FREE as NO_CONTACT
from robot_ik.kernels.collision import open_run as open_collisions
from robot_ik.kernels.collision import smallest_distance, verdict
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import forward, velocity_of
from robot_ik.kernels.tree import TREE
from robot_ik.solvers.analytic import write_branches
from robot_ik.solvers.analytic.subproblems import FORM, image

# Status of a pose.
UNREACHABLE, NOT_FOUND, TOUCHING, REACHED = range(4)

# m. Clearances are measured up to this.
FARTHEST_CLEARANCE = 0.1
# Largest number of free branches of a pose that one byte can count.
_MAX_BRANCHES = 255
# A pivot of the Gram matrix at or below this is zero.
_ZERO_PIVOT = 1e-300

# With j joints of a closed form, d degrees of freedom and n nodes that move the frame, f closed
# forms.
CELLS = Layout(
    "ReachabilityCells",
    checked="bool",  # whether collisions count
    no_branch="int",  # status of a pose without a branch: UNREACHABLE or NOT_FOUND
    swept="int",  # coordinate in q of the joint that is fixed at several values; -1 without one
    node="int",  # node that carries the frame
    margin="float",  # m
    best_manipulability="float",
    best_clearance="float",
    reach="floats",  # (4,) centre and radius of a ball that the frame cannot leave
    rotations="table",  # (o, 9)
    values="floats",  # (f,) of the swept joint
    columns="ints",  # (j,) coordinate in q of each joint of the closed forms
    nodes="ints",  # (n,)
    dofs="ints",  # (d,)
    local="table",  # (1, 12) the frame in its node
    q="floats nq",
    world="table n 12",
    scratch="table 2 12",
    jacobian="table 6 d",
    gram="table 6 6",
    tree=TREE,
)
open_cells = CELLS.open
open_form = FORM.open


@inlined
def is_within_reach(cells, positions, cell):
    """Return whether the frame may reach a position."""
    offset = so3.subtract(so3.read_vector(positions, cell, 0), so3.read_vector_at(cells.reach, 0))
    return so3.dot(offset, offset) <= cells.reach[3] * cells.reach[3]


@inlined
def put_branch(cells, form, row):
    """Write a branch to cells.q; return whether it exists and is inside the limits."""
    if math.isnan(form.branches[row, 0]):
        return False
    for j in range(cells.columns.shape[0]):
        angle, inside = image(form.branches[row, j], form.start[j], form.lower[j], form.upper[j])
        if not inside:
            return False
        cells.q[cells.columns[j]] = angle
    return True


@outlined
def is_free(cells, run):
    """Return whether cells.q keeps the margin; updates cells.best_clearance.

    The exact distance is measured only if the clearance of the posture is larger than the largest
    so far. A posture within rounding of the margin does not count as free.
    """
    best = cells.best_clearance
    if best < cells.margin or best >= FARTHEST_CLEARANCE:
        if verdict(run, cells.q, cells.margin) != NO_CONTACT:
            return False
        if best >= FARTHEST_CLEARANCE:
            return True
    elif verdict(run, cells.q, best) != NO_CONTACT:
        return verdict(run, cells.q, cells.margin) == NO_CONTACT
    distance, _ = smallest_distance(run, cells.q, FARTHEST_CLEARANCE)
    cells.best_clearance = max(best, distance)
    return True


@outlined
def manipulability_at(cells):
    """Return √det(J Jᵀ) at cells.q (Yoshikawa 1985), metres and radians."""
    tree = cells.tree
    forward(tree, cells.nodes, cells.q, cells.world, cells.scratch)
    node = cells.node
    point = so3.add(
        so3.read_vector(cells.world, node, 0),
        so3.apply(so3.read_rotation(cells.world, node), so3.read_vector(cells.local, 0, 0)),
    )
    jacobian = cells.jacobian
    for d in range(cells.dofs.shape[0]):
        linear, angular = velocity_of(tree, cells.world, cells.dofs[d], point)
        so3.write_column(jacobian, 0, d, linear)
        so3.write_column(jacobian, 3, d, angular)
    gram = cells.gram
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for d in range(cells.dofs.shape[0]):
                total += jacobian[i, d] * jacobian[j, d]
            gram[i, j] = total
    # Elimination of the lower triangle: the product of the pivots is the determinant.
    determinant = 1.0
    for k in range(6):
        pivot = gram[k, k]
        if pivot <= _ZERO_PIVOT:
            return 0.0
        determinant *= pivot
        for i in range(k + 1, 6):
            factor = gram[i, k] / pivot
            for j in range(k + 1, i + 1):
                gram[i, j] -= factor * gram[j, k]
    return math.sqrt(determinant)


@outlined
def sweep_pose(cells, run, forms, positions, cell, orientation):
    """Return the status of one pose, and its number of free branches.

    Updates cells.best_manipulability and cells.best_clearance.
    """
    free = 0
    touching = False
    for f in range(forms.shape[0]):
        form = open_form(forms[f])
        for i in range(3):
            form.target[0, i] = positions[cell, i]
        for i in range(9):
            form.target[0, 3 + i] = cells.rotations[orientation, i]
        write_branches(form, 0.0, True)
        for row in range(form.branches.shape[0]):
            if not put_branch(cells, form, row):
                continue
            if cells.swept >= 0:
                cells.q[cells.swept] = cells.values[f]
            if cells.checked and not is_free(cells, run):
                touching = True
                continue
            free += 1
            cells.best_manipulability = max(cells.best_manipulability, manipulability_at(cells))
    if free > 0:
        return REACHED, min(free, _MAX_BRANCHES)
    return TOUCHING if touching else cells.no_branch, 0


@kernel
def sweep_cells(address, forms, collisions, positions, status, branches, manipulability, clearance):
    """Sweep all orientations of some cells.

    Args:
        address: Block of ``CELLS``.
        forms: (f,) addresses of the closed forms, one for each value of the swept joint.
        collisions: Block of ``collision.RUN``. Not read unless cells.checked.
        positions: (c, 3) centres of the cells.
        status: (c, o) written: UNREACHABLE … REACHED.
        branches: (c, o) written: numbers of free branches.
        manipulability: (c,) written: the largest manipulability of the free branches.
        clearance: (c,) written: the largest clearance of the free branches, m; NaN without one.
    """
    cells = open_cells(address)
    run = open_collisions(collisions)
    for cell in range(positions.shape[0]):
        cells.best_manipulability = 0.0
        cells.best_clearance = -math.inf
        in_ball = is_within_reach(cells, positions, cell)
        for orientation in range(cells.rotations.shape[0]):
            pose_status = UNREACHABLE
            count = 0
            if in_ball:
                pose_status, count = sweep_pose(cells, run, forms, positions, cell, orientation)
            status[cell, orientation] = pose_status
            branches[cell, orientation] = count
        manipulability[cell] = cells.best_manipulability
        clearance[cell] = cells.best_clearance if cells.best_clearance > -math.inf else math.nan
