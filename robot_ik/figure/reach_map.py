"""Maps of the balls that a hand reaches, computed from the model and stored in a file.

All balls here are given in the frame of the stance: the middle between the feet, x forward.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.figure import Figure, rotation_points
from robot_ik.figure.motion.pose_prior import mirrored, other_side
from robot_ik.figure.pose_search import SEARCH, best_pose, find_pose
from robot_ik.figure.poses import BEND, PALM_TOLERANCE, REACH
from robot_ik.files import write_atomically
from robot_ik.kernels.jit import cache_folder
from robot_ik.ports import Array
from robot_ik.robot import Robot

GRID = 0.15
"""Distance of the points of a map, m."""

ORIGIN = np.array([-1.2, -1.35, -0.1])
"""First point of a map, m."""

SHAPE = (19, 19, 19)
"""Points of a map along x, y and z."""

POINTS = ORIGIN + np.argwhere(np.ones(SHAPE, dtype=bool)) * GRID
"""(n, 3) points of a map, m."""

MAP_FILE = "abilities.npz"
"""Name of the file with maps beside a model."""

SLACK = 0.04
"""Excess of an error that a local minimum may cause, m, whatever the size of the error."""

SHARE = 0.75
"""Share of the error of a point that is certain. The excess of large errors is larger."""

_VERSION = 4
"""Version of the maps. Files of another version are not read."""

_FARTHEST = 1.7
"""Largest distance of a point from the shoulder, m: arm, bending trunk and hips."""

_FAR_CODE = -32768
"""Stored error of a point that was not tried."""

_UNITS = 1e4
"""Stored units per rad and m. A pose is stored within 3.2 rad and m."""

_NEARBY = 12
"""Largest number of start poses for a ball."""

_GRADE_STARTS = 3
"""Number of start poses for a point of the map."""

_SHELL = 1.9 * GRID
"""Points up to this distance from those in reach are tried, m."""

_FAR_OUT = 1.75 * GRID
"""A ball farther than this from all points in reach is out of reach, m: half a diagonal of the grid
and as much for points in reach that were not found."""


@dataclass(frozen=True, eq=False)
class ReachMap:
    """Errors of the palm over the grid of points.

    Attributes:
        error: (i, j, k) m. 0 where an admissible pose reaches the point. -1 where the palm reaches
            it in no admissible pose. Infinite where it was not tried.
        poses: (n, nq) poses of the points in reach, in the order of the grid.
    """

    error: NDArray[np.float32]
    poses: Array

    @cached_property
    def points(self) -> Array:
        """Points (n, 3) in reach."""
        return np.asarray(ORIGIN + np.argwhere(self.error == 0.0) * GRID)

    def nearby(self, ball: Array, count: int = _NEARBY) -> Array:
        """Return poses (count, nq) that reach the nearest points, the nearest first."""
        distances = ((self.points - ball) ** 2).sum(axis=1)
        return np.asarray(self.poses[np.argsort(distances, kind="stable")[:count]])

    @cached_property
    def _missed(self) -> tuple[Array, Array]:
        """Points (m, 3) out of reach and their errors (m,)."""
        is_missed = np.isfinite(self.error) & (self.error > 0.0)
        return ORIGIN + np.argwhere(is_missed) * GRID, self.error[is_missed].astype(float)

    def is_out_of_reach(self, ball: Array) -> bool:
        """Return whether no pose reaches a ball (3,).

        It is far from all points in reach, or some point is farther out of reach than the ball is
        away from it.
        """
        if not len(self.points):
            return True
        if float(((self.points - ball) ** 2).sum(axis=1).min()) > _FAR_OUT**2:
            return True
        points, error = self._missed
        offsets = ball - points
        distances = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        return bool((SHARE * error - distances).max(initial=-1.0) > SLACK)

    @cached_property
    def _inner(self) -> NDArray[np.bool_]:
        """Grid points in reach whose neighbours at the same height are in reach."""
        inner = self.error == 0.0
        for axis in (0, 1):
            inner = inner & np.roll(inner, 1, axis) & np.roll(inner, -1, axis)
        return np.asarray(inner)

    def comfortable(self, z: float) -> Array:
        """Return positions (n, 2) in reach at a height whose neighbours are in reach, too."""
        inner = self._inner
        k = (z - ORIGIN[2]) / GRID
        levels = [
            level for level in {int(np.floor(k)), int(np.ceil(k))} if 0 <= level < inner.shape[2]
        ]
        return np.asarray(ORIGIN[:2] + np.argwhere(inner[:, :, levels].any(axis=2)) * GRID)


Maps = dict[tuple[str, str], ReachMap]
"""Maps by kind and arm."""


def load_maps(figure: Figure, progress: Callable[[int, int], None] | None = None) -> Maps:
    """Return the maps of a figure from a file, or compute them in some minutes.

    Args:
        figure: The figure.
        progress: Called with the number of finished points and of all points.
    """
    digest = _digest(figure)
    folder = cache_folder().parents[1] / "abilities"
    cached = folder / f"{figure.robot.name}-{digest}.npz"
    symmetric = _is_mirrored(figure)
    arms = [arm for arm in figure.hands if not symmetric or arm == "right"]
    keys = [(kind, arm) for arm in arms for kind in (REACH, BEND)]
    maps: Maps | None = None
    for file in (figure.robot.folder / MAP_FILE, cached):
        maps = _read_maps(file, digest, keys)
        if maps:
            break
    if maps is None and keys:
        maps = _compute_maps(figure, keys, progress)
        write_maps(cached, digest, maps)
    maps = maps or {}
    if symmetric:
        for kind in (REACH, BEND):
            maps[kind, "left"] = _mirrored_map(figure.robot, maps[kind, "right"])
    return maps


def _mirrored_map(robot: Robot, right: ReachMap) -> ReachMap:
    """Return the map of the left arm. The grid is symmetric."""
    rows = np.full(right.error.shape, -1)
    rows[right.error == 0.0] = np.arange(len(right.poses))
    flipped = rows[:, ::-1]
    poses = mirrored(robot, right.poses[flipped[flipped >= 0]])
    return ReachMap(right.error[:, ::-1].copy(), poses)


def _read_maps(file: Path, digest: str, keys: list[tuple[str, str]]) -> Maps | None:
    """Return the maps of a file. None if there is no file or it is of another model."""
    if not file.is_file():
        return None
    with np.load(file) as stored:
        if str(stored["digest"]) != digest:
            return None
        maps: Maps = {}
        for kind, arm in keys:
            code = stored[f"{kind}-{arm}"]
            error = np.where(code == _FAR_CODE, np.inf, code / 1000.0).astype(np.float32)
            maps[kind, arm] = ReachMap(error, stored[f"poses-{kind}-{arm}"] / _UNITS)
        return maps


def write_maps(file: Path, digest: str, maps: Maps) -> None:
    """Write maps into a file.

    Errors are whole millimetres, rounded down: an error that is reported too small only costs a
    solve. Poses are tenths of a milliradian or millimetre.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, NDArray[Any]] = {"digest": np.array(digest)}
    for (kind, arm), reach_map in maps.items():
        code = np.full(reach_map.error.shape, _FAR_CODE, dtype=np.int16)
        is_tried = np.isfinite(reach_map.error)
        code[is_tried] = np.floor(1000.0 * reach_map.error[is_tried]).astype(np.int16)
        arrays[f"{kind}-{arm}"] = code
        arrays[f"poses-{kind}-{arm}"] = np.rint(reach_map.poses * _UNITS).astype(np.int16)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomically(file, buffer.getvalue())


def _digest(figure: Figure) -> str:
    """Return a digest of the model, the frames of hands and feet, and the version of the maps."""
    robot = figure.robot
    if robot.path.is_file():
        model = robot.path.read_bytes()
    else:
        buffer = np.empty(mujoco.mj_sizeModel(robot.model), dtype=np.uint8)
        mujoco.mj_saveModel(robot.model, None, buffer)
        model = buffer.tobytes()
    feet = [foot.frame for foot in figure.feet.values()]
    settings = (_VERSION, GRID, sorted(figure.hands.items()), feet)
    return hashlib.sha256(model + repr(settings).encode()).hexdigest()[:16]


def _compute_maps(
    figure: Figure,
    keys: list[tuple[str, str]],
    progress: Callable[[int, int], None] | None,
) -> Maps:
    """Compute maps from the hand at home outwards and in a shell around the points in reach."""
    candidates = {key: _candidate_points(figure, key[1]) for key in keys}
    total = sum(map(len, candidates.values()))
    maps: Maps = {}
    for number, (kind, arm) in enumerate(keys):
        error = np.full(len(POINTS), np.inf, dtype=np.float32)
        poses = np.full((len(POINTS), figure.robot.nq), np.nan)
        previous = -1
        graded = 0
        while previous < graded:
            indices = candidates[kind, arm]
            for i in indices[~np.isfinite(error[indices])]:
                nearest, distance = _nearest(i, error == 0.0)
                if distance > _SHELL:
                    continue
                starts = poses[nearest[:_GRADE_STARTS]]
                error[i], poses[i] = grade(figure, POINTS[i], arm, kind, starts)
                if progress is not None:
                    done = number * total / len(keys) + np.isfinite(error).sum()
                    progress(int(done), total)
            previous = graded
            graded = int(np.isfinite(error).sum())
        _retry_missed(figure, (kind, arm), error, poses)

        # A palm that reaches a point is as near to other points as this point is.
        for i in np.flatnonzero(np.isfinite(error)):
            bound = max(float(error[i]), 0.0) + np.linalg.norm(POINTS - POINTS[i], axis=1)
            error = np.where(np.isfinite(error), np.minimum(error, bound), error)
            error = error.astype(np.float32)
        maps[kind, arm] = ReachMap(error.reshape(SHAPE), poses[error == 0.0])
    return maps


def _nearest(i: int, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], float]:
    """Return the chosen points nearest to a point, and the distance of the first, m."""
    indices = np.flatnonzero(chosen)
    if not len(indices):
        return indices, 0.0
    distances = np.linalg.norm(POINTS[indices] - POINTS[i], axis=1)
    order = np.argsort(distances, kind="stable")[:_NEARBY]
    return indices[order], float(distances[order[0]])


def grade(figure: Figure, point: Array, arm: str, kind: str, starts: Array) -> tuple[float, Array]:
    """Return the error of a point as the map stores it, and the pose (nq,) nearest to it.

    Args:
        figure: The figure.
        point: (3,) the point.
        arm: Side of the hand.
        kind: ``reach`` or ``bend``.
        starts: (n, nq) poses from which the search begins.
    """
    pose = find_pose(figure, point, arm, kind, starts)
    if pose.violation and pose.error < SEARCH.near:
        wide = find_pose(figure, point, arm, kind)
        if not wide.violation or wide.error <= pose.error:
            pose = wide
    if not pose.violation:
        return 0.0, pose.q
    return pose.error if pose.error > PALM_TOLERANCE else -1.0, pose.q


def _retry_missed(
    figure: Figure, key: tuple[str, str], error: NDArray[np.float32], poses: Array
) -> None:
    """Retry missed points from their neighbours, in place in ``error`` and ``poses``.

    The retries end when no further point is reached.
    """
    kind, arm = key
    fresh = np.flatnonzero(error == 0.0)
    while len(fresh):
        reached = []
        positions = POINTS[fresh]
        for i in np.flatnonzero((error != 0.0) & (error < 2.0 * GRID)).tolist():
            if np.abs(positions - POINTS[i]).max(axis=1).min() > 1.1 * GRID:
                continue
            starts = poses[_nearest(i, error == 0.0)[0]]
            pose = best_pose(figure, POINTS[i], arm, kind, starts)
            if pose is None:
                raise RuntimeError("no start was given for a point near the points in reach")
            if not pose.violation:
                error[i] = 0.0
                poses[i] = pose.q
                reached.append(i)
            elif error[i] > 0.0:
                error[i] = min(float(error[i]), max(pose.error, PALM_TOLERANCE))
        fresh = np.array(reached, dtype=int)


def _candidate_points(figure: Figure, arm: str) -> NDArray[np.int64]:
    """Return points that arm and trunk may bring a palm to, those near the hand at home first."""
    shoulder = shoulder_position(figure, arm)
    near = np.flatnonzero(np.linalg.norm(POINTS - shoulder, axis=1) < _FARTHEST)
    distances = np.linalg.norm(POINTS[near] - figure.hands_at_home[arm], axis=1)
    return np.asarray(near[np.argsort(distances, kind="stable")])


def shoulder_position(figure: Figure, arm: str, q: Array | None = None) -> Array:
    """Return the point (3,) about which an arm rotates, at ``q`` (nq,) or at home."""
    data = figure.data_at(figure.home if q is None else q)
    hand = figure.robot.frame(figure.hands[arm]).body
    trunk = figure.robot.frame(figure.trunk).body
    points = rotation_points(figure.model, data, hand, trunk)
    # From the hand: wrist, elbow, shoulder.
    return points[min(2, len(points) - 1)]


def _is_mirrored(figure: Figure) -> bool:
    """Return whether the left of the model mirrors the right: masses, joints and frames at home."""
    if set(figure.hands) != {"left", "right"}:
        return False
    model = figure.model
    data = figure.data_at(figure.home)
    names = [model.body(body).name for body in range(1, model.nbody)]
    flip = np.array([1.0, -1.0, 1.0])
    for name in names:
        other = other_side(name)
        if other not in names:
            return False
        a = model.body(name)
        b = model.body(other)
        if not np.allclose(data.xpos[a.id], flip * data.xpos[b.id], atol=1e-9):
            return False
        if not np.isclose(a.mass[0], b.mass[0]):
            return False
        if name != other and not np.allclose(_joint_ranges(model, a), _joint_ranges(model, b)):
            return False
    return True


def _joint_ranges(model: mujoco.MjModel, body: Any) -> Array:
    """Return the ranges (k, 2) of the joints of a body."""
    first = int(body.jntadr[0])
    return np.asarray(model.jnt_range[first : first + int(body.jntnum[0])])
