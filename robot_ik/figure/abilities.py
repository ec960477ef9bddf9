"""What a figure can do: reach standing, bend, jump; computed from its own model, and kept as a map on disk.

All balls here are seen from the middle between the feet, x ahead: what a figure can do depends on nothing else.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.figure import GRAVITY, Figure, Rows
from robot_ik.figure.jump import TAKE_OFF, forward_at_take_off, highest_take_off
from robot_ik.figure.poses import AT_BALL, BEND, REACH, Pose, find_pose
from robot_ik.kernels.jit import cache_folder

Array = NDArray[np.float64]

_GRID = 0.1  # m
# No jump for a ball farther behind the centre of mass, m: the arm does not go there in the air.
_BEHIND = -0.1
_VERSION = 1
# A ball that is so much nearer to a point of the map than that point's miss is out of reach; local minima, m.
_SLACK = 0.03


@dataclass(frozen=True, eq=False)
class Map:
    """Misses of the palm over a grid: 0 where an admissible pose reaches the ball.

    Attributes:
        origin: (3,) first point of the grid.
        miss: (i, j, k) m; -1 where the hand comes there, but not in an admissible pose.
    """

    origin: Array
    miss: NDArray[np.float32]

    def nearest(self, ball: Array) -> tuple[float, float]:
        """Miss of the nearest grid point (inf outside the grid) and how far that point is."""
        index = np.rint((ball - self.origin) / _GRID).astype(int)
        if (index < 0).any() or (index >= self.miss.shape).any():
            return np.inf, 0.0
        away = float(np.linalg.norm(self.origin + index * _GRID - ball))
        return float(self.miss[tuple(index)]), away

    def surely_out(self, ball: Array) -> bool:
        """No pose reaches the ball: the nearest point of the map is farther out of reach than the ball is from it."""
        miss, away = self.nearest(ball)
        return miss > away + _SLACK

    def comfortable(self, z: float) -> Array:
        """(n, 2) grid points at that height that are in reach, and their neighbours."""
        inside = self.miss == 0.0
        for axis in (0, 1):
            inside = inside & np.roll(inside, 1, axis) & np.roll(inside, -1, axis)
        k = int(np.rint((z - self.origin[2]) / _GRID))
        if not 0 <= k < inside.shape[2]:
            return np.zeros((0, 2))
        return np.asarray(self.origin[:2] + np.argwhere(inside[:, :, k]) * _GRID)


@dataclass(frozen=True, eq=False)
class Abilities:
    """Maps of a figure, by kind and arm.

    Attributes:
        figure: Whose.
        maps: ``(kind, arm)`` to its map.
        ahead: How far before its middle the centre of mass takes off, m.
        raised: By arm: shoulder over the centre of mass (3,) and how far the palm is from it with a straight arm.
    """

    figure: Figure
    maps: dict[tuple[str, str], Map]
    ahead: float
    raised: dict[str, tuple[Array, float]] = field(repr=False)

    @cached_property
    def shoulders(self) -> dict[str, Array]:
        """(3,) of each arm at home."""
        return {arm: shoulder_of(self.figure, arm) for arm in self.figure.hands}

    def can(self, kind: str, ball: Array, arm: str) -> Pose | None:
        """An admissible pose, confirmed by a solve; None where the map or the solve says no."""
        if self.maps[kind, arm].surely_out(ball):
            return None
        pose = find_pose(self.figure, ball, arm, kind)
        return None if pose.flaw else pose

    def take_off(self, ball: Array, arm: str) -> float | None:
        """Speed at take-off that brings the palm to a ball overhead, m/s; None where no jump does, or needs to."""
        shoulder, length = self.raised[arm]
        if ball[0] - self.ahead < _BEHIND:
            return None
        aside = float(np.linalg.norm(ball[:2] - [self.ahead, 0.0] - shoulder[:2]))
        if aside >= length:
            return None
        height = shoulder[2] + float(np.sqrt(length**2 - aside**2))
        squared = 2 * GRAVITY * (ball[2] - height - highest_take_off(self.figure))
        return float(np.sqrt(squared)) if 0.0 < squared <= TAKE_OFF**2 else None


def shoulder_of(figure: Figure, arm: str) -> Array:
    """(3,) the place about which an arm turns, at home: the third place from the hand about which joints turn."""
    return _shoulder_at(figure, figure.home, arm)


def _shoulder_at(figure: Figure, q: Array, arm: str) -> Array:
    model, data = figure.model, figure.data
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    body, anchors = figure.robot.frame(figure.hands[arm]).body, []
    trunk = figure.robot.frame(figure.trunk).body
    while body not in (0, trunk):
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            if not any(np.linalg.norm(data.xanchor[joint] - a) < 1e-3 for a in anchors):
                anchors.append(data.xanchor[joint].copy())
        body = int(model.body_parentid[body])
    return anchors[min(2, len(anchors) - 1)]  # wrist, elbow, shoulder


def _raised(figure: Figure, arm: str) -> tuple[Array, float]:
    """Where the shoulder is beside the centre of mass with the arm stretched straight up, and how far the palm from it."""
    steps = 16
    start, s = figure.posture(**{f"{arm}_shoulder_pitch": 2.6}), np.linspace(1 / steps, 1.0, steps)
    rows = Rows(figure, steps)
    center, shoulder = figure.center(start), shoulder_of(figure, arm)
    hand = figure.pose(start, figure.hands[arm])[0]
    top = np.array([center[0], shoulder[1], hand[2] + 0.6])
    rows.position(figure.hands[arm], hand + (top - hand) * s[:, None], 100.0)
    rows.center(center)
    rows.turned(figure.trunk, np.eye(3))
    stiff = figure.stiffnesses({"*": 0.01, "*hip*": 1.0, "*knee*": 1.0, "*ankle*": 1.0})
    q = rows.solve(start, stiff, start, speeds=None, steps=20).q[-1]
    palm, at = figure.pose(q, figure.hands[arm])[0], _shoulder_at(figure, q, arm)
    # Not quite straight and not quite up: a stretched arm has nowhere to go.
    return at - figure.center(q) - [0.0, 0.0, 0.03], 0.95 * float(np.linalg.norm(palm - at))


def load_abilities(
    figure: Figure, *, progress: Callable[[int, int], None] | None = None, folder: Path | None = None
) -> Abilities:
    """Maps from the user's cache, made if need be (a minute or two, once for each model).

    Args:
        figure: Whose.
        progress: Called with points done and points in all.
        folder: Where the maps are kept; default: the user's cache.
    """
    where = folder or cache_folder().parents[1] / "abilities"
    file = where / f"{figure.robot.name}-{_digest(figure)}.npz"
    keys = [(kind, arm) for arm in figure.hands for kind in (REACH, BEND)]
    maps: dict[tuple[str, str], Map] = {}
    if file.is_file():
        with np.load(file) as stored:
            maps = {(k, a): Map(stored[f"{k}-{a}-origin"], stored[f"{k}-{a}"]) for k, a in keys}
    elif keys:
        maps = _make_maps(figure, keys, progress)
        where.mkdir(parents=True, exist_ok=True)
        arrays: dict[str, NDArray[np.generic]] = {}
        for (kind, arm), found in maps.items():
            arrays |= {f"{kind}-{arm}": found.miss, f"{kind}-{arm}-origin": found.origin}
        part = file.with_name(f"{file.stem}.{os.getpid()}.part.npz")
        np.savez_compressed(part, **arrays)  # type: ignore[arg-type]
        part.replace(file)
    raised = {arm: _raised(figure, arm) for arm in figure.hands}
    return Abilities(figure, maps, forward_at_take_off(figure) if figure.hands else 0.0, raised)


def _digest(figure: Figure) -> str:
    size = mujoco.mj_sizeModel(figure.model)
    buffer = np.empty(size, dtype=np.uint8)
    mujoco.mj_saveModel(figure.model, None, buffer)
    digest = hashlib.sha256(buffer.tobytes())
    digest.update(repr((_VERSION, _GRID, figure.hands, [f.frame for f in figure.feet.values()])).encode())
    return digest.hexdigest()[:16]


def _make_maps(
    figure: Figure, keys: list[tuple[str, str]], progress: Callable[[int, int], None] | None
) -> dict[tuple[str, str], Map]:
    origin, shape = np.array([-1.2, -1.3, -0.1]), (27, 27, 24)
    points = (
        origin
        + np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3) * _GRID
    )
    near, jobs = {}, []
    for kind, arm in keys:
        shoulder = shoulder_of(figure, arm)
        # Beyond the straight arm and what the trunk can do nothing is to be had.
        radius = 1.05 if kind == REACH else 1.75
        near[kind, arm] = np.flatnonzero(np.linalg.norm(points - shoulder, axis=1) < radius)
        jobs += [(kind, arm, int(i)) for i in near[kind, arm]]
    flat = {key: np.full(len(points), np.inf, dtype=np.float32) for key in keys}
    workers = min(2, os.cpu_count() or 1)
    done = 0

    def work(part: list[tuple[str, str, int]], mine: Figure) -> int:
        for kind, arm, i in part:
            pose = find_pose(mine, points[i], arm, kind)
            flat[kind, arm][i] = 0.0 if not pose.flaw else pose.miss if pose.miss > AT_BALL else -1.0
        return len(part)

    figures = [figure.copy() for _ in range(workers)]
    chunks = [jobs[i : i + 200] for i in range(0, len(jobs), 200)]
    with ThreadPoolExecutor(workers) as pool:
        for first in range(0, len(chunks), workers):
            batch = chunks[first : first + workers]
            for count in pool.map(work, batch, figures):
                done += count
                if progress is not None:
                    progress(done, len(jobs))
    return {key: Map(origin, values.reshape(shape)) for key, values in flat.items()}
