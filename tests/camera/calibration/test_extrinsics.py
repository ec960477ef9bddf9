"""Where a camera is: found from a board, kept in a file that belongs to one calibration."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics, locate_camera, today
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.target_files import parse_target
from robot_ik.camera.targets import (
    MarkerTarget,
    Observation,
    PatternTarget,
    marker_grid,
    marker_points,
)
from robot_ik.errors import CalibrationError, CameraError
from robot_ik.geometry import Pose, rotation_exp

LAYOUT = marker_grid(3, 2, 0.05, 0.0125).markers
POINTS = np.concatenate([pose.apply(marker_points(side)) for side, pose in LAYOUT.values()])
BOARD = Pose((0.4, -0.1, 0.02), rotation_exp([0.0, 0.0, 0.7]))
SEEN = Pose((0.03, -0.02, 0.7), (0, 1, 0, 0)).compose(Pose(wxyz=rotation_exp([0.5, -0.3, 0.2])))


def observed(rng: np.random.Generator, noise: float = 0.1) -> Observation:
    """One frame of the board."""
    pixels = STANDARD_CAMERA.project(SEEN.apply(POINTS)) + rng.normal(0, noise, (len(POINTS), 2))
    return Observation(POINTS, pixels, SEEN.compose(Pose().plus(rng.normal(0, 2e-3, 6))), 0.1)


def extrinsics_of(pose: Pose, covariance: np.ndarray) -> CameraExtrinsics:
    return CameraExtrinsics(pose, "world", covariance, 0.12, 0.2, today(), STANDARD_CAMERA.digest)


@settings(max_examples=10)
@given(
    twist=st.lists(st.floats(-3, 3), min_size=6, max_size=6),
    parent=st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=12),
)
def test_the_written_file_is_read_back(
    twist: list[float], parent: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("place") / "place.toml"
    extrinsics = dataclasses.replace(
        extrinsics_of(Pose().plus(twist), np.diag(np.arange(6.0)) * 1e-7), parent=parent
    )
    extrinsics.save(path)
    read = CameraExtrinsics.load(path, STANDARD_CAMERA)
    np.testing.assert_array_equal(
        read.pose_parent_camera.position, extrinsics.pose_parent_camera.position
    )
    assert max(read.pose_parent_camera.distance(extrinsics.pose_parent_camera)) < 1e-15
    np.testing.assert_array_equal(read.covariance, extrinsics.covariance)
    assert (read.parent, read.date, read.residual_px, read.views) == (parent, today(), 0.12, 1)
    assert "OpenCV" in path.read_text(encoding="utf-8")


def test_it_belongs_to_one_calibration_and_one_parent(tmp_path: Path) -> None:
    path = tmp_path / "place.toml"
    extrinsics_of(Pose(), np.eye(6)).save(path)
    other = dataclasses.replace(STANDARD_CAMERA, fx=801.0)
    with pytest.raises(CalibrationError, match="another calibration") as refused:
        CameraExtrinsics.load(path, other)
    assert STANDARD_CAMERA.digest in str(refused.value) and other.digest in str(refused.value)
    with pytest.raises(CalibrationError, match="'world'"):
        CameraExtrinsics.load(path).require_parent("gripper")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("parent = [", "not valid TOML"),
        ("parent = 'world'", "position: this key is missing"),
        (None, "cannot be read"),
        ("wxyz", "wxyz: a zero quaternion"),
        ("schema = 2", "schema: 2 is not right; allowed: 1"),
        ("covariance", "covariance"),
    ],
)
def test_a_wrong_file_is_reported_in_one_sentence(
    tmp_path: Path, text: str | None, words: str
) -> None:
    path = tmp_path / "place.toml"
    extrinsics_of(Pose(), np.eye(6)).save(path)
    good = path.read_text()
    if text is None:
        path.unlink()
    elif text == "wxyz":
        path.write_text(good.replace("wxyz = [1.0, 0.0, 0.0, 0.0]", "wxyz = [0, 0, 0, 0]"))
    elif text == "schema = 2":
        path.write_text(good.replace("schema = 1", text))
    elif text == "covariance":
        path.write_text(good.replace("  [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],\n", ""))
    else:
        path.write_text(text)
    with pytest.raises(CalibrationError, match=words):
        CameraExtrinsics.load(path)


def test_a_camera_is_located_with_a_consistent_uncertainty() -> None:
    true = BOARD.compose(SEEN.inverse())
    errors = []
    stated = []
    for seed in range(12):
        extrinsics = locate_camera([observed(np.random.default_rng(seed))], BOARD, STANDARD_CAMERA)
        errors.append(extrinsics.pose_parent_camera.distance(true))
        stated.append((extrinsics.sigma_position, extrinsics.sigma_angle))
    errors_rms, stated_rms = (np.sqrt(np.mean(np.square(v), axis=0)) for v in (errors, stated))
    assert errors_rms[0] < 2e-3 and errors_rms[1] < np.deg2rad(0.25)
    assert (errors_rms < 2 * stated_rms).all() and (stated_rms < 2 * errors_rms).all()
    assert 0.05 < extrinsics.residual_px < 0.2
    assert extrinsics.residual_mm == pytest.approx(
        1e3 * extrinsics.residual_px * 0.7 / 800, rel=0.1
    )


def test_frames_are_averaged_even_with_a_hand_before_the_board() -> None:
    true = BOARD.compose(SEEN.inverse())
    rng = np.random.default_rng(1)
    views = [observed(rng) for _ in range(9)]
    single = locate_camera(views[:1], BOARD, STANDARD_CAMERA)
    spoilt = Observation(POINTS, views[0].pixels + 25.0, SEEN.compose(Pose((0.05, 0.0, 0.1))), 0.1)
    part = Observation(POINTS[:8], views[1].pixels[:8], SEEN, 0.1)
    many = locate_camera([*views, spoilt, part], BOARD, STANDARD_CAMERA)
    assert many.residual_px < 0.6 * single.residual_px and many.views == 11
    assert many.pose_parent_camera.distance(true)[0] < 5e-4
    with pytest.raises(CameraError, match="no picture"):
        locate_camera([], BOARD, STANDARD_CAMERA)


def test_markers_are_seen_in_a_picture_as_a_board() -> None:
    markers = {id: (side, SEEN.compose(pose)) for id, (side, pose) in LAYOUT.items()}
    rng = np.random.default_rng(0)
    image = render_markers(STANDARD_CAMERA, markers, rng, dictionary="DICT_5X5_50", margin=0.12)
    frame = Frame(np.repeat(image[:, :, None], 3, axis=2), 0.0, 0)
    board = parse_target("grid:3x2:50:12.5")
    assert isinstance(board, MarkerTarget)
    view = board.find(frame, STANDARD_CAMERA)
    assert view is not None and len(view.points) == 24
    extrinsics = locate_camera([view], BOARD, STANDARD_CAMERA)
    assert extrinsics.pose_parent_camera.distance(BOARD.compose(SEEN.inverse()))[0] < 1e-3
    assert marker_grid(1, 1, 0.05, 0.01, 40).find(frame, STANDARD_CAMERA) is None


@pytest.mark.parametrize("text", ["charuco:7x5:30:22", "chessboard:7x5:30"])
def test_patterns_are_seen_with_their_frame_in_the_corner(text: str) -> None:
    board = parse_target(text)
    assert isinstance(board, PatternTarget)
    # The whole of it in view: x right, y down, z away from the camera.
    turn = Pose(wxyz=rotation_exp([0.4, -0.3, 0.1]))
    pose = Pose((-0.1, -0.06, 0.5), turn.wxyz)
    frame = pattern_frame(board, pose)
    view = board.find(frame, STANDARD_CAMERA)
    assert view is not None
    position, angle = view.pose.distance(pose)
    assert position < 2e-3 and angle < np.deg2rad(0.5)
    (side, square), *_ = board.squares.values()
    assert square.rotation[2, 2] == pytest.approx(-1.0) and side > 0.1
    assert board.find(Frame(np.zeros((480, 640, 3), np.uint8), 0.0, 0), STANDARD_CAMERA) is None


def pattern_frame(board: PatternTarget, pose: Pose) -> Frame:
    """A picture of the pattern at ``pose_camera_board``."""
    from robot_ik.camera.synthetic.pictures import render_pattern

    image = render_pattern(board.pattern, STANDARD_CAMERA, pose, np.random.default_rng(0))
    return Frame(image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2), 0.0, 0)


@pytest.mark.parametrize(
    "text", ["", "marker:7", "grid:3x:50:12", "marker:x:50", "grid:3x2:-50:12", "cube"]
)
def test_a_meaningless_board_is_rejected(text: str) -> None:
    with pytest.raises(CameraError, match="is not a board") as refused:
        parse_target(text)
    assert "charuco:COLUMNSxROWS" in refused.value.hint


def test_metres_in_the_text_of_a_board_are_reported() -> None:
    with pytest.raises(CameraError, match=r"0\.05 mm is too small for a board") as refused:
        parse_target("grid:2x2:0.05:0.0125")
    assert "0.05 m are 50" in refused.value.hint


@pytest.mark.parametrize("text", ["charuco:8x6:2000:22", "chessboard:9x6:2000"])
def test_an_impossible_pattern_is_rejected_in_millimetres(text: str) -> None:
    """It was said to have squares of 2 m, which were to be 2 mm."""
    with pytest.raises(CameraError, match="a square of 2000 mm is not possible") as refused:
        parse_target(text)
    assert refused.value.hint == "give 1 to 1000 mm"


def test_a_body_is_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "bodies.toml"
    body_text = '[[body]]\nname = "{name}"\nmarkers = [{{ id = {id}, size = 0.04 }}]\n'
    path.write_text(body_text.format(name="hand", id=3))
    board = parse_target(str(path), "DICT_4X4_50")
    assert (
        isinstance(board, MarkerTarget)
        and set(board.squares) == {3}
        and board.dictionary == "DICT_4X4_50"
    )
    path.write_text(body_text.format(name="hand", id=3) + body_text.format(name="table", id=4))
    assert set(parse_target(f"{path}:table").squares) == {4}
    with pytest.raises(CameraError, match="several bodies") as refused:
        parse_target(str(path))
    assert f"{path}:table" in refused.value.hint


def test_a_film_of_a_moving_board_gives_no_camera_pose() -> None:
    """It gave one, 3 µm well known, beside residuals of 58 px."""
    rng = np.random.default_rng(8)
    moving = []
    for k in range(6):
        pose = Pose((0.04 * k - 0.1, 0.0, 0.0)).compose(SEEN)
        pixels = STANDARD_CAMERA.project(pose.apply(POINTS)) + rng.normal(0, 0.1, (len(POINTS), 2))
        moving.append(Observation(POINTS, pixels, pose, 0.1))
    with pytest.raises(CalibrationError, match=r"move by .* px between the pictures") as refused:
        locate_camera(moving, BOARD, STANDARD_CAMERA)
    assert "handeye" in str(refused.value.hint)


def test_a_board_with_wrong_sizes_gives_no_camera_pose() -> None:
    """Gaps twice as wide as the layout says: no pose meets the corners."""
    printed = marker_grid(3, 2, 0.05, 0.03).markers
    points = np.concatenate([pose.apply(marker_points(side)) for side, pose in printed.values()])
    view = Observation(POINTS, STANDARD_CAMERA.project(SEEN.apply(points)), SEEN, 0.1)
    with pytest.raises(CalibrationError, match="median reprojection error"):
        locate_camera([view], BOARD, STANDARD_CAMERA)


def test_wrong_corners_count_less_even_where_the_plain_fit_was_the_start() -> None:
    view = observed(np.random.default_rng(3))
    pixels = view.pixels.copy()
    pixels[5] += (4.0, -3.0)
    lens = np.array(STANDARD_CAMERA.distortion)
    _, vector, shift = cv2.solvePnP(POINTS, pixels, STANDARD_CAMERA.matrix, lens)
    vector, shift = cv2.solvePnPRefineLM(
        POINTS, pixels, STANDARD_CAMERA.matrix, lens, vector, shift
    )
    plain = Pose.from_rotation(cv2.Rodrigues(vector)[0], shift.ravel())
    one, other = (
        locate_camera([Observation(POINTS, pixels, pose, view.sigma)], BOARD, STANDARD_CAMERA)
        for pose in (view.pose, plain)
    )
    moved, turned = one.pose_parent_camera.distance(other.pose_parent_camera)
    assert moved < 1e-6 and turned < 1e-6
    assert one.pose_parent_camera.distance(BOARD.compose(plain.inverse()))[0] > 1e-4
