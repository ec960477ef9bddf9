"""Plan the joint configurations whose views determine the pose of a camera best.

The arm carries the camera or the board, and the other one rests (``Mounting``). Rough poses of both
suffice if they bring the board into the picture.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.budget import Budget
from robot_ik.camera.calibration.handeye import MIN_VIEWS, HandEyeSample, Mount, compress
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.painted import SceneTable
from robot_ik.camera.targets import Observation, Squares, marker_points
from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.obstacles import Box, Obstacle
from robot_ik.collision.scene import Scene
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.goals import PoseGoal, Tolerance
from robot_ik.motion.certificate import is_certified
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.workcell.scene import in_view

# Smallest distance of the arm from itself, its surroundings and the table, metres.
_MIN_DISTANCE = 0.01
# Smallest thickness of a table, metres.
_MIN_THICKNESS = 0.03
# A geom may begin this far before a point that is seen on it, metres.
_SIGHT_SLACK = 2e-3
# Border of the picture that is kept free at each side, as a share of its size. The guess of the
# poses is off by about as much.
_MARGIN = 0.06
# Smallest cosine between the normal of a marker and the direction to the camera.
_MIN_FACING = 0.40
# Smallest side of a marker in the picture, px.
_MIN_SIDE = 28.0
# Smallest share of the markers facing the camera that must be in the picture.
_MIN_SHARE_IN_VIEW = 0.75
# Largest tilt of a marker in a random view, rad.
_LARGEST_TILT = np.deg2rad(50.0)
# Number of random starts.
_TRIES = 3000
# Candidates for each view that is chosen.
_POOL = 5
# How often stations without a free path are replaced.
_REPAIRS = 4
# Random starts without a candidate after which the search ends.
_HOPELESS = 300
# Range of the distance of a random start from home, as a share of the way to a random
# configuration.
_SHARES = (0.1, 0.7)
# Assumed standard deviation of a corner, px.
_PIXEL = 0.2
# Assumed standard deviation of the arm's position, each axis, metres.
_ARM_POSITION = 5e-4
# Assumed standard deviation of the arm's orientation, each axis, rad.
_ARM_ANGLE = np.deg2rad(0.1)
# Inverse kinematics of a candidate: a rough solution suffices.
_NEAR = Tolerance(position=1e-3, angle=5e-3)
_TRY = Budget(iterations=300, restarts=1)


def condition_at(
    robot: Robot,
    start: Array,
    table: SceneTable | None = None,
    collisions: CollisionAvoidance | None = None,
) -> CollisionAvoidance:
    """Return the condition that the arm touches neither itself, its surroundings nor a table.

    Parts that are near each other at ``start`` (nq,) are left out: neighbouring links, or a base on
    the table.

    Args:
        robot: The robot.
        start: Where the arm stands (nq,).
        table: The table. None for none.
        collisions: Condition of the arm file, whose obstacles count too. None for none.
    """
    obstacles: list[Obstacle] = []
    margin = _MIN_DISTANCE
    ignore: Sequence[Sequence[str]] = ()
    if collisions is not None:
        obstacles += collisions.scene.obstacles
        margin = max(margin, collisions.margin)
        ignore = collisions.ignore
    if table is not None:
        obstacles.append(_block(table))
    condition = CollisionAvoidance(Scene(robot, obstacles), margin, ignore=ignore)
    return condition.without(condition.near(start))


def _block(table: SceneTable) -> Box:
    """Return a table as an obstacle that reaches down to the floor."""
    thickness = max(table.height - table.floor_height, _MIN_THICKNESS)
    size = (table.x[1] - table.x[0], table.y[1] - table.y[0], thickness)
    middle = (0.5 * sum(table.x), 0.5 * sum(table.y), table.height - 0.5 * thickness)
    return Box("table of the scene", size=size, pose=Pose(middle))


def is_visible(robot: Robot, q: Array, eye: Array, points: Array) -> bool:
    """Return whether no geom at ``q`` (nq,) hides points (n, 3), world, from an eye (3,)."""
    return in_view(robot.model, robot.data_at(q), eye, points, _SIGHT_SLACK)


def visiting_order(
    robot: Robot, start: Array, stations: Sequence[Array], condition: CollisionAvoidance
) -> list[int]:
    """Return the indices of stations in the order of a short path without contacts.

    The order begins with the nearest neighbour of each station and is improved by 2-opt. Stations
    without a free path are left out.
    """
    configurations = [start, *stations]
    # Seconds of the move between two configurations; infinite if it is not proven free.
    cost = np.full((len(configurations), len(configurations)), np.inf)
    for i in range(len(configurations)):
        for j in range(i):
            ends = [configurations[i], configurations[j]]
            if is_certified(ends, condition):
                cost[i, j] = float(np.max(np.abs(ends[1] - ends[0]) / robot.velocity_limits))
                cost[j, i] = cost[i, j]
    order = [0]
    left = set(range(1, len(configurations)))
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
                    order = trial
                    improved = True
    return [k - 1 for k in order[1:]]


@dataclass(frozen=True, eq=False)
class ViewTask:
    """Rough poses of camera and board, for planning.

    Attributes:
        mount: The rough poses.
        frame: Frame of the robot that carries the camera or the board.
        squares: Markers of the board by id: side, metres, and ``pose_board_marker``.
        intrinsics: Intrinsics of the camera.
        table: Table that the arm must not touch.
    """

    mount: Mount
    frame: str
    squares: Squares
    intrinsics: CameraIntrinsics
    table: SceneTable | None = None

    def pose_camera_board(self, robot: Robot, q: Array) -> Pose:
        """Return the pose of the board in the camera's frame at ``q``."""
        return self.mount.pose_camera_board(self.sample(robot, q, np.zeros((4, 3))))

    def sample(self, robot: Robot, q: Array, points: Array) -> HandEyeSample:
        """Return a sample at ``q`` with an empty view of ``points`` (n, 3) of the board."""
        view = Observation(points, np.zeros((len(points), 2)), Pose(), _PIXEL)
        return HandEyeSample(robot.forward(q, self.frame), view)

    def shown(self, pose_camera_board: Pose) -> tuple[int, ...]:
        """Return the ids of the markers that are large enough in the picture and not too tilted.

        Occlusion is not checked. The result is empty if too many of the markers that face the
        camera are outside the picture.
        """
        size = np.array(self.intrinsics.size)
        facing = 0
        ids = []
        for marker_id, (side, pose_board_marker) in self.squares.items():
            marker = pose_camera_board.compose(pose_board_marker)
            normal = marker.rotation[:, 2]
            cosine = -float(normal @ marker.position) / float(np.linalg.norm(marker.position))
            if marker.position[2] <= side or cosine <= _MIN_FACING:
                continue
            facing += 1
            pixels = self.intrinsics.project(marker.apply(marker_points(side)))
            sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1)
            inside = (pixels > _MARGIN * size).all() and (pixels < (1.0 - _MARGIN) * size).all()
            if inside and sides.min() > _MIN_SIDE:
                ids.append(marker_id)
        return tuple(ids) if len(ids) >= _MIN_SHARE_IN_VIEW * facing else ()


def plan_views(
    robot: Robot,
    task: ViewTask,
    count: int = 15,
    *,
    start: Array | None = None,
    seed: int = 0,
    collisions: CollisionAvoidance | None = None,
) -> list[Array]:
    """Plan joint configurations with the board in view.

    Inverse kinematics finds candidates for random views. A greedy search chooses those that
    together determine camera and board best: D-optimality of the information matrix (Fedorov,
    Theory of Optimal Experiments, 1972). All configurations are inside the joint limits. Neither
    they nor the straight moves between them touch anything of the model or the table.

    Args:
        robot: The robot.
        task: What to view.
        count: Number of configurations. Fewer are returned if no more can be reached.
        start: Configuration (nq,) of the arm. None for home.
        seed: Of the random views.
        collisions: Condition of the arm file, whose obstacles count too. None for none.

    Returns:
        Configurations (nq,) in the order of a short path from ``start``.

    Raises:
        CameraError: Fewer than four can be reached.
    """
    start = robot.home if start is None else robot.check_q(start, "start")
    condition = condition_at(robot, start, task.table, collisions)
    pool = _candidates(robot, task, condition, start, max(_POOL * count, 4 * MIN_VIEWS), seed)
    ordered: list[Array] = []
    for _ in range(_REPAIRS):
        chosen = _most_informative([information for _, information in pool], count)
        order = visiting_order(robot, start, [pool[k][0] for k in chosen], condition)
        ordered = max(ordered, [pool[chosen[k]][0] for k in order], key=len)
        if len(order) == len(chosen):
            break
        # Replace the stations without a free path.
        unconnected = {k for index, k in enumerate(chosen) if index not in order}
        pool = [candidate for k, candidate in enumerate(pool) if k not in unconnected]
    if len(ordered) < MIN_VIEWS:
        carried = "camera" if task.mount.mounting == "eye_in_hand" else "board"
        raise CameraError(
            f"only {len(ordered)} views were found in which the board can be seen and the arm, "
            f"carrying the {carried}, touches nothing; at least {MIN_VIEWS} are needed",
            hint="give better rough poses of camera and board, move them, or take a larger board",
        )
    return ordered


def _candidates(
    robot: Robot,
    task: ViewTask,
    condition: CollisionAvoidance,
    start: Array,
    count: int,
    seed: int,
) -> list[tuple[Array, Array]]:
    """Return at most ``count`` configurations (nq,) and the information (12, 12) of each."""
    rng = np.random.default_rng(seed)
    aim = PoseGoal(task.frame, robot.forward(start, task.frame).position, (1.0, 0.0, 0.0, 0.0))
    problem = Problem(robot, aim, solver="lm", tolerance=_NEAR, budget=_TRY, seed=seed)
    candidates: list[tuple[Array, Array]] = []
    for attempt in range(_TRIES):
        if attempt == _HOPELESS and not candidates:
            break
        near = robot.clip(start + rng.uniform(*_SHARES) * (robot.sample(rng) - start))
        hand = _random_hand_pose(robot, task, near, rng)
        if hand is None:
            continue
        # An arm with few joints may not reach the pose, but its best approximation may suffice.
        q = robot.clip(problem.solve(near, target=hand).q)
        information = _worth(robot, task, condition, q)
        if information is not None:
            candidates.append((q, information))
            if len(candidates) == count:
                break
    return candidates


def _random_hand_pose(
    robot: Robot, task: ViewTask, near: Array, rng: np.random.Generator
) -> Pose | None:
    """Return a pose of the hand close to that at ``near`` with a marker in view, or None."""
    board = task.pose_camera_board(robot, near)
    _, pose_board_marker = list(task.squares.values())[rng.integers(len(task.squares))]
    mount = task.mount
    if mount.mounting == "eye_to_hand":
        marker = _tilted(board.apply(pose_board_marker.position), rng)
        orientation = marker.compose(pose_board_marker.inverse()).wxyz
        rotated_board = Pose(board.position, orientation)
        if not task.shown(rotated_board):
            return None
        return mount.pose_world_hand(rotated_board)
    # The camera rotates about itself so that the middle of the board is at a random pixel.
    middle = board.apply(np.mean([pose.position for _, pose in task.squares.values()], axis=0))
    pixel = rng.uniform(0.3, 0.7, 2) * task.intrinsics.size
    rotation = _rotation_onto(middle, task.intrinsics.unproject(pixel.reshape(1, 2))[0], rng)
    board = Pose(wxyz=rotation).compose(board)
    if not task.shown(board):
        return None
    return mount.pose_world_hand(board)


def _tilted(position: Array, rng: np.random.Generator) -> Pose:
    """Return ``pose_camera_marker`` at a position (3,), with a random tilt and roll."""
    back = -position / np.linalg.norm(position)
    facing = _rotation_onto(np.array([0.0, 0.0, 1.0]), back, rng)
    tilt = rng.uniform(0.0, _LARGEST_TILT)
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    tilt_rotation = rotation_exp([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0.0])
    return Pose(position, facing).compose(Pose(wxyz=tilt_rotation))


def _rotation_onto(source: Array, target: Array, rng: np.random.Generator) -> Array:
    """Return a random rotation (4,), wxyz, of those that turn ``source`` into ``target``."""
    a = source / np.linalg.norm(source)
    b = target / np.linalg.norm(target)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    cosine = float(a @ b)
    axis = axis / sine if sine > 1e-9 else np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
    axis = axis / np.linalg.norm(axis)
    roll = Pose(wxyz=rotation_exp(rng.uniform(-np.pi, np.pi) * b))
    return roll.compose(Pose(wxyz=rotation_exp(np.arctan2(sine, cosine) * axis))).wxyz


def _worth(robot: Robot, task: ViewTask, condition: CollisionAvoidance, q: Array) -> Array | None:
    """Return the information (12, 12) of the view at ``q``, or None if it is not usable."""
    board = task.pose_camera_board(robot, q)
    ids = task.shown(board)
    if not ids or not condition.free(q):
        return None
    hand = robot.forward(q, task.frame)
    mount = task.mount
    parent = hand if mount.mounting == "eye_in_hand" else Pose()
    camera = parent.compose(mount.pose_parent_camera)
    pose_world_board = camera.compose(board)
    visible = []
    for marker_id in ids:
        side, pose_board_marker = task.squares[marker_id]
        points = pose_board_marker.apply(marker_points(side))
        if is_visible(robot, q, camera.position, pose_world_board.apply(points)):
            visible.append(points)
    # Half of the markers in the picture must not be hidden.
    if 2 * len(visible) < len(ids):
        return None
    view, _ = compress(mount, [task.sample(robot, q, np.concatenate(visible))], task.intrinsics)
    arm = np.diag([_ARM_POSITION**2] * 3 + [_ARM_ANGLE**2] * 3)
    rows = view.rows[0]
    return np.asarray(rows.T @ np.linalg.solve(view.pixels[0] + arm, rows))


def _most_informative(informations: Sequence[Array], count: int) -> list[int]:
    """Return indices, chosen greedily by the determinant of the sum."""
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
