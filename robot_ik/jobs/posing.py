"""Poses made from others: a named one, with joints at other angles, with frames brought to places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from robot_ik.errors import UnknownJointError
from robot_ik.goals import Goal, PoseGoal, PositionGoal, PostureGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.kernels.tree import HINGE, SLIDE
from robot_ik.motion.key_poses import KeyPoses
from robot_ik.motion.keyframes import qpos_addresses
from robot_ik.ports import Array
from robot_ik.robot import Robot

FEET = ("_foot", "_paw")
"""Frames whose names end so stand on the floor."""


def named_poses(robot: Robot, book: KeyPoses) -> dict[str, Array]:
    """(nq,) by name: those of the file, and the keyframes of the model that it does not have."""
    places = qpos_addresses(robot)
    keys = [robot.model.key(k) for k in range(robot.model.nkey)]
    return {**{key.name: np.array(key.qpos[places]) for key in keys}, **book.poses}


def with_joint(robot: Robot, q: Array, joint: str, value: float) -> Array:
    """The pose (nq,) with one joint at another value: degrees of a hinge, metres of a slide.

    Raises:
        UnknownJointError: No such joint.
        ValueError: It is neither, or the value is not finite.
    """
    if joint not in robot.joints:
        raise UnknownJointError(joint, robot.joints)
    k = robot.joints.index(joint)
    kind = int(robot.tree.kind[k])
    if kind not in (HINGE, SLIDE) or not np.isfinite(value):
        raise ValueError(f"{joint} is no hinge and no slide, or {value} is not finite")
    changed = np.array(q)
    changed[int(robot.tree.qadr[k])] = np.radians(value) if kind == HINGE else value
    return changed


def pose_reaching(robot: Robot, q: Array, places: Mapping[str, Sequence[float]]) -> Array | None:
    """The pose near ``q`` that brings frames to places while the other feet stay where they are.

    Args:
        robot: Whose.
        q: (nq,) where it starts.
        places: Frame -> x, y, z in the world, m.

    Returns:
        (nq,), or None: out of reach.
    """
    goals: list[Goal] = [PositionGoal(frame, place) for frame, place in places.items()]
    feet = [frame for frame in robot.file.tools if frame.endswith(FEET) and frame not in places]
    goals += [PoseGoal.at(frame, robot.forward(q, frame)) for frame in feet]
    found = solve(robot, [*goals, PostureGoal(q=q, soft=True)], solver="lm", start=q)
    return np.array(found.q) if found.converged else None
