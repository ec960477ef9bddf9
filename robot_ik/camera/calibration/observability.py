"""Joint offsets that the views do not determine.

The views cannot separate them from each other, or from the poses of camera and board.

Source: Hollerbach & Wampler, The calibration index and taxonomy for robot kinematic calibration
methods, Int. J. Robotics Research 15(6), 1996. The singular values of the information matrix are
the measure there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.camera.calibration.least_squares import NormalEquations, inverse
from robot_ik.ports import Array

# A direction without information: singular value, 1/rad^2, and part of the largest one.
_NO_INFORMATION = 1e-6
_NO_INFORMATION_SHARE = 1e-12


@dataclass(frozen=True, eq=False)
class Unobservable:
    """A combination of joint offsets that the views do not determine.

    Attributes:
        joint: Joint that is held at 0 because of it.
        joints: Names of the free joints, in the order of ``direction``.
        direction: (n,) the combination, of length 1.
        poses: (12,) twists of camera and board with the same effect on the views, per rad.
        sigma: Its standard deviation, rad; infinite if the views contain no information on it.
    """

    joint: str
    joints: tuple[str, ...]
    direction: Array
    poses: Array
    sigma: float


def joint_information(normal: NormalEquations, joints: int) -> tuple[Array, Array, Array]:
    """Return the information on the joint offsets, with the poses eliminated (Schur complement).

    Args:
        normal: Normal equations with a prior of the poses, so that these are always determined.
        joints: Number of unknowns that are joints. They are the first unknowns.

    Returns:
        Singular values, 1/rad^2, the largest first; directions as columns; (poses, joints) change
        of the poses that compensates a change of each joint in the views.
    """
    h = normal.matrix
    count = int(np.sum(normal.free < joints))
    along = -inverse(h[count:, count:]) @ h[count:, :count]
    information = h[:count, :count] + h[:count, count:] @ along
    _, values, rows = np.linalg.svd(0.5 * (information + information.T), hermitian=True)
    return values, rows.T, along


def find_unobservable(
    normal: NormalEquations, names: Sequence[str], max_sigma: float
) -> Unobservable | None:
    """Return the worst determined combination of offsets, or None if it is determined.

    Args:
        normal: Normal equations of joints and poses.
        names: Names of all joints.
        max_sigma: Standard deviation of a determined combination, rad.
    """
    values, directions, along = joint_information(normal, len(names))
    if len(values) == 0 or values[-1] >= max_sigma**-2:
        return None
    free = tuple(names[k] for k in normal.free if k < len(names))
    direction = directions[:, -1]
    largest = int(np.argmax(np.abs(direction)))
    direction = direction * np.sign(direction[largest])
    known = values[-1] > max(_NO_INFORMATION_SHARE * values[0], _NO_INFORMATION)
    sigma = float(values[-1] ** -0.5) if known else np.inf
    return Unobservable(free[largest], free, direction, along @ direction, sigma)
