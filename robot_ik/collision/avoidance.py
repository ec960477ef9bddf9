"""``CollisionAvoidance``: the condition that a posture keeps a margin from all collisions.

avoid = CollisionAvoidance(scene, margin=0.005, ignore=[("gripper", "part")])
solution = solve(robot, goal, collisions=avoid)
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from numpy.typing import ArrayLike, NDArray

from robot_ik.collision.distances import PairTables
from robot_ik.collision.pairs import chosen_pairs
from robot_ik.collision.scene import Clearance, Scene, free_postures
from robot_ik.errors import OptionError
from robot_ik.geometry import is_real
from robot_ik.kernels.block import Block
from robot_ik.robot import Robot

LARGEST_MARGIN = 10.0
"""m."""

DEFAULT_MARGIN = 0.005
"""m. More than the error of a calibrated small arm."""


class CollisionAvoidance:
    """Keep chosen pairs of a scene apart by a margin.

    Attributes:
        scene: The scene.
        margin: Smallest allowed distance, m.
        pairs: The names that were chosen, None for all.
        ignore: The names that are left out.
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

    def __repr__(self) -> str:
        return f"CollisionAvoidance({self.scene!r}, margin={self.margin:g})"

    def __reduce__(self) -> tuple[Any, ...]:
        return CollisionAvoidance, (self.scene, self.margin, self.pairs, self.ignore)

    def clearance(self, q: ArrayLike) -> Clearance:
        """Return the nearest of the chosen pairs at ``q`` (nq,), by MuJoCo."""
        return self.scene.clearance(q, self.tables.geoms)

    def free(self, q: ArrayLike) -> NDArray[Any]:
        """Return whether each posture (n, nq) keeps the margin, as ``Scene.free``."""
        return free_postures(self.scene, self.tables, q, self.margin)

    def memory(self) -> Block:
        """Return memory for one compiled check at a time (``collision.RUN``)."""
        return self.scene.memory(self.tables)


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
            hint="make the scene with the same robot: Scene(robot, …)",
        )
