"""``Figure``: a model with feet and hands, and the shapes of its soles.

Everything is found in the model and in the table ``[figure]`` of its ``robot.toml``; any model that names
two feet there can walk.  Angles rad, lengths m, world axes with z up; the floor is z = 0.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatch
from functools import cached_property
from typing import Any, Concatenate, ParamSpec, TypeVar

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import ModelError
from robot_ik.figure.parts import figure_parts
from robot_ik.geometry import axis_rotations, quat_to_matrix
from robot_ik.goals import mass_table
from robot_ik.kernels.tree import FREE, HINGE, SLIDE
from robot_ik.motion.keyframes import Displacement
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

SIDES = ("left", "right")
GRAVITY = 9.81
RATE = 60.0
"""Frames a second."""
DT = 1.0 / RATE
"""Time between two frames, s."""

_PITCHES = np.radians(np.arange(-60.0, 90.01, 0.25))
_GEOM = mujoco.mjtGeom
_Made = TypeVar("_Made")
_More = ParamSpec("_More")


def once_each(
    make: Callable[Concatenate[Figure, _More], _Made],
) -> Callable[Concatenate[Figure, _More], _Made]:
    """A function of a figure (and names, numbers) whose results the figure keeps."""

    @functools.wraps(make)
    def kept(figure: Figure, /, *more: _More.args, **named: _More.kwargs) -> _Made:
        key = (make, *more, *named.items())
        if key not in figure.memory:
            figure.memory[key] = make(figure, *more, **named)
        found: _Made = figure.memory[key]
        return found

    return kept


def in_stance_frame(stance: Array, point: Array) -> Array:
    """A point (3,) of the world seen from a stance (x, y, heading)."""
    return np.asarray(axis_rotations("z", -stance[2]) @ (point - [stance[0], stance[1], 0.0]))


def shape_points(model: mujoco.MjModel, g: int, up: Array) -> Array:
    """(k, a, 3) points of a geom, in its body's frame, one of which is its lowest: ends, corners.

    A shape that lies on the floor touches it with all of them.

    Args:
        model: The model.
        g: A sphere, capsule, ellipsoid, box or cylinder.
        up: (a, 3) what is up, seen from the body.

    Raises:
        ModelError: A geom of another kind (a mesh has no exact lowest point here).
    """
    matrix, size, kind = np.empty(9), model.geom_size[g], model.geom_type[g]
    mujoco.mju_quat2Mat(matrix, model.geom_quat[g])
    axes = matrix.reshape(3, 3)
    down = -up @ axes
    ends = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])[:, None]
    if kind == _GEOM.mjGEOM_SPHERE:
        local = size[0] * down[None]
    elif kind == _GEOM.mjGEOM_CAPSULE:
        local = size[0] * down + ends
    elif kind == _GEOM.mjGEOM_ELLIPSOID:
        local = (size**2 * down / np.linalg.norm(size * down, axis=1, keepdims=True))[None]
    elif kind == _GEOM.mjGEOM_BOX:
        corners = size * (2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1.0)
        local = np.broadcast_to(corners[:, None], (8, len(up), 3))
    elif kind == _GEOM.mjGEOM_CYLINDER:
        flat = down * [1.0, 1.0, 0.0]
        local = size[0] * flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12) + ends
    else:
        raise ModelError(
            f"the foot's shape {model.geom(g).name!r} is no sphere, capsule, ellipsoid, box or cylinder",
            hint="give the foot simple collision shapes, and its mesh contype=0 conaffinity=0",
        )
    return np.asarray(model.geom_pos[g] + local @ axes.T)


def lowest_points(model: mujoco.MjModel, geoms: list[int], up: Array) -> tuple[Array, Array]:
    """(a, g) heights and (a, g, 3) positions of the lowest points of geoms; as ``shape_points``."""
    height, position = np.empty((len(up), len(geoms))), np.empty((len(up), len(geoms), 3))
    rows = np.arange(len(up))
    for index, g in enumerate(geoms):
        points = shape_points(model, g, up)
        heights = np.einsum("kai,ai->ka", points, up)
        low = heights.argmin(axis=0)
        height[:, index], position[:, index] = heights[low, rows], points[low, rows]
    return height, position


@dataclass(frozen=True)
class Sole:
    """How a foot rolls on a floor: its frame when the foot, pitched, stands on its lowest point."""

    pitch: Array  # (a,) toes down positive
    height: Array  # (a,) of the foot's frame over the floor
    rolled: Array  # (a,) forward from flat: rolling without slip moves it by dx = h dθ
    front: float  # x of the end of the flat part where the weight may stand, in the foot's frame
    rear: float  # likewise

    def stand(self, pitch: ArrayLike) -> tuple[Array, Array]:
        """(forward, height) of the foot's frame at ``pitch``."""
        at = np.asarray(pitch, dtype=float)
        return np.interp(at, self.pitch, self.rolled), np.interp(at, self.pitch, self.height)


@dataclass(frozen=True)
class Foot:
    """A foot: its frame, the shapes that touch the floor, its toes and the leg above it."""

    frame: str  # on the sole under the ankle, x to the toes, z up
    parts: tuple[tuple[int, tuple[int, ...]], ...]  # body and collision geoms of foot and toes
    toes: tuple[int, int] | None  # index in q and in dq of their hinge, if there is one
    sole: Sole  # how it rolls
    thigh: float  # m
    shank: float  # m
    ankle: Array  # (3,) seen from the frame
    hip: Array  # (3,) seen from the frame ``pelvis``


@dataclass(frozen=True, eq=False)
class Figure:
    """What a figure is.  Made by ``load_figure``; never changes."""

    robot: Robot  # all joints active
    hands: Mapping[str, str]  # frame of each by side; empty for a figure without arms
    feet: Mapping[str, Foot]  # by side, left and right
    gaze: str | None  # frame whose x axis looks
    neck: tuple[str, ...]  # joints that may serve it
    pelvis: str  # frame
    trunk: str  # frame
    home: Array  # (nq,) standing at ease
    bent: Array  # (nq,) deeply bent
    speeds: Mapping[str, Array]  # (nv,) joint speed limits, rad/s, by name of the set
    apart: float  # half the distance of the feet at home
    masses: Array = field(repr=False)  # (n + 1, 4) of ``goals.mass_table``
    inertia: Array = field(repr=False)
    data: mujoco.MjData = field(repr=False)
    # Of ``once_each``; tables that solves fill in, too: one thread uses a figure at a time.
    memory: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model."""
        return self.robot.model

    @property
    def mass(self) -> float:
        """Of the whole body, kg."""
        return float(self.masses[:, 0].sum())

    def addresses(self, name: str) -> tuple[int, int]:
        """Addresses of a hinge or slide in q and in dq."""
        node = self.robot.joints.index(name)
        return int(self.robot.tree.qadr[node]), int(self.robot.tree.vadr[node])

    def posture(self, angles: Mapping[str, float | Array], base: Array | None = None) -> Array:
        """``base`` (nq,) or (n, nq), by default home, with some joints elsewhere: numbers, or (n,) each.

        Joints that the model does not have are left out: a figure without clavicles reaches without them.
        """
        q = (self.home if base is None else base).copy()
        for name, value in angles.items():
            if name in self.robot.joints:
                q[..., self.addresses(name)[0]] = value
        return q

    def stiffnesses(self, rows: Mapping[str, float]) -> Array:
        """(nv,) posture weights by patterns of joint names; a later pattern wins; the base has none."""
        return _stiffnesses(self, tuple(rows.items()))

    def at(self, q: Array) -> mujoco.MjData:
        """MuJoCo's data with all bodies where they are at ``q`` (nq,); good until the next call."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        return self.data

    def pose(self, q: Array, frame: str) -> tuple[Array, Array]:
        """(3,) position and (3, 3) rotation of a frame, by MuJoCo."""
        positions, matrices = self.poses(q[None], frame)
        return positions[0], matrices[0]

    def poses(self, q: Array, frame: str) -> tuple[Array, Array]:
        """(n, 3) positions and (n, 3, 3) rotations of a frame in frames (n, nq)."""
        at = self.robot.frame(frame)
        position, matrix = np.empty((len(q), 3)), np.empty((len(q), 9))
        for i, row in enumerate(q):
            data = self.at(row)
            position[i], matrix[i] = data.xpos[at.body], data.xmat[at.body]
        matrices = matrix.reshape(-1, 3, 3)
        return position + matrices @ at.local.position, matrices @ at.local.rotation

    def feet_at(self, q: Array) -> dict[str, tuple[Array, Array]]:
        """(3,) position and (3, 3) rotation of the feet at ``q`` (nq,), by side."""
        return {side: self.pose(q, foot.frame) for side, foot in self.feet.items()}

    @cached_property
    def feet_at_home(self) -> dict[str, tuple[Array, Array]]:
        """As ``feet_at``."""
        return self.feet_at(self.home)

    @cached_property
    def hands_at_home(self) -> dict[str, Array]:
        """(3,) positions of the hands at home."""
        return {side: self.pose(self.home, frame)[0] for side, frame in self.hands.items()}

    @cached_property
    def center_at_home(self) -> Array:
        """(3,) centre of mass at home."""
        return self.center(self.home)

    def center(self, q: Array) -> Array:
        """(3,) centre of mass, by MuJoCo."""
        mujoco.mj_comPos(self.model, self.at(q))
        return np.array(self.data.subtree_com[0])

    def placed(self, q: Array, x: float, y: float, heading: float) -> Array:
        """``q`` (nq,) moved as a whole: rotated about the world's origin by ``heading``, then shifted."""
        moved = q.copy()
        Displacement(x, y, heading).move(moved[:7])
        return moved

    def stance(self, q: Array) -> Array:
        """(3,) x, y and heading of the middle between the feet."""
        poses = list(self.feet_at(q).values())
        middle = (poses[0][0] + poses[1][0]) / 2
        forward = poses[0][1][:, 0] + poses[1][1][:, 0]
        return np.array([middle[0], middle[1], np.arctan2(forward[1], forward[0])])


def load_figure(name: str | os.PathLike[str] | Robot = "humanoid") -> Figure:
    """A figure by catalogue name, by path, or of a robot.

    Raises:
        ModelError: It names no two feet, has no floating base, or joints other than hinges and slides.
        UnknownRobotError, UnknownFrameError, UnknownJointError: With the close names.
    """
    robot = name if isinstance(name, Robot) else load_robot(name)
    parts = figure_parts(robot)
    if parts is None or set(parts.feet) != set(SIDES):
        raise ModelError(
            f"{robot.name!r} is no figure: its robot.toml names no left and right foot",
            path=robot.path, hint='add [figure] with feet = { left = "…", right = "…" }, pelvis and trunk',
        )  # fmt: skip
    kinds = robot.tree.kind
    if robot.nq != robot.model.nq or kinds[0] != FREE or not np.isin(kinds[1:], (HINGE, SLIDE)).all():
        raise ModelError(
            f"{robot.name!r} cannot move as a figure: it needs a free base and hinges that all move",
            path=robot.path, hint="load it without `joints=`; split ball joints into hinges",
        )  # fmt: skip
    feet = {side: _foot(robot, parts.feet[side], parts.pelvis) for side in SIDES}
    bent = robot.model.key(parts.bend).qpos.copy() if parts.bend else robot.home.copy()
    left, right = (float(robot.forward(robot.home, parts.feet[side]).position[1]) for side in SIDES)
    return Figure(
        robot=robot,
        hands={side: parts.hands[side] for side in SIDES if side in parts.hands},
        feet=feet,
        gaze=parts.gaze,
        neck=parts.neck,
        pelvis=parts.pelvis,
        trunk=parts.trunk,
        home=robot.home.copy(),
        bent=bent,
        speeds={"daily": np.full(robot.nv, np.inf)}
        | {key: _by_pattern(robot, rows, np.inf) for key, rows in robot.file.speeds.items()},
        apart=abs(left - right) / 2,
        masses=mass_table(robot),
        inertia=_inertia_table(robot),
        data=mujoco.MjData(robot.model),
    )  # fmt: skip


@once_each
def _stiffnesses(figure: Figure, rows: tuple[tuple[str, float], ...]) -> Array:
    return _by_pattern(figure.robot, dict(rows), 0.0)


def _by_pattern(robot: Robot, rows: Mapping[str, float], free: float) -> Array:
    """(nv,) values of joints by patterns of their names, a later pattern wins; ``free`` for the base."""
    found = np.full(robot.nv, free)
    for node, name in enumerate(robot.joints):
        if robot.tree.kind[node] != FREE:
            for pattern, value in rows.items():
                if fnmatch(name, pattern):
                    found[robot.tree.vadr[node]] = value
    return found


def _inertia_table(robot: Robot) -> Array:
    """Return the inertia (n, 9) of each node about its centre of mass, in its axes, row by row."""
    model, mass = robot.model, mass_table(robot)[: robot.tree.size]
    whole = np.zeros((robot.tree.size, 3, 3))
    for body in range(1, model.nbody):
        node, local = robot.attachment(body)
        if node < 0:
            continue
        rotation = local[3:].reshape(3, 3)
        away = local[:3] + rotation @ model.body_ipos[body] - mass[node, 1:]
        axes = rotation @ quat_to_matrix(model.body_iquat[body])
        inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
        whole[node] += inertia + model.body_mass[body] * (away @ away * np.eye(3) - np.outer(away, away))
    return whole.reshape(-1, 9)


def _foot(robot: Robot, frame: str, pelvis: str) -> Foot:
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_forward(model, data)
    body = robot.frame(frame).body
    below = [b for b in range(model.nbody) if model.body_parentid[b] == body and model.body_jntnum[b] == 1]
    parts = tuple(
        (b, tuple(g for g in range(model.ngeom) if model.geom_bodyid[g] == b and model.geom_contype[g]))
        for b in (body, *below[:1])
    )
    if not parts[0][1]:
        raise ModelError(f"the foot {frame!r} has no collision shape", path=robot.path)
    toes = None
    if below:
        joint = int(model.body_jntadr[below[0]])
        toes = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    position, matrix = np.array(robot.frame(frame).local.position), robot.frame(frame).local.rotation
    leg = rotation_points(model, data, body, robot.frame(pelvis).body)
    if len(leg) != 3:
        raise ModelError(
            f"the leg of {frame!r} rotates about {len(leg)} points, not about hip, knee and ankle"
        )
    ankle, knee, hip = leg
    foot_at = data.xpos[body] + data.xmat[body].reshape(3, 3) @ position
    at = robot.measure(model.qpos0, pelvis).position
    return Foot(
        frame, parts, toes, _sole(model, parts[0][1], position, np.asarray(matrix)),
        float(np.linalg.norm(hip - knee)), float(np.linalg.norm(knee - ankle)), ankle - foot_at, hip - at,
    )  # fmt: skip


def rotation_points(model: mujoco.MjModel, data: mujoco.MjData, body: int, top: int) -> list[Array]:
    """The points (3,), world, about which the joints of a limb rotate, from its last body up to ``top``."""
    found: list[Array] = []
    for part in chain(model, body, top):
        first = int(model.body_jntadr[part])
        for anchor in data.xanchor[first : first + int(model.body_jntnum[part])]:
            if not any(np.linalg.norm(anchor - other) < 1e-3 for other in found):
                found.append(anchor.copy())
    return found


def chain(model: mujoco.MjModel, body: int, top: int) -> list[int]:
    """A body and those above it, below ``top``."""
    found = []
    while body not in (0, top):
        found.append(body)
        body = int(model.body_parentid[body])
    return found


def _sole(model: mujoco.MjModel, geoms: tuple[int, ...], position: Array, matrix: Array) -> Sole:
    """``position`` and ``matrix``: the foot's frame in its body."""
    up = np.column_stack([-np.sin(_PITCHES), 0.0 * _PITCHES, np.cos(_PITCHES)]) @ matrix.T
    lowest, points = lowest_points(model, list(geoms), up)
    height = up @ position - lowest.min(axis=1)
    steps = (height[1:] + height[:-1]) / 2 * np.diff(_PITCHES)
    rolled = np.concatenate([[0.0], np.cumsum(steps)])
    flat = int(np.abs(_PITCHES).argmin())
    # Where the sole ends: the lowest points just before and behind flat.
    ends = [float(((points[i, lowest[i].argmin()] - position) @ matrix)[0]) for i in (flat - 8, flat + 8)]
    return Sole(_PITCHES, height, rolled - rolled[flat], front=ends[1], rear=ends[0])
