"""The model of a chain of ball joints, for ``make_chain`` and the name ``chain:5``."""

from __future__ import annotations

import mujoco

LINK_THICKNESS = 0.06
"""Radius of the drawn link, as a share of its length."""

_COLOURS = ([0.9, 0.55, 0.2, 1.0], [0.25, 0.35, 0.5, 1.0])
"""Red, green, blue, opacity of links 1, 3, 5 … and of links 2, 4, 6 …"""


def chain_model(links: int, length: float = 1.0) -> mujoco.MjSpec:
    """Return a chain of unlimited ball joints whose base is at the origin of the world.

    All links are along z at zero. The joints are ``joint1`` to ``joint<links>``, the bodies
    ``link1`` to ``link<links>``, the end of the last link is the site ``tip``.

    Args:
        links: Number of links.
        length: Length of each link, m.
    """
    spec = mujoco.MjSpec()
    spec.modelname = f"chain{links}"
    body = spec.worldbody
    for k in range(1, links + 1):
        body = body.add_body(name=f"link{k}", pos=[0.0, 0.0, length if k > 1 else 0.0])
        body.add_joint(name=f"joint{k}", type=mujoco.mjtJoint.mjJNT_BALL)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0.0, 0.0, 0.0, 0.0, 0.0, length],
            size=[LINK_THICKNESS * length, 0.0, 0.0],
            contype=0,
            conaffinity=0,
            rgba=_COLOURS[(k - 1) % 2],
        )
    body.add_site(name="tip", pos=[0.0, 0.0, length])
    return spec
