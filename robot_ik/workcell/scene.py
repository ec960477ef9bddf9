"""Scene of `robot-ik reach`: table, printed markers and camera.

The scene is read from ``[reach]`` of a ``robot.toml``. Without that table it is generated: a goal
within reach, a marker in front of the tool at the goal, and a camera that sees both.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.camera import SyntheticMarker, SyntheticScene
from robot_ik.camera.synthetic.painted import SceneTable
from robot_ik.config import Pair, Position, Several, Table, check_table
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Array
from robot_ik.robot import Robot

FACING = Pose((0.0, 0.0, 0.0), rotation_exp([np.pi, 0.0, 0.0]))
"""``pose_marker_tool`` of a tool that faces the marker: z into the paper, x along the marker's."""

_MARKER_SIDE = 0.09
"""Side of the printed marker of a generated scene, in reaches of the robot."""

_TOOL_MARKER_SIDE = 0.07
"""Side of the tool's markers of a generated scene, in reaches of the robot."""

_HOVER = 0.15
"""Distance of the tool from the paper in a generated scene, in reaches of the robot."""

_CAMERA_DISTANCE = 1.25
"""Distance of the camera in a generated scene, in reaches of the robot."""

_CUBE_PER_MARKER = 1.35
"""Edge of the cube per side of its markers. It leaves a white margin of more than one cell."""

_TOOL_IDS = (20, 21, 22, 23)
"""Ids of the tool's markers in a generated scene."""

_TRIES = 60
"""Number of goals that are tried for a generated scene."""

_GOOD_VIEW = 0.45
"""Score at which the search for a camera pose ends: a cosine between view and paper."""

_WORST_VIEW = 0.25
"""Smallest cosine between view and paper at which a marker counts as visible."""

_OVERLAP_FACTOR = 0.5
"""Factor on the score of a view in which the cube overlaps the printed marker."""

_PATIENCE = 4
"""Number of goals after which the search also ends with a good view that has an overlap."""

_BORDER = 20
"""Smallest distance of a marker from the border of the picture, px."""

_PAPER_PER_MARKER = 1.2
"""Side of the paper that must be visible, per side of the marker: about one white cell more."""

_RAY_SLACK = 1e-4
"""Distance before a marker within which a geom does not hide it, metres."""


class Marker(Table):
    """``[reach.marker]``: the printed marker. Its z axis points up, out of the paper.

    Attributes:
        id: Id in the dictionary.
        dictionary: OpenCV's name of the dictionary.
        size: Side of the black square, metres.
        position: Centre in the world, metres.
        yaw_deg: Rotation about the vertical, degrees.
    """

    id: int
    dictionary: str = "DICT_5X5_50"
    size: float
    position: Position
    yaw_deg: float = 0.0


class TableTop(Table):
    """``[reach.table]``: height and extent of a table top in the world, metres."""

    height: float
    x: Pair
    y: Pair


class SceneCamera(Table):
    """``[reach.camera]``: the camera.

    Attributes:
        position: Optical centre in the world, metres.
        look_at: Point in the world at which the camera is aimed, metres.
        width: Width of the picture, px.
        height: Height of the picture, px.
        focal: Focal length, px.
        distortion: Distortion coefficients of OpenCV: k1, k2, p1, p2, k3.
    """

    position: Position
    look_at: Position
    width: int = 1280
    height: int = 720
    focal: float = 1100.0
    distortion: Several[float] = (0.0, 0.0, 0.0, 0.0, 0.0)


class ToolMarker(Table):
    """``[reach.tool_marker]``: four markers on the sides of a cube that the gripper carries.

    Attributes:
        ids: Ids of the markers.
        size: Side of the black squares, metres.
        cube: Edge of the cube, metres.
        site: Site of the model at the centre of the cube.
    """

    ids: Several[int]
    size: float
    cube: float
    site: str


class ReachTable(Table):
    """``[reach]`` of a ``robot.toml``."""

    marker: Marker
    hover: float
    table: TableTop | None = None
    camera: SceneCamera
    tool_marker: ToolMarker


class _ReachFile(Table):
    reach: ReachTable


@dataclass(frozen=True)
class Scene:
    """Camera, markers and table around a robot.

    Attributes:
        intrinsics: Intrinsics of the camera.
        pose_world_camera: Pose of the camera.
        marker_id: Id of the printed marker to reach.
        dictionary: OpenCV's name of the dictionary of all markers.
        marker_size: Side of the printed marker, metres.
        pose_world_marker: Initial pose of the printed marker.
        hover: Distance between tool and paper at the goal, metres.
        cube_frame: Robot frame that carries the cube with the tool's markers.
        cube_offset: Pose of the cube in that frame.
        cube: (side in metres, ``pose_cube_marker``) by marker id.
        cube_margin: Width of the white paper around each marker of the cube, metres. The paper
            covers the whole side of the cube.
        table: Table top under the marker, or None.
        generated: Whether the scene was generated, not read from a ``robot.toml``.
    """

    intrinsics: CameraIntrinsics
    pose_world_camera: Pose
    marker_id: int
    dictionary: str
    marker_size: float
    pose_world_marker: Pose
    hover: float
    cube_frame: str
    cube_offset: Pose
    cube: Mapping[int, tuple[float, Pose]]
    cube_margin: float
    table: SceneTable | None = None
    generated: bool = False

    @property
    def pose_marker_tool(self) -> Pose:
        """Goal pose of the tool in the marker frame: ``hover`` above the paper, facing it."""
        return Pose((0.0, 0.0, self.hover)).compose(FACING)

    def with_marker_at(self, x: float, y: float, z: float, yaw_deg: float = 0.0) -> Scene:
        """Return a copy of the scene with the printed marker at another place.

        Args:
            x: Position in the world, metres.
            y: Position in the world, metres.
            z: Position in the world, metres.
            yaw_deg: Rotation about the vertical, degrees.
        """
        pose = Pose((x, y, z), rotation_exp([0.0, 0.0, np.deg2rad(yaw_deg)]))
        return replace(self, pose_world_marker=pose)

    def synthetic(self, robot: Robot) -> SyntheticScene:
        """Return the scene for the synthetic camera."""
        marker = partial(SyntheticMarker, dictionary=self.dictionary)
        # Wider paper would protrude and hide the edge of the marker on the next side.
        cube_marker = partial(marker, frame=self.cube_frame, margin=self.cube_margin)
        markers = [marker(self.marker_id, self.marker_size, self.pose_world_marker)]
        for id, (side, pose) in self.cube.items():
            markers.append(cube_marker(id, side, self.cube_offset.compose(pose)))
        return SyntheticScene(
            robot, self.intrinsics, self.pose_world_camera, tuple(markers), table=self.table
        )


def scene_for(robot: Robot, frame: str | None = None, *, upright: bool = False) -> Scene:
    """Return the scene of the robot's ``robot.toml``, or a generated scene.

    Args:
        robot: The robot.
        frame: Frame that reaches the goal of a generated scene. None: the tool.
        upright: Whether the marker of a generated scene lies flat below the goal for any
            orientation of the tool. Use it if only the position of the tool is controlled.

    Returns:
        The scene.

    Raises:
        CameraError: No camera pose shows a goal.
        ConfigError: ``[reach]`` of the robot's ``robot.toml`` is not valid.
    """
    reach = reach_table(robot)
    if reach is None:
        return _generated(robot, frame or robot.tool, upright)
    return _described(robot, reach)


def reach_table(robot: Robot) -> ReachTable | None:
    """Return ``[reach]`` of the robot's ``robot.toml``, or None if the table is missing.

    Raises:
        ConfigError: The table is not valid.
    """
    file = robot.file
    if file.reach is None:
        return None
    return check_table(_ReachFile, {"reach": file.reach}, file.path or file.name).reach


def _described(robot: Robot, reach: ReachTable) -> Scene:
    """Return the scene that a ``robot.toml`` describes."""
    camera = reach.camera
    marker = reach.marker
    tool = reach.tool_marker
    intrinsics = CameraIntrinsics(
        camera.width,
        camera.height,
        camera.focal,
        camera.focal,
        (camera.width - 1) / 2,
        (camera.height - 1) / 2,
        distortion=camera.distortion,
    )
    yaw = rotation_exp([0.0, 0.0, np.deg2rad(marker.yaw_deg)])

    # A site of the model named marker_<id> overrides the computed pose on the cube.
    pose_world_cube = robot.forward(robot.home, tool.site)
    cube = {}
    for k, id in enumerate(tool.ids):
        pose = _cube_side(k, tool.cube)
        if f"marker_{id}" in robot.frames:
            pose_world_side = robot.forward(robot.home, f"marker_{id}")
            pose = pose_world_cube.inverse().compose(pose_world_side)
        cube[id] = (tool.size, pose)
    return Scene(
        intrinsics=intrinsics,
        pose_world_camera=Pose.look_at(camera.position, camera.look_at),
        marker_id=marker.id,
        dictionary=marker.dictionary,
        marker_size=marker.size,
        pose_world_marker=Pose(marker.position, yaw),
        hover=reach.hover,
        cube_frame=tool.site,
        cube_offset=Pose(),
        cube=cube,
        cube_margin=0.5 * (tool.cube - tool.size),
        table=None if reach.table is None else SceneTable(**dict(reach.table)),
    )


def _cube_side(k: int, edge: float) -> Pose:
    """Return ``pose_cube_marker`` of a side of a cube: z outwards, y along the cube's z.

    Args:
        k: Index of the side, in the order +x, +y, -x, -y.
        edge: Edge of the cube, metres.
    """
    angle = k * np.pi / 2
    normal = np.array([np.cos(angle), np.sin(angle), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    rotation = np.column_stack([np.cross(up, normal), up, normal])
    return Pose.from_rotation(rotation, normal * edge / 2)


def _generated(robot: Robot, frame: str, upright: bool) -> Scene:
    """Return a scene in proportion to the robot's reach, with the best view that is found."""
    ball = robot.reach(frame)
    reach = 1.0 if ball is None else max(ball[1], 1e-3)
    side = _TOOL_MARKER_SIDE * reach
    cube = {id: (side, _cube_side(k, side * _CUBE_PER_MARKER)) for k, id in enumerate(_TOOL_IDS)}
    focal = 1100.0
    scene = Scene(
        intrinsics=CameraIntrinsics(
            1280, 720, focal, focal, 639.5, 359.5, distortion=(-0.12, 0.05, 0.0005, -0.0003, 0.0)
        ),
        pose_world_camera=Pose(),
        marker_id=7,
        dictionary="DICT_5X5_50",
        marker_size=_MARKER_SIDE * reach,
        pose_world_marker=Pose(),
        hover=_HOVER * reach,
        cube_frame=frame,
        # The cube is in front of the tool, so that the geoms of the tool do not hide it.
        cube_offset=Pose((0.0, 0.0, 0.6 * side * _CUBE_PER_MARKER)),
        cube=cube,
        cube_margin=0.5 * (_CUBE_PER_MARKER - 1.0) * side,
        generated=True,
    )
    return _best_view(robot, frame, scene, reach, upright)


def _best_view(robot: Robot, frame: str, scene: Scene, reach: float, upright: bool) -> Scene:
    """Return the scene with the goal and camera that show marker and cube best.

    Goals near home and cameras around each goal are tried.

    Args:
        robot: The robot.
        frame: Frame that reaches the goal.
        scene: Scene whose marker, camera and table are replaced.
        reach: Reach of the frame, metres.
        upright: Whether the marker lies flat below the goal.

    Raises:
        CameraError: No camera pose shows a goal.
    """
    rng = np.random.default_rng(0)
    best = None
    best_score = 0.0
    home = robot.forward(robot.home, frame)
    at_home = _posed(robot, scene, robot.home)
    for attempt in range(_TRIES):
        # The goals begin within a quarter of the joint ranges and spread to all of them.
        share = 0.25 + 0.75 * attempt / _TRIES
        q = robot.sample(rng)
        # Coordinates of ball and free joints are no vector space and cannot be scaled.
        if robot.nq == robot.nv:
            q = robot.home + share * (q - robot.home)
        q = robot.clip(q)
        tool = robot.forward(q, frame)
        if not 0.05 * reach < tool.distance(home)[0]:
            continue
        if upright:
            marker = Pose(tool.position - [0.0, 0.0, scene.hover])
        else:
            marker = tool.compose(scene.pose_marker_tool.inverse())
        at_goal = _posed(robot, scene, q)
        placed = replace(scene, pose_world_marker=marker)
        placed = replace(placed, table=_ground(placed, at_goal[1], reach))
        ground = 0.0 if placed.table is None else placed.table.height
        for pose in _cameras(marker.position, tool.position, reach):
            if pose.position[2] < ground + 0.1 * reach:
                continue
            candidate = replace(placed, pose_world_camera=pose)
            score = _visibility(robot, candidate, at_home, at_goal)
            # Rounding errors must not decide between equally good views.
            if score > best_score * (1.0 + 1e-6):
                best = candidate
                best_score = score

        sufficient_score = _GOOD_VIEW
        if attempt >= _PATIENCE:
            sufficient_score *= _OVERLAP_FACTOR
        if best_score > sufficient_score:
            break
    if best is None:
        raise CameraError(
            f"no camera pose shows a goal of frame {frame!r} of {robot.name}: "
            "the robot hides it everywhere",
            hint="give a goal yourself (--goal X Y Z), or another frame (--frame), "
            "or describe the scene in a robot.toml beside the model ([reach])",
        )
    return best


def _ground(scene: Scene, cube: Pose, reach: float) -> SceneTable | None:
    """Return a table top below marker and cube, or None if both are above the floor at height 0.

    Args:
        scene: Scene with the marker in place.
        cube: Pose of the cube in the world, at the goal.
        reach: Reach of the robot, metres.
    """
    side = _cube_marker_side(scene)
    marker_bottom = scene.pose_world_marker.position[2] - scene.marker_size
    cube_bottom = cube.position[2] - 1.2 * side
    height = float(min(marker_bottom, cube_bottom)) - 0.02 * reach
    return None if height > 0.0 else SceneTable(height, (-reach, reach), (-reach, reach))


def _cube_marker_side(scene: Scene) -> float:
    """Return the side of the cube's markers, metres. All have the same side."""
    return next(side for side, _ in scene.cube.values())


def _cameras(marker: Array, tool: Array, reach: float) -> list[Pose]:
    """Return camera poses on a sphere, aimed at the midpoint of marker and tool (3,)."""
    middle = 0.5 * (marker + tool)
    distance = _CAMERA_DISTANCE * reach
    poses = []
    for elevation in np.deg2rad([20.0, 40.0, 60.0, -15.0, -35.0]):
        for azimuth in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False):
            x = np.cos(elevation) * np.cos(azimuth)
            y = np.cos(elevation) * np.sin(azimuth)
            direction = np.array([x, y, np.sin(elevation)])
            poses.append(Pose.look_at(middle + distance * direction, middle))
    return poses


def _posed(robot: Robot, scene: Scene, q: Array) -> tuple[mujoco.MjData, Pose]:
    """Return the MuJoCo data at ``q`` (nq,), for rays, and the pose of the cube in the world."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_kinematics(robot.model, data)
    return data, robot.forward(q, scene.cube_frame).compose(scene.cube_offset)


def _visibility(
    robot: Robot,
    scene: Scene,
    at_home: tuple[mujoco.MjData, Pose],
    at_goal: tuple[mujoco.MjData, Pose],
) -> float:
    """Return the score of a view: 0 if marker or cube is hidden, towards 1 if both face the camera.

    Args:
        robot: The robot.
        scene: Scene with the camera in place.
        at_home: MuJoCo data and pose of the cube at home, where the marker must be visible.
        at_goal: MuJoCo data and pose of the cube at the goal, where the cube must be visible.
    """
    data_at_home, cube_at_home = at_home
    data_at_goal, cube_at_goal = at_goal
    marker = [(scene.marker_size, scene.pose_world_marker)]
    marker_cosines = _facing(robot, scene, data_at_home, marker)
    if not marker_cosines or not _apart(scene, cube_at_home):
        return 0.0

    sides = [(side, cube_at_goal.compose(pose)) for side, pose in scene.cube.values()]
    side_cosines = _facing(robot, scene, data_at_goal, sides)
    # Two visible sides determine the orientation of the cube better than a single frontal side.
    score = min(marker_cosines[0], float(sum(side_cosines[:2]) / np.sqrt(2.0)))
    if score and not _apart(scene, cube_at_goal):
        score *= _OVERLAP_FACTOR
    return score


def _apart(scene: Scene, cube: Pose) -> bool:
    """Return whether printed marker and cube do not overlap in the picture.

    One white cell around the printed marker counts as part of it.

    Args:
        scene: Scene with the camera in place.
        cube: Pose of the cube in the world.
    """
    to_camera = scene.pose_world_camera.inverse()

    def outline(pose: Pose, points: Array) -> NDArray[np.float32]:
        pixels = scene.intrinsics.project(to_camera.apply(pose.apply(points)))
        return np.asarray(cv2.convexHull(pixels.astype(np.float32)))

    half_edge = 0.5 * _cube_marker_side(scene) + scene.cube_margin
    corners = half_edge * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    marker_outline = outline(scene.pose_world_marker, _paper_corners(scene.marker_size))
    overlap, _ = cv2.intersectConvexConvex(marker_outline, outline(cube, corners))
    return not overlap > 0.0


def _paper_corners(side: float) -> Array:
    """Return the corners (4, 3) of a marker's paper in the marker frame, metres."""
    h = 0.5 * _PAPER_PER_MARKER * side
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def _facing(
    robot: Robot, scene: Scene, data: mujoco.MjData, markers: list[tuple[float, Pose]]
) -> list[float]:
    """Return the cosines between view and paper normal of the markers that are not hidden.

    Args:
        robot: The robot.
        scene: Scene with the camera in place.
        data: MuJoCo data of the robot's configuration.
        markers: (side in metres, pose in the world) of each marker.

    Returns:
        Cosines in descending order, without the markers that are hidden in part.
    """
    eye = scene.pose_world_camera.position
    to_camera = scene.pose_world_camera.inverse()
    low = np.array([_BORDER, _BORDER])
    high = np.array(scene.intrinsics.size) - _BORDER
    cosines = []
    for side, pose in markers:
        points = pose.apply(np.vstack([_paper_corners(side), np.zeros(3)]))
        view = eye - pose.position
        cosine = float(pose.rotation[:, 2] @ view / np.linalg.norm(view))
        if cosine <= _WORST_VIEW:
            continue
        pixels = scene.intrinsics.project(to_camera.apply(points))
        if not ((pixels > low).all() and (pixels < high).all()):
            continue
        if in_view(robot.model, data, eye, points, _RAY_SLACK):
            cosines.append(cosine)
    return sorted(cosines, reverse=True)


def in_view(
    model: mujoco.MjModel, data: mujoco.MjData, eye: Array, points: Array, slack: float
) -> bool:
    """Return whether no geom hides any of several points from an eye.

    Args:
        model: MuJoCo model.
        data: MuJoCo data with the poses of the geoms.
        eye: Position of the eye (3,) in the world, metres.
        points: Points (n, 3) in the world, metres.
        slack: Distance before a point within which a geom does not hide it, metres.
    """
    geom = np.zeros(1, dtype=np.int32)
    for ray in points - eye:
        length = float(np.linalg.norm(ray))
        hit = mujoco.mj_ray(model, data, eye, ray / length, None, 1, -1, geom, None)
        if 0.0 <= hit < length - slack:
            return False
    return True
