"""Joint configurations from which a camera learns most about where it is mounted.

Either the arm carries the camera and the board rests, or the camera rests and the arm carries the board
(``Mounting``).  Both poses need to be known roughly only: well enough for the board to be in the picture.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from robot_ik.budget import Budget
from robot_ik.camera.calibration.handeye import LEAST_VIEWS, HandEyeSample, Mount, compress
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.painted import SceneTable
from robot_ik.camera.targets import Observation, Squares, marker_points
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.goals import PoseGoal, Tolerance
from robot_ik.jobs.scene import in_view
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot

# ------------------------------------------------------------------------------------------
# Whether an arm can stand at joint angles, and go straight between them in joint space, without touching.


# Between two checks of a straight joint move no joint turns farther than this, rad.
_STEP = 0.06
# Kept between the arm and the table, metres.
_AIR = 0.01


class Clearance:
    """Contacts of the arm with itself, its surroundings in the model, and a table.

    What touches at ``free`` (nq,), where the arm stands freely (neighbouring links, a base on the table),
    counts as no contact.  Links are boxes to the table: an arm is kept farther away rather than nearer.
    """

    def __init__(self, robot: Robot, free: Array, table: SceneTable | None = None) -> None:
        self._robot, self._table = robot, table
        self._data = mujoco.MjData(robot.model)
        model = robot.model
        moving = model.body_weldid[model.geom_bodyid] > 0
        self._geoms = np.flatnonzero(moving)
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
        box = model.geom_aabb[self._geoms]
        self._corners = box[:, None, :3] + signs * box[:, None, 3:]  # (g, 8, 3) in the geoms' frames
        self._place(free)
        self._allowed, self._on_table = self._touching(), self._at_table()

    def free(self, q: Array) -> bool:
        """Whether the arm touches nothing at ``q`` (nq,)."""
        self._place(q)
        return self._at_table() <= self._on_table and self._touching() <= self._allowed

    def path_is_free(self, start: Array, end: Array) -> bool:
        """Whether it touches nothing on the straight joint move between two configurations."""
        count = max(2, int(np.ceil(np.abs(end - start).max() / _STEP)))
        # From the middle outwards: a way is blocked there first.
        shares = sorted(np.arange(1, count) / count, key=lambda share: abs(share - 0.5))
        return all(self.free(start + share * (end - start)) for share in shares)

    def sees(self, q: Array, eye: Array, points: Array) -> bool:
        """Whether no geom stands between an eye and points (n, 3), world, at ``q``."""
        self._place(q)
        return in_view(self._robot.model, self._data, eye, points, 2e-3)

    def _place(self, q: Array) -> None:
        self._data.qpos[:] = self._robot.qpos(q)
        mujoco.mj_kinematics(self._robot.model, self._data)

    def _touching(self) -> set[tuple[int, int]]:
        mujoco.mj_collision(self._robot.model, self._data)
        pairs = self._data.contact.geom[np.asarray(self._data.contact.dist) < 0.0]
        return {(int(a), int(b)) for a, b in np.sort(pairs, axis=1)}

    def _at_table(self) -> set[int]:
        table = self._table
        if table is None or not len(self._geoms):
            return set()
        rotation = self._data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        corners = self._corners @ rotation.transpose(0, 2, 1) + self._data.geom_xpos[self._geoms][:, None]
        low, high = corners.min(axis=1), corners.max(axis=1)
        over = (
            (high[:, 0] > table.x[0] - _AIR) & (low[:, 0] < table.x[1] + _AIR)
            & (high[:, 1] > table.y[0] - _AIR) & (low[:, 1] < table.y[1] + _AIR)
        )  # fmt: skip
        return {int(g) for g in self._geoms[over & (low[:, 2] < table.height + _AIR)]}


# ------------------------------------------------------------------------------------------
# In which order to visit configurations, so that the way is short and free.


def visiting_order(robot: Robot, start: Array, stations: Sequence[Array], clearance: Clearance) -> list[int]:
    """Indices of stations, ordered by short free ways: the nearest each time, then crossings undone (2-opt).

    Stations that no free way leads to are left out.
    """
    configurations = [start, *stations]
    cost = np.zeros((len(configurations), len(configurations)))
    for i in range(len(configurations)):
        for j in range(i):
            seconds = float(np.max(np.abs(configurations[i] - configurations[j]) / robot.velocity_limits))
            cost[i, j] = cost[j, i] = (
                seconds if clearance.path_is_free(configurations[i], configurations[j]) else np.inf
            )
    order, left = [0], set(range(1, len(configurations)))
    while left:
        nearest = min(left, key=lambda k: cost[order[-1], k])
        if not np.isfinite(cost[order[-1], nearest]):
            break
        order.append(nearest)
        left.remove(nearest)

    def length(stations: Sequence[int]) -> float:
        return float(sum(cost[a, b] for a, b in itertools.pairwise(stations)))

    improved = True
    while improved:
        improved = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                trial = [*order[:i], *order[i : j + 1][::-1], *order[j + 1 :]]
                if length(trial) < length(order) - 1e-9:
                    order, improved = trial, True
    return [k - 1 for k in order[1:]]


# Part of the picture's width and height that is kept free at each side: the guess may be off by so much.
_MARGIN = 0.06
# Least cosine between a marker's face and the view, and least side in the picture, px.
_LEAST_FACING, _LEAST_SIDE = 0.40, 28.0
# Least part of the markers that face the camera which is in the picture.
_LEAST_PART = 0.75
# Wanted tilts and off-centre positions, for which joint angles are sought.
_LARGEST_TILT = np.deg2rad(50.0)
# Random starts in all, and candidates wanted for each view that is chosen.
_TRIES, _POOL = 3000, 5
# How often stations that cannot be got to are replaced.
_REPAIRS = 4
# Where not one of so many shows anything, none will.
_HOPELESS = 300
# How far from home the search goes: shares of the way to a random configuration.
_SHARES = (0.1, 0.7)
# What pixels and arm are taken to be good for while views are chosen: px, metres, rad.
_PIXEL, _ARM_POSITION, _ARM_ANGLE = 0.2, 5e-4, np.deg2rad(0.1)
_NEAR = Tolerance(position=1e-3, angle=5e-3)
_TRY = Budget(iterations=300, restarts=1)


@dataclass(frozen=True, eq=False)
class ViewTask:
    """What shall be looked at: rough poses of camera and board, and the frame that carries one of them.

    ``squares`` has the board's markers, id -> (side, ``pose_board_marker``); the table is not to be touched.
    """

    mount: Mount
    frame: str
    squares: Squares
    intrinsics: CameraIntrinsics
    table: SceneTable | None = None

    def pose_camera_board(self, robot: Robot, q: Array) -> Pose:
        """Where the board is seen at ``q``."""
        return self.mount.pose_camera_board(self.sample(robot, q, np.zeros((4, 3))))

    def sample(self, robot: Robot, q: Array, points: Array) -> HandEyeSample:
        """The arm at ``q``, with a view that is yet to be taken of ``points`` (n, 3) of the board."""
        view = Observation(points, np.zeros((len(points), 2)), Pose(), _PIXEL)
        return HandEyeSample(robot.forward(q, self.frame), view)

    def shown(self, pose_camera_board: Pose) -> tuple[int, ...]:
        """Ids of the markers in the picture, with a margin, large enough and not too flat; nothing hides.

        None where too many of those that face the camera are cut off, as the board may be elsewhere.
        """
        size, facing, found = np.array(self.intrinsics.size), 0, []
        for id, (side, pose) in self.squares.items():
            at = pose_camera_board.compose(pose)
            towards = -float(at.rotation[:, 2] @ at.position) / float(np.linalg.norm(at.position))
            if at.position[2] <= side or towards <= _LEAST_FACING:
                continue
            facing += 1
            pixels = self.intrinsics.project(at.apply(marker_points(side)))
            sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1)
            inside = (pixels > _MARGIN * size).all() and (pixels < (1.0 - _MARGIN) * size).all()
            if inside and sides.min() > _LEAST_SIDE:
                found.append(id)
        return tuple(found) if len(found) >= _LEAST_PART * facing else ()


def plan_views(
    robot: Robot, task: ViewTask, count: int = 15, *, start: Array | None = None, seed: int = 0
) -> list[Array]:
    """Joint configurations (nq,), in the order of a short way from ``start``, the board in view at each.

    Candidates are found by inverse kinematics for random views; those are taken, one after the other, that
    together determine camera and board best (greedy D-optimality of the information matrix; Fedorov, Theory
    of Optimal Experiments, 1972).  All lie inside the limits; neither they nor the straight joint moves
    between them touch anything of the model or the table.  Fewer than ``count`` come back where no more can
    be reached.

    Raises:
        CameraError: Fewer than four can be reached.
    """
    start = robot.home if start is None else robot.check_q(start, "start")
    clearance = Clearance(robot, start, task.table)
    pool = _candidates(robot, task, clearance, start, max(_POOL * count, 4 * LEAST_VIEWS), seed)
    ordered: list[Array] = []
    for _ in range(_REPAIRS):
        chosen = _most_informative([information for _, information in pool], count)
        order = visiting_order(robot, start, [pool[k][0] for k in chosen], clearance)
        ordered = max(ordered, [pool[chosen[k]][0] for k in order], key=len)
        if len(order) == len(chosen):
            break
        # To some no way is free: others take their place.
        lost = {k for index, k in enumerate(chosen) if index not in order}
        pool = [one for k, one in enumerate(pool) if k not in lost]
    if len(ordered) < LEAST_VIEWS:
        who = "camera" if task.mount.mounting == "eye_in_hand" else "board"
        raise CameraError(
            f"only {len(ordered)} views were found in which the board can be seen and the arm, carrying the "
            f"{who}, touches nothing; {LEAST_VIEWS} are the least",
            hint="give better guesses of where camera and board are, move them, or take a larger board",
        )
    return ordered


# ------------------------------------------------------------------------------- candidates


def _candidates(
    robot: Robot, task: ViewTask, clearance: Clearance, start: Array, wanted: int, seed: int
) -> list[tuple[Array, Array]]:
    """Configurations with what each would tell (12, 12)."""
    rng = np.random.default_rng(seed)
    aim = PoseGoal(task.frame, robot.forward(start, task.frame).position, (1.0, 0.0, 0.0, 0.0))
    problem = Problem(robot, aim, solver="lm", tolerance=_NEAR, budget=_TRY, seed=seed)
    found: list[tuple[Array, Array]] = []
    for attempt in range(_TRIES):
        if attempt == _HOPELESS and not found:
            break
        near = robot.clip(start + rng.uniform(*_SHARES) * (robot.sample(rng) - start))
        hand = _wanted_hand(robot, task, near, rng)
        if hand is None:
            continue
        # An arm with few joints does not get there; where it gets may do all the same.
        q = robot.clip(problem.solve(near, target=hand).q)
        information = _worth(robot, task, clearance, q)
        if information is not None:
            found.append((q, information))
            if len(found) == wanted:
                break
    return found


def _wanted_hand(robot: Robot, task: ViewTask, near: Array, rng: np.random.Generator) -> Pose | None:
    """A pose of the hand about where it is at ``near`` that shows one of the markers, or None."""
    board = task.pose_camera_board(robot, near)
    _, pose_board_marker = list(task.squares.values())[rng.integers(len(task.squares))]
    mount = task.mount
    if mount.mounting == "eye_to_hand":
        seen = _tilted(board.apply(pose_board_marker.position), rng)
        orientation = seen.compose(pose_board_marker.inverse()).wxyz
        rotated_board = Pose(board.position, orientation)
        if not task.shown(rotated_board):
            return None
        return mount.pose_world_hand(rotated_board)
    # The camera stays where it is; its view turns so that the middle of the board comes to a random pixel.
    middle = board.apply(np.mean([pose.position for _, pose in task.squares.values()], axis=0))
    pixel = rng.uniform(0.3, 0.7, 2) * task.intrinsics.size
    rotation = _rotation_onto(middle, task.intrinsics.unproject(pixel.reshape(1, 2))[0], rng)
    board = Pose(wxyz=rotation).compose(board)
    if not task.shown(board):
        return None
    return mount.pose_world_hand(board)


def _tilted(position: Array, rng: np.random.Generator) -> Pose:
    """``pose_camera_marker`` at a place (3,), facing the camera but for a random tilt and roll."""
    back = -position / np.linalg.norm(position)
    facing = _rotation_onto(np.array([0.0, 0.0, 1.0]), back, rng)
    tilt, azimuth = rng.uniform(0.0, _LARGEST_TILT), rng.uniform(0.0, 2.0 * np.pi)
    tilt_rotation = rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0])
    return Pose(position, facing).compose(Pose(wxyz=tilt_rotation))


def _rotation_onto(source: Array, target: Array, rng: np.random.Generator) -> Array:
    """A rotation (4,), wxyz, that turns ``source`` into the direction ``target``, else at random."""
    a, b = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    axis = axis / sine if sine > 1e-9 else np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
    axis = axis / np.linalg.norm(axis)
    roll = Pose(wxyz=rotation_exp(rng.uniform(-np.pi, np.pi) * b))
    return roll.compose(Pose(wxyz=rotation_exp(np.arctan2(sine, cosine) * axis))).wxyz


def _worth(robot: Robot, task: ViewTask, clearance: Clearance, q: Array) -> Array | None:
    """Information (12, 12) on camera and board of the view at ``q``; None when it shows no marker."""
    seen = task.pose_camera_board(robot, q)
    ids = task.shown(seen)
    if not ids or not clearance.free(q):
        return None
    hand = robot.forward(q, task.frame)
    mount = task.mount
    parent = hand if mount.mounting == "eye_in_hand" else Pose()
    camera = parent.compose(mount.pose_parent_camera)
    markers = [task.squares[id][1].apply(marker_points(task.squares[id][0])) for id in ids]
    clear = [m for m in markers if clearance.sees(q, camera.position, camera.compose(seen).apply(m))]
    # Half of a board is enough; of a cube, one side.
    if 2 * len(clear) < len(ids):
        return None
    view, _ = compress(mount, [task.sample(robot, q, np.concatenate(clear))], task.intrinsics)
    arm = np.diag([_ARM_POSITION**2] * 3 + [_ARM_ANGLE**2] * 3)
    rows = view.rows[0]
    return np.asarray(rows.T @ np.linalg.solve(view.pixels[0] + arm, rows))


# ---------------------------------------------------------------------------------- choosing


def _most_informative(informations: Sequence[Array], count: int) -> list[int]:
    """Indices, greedily by the determinant of the sum."""
    if not informations:
        return []
    each = np.array(informations)
    scale = np.sqrt(np.maximum(np.diagonal(each.mean(axis=0)), 1e-300))
    each = each / np.outer(scale, scale)
    total = 1e-3 * np.eye(12)
    chosen: list[int] = []
    for _ in range(min(count, len(each))):
        gain = np.linalg.slogdet(total + each)[1]
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        total = total + each[chosen[-1]]
    return chosen
