"""Whether an arm can stand at joint angles, and go straight between them in joint space, without touching."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.made_up.stage import Table
from robot_ik.robot import Robot

Array = NDArray[np.float64]

# Between two looks at a straight joint move no joint turns farther than this, rad.
_STEP = 0.06
# Kept between the arm and the table, metres.
_AIR = 0.01


class Clearance:
    """Contacts of the arm with itself, its surroundings in the model, and a table.

    What touches already at ``free`` (neighbouring links, a base on the table) counts as no contact.
    Links are boxes to the table: an arm is kept farther away rather than nearer.

    Args:
        robot: Whose geoms.
        free: (nq,) where the arm stands freely.
        table: None for no table.
    """

    def __init__(self, robot: Robot, free: Array, table: Table | None = None) -> None:
        self._robot, self._table = robot, table
        self._data = mujoco.MjData(robot.model)
        model = robot.model
        moving = model.body_weldid[model.geom_bodyid] > 0
        self._geoms = np.flatnonzero(moving)
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
        box = model.geom_aabb[self._geoms]
        self._corners = box[:, None, :3] + signs * box[:, None, 3:]  # (g, 8, 3) in the geoms' frames
        self._allowed: set[tuple[int, int]] = set()
        self._on_table: set[int] = set()
        self._place(free)
        self._allowed, self._on_table = self._touching(), self._at_table()

    def free(self, q: Array) -> bool:
        """Whether the arm touches nothing at ``q`` (nq,)."""
        self._place(q)
        return self._at_table() <= self._on_table and self._touching() <= self._allowed

    def free_way(self, start: Array, end: Array) -> bool:
        """Whether it touches nothing on the straight joint move between two configurations."""
        count = max(2, int(np.ceil(np.abs(end - start).max() / _STEP)))
        # From the middle outwards: a way is blocked there first.
        shares = sorted(np.arange(1, count) / count, key=lambda share: abs(share - 0.5))
        return all(self.free(start + share * (end - start)) for share in shares)

    def sees(self, q: Array, eye: Array, points: Array) -> bool:
        """Whether no geom stands between an eye and points (n, 3), world, at ``q``."""
        self._place(q)
        geom = np.zeros(1, dtype=np.int32)
        for point in points:
            way = point - eye
            length = float(np.linalg.norm(way))
            hit = mujoco.mj_ray(self._robot.model, self._data, eye, way / length, None, 1, -1, geom, None)
            if 0.0 <= hit < length - 2e-3:
                return False
        return True

    def _place(self, q: Array) -> None:
        self._data.qpos[:] = self._robot.qpos(q)
        mujoco.mj_kinematics(self._robot.model, self._data)

    def _touching(self) -> set[tuple[int, int]]:
        mujoco.mj_collision(self._robot.model, self._data)
        pairs = self._data.contact.geom[np.asarray(self._data.contact.dist) < 0.0]
        return {(int(a), int(b)) for a, b in np.sort(pairs, axis=1)}

    def _at_table(self) -> set[int]:
        table = self._table
        if table is None or not len(self._geoms):
            return set()
        turn = self._data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        corners = self._corners @ turn.transpose(0, 2, 1) + self._data.geom_xpos[self._geoms][:, None]
        low, high = corners.min(axis=1), corners.max(axis=1)
        over = (
            (high[:, 0] > table.x[0] - _AIR) & (low[:, 0] < table.x[1] + _AIR)
            & (high[:, 1] > table.y[0] - _AIR) & (low[:, 1] < table.y[1] + _AIR)
        )  # fmt: skip
        return {int(g) for g in self._geoms[over & (low[:, 2] < table.height + _AIR)]}
