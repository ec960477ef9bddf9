"""Balance: the centre of mass for a wanted zero-moment point, and the point of given frames.

The model is the linear inverted pendulum x'' = ω² (x − p) with ω² = g / z. Its divergent component
ξ = x + x' / ω is planned backwards (Englsberger et al., *Trajectory generation for continuous leg
forces*, Humanoids 2014). MuJoCo's inverse dynamics of the whole body gives the zero-moment point of
the resulting frames, and ``compensate`` corrects the plan by its error.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from robot_ik.figure.figure import DT, Figure
from robot_ik.ports import Array

_MIN_FORCE = 1.0
"""Smallest vertical force with a zero-moment point, N."""


def plan_center(
    nodes: Sequence[tuple[float, Array]], x: Array, omega: float, t: Array
) -> tuple[Array, Array]:
    """Return the centre of mass (n, 2) and the zero-moment point (n, 2) at times ``t``.

    The zero-moment point moves straight from node to node and then rests. In the first piece it is
    constant, at the point from which a body at rest at ``x`` continues into the second piece. This
    is the shift backwards and to the swinging foot before the first step.

    Args:
        nodes: (time, (2,) zero-moment point). Of the first node only the time is used.
        x: (2,) centre of mass at the start.
        omega: ω of the pendulum, 1/s.
        t: (n,) times, s.
    """
    times = np.array([time for time, _ in nodes])
    points = np.array([point for _, point in nodes])
    count = len(nodes) - 1
    slope = (points[1:] - points[:-1]) / np.diff(times)[:, None]

    # The divergent component at the nodes, from the end backwards.
    diverging = np.empty((count + 1, 2))
    diverging[-1] = points[-1]
    for k in range(count - 1, 0, -1):
        shift = slope[k] / omega
        shrinkage = np.exp(-omega * (times[k + 1] - times[k]))
        diverging[k] = points[k] + shift + (diverging[k + 1] - points[k + 1] - shift) * shrinkage

    start = points[:-1].copy()
    e = np.exp(-omega * (times[1] - times[0]))
    start[0] = (diverging[1] * e - x) / (e - 1.0)
    slope[0] = 0.0
    diverging[0] = x

    # Factors of e^{ωu} and e^{−ωu} in each piece.
    growing = np.empty((count, 2))
    shrinking = np.empty((count, 2))
    center = x.copy()
    for k in range(count):
        growing[k] = (diverging[k] - start[k] - slope[k] / omega) / 2
        shrinking[k] = center - start[k] - growing[k]
        u = times[k + 1] - times[k]
        growth = growing[k] * np.exp(omega * u)
        center = start[k] + slope[k] * u + growth + shrinking[k] * np.exp(-omega * u)

    piece = np.clip(np.searchsorted(times, t, side="right") - 1, 0, count - 1)
    elapsed = (np.clip(t, times[0], times[-1]) - times[piece])[:, None]
    point = start[piece] + slope[piece] * elapsed
    growth = np.exp(omega * elapsed)
    return point + growing[piece] * growth + shrinking[piece] / growth, point


def derivatives(figure: Figure, q: Array) -> tuple[Array, Array, Array]:
    """Return speeds and accelerations by central differences, and speeds by forward differences.

    Args:
        figure: The figure.
        q: (n, nq) frames.

    Returns:
        Three arrays (n, nv). Values that need a missing neighbour are zero.
    """
    count = len(q)
    nv = figure.model.nv
    forward = np.zeros((count, nv))
    central = np.zeros((count, nv))
    acceleration = np.zeros((count, nv))
    for i in range(count - 1):
        mujoco.mj_differentiatePos(figure.model, forward[i], DT, q[i], q[i + 1])
    for i in range(1, count - 1):
        mujoco.mj_differentiatePos(figure.model, central[i], 2 * DT, q[i - 1], q[i + 1])
    acceleration[1:-1] = (forward[1:-1] - forward[:-2]) / DT
    return central, acceleration, forward


def zero_moment_points(figure: Figure, q: Array) -> tuple[Array, Array]:
    """Return the zero-moment point on z = 0 and the vertical force of the floor.

    The free base has no motor, so the wrench of inverse dynamics at the base is that of the floor.
    The first and the last frame have no acceleration and count as frames at rest.

    Args:
        figure: The figure.
        q: (n, nq) frames.

    Returns:
        (n, 2) points, m, and (n,) forces, N.
    """
    model = figure.free_model
    data = figure.data
    speed, acceleration, _ = derivatives(figure, q)
    points = np.empty((len(q), 2))
    force = np.empty(len(q))
    for i, row in enumerate(q):
        data.qpos[:] = row
        data.qvel[:] = speed[i]
        data.qacc[:] = acceleration[i]
        mujoco.mj_inverse(model, data)
        push = data.qfrc_inverse[:3]
        moment = data.xmat[1].reshape(3, 3) @ data.qfrc_inverse[3:6]
        force[i] = push[2]
        vertical = push[2] if abs(push[2]) > _MIN_FORCE else 1.0
        points[i] = (
            row[0] - (moment[1] + row[2] * push[0]) / vertical,
            row[1] - (row[2] * push[1] - moment[0]) / vertical,
        )
    return points, force


def compensate(error: Array, omega2: Array) -> Array:
    """Return the shift (n, 2) of the centre of mass that removes an error of the zero-moment point.

    The shift s solves s − s'' / ω² = −error with s = 0 at both ends. This is one tridiagonal system
    (Thomas's elimination).

    Args:
        error: (n, 2) error of the zero-moment point, m.
        omega2: (n,) ω², 1/s².
    """
    k = 1.0 / (omega2 * DT * DT)
    count = len(error)
    shift = -error.copy()
    shift[0] = 0.0
    shift[-1] = 0.0
    upper = np.zeros(count)
    for i in range(1, count - 1):
        pivot = 1.0 + 2.0 * k[i] + k[i] * upper[i - 1]
        upper[i] = -k[i] / pivot
        shift[i] = (shift[i] + k[i] * shift[i - 1]) / pivot
    for i in range(count - 2, 0, -1):
        shift[i] -= upper[i] * shift[i + 1]
    return shift
