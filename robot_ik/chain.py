"""Chains of ball joints, built in memory."""

from __future__ import annotations

import sys

import mujoco
import numpy as np

from robot_ik.errors import InvalidModelError
from robot_ik.geometry import is_real
from robot_ik.robot import Robot, load_robot

# A link is drawn this thick, as a share of its length.
_THICKNESS = 0.06
LONGEST = 500
"""Links of a chain."""


def make_chain(n: int, length: float = 1.0) -> Robot:
    """A chain of ``n`` unlimited ball joints (3 degrees of freedom each), built in memory.

    The base is at the origin of the world; at home all links lie along z.  Joints are ``joint1`` …
    ``joint<n>``, bodies ``link1`` … ``link<n>``; the tool is the site ``tip`` at the end of the last
    link, z along it.

    Args:
        n: Number of links, one or more.
        length: Of each link, metres.

    Raises:
        InvalidModelError: No links or too many, or a length that is not positive and finite.
    """
    given: object = n
    if isinstance(n, bool) or not isinstance(given, int | np.integer) or not 1 <= n <= LONGEST:
        hint = "what MuJoCo takes to compile it grows with the cube of the links: 10 s for 400"
        raise InvalidModelError(f"a chain has 1 to {LONGEST} links, not {n!r}", hint=hint)
    if not (is_real(length, 0.0, sys.float_info.max) and length > 0.0):
        raise InvalidModelError(f"a link's length is positive and finite, not {length!r}")
    spec = mujoco.MjSpec()
    spec.modelname = f"chain{n}"
    body = spec.worldbody
    for i in range(1, n + 1):
        body = body.add_body(name=f"link{i}", pos=[0.0, 0.0, length if i > 1 else 0.0])
        body.add_joint(name=f"joint{i}", type=mujoco.mjtJoint.mjJNT_BALL)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0.0, 0.0, 0.0, 0.0, 0.0, length],
            size=[_THICKNESS * length, 0.0, 0.0], contype=0, conaffinity=0,
            rgba=[0.9, 0.55, 0.2, 1.0] if i % 2 else [0.25, 0.35, 0.5, 1.0],
        )  # fmt: skip
    body.add_site(name="tip", pos=[0.0, 0.0, length])
    return load_robot(spec.compile(), tool="tip")
