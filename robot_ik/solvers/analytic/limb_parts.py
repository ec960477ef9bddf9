"""Recognises limbs that shall bring a point of the hand to a place, or aim an axis of the hand.

Neither asks for a whole pose, so more is free than the elbow's swivel, and less is asked of the wrist: any
hinges will do there.  The closed form moves some joints and keeps the rest; see ``partial.py``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robot_ik.kernels.tree import BALL, HINGE, Tree
from robot_ik.solvers.analytic.geometry import (
    BALL_JOINT,
    HINGES,
    NO_JOINTS,
    Family,
    Form,
    axes_at_zero,
    joint_centre,
    on_axis,
    size_of,
)

Array = NDArray[np.float64]


def recognise_part(tree: Tree, node: int, local: Array, aimed: Array | None) -> Form | None:
    """The closed form for the place of the frame at ``local`` (12,) of ``node``, or for its aim.

    ``aimed``: (3,) the axis of the frame that is to point somewhere; None: the frame's place is wanted.
    """
    chain = tree.ancestors(node)
    kinds = [int(tree.kind[k]) for k in chain]
    if not kinds or any(kind not in (HINGE, BALL) for kind in kinds) or BALL in kinds[1:]:
        return None
    axes, frames, tool = axes_at_zero(tree, chain, local)
    scale = size_of(axes, tool)
    arm, shoulder = joint_centre(kinds, axes, scale)
    rest = axes[arm:]
    if shoulder is None:
        return None
    if aimed is None and (len(rest) < 2 or on_axis(rest[0], shoulder, scale, 1e-4)):
        return None  # the elbow would not change how far the hand is from the shoulder
    table = np.zeros((max(7, 3 + len(rest)), 6))
    table[:3, :3] = axes[:3, :3] if arm == 3 else frames[0].T
    table[:3, 3:] = shoulder
    table[3 : 3 + len(rest)] = rest
    first, joined = (4, HINGES) if arm == 3 else (5, BALL_JOINT)
    extra = np.zeros((5, 3))
    extra[2] = tool.position
    groups = np.array([(joined, 0), (NO_JOINTS, first)])
    if aimed is None:
        return Form(Family.LIMB_POINT, tuple(chain), table, extra, groups)
    extra[3] = tool.rotation @ aimed
    if len(rest) == 4:
        _, wrist = joint_centre(kinds[arm + 1 :], rest[1:], scale)
        if wrist is not None:
            groups[1, 0] = HINGES
            table[4:, 3:] = wrist
    return Form(Family.LIMB_AIM, tuple(chain), table, extra, groups)
