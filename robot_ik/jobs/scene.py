"""What stands round the robot in `robot-ik reach`: table, printed markers, camera.

From ``[reach]`` of a ``robot.toml``, else generated: a goal within reach, a marker before it, a camera for
both.
"""

from __future__ import annotations

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

# The tool meets a marker head on: its z axis into the paper, its x axis along the marker's.
FACING = Pose((0.0, 0.0, 0.0), rotation_exp([np.pi, 0.0, 0.0]))

# Proportions of a generated scene, in reaches of the robot.
_MARKER_SIDE, _TOOL_MARKER_SIDE, _HOVER, _CAMERA_DISTANCE = 0.09, 0.07, 0.15, 1.25
_CUBE_PER_MARKER = 1.35  # a white margin of more than a cell round the markers on the cube
_TOOL_IDS = (20, 21, 22, 23)
_TRIES = 60
# Cosine of the view on the worse-seen target with which the search for a camera's pose is content.
_GOOD_VIEW, _WORST_VIEW = 0.45, 0.25
# A view in which the tool's markers lie on the target's is worth so much of one that keeps them apart, and
# ends the search after so many goals.
_ONE_ON_THE_OTHER, _PATIENCE = 0.5, 4


class Marker(Table):
    """A printed marker lying in the world, z up out of the paper."""

    id: int
    dictionary: str = "DICT_5X5_50"
    size: float
    position: Position
    yaw_deg: float = 0.0


class TableTop(Table):
    """A table top: its height and extent in the world, metres."""

    height: float
    x: Pair
    y: Pair


class SceneCamera(Table):
    """A camera: where it stands, the point that it is aimed at, and its optics (pixels)."""

    position: Position
    look_at: Position
    width: int = 1280
    height: int = 720
    focal: float = 1100.0
    distortion: Several[float] = (0.0, 0.0, 0.0, 0.0, 0.0)


class ToolMarker(Table):
    """Four markers on the sides of a cube that the gripper carries."""

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
    """What stands round the robot.

    Attributes:
        intrinsics, pose_world_camera: The camera.
        marker_id, dictionary, marker_size: The printed marker to reach.
        pose_world_marker: Where it lies at first.
        hover: How far from the paper the tool stops, metres.
        cube_frame: Robot frame that carries the tool's markers.
        cube_offset: The cube seen from that frame.
        cube: Marker id -> (side, ``pose_cube_marker``).
        cube_margin: White paper round each of them, metres: as much as the cube's side leaves.
        table: Where the marker lies, or None.
        generated: True when no ``robot.toml`` describes it.
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
        """The wanted tool, seen from the marker: ``hover`` above the paper, facing it."""
        return Pose((0.0, 0.0, self.hover)).compose(FACING)

    def with_marker_at(self, x: float, y: float, z: float, yaw_deg: float = 0.0) -> Scene:
        """The same with the printed marker elsewhere: metres in the world, degrees about the vertical."""
        pose = Pose((x, y, z), rotation_exp([0.0, 0.0, np.deg2rad(yaw_deg)]))
        return replace(self, pose_world_marker=pose)

    def synthetic(self, robot: Robot) -> SyntheticScene:
        """The same for the synthetic camera."""
        marker = partial(SyntheticMarker, dictionary=self.dictionary)
        # Wider paper would stick out and hide the edge of the marker round the corner.
        carried = partial(marker, frame=self.cube_frame, margin=self.cube_margin)
        markers = (
            marker(self.marker_id, self.marker_size, self.pose_world_marker),
            *(carried(id, side, self.cube_offset.compose(pose)) for id, (side, pose) in self.cube.items()),
        )
        return SyntheticScene(robot, self.intrinsics, self.pose_world_camera, markers, table=self.table)


def scene_for(robot: Robot, frame: str | None = None, *, upright: bool = False) -> Scene:
    """The scene of ``robot.toml``, or one generated from the kinematics of ``frame`` (default: the tool).

    Generated and ``upright``, the marker lies flat below the goal, however the tool is turned there: for arms
    that are asked for a position alone.

    Raises:
        CameraError: No camera pose shows a goal.
        ConfigError: ``[reach]`` of the robot's ``robot.toml`` is wrong.
    """
    reach = reach_table(robot)
    return _generated(robot, frame or robot.tool, upright) if reach is None else _described(robot, reach)


def reach_table(robot: Robot) -> ReachTable | None:
    """``[reach]`` of the robot's ``robot.toml``, if it has one; raises ``ConfigError`` where it is wrong."""
    file = robot.file
    if file.reach is None:
        return None
    return check_table(_ReachFile, {"reach": file.reach}, file.path or file.name).reach


def _described(robot: Robot, reach: ReachTable) -> Scene:
    camera, marker, tool = reach.camera, reach.marker, reach.tool_marker
    centre = ((camera.width - 1) / 2, (camera.height - 1) / 2)
    intrinsics = CameraIntrinsics(
        camera.width, camera.height, camera.focal, camera.focal, *centre, distortion=camera.distortion
    )
    yaw = rotation_exp([0.0, 0.0, np.deg2rad(marker.yaw_deg)])
    cube_pose = robot.forward(robot.home, tool.site)
    cube = {
        id: (tool.size, cube_pose.inverse().compose(robot.forward(robot.home, f"marker_{id}")))
        if f"marker_{id}" in robot.frames
        else (tool.size, _cube_side(k, tool.cube))
        for k, id in enumerate(tool.ids)
    }
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
    """``pose_cube_marker`` of the k-th side (+x, +y, -x, -y): z outwards, y along the cube's z."""
    angle = k * np.pi / 2
    out = np.array([np.cos(angle), np.sin(angle), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return Pose.from_rotation(np.column_stack([np.cross(up, out), up, out]), out * edge / 2)


def _generated(robot: Robot, frame: str, upright: bool) -> Scene:
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
        # Held in front of the tool, so that whatever the tool is made of does not hide it.
        cube_offset=Pose((0.0, 0.0, 0.6 * side * _CUBE_PER_MARKER)),
        cube=cube,
        cube_margin=0.5 * (_CUBE_PER_MARKER - 1.0) * side,
        generated=True,
    )
    return _best_view(robot, frame, scene, reach, upright)


def _best_view(robot: Robot, frame: str, scene: Scene, reach: float, upright: bool) -> Scene:
    """Tries goals near home and cameras round them; keeps the pair that shows marker and cube best."""
    rng = np.random.default_rng(0)
    best, best_score = None, 0.0
    home, at_home = robot.forward(robot.home, frame), _posed(robot, scene, robot.home)
    for attempt in range(_TRIES):
        # From a quarter of the range towards all of it, should nothing near home do.
        share = 0.25 + 0.75 * attempt / _TRIES
        q = robot.sample(rng)
        if robot.nq == robot.nv:  # else no vector space: ball and free joints go all of the way
            q = robot.home + share * (q - robot.home)
        q = robot.clip(q)
        tool = robot.forward(q, frame)
        if not 0.05 * reach < tool.distance(home)[0]:
            continue
        below = Pose(tool.position - [0.0, 0.0, scene.hover])  # enough where the position is
        marker = below if upright else tool.compose(scene.pose_marker_tool.inverse())
        placed, at_goal = replace(scene, pose_world_marker=marker), _posed(robot, scene, q)
        placed = replace(placed, table=_ground(placed, at_goal[1], reach))
        ground = 0.0 if placed.table is None else placed.table.height
        for pose in _cameras(marker.position, tool.position, reach):
            if pose.position[2] < ground + 0.1 * reach:
                continue
            score = _visibility(robot, replace(placed, pose_world_camera=pose), at_home, at_goal)
            if score > best_score * (1.0 + 1e-6):  # by rounding errors alone no other one is chosen
                best, best_score = replace(placed, pose_world_camera=pose), score
        enough = _GOOD_VIEW if attempt < _PATIENCE else _ONE_ON_THE_OTHER * _GOOD_VIEW
        if best_score > enough:
            break
    if best is None:
        raise CameraError(
            f"no camera pose shows a goal of frame {frame!r} of {robot.name}: the robot hides it everywhere",
            hint="give a goal yourself (--goal X Y Z), or another frame (--frame), "
            "or describe the scene in a robot.toml beside the model ([reach])",
        )
    return best


def _ground(scene: Scene, cube: Pose, reach: float) -> SceneTable | None:
    """A table top below marker and tool where the floor, at height 0, would hide them."""
    side = next(side for side, _ in scene.cube.values())
    lowest = min(scene.pose_world_marker.position[2] - scene.marker_size, cube.position[2] - 1.2 * side)
    height = float(lowest) - 0.02 * reach
    return None if height > 0.0 else SceneTable(height, (-reach, reach), (-reach, reach))


def _cameras(marker: Array, tool: Array, reach: float) -> list[Pose]:
    middle = 0.5 * (marker + tool)
    found = []
    for elevation in np.deg2rad([20.0, 40.0, 60.0, -15.0, -35.0]):
        for azimuth in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False):
            direction = np.array(
                [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
            )
            found.append(Pose.look_at(middle + _CAMERA_DISTANCE * reach * direction, middle))
    return found


def _posed(robot: Robot, scene: Scene, q: Array) -> tuple[mujoco.MjData, Pose]:
    """The model at ``q`` (nq,), for rays, and where the cube is."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_kinematics(robot.model, data)
    return data, robot.forward(q, scene.cube_frame).compose(scene.cube_offset)


def _visibility(
    robot: Robot, scene: Scene, at_home: tuple[mujoco.MjData, Pose], at_goal: tuple[mujoco.MjData, Pose]
) -> float:
    """0 when marker or cube cannot be seen, towards 1 when all that counts faces the camera."""
    (home, cube_at_home), (goal, cube) = at_home, at_goal
    marker = _facing(robot, scene, home, [(scene.marker_size, scene.pose_world_marker)])
    if not marker or not _apart(scene, cube_at_home):
        return 0.0
    seen = _facing(robot, scene, goal, [(side, cube.compose(pose)) for side, pose in scene.cube.values()])
    # Two sides at once tell how the cube is turned far better than one seen squarely.
    score = min(marker[0], float(sum(seen[:2]) / np.sqrt(2.0)))
    return score if not score or _apart(scene, cube) else _ONE_ON_THE_OTHER * score


def _apart(scene: Scene, cube: Pose) -> bool:
    """Whether the picture shows the target, and a cell of white round it, beside the whole cube there."""
    to_camera = scene.pose_world_camera.inverse()

    def outline(pose: Pose, points: Array) -> NDArray[np.float32]:
        pixels = scene.intrinsics.project(to_camera.apply(pose.apply(points)))
        return np.asarray(cv2.convexHull(pixels.astype(np.float32)))

    h = 0.6 * scene.marker_size
    paper = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
    side = next(side for side, _ in scene.cube.values())
    c = 0.5 * side + scene.cube_margin
    corners = c * np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    overlap, _ = cv2.intersectConvexConvex(outline(scene.pose_world_marker, paper), outline(cube, corners))
    return not overlap > 0.0


def _facing(
    robot: Robot, scene: Scene, data: mujoco.MjData, markers: list[tuple[float, Pose]]
) -> list[float]:
    """Cosines between view and paper of the markers (side, pose) that are seen whole, the best first."""
    eye = scene.pose_world_camera.position
    width, height = scene.intrinsics.size
    found = []
    for side, pose in markers:
        h = 0.6 * side
        points = pose.apply(np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0], [0, 0, 0]]))
        view = eye - pose.position
        cosine = float(pose.rotation[:, 2] @ view / np.linalg.norm(view))
        if cosine <= _WORST_VIEW:
            continue
        pixels = scene.intrinsics.project(scene.pose_world_camera.inverse().apply(points))
        if not ((pixels > 20).all() and (pixels < [width - 20, height - 20]).all()):
            continue
        if in_view(robot.model, data, eye, points, 1e-4):
            found.append(cosine)
    return sorted(found, reverse=True)


def in_view(model: mujoco.MjModel, data: mujoco.MjData, eye: Array, points: Array, slack: float) -> bool:
    """Whether no geom stands between ``eye`` and points (n, 3), up to ``slack`` metres before them."""
    geom = np.zeros(1, dtype=np.int32)
    for ray in points - eye:
        length = float(np.linalg.norm(ray))
        hit = mujoco.mj_ray(model, data, eye, ray / length, None, 1, -1, geom, None)
        if 0.0 <= hit < length - slack:
            return False
    return True
