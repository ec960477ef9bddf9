"""The robot drawn over a picture, and the drawings on top of it."""

from collections.abc import Callable

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.camera.drawing import overlay, text
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CalibrationError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.robot import load_robot

LENS = CameraIntrinsics(640, 480, 612.0, 605.0, 331.3, 228.9, (-0.28, 0.09, 0.001, -0.0007, 0.0))


def test_nothing_is_drawn_of_what_is_behind_the_camera(
    model_of: Callable[..., mujoco.MjModel],
) -> None:
    picture = np.full((480, 640, 3), 77, np.uint8)
    model = model_of("<geom type='box' size='.1 .2 .15' pos='0 0 -1'/>")
    for style in ("solid", "outline", "registered"):
        assert (overlay.draw_robot(picture, model, [], LENS, Pose(), style=style) == picture).all()


@settings(max_examples=10)
@given(st.tuples(*[st.floats(-0.8, 0.8)] * 3), st.tuples(*[st.floats(-3, 3)] * 3))
def test_a_camera_at_any_pose_even_inside_the_robot_draws_without_error(
    place: tuple[float, float, float], turn: tuple[float, float, float]
) -> None:
    robot = load_robot("puma560")
    camera = Pose((place[0], place[1], place[2] + 0.6), rotation_exp(turn))
    picture = np.zeros((480, 640, 3), np.uint8)
    drawn = overlay.draw_robot(
        picture, robot.model, robot.qpos(robot.home), LENS, camera, style="registered"
    )
    assert drawn.shape == picture.shape


def test_styles_and_blending(model_of: Callable[..., mujoco.MjModel]) -> None:
    picture = np.full((480, 640, 3), 100, np.uint8)
    model = model_of("<geom type='box' size='.1 .1 .1' pos='0 0 1' rgba='1 0 0 1'/>")
    clear = overlay.draw_robot(picture, model, [], LENS, Pose(), alpha=0.0)
    half = overlay.draw_robot(picture, model, [], LENS, Pose(), alpha=0.5)
    full = overlay.draw_robot(picture, model, [], LENS, Pose(), alpha=1.0)
    x, y = (int(v) for v in np.rint(LENS.project([0.0, 0.0, 0.9])))
    assert (picture == 100).all(), "the picture handed in must not change"
    assert (clear == 100).all()
    assert full[y, x, :2].max() < 10 and full[y, x, 2] > 80
    assert np.abs(half[y, x].astype(int) - (full[y, x].astype(int) + 100) / 2).max() <= 1
    tinted = overlay.draw_robot(picture, model, [], LENS, Pose(), alpha=1.0, tint=(200, 0, 0))
    assert tinted[y, x, 0] > 80 and tinted[y, x, 2] < 10
    lines = overlay.draw_robot(
        picture, model, [], LENS, Pose(), style="outline", line_colour=(0, 255, 0)
    )
    assert (lines[y, x] == 100).all() and (lines[..., 1] > 200).any()


def test_hidden_lines_are_left_out(model_of: Callable[..., mujoco.MjModel]) -> None:
    wall = "<geom type='box' size='.3 .3 .01' pos='0 0 .8'/>"
    picture = np.zeros((480, 640, 3), np.uint8)
    wall_only = overlay.draw_robot(picture, model_of(wall), [], LENS, Pose(), style="outline")
    hiding = model_of(wall + "<geom type='box' size='.1 .1 .1' pos='0 0 1.2'/>")
    assert (
        overlay.draw_robot(picture, hiding, [], LENS, Pose(), style="outline") == wall_only
    ).all()


def test_wrong_picture_size_and_style_are_refused(model_of: Callable[..., mujoco.MjModel]) -> None:
    model = model_of("<geom type='sphere' size='.1' pos='0 0 1'/>")
    with pytest.raises(CalibrationError, match="640x480"):
        overlay.draw_robot(np.zeros((100, 100, 3), np.uint8), model, [], LENS, Pose())
    with pytest.raises(ValueError, match="outline"):
        overlay.draw_robot(np.zeros((480, 640, 3), np.uint8), model, [], LENS, Pose(), style="wire")  # type: ignore[arg-type]


def test_axes_end_where_opencv_says() -> None:
    pose = Pose((0.1, -0.05, 0.9), rotation_exp([0.4, 2.5, 0.2]))
    picture = overlay.draw_axes(np.full((480, 640, 3), 128, np.uint8), pose, 0.15, LENS)
    tips = np.eye(3) * 0.14
    rotation = cv2.Rodrigues(pose.rotation)[0]
    pixels = cv2.projectPoints(
        tips, rotation, pose.position, LENS.matrix, np.array(LENS.distortion)
    )[0].reshape(-1, 2)
    for k, (x, y) in enumerate(np.rint(pixels).astype(int)):
        assert int(np.argmax(picture[y, x])) == 2 - k, "x red, y green, z blue"


def test_axes_behind_the_camera_are_left_out() -> None:
    picture = np.full((480, 640, 3), 128, np.uint8)
    assert (overlay.draw_axes(picture, Pose((0, 0, -1)), 0.2, LENS, label="x") == picture).all()
    assert (overlay.draw_axes(picture, Pose((0, 0, 0.5)), 0.2, LENS) != picture).any()


@given(st.floats(-500, 2000), st.floats(-500, 2000), st.text("abc \n°µ→", min_size=1, max_size=40))
@settings(max_examples=12)
def test_a_label_stays_in_the_picture(x: float, y: float, caption: str) -> None:
    picture = np.full((200, 700, 3), 250, np.uint8)
    drawn = overlay.put_label(picture, caption, (x, y), accent=overlay.GREEN)
    assert drawn.shape == picture.shape
    assert (drawn < 120).any(), "the card is there"


def test_labels_are_written_with_the_stroke_font_where_there_is_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(cv2, "FontFace", raising=False)
    text._outline_font.cache_clear()
    try:
        drawn = overlay.put_label(np.full((100, 400, 3), 250, np.uint8), "3.2 µm ± 0.1°", (20, 50))
        assert (drawn > 200).any()
        assert text.text_size("wide text", 20)[0] > text.text_size("w", 20)[0] > 0
    finally:
        text._outline_font.cache_clear()


def test_marker_outline_follows_its_corners() -> None:
    corners = np.array([[100.0, 100], [180, 110], [170, 190], [95, 180]])
    drawn = overlay.draw_marker_outline(np.zeros((300, 300, 3), np.uint8), corners, label="7")
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        x, y = np.rint((a + b) / 2).astype(int)
        assert drawn[y - 1 : y + 2, x - 1 : x + 2, 1].max() > 150


def test_before_and_after_are_shown_side_by_side() -> None:
    left = np.full((90, 160, 3), 10, np.uint8)
    right = np.full((180, 320, 3), 200, np.uint8)
    accents = (overlay.ORANGE, overlay.GREEN)
    sheet = overlay.before_after(
        left, right, ("Before\nfar", "After\nnear"), title="T", footer="f", accents=accents
    )
    assert sheet.shape[1] == 2 * 960 + 2 * 28 + 20
    half = sheet.shape[1] // 2
    assert (sheet[:, :half] == 10).all(axis=2).sum() > 960 * 530
    assert (sheet[:, half:] == 200).all(axis=2).sum() > 960 * 530
