"""``robot-ik camera detect`` on pictures with known content, and on nothing of use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, STANDARD_SIZE, render_markers
from robot_ik.camera.targets import marker_grid, marker_points
from robot_ik.geometry import Pose, quat_multiply, rotation_exp

FACING = np.array([0.0, 1.0, 0.0, 0.0])
BOARD = marker_grid(2, 2, STANDARD_SIZE, 0.012, first_id=3)
TRUE = Pose((0.01, -0.02, 0.5), quat_multiply(FACING, rotation_exp([0.5, 0.2, 0.1])))


def board_picture(pose: Pose, seed: int = 0) -> np.ndarray:
    markers = {i: (size, pose.compose(p)) for i, (size, p) in BOARD.markers.items()}
    rng = np.random.default_rng(seed)
    return render_markers(STANDARD_CAMERA, markers, rng, dictionary="DICT_5X5_50", margin=0.24)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a board's picture, its calibration and its description."""
    folder = tmp_path_factory.mktemp("seen")
    cv2.imwrite(str(folder / "board.png"), board_picture(TRUE))
    STANDARD_CAMERA.save(folder / "camera.yaml")
    rows = [
        f"{{id = {i}, size = {size}, position = {p.position.tolist()}}}"
        for i, (size, p) in BOARD.markers.items()
    ]
    (folder / "bodies.toml").write_text(
        f'[[body]]\nname = "board"\nmarkers = [{", ".join(rows)}]\n'
    )
    return folder


def test_poses_of_markers_and_bodies_as_json(robot_ik: Any, place: Path, tmp_path: Path) -> None:
    run = robot_ik(
        "camera",
        "detect",
        place / "board.png",
        "--intrinsics",
        place / "camera.yaml",
        "--bodies",
        place / "bodies.toml",
        "--json",
        "--draw",
        tmp_path / "drawn",
    )
    assert run.code == 0 and run.err == f"wrote 1 drawing to {tmp_path / 'drawn'}\n", run
    facts = json.loads(run.out)
    (image,) = facts["images"]
    assert (facts["schema"], image["width"], image["height"]) == (1, 640, 480)
    assert image["file"] == str(place / "board.png")
    assert [m["id"] for m in image["markers"]] == [3, 4, 5, 6]
    for marker in image["markers"]:
        size, pose = BOARD.markers[marker["id"]]
        true = TRUE.compose(pose)
        corners = STANDARD_CAMERA.project(true.apply(marker_points(size)))
        assert np.array(marker["corners"]) == pytest.approx(corners, abs=0.15)
        assert np.shape(marker["covariance"]) == (6, 6)
        assert 0.0 <= marker["ambiguity"] < 0.6 and marker["reprojection_error"] < 0.1
        off = Pose(marker["pose"]["position"], marker["pose"]["wxyz"]).distance(true)
        assert off[0] < 1e-3 and off[1] < np.deg2rad(1)
    (body,) = image["bodies"]
    assert (body["name"], body["ids"], body["rejected"]) == ("board", [3, 4, 5, 6], [])
    off = Pose(body["pose"]["position"], body["pose"]["wxyz"]).distance(TRUE)
    assert off[0] < 0.2e-3 and off[1] < np.deg2rad(0.2)
    drawn = cv2.imread(str(tmp_path / "drawn" / "board.png"))
    plain = cv2.imread(str(place / "board.png"))
    assert drawn.shape == plain.shape and (drawn != plain).any(axis=2).mean() > 0.005


def test_a_readable_table_and_only_the_listed_ids(robot_ik: Any, place: Path) -> None:
    run = robot_ik(
        "camera",
        "detect",
        place / "board.png",
        "--intrinsics",
        place / "camera.yaml",
        "--marker-size",
        STANDARD_SIZE,
        "--id",
        5,
        3,
    )
    assert run.code == 0
    _, head, *rows = run.out.splitlines()
    assert head.split() == ["picture", "id", "position,", "m", "tilt", "error", "guity", "sigma"]
    assert [row.split()[:2] for row in rows] == [["board.png", "3"], ["board.png", "5"]]
    assert max(map(len, rows)) <= 80


def test_without_a_calibration_only_corners_are_printed_with_a_note(
    robot_ik: Any, place: Path
) -> None:
    run = robot_ik("camera", "detect", place / "board.png", "--json")
    assert run.code == 0 and "corners only" in run.err
    marker = json.loads(run.out)["images"][0]["markers"][0]
    assert set(marker) == {"id", "corners", "corner_sigma", "refined"}


def test_films_and_folders_picture_by_picture(robot_ik: Any, tmp_path: Path) -> None:
    film = tmp_path / "film.avi"
    folder = tmp_path / "folder"
    folder.mkdir()
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (640, 480))
    for k in range(4):
        pose = Pose(TRUE.position + np.array([0.004 * k, 0.0, 0.0]), TRUE.wxyz)
        gray = board_picture(pose, k) if k != 2 else np.full((480, 640), 128, np.uint8)
        colour = np.repeat(gray[:, :, None], 3, axis=2)
        writer.write(colour)
        cv2.imwrite(str(folder / f"view{k}.png"), colour)
    writer.release()
    run = robot_ik("camera", "detect", film, folder, "--json", "--draw", tmp_path / "drawn")
    images = json.loads(run.out)["images"]
    assert run.code == 0
    assert [i["frame"] for i in images] == [0, 1, 2, 3] * 2
    assert [Path(i["file"]).name for i in images[3:6]] == ["film.avi", "view0.png", "view1.png"]
    assert [len(i["markers"]) for i in images] == [4, 4, 0, 4] * 2
    table = robot_ik("camera", "detect", film, folder).out
    assert "film.avi #0" in table and "film.avi #3" in table and "view3.png #" not in table
    assert (tmp_path / "drawn" / "film-00003.png").exists() and (
        tmp_path / "drawn" / "view3.png"
    ).exists()


def test_a_picture_that_cannot_be_used_is_named_and_the_others_are_done(
    robot_ik: Any, place: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "mixed"
    folder.mkdir()
    (folder / "a.png").write_text("no picture")  # the first one, too
    (folder / "c.jpg").write_bytes(b"")
    for name in ("b.png", "d.png"):
        (folder / name).write_bytes((place / "board.png").read_bytes())
    cv2.imwrite(str(folder / "e.png"), np.full((240, 320), 128, np.uint8))
    options = ("--intrinsics", place / "camera.yaml", "--marker-size", STANDARD_SIZE)
    run = robot_ik("camera", "detect", folder, tmp_path / "gone.png", *options, "--json")
    assert run.code == 1
    assert "4 of 6 pictures could not be searched" in run.err
    for words in (
        "a.png is not a picture",
        "c.jpg is not a picture",
        "e.png: the calibration is for 640x480",
    ):
        assert words in run.err
    images = {Path(one["file"]).name: one for one in json.loads(run.out)["images"]}
    assert list(images) == ["a.png", "b.png", "c.jpg", "d.png", "e.png", "gone.png"]
    assert [name for name, one in images.items() if "error" in one] == [
        "a.png",
        "c.jpg",
        "e.png",
        "gone.png",
    ]
    assert "is not a picture" in images["a.png"]["error"] and images["a.png"]["markers"] == []
    assert [m["id"] for m in images["d.png"]["markers"]] == [3, 4, 5, 6] and images["d.png"][
        "frame"
    ] == 3
    # No picture is usable, so there is no report.
    for name in ("b.png", "d.png"):
        (folder / name).unlink()
    run = robot_ik("camera", "detect", folder, *options)
    run.assert_one_screen_error()
    assert "a.png is not a picture" in run.err and "2 other files cannot be used either" in run.err


def test_no_marker_is_exit_code_1(robot_ik: Any, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((480, 640), 128, np.uint8))
    run = robot_ik("camera", "detect", tmp_path / "grey.png", "--id", 4)
    assert run.code == 1 and run.out == ""
    assert "none of the ids 4 of DICT_5X5_50 in 1 picture" in run.err
    assert "large, sharp, and has white paper" in run.err


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        (("--dictionary", "DICT_6X6_250"), "--dictionary DICT_5X5_50"),
        (("--id", 9), "omit --id to see which"),
    ],
)
def test_markers_of_another_kind_are_named(
    robot_ik: Any, place: Path, options: Any, hint: str
) -> None:
    run = robot_ik("camera", "detect", place / "board.png", *options)
    assert run.code == 1 and run.out == ""
    assert hint in run.err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "no picture is given"),
        (("missing.png",), "there is no camera, file or folder 'missing.png'"),
        (("{}/bodies.toml",), "is not a picture that OpenCV can read"),
        (("{}/board.png", "--dictionary", "DICT_5X5"), "did you mean 'DICT_5X5_50'"),
        (("{}/board.png", "--id", "50"), "DICT_5X5_50 has no marker 50"),
        (("{}/board.png", "--intrinsics", "{}/camera.yaml"), "a pose needs the size of the marker"),
        (
            ("{}/board.png", "--intrinsics", "{}/camera.yaml", "--marker-size", "50"),
            "50 mm are 0.05",
        ),
        (("{}/board.png", "--marker-size", "-1"), "a marker size of -1.0 m is impossible"),
        (("{}/board.png", "--bodies", "{}/bodies.toml"), "needs the camera's intrinsics"),
        (("{}/board.png", "--intrinsics", "{}/none.yaml", "--marker-size", "0.05"), "none.yaml"),
        (("{}/board.png", "--bodies", "{}/camera.yaml"), "camera.yaml: not valid TOML"),
        (
            (
                "{}/board.png",
                "--bodies",
                "{}/bodies.toml",
                "--intrinsics",
                "{}/camera.yaml",
                "--id",
                "9",
            ),
            "the size of marker 9 is unknown",
        ),
    ],
)
def test_an_impossible_request_is_one_sentence(
    robot_ik: Any, place: Path, arguments: tuple[str, ...], text: str
) -> None:
    run = robot_ik("camera", "detect", *(a.format(place) for a in arguments))
    run.assert_one_screen_error()
    assert text in run.err


def test_a_picture_of_another_size_than_the_calibration_is_refused(
    robot_ik: Any, place: Path, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.full((240, 320), 128, np.uint8))
    run = robot_ik(
        "camera",
        "detect",
        tmp_path / "small.png",
        "--intrinsics",
        place / "camera.yaml",
        "--marker-size",
        0.05,
    )
    run.assert_one_screen_error()
    assert "640x480 px, the picture has 320x240 px" in run.err
