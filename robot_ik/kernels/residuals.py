"""``GOALS``: the goals of a problem, read-only in kernels; residual and Jacobian.

Each goal has some rows of the residual, one goal after the other. Each degree of freedom that
moves any goal has a column of the Jacobian. The column of a stiff joint is shortened by
``joint_scale``, and ``search.apply_step`` shortens its step by the same factor: the damped step
then moves the joint less (weighted least squares, Whitney 1972).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.body_goals import (
    ON_CENTER_OF_MASS,
    ON_FRAME,
    ON_JOINTS,
    center_jacobian,
    center_residual,
    posture_jacobian,
    posture_residual,
)
from robot_ik.kernels.frame_goals import frame_jacobian, frame_residual
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.kernels.pose_prior import PRIOR

# With g goals, u degrees of freedom that have a column, c coupled ones, m rows of the residual.
GOALS = Layout(
    "Goals",
    needed_levels="int",  # levels with goals that are not soft; soft levels come after them
    prior_goal="int",  # which goal is a pose prior, or -1
    subject="ints",  # (g,) frame, centre of mass, joints or prior, a code of ``body_goals``
    position_part="ints",  # (g,) which coordinates count, a code of ``frame_goals``
    orientation_part="ints",  # (g,) which part of the orientation counts, a code of ``frame_goals``
    level="ints",  # (g,) place in the order of priorities, 0 first; see ``priorities``
    soft="ints",  # (g,) 1: the goal does not decide whether the solve has converged
    row="ints",  # (g,) first row of the residual
    node="ints",  # (g,) node that carries the frame, -1 = world
    local="table",  # (g, 12) pose of the frame in the node
    mask="table",  # (g, 3) 1 for each coordinate that counts, in the axes of the target
    weight="table",  # (g, 2) on metres divided by the length scale, and on radians
    tolerance="table",  # (g, 2) metres, radians; inf where nothing is needed
    reach="table",  # (g, 4) centre and radius of a ball that the frame cannot leave; inf if unknown
    dofs="ints",  # (u,) degrees of freedom with a column
    joint_scale="floats",  # (u,) 1 for the least stiff joint, less for stiffer ones
    column="ints",  # (u + c,) column of each mover
    moved="ints",  # (u + c,) degree of freedom of each mover
    moves="int_table",  # (g, u + c) 1 if the mover moves the goal
    movers="int_table",  # (g, u + c) those whose entries may differ from zero, first
    mover_count="ints",  # (g,)
    hits="int_table",  # (u, m) rows where a column may differ from zero, first
    hit_count="ints",  # (u,)
    coupled="int_table",  # (c, 3) coupling, column of its leader, degree of freedom
    nodes="ints",  # nodes that move any goal, parents first
    mass_row="ints",  # (g,) first row of ``masses``
    masses="table",  # (w, 4) of the centres of mass, see ``center_of_mass``
    joint_weight="table",  # (g, nv) of a posture, or (0, nv)
    prior=PRIOR,
)
open_goals = GOALS.open


@outlined
def evaluate(tree, goals, search):
    """Write the residual and error of all goals; return (½ |r|², all within tolerance).

    Leaves out a pose prior: it is always soft, and only ``priorities`` supports soft goals.
    """
    cost = 0.0
    all_within = True
    for g in range(goals.row.shape[0]):
        subject = goals.subject[g]
        if subject == ON_FRAME:
            square, within = frame_residual(goals, search, g)
        elif subject == ON_CENTER_OF_MASS:
            square, within = center_residual(tree, goals, search, g)
        elif subject == ON_JOINTS:
            square, within = posture_residual(tree, goals, search, g)
        else:
            continue
        cost += square
        all_within = all_within and within
    return 0.5 * cost, all_within


@outlined
def goal_jacobian(tree, goals, search, at_target, jacobian):
    """Write the weighted Jacobian (m, u) with J dq ≈ r to ``jacobian``.

    ``at_target`` gives the alternative Jacobian, see ``frame_jacobian``. Leaves out a pose prior.
    """
    for g in range(goals.row.shape[0]):
        subject = goals.subject[g]
        if subject == ON_FRAME:
            frame_jacobian(tree, goals, search, at_target, g, jacobian)
        elif subject == ON_CENTER_OF_MASS:
            center_jacobian(tree, goals, search, g, jacobian)
        elif subject == ON_JOINTS:
            posture_jacobian(tree, goals, search, g, jacobian)


@inlined
def rows_end(goals, g, rows):
    """Return the row after the last row of goal ``g``."""
    return goals.row[g + 1] if g + 1 < goals.row.shape[0] else rows


@outlined
def clamp_residual(goals, residual, clamp, alike, clamped):
    """Write the residual, each goal shortened to ``clamp`` at most, to ``clamped``.

    This is ClampMag (Buss & Kim 2005, section 3). With ``alike`` all goals are shortened by the
    factor of the longest, which keeps the direction of descent.
    """
    rows = residual.shape[0]
    smallest = 1.0
    for g in range(goals.row.shape[0]):
        first = goals.row[g]
        end = rows_end(goals, g, rows)
        square = 0.0
        for r in range(first, end):
            square += residual[r] * residual[r]
        length = math.sqrt(square)
        share = clamp / length if length > clamp else 1.0
        smallest = min(smallest, share)
        for r in range(first, end):
            clamped[r] = share * residual[r]
    if alike:
        for r in range(rows):
            clamped[r] = smallest * residual[r]
