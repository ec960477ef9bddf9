"""Brute force for arms with five joints: independent of the closed form of ``robot_ik``.

``Search`` uses only the joint axes of MuJoCo at q = 0. It lays a grid over the last two joints.
For each pair the position fixes the first three joints up to two choices each, by plane
trigonometry. The best pair is refined by smaller and smaller grids.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import robot_ik as rik

Array = NDArray[np.float64]

# Points of the first grid over wrist and roll, of each refinement, and refinements.
GRID = (81, 121)
ZOOM = 21
ZOOMS = 10
# rad: excess over a joint limit that counts as inside.
LIMIT_SLACK = 1e-9


@dataclass(frozen=True)
class Best:
    """The best configuration: joint angles (5,), angle in radians."""

    q: Array
    angle: float


class Search:
    """Exact position and best orientation by grids, for a robot of five hinges."""

    def __init__(self, robot: rik.Robot) -> None:
        self.robot = robot
        data = mujoco.MjData(robot.model)
        data.qpos[:] = robot.qpos(np.zeros(5))
        mujoco.mj_kinematics(robot.model, data)
        ids = [robot.model.joint(name).id for name in robot.joints]
        self.axes = data.xaxis[ids].copy()
        self.points = data.xanchor[ids].copy()
        pose = robot.measure(np.zeros(5))
        self.tool = np.asarray(pose.position)
        self.rotation = np.asarray(pose.rotation)
        lower = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
        upper = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
        self.lower = lower
        self.upper = upper

    def best(self, position: Array, rotation: Array, axis: Array | None = None) -> Best | None:
        """Return the configuration at ``position`` with the smallest angle; None if there is none.

        Args:
            position: (3,) world.
            rotation: (3, 3) wanted orientation.
            axis: (3,) axis of the tool that counts; None for the whole orientation.
        """
        low = self.lower[3:]
        high = self.upper[3:]
        best = self._grid(position, rotation, axis, low, high, GRID)
        if best is None:
            return None
        step = (high - low) / (np.array(GRID) - 1)
        for _ in range(ZOOMS):
            first = np.maximum(low, best.q[3:] - step)
            last = np.minimum(high, best.q[3:] + step)
            finer = self._grid(position, rotation, axis, first, last, (ZOOM, ZOOM))
            if finer is not None and finer.angle <= best.angle:
                best = finer
            step = 4.0 * step / (ZOOM - 1)
        return best

    def _grid(
        self,
        position: Array,
        rotation: Array,
        axis: Array | None,
        low: Array,
        high: Array,
        shape: tuple[int, int],
    ) -> Best | None:
        wrist, roll = np.meshgrid(
            np.linspace(low[0], high[0], shape[0]),
            np.linspace(low[1], high[1], shape[1]),
            indexing="ij",
        )
        last_two = np.column_stack([wrist.ravel(), roll.ravel()])
        roll_turn = Rotation.from_rotvec(last_two[:, 1:] * self.axes[4])
        wrist_turn = Rotation.from_rotvec(last_two[:, :1] * self.axes[3])
        tool = self.points[4] + roll_turn.apply(self.tool - self.points[4])
        tool = self.points[3] + wrist_turn.apply(tool - self.points[3])
        best: Best | None = None
        for back, elbow in itertools.product((False, True), (1.0, -1.0)):
            first_three = self._close(position, tool, back, elbow)
            q = self._wrapped(np.column_stack([first_three, last_two]))
            inside = ((q >= self.lower - LIMIT_SLACK) & (q <= self.upper + LIMIT_SLACK)).all(axis=1)
            if not inside.any():
                continue
            q = q[inside]
            angles = self._angles(q, rotation, axis)
            k = int(np.argmin(angles))
            if best is None or angles[k] < best.angle:
                best = Best(q[k], float(angles[k]))
        return best

    def _close(self, position: Array, tool: Array, back: bool, elbow: float) -> Array:
        """Return the first three joints (n, 3) that bring tool points (n, 3) to a position."""
        up = self.axes[0]
        across = self.axes[1]
        forward = np.cross(across, up)
        target = position - self.points[0]
        radius = np.hypot(target @ forward, target @ across)
        azimuth = np.arctan2(target @ across, target @ forward)
        with np.errstate(invalid="ignore", divide="ignore"):
            bearing = np.arcsin((tool - self.points[0]) @ across / radius)
            if back:
                bearing = np.pi - bearing
            pan = azimuth - bearing
            goal = np.column_stack([radius * np.cos(bearing), np.full(len(tool), target @ up)])
            shoulder = _plane(self.points[1] - self.points[0], forward, up)
            upper = _plane(self.points[2] - self.points[1], forward, up)
            fore = np.column_stack(
                [(tool - self.points[2]) @ forward, (tool - self.points[2]) @ up]
            )
            wanted = goal - shoulder
            upper_length = np.linalg.norm(upper)
            fore_length = np.linalg.norm(fore, axis=1)
            distance = np.linalg.norm(wanted, axis=1)
            cosine = distance**2 - upper_length**2 - fore_length**2
            bend = elbow * np.arccos(cosine / (2.0 * upper_length * fore_length))
        # Angles in the plane (forward, up); a rotation about ``across`` counts them negatively.
        upper_angle = np.arctan2(wanted[:, 1], wanted[:, 0]) - np.arctan2(
            fore_length * np.sin(bend), upper_length + fore_length * np.cos(bend)
        )
        lift = upper_angle - np.arctan2(upper[1], upper[0])
        elbow_angle = upper_angle + bend - np.arctan2(fore[:, 1], fore[:, 0]) - lift
        sign = np.sign(self.axes[2] @ across)
        return np.column_stack([pan, -lift, -sign * elbow_angle])

    def _wrapped(self, q: Array) -> Array:
        middle = 0.5 * (self.lower + self.upper)
        return np.asarray(middle + np.remainder(q - middle + np.pi, 2.0 * np.pi) - np.pi)

    def _angles(self, q: Array, rotation: Array, axis: Array | None) -> Array:
        """Return the angle (n,) between the orientation of each q (n, 5) and the wanted one."""
        turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(q), 1))
        for k in range(5):
            half = 0.5 * q[:, k : k + 1]
            turn = _multiply(turn, np.hstack([np.cos(half), np.sin(half) * self.axes[k]]))
        if axis is None:
            # turn · self.rotation = rotation
            x, y, z, w = Rotation.from_matrix(rotation @ self.rotation.T).as_quat()
            difference = _multiply(
                turn * np.array([1.0, -1.0, -1.0, -1.0]), np.array([[w, x, y, z]])
            )
            sine = np.linalg.norm(difference[:, 1:], axis=1)
            return np.asarray(2.0 * np.arctan2(sine, np.abs(difference[:, 0])))
        x = turn[:, 1]
        y = turn[:, 2]
        z = turn[:, 3]
        w = turn[:, 0]
        pointing = Rotation.from_quat(np.column_stack([x, y, z, w])).apply(self.rotation @ axis)
        wanted = rotation @ axis
        return np.arctan2(np.linalg.norm(np.cross(pointing, wanted), axis=1), pointing @ wanted)


def _multiply(a: Array, b: Array) -> Array:
    """Return the product of quaternions (n, 4), w first."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.column_stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def _plane(vector: Array, forward: Array, up: Array) -> Array:
    return np.array([vector @ forward, vector @ up])


def nearest_distance(robot: rik.Robot, position: Array, rng: np.random.Generator) -> float:
    """Return the smallest distance that 12 least-squares searches find to a position."""
    best = np.inf
    for _ in range(12):
        start = robot.sample(rng)
        found = least_squares(
            lambda q: np.asarray(robot.measure(q).position) - position,
            start,
            bounds=(robot.lower - 1e-12, robot.upper + 1e-12),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        best = min(best, float(np.linalg.norm(found.fun)))
    return best
