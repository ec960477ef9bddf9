"""Detection: ids, order of corners, no false detections."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from robot_ik.camera.detection import MarkerDetector, guess_dictionary, ids_text
from robot_ik.camera.image import dictionary_names, dictionary_size, marker_bits
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.synthetic.sensor import SensorModel
from robot_ik.camera.targets import marker_points
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.workcell.pictures import MarkerFinder

#: Marker z towards the camera, marker x along camera x.
FACING = np.array([0.0, 1.0, 0.0, 0.0])


def sheet(
    ids: list[int], dictionary: str = "DICT_5X5_50", cell: int = 9, gap: int = 40
) -> np.ndarray:
    """Return a picture of markers side by side on white paper, facing the camera."""
    tiles = [
        cv2.copyMakeBorder(
            np.kron(marker_bits(dictionary, i), np.ones((cell, cell), np.uint8)),
            gap,
            gap,
            gap,
            gap,
            cv2.BORDER_CONSTANT,
            value=255,
        )
        for i in ids
    ]
    return np.hstack(tiles)


def photographed(image: np.ndarray, rng: np.random.Generator, quality: int = 60) -> np.ndarray:
    """Return a picture that is blurred, noisy, in colour and JPEG-compressed."""
    soft = cv2.GaussianBlur(image, (0, 0), 1.0).astype(float) * 0.8 + 20
    soft += rng.normal(0, 5, soft.shape)
    colour = np.stack([soft * 0.9, soft, soft * 0.95], axis=2)
    data = cv2.imencode(
        ".jpg", np.clip(colour, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    return np.asarray(cv2.imdecode(data[1], cv2.IMREAD_COLOR), dtype=np.uint8)


@pytest.mark.parametrize("roll_deg", [0, 90, 180, 270, 37])
def test_corners_start_at_the_printed_upper_left(roll_deg: float) -> None:
    turn = rotation_exp([0, 0, np.deg2rad(roll_deg)])
    pose = Pose((0.02, -0.01, 0.4), quat_multiply(FACING, turn))
    rng = np.random.default_rng(3)
    image = render_markers(STANDARD_CAMERA, {5: (0.05, pose)}, rng, dictionary="DICT_5X5_50")
    (found,) = MarkerDetector("DICT_5X5_50").detect(image)
    truth = STANDARD_CAMERA.project(pose.apply(marker_points(0.05)))
    assert found.id == 5
    assert found.corners == pytest.approx(truth, abs=2.0)


@pytest.mark.parametrize(
    "dictionary", ["DICT_4X4_50", "DICT_5X5_50", "DICT_6X6_250", "DICT_APRILTAG_36H11"]
)
def test_ids_are_read_from_a_poor_photograph(dictionary: str) -> None:
    rng = np.random.default_rng(1)
    ids = [3, 11, 17, 42]
    image = photographed(sheet(ids, dictionary), rng)
    assert [d.id for d in MarkerDetector(dictionary).detect(image)] == ids


def test_only_listed_ids_are_reported() -> None:
    image = sheet([3, 11, 17])
    assert [d.id for d in MarkerDetector(ids=[11, 40]).detect(image)] == [11]
    assert MarkerDetector(ids=[]).detect(image) == []


def test_two_copies_of_a_marker_are_both_reported() -> None:
    assert [d.id for d in MarkerDetector().detect(sheet([9, 9]))] == [9, 9]


def test_grey_and_colour_give_the_same_corners() -> None:
    image = sheet([4])
    grey = MarkerDetector().detect(image)
    colour = MarkerDetector().detect(np.repeat(image[:, :, None], 3, axis=2))
    assert grey[0].corners == pytest.approx(colour[0].corners)


def test_nothing_is_found_in_clutter() -> None:
    """Strict detection rejects them, and the fit of the print rejects the rest."""
    rng = np.random.default_rng(7)
    strict = MarkerDetector("DICT_5X5_50", strict=True)
    finder = MarkerFinder("DICT_5X5_50")
    nearly = 0
    for _ in range(12):
        image = rng.integers(90, 200, (480, 640)).astype(np.uint8)
        image = cv2.GaussianBlur(image, (0, 0), 3)
        for _ in range(25):
            # Squares with random bits look like markers, but their code is wrong.
            cells = int(rng.integers(5, 9))
            cell = int(rng.integers(3, 9))
            bits = np.zeros((cells + 2, cells + 2), np.uint8)
            bits[1:-1, 1:-1] = 255 * rng.integers(0, 2, (cells, cells))
            tile = np.pad(np.kron(bits, np.ones((cell, cell), np.uint8)), cell, constant_values=255)
            h, w = tile.shape
            y = rng.integers(0, 480 - h)
            x = rng.integers(0, 640 - w)
            image[y : y + h, x : x + w] = tile
        assert strict.detect(image) == []
        nearly += len(MarkerDetector("DICT_5X5_50").detect(image))
        assert finder.observe(Frame(image, 0.0, 0)).markers == []
    # Otherwise the test does not exercise the fit of the print.
    assert nearly > 0


def test_a_blank_picture_is_empty() -> None:
    for value in (0, 128, 255):
        assert MarkerDetector().detect(np.full((480, 640, 3), value, np.uint8)) == []


def test_an_unknown_dictionary_gives_suggestions() -> None:
    with pytest.raises(CameraError, match=r"unknown .* 'DICT_5X5_5'; did you mean 'DICT_5X5_50'"):
        MarkerDetector("DICT_5X5_5")


def test_dictionary_names_need_neither_case_nor_prefix() -> None:
    assert dictionary_size("apriltag_36h11") == 587
    assert dictionary_size("5x5_50") == 50
    assert len({name.upper() for name in dictionary_names()}) == len(dictionary_names())


def test_an_id_beyond_the_dictionary_is_reported() -> None:
    with pytest.raises(CameraError, match=r"DICT_5X5_50 has no marker 50, 99(.|\n)*0 to 49"):
        MarkerDetector("DICT_5X5_50", ids=[7, 99, 50])
    with pytest.raises(CameraError, match=r"marker id 50 is not in"):
        marker_bits("DICT_5X5_50", 50)


def test_marker_bits_have_a_black_border() -> None:
    bits = marker_bits("DICT_5X5_50", 7)
    assert bits.shape == (7, 7)
    border = np.concatenate([bits[0], bits[-1], bits[:, 0], bits[:, -1]])
    assert not border.any()
    assert set(np.unique(bits)) == {0, 255}


@pytest.mark.parametrize(
    ("dictionary", "marker_id", "rows"),
    [
        ("DICT_5X5_50", 7, (14, 4, 5, 3, 11)),
        ("DICT_APRILTAG_36H11", 3, (6, 19, 37, 57, 56, 39)),
    ],
)
def test_prints_are_the_same_with_every_opencv(
    dictionary: str, marker_id: int, rows: tuple[int, ...]
) -> None:
    """The next release of OpenCV must read sheets of the last one. These are the bits of 4.14."""
    inner = marker_bits(dictionary, marker_id)[1:-1, 1:-1] > 127
    assert tuple(int("".join("01"[int(b)] for b in row), 2) for row in inner) == rows


def test_quick_detection_finds_easily_visible_markers() -> None:
    image = photographed(sheet([3, 11, 17]), np.random.default_rng(2))
    detector = MarkerDetector()
    full = detector.detect(image)
    quick = detector.detect_quickly(image)
    assert [d.id for d in quick] == [3, 11, 17]
    for a, b in zip(full, quick, strict=True):
        assert a.corners == pytest.approx(b.corners, abs=1.5)


def test_a_marker_under_steep_view_and_weak_contrast_is_found() -> None:
    lean = rotation_exp([np.deg2rad(60), 0, 0])
    pose = Pose((0.0, 0.0, 0.8), quat_multiply(FACING, lean))
    image = render_markers(
        STANDARD_CAMERA,
        {1: (0.05, pose)},
        np.random.default_rng(0),
        dictionary="DICT_5X5_50",
        sensor=SensorModel(black=80, white=150),
    )
    assert [d.id for d in MarkerDetector().detect(image)] == [1]


@pytest.mark.parametrize(
    ("dictionary", "ids"),
    [("DICT_4X4_100", (77, 3)), ("DICT_5X5_50", (7, 9)), ("DICT_APRILTAG_36H11", (500, 2))],
)
def test_the_dictionary_of_a_picture_is_guessed(dictionary: str, ids: tuple[int, int]) -> None:
    cells = [np.pad(marker_bits(dictionary, i), 2, constant_values=255) for i in ids]
    picture = np.hstack([np.kron(c, np.ones((16, 16), np.uint8)) for c in cells])
    assert guess_dictionary([picture]) == (dictionary, tuple(sorted(ids)))
    assert guess_dictionary([picture], min_count=3) is None
    assert guess_dictionary([np.full((120, 160), 200, np.uint8)]) is None


def test_the_sentence_names_the_dictionary_and_some_ids() -> None:
    assert ids_text("DICT_4X4_50", (3, 7)) == "these ids exist in DICT_4X4_50: 3, 7"
    assert ids_text("DICT_4X4_50", tuple(range(20))).endswith("6, 7, …")
