"""Residual and Jacobian of the goals on the whole body, side by side.

    centre of mass   e = t − c            J = v of the centre of mass
    posture          e = q_target ⊖ q     J = 1 for hinges and slides, J_l⁻¹(e) for balls

Both have the form of the goals on a frame (``frame_goals``): J is minus the derivative of the
residual, so that J dq ≈ r is the step that meets the goal.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import so3
from robot_ik.kernels.frame_goals import position_error, position_jacobian, read_column
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.kernels.kinematics import difference, rotation_back, slope_of, unit, velocity_of
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE

# What the residual of a goal is measured on. ``residuals`` calls a pair of functions for each.
ON_FRAME, ON_CENTER_OF_MASS, ON_JOINTS, ON_PRIOR = range(4)


# Centre of mass


@outlined
def center_of_mass(tree, world, masses, first, moments):
    """Write the moments of what each node carries to ``moments``; return the centre of mass.

    Args:
        tree: The kinematic tree.
        world: (n, 12) node poses.
        masses: (…, 4) from row ``first``: mass and centre of each node, seen from the node. Row
            ``first + n`` has mass and centre of the parts that never move.
        first: First row.
        moments: (…, 4) from row ``first``: mass and first moment, in the world, of each node with
            all its descendants. Row ``first + n`` is the whole body.
    """
    nodes = tree.parent.shape[0]
    total_row = first + nodes
    for k in range(nodes):
        mass = masses[first + k, 0]
        center = so3.read_vector(masses, first + k, 1)
        moments[first + k, 0] = mass
        for i in range(3):
            row = so3.read_vector(world, k, 3 + 3 * i)
            at = world[k, i] + row[0] * center[0] + row[1] * center[1] + row[2] * center[2]
            moments[first + k, 1 + i] = mass * at if mass > 0.0 else 0.0
    moments[total_row, 0] = masses[total_row, 0]
    for i in range(1, 4):
        moments[total_row, i] = masses[total_row, 0] * masses[total_row, i]
    for back in range(nodes):
        k = nodes - 1 - back
        carrier = first + tree.parent[k] if tree.parent[k] >= 0 else total_row
        for i in range(4):
            moments[carrier, i] += moments[first + k, i]
    return (
        moments[total_row, 1] / moments[total_row, 0],
        moments[total_row, 2] / moments[total_row, 0],
        moments[total_row, 3] / moments[total_row, 0],
    )


@inlined
def center_velocity(tree, world, moments, first, v):
    """Return the velocity of the centre of mass per unit of degree of freedom ``v``.

    Reads the ``moments`` that ``center_of_mass`` wrote for the same node poses.
    """
    node = first + tree.dof_node[v]
    mass = moments[node, 0]
    if not mass > 0.0:
        return 0.0, 0.0, 0.0
    carried = so3.scale(1.0 / mass, so3.read_vector(moments, node, 1))
    velocity, _ = velocity_of(tree, world, v, carried)
    return so3.scale(mass / moments[first + world.shape[0], 0], velocity)


@outlined
def center_residual(tree, goals, search, g):
    """Write the residual and error of a centre of mass; return (|r|², within tolerance)."""
    point = center_of_mass(tree, search.world, goals.masses, goals.mass_row[g], search.moments)
    so3.write_vector(search.frames[g], 0, point)
    error = position_error(
        goals.position_part[g],
        so3.read_vector(goals.mask, g, 0),
        so3.read_matrix_rotation(search.target, g),
        so3.read_matrix_point(search.target, g),
        point,
    )
    weight = search.weight[g, 0]
    square = so3.dot(error, error)
    so3.write_vector(search.residual, goals.row[g], so3.scale(weight, error))
    search.error[g, 0] = math.sqrt(square)
    search.error[g, 1] = 0.0
    return weight * weight * square, search.error[g, 0] <= search.tolerance[g, 0]


@outlined
def center_jacobian(tree, goals, search, g, jacobian):
    """Write the rows of a centre of mass to ``jacobian``, in the columns that can move it."""
    row = goals.row[g]
    part = goals.position_part[g]
    mask = so3.read_vector(goals.mask, g, 0)
    target_rotation = so3.read_matrix_rotation(search.target, g)
    error = so3.read_vector_at(search.residual, row)
    direct_columns = goals.dofs.shape[0]
    for k in range(goals.mover_count[g]):
        mover = goals.movers[g, k]
        column = goals.column[mover]
        factor = goals.joint_scale[column] * goals.moves[g, mover]
        if mover >= direct_columns:
            factor *= slope_of(tree, goals.coupled[mover - direct_columns, 0], search.q)
        velocity = center_velocity(
            tree, search.world, search.moments, goals.mass_row[g], goals.moved[mover]
        )
        entries = position_jacobian(part, mask, target_rotation, error, velocity)
        entries = so3.scale(factor * search.weight[g, 0], entries)
        if mover >= direct_columns:
            entries = so3.add(entries, read_column(jacobian, row, column))
        so3.write_column(jacobian, row, column, entries)


# Posture


@inlined
def is_linear(joint, index):
    """Return whether a degree of freedom is a displacement in metres."""
    return joint == SLIDE or (joint == FREE and index < 3)


@outlined
def posture_residual(tree, goals, search, g):
    """Write the residual and error of a posture; return (|r|², within tolerance).

    The posture has a row for each column. A coupled joint has no row: it follows its leader.
    The error is that of the joint farthest from the posture.
    """
    change = search.dq
    metres = 0.0
    radians = 0.0
    cost = 0.0
    difference(tree, search.q, search.posture[g], change)
    for u in range(goals.dofs.shape[0]):
        v = goals.dofs[u]
        node = tree.dof_node[v]
        joint = tree.kind[node]
        index = v - tree.vadr[node]
        joint_weight = goals.joint_weight[g, v]
        linear = is_linear(joint, index)
        weight = joint_weight * (search.weight[g, 0] if linear else search.weight[g, 1])
        search.residual[goals.row[g] + u] = weight * change[v]
        cost += weight * weight * change[v] * change[v]
        if not joint_weight > 0.0:
            continue
        if linear:
            metres = max(metres, abs(change[v]))
        elif joint < BALL:
            radians = max(radians, abs(change[v]))
        else:
            radians = max(radians, so3.norm(so3.read_vector_at(change, v - index % 3)))
    search.error[g, 0] = metres
    search.error[g, 1] = radians
    return cost, metres <= search.tolerance[g, 0] and radians <= search.tolerance[g, 1]


@outlined
def posture_jacobian(tree, goals, search, g, jacobian):
    """Write the rows of a posture to ``jacobian``, in the columns of its joints."""
    direct_columns = goals.dofs.shape[0]
    for k in range(goals.mover_count[g]):
        column = goals.movers[g, k]
        if column >= direct_columns or goals.moves[g, column] == 0:
            continue
        v = goals.dofs[column]
        node = tree.dof_node[v]
        joint = tree.kind[node]
        index = v - tree.vadr[node]
        row = goals.row[g] + column
        scale = goals.joint_scale[column] * goals.joint_weight[g, v]
        if joint == HINGE or is_linear(joint, index):
            weight = search.weight[g, 1] if joint == HINGE else search.weight[g, 0]
            jacobian[row, column] = scale * weight
            continue
        first = tree.qadr[node] + (3 if joint == FREE else 0)
        phi = rotation_back(
            search.q,
            first,
            search.posture[g, first],
            search.posture[g, first + 1],
            search.posture[g, first + 2],
            search.posture[g, first + 3],
        )
        # The vector is in the axes of the body, which turn with it: the left Jacobian.
        negative = so3.scale(-1.0, phi)
        entries = so3.jr_inv(negative, so3.curvature(phi), unit(index % 3))
        so3.write_column(
            jacobian, row - index % 3, column, so3.scale(scale * search.weight[g, 1], entries)
        )
