"""Planned views: inside the limits, free, with the board in the picture, from many sides."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import mujoco
import numpy as np
import pytest

from robot_ik.camera.calibration.handeye import Mount, compress
from robot_ik.camera.calibration.pose_means import rotation_spread
from robot_ik.camera.targets import marker_points
from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.obstacles import Sphere
from robot_ik.collision.scene import Scene as CollisionScene
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot
from robot_ik.workcell.arm_camera.view_planning import ViewTask, plan_views
from robot_ik.workcell.scene import Scene, scene_for

# Distance of visible markers from the edge of the picture, px.
EDGE = 30


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("puma560")


@pytest.fixture(scope="module")
def scene(robot: Robot) -> Scene:
    return scene_for(robot)


@pytest.fixture(scope="module")
def task(scene: Scene) -> ViewTask:
    mount = Mount(scene.pose_world_camera, scene.cube_offset, "eye_to_hand")
    return ViewTask(mount, scene.cube_frame, dict(scene.cube), scene.intrinsics, scene.table)


@pytest.fixture(scope="module")
def views(robot: Robot, task: ViewTask) -> list[Array]:
    return plan_views(robot, task, 8, seed=1)


def test_views_are_inside_the_limits_and_show_the_board(
    robot: Robot, task: ViewTask, scene: Scene, views: list[Array]
) -> None:
    assert len(views) == 8
    lens = scene.intrinsics
    for q in views:
        assert robot.outside(q) == []
        # MuJoCo's forward kinematics is independent of the planner's.
        hand = robot.measure(q, scene.cube_frame)
        visible = 0
        for side, pose in scene.cube.values():
            marker = scene.pose_world_camera.inverse().compose(hand).compose(pose)
            if marker.rotation[:, 2] @ marker.position > -0.3 * np.linalg.norm(marker.position):
                continue
            corners = marker.apply(marker_points(side))
            points, _ = cv2.projectPoints(
                corners, np.zeros(3), np.zeros(3), lens.matrix, lens.coefficients
            )
            is_inside = (points > EDGE) & (points < np.array(lens.size) - EDGE)
            visible += bool(is_inside.all())
        assert visible >= 1


def test_neither_views_nor_the_motions_between_touch_the_table(
    robot: Robot, scene: Scene, views: list[Array]
) -> None:
    assert scene.table is not None
    x0, x1 = scene.table.x
    y0, y1 = scene.table.y
    spec = mujoco.MjSpec.from_file(str(robot.path))
    spec.worldbody.add_geom(
        name="table_top",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        contype=1,
        conaffinity=1,
        pos=[(x0 + x1) / 2, (y0 + y1) / 2, scene.table.height - 0.05],
        size=[(x1 - x0) / 2, (y1 - y0) / 2, 0.05],
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    table = model.geom("table_top").id
    moving = model.body_weldid[model.geom_bodyid] > 0
    for start, end in itertools.pairwise([robot.home, *views]):
        for share in np.linspace(0, 1, 25):
            data.qpos[:] = robot.qpos(start + share * (end - start))
            mujoco.mj_forward(model, data)
            for a, b in data.contact.geom:
                assert not (table in (a, b) and (moving[a] or moving[b])), share


def test_neither_they_nor_the_ways_between_touch_an_obstacle_of_the_arm_file(
    robot: Robot, task: ViewTask, views: list[Array]
) -> None:
    """A ball where the tool passes on the way to a view that was planned without it."""
    home = robot.home
    far = max(views, key=lambda q: float(np.abs(q - home).max()))
    passed = robot.forward(0.5 * (home + far)).position
    surroundings = CollisionScene(robot, [Sphere("ball", radius=0.04, pose=Pose(passed))])
    ball = surroundings.model.geom("ball").id
    pairs = surroundings.pairs[(surroundings.pairs == ball).any(axis=1)]

    def nearest(start: Array, end: Array) -> float:
        """Distance of the arm from the ball on a straight move."""
        return min(surroundings.clearance(q, pairs).distance for q in np.linspace(start, end, 100))

    assert surroundings.clearance(home, pairs).distance > 0.02
    assert nearest(home, far) < 0.0
    condition = CollisionAvoidance(surroundings, margin=0.01)
    planned = plan_views(robot, task, 6, seed=1, collisions=condition)
    for start, end in itertools.pairwise([home, *planned]):
        assert nearest(start, end) >= 0.01


def test_planned_views_contain_more_information_than_random_ones(
    robot: Robot, task: ViewTask, views: list[Array]
) -> None:
    spread = rotation_spread([robot.forward(q, task.frame).wxyz for q in views])
    assert np.degrees(spread[1]) > 25
    rng = np.random.default_rng(0)
    corners = np.concatenate(
        [pose.apply(marker_points(side)) for side, pose in task.squares.values()]
    )
    arm = np.diag([5e-4**2] * 3 + [2e-3**2] * 3)

    def information(stations: list[Array]) -> float:
        """Return the log determinant of the information on the poses of camera and board."""
        samples = [task.sample(robot, q, corners) for q in stations]
        linear, _ = compress(task.mount, samples, task.intrinsics)
        weighted = np.linalg.solve(linear.pixels + arm, linear.rows)
        matrix = np.einsum("nik,nil->kl", linear.rows, weighted)
        return float(np.linalg.slogdet(matrix)[1])

    near = [robot.clip(views[0] + rng.uniform(-0.35, 0.35, robot.nq)) for _ in views]
    assert information(views) > information(near) + 5


def test_the_same_seed_gives_the_same_views(
    robot: Robot, task: ViewTask, views: list[Array]
) -> None:
    np.testing.assert_array_equal(plan_views(robot, task, 8, seed=1), views)


def test_a_camera_that_cannot_see_the_board_is_reported(robot: Robot, task: ViewTask) -> None:
    # Far from the arm, looking straight up.
    camera = Pose((5.0, 0.0, 1.0))
    blind = replace(task, mount=Mount(camera, Pose(), "eye_to_hand"))
    with pytest.raises(CameraError, match="only 0 views") as reported:
        plan_views(robot, blind, 8)
    assert "give better rough poses of camera and board" in reported.value.hint
