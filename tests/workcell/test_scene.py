"""Scenes around a robot: read from a ``robot.toml``, and generated for arms without one."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.camera import targets
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.errors import CameraError, ConfigError
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.robot import Robot, load_robot
from robot_ik.workcell import scene as scenes
from robot_ik.workcell.scene import Scene, reach_table, scene_for


@pytest.fixture(scope="module")
def puma() -> Robot:
    return load_robot("puma560")


def test_a_described_scene_has_the_poses_of_its_robot_toml(puma: Robot) -> None:
    scene = scene_for(puma)
    reach = reach_table(puma)
    assert reach is not None
    assert not scene.generated
    np.testing.assert_allclose(scene.pose_world_marker.position, reach.marker.position)
    np.testing.assert_allclose(scene.pose_world_marker.rotation[:, 2], [0, 0, 1], atol=1e-12)
    assert set(scene.cube) == set(reach.tool_marker.ids)
    eye = np.array(reach.camera.position)
    aim = np.array(reach.camera.look_at)
    axis = (aim - eye) / np.linalg.norm(aim - eye)
    np.testing.assert_allclose(scene.pose_world_camera.rotation[:, 2], axis, atol=1e-12)
    # The goal of the tool is above the paper, and its z axis points down.
    tool = scene.pose_world_marker.compose(scene.pose_marker_tool)
    above_marker = np.add(reach.marker.position, [0, 0, reach.hover])
    np.testing.assert_allclose(tool.position, above_marker, atol=1e-12)
    np.testing.assert_allclose(tool.rotation[:, 2], [0, 0, -1], atol=1e-12)


def test_the_error_for_an_unknown_key_names_file_and_key(tmp_path: Path, puma: Robot) -> None:
    shutil.copytree(puma.folder, tmp_path / "arm")
    file = tmp_path / "arm" / "robot.toml"
    file.write_text(file.read_text().replace("hover =", "hovers ="))
    robot = load_robot(file.parent)
    with pytest.raises(ConfigError, match=r"robot\.toml: reach\.hovers: unknown key"):
        scene_for(robot)


def check_cube(scene: Scene) -> None:
    """Check that each marker faces outwards and that its paper fits on the side of the cube."""
    for side, pose in scene.cube.values():
        edge = 2 * np.linalg.norm(pose.position)
        np.testing.assert_allclose(pose.rotation[:, 2], pose.position / (edge / 2), atol=1e-9)
        assert side + 2 * scene.cube_margin <= edge * (1 + 1e-9)
        assert scene.cube_margin > 0.05 * side
    outward = np.array([pose.rotation[:, 2] for _, pose in scene.cube.values()])
    np.testing.assert_allclose(outward.sum(axis=0), 0, atol=1e-9)


def test_markers_and_their_paper_fit_on_the_cube(puma: Robot, arms: dict[str, Path]) -> None:
    scene = scene_for(puma)
    check_cube(scene)
    synthetic = scene.synthetic(puma)
    for marker in synthetic.markers:
        if marker.id in scene.cube:
            assert marker.margin == scene.cube_margin
            assert marker.frame == scene.cube_frame
    check_cube(scene_for(load_robot(arms["ur"])))


@pytest.mark.parametrize(("name", "upright"), [("ur", False), ("planar", True), ("desk", True)])
def test_the_marker_of_a_generated_scene_is_reachable_and_visible(
    name: str, upright: bool, arms: dict[str, Path]
) -> None:
    robot = load_robot(arms[name])
    scene = scene_for(robot, upright=upright)
    assert scene.generated
    tool = scene.pose_world_marker.compose(scene.pose_marker_tool)
    goal = (
        PositionGoal(robot.tool, tool.position)
        if upright
        else PoseGoal(robot.tool, position=tool.position, wxyz=tool.wxyz)
    )
    solution = solve(robot, goal, seed=1)
    assert solution.converged, solution
    assert solution.error.position < 1e-3
    if upright:
        np.testing.assert_allclose(scene.pose_world_marker.rotation[:, 2], [0, 0, 1])
    ground = 0.0 if scene.table is None else scene.table.height
    assert scene.pose_world_marker.position[2] > ground
    assert scene.pose_world_camera.position[2] > ground
    frame = SyntheticSource(scene.synthetic(robot), lambda: robot.home).read()
    target = targets.marker(scene.marker_id, scene.marker_size, scene.dictionary)
    assert target.find(frame.without_truth(), scene.intrinsics) is not None


def test_generating_a_scene_twice_gives_the_same_scene(arms: dict[str, Path]) -> None:
    robot = load_robot(arms["planar"])
    assert str(scene_for(robot, upright=True)) == str(scene_for(robot, upright=True))


@pytest.mark.parametrize("name", ["planar", "ur"])
def test_rounding_errors_do_not_change_the_camera_pose(
    name: str, arms: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first of several equally good views is used, independent of the processor."""
    robot = load_robot(str(arms[name]))
    expected = scene_for(robot, upright=name == "planar").pose_world_camera
    visibility = scenes._visibility
    views = itertools.count()

    def disturbed_visibility(*view: Any) -> float:
        return visibility(*view) * (1.0 + 1e-14 * next(views))

    monkeypatch.setattr(scenes, "_visibility", disturbed_visibility)
    pose = scene_for(robot, upright=name == "planar").pose_world_camera
    assert next(views) > 1
    assert max(pose.distance(expected)) < 1e-12


def test_a_tool_hidden_in_a_box_raises_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The box hides the tool at every goal, so fewer goals give the same result in less time.
    monkeypatch.setattr(scenes, "_TRIES", 12)
    file = tmp_path / "boxed.xml"
    file.write_text(
        '<mujoco><worldbody><body><joint name="j" axis="0 0 1" range="-90 90"/>'
        '<geom size=".2" pos=".3 0 0"/><site name="tip" pos=".3 0 0"/></body></worldbody></mujoco>'
    )
    with pytest.raises(CameraError, match=r"'tip'.*hides"):
        scene_for(load_robot(file), upright=True)
