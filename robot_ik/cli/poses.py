"""A pose on the command line: seven numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robot_ik.cli.arguments import wrong
from robot_ik.errors import InvalidGoalError

if TYPE_CHECKING:
    from robot_ik.geometry import Pose


def pose_option(numbers: tuple[float, ...], key: str) -> Pose | None:
    """Position in metres and quaternion w x y z, or position alone; None when nothing was given.

    Raises:
        ConfigError, InvalidGoalError: Another count of numbers, or no pose.
    """
    from robot_ik.geometry import Pose

    if not numbers:
        return None
    if len(numbers) not in (3, 7):
        raise wrong(key, f"{len(numbers)} numbers", "x y z in metres, and an orientation as w x y z")
    try:
        return Pose(numbers[:3], numbers[3:] or (1.0, 0.0, 0.0, 0.0))
    except ValueError as error:
        raise InvalidGoalError(f"{key}: {error}") from error


def pose_words(pose: Pose) -> str:
    """Millimetres and quaternion, for tables."""
    x, y, z = (1e3 * pose.position).tolist()
    w = " ".join(f"{v:.5f}" for v in pose.wxyz)
    return f"{x:.2f} {y:.2f} {z:.2f} mm, wxyz {w}"
