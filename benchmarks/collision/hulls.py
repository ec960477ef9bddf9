"""Cost of a check on a model of many convex hulls, as a decomposition of meshes gives them.

    taskset -c 0 python -m benchmarks.collision.hulls [HULLS_PER_LINK]

The model is an arm of seven links. Each link is a tube of hulls of up to 200 vertices, and the base
is one hull: 211 hulls with 30 a link. Only free postures are timed, because a contact ends a check
early.
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np

import robot_ik as rik
from benchmarks.collision.checks import mujoco_checks, smallest_times
from robot_ik.kernels import collision

LINKS = 7
HULLS_PER_LINK = 30
VERTICES = 200
LENGTH = 0.1
"""m. Length of a link."""

RADIUS = 0.06
"""m. Radius of a link."""

BEGIN = 0.02
"""m. Distance of the first hull from the joint."""

POSTURES = 300


def model_text(hulls: int) -> str:
    """Return the MJCF of the arm."""
    rng = np.random.default_rng(5)
    assets = []
    body = ""
    for link in reversed(range(LINKS)):
        geoms = []
        for k in range(hulls):
            directions = rng.normal(size=(VERTICES, 3))
            directions /= np.linalg.norm(directions, axis=1)[:, None]
            points = directions * rng.uniform(0.02, 0.06, 3)
            name = f"hull {link} {k}"
            numbers = " ".join(f"{number:.6g}" for number in points.ravel())
            assets.append(f'<mesh name="{name}" vertex="{numbers}"/>')
            turn = 2.4 * k
            position = (
                RADIUS * np.cos(turn),
                RADIUS * np.sin(turn),
                BEGIN + (LENGTH - 2.0 * BEGIN) * k / hulls,
            )
            place = " ".join(f"{number:.4g}" for number in position)
            geoms.append(f'<geom type="mesh" mesh="{name}" pos="{place}"/>')
        axis = "0 1 0" if link % 2 else "0 0 1"
        body = (
            f'<body name="link {link}" pos="0 0 {LENGTH}">'
            f'<joint name="joint {link}" axis="{axis}" range="-2.5 2.5"/>'
            f"{''.join(geoms)}{body}</body>"
        )
    base = '<geom type="mesh" mesh="hull 0 0" pos="0 0 -.3"/>'
    return (
        f'<mujoco><compiler angle="radian"/><asset>{"".join(assets)}</asset>'
        f"<worldbody>{base}{body}</worldbody></mujoco>"
    )


def main() -> None:
    """Print one line."""
    hulls = int(sys.argv[1]) if len(sys.argv) > 1 else HULLS_PER_LINK
    robot = rik.load_robot(model_text(hulls))
    scene = rik.Scene(robot)
    rng = np.random.default_rng(1)
    rows = np.array([robot.sample(rng) for _ in range(40 * POSTURES)])
    rows = rows[scene.free(rows)][:POSTURES]
    memory = scene.memory(scene.pair_tables(scene.pairs))
    verdicts = np.zeros(len(rows), dtype=np.int64)
    data = mujoco.MjData(scene.model)
    times = smallest_times(
        [
            lambda: mujoco_checks(scene.model._address, data._address, data.qpos, rows),
            lambda: collision.verdicts(memory.address, rows, 0.0, verdicts),
        ]
    )
    theirs, ours = (1e6 * seconds / len(rows) for seconds in times)
    print(
        f"{scene.model.ngeom} hulls, {len(scene.pairs)} pairs, {len(rows)} free postures: "
        f"MuJoCo {theirs:.1f} µs, ours {ours:.1f} µs"
    )


if __name__ == "__main__":
    main()
