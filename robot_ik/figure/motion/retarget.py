"""Retargeting: motion capture for a figure of other proportions, by inverse kinematics.

Joint angles are not copied. Lengths are scaled by the two skeletons: the path of the root and the
steps with the legs, the trunk with the trunk, the arms with the arms. The lowest ankle of the
motion stands on the floor. Feet are hard goals, pinned while they rest in the motion. Hands,
elbows, pelvis and head are soft goals. Rotations are relative to the rest pose, in which the figure
stands upright with its toes forward.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray
from pydantic import field_validator

from robot_ik.budget import Budget
from robot_ik.config import KeyProblem, SchemaVersion, Several, Table, read_table
from robot_ik.errors import ConfigError, ModelError, TrajectoryError
from robot_ik.figure.motion.bvh import Bvh, data_at_rest
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, OrientationGoal, PoseGoal, PositionGoal, PostureGoal, Tolerance
from robot_ik.inverse_kinematics import solve
from robot_ik.model import qpos_addresses
from robot_ik.motion.keyframes import Keyframes, free_base
from robot_ik.ports import Array
from robot_ik.robot import Robot

SIDES = ("left", "right")
PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
ROLES = ("pelvis", "head", *(f"{side}_{part}" for side in SIDES for part in PARTS))
# Largest height of the ankle of a resting foot above its height in the stand, m.
_REST_HEIGHT = 0.03
# Largest speed of the ankle of a resting foot, m/s.
_REST_SPEED = 0.20
# Shortest rest of a foot, s.
_REST_TIME = 0.10
# Duration of the transition to and from the pinned pose of a foot, s.
_PIN_BLEND = 0.12
# Share of the frames whose lowest ankle may lie below the floor, because of noise.
_FLOOR_SHARE = 0.02
# Weights of the soft goals.
_HAND = 3.0
_PELVIS = 2.0
_ELBOW = 0.5
_HEAD = 0.5
_POSTURE = 0.05
_FOOT_TOLERANCE = Tolerance(position=1e-4, angle=1e-3)
_BUDGET = Budget(iterations=60, restarts=0)
# The first frame may be far from home.
_FIRST_BUDGET = Budget(iterations=2000)


class _Role(Table):
    body: str
    names: Several[str]


class _MapFile(Table):
    version: SchemaVersion
    roles: dict[Literal[ROLES], _Role]  # type: ignore[valid-type]

    @field_validator("roles")
    @classmethod
    def _all(cls, roles: dict[str, _Role]) -> dict[str, _Role]:
        for role in ROLES:
            if role not in roles:
                raise KeyProblem("this key is missing", role, "body, names")
        return roles


@dataclass(frozen=True)
class SkeletonMap:
    """The joint of a file for each part of a figure.

    Attributes:
        roles: For each of ``ROLES`` the body of the figure, and the names of the joint in files,
            the likeliest first.
        file: The file of the map.
    """

    roles: Mapping[str, _Role]
    file: Path

    @classmethod
    def load(cls, path: Path | str) -> SkeletonMap:
        """Read a map, such as ``bvh.toml`` beside the humanoid.

        Raises:
            ConfigError: The file is missing or a key is wrong. The error names what is allowed.
        """
        file = Path(path)
        return cls(read_table(_MapFile, file, "the map of joints").roles, file)

    @classmethod
    def of(cls, robot: Robot) -> SkeletonMap:
        """Return the map beside the model of a robot.

        Raises:
            ModelError: The folder of the model has no map.
        """
        file = robot.folder / "bvh.toml"
        if not file.is_file():
            raise ModelError(
                f"{robot.name!r} has no map of joints for motion capture",
                path=robot.path,
                hint=f"write {file.name} beside its model, as models/humanoid/bvh.toml",
            )
        return cls.load(file)

    def find(self, bvh: Bvh) -> dict[str, int]:
        """Return the joint index of a file for each role.

        Raises:
            ConfigError: The file has no joint with one of the names of a role.
        """
        joints = {}
        for role in ROLES:
            indices = [index for index in map(bvh.named, self.roles[role].names) if index >= 0]
            if not indices:
                known = ", ".join(joint.name for joint in bvh.joints[:30])
                raise ConfigError(
                    f"no name of {role} is in the BVH file",
                    file=self.file,
                    key=f"roles.{role}.names",
                    allowed=f"one of {known}",
                )
            joints[role] = indices[0]
        return joints


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A retargeted motion and its quality.

    Attributes:
        motion: Motion of the figure.
        hand_error: (n, 2) distance of the left and right hand from their targets, m.
        rests: (n, 2) whether the left and right foot is pinned.
        scale: Metres of the figure for a unit of the file, by the legs.
    """

    motion: Keyframes
    hand_error: Array = field(repr=False)
    rests: NDArray[np.bool_] = field(repr=False)
    scale: float


class _Measures:
    """Lengths and frames of the figure, which stands upright at qpos0."""

    def __init__(self, robot: Robot, bodies: Mapping[str, str]) -> None:
        data = data_at_rest(robot.model)
        names = {robot.model.body(b).name: b for b in range(robot.model.nbody)}
        for role, body in bodies.items():
            if body not in names:
                raise ModelError(f"{robot.name!r} has no body {body!r} for {role}", path=robot.path)
        self.frames = bodies
        self.positions = {role: np.array(data.xpos[names[body]]) for role, body in bodies.items()}
        rest = robot.model.qpos0[qpos_addresses(robot.model, robot.tree)]
        # The frame of a goal may be a site with the name of the body: the palm, the sole.
        self.offsets = {
            role: robot.measure(rest, body).position - self.positions[role]
            for role, body in bodies.items()
        }
        self.soles = {side: self._sole(robot, data, f"{side}_ankle") for side in SIDES}
        feet = [robot.measure(rest, bodies[f"{side}_ankle"]).position for side in SIDES]
        lowest = min(float(position[2]) for position in feet)
        self.ankle = float(_middle(self.positions, "ankle")[2] - lowest)

    def _sole(self, robot: Robot, data: mujoco.MjData, role: str) -> Array:
        """Return the points (n, 3) that may touch the floor, from the foot frame.

        They are the origin of the frame and the sites of the foot and of the bodies below it.
        """
        model = robot.model
        foot = model.body(self.frames[role]).id
        below = [foot]
        for body in range(foot + 1, model.nbody):
            if int(model.body_parentid[body]) in below:
                below.append(body)
        origin = self.positions[role] + self.offsets[role]
        return np.vstack([np.zeros(3), data.site_xpos[np.isin(model.site_bodyid, below)] - origin])


def _length(positions: Mapping[str, Array], *roles: str) -> float:
    """Return the length along these parts of a limb, as the mean of both sides."""
    limbs = [[positions[f"{side}_{role}"] for role in roles] for side in SIDES]
    return float(np.linalg.norm(np.diff(limbs, axis=1), axis=2).sum()) / len(SIDES)


def _middle(positions: Mapping[str, Array], role: str) -> Array:
    return np.asarray(0.5 * (positions[f"left_{role}"] + positions[f"right_{role}"]))


def _lengths(positions: Mapping[str, Array]) -> Array:
    """Return the lengths (4,) of a leg, an arm, the trunk, and from shoulder to shoulder."""
    trunk = np.linalg.norm(_middle(positions, "shoulder") - _middle(positions, "hip"))
    girdle = np.linalg.norm(positions["left_shoulder"] - positions["right_shoulder"])
    legs = _length(positions, "hip", "knee", "ankle")
    arms = _length(positions, "shoulder", "elbow", "wrist")
    return np.array([legs, arms, trunk, girdle])


def _ratios(
    figure_positions: Mapping[str, Array], file_positions: Mapping[str, Array]
) -> list[float]:
    """Return the metres of the figure for a unit of the file, by leg, arm, trunk and girdle.

    Raises:
        TrajectoryError: A part has no length in the file.
    """
    lengths = _lengths(file_positions)
    for length, part in zip(lengths, ("legs", "arms", "trunk", "girdle"), strict=True):
        if not length > 1e-9:
            raise TrajectoryError(
                f"the {part} of the file's rest pose have no length",
                hint="use a joint for one role only in the map of joints",
            )
    return [float(ratio) for ratio in _lengths(figure_positions) / lengths]


def _alignment(rest: Mapping[str, Array], up: str) -> Array:
    """Return the rotation (3, 3) from the file's axes to the figure's, whose y is hip to hip."""
    z = np.eye(3)["xyz".index(up)]
    left = rest["left_hip"] - rest["right_hip"]
    left = left - z * float(left @ z)
    if not np.linalg.norm(left) > 1e-9:
        problem = "in the file's rest pose the hips are not beside each other"
        raise TrajectoryError(problem, hint="choose another rest_frame")
    y = left / np.linalg.norm(left)
    return np.stack([np.cross(y, z), y, z])


def _targets(
    bvh: Bvh, joints: Mapping[str, int], measures: _Measures, rest: Bvh, up: str
) -> tuple[dict[str, Any], NDArray[np.bool_], float]:
    """Return the path of each role, when the feet rest (n, 2), and the scale of the legs.

    A path has a pose for each frame for pelvis, head and ankles (the soles), and a position (3,)
    for wrists and elbows, in the world.
    """
    still, rest_rotations = rest.poses()
    upright = {role: still[0, j] for role, j in joints.items()}
    axes = _alignment(upright, up)
    moved, rotations = bvh.poses()
    positions = {role: moved[:, j] @ axes.T for role, j in joints.items()}
    deltas = {
        role: axes @ rotations[:, j] @ rest_rotations[0, j].T @ axes.T for role, j in joints.items()
    }
    legs, arms, trunk, girdle = _ratios(measures.positions, upright)
    lowest = np.minimum(positions["left_ankle"][:, 2], positions["right_ankle"][:, 2])
    floor = np.array([0.0, 0.0, np.quantile(lowest, _FLOOR_SHARE) - measures.ankle / legs])
    hips = _middle(positions, "hip")
    chest = _middle(positions, "shoulder")
    pelvis = legs * (hips - floor)
    paths: dict[str, Any] = {
        "pelvis": list(map(Pose.from_rotation, deltas["pelvis"], pelvis)),
        "head": list(map(Pose.from_rotation, deltas["head"])),
    }
    rests = []
    for side in SIDES:
        shoulder = positions[f"{side}_shoulder"]
        scaled_shoulder = pelvis + trunk * (chest - hips) + girdle * (shoulder - chest)
        from_shoulder = scaled_shoulder - arms * shoulder
        paths[f"{side}_elbow"] = from_shoulder + arms * positions[f"{side}_elbow"]
        palm = float(np.linalg.norm(measures.offsets[f"{side}_wrist"]))
        along = _hand_direction(bvh, joints, side, moved, rotations) @ axes.T
        paths[f"{side}_wrist"] = from_shoulder + arms * positions[f"{side}_wrist"] + palm * along
        ankle = legs * (positions[f"{side}_ankle"] - floor)
        rests.append(_rests(ankle, measures.ankle, bvh.rate))
        path = _foot_path(ankle, deltas[f"{side}_ankle"], measures, side, rests[-1], bvh.rate)
        paths[f"{side}_ankle"] = path
    return paths, np.stack(rests, axis=1), legs


def _hand_direction(
    bvh: Bvh, joints: Mapping[str, int], side: str, positions: Array, rotations: Array
) -> Array:
    """Return unit vectors (n, 3) along the hand, to its first child or End Site, in file axes."""
    j = joints[f"{side}_wrist"]
    bone = next((np.array(other.offset) for other in bvh.joints if other.parent == j), None)
    bone = np.array(bvh.joints[j].end) if bone is None and bvh.joints[j].end is not None else bone
    along = rotations[:, j] @ (np.zeros(3) if bone is None else bone)
    if not np.linalg.norm(along, axis=1).min() > 1e-9:  # a hand of no length points as the forearm
        along = positions[:, j] - positions[:, joints[f"{side}_elbow"]]
    return np.asarray(along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12))


def _rests(ankle: Array, height: float, rate: float) -> NDArray[np.bool_]:
    """Return (n,) whether a foot rests: it is low and slow for long enough."""
    speed = np.zeros(len(ankle))
    if len(ankle) > 2:
        speed = np.linalg.norm(np.gradient(ankle, 1.0 / rate, axis=0), axis=1)
    calm = (ankle[:, 2] < height + _REST_HEIGHT) & (speed < _REST_SPEED)
    shortest = max(1, round(_REST_TIME * rate))
    out = np.zeros(len(calm), dtype=bool)
    for first, end in _runs(calm):
        out[first:end] = end - first >= min(shortest, len(calm))
    return out


def _runs(marks: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first index of each run of marks, and the index after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marks, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _foot_path(
    ankle: Array,
    rotations: Array,
    measures: _Measures,
    side: str,
    rests: NDArray[np.bool_],
    rate: float,
) -> list[Pose]:
    """Return the pose of the sole in each frame.

    A resting sole has one pose, flat on the floor. The transition to and from that pose is smooth.
    No point of the sole goes below the floor.
    """
    positions = ankle + rotations @ measures.offsets[f"{side}_ankle"]
    sole = positions[:, None, :] + measures.soles[side] @ rotations.transpose(0, 2, 1)
    lowest = sole[..., 2].min(axis=1)
    positions[:, 2] -= np.minimum(lowest, 0.0)
    path = list(map(Pose.from_rotation, rotations, positions))
    fade = max(1, round(_PIN_BLEND * rate))
    for first, end in _runs(rests):
        heading = math.atan2(*rotations[first:end, 1::-1, 0].mean(axis=0).tolist())
        half = 0.5 * heading
        position = positions[first:end].mean(axis=0)
        pin = Pose((position[0], position[1], 0.0), (math.cos(half), 0.0, 0.0, math.sin(half)))
        path[first:end] = [pin] * (end - first)
        for step in range(1, fade):
            share = 1.0 - step / fade
            share = share * share * (3.0 - 2.0 * share)
            for k in (first - step, end - 1 + step):
                if 0 <= k < len(path) and not rests[k]:
                    path[k] = path[k] @ Pose().plus(share * (path[k].inverse() @ pin).minus(Pose()))
    return path


def retarget(
    bvh: Bvh,
    robot: Robot,
    joints: SkeletonMap | None = None,
    *,
    rate: float | None = None,
    up: Literal["y", "z"] = "y",
    rest_frame: int | None = None,
) -> Retargeted:
    """Return a motion of another skeleton as a motion of a figure.

    Args:
        bvh: Motion of a skeleton with the roles of the map.
        robot: A figure with hands, feet and head.
        joints: Map of the joints; None for the map beside the robot's model.
        rate: Largest number of frames a second; None for the rate of the file. Frames are skipped,
            never interpolated.
        up: Axis of the file that points up.
        rest_frame: Index of a frame in which the figure stands upright with its toes forward, for
            files whose rest pose does not.

    Raises:
        ConfigError: The file lacks a joint of the map.
        TrajectoryError: The file has no frames, or no frame ``rest_frame``.
    """
    joints = SkeletonMap.of(robot) if joints is None else joints
    indices = joints.find(bvh)
    bodies = {role: row.body for role, row in joints.roles.items()}
    if not len(bvh.values):
        raise TrajectoryError("the BVH file has no frames")
    if rest_frame is not None and not 0 <= rest_frame < len(bvh.values):
        raise TrajectoryError(f"there is no frame {rest_frame}", hint=f"0 … {len(bvh.values) - 1}")
    rest = bvh.rest() if rest_frame is None else replace(bvh, values=bvh.values[[rest_frame]])
    every = 1 if rate is None else max(1, int(bvh.rate / rate + 1e-6))
    bvh = replace(bvh, frame_time=every / bvh.rate, values=bvh.values[::every])
    measures = _Measures(robot, bodies)
    paths, rests, scale = _targets(bvh, indices, measures, rest, up)
    rows, error = _solve_frames(robot, bodies, paths)
    motion = Keyframes(robot, np.arange(len(rows)) / bvh.rate, rows)
    return Retargeted(motion, error, rests, scale)


def _goals(bodies: Mapping[str, str], paths: Mapping[str, Any], k: int, q: Array) -> list[Goal]:
    """Return the goals of frame ``k``."""
    feet = [(bodies[f"{side}_ankle"], paths[f"{side}_ankle"][k]) for side in SIDES]
    goals: list[Goal] = [replace(PoseGoal.at(*foot), tolerance=_FOOT_TOLERANCE) for foot in feet]
    hips = paths["pelvis"][k]
    pelvis = PoseGoal(
        bodies["pelvis"],
        hips.position,
        hips.wxyz,
        soft=True,
        position_weight=_PELVIS,
        angle_weight=_PELVIS / 4,
    )
    goals.append(pelvis)
    goals.append(OrientationGoal(bodies["head"], paths["head"][k].wxyz, weight=_HEAD, soft=True))
    for part, weight in (("wrist", _HAND), ("elbow", _ELBOW)):
        for role in (f"{side}_{part}" for side in SIDES):
            goals.append(PositionGoal(bodies[role], paths[role][k], weight=weight, soft=True))
    return [*goals, PostureGoal(q, weight=_POSTURE, soft=True)]


def _solve_frames(
    robot: Robot, bodies: Mapping[str, str], paths: Mapping[str, Any]
) -> tuple[list[Array], Array]:
    """Return joint vectors (n, nq) and the position errors of the hands (n, 2), m."""
    rows: list[Array] = []
    q = np.array(robot.home)
    error = np.zeros((len(paths["pelvis"]), 2))
    base = free_base(robot)
    if base is not None:
        q[base][:3] += paths["pelvis"][0].position - robot.forward(q, bodies["pelvis"]).position
    for k in range(len(error)):
        goals = _goals(bodies, paths, k, robot.home)
        q = solve(robot, goals, solver="lm", start=q, budget=_BUDGET if k else _FIRST_BUDGET).q
        rows.append(q)
        for i, role in enumerate(f"{side}_wrist" for side in SIDES):
            error[k, i] = np.linalg.norm(robot.forward(q, bodies[role]).position - paths[role][k])
    return rows, error
