"""``CollisionAvoidance``: the condition that a posture keeps a margin from all collisions.

avoid = CollisionAvoidance(scene, margin=0.005, ignore=[("gripper", "part")])
solution = solve(robot, goal, collisions=avoid)
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.collision import DEFAULT_MARGIN, LARGEST_MARGIN
from robot_ik.collision.distances import PairTables
from robot_ik.collision.pairs import Ints, chosen_pairs
from robot_ik.collision.scene import Clearance, Scene, Touching, always_near, free_postures
from robot_ik.errors import OptionError
from robot_ik.geometry import is_real
from robot_ik.kernels.block import Block
from robot_ik.robot import Robot


class CollisionAvoidance:
    """Keep chosen pairs of a scene apart by a margin.

    Attributes:
        scene: The scene.
        margin: Smallest allowed distance, m.
        pairs: The chosen pairs of names, None for all pairs.
        ignore: The pairs of names that are left out.
    """

    def __init__(
        self,
        scene: Scene,
        margin: float = DEFAULT_MARGIN,
        pairs: Iterable[Sequence[str]] | None = None,
        ignore: Iterable[Sequence[str]] = (),
    ) -> None:
        """Choose pairs.

        Args:
            scene: The scene.
            margin: Smallest allowed distance, m, 0 or more.
            pairs: Pairs of names of bodies or geoms, such as ``[("gripper", "crate")]``. None
                takes all pairs that MuJoCo compares.
            ignore: Pairs of names to leave out.

        Raises:
            OptionError: A margin that is negative or not finite, or a pair that is not two names.
            UnknownPartError: There is no such body or geom.
        """
        given: Any = scene
        if not isinstance(given, Scene):
            raise OptionError("scene", f"{scene!r}", "a Scene", hint="rik.Scene(robot)")
        if not is_real(margin, 0.0, LARGEST_MARGIN):
            raise OptionError("margin", f"{margin!r}", f"0 to {LARGEST_MARGIN:g} m")
        self.scene = scene
        self.margin = float(margin)
        self.pairs = None if pairs is None else tuple(tuple(pair) for pair in pairs)
        self.ignore = tuple(tuple(pair) for pair in ignore)
        chosen = chosen_pairs(scene.model, scene.pairs, self.pairs, self.ignore)
        self.tables: PairTables = scene.pair_tables(chosen)
        self._left_out: Ints = np.zeros((0, 2), dtype=np.int64)

    def __repr__(self) -> str:
        return f"CollisionAvoidance({self.scene!r}, margin={self.margin:g})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (self.scene, self.margin, self.pairs, self.ignore, self._left_out)

    @cached_property
    def always_near(self) -> tuple[Touching, ...]:
        """Parts that are nearer than the margin in all of many random postures, deepest first.

        With them no posture is free. ``ignore`` leaves them out.
        """
        return always_near(self.scene, self.tables.geoms, self.margin)

    def without(self, geoms: Ints) -> CollisionAvoidance:
        """Return the same condition without pairs (p, 2) of ids of geoms."""
        keys = np.sort(self.tables.geoms, axis=1) @ (self.scene.model.ngeom, 1)
        left_out = np.sort(geoms, axis=1) @ (self.scene.model.ngeom, 1)
        rest = CollisionAvoidance(self.scene, self.margin, self.pairs, self.ignore)
        rest.tables = self.scene.pair_tables(self.tables.geoms[~np.isin(keys, left_out)])
        rest._left_out = np.concatenate([self._left_out, geoms])
        return rest

    def near(self, q: ArrayLike) -> Ints:
        """Return the pairs (p, 2) of ids of geoms nearer than the margin at ``q``, by MuJoCo."""
        geoms = self.tables.geoms
        distances = self.scene.pair_distances(q, geoms, self.margin)
        return geoms[distances < self.margin]

    def clearance(self, q: ArrayLike) -> Clearance:
        """Return the nearest of the chosen pairs at ``q`` (nq,), by MuJoCo."""
        return self.scene.clearance(q, self.tables.geoms)

    def free(self, q: ArrayLike) -> NDArray[Any]:
        """Return whether each posture (n, nq) keeps the margin, as ``Scene.free``."""
        return free_postures(self.scene, self.tables, q, self.margin)

    def memory(self) -> Block:
        """Return memory for one compiled check at a time (``collision.RUN``)."""
        return self.scene.memory(self.tables)


def _rebuilt(
    scene: Scene,
    margin: float,
    pairs: Iterable[Sequence[str]] | None,
    ignore: Iterable[Sequence[str]],
    left_out: Ints,
) -> CollisionAvoidance:
    """Return the copy of a condition."""
    condition = CollisionAvoidance(scene, margin, pairs, ignore)
    return condition.without(left_out) if len(left_out) else condition


def require_same_robot(robot: Robot, collisions: CollisionAvoidance) -> None:
    """Raise ``OptionError`` for a condition on another robot, or for another value."""
    if not isinstance(collisions, CollisionAvoidance):
        raise OptionError(
            "collisions",
            f"{collisions!r}",
            "CollisionAvoidance(scene)",
            hint="None for no condition",
        )
    other = collisions.scene.robot
    if other.model is not robot.model or other.joints != robot.joints:
        raise OptionError(
            "collisions",
            f"its scene is of robot {other!r}, not of {robot!r}",
            hint="create the scene with the same robot: Scene(robot, …)",
        )
