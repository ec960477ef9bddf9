"""Masses and inertias of what each node of a tree carries: for the centre of mass, and figures in motion."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose
from robot_ik.kernels.tree import Tree
from robot_ik.model import Attachment

Array = NDArray[np.float64]

LEAST_MASS = 1e-6
"""kg; a robot of less was described without masses."""


def mass_table(model: mujoco.MjModel, tree: Tree, bodies: tuple[Attachment, ...], root: int) -> Array:
    """(n + 1, 4) mass and its centre, seen from the node, of what each node carries; last: what never moves.

    Only the body ``root`` and all that hangs on it count.
    """
    table = np.zeros((tree.size + 1, 4))
    inside: set[int] = set()
    for body in range(root, model.nbody):
        if body == root or int(model.body_parentid[body]) in inside:
            inside.add(body)
            at = bodies[body]  # of node -1, the world, is the last row
            moment = (1.0, *at.local.compose(Pose(model.body_ipos[body])).position)
            table[at.node] += float(model.body_mass[body]) * np.array(moment)
    carried = table[:, 0] > 0.0
    table[carried, 1:] /= table[carried, :1]
    return table


def inertia_table(model: mujoco.MjModel, tree: Tree, bodies: tuple[Attachment, ...]) -> Array:
    """(n, 10) mass, its centre and the inertia xx yy zz xy xz yz about it, in its axes, of each node."""
    mass = mass_table(model, tree, bodies, 0)[: tree.size]
    whole = np.zeros((tree.size, 3, 3))
    for body in range(1, model.nbody):
        at = bodies[body]
        if at.node < 0:
            continue
        inertial = at.local.compose(Pose(model.body_ipos[body], model.body_iquat[body]))
        away = inertial.position - mass[at.node, 1:]
        inertia = inertial.rotation @ np.diag(model.body_inertia[body]) @ inertial.rotation.T
        whole[at.node] += inertia + model.body_mass[body] * (away @ away * np.eye(3) - np.outer(away, away))
    xx, yy, zz, xy, xz, yz = whole[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].T
    return np.column_stack([mass, xx, yy, zz, xy, xz, yz])
