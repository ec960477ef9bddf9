"""The gallery: every robot is seen, whole and large enough, and does in its picture what it is said to do."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.studio import SEAMLESS
from robot_ik.errors import ConfigError, ModelError
from robot_ik.jobs import gallery
from robot_ik.jobs.gallery import (
    contact_sheet,
    draw_gallery,
    draw_robot,
    fitted_camera,
    lens,
    pose_at_work,
)
from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue
from robot_ik.support import supported_frames
from robot_ik.testbed.gallery_scene import gallery_scene
from tests.doc_pages import script

TWO_LINKS = """
<mujoco><worldbody><body><joint name="a" axis="0 -1 0" range="-90 90"/>
  <geom type="capsule" fromto="0 0 0 .4 0 .2" size=".05" rgba=".8 .3 .2 1"/>
  <body pos=".4 0 .2"><joint name="b" axis="0 -1 0" range="-120 120"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04" rgba="{rgba}"/><site name="tip" pos=".34 0 0"/>
</body></body></worldbody></mujoco>
"""


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gallery, "HEIGHT", 120)


def two_links(folder: Path, rgba: str = ".2 .4 .8 1") -> Path:
    file = folder / "two_links.xml"
    file.write_text(TWO_LINKS.format(rgba=rgba))
    return file


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_every_robot_does_what_its_picture_says(name: str) -> None:
    robot = load_robot(name)
    scene = gallery_scene(robot)
    assert scene.goals, "a robot that ships has a scene of its own"
    floor = float(surface_points(robot.model, robot.qpos(robot.home))[:, 2].min())
    solution = pose_at_work(robot, scene, floor, seed=0)
    assert solution.converged, solution
    at_work = surface_points(robot.model, robot.qpos(solution.q))
    assert at_work[:, 2].min() > floor - 0.01, "through the floor"
    for frame in supported_frames(robot, scene.goals):  # by MuJoCo's own forward pass
        metres, radians = robot.measure(solution.q, frame).distance(robot.measure(robot.home, frame))
        assert metres < 1e-4 and radians < 1e-3
    moved = np.abs(at_work - surface_points(robot.model, robot.qpos(robot.home))).max()
    assert moved > 0.1 * np.ptp(at_work, axis=0).max(), "two pictures of the same"


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    st.tuples(st.floats(-180, 180), st.floats(-60, 80)),
    st.integers(0, 2**32 - 1),
    st.floats(0.05, 5.0),
)
def test_a_fitted_camera_sees_all_and_as_large_as_can_be(
    view: tuple[float, float], seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * size * rng.uniform(0.2, 1.0, 3) + rng.normal(size=3) * 3
    optics = lens(320, 200)
    camera = fitted_camera(points, view, optics)
    pixels = optics.project(camera.inverse().apply(points))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    assert (low > 0).all() and (high < np.array(optics.size) - 1).all()
    assert ((high - low) / np.array(optics.size)).max() > 0.8
    assert np.abs((low + high) / 2 - np.array([optics.cx, optics.cy])).max() < 4


@pytest.mark.parametrize("name", ["puma560", "seven_segment"])
def test_a_portrait_shows_the_robot_twice(name: str) -> None:
    portrait = draw_robot(load_robot(name))
    for photo in portrait.photos:
        share = float(photo.coverage.mean()) / 255
        assert 0.02 < share < 0.6
        edge = np.concatenate([photo.coverage[[0, -1]].ravel(), photo.coverage[:, [0, -1]].ravel()])
        assert edge.max() == 0, "cut off"
        seen = np.abs(photo.image.astype(float) - 255 * np.array(SEAMLESS.wall)).max(axis=2) > 12
        assert seen[photo.coverage > 230].mean() > 0.95, "robot and wall look the same"
    first, second = portrait.photos
    assert np.abs(first.coverage.astype(float) - second.coverage).mean() > 2.5
    whole, (left, right) = portrait.image.shape, portrait.pair
    assert whole[1] == left.shape[1] + right.shape[1] + 2 and whole[0] > left.shape[0]


def test_the_same_seed_draws_the_same_and_another_seed_another_pose(tmp_path: Path) -> None:
    robot = load_robot(two_links(tmp_path))
    one, again, other = (draw_robot(robot, seed) for seed in (1, 1, 2))
    assert np.array_equal(one.image, again.image)
    assert not np.array_equal(one.solution.q, other.solution.q)
    assert one.solution.converged and other.solution.converged


def test_a_model_without_anything_to_see_says_so(tmp_path: Path) -> None:
    file = two_links(tmp_path)
    file.write_text(file.read_text().replace("<geom", '<geom group="4"'))
    with pytest.raises(ModelError, match="no visible geom"):
        draw_robot(load_robot(file), height=60)


def test_the_script_leaves_a_picture_and_a_sheet(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "pictures"
    assert script("gallery").main([str(two_links(tmp_path)), "--out", str(folder)]) == 0
    for path in (folder / "two_links.png", folder / "gallery.png"):
        picture = cv2.imread(str(path))
        assert picture is not None and picture.std() > 5


def test_a_pose_that_is_not_reached_is_drawn_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two_links(tmp_path)
    (tmp_path / "robot.toml").write_text(
        'schema = 1\ntitle = "two"\nmodel = "two_links.xml"\n[gallery]\ngoals = { tip = [9.0, 0.0, 0.0] }\n'
    )
    assert script("gallery").main([str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "UNREACHABLE" in capsys.readouterr().out
    assert (tmp_path / "out" / "gallery.png").is_file()


def test_a_goal_of_a_scene_has_three_numbers_or_seven(tmp_path: Path) -> None:
    two_links(tmp_path)
    text = 'schema = 1\ntitle = "two"\nmodel = "two_links.xml"\n[gallery]\ngoals = {{ tip = {} }}\n'
    (tmp_path / "robot.toml").write_text(text.format("[1.0, 2.0]"))
    robot = load_robot(tmp_path)
    with pytest.raises(ConfigError, match=r"robot\.toml: gallery\.goals"):
        gallery_scene(robot)


def test_a_sheet_shows_every_robot_in_full_rows(tmp_path: Path) -> None:
    portrait = draw_robot(load_robot(two_links(tmp_path)), height=60)
    for count in (1, 2, 5, 9):
        sheet = contact_sheet([portrait] * count)
        white = (sheet == 255).all(axis=2).mean()
        assert white < (0.75 if count == 1 else 0.3)
    reported: list[str] = []
    robots = [load_robot(two_links(tmp_path))]
    draw_gallery(robots, tmp_path, progress=lambda name, share: reported.append(f"{share:g} {name}"))
    assert reported == ["0 two_links"]
