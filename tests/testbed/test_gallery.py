"""Gallery: each picture shows the complete robot, large enough, and in a reached pose."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.studio import SEAMLESS
from robot_ik.errors import ConfigError, ModelError
from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue
from robot_ik.support import supported_frames
from robot_ik.testbed.gallery_scene import gallery_scene
from tests.doc_pages import script

TWO_LINKS = """
<mujoco><worldbody><body><joint name="a" axis="0 -1 0" range="-90 90"/>
  <geom type="capsule" fromto="0 0 0 .4 0 .2" size=".05" rgba=".8 .3 .2 1"/>
  <body pos=".4 0 .2"><joint name="b" axis="0 -1 0" range="-120 120"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04" rgba="{rgba}"/>
    <site name="tip" pos=".34 0 0"/>
</body></body></worldbody></mujoco>
"""


gallery = script("gallery")
HEIGHT = 120
"""Height of a picture, px. Drawing it takes less time than the usual height."""


def two_links(folder: Path, rgba: str = ".2 .4 .8 1") -> Path:
    file = folder / "two_links.xml"
    file.write_text(TWO_LINKS.format(rgba=rgba))
    return file


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_the_pose_of_every_bundled_robot_reaches_its_goals(name: str) -> None:
    robot = load_robot(name)
    scene = gallery_scene(robot)
    assert scene.goals, "a bundled robot needs its own gallery scene"
    floor = float(surface_points(robot.model, robot.qpos(robot.home))[:, 2].min())
    solution = gallery.pose_at_work(robot, scene, floor, seed=0)
    assert solution.converged, solution
    at_work = surface_points(robot.model, robot.qpos(solution.q))
    assert at_work[:, 2].min() > floor - 0.01, "a geom is below the floor"
    # robot.measure computes poses with the forward pass of MuJoCo.
    for frame in supported_frames(robot, scene.goals):
        at_home = robot.measure(robot.home, frame)
        metres, radians = robot.measure(solution.q, frame).distance(at_home)
        assert metres < 1e-4
        assert radians < 1e-3
    displacement = np.abs(at_work - surface_points(robot.model, robot.qpos(robot.home))).max()
    size = np.ptp(at_work, axis=0).max()
    assert displacement > 0.1 * size, "both pictures show almost the same pose"


@pytest.mark.parametrize("name", ["puma560", "seven_segment"])
def test_a_portrait_shows_the_robot_in_two_poses(name: str) -> None:
    portrait = gallery.draw_robot(load_robot(name), height=HEIGHT)
    for photo in portrait.photos:
        share = float(photo.coverage.mean()) / 255
        assert 0.02 < share < 0.6
        rows = photo.coverage[[0, -1]].ravel()
        columns = photo.coverage[:, [0, -1]].ravel()
        assert rows.max() == columns.max() == 0, "the robot is cut off at the border"
        contrast = np.abs(photo.image.astype(float) - 255 * np.array(SEAMLESS.wall)).max(axis=2)
        is_distinct = contrast[photo.coverage > 230] > 12
        assert is_distinct.mean() > 0.95, "robot and wall have the same colour"
    first, second = portrait.photos
    assert np.abs(first.coverage.astype(float) - second.coverage).mean() > 2.5
    height, width = portrait.image.shape[:2]
    left, right = portrait.pair
    assert width == left.shape[1] + right.shape[1] + 2
    assert height > left.shape[0]


def test_the_seed_determines_the_pose(tmp_path: Path) -> None:
    robot = load_robot(two_links(tmp_path))
    first = gallery.draw_robot(robot, 1, HEIGHT)
    repeated = gallery.draw_robot(robot, 1, HEIGHT)
    other = gallery.draw_robot(robot, 2, HEIGHT)
    assert np.array_equal(first.image, repeated.image)
    assert not np.array_equal(first.solution.q, other.solution.q)
    assert first.solution.converged
    assert other.solution.converged


def test_a_model_without_visible_geoms_raises_an_error(tmp_path: Path) -> None:
    file = two_links(tmp_path)
    file.write_text(file.read_text().replace("<geom", '<geom group="4"'))
    with pytest.raises(ModelError, match="no visible geom"):
        gallery.draw_robot(load_robot(file), height=60)


def test_the_gallery_script_writes_a_picture_and_a_contact_sheet(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "pictures"
    assert gallery.main([str(two_links(tmp_path)), "--out", str(folder)]) == 0
    for path in (folder / "two_links.png", folder / "gallery.png"):
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.std() > 5


def test_an_unreachable_goal_is_reported_and_the_picture_is_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two_links(tmp_path)
    (tmp_path / "robot.toml").write_text(
        'schema = 1\ntitle = "two"\nmodel = "two_links.xml"\n'
        "[gallery]\ngoals = { tip = [9.0, 0.0, 0.0] }\n"
    )
    assert gallery.main([str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "UNREACHABLE" in capsys.readouterr().out
    assert (tmp_path / "out" / "gallery.png").is_file()


def test_a_goal_with_two_numbers_is_rejected(tmp_path: Path) -> None:
    two_links(tmp_path)
    (tmp_path / "robot.toml").write_text(
        'schema = 1\ntitle = "two"\nmodel = "two_links.xml"\n'
        "[gallery]\ngoals = { tip = [1.0, 2.0] }\n"
    )
    robot = load_robot(tmp_path)
    with pytest.raises(ConfigError, match=r"robot\.toml: gallery\.goals"):
        gallery_scene(robot)


def test_a_contact_sheet_has_little_empty_space(tmp_path: Path) -> None:
    portrait = gallery.draw_robot(load_robot(two_links(tmp_path)), height=60)
    for count in (1, 2, 5, 9):
        sheet = gallery.contact_sheet([portrait] * count)
        white = (sheet == 255).all(axis=2).mean()
        assert white < (0.75 if count == 1 else 0.3)
