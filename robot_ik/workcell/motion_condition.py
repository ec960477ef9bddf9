"""Conditions on the collisions of a motion: with the obstacles of a file, or of an arm file."""

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


def motion_condition(
    robot: Robot, file: Path | None, avoid: bool, arm_condition: CollisionAvoidance | None
) -> CollisionAvoidance | None:
    """Return the condition on a motion; None if it has none.

    The obstacles of ``file`` have precedence. Without a file, an avoiding motion has the condition
    of the arm file, with its scene, its ground and its margin. Without an arm file, the condition
    covers collisions of the robot with itself.

    Args:
        robot: The robot.
        file: MJCF file of obstacles.
        avoid: Whether the motion is planned around the obstacles and the robot itself.
        arm_condition: Condition of the table ``[collisions]`` of the arm file.

    Raises:
        ModelError: The file cannot be read.
        CollisionError: An obstacle is not possible.
    """
    if file is None and not avoid:
        return None
    if file is None and arm_condition is not None:
        return arm_condition
    return condition_among(robot, file)
