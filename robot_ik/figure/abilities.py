"""What a figure can do: reach standing, bend, jump; computed from its own model, and kept as a map on disk.

All balls here are seen from the middle between the feet, x forward: what a figure can do depends on nothing
else.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.figure import GRAVITY, Figure, once_each, rotation_points
from robot_ik.figure.frames import FrameRows
from robot_ik.figure.jump import TAKE_OFF, forward_at_take_off, highest_take_off
from robot_ik.figure.motion.pose_prior import mirrored, other_side
from robot_ik.figure.poses import AT_BALL, BEND, NEARLY, REACH, FigurePose, best_pose, find_pose
from robot_ik.files import write_atomically
from robot_ik.kernels.jit import cache_folder
from robot_ik.ports import Array

_GRID = 0.15  # m
# Largest horizontal distance of palm and ball in a jump, which leans a little, m (docs/theory/figure.md); and
# the least rise of the centre of mass, m.
LATERAL_TOLERANCE, _HOP = 0.05, 0.01
# The girdle brings an arm by so much farther than its length, m.
_GIRDLE = 0.06
# A palm that stays farther from where a ball needs it, m, comes there in no other way.
_RIM = 0.2
# An arm that is stretched at the apex as far as it goes has nothing left to correct with, m.
_SPARE = 0.04
_VERSION = 4
ORIGIN, SHAPE = np.array([-1.2, -1.35, -0.1]), (19, 19, 19)
POINTS = ORIGIN + np.argwhere(np.ones(SHAPE, dtype=bool)) * _GRID
# From the shoulder, m: an arm, a trunk that bends, and the hips that follow.
_FARTHEST = 1.7
MAP_FILE = "abilities.npz"
"""Beside a model that ships: its maps."""
_FAR = -32768
_PER_UNIT = 1e4  # of a stored pose: angles and positions within 3.2 rad and m
# A ball that is so much nearer, m, to a point of the map than this share of the error there is out of reach:
# local minima report an error too large, far errors more so.
SLACK, SHARE = 0.04, 0.75
# Poses from which a ball is tried, and from which a point of the map is.
_STARTS, _FEW = 12, 3
# … and a ball that is decided upon.
ASKED = 8
# Joints that hold the trunk upright.
_UPRIGHT = ("*hip*", "*knee*", "*ankle*", "torso*", "pelvis*")
# Points of the map are tried up to so far from those in reach; a ball that is farther than this from all of
# them is out of reach: half a diagonal of the grid, and as much for points that were not found.
_SHELL, _FAR_OFF = 1.9 * _GRID, 1.75 * _GRID


@dataclass(frozen=True, eq=False)
class Map:
    """Errors of the palm over the grid from ``ORIGIN``: 0 where an admissible pose reaches the ball."""

    error: NDArray[np.float32]  # (i, j, k) m; -1 where the hand comes there, but in no admissible pose
    poses: Array  # (n, nq) of the points in reach, in the order of the grid

    @cached_property
    def points(self) -> Array:
        """(n, 3) points in reach."""
        return np.asarray(ORIGIN + np.argwhere(self.error == 0.0) * _GRID)

    def nearby(self, ball: Array, count: int = _STARTS) -> Array:
        """(count, nq) poses that reach the nearest points, the nearest first."""
        away = ((self.points - ball) ** 2).sum(axis=1)
        return np.asarray(self.poses[np.argsort(away, kind="stable")[:count]])

    @cached_property
    def _unreached(self) -> tuple[Array, Array]:
        """(m, 3) points out of reach, and (m,) by how much."""
        out = np.isfinite(self.error) & (self.error > 0.0)
        return ORIGIN + np.argwhere(out) * _GRID, self.error[out].astype(float)

    def surely_out(self, ball: Array) -> bool:
        """No pose reaches the ball.

        It is far from all points in reach, or some point is farther out of reach than it is away from it.
        """
        if not len(self.points) or float(((self.points - ball) ** 2).sum(axis=1).min()) > _FAR_OFF**2:
            return True
        points, error = self._unreached
        away = ball - points
        return bool((SHARE * error - np.sqrt(np.einsum("ij,ij->i", away, away))).max(initial=-1.0) > SLACK)

    @cached_property
    def _inner(self) -> NDArray[np.bool_]:
        """Grid points in reach whose neighbours at the same height are."""
        inside = self.error == 0.0
        for axis in (0, 1):
            inside = inside & np.roll(inside, 1, axis) & np.roll(inside, -1, axis)
        return np.asarray(inside)

    def comfortable(self, z: float) -> Array:
        """(n, 2) grid points at that height that are in reach, and their neighbours."""
        inside = self._inner
        k = (z - ORIGIN[2]) / _GRID
        levels = [level for level in {int(np.floor(k)), int(np.ceil(k))} if 0 <= level < inside.shape[2]]
        return np.asarray(ORIGIN[:2] + np.argwhere(inside[:, :, levels].any(axis=2)) * _GRID)


@dataclass(frozen=True, eq=False)
class Abilities:
    """Maps of a figure, by kind and arm."""

    figure: Figure
    maps: dict[tuple[str, str], Map]

    @cached_property
    def shoulders(self) -> dict[str, Array]:
        """(3,) of each arm at home."""
        return {arm: shoulder_of(self.figure, arm) for arm in self.figure.hands}

    def under(self, arm: str) -> Array:
        """(2,) where a ball is highest that a jump reaches: over the shoulder at take-off."""
        x, y, _ = raised(self.figure, arm)[0]
        return np.array([x + forward_at_take_off(self.figure), y])

    def can(self, kind: str, ball: Array, arm: str, starts: int = ASKED) -> FigurePose | None:
        """An admissible pose, confirmed by a solve from so many poses; None where map or solve says no."""
        found = self.maps[kind, arm]
        if found.surely_out(ball):
            return None
        pose = best_pose(self.figure, ball, arm, kind, found.nearby(ball, starts), quick=True)
        return None if pose is None or pose.flaw else pose

    def pose(self, kind: str, ball: Array, arm: str) -> FigurePose:
        """The natural pose at a ball, or the one that comes nearest."""
        return find_pose(self.figure, ball, arm, kind, self.maps[kind, arm].nearby(ball))

    def top(self, arm: str) -> float:
        """No jump brings a palm higher, m."""
        return highest_take_off(self.figure) + TAKE_OFF**2 / (2 * GRAVITY) + _summit(self.figure, arm)

    def _highest(self, arm: str, xy: Array) -> Array:
        """(3,) as high as a palm comes at (2,) over the centre of mass; the latest point is remembered."""
        known = self.figure.memory.setdefault(f"highest {arm}", {})
        if xy.tobytes() not in known:
            known.clear()
            known[xy.tobytes()] = palm_over_center(self.figure, arm, xy, None)
        return np.asarray(known[xy.tobytes()])

    def take_off(self, ball: Array, arm: str) -> float | None:
        """Speed at take-off that brings the palm to a ball overhead, m/s.

        None where no jump does.  The trunk upright, the palm over the centre of mass as high as it comes, or
        lower for a ball that needs hardly a jump; confirmed by a solve.
        """
        shoulder, length = raised(self.figure, arm)
        over = ball - [forward_at_take_off(self.figure), 0.0, highest_take_off(self.figure)]
        least = float(over[2]) - TAKE_OFF**2 / (2 * GRAVITY)
        lateral = max(float(np.linalg.norm(over[:2] - shoulder[:2])) - LATERAL_TOLERANCE, 0.0)
        if over[2] <= 0.0 or np.hypot(lateral, max(least - shoulder[2], 0.0)) > length + _GIRDLE:
            return None
        if least - 1e-3 > _summit(self.figure, arm):
            return None
        for palm in self._palms(arm, over, least, shoulder[:2]):
            if float(np.linalg.norm(palm[:2] - over[:2])) <= LATERAL_TOLERANCE and palm[2] >= least - 1e-3:
                rise = float(np.clip(over[2] - palm[2] + _SPARE, _HOP, over[2] - least))
                return float(np.sqrt(2 * GRAVITY * rise))
        return None

    def _palms(self, arm: str, over: Array, least: float, shoulder: Array) -> Iterator[Array]:
        """Points of the palm over the centre of mass, one of which a ball may need, the likeliest first."""
        palm = self._highest(arm, over[:2])
        low = palm[2] >= over[2] - _HOP  # no jump would do; a small one does
        yield palm_over_center(self.figure, arm, over[:2], float(over[2]) - _HOP) if low else palm
        if np.linalg.norm(palm[:2] - over[:2]) > _RIM or palm[2] < least - _RIM:
            return
        inwards = shoulder - over[:2]
        inwards *= 0.9 * LATERAL_TOLERANCE / max(float(np.linalg.norm(inwards)), LATERAL_TOLERANCE)
        if palm[2] < least:
            yield palm_over_center(self.figure, arm, over[:2] + inwards, None)
        yield palm_over_center(self.figure, arm, over[:2], least, 0.05)
        yield palm_over_center(self.figure, arm, over[:2] + inwards, least, 0.05)


def shoulder_of(figure: Figure, arm: str, q: Array | None = None) -> Array:
    """(3,) the point about which an arm rotates, at home or at ``q``: the third from the hand."""
    data = figure.at(figure.home if q is None else q)
    hand, trunk = (figure.robot.frame(frame).body for frame in (figure.hands[arm], figure.trunk))
    anchors = rotation_points(figure.model, data, hand, trunk)
    return anchors[min(2, len(anchors) - 1)]  # wrist, elbow, shoulder


@once_each
def raised(figure: Figure, arm: str) -> tuple[Array, float]:
    """The shoulder (3,) seen from the centre of mass with the arm stretched up, and the length of the arm."""
    shoulder = shoulder_of(figure, arm) - figure.center_at_home
    q = _lifted(figure, arm, shoulder[:2], None)
    palm, at = figure.pose(q, figure.hands[arm])[0], shoulder_of(figure, arm, q)
    return at - figure.center(q), float(np.linalg.norm(palm - at))


@once_each
def _summit(figure: Figure, arm: str) -> float:
    """How far above the centre of mass a palm comes at all, m."""
    return float(palm_over_center(figure, arm, raised(figure, arm)[0][:2], 1.25, 0.05)[2])


def palm_over_center(
    figure: Figure, arm: str, xy: Array, z: float | None, lateral_weight: float = 1.0
) -> Array:
    """(3,) where the palm comes, seen from the centre of mass, the trunk upright and the legs as at home.

    Args:
        figure: Who.
        arm: Which hand.
        xy: (2,) where it shall be, m.
        z: At which height; None: as high as it comes.
        lateral_weight: Of the horizontal position, relative to the height's.
    """
    q = _lifted(figure, arm, xy, z, lateral_weight)
    return np.asarray(figure.pose(q, figure.hands[arm])[0] - figure.center(q))


def _lifted(figure: Figure, arm: str, xy: Array, z: float | None, lateral_weight: float = 1.0) -> Array:
    steps = 10
    s = np.minimum(1.0, np.arange(1, steps + 1) / (0.7 * steps))[:, None]
    start = figure.posture({f"{arm}_shoulder_pitch": 2.0, f"{arm}_elbow_pitch": 0.4})
    rows, center = FrameRows(figure, steps), figure.center(start)
    hand = figure.pose(start, figure.hands[arm])[0]
    goal = center + np.array([xy[0], xy[1], 1.6 if z is None else z])
    rows.position(figure.hands[arm], hand + (goal - hand) * s, 3e4 * lateral_weight, axes="xy")
    rows.position(figure.hands[arm], hand + (goal - hand) * s, 30.0 if z is None else 3e4, axes="z")
    rows.center(center)
    rows.orientation(figure.trunk, np.eye(3))
    stiff = figure.stiffnesses({"*": 0.3} | dict.fromkeys(_UPRIGHT, 3e4))
    return rows.solve(start, stiff, start, speeds=None, steps=6).q[-1]


def load_abilities(figure: Figure, *, progress: Callable[[int, int], None] | None = None) -> Abilities:
    """Maps that lie beside the model or in the user's cache; made if need be, some minutes, once for a model.

    Args:
        figure: Whose.
        progress: Called with points done and points in all.
    """
    digest = _digest(figure)
    cached = cache_folder().parents[1] / "abilities" / f"{figure.robot.name}-{digest}.npz"
    symmetric = _is_mirrored(figure)
    arms = [arm for arm in figure.hands if not symmetric or arm == "right"]
    keys = [(kind, arm) for arm in arms for kind in (REACH, BEND)]
    found = next((m for f in (figure.robot.folder / MAP_FILE, cached) if (m := _read(f, digest, keys))), None)
    if found is None and keys:
        found = _make_maps(figure, keys, progress)
        write_maps(cached, digest, found)
    found = found or {}
    if symmetric:
        found |= {(kind, "left"): _reflected(figure, found[kind, "right"]) for kind in (REACH, BEND)}
    abilities = Abilities(figure, found)
    for arm in figure.hands:
        abilities.under(arm)  # now, and not in the frame of the first decision
    return abilities


def _reflected(figure: Figure, right: Map) -> Map:
    """The other arm's map: the grid is its own mirror image."""
    row = np.full(right.error.shape, -1)
    row[right.error == 0.0] = np.arange(len(right.poses))
    flipped = row[:, ::-1]
    poses = mirrored(figure.robot, right.poses[flipped[flipped >= 0]])
    return Map(right.error[:, ::-1].copy(), poses)


def _read(file: Path, digest: str, keys: list[tuple[str, str]]) -> dict[tuple[str, str], Map] | None:
    if not file.is_file():
        return None
    with np.load(file) as stored:
        if str(stored["digest"]) != digest:
            return None
        out = {}
        for kind, arm in keys:
            code = stored[f"{kind}-{arm}"]
            error = np.where(code == _FAR, np.inf, code / 1000.0).astype(np.float32)
            out[kind, arm] = Map(error, stored[f"poses-{kind}-{arm}"] / _PER_UNIT)
    return out


def write_maps(file: Path, digest: str, maps: dict[tuple[str, str], Map]) -> None:
    """Errors as whole millimetres (too far to be tried: ``_FAR``), poses as tenths of a milliradian or mm."""
    file.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, NDArray[Any]] = {"digest": np.array(digest)}
    for (kind, arm), found in maps.items():
        code = np.full(found.error.shape, _FAR, dtype=np.int16)
        near = np.isfinite(found.error)
        # Rounded down: an error that is reported too small only costs a solve.
        code[near] = np.floor(1000.0 * found.error[near]).astype(np.int16)
        coarse = np.rint(found.poses * _PER_UNIT).astype(np.int16)
        arrays |= {f"{kind}-{arm}": code, f"poses-{kind}-{arm}": coarse}
    stored = io.BytesIO()
    np.savez_compressed(stored, allow_pickle=False, **arrays)
    write_atomically(file, stored.getvalue())


def _digest(figure: Figure) -> str:
    """Of all that the maps depend on: the model, which frames are its hands and feet, how they are made."""
    robot = figure.robot
    if robot.path.is_file():
        model = robot.path.read_bytes()
    else:
        buffer = np.empty(mujoco.mj_sizeModel(robot.model), dtype=np.uint8)
        mujoco.mj_saveModel(robot.model, None, buffer)
        model = buffer.tobytes()
    what = (_VERSION, _GRID, sorted(figure.hands.items()), [f.frame for f in figure.feet.values()])
    return hashlib.sha256(model + repr(what).encode()).hexdigest()[:16]


def _make_maps(
    figure: Figure, keys: list[tuple[str, str]], progress: Callable[[int, int], None] | None
) -> dict[tuple[str, str], Map]:
    """Every map: from the hand at home outwards and a shell round what is in reach, then all errors again."""
    at = {key: _points_near(figure, key[1]) for key in keys}
    whole, maps = sum(map(len, at.values())), {}
    for done, key in enumerate(keys):
        error = np.full(len(POINTS), np.inf, dtype=np.float32)
        poses = np.full((len(POINTS), figure.robot.nq), np.nan)
        graded = -1
        while graded < (graded := int(np.isfinite(error).sum())):
            for i in at[key][~np.isfinite(error[at[key]])]:
                near, away = _nearest(i, error == 0.0)
                if away > _SHELL:
                    continue
                error[i], poses[i] = grade(figure, POINTS[i], key[1], key[0], poses[near[:_FEW]])
                if progress is not None:
                    progress(int(done * whole / len(keys) + np.isfinite(error).sum()), whole)
        _again(figure, key, error, poses)
        # A palm that comes to a point comes as near to all others as they are from there.
        for i in np.flatnonzero(np.isfinite(error)):
            nearer = max(float(error[i]), 0.0) + np.linalg.norm(POINTS - POINTS[i], axis=1)
            error = np.where(np.isfinite(error), np.minimum(error, nearer), error).astype(np.float32)
        maps[key] = Map(error.reshape(SHAPE), poses[error == 0.0])
    return maps


def _nearest(i: int, which: NDArray[np.bool_]) -> tuple[NDArray[np.int64], float]:
    """Those points that are nearest to a point, and the distance of the first, m."""
    reached = np.flatnonzero(which)
    if not len(reached):
        return reached, 0.0
    away = np.linalg.norm(POINTS[reached] - POINTS[i], axis=1)
    order = np.argsort(away, kind="stable")[:_STARTS]
    return reached[order], float(away[order[0]])


def grade(figure: Figure, point: Array, arm: str, kind: str, starts: Array) -> tuple[float, Array]:
    """What the map says of a point, and the pose (nq,) that comes nearest.

    0 in reach, -1 only in a pose that is not admissible, else the palm's error, m.
    """
    pose = find_pose(figure, point, arm, kind, starts)
    if pose.flaw and pose.error < NEARLY:
        found = find_pose(figure, point, arm, kind)
        pose = pose if found.flaw and found.error > pose.error else found
    return 0.0 if not pose.flaw else pose.error if pose.error > AT_BALL else -1.0, pose.q


def _again(figure: Figure, key: tuple[str, str], error: NDArray[np.float32], poses: Array) -> None:
    """Points that are missed, from the nearest that are not, as long as that brings more into reach."""
    kind, arm = key
    fresh = np.flatnonzero(error == 0.0)
    while len(fresh):
        found, positions = [], POINTS[fresh]
        for i in np.flatnonzero((error != 0.0) & (error < 2.0 * _GRID)).tolist():
            if np.abs(positions - POINTS[i]).max(axis=1).min() > 1.1 * _GRID:
                continue
            best = best_pose(figure, POINTS[i], arm, kind, poses[_nearest(i, error == 0.0)[0]])
            if best is None:
                raise RuntimeError("no pose was found for a point in reach")
            if not best.flaw:
                error[i], poses[i] = 0.0, best.q
                found.append(i)
            elif error[i] > 0.0:
                error[i] = min(float(error[i]), max(best.error, AT_BALL))
        fresh = np.array(found, dtype=int)


def _points_near(figure: Figure, arm: str) -> NDArray[np.int64]:
    """Points that an arm and what the trunk can do may bring a palm to, those near the hand at home first."""
    near = np.flatnonzero(np.linalg.norm(POINTS - shoulder_of(figure, arm), axis=1) < _FARTHEST)
    away = np.linalg.norm(POINTS[near] - figure.hands_at_home[arm], axis=1)
    return np.asarray(near[np.argsort(away, kind="stable")])


def _is_mirrored(figure: Figure) -> bool:
    """Whether left is the mirror image of right: the model, by its masses, joints and frames at home."""
    if set(figure.hands) != {"left", "right"}:
        return False
    model, data = figure.model, figure.at(figure.home)
    names = [model.body(b).name for b in range(1, model.nbody)]
    flip = np.array([1.0, -1.0, 1.0])
    for name in names:
        other = other_side(name)
        if other not in names:
            return False
        a, b = model.body(name), model.body(other)
        same_place = np.allclose(data.xpos[a.id], flip * data.xpos[b.id], atol=1e-9)
        ranges = [model.jnt_range[int(x.jntadr[0]) : int(x.jntadr[0]) + int(x.jntnum[0])] for x in (a, b)]
        same_joints = name == other or np.allclose(*ranges)
        if not (same_place and np.isclose(a.mass[0], b.mass[0]) and same_joints):
            return False
    return True
