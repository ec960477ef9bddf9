"""``Figure``: a model with two feet that can stand, walk, reach and jump.

The figure is read from the model and from the table ``[figure]`` of its ``robot.toml``. Every model
whose table names two feet can walk. Angles are in rad and lengths in m. World axes have z up, and
the floor is z = 0.
"""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import cached_property
from typing import Any, Concatenate, ParamSpec, TypeVar

import mujoco
import numpy as np

from robot_ik.errors import ModelError
from robot_ik.figure.parts import figure_parts
from robot_ik.figure.soles import Sole, rolling_sole
from robot_ik.geometry import axis_rotations, quat_to_matrix
from robot_ik.goals import mass_table
from robot_ik.kernels.tree import FREE, HINGE, SLIDE
from robot_ik.motion.keyframes import Displacement
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

SIDES = ("left", "right")

GRAVITY = 9.81
"""m/s²."""

RATE = 60.0
"""Frames per second."""

DT = 1.0 / RATE
"""Time between two frames, s."""

_SAME_POINT = 1e-3
"""Joints whose anchors are nearer than this rotate about one point, m."""

_Value = TypeVar("_Value")
_Arguments = ParamSpec("_Arguments")


def cached_per_figure(
    compute: Callable[Concatenate[Figure, _Arguments], _Value],
) -> Callable[Concatenate[Figure, _Arguments], _Value]:
    """Cache the results of a function in the figure. Its arguments are the figure and hashables."""

    @functools.wraps(compute)
    def cached(figure: Figure, /, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Value:
        key = (compute, *args, *kwargs.items())
        if key not in figure.cache:
            figure.cache[key] = compute(figure, *args, **kwargs)
        value: _Value = figure.cache[key]
        return value

    return cached


def in_stance_frame(stance: Array, point: Array) -> Array:
    """Return a world point (3,) in the frame of a stance (x, y, heading)."""
    return np.asarray(axis_rotations("z", -stance[2]) @ (point - [stance[0], stance[1], 0.0]))


@dataclass(frozen=True)
class Foot:
    """A foot: its frame, the shapes that touch the floor, its toes and the leg above it.

    Attributes:
        frame: Frame on the sole below the ankle, x to the toes and z up.
        parts: Body and collision geoms of the foot and of its toes.
        toes: Index of the toes' hinge in q and in dq. None for a foot without toes.
        sole: How the foot rolls.
        thigh: Length of the thigh, m.
        shank: Length of the shank, m.
        ankle: (3,) the ankle in the foot's frame, m.
        hip: (3,) the hip in the frame of the pelvis, m.
    """

    frame: str
    parts: tuple[tuple[int, tuple[int, ...]], ...]
    toes: tuple[int, int] | None
    sole: Sole
    thigh: float
    shank: float
    ankle: Array
    hip: Array


@dataclass(frozen=True, eq=False)
class Figure:
    """A model with the frames of a figure. ``load_figure`` makes it.

    The description never changes. ``data`` and ``cache`` are memory of calculations, so only one
    thread may use a figure. ``duplicate`` returns a copy for another thread.

    Attributes:
        robot: The robot. All its joints are active.
        hands: Frame of each hand by side. Empty for a figure without arms.
        feet: Feet by side, left and right.
        gaze: Frame whose x axis is the direction of the gaze, or None.
        neck: Joints that may turn the gaze.
        pelvis: Frame of the pelvis.
        trunk: Frame of the trunk.
        home: (nq,) relaxed standing pose.
        bent: (nq,) deeply bent.
        speeds: (nv,) joint speed limits, rad/s, by name of the set.
        half_width: Half the distance of the feet at home, m.
        masses: (n + 1, 4) masses and centres of ``goals.mass_table``.
        inertia: (n, 9) inertia of the nodes.
        free_model: The model without contacts and joint limits, for inverse dynamics.
        data: MuJoCo's data.
        cache: Results of functions with ``cached_per_figure``.
    """

    robot: Robot
    hands: Mapping[str, str]
    feet: Mapping[str, Foot]
    gaze: str | None
    neck: tuple[str, ...]
    pelvis: str
    trunk: str
    home: Array
    bent: Array
    speeds: Mapping[str, Array]
    half_width: float
    masses: Array = field(repr=False)
    inertia: Array = field(repr=False)
    free_model: mujoco.MjModel = field(repr=False)
    data: mujoco.MjData = field(repr=False)
    cache: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model."""
        return self.robot.model

    @property
    def mass(self) -> float:
        """Mass of the whole body, kg."""
        return float(self.masses[:, 0].sum())

    def duplicate(self) -> Figure:
        """Return the same figure with its own data and cache, for another thread."""
        return replace(self, data=mujoco.MjData(self.model))

    def addresses(self, name: str) -> tuple[int, int]:
        """Return the addresses of a hinge or slide in q and in dq."""
        node = self.robot.joints.index(name)
        return int(self.robot.tree.qadr[node]), int(self.robot.tree.vadr[node])

    def posture(self, angles: Mapping[str, float | Array], base: Array | None = None) -> Array:
        """Return a posture with some joints at other values.

        Joints that the model does not have are ignored, so a figure without clavicles can reach.

        Args:
            angles: Values of joints by name: a number, or (n,) numbers for n frames.
            base: (nq,) or (n, nq) values of the other joints. Default: home.
        """
        q = (self.home if base is None else base).copy()
        for name, value in angles.items():
            if name in self.robot.joints:
                q[..., self.addresses(name)[0]] = value
        return q

    def stiffnesses(self, rows: Mapping[str, float]) -> Array:
        """Return posture weights (nv,) by patterns of joint names.

        A later pattern replaces an earlier one. The weight of the free base is zero.
        """
        return _stiffnesses(self, tuple(rows.items()))

    def data_at(self, q: Array) -> mujoco.MjData:
        """Return MuJoCo's data with the bodies at ``q`` (nq,), valid until the next call."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        return self.data

    def pose(self, q: Array, frame: str) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of a frame at ``q`` (nq,), by MuJoCo."""
        positions, rotations = self.poses(q[None], frame)
        return positions[0], rotations[0]

    def poses(self, q: Array, frame: str) -> tuple[Array, Array]:
        """Return positions (n, 3) and rotations (n, 3, 3) of a frame at ``q`` (n, nq)."""
        attached = self.robot.frame(frame)
        positions = np.empty((len(q), 3))
        matrices = np.empty((len(q), 9))
        for i, row in enumerate(q):
            data = self.data_at(row)
            positions[i] = data.xpos[attached.body]
            matrices[i] = data.xmat[attached.body]
        rotations = matrices.reshape(-1, 3, 3)
        local = attached.local
        return positions + rotations @ local.position, rotations @ local.rotation

    def feet_at(self, q: Array) -> dict[str, tuple[Array, Array]]:
        """Return position (3,) and rotation (3, 3) of each foot at ``q`` (nq,), by side."""
        return {side: self.pose(q, foot.frame) for side, foot in self.feet.items()}

    @cached_property
    def feet_at_home(self) -> dict[str, tuple[Array, Array]]:
        """Poses of the feet at home, as ``feet_at``."""
        return self.feet_at(self.home)

    @cached_property
    def hands_at_home(self) -> dict[str, Array]:
        """Positions (3,) of the hands at home, by side."""
        return {side: self.pose(self.home, frame)[0] for side, frame in self.hands.items()}

    @cached_property
    def center_at_home(self) -> Array:
        """Centre of mass (3,) at home."""
        return self.center(self.home)

    def center(self, q: Array) -> Array:
        """Return the centre of mass (3,) at ``q`` (nq,), by MuJoCo."""
        mujoco.mj_comPos(self.model, self.data_at(q))
        return np.array(self.data.subtree_com[0])

    def centers(self, q: Array) -> Array:
        """Return the centres of mass (n, 3) at ``q`` (n, nq), by MuJoCo."""
        return np.array([self.center(row) for row in q])

    def placed(self, q: Array, x: float, y: float, heading: float) -> Array:
        """Return ``q`` (nq,) after a rotation about the world's z axis and a shift by x and y."""
        moved = q.copy()
        Displacement(x, y, heading).move(moved[:7])
        return moved

    def stance(self, q: Array) -> Array:
        """Return x, y and heading (3,) of the middle between the feet."""
        left, right = self.feet_at(q).values()
        middle = (left[0] + right[0]) / 2
        forward = left[1][:, 0] + right[1][:, 0]
        return np.array([middle[0], middle[1], np.arctan2(forward[1], forward[0])])


def load_figure(name: str | os.PathLike[str] | Robot = "humanoid") -> Figure:
    """Return a figure by the catalogue name or the path of its model, or of a robot.

    Raises:
        ModelError: The model does not have two feet, has no floating base, or has ball joints.
        UnknownRobotError: No robot has that name.
        UnknownFrameError: A frame of the table does not exist.
        UnknownJointError: A joint of the table does not exist.
    """
    robot = name if isinstance(name, Robot) else load_robot(name)
    parts = figure_parts(robot)
    if parts is None or set(parts.feet) != set(SIDES):
        raise ModelError(
            f"{robot.name!r} is not a figure: its robot.toml has no left and right foot",
            path=robot.path,
            hint='add [figure] with feet = { left = "…", right = "…" }, pelvis and trunk',
        )
    kinds = robot.tree.kind
    is_complete = robot.nq == robot.model.nq and kinds[0] == FREE
    if not is_complete or not np.isin(kinds[1:], (HINGE, SLIDE)).all():
        raise ModelError(
            f"{robot.name!r} cannot move as a figure: it needs a free base and hinges that all "
            "move",
            path=robot.path,
            hint="load it without `joints=`; split ball joints into hinges",
        )
    left, right = (float(robot.forward(robot.home, parts.feet[side]).position[1]) for side in SIDES)
    speeds = {"daily": np.full(robot.nv, np.inf)}
    for key, rows in robot.file.speeds.items():
        speeds[key] = _values_by_pattern(robot, rows, np.inf)
    return Figure(
        robot=robot,
        hands={side: parts.hands[side] for side in SIDES if side in parts.hands},
        feet={side: _foot(robot, parts.feet[side], parts.pelvis) for side in SIDES},
        gaze=parts.gaze,
        neck=parts.neck,
        pelvis=parts.pelvis,
        trunk=parts.trunk,
        home=robot.home.copy(),
        bent=robot.model.key(parts.bend).qpos.copy() if parts.bend else robot.home.copy(),
        speeds=speeds,
        half_width=abs(left - right) / 2,
        masses=mass_table(robot),
        inertia=_inertia_table(robot),
        free_model=_without_contacts_and_limits(robot.model),
        data=mujoco.MjData(robot.model),
    )


@cached_per_figure
def _stiffnesses(figure: Figure, rows: tuple[tuple[str, float], ...]) -> Array:
    return _values_by_pattern(figure.robot, dict(rows), 0.0)


def _values_by_pattern(robot: Robot, rows: Mapping[str, float], base_value: float) -> Array:
    """Return values (nv,) of joints by patterns of their names. A later pattern overrides."""
    values = np.full(robot.nv, base_value)
    for node, name in enumerate(robot.joints):
        if robot.tree.kind[node] == FREE:
            continue
        for pattern, value in rows.items():
            if fnmatch(name, pattern):
                values[robot.tree.vadr[node]] = value
    return values


def _without_contacts_and_limits(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a model whose inverse dynamics has no contact and no limit forces."""
    free = copy.copy(model)
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    return free


def _inertia_table(robot: Robot) -> Array:
    """Return the inertia (n, 9) of each node about its centre of mass, in its axes, row by row."""
    model = robot.model
    masses = mass_table(robot)[: robot.tree.size]
    total = np.zeros((robot.tree.size, 3, 3))
    for body in range(1, model.nbody):
        node, local = robot.attachment(body)
        if node < 0:
            continue
        rotation = local[3:].reshape(3, 3)
        offset = local[:3] + rotation @ model.body_ipos[body] - masses[node, 1:]
        axes = rotation @ quat_to_matrix(model.body_iquat[body])
        inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
        steiner = offset @ offset * np.eye(3) - np.outer(offset, offset)
        total[node] += inertia + model.body_mass[body] * steiner
    return total.reshape(-1, 9)


def _foot(robot: Robot, frame: str, pelvis: str) -> Foot:
    """Return the foot of a frame.

    Raises:
        ModelError: The foot has no shape, or its leg has no hip, knee and ankle.
    """
    model = robot.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = robot.frame(frame).body
    toe_bodies = [
        child
        for child in range(model.nbody)
        if model.body_parentid[child] == body and model.body_jntnum[child] == 1
    ]
    parts = tuple((part, _collision_geoms(model, part)) for part in (body, *toe_bodies[:1]))
    geoms = parts[0][1]
    if not geoms:
        raise ModelError(f"the foot {frame!r} has no collision shape", path=robot.path)
    toes = None
    if toe_bodies:
        joint = int(model.body_jntadr[toe_bodies[0]])
        toes = (int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]))

    position = np.array(robot.frame(frame).local.position)
    rotation = np.asarray(robot.frame(frame).local.rotation)
    leg = rotation_points(model, data, body, robot.frame(pelvis).body)
    if len(leg) != 3:
        raise ModelError(
            f"the leg of {frame!r} rotates about {len(leg)} points, not about hip, knee and ankle"
        )
    ankle, knee, hip = leg
    foot_position = data.xpos[body] + data.xmat[body].reshape(3, 3) @ position
    pelvis_position = robot.measure(model.qpos0, pelvis).position
    return Foot(
        frame=frame,
        parts=parts,
        toes=toes,
        sole=rolling_sole(model, geoms, position, rotation),
        thigh=float(np.linalg.norm(hip - knee)),
        shank=float(np.linalg.norm(knee - ankle)),
        ankle=ankle - foot_position,
        hip=hip - pelvis_position,
    )


def _collision_geoms(model: mujoco.MjModel, body: int) -> tuple[int, ...]:
    """Return the geoms of a body that collide."""
    return tuple(
        geom
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] == body and model.geom_contype[geom]
    )


def rotation_points(model: mujoco.MjModel, data: mujoco.MjData, body: int, top: int) -> list[Array]:
    """Return the world points (3,) about which the joints of a limb rotate.

    Args:
        model: The model.
        data: Data with the bodies at the pose.
        body: Last body of the limb; its points come first.
        top: Body at which the limb begins; its joints are not included.
    """
    points: list[Array] = []
    for part in bodies_between(model, body, top):
        first = int(model.body_jntadr[part])
        for anchor in data.xanchor[first : first + int(model.body_jntnum[part])]:
            if not any(np.linalg.norm(anchor - point) < _SAME_POINT for point in points):
                points.append(anchor.copy())
    return points


def bodies_between(model: mujoco.MjModel, body: int, top: int) -> list[int]:
    """Return a body and its ancestors below ``top``."""
    bodies = []
    while body not in (0, top):
        bodies.append(body)
        body = int(model.body_parentid[body])
    return bodies
