"""``condition_among``: the condition on collisions of a robot among the obstacles of a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from robot_ik.collision import DEFAULT_MARGIN
from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.obstacle_file import load_obstacles
from robot_ik.collision.scene import Scene
from robot_ik.robot import Robot


def condition_among(
    robot: Robot,
    file: Path | None,
    margin: float = DEFAULT_MARGIN,
    ignore: Iterable[Sequence[str]] = (),
) -> CollisionAvoidance:
    """Return the condition that a robot touches neither itself nor the obstacles of a file.

    Args:
        robot: The robot.
        file: MJCF file of obstacles. None for the robot alone.
        margin: Smallest allowed distance, m.
        ignore: Pairs of names that may touch.

    Raises:
        ModelError: The file cannot be read.
        CollisionError: An obstacle is not possible, or a name is unknown.
    """
    obstacles = () if file is None else load_obstacles(file)
    return CollisionAvoidance(Scene(robot, obstacles), margin, ignore=ignore)
