"""Which joint offsets the views cannot tell from each other or from the camera's and the board's places.

Source: Hollerbach & Wampler, The calibration index and taxonomy for robot kinematic calibration methods,
Int. J. Robotics Research 15(6), 1996; the singular values of the information matrix are the measure there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.arm_zeros.noise import Normal, inverse

Array = NDArray[np.float64]

# Parts of a direction that are smaller than this share of its largest are not mentioned.
_SHARE = 0.25
# A translation that goes with a degree of the joints and is shorter is not mentioned, metres a rad.
_LEVER = 0.02


@dataclass(frozen=True, eq=False)
class Mixture:
    """A combination of joint offsets that the views do not determine.

    Attributes:
        joint: The one that is held at 0 for it.
        direction: (nv,) the combination, of length 1.
        sigma: Its standard deviation, rad; infinite where the views say nothing at all.
        words: What cannot be told apart, for people.
    """

    joint: str
    direction: Array
    sigma: float
    words: str


def joint_information(normal: Normal, joints: int) -> tuple[Array, Array, Array]:
    """What is known of the joints' offsets when the poses have taken the share that they can.

    Args:
        normal: With what is known of the poses beforehand, so that these are determined in any case.
        joints: How many unknowns are joints; the first of the free ones are.

    Returns:
        Singular values, 1/rad^2, the largest first; directions as columns; (poses, joints): how the poses
        go along with each joint without the views noticing.
    """
    h = normal.matrix
    count = int(np.sum(normal.free < joints))
    along = -inverse(h[count:, count:]) @ h[count:, :count]
    information = h[:count, :count] + h[:count, count:] @ along
    _, values, rows = np.linalg.svd(0.5 * (information + information.T), hermitian=True)
    return values, rows.T, along


def find_mixture(
    normal: Normal, names: Sequence[str], unclear: float, parent: str, other: str
) -> Mixture | None:
    """The worst determined combination of offsets, if its standard deviation is beyond ``unclear`` rad.

    Args:
        normal: At the answer.
        names: Of all joints.
        unclear: Largest standard deviation that counts as told apart.
        parent: What the camera is seen from.
        other: What the board is seen from.
    """
    values, directions, along = joint_information(normal, len(names))
    if len(values) == 0 or values[-1] >= unclear**-2:
        return None
    free = [names[k] for k in normal.free if k < len(names)]
    v = directions[:, -1] * np.sign(directions[int(np.argmax(np.abs(directions[:, -1]))), -1])
    whole = np.zeros(len(names))
    whole[normal.free[: len(free)]] = v
    known = values[-1] > 1e-12 * values[0] and values[-1] > 1e-6
    held = free[int(np.argmax(np.abs(v)))]
    return Mixture(
        held, whole, float(values[-1] ** -0.5) if known else np.inf,
        _words(free, v, along @ v, parent, other),
    )  # fmt: skip


def _words(free: Sequence[str], v: Array, poses: Array, parent: str, other: str) -> str:
    big = np.abs(v) >= _SHARE * np.abs(v).max()
    order = [int(k) for k in np.argsort(-np.abs(v), kind="stable") if big[k]]
    parts = [f"the offset of {free[k]}" for k in order]
    for thing, seen_from, twist in (("camera", parent, poses[:6]), ("board", other, poses[6:])):
        turn, shift = float(np.linalg.norm(twist[3:])), float(np.linalg.norm(twist[:3]))
        if turn >= _SHARE:
            parts.append(f"the turn of the {thing} about {_axis(twist[3:])} of {seen_from}")
        elif shift >= _LEVER:
            parts.append(f"the shift of the {thing} along {_axis(twist[:3])} of {seen_from}")
    if len(parts) == 1:
        return f"{parts[0]} does not show in these views"
    return f"{', '.join(parts[:-1])} and {parts[-1]} look the same"


def _axis(vector: Array) -> str:
    """``z``, or the components of a direction that is along no axis."""
    unit = vector / np.linalg.norm(vector)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > 0.98:
        return "xyz"[k]
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in unit) + ")"
