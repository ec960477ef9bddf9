"""Goals that keep the feet of a robot in place while another frame moves.

``keep`` of ``robot.toml`` names the frames. The commands and the testbed add these goals unless the
user gives other goals.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.goals import Goal, PoseGoal
from robot_ik.robot import Robot


def supported_frames(robot: Robot, moved: Collection[str]) -> tuple[str, ...]:
    """Return the frames that stay at home while others move.

    A frame that is rigidly connected to a moved frame, or that no active joint moves, is left out.

    Args:
        robot: The robot.
        moved: Names of the frames that goals move.

    Raises:
        UnknownFrameError: The robot has no such frame.
    """
    rigid = robot.model.body_weldid
    taken = {int(rigid[robot.frame(name).body]) for name in moved}
    return tuple(
        name
        for name in robot.file.keep
        if int(rigid[robot.frame(name).body]) not in taken and robot.attachment(name)[0] >= 0
    )


def support_goals(
    robot: Robot, moved: Collection[str], *, q: ArrayLike | None = None, priority: int = 0
) -> list[Goal]:
    """Return goals that keep the feet of a robot where they are.

    Example::

        goals = [PositionGoal("right_hand", (0.5, -0.3, 1.4), priority=1)]
        goals = [*support_goals(robot, ["right_hand"]), *goals]

    Args:
        robot: The robot.
        moved: Names of the frames that other goals move.
        q: (nq,) joint angles at which the frames are where they should stay. Default: home.
        priority: Priority of these goals. Goals of priority 0 are met first.

    Returns:
        One pose goal a frame. None for a robot without feet, such as an arm on a table.

    Raises:
        UnknownFrameError: The robot has no such frame.
    """
    at = robot.home if q is None else np.asarray(q, dtype=float)
    poses = [(name, robot.forward(at, name)) for name in supported_frames(robot, moved)]
    return [PoseGoal(name, pose.position, pose.wxyz, priority=priority) for name, pose in poses]
