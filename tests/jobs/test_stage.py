"""What stands round a robot: the described stage, and stages made up for arms nobody described."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.tracker import MarkerTracker
from robot_ik.errors import CameraError
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.jobs.scene import Stage, stage_for
from robot_ik.robot import Robot, load_robot


@pytest.fixture(scope="module")
def puma() -> Robot:
    return load_robot("puma560")


def test_the_described_stage(puma: Robot) -> None:
    stage, reach = stage_for(puma), puma.file.reach
    assert reach is not None and not stage.made_up
    np.testing.assert_allclose(stage.pose_world_marker.position, reach.marker.position)
    np.testing.assert_allclose(stage.pose_world_marker.rotation[:, 2], [0, 0, 1], atol=1e-12)
    assert set(stage.cube) == set(reach.tool_marker.ids)
    eye, aim = np.array(reach.camera.position), np.array(reach.camera.look_at)
    axis = (aim - eye) / np.linalg.norm(aim - eye)
    np.testing.assert_allclose(stage.pose_world_camera.rotation[:, 2], axis, atol=1e-12)
    # the wanted tool: above the paper, looking at it
    tool = stage.pose_world_marker.compose(stage.pose_marker_tool)
    np.testing.assert_allclose(tool.position, np.add(reach.marker.position, [0, 0, reach.hover]), atol=1e-12)
    np.testing.assert_allclose(tool.rotation[:, 2], [0, 0, -1], atol=1e-12)


def check_cube(stage: Stage) -> None:
    """Each side looks out of the cube, and its paper does not stick out over the edge."""
    for side, pose in stage.cube.values():
        edge = 2 * np.linalg.norm(pose.position)
        np.testing.assert_allclose(pose.rotation[:, 2], pose.position / (edge / 2), atol=1e-9)
        assert side + 2 * stage.cube_margin <= edge * (1 + 1e-9)
        assert stage.cube_margin > 0.05 * side
    outward = np.array([pose.rotation[:, 2] for _, pose in stage.cube.values()])
    np.testing.assert_allclose(outward.sum(axis=0), 0, atol=1e-9)


def test_the_papers_fit_their_cube(puma: Robot, arms: dict[str, Path]) -> None:
    stage = stage_for(puma)
    check_cube(stage)
    scene = stage.scene(puma)
    for marker in scene.markers:
        if marker.id in stage.cube:
            assert marker.margin == stage.cube_margin and marker.frame == stage.cube_frame
    check_cube(stage_for(load_robot(arms["ur"])))


@pytest.mark.parametrize(("name", "upright"), [("ur", False), ("planar", True), ("desk", True)])
def test_a_made_up_stage_can_be_seen_and_reached(name: str, upright: bool, arms: dict[str, Path]) -> None:
    robot = load_robot(arms[name])
    stage = stage_for(robot, upright=upright)
    assert stage.made_up
    place = stage.pose_world_marker.compose(stage.pose_marker_tool)
    goal = (
        PositionGoal(robot.tool, place.position)
        if upright
        else PoseGoal(robot.tool, position=place.position, wxyz=place.wxyz)
    )
    solution = solve(robot, goal, seed=1)
    assert solution.converged, solution
    assert solution.miss.position < 1e-3
    if upright:
        np.testing.assert_allclose(stage.pose_world_marker.rotation[:, 2], [0, 0, 1])
    ground = 0.0 if stage.table is None else stage.table.height
    assert stage.pose_world_marker.position[2] > ground and stage.pose_world_camera.position[2] > ground
    sides = {stage.marker_id: stage.marker_size} | {i: side for i, (side, _) in stage.cube.items()}
    q = [robot.home]
    frame = SyntheticSource(stage.scene(robot), lambda: q[0], quality="fast").read()
    tracker = MarkerTracker(stage.intrinsics, stage.dictionary, sides)
    assert stage.marker_id in {o.id for o in tracker.observe(frame.without_truth())}


def test_a_stage_is_the_same_each_time(arms: dict[str, Path]) -> None:
    robot = load_robot(arms["planar"])
    assert str(stage_for(robot, upright=True)) == str(stage_for(robot, upright=True))


def test_a_tool_hidden_in_a_box_has_no_stage(tmp_path: Path) -> None:
    file = tmp_path / "boxed.xml"
    file.write_text(
        '<mujoco><worldbody><body><joint name="j" axis="0 0 1" range="-90 90"/>'
        '<geom size=".2" pos=".3 0 0"/><site name="tip" pos=".3 0 0"/></body></worldbody></mujoco>'
    )
    with pytest.raises(CameraError, match=r"'tip'.*hides"):
        stage_for(load_robot(file), upright=True)
