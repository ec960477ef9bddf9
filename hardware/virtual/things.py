"""Things to grip in a MuJoCo world: boxes that lie about and fall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco

FRICTION = (1.0, 0.02, 0.0005)
"""Of rubber pads on wood: sliding, and so many metres of turning and rolling."""
SOLREF, SOLIMP = (0.004, 1.0), (0.95, 0.99, 0.0005, 0.5, 2.0)
"""As stiff as the step of the world allows: at 10 N a thing of 50 g gives by less than 0.1 mm."""


@dataclass(frozen=True)
class Thing:
    """A box.

    Attributes:
        name: Of its body.
        position: Centre, m, world; wxyz: how it is turned.
        size: Edges, m.
        mass: kg.
    """

    name: str
    position: tuple[float, float, float]
    size: tuple[float, float, float]
    mass: float
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


def model_with(path: Path, things: Sequence[Thing], floor: float | None = None) -> mujoco.MjModel:
    """The model of a robot with things beside it, for a ``World`` with contacts.

    Args:
        path: The robot's model file.
        things: What lies about.
        floor: Height of a plane to lie on, m; None: there is none.

    Raises:
        ValueError: MuJoCo cannot compile it, e.g. a name is taken.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    for key in list(spec.keys):
        spec.delete(key)  # they know nothing of the things' places
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.noslip_iterations = 3  # else a grip creeps
    if floor is not None:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.01], pos=[0, 0, floor])
    for thing in things:
        body = spec.worldbody.add_body(name=thing.name, pos=thing.position, quat=thing.wxyz)
        body.add_freejoint()
        geom = body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5 * edge for edge in thing.size], mass=thing.mass
        )
        geom.condim, geom.priority, geom.friction = 4, 1, FRICTION
        geom.solref, geom.solimp = SOLREF, SOLIMP
    return spec.compile()
