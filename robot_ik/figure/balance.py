"""Balance: the centre of mass for a wanted zero-moment point, and the zero-moment point of given frames.

The linear inverted pendulum x'' = ω² (x − p) with ω² = g / z: planned backwards by its divergent component
ξ = x + x' / ω (Englsberger et al., *Trajectory generation for continuous leg forces*, Humanoids 2014), and
corrected by the zero-moment point that MuJoCo's inverse dynamics finds for the whole body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from robot_ik.figure.figure import DT, Figure
from robot_ik.figure.frames import SLICE, Slices, at_once
from robot_ik.motion.keyframes import monotone_slope
from robot_ik.ports import Array


def plan_center(
    nodes: Sequence[tuple[float, Array]], x: Array, omega: float, t: Array
) -> tuple[Array, Array]:
    """(n, 2) centre of mass and (n, 2) zero-moment point, which runs straight from node to node, then rests.

    In the first piece the zero-moment point is constant, wherever it must be for a body at rest at ``x`` to
    meet the second: this is the shift backwards and to the swinging foot before the first step.

    Args:
        nodes: (time, (2,) zero-moment point); the first gives the time of the start only.
        x: (2,) the centre of mass at the start.
        omega: ω, 1/s.
        t: (n,) times.
    """
    times = np.array([t for t, _ in nodes])
    points = np.array([p for _, p in nodes])
    count = len(nodes) - 1
    slope = (points[1:] - points[:-1]) / np.diff(times)[:, None]
    diverging = np.empty((count + 1, 2))
    diverging[-1] = points[-1]
    for k in range(count - 1, 0, -1):
        shift, shrunk = slope[k] / omega, np.exp(-omega * (times[k + 1] - times[k]))
        diverging[k] = points[k] + shift + (diverging[k + 1] - points[k + 1] - shift) * shrunk
    start = points[:-1].copy()
    e = np.exp(-omega * (times[1] - times[0]))
    start[0], slope[0], diverging[0] = (diverging[1] * e - x) / (e - 1.0), 0.0, x
    # Factors of e^{ωu} and e^{−ωu} in each piece.
    growing, shrinking, at = np.empty((count, 2)), np.empty((count, 2)), x.copy()
    for k in range(count):
        growing[k] = (diverging[k] - start[k] - slope[k] / omega) / 2
        shrinking[k] = at - start[k] - growing[k]
        u = times[k + 1] - times[k]
        at = start[k] + slope[k] * u + growing[k] * np.exp(omega * u) + shrinking[k] * np.exp(-omega * u)
    piece = np.clip(np.searchsorted(times, t, side="right") - 1, 0, count - 1)
    passed = (np.clip(t, times[0], times[-1]) - times[piece])[:, None]
    point, grown = start[piece] + slope[piece] * passed, np.exp(omega * passed)
    return point + growing[piece] * grown + shrinking[piece] / grown, point


def derivatives(figure: Figure, q: Array) -> tuple[Array, Array, Array]:
    """Central speeds and accelerations, and forward speeds, (n, nv) each; zero without neighbours."""
    n, nv = len(q), figure.model.nv
    forward, speed, change = np.zeros((n, nv)), np.zeros((n, nv)), np.zeros((n, nv))
    for i in range(n - 1):
        mujoco.mj_differentiatePos(figure.model, forward[i], DT, q[i], q[i + 1])
    for i in range(1, n - 1):
        mujoco.mj_differentiatePos(figure.model, speed[i], 2 * DT, q[i - 1], q[i + 1])
    change[1:-1] = (forward[1:-1] - forward[:-2]) / DT
    return speed, change, forward


def zero_moment_slices(figure: Figure, q: Array) -> Slices[tuple[Array, Array]]:
    """(n, 2) zero-moment point on z = 0 and (n,) vertical force of the floor, N, by inverse dynamics.

    The free base has no motor: the wrench that inverse dynamics puts there is the floor's.  At the ends,
    where there is no acceleration, they are those of rest.
    """
    model, data = figure.model, figure.data
    speed, change, _ = derivatives(figure, q)
    points, force = np.empty((len(q), 2)), np.empty(len(q))
    flags, off = model.opt.disableflags, mujoco.mjtDisableBit
    for a in range(0, len(q), SLICE):
        model.opt.disableflags = flags | off.mjDSBL_CONTACT | off.mjDSBL_LIMIT
        try:
            for i in range(a, min(len(q), a + SLICE)):
                data.qpos[:], data.qvel[:], data.qacc[:] = q[i], speed[i], change[i]
                mujoco.mj_inverse(model, data)
                push = data.qfrc_inverse[:3]
                moment = data.xmat[1].reshape(3, 3) @ data.qfrc_inverse[3:6]
                force[i] = push[2]
                up = push[2] if abs(push[2]) > 1.0 else 1.0
                points[i] = (
                    q[i, 0] - (moment[1] + q[i, 2] * push[0]) / up,
                    q[i, 1] - (q[i, 2] * push[1] - moment[0]) / up,
                )
        finally:
            model.opt.disableflags = flags
        yield
    return points, force


zero_moment_points = at_once(zero_moment_slices)


def compensate(error: Array, omega2: Array) -> Array:
    """(n, 2) shift s of the centre of mass that takes an error (n, 2) off the zero-moment point.

    s − s'' / ω² = −error with s = 0 at both ends: one tridiagonal system (Thomas's elimination).
    """
    k = 1.0 / (omega2 * DT * DT)
    n, shift = len(error), -error.copy()
    shift[0] = shift[-1] = 0.0
    upper = np.zeros(n)
    for i in range(1, n - 1):
        pivot = 1.0 + 2.0 * k[i] + k[i] * upper[i - 1]
        upper[i] = -k[i] / pivot
        shift[i] = (shift[i] + k[i] * shift[i - 1]) / pivot
    for i in range(n - 2, 0, -1):
        shift[i] -= upper[i] * shift[i + 1]
    return shift


def hull(points: Array) -> Array:
    """(h, 2) corners of the convex hull of (n, 2) points, counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted(set(map(tuple, points.tolist())))
    if len(ordered) < 3:
        return np.array(ordered).reshape(-1, 2)

    def half(ordered: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
        out: list[tuple[float, ...]] = []
        for x, y in ordered:
            while len(out) > 1:
                (ax, ay), (bx, by) = out[-2], out[-1]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 1e-12:
                    break
                out.pop()
            out.append((x, y))
        return out[:-1]

    return np.array(half(ordered) + half(ordered[::-1]))


def hull_edges(corners: Array) -> tuple[Array, Array]:
    """Edges of a hull as (h, 2) inward normals and (h,) offsets: p is inside by ``normal @ p - offset``."""
    edge = np.concatenate([corners[1:], corners[:1]]) - corners
    normal = np.column_stack([-edge[:, 1], edge[:, 0]]) / np.linalg.norm(edge, axis=1)[:, None]
    return normal, (normal * corners).sum(axis=1)


def hull_margin(points: Array, z: Array) -> float:
    """Distance of z (2,) to the border of the hull of (n, 2) points: positive inside."""
    corners = hull(points)
    if len(corners) == 1:
        return -float(np.linalg.norm(z - corners[0]))
    edge = np.concatenate([corners[1:], corners[:1]]) - corners
    away = z - corners
    t = np.clip((away * edge).sum(1) / (edge * edge).sum(1), 0.0, 1.0)
    distance = float(np.sqrt(((away - t[:, None] * edge) ** 2).sum(1).min()))
    inside = len(corners) > 2 and bool((edge[:, 0] * away[:, 1] - edge[:, 1] * away[:, 0] >= 0).all())
    return distance if inside else -distance


def inset(normal: Array, offset: Array, point: Array, margin: float) -> Array:
    """The point (2,), moved until it is ``margin`` inside all edges of a hull.

    Edges as (h, 2) inward normals and (h,) offsets: inside is ``normal @ point >= offset``.
    """
    for _ in range(20):
        short = margin + offset - normal @ point
        worst = int(short.argmax())
        if short[worst] <= 1e-6:
            break
        point = point + short[worst] * normal[worst]
    return np.asarray(point)


def smooth(values: Array, sigma: float) -> Array:
    """Values along the first axis under a Gaussian of ``sigma`` samples; the ends go on as they are."""
    reach = int(4 * sigma + 0.5)
    if reach == 0:
        return values
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights /= weights.sum()
    padded = np.pad(values, [(reach, reach)] + [(0, 0)] * (values.ndim - 1), mode="edge")
    columns = padded.reshape(len(padded), -1).T
    out = np.stack([np.convolve(column, weights, mode="valid") for column in columns], axis=1)
    return out.reshape(values.shape)


def monotone_curve(knots: Array, values: Array, t: Array) -> Array:
    """Cubic curve through the knots that overshoots none, flat at both ends."""
    h, slope = np.diff(knots), np.zeros(len(knots))
    d = np.diff(values) / h
    slope[1:-1] = monotone_slope(d[:-1], d[1:], h[:-1], h[1:])
    return _hermite(knots, values, slope, t)


def clamped_curve(knots: Array, values: Array, t: Array, slope: float = 0.0) -> Array:
    """Cubic spline through the knots, smooth to the second derivative, from rest to a slope at its end."""
    h, n = np.diff(knots), len(knots)
    matrix, right = np.eye(n), np.zeros(n)
    right[-1] = slope
    for i in range(1, n - 1):
        matrix[i, i - 1 : i + 2] = 1 / h[i - 1], 2 / h[i - 1] + 2 / h[i], 1 / h[i]
        right[i] = 3 * ((values[i] - values[i - 1]) / h[i - 1] ** 2 + (values[i + 1] - values[i]) / h[i] ** 2)
    return _hermite(knots, values, np.asarray(np.linalg.solve(matrix, right), dtype=float), t)


def quintic(x0: Array, v0: Array, a0: Array, x1: Array, v1: Array, a1: Array, T: float) -> Array:
    """(6, ...) coefficients, highest first, of a quintic with position, speed, acceleration of both ends."""
    matrix = np.array([[T**5, T**4, T**3], [5 * T**4, 4 * T**3, 3 * T**2], [20 * T**3, 12 * T**2, 6 * T]])
    right = np.stack([x1 - x0 - v0 * T - a0 * T * T / 2, v1 - v0 - a0 * T, a1 - a0])
    return np.concatenate([np.linalg.solve(matrix, right), np.stack([a0 / 2, v0, x0])])


def decay(x0: Array, v0: Array, duration: float, a0: Array | float = 0.0) -> Callable[[Array], Array]:
    """An offset (k,) with its speed and acceleration that comes to rest at zero: (n,) times to (n, k).

    The quintic of inertialisation (Bollo, *Inertialization*, GDC 2018).
    """
    rest = np.zeros_like(x0)
    coefficients = quintic(x0, v0, rest + a0, rest, rest, rest, duration)
    return lambda t: np.where(t[:, None] >= duration, 0.0, np.polyval(coefficients, t[:, None]))


def _hermite(knots: Array, values: Array, slope: Array, t: Array) -> Array:
    t = np.clip(t, knots[0], knots[-1])
    k = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    h = knots[k + 1] - knots[k]
    s = (t - knots[k]) / h
    a, b = values[k], values[k + 1]
    return np.asarray(
        (1 + 2 * s) * (1 - s) ** 2 * a + s * (1 - s) ** 2 * h * slope[k]
        + s * s * (3 - 2 * s) * b + s * s * (s - 1) * h * slope[k + 1]
    )  # fmt: skip
