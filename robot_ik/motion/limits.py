"""What a move may ask of a robot: the checks that every planner shares."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import TrajectoryError, UnsupportedJointError, apart
from robot_ik.ports import Array

if TYPE_CHECKING:
    from robot_ik.robot import Robot

# A goal that a solver put onto a limit may miss it by rounding: rad or m.
_LIMIT_ROUNDING = 1e-9


def joint_vector(robot: Robot, q: ArrayLike, what: str) -> Array:
    """``q`` as a fresh (nq,) array.

    Raises:
        TrajectoryError: Wrong length or a number that is not finite; names the joint.
        UnsupportedJointError: The robot has ball or free joints.
    """
    if robot.nq != robot.nv:
        raise UnsupportedJointError(
            f"robot {robot.name!r} has ball or free joints; moves are planned for hinges and slides",
            hint="keep only hinge and slide joints: load_robot(…, joints=[…])",
        )
    vector = np.array(q, dtype=float)
    if vector.shape != (robot.nq,):
        raise TrajectoryError(
            f"the {what} has shape {vector.shape}; {robot.name!r} has {robot.nq} joints",
            hint=f"give one number each for {', '.join(robot.joints)}",
        )
    if not np.isfinite(vector).all():
        k = int(np.argmin(np.isfinite(vector)))
        raise TrajectoryError(
            f"the {what} asks {vector[k]} of joint {robot.joints[k]!r}", hint="give finite numbers, rad or m"
        )
    return vector


def require_inside(robot: Robot, q: Array) -> None:
    """Raises `TrajectoryError` naming joint, asked and allowed when ``q`` (nq,) is outside the limits."""
    outside = np.maximum(robot.lower - q, q - robot.upper)
    k = int(np.argmax(outside))
    if outside[k] > _LIMIT_ROUNDING:
        asked, low, high = apart(q[k], robot.lower[k], robot.upper[k], digits=6, form="g")
        raise TrajectoryError(
            f"the goal asks {asked} of joint {robot.joints[k]!r}; "
            f"allowed: {low} to {high} (rad, m for slides)",
            hint="solve within the limits, or widen them with robot.with_limits",
        )


def motion_limits(
    robot: Robot, speed: float, velocity: ArrayLike | None = None, acceleration: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Velocity and acceleration (nq,) to plan with.

    ``speed`` times the lower of the robot's own limits and the given caps.

    Raises:
        TrajectoryError: ``speed`` outside (0, 1], or a limit that is missing, zero or infinite.
    """
    if not 0.0 < speed <= 1.0:
        raise TrajectoryError(f"asked for speed {speed}", hint="a part of the limits: above 0, at most 1")
    limits = []
    for what, own, cap in (
        ("velocity", robot.velocity, velocity),
        ("acceleration", robot.acceleration, acceleration),
    ):
        lowest = np.minimum(own, np.inf if cap is None else np.asarray(cap, dtype=float))
        if lowest.shape != (robot.nv,) or not (np.isfinite(lowest) & (lowest > 0.0)).all():
            raise TrajectoryError(
                f"the {what} limits of {robot.name!r} are {np.asarray(lowest).tolist()}",
                hint="each joint needs one finite limit above zero: [motion] in robot.toml",
            )
        limits.append(speed * lowest)
    return limits[0], limits[1]


def require_positive(what: str, value: float, unit: str) -> None:
    """Raises `TrajectoryError` unless ``value`` is finite and above zero."""
    if not (np.isfinite(value) and value > 0.0):
        raise TrajectoryError(f"asked for a {what} of {value} {unit}", hint=f"{what} must be above zero")
