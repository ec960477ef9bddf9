"""What stands round a robot: the described scene, and scenes generated for arms nobody described."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest

from robot_ik.camera import targets
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.errors import CameraError, ConfigError
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.jobs import scene as scenes
from robot_ik.jobs.scene import Scene, reach_table, scene_for
from robot_ik.robot import Robot, load_robot


@pytest.fixture(scope="module")
def puma() -> Robot:
    return load_robot("puma560")


def test_the_described_scene(puma: Robot) -> None:
    scene, reach = scene_for(puma), reach_table(puma)
    assert reach is not None and not scene.generated
    np.testing.assert_allclose(scene.pose_world_marker.position, reach.marker.position)
    np.testing.assert_allclose(scene.pose_world_marker.rotation[:, 2], [0, 0, 1], atol=1e-12)
    assert set(scene.cube) == set(reach.tool_marker.ids)
    eye, aim = np.array(reach.camera.position), np.array(reach.camera.look_at)
    axis = (aim - eye) / np.linalg.norm(aim - eye)
    np.testing.assert_allclose(scene.pose_world_camera.rotation[:, 2], axis, atol=1e-12)
    # the wanted tool: above the paper, looking at it
    tool = scene.pose_world_marker.compose(scene.pose_marker_tool)
    np.testing.assert_allclose(tool.position, np.add(reach.marker.position, [0, 0, reach.hover]), atol=1e-12)
    np.testing.assert_allclose(tool.rotation[:, 2], [0, 0, -1], atol=1e-12)


def test_a_wrong_key_of_the_scene_is_named_with_its_file(tmp_path: Path, puma: Robot) -> None:
    shutil.copytree(puma.folder, tmp_path / "arm")
    file = tmp_path / "arm" / "robot.toml"
    file.write_text(file.read_text().replace("hover =", "hovers ="))
    robot = load_robot(file.parent)
    with pytest.raises(ConfigError, match=r"robot\.toml: reach\.hovers: unknown key"):
        scene_for(robot)


def check_cube(scene: Scene) -> None:
    """Each side looks out of the cube, and its paper does not stick out over the edge."""
    for side, pose in scene.cube.values():
        edge = 2 * np.linalg.norm(pose.position)
        np.testing.assert_allclose(pose.rotation[:, 2], pose.position / (edge / 2), atol=1e-9)
        assert side + 2 * scene.cube_margin <= edge * (1 + 1e-9)
        assert scene.cube_margin > 0.05 * side
    outward = np.array([pose.rotation[:, 2] for _, pose in scene.cube.values()])
    np.testing.assert_allclose(outward.sum(axis=0), 0, atol=1e-9)


def test_the_papers_fit_their_cube(puma: Robot, arms: dict[str, Path]) -> None:
    scene = scene_for(puma)
    check_cube(scene)
    synthetic = scene.synthetic(puma)
    for marker in synthetic.markers:
        if marker.id in scene.cube:
            assert marker.margin == scene.cube_margin and marker.frame == scene.cube_frame
    check_cube(scene_for(load_robot(arms["ur"])))


@pytest.mark.parametrize(("name", "upright"), [("ur", False), ("planar", True), ("desk", True)])
def test_a_generated_scene_can_be_seen_and_reached(name: str, upright: bool, arms: dict[str, Path]) -> None:
    robot = load_robot(arms[name])
    scene = scene_for(robot, upright=upright)
    assert scene.generated
    place = scene.pose_world_marker.compose(scene.pose_marker_tool)
    goal = (
        PositionGoal(robot.tool, place.position)
        if upright
        else PoseGoal(robot.tool, position=place.position, wxyz=place.wxyz)
    )
    solution = solve(robot, goal, seed=1)
    assert solution.converged, solution
    assert solution.error.position < 1e-3
    if upright:
        np.testing.assert_allclose(scene.pose_world_marker.rotation[:, 2], [0, 0, 1])
    ground = 0.0 if scene.table is None else scene.table.height
    assert scene.pose_world_marker.position[2] > ground and scene.pose_world_camera.position[2] > ground
    q = [robot.home]
    frame = SyntheticSource(scene.synthetic(robot), lambda: q[0]).read()
    target = targets.marker(scene.marker_id, scene.marker_size, scene.dictionary)
    assert target.find(frame.without_truth(), scene.intrinsics) is not None


def test_a_scene_is_the_same_each_time(arms: dict[str, Path]) -> None:
    robot = load_robot(arms["planar"])
    assert str(scene_for(robot, upright=True)) == str(scene_for(robot, upright=True))


@pytest.mark.parametrize("name", ["planar", "ur"])
def test_rounding_errors_choose_no_view(
    name: str, arms: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of views that are equally good the first is taken, whatever the processor makes of the last digit."""
    robot = load_robot(str(arms[name]))
    expected = scene_for(robot, upright=name == "planar").pose_world_camera
    visibility, views = scenes._visibility, itertools.count()
    monkeypatch.setattr(scenes, "_visibility", lambda *view: visibility(*view) * (1.0 + 1e-14 * next(views)))
    found = scene_for(robot, upright=name == "planar").pose_world_camera
    assert next(views) > 1 and max(found.distance(expected)) < 1e-12


def test_a_tool_hidden_in_a_box_has_no_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "_TRIES", 12)  # the box hides the tool from every side at every one of sixty
    file = tmp_path / "boxed.xml"
    file.write_text(
        '<mujoco><worldbody><body><joint name="j" axis="0 0 1" range="-90 90"/>'
        '<geom size=".2" pos=".3 0 0"/><site name="tip" pos=".3 0 0"/></body></worldbody></mujoco>'
    )
    with pytest.raises(CameraError, match=r"'tip'.*hides"):
        scene_for(load_robot(file), upright=True)
