"""Choice of views: all pictures of a folder; of a moving source those that are still and new."""

from __future__ import annotations

import numpy as np
import pytest

from robot_ik.camera.calibration.views import ViewGatherer, missing_text
from robot_ik.camera.drawing.prints import Print
from robot_ik.camera.patterns import CharucoPattern, ChessboardPattern, FoundPattern, Pattern
from robot_ik.camera.sources import Frame
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_pattern
from robot_ik.camera.synthetic.sensor import SensorModel
from robot_ik.errors import CalibrationError, FrameSizeError
from robot_ik.geometry import Pose, rotation_exp


class ScriptedPattern(ChessboardPattern):
    """A chessboard with corners from a list of poses. The first pixel of a frame is the index."""

    places: list[Pose]

    def find(self, image: np.ndarray) -> FoundPattern | None:
        number = int(image[0, 0, 0])
        if number == 255:
            return None
        points = np.stack(
            [*np.meshgrid(np.arange(9.0), np.arange(6.0)), np.zeros((6, 9))], -1
        ).reshape(-1, 3)
        points *= self.square
        return FoundPattern(
            points, STANDARD_CAMERA.project(self.places[number].apply(points)), np.arange(54)
        )


def frame(value: int, size: tuple[int, int] = (640, 480)) -> Frame:
    return Frame(np.full((size[1], size[0], 3), value, np.uint8), 0.0, value)


def at(x: float, y: float, z: float = 0.6, lean: tuple[float, float] = (0.0, 0.0)) -> Pose:
    return Pose((x, y, z), rotation_exp([*np.deg2rad(lean), 0.0]))


@pytest.fixture
def gatherer() -> ViewGatherer:
    pattern = ScriptedPattern(9, 6, 0.025)
    object.__setattr__(
        pattern,
        "places",
        [
            at(-0.1, -0.05),
            at(-0.1002, -0.05),
            at(-0.05, -0.05),
            at(0.05, 0.02),
            at(0.05, 0.02),
            at(-0.1, -0.05, lean=(25.0, 0.0)),
            at(-0.1, -0.05, lean=(-25.0, 0.0)),
            at(-0.1, -0.05, 0.8),
        ],
    )
    return ViewGatherer(pattern)


def test_only_still_and_new_views_are_taken(gatherer: ViewGatherer) -> None:
    def show(*numbers: int) -> list[bool]:
        return [gatherer.offer(frame(n), f"{n}", selective=True) for n in numbers]

    assert show(0) == [False], "the first picture may be of a moving board"
    assert show(1) == [True], "a third of a pixel is hand tremor"
    assert show(1, 0) == [False, False], "seen already"
    assert show(2) == [False], "moving"
    assert show(3, 3) == [False, True]
    assert show(5, 5, 6, 6, 7, 7) == [False, True] * 3, "another lean or distance is new"
    assert show(255, 0) == [False, False], "lost in between: not known to be still"
    assert [v.name for v in gatherer.views] == ["1", "3", "5", "6", "7"]
    missing = gatherer.coverage.missing
    assert "the top side of the board tilted away" not in missing
    assert "the left side of the board tilted away" in missing
    assert missing_text(missing).startswith("still to show: the board in the upper")


def test_of_pictures_all_are_taken(gatherer: ViewGatherer) -> None:
    assert all(gatherer.offer(frame(0), "same", selective=False) for _ in range(3))
    with pytest.raises(
        FrameSizeError, match=r"big\.png has 1280x960 px, the pictures before it 640x480"
    ):
        gatherer.offer(frame(0, (1280, 960)), "big.png", selective=False)


def test_missing_text_is_short() -> None:
    assert missing_text(()) == "nothing is missing"
    assert missing_text(list("abcde")) == "still to show: a; b; c and 2 more"


def picture(pattern: Pattern) -> Frame:
    """Return a picture of a pattern that faces the camera."""
    boxes = pattern.black()
    boxes[:, :2] += 0.03 - np.array(pattern.origin)
    width, height = (round((length + 0.06) * 2000.0) for length in pattern.size)
    gray = Print.of_boxes(boxes * 2000.0, (0.0, 0.0, width, height)).flat(width, height)
    return Frame(np.repeat(gray[:, :, None], 3, axis=2), 0.0, 0)


def test_a_board_of_the_old_layout_is_used_and_reported() -> None:
    gatherer = ViewGatherer(CharucoPattern(6, 4, 0.03, 0.022))
    old = picture(CharucoPattern(6, 4, 0.03, 0.022, legacy=True))
    assert not gatherer.offer(old, "old.png", selective=False)
    gatherer.finish()
    assert isinstance(gatherer.pattern, CharucoPattern) and gatherer.pattern.legacy
    assert len(gatherer.views) == 1
    assert "OpenCV before 4.6" in gatherer.notices[0]


def test_a_wrong_board_size_is_reported() -> None:
    gatherer = ViewGatherer(ChessboardPattern(8, 5, 0.025))
    for _ in range(3):
        gatherer.offer(picture(ChessboardPattern(7, 4, 0.025)), "photo", selective=False)
    with pytest.raises(
        CalibrationError, match=r"no chessboard of 8x5 inner .* but a chessboard of 7x4"
    ) as caught:
        gatherer.finish()
    assert "--columns 7 --rows 4 (inner corners, not squares)" in caught.value.hint


def test_a_wrong_board_before_a_live_camera_is_reported_early() -> None:
    gatherer = ViewGatherer(ChessboardPattern(8, 5, 0.025))
    other = picture(ChessboardPattern(7, 4, 0.025))
    with pytest.raises(CalibrationError, match="but a chessboard of 7x4"):
        for _ in range(12):
            assert not gatherer.offer(other, "live", selective=True)
            assert not gatherer.in_view


def test_pictures_without_any_board_are_reported() -> None:
    gatherer = ViewGatherer(CharucoPattern(8, 6, 0.03, 0.022))
    gatherer.offer(frame(120), "wall.png", selective=False)
    with pytest.raises(
        CalibrationError, match=r"no ChArUco board of 8x6 squares .* in any of the pictures"
    ):
        gatherer.finish()


@pytest.mark.parametrize(
    ("asked", "shown", "hint"),
    [
        (
            CharucoPattern(6, 4, 0.03, 0.022, "DICT_6X6_250"),
            CharucoPattern(6, 4, 0.03, 0.022),
            "DICT_5X5_50:",
        ),
        (
            CharucoPattern(8, 6, 0.03, 0.022),
            CharucoPattern(4, 3, 0.03, 0.022),
            "check --columns, --rows",
        ),
        (CharucoPattern(8, 6, 0.03, 0.022), ChessboardPattern(4, 3, 0.025), "--pattern chessboard"),
    ],
)
def test_a_board_of_another_kind_is_reported(asked: Pattern, shown: Pattern, hint: str) -> None:
    gatherer = ViewGatherer(asked)
    gatherer.offer(picture(shown), "photo", selective=False)
    with pytest.raises(CalibrationError, match="in any of the pictures") as caught:
        gatherer.finish()
    assert hint in caught.value.hint


def test_pictures_without_the_board_are_named(gatherer: ViewGatherer) -> None:
    for image, name in ((0, "good"), (255, "wall"), (0, "again")):
        gatherer.offer(frame(image), name, selective=False)
    gatherer.finish()
    assert gatherer.notices == ["the pattern was not found in 1 of the pictures: wall"]


def test_pictures_of_another_board_with_the_same_markers_are_no_calibration() -> None:
    """A 7x5 board has markers of the 8x6 board. Its corners must not count as the other's."""
    rng = np.random.default_rng(0)
    pose = Pose((-0.1, -0.07, 0.45), rotation_exp([0.3, 0.2, 0.0]))
    image = render_pattern(
        CharucoPattern(7, 5, 0.03, 0.022), STANDARD_CAMERA, pose, rng, SensorModel(noise=2.0)
    )
    assert CharucoPattern(8, 6, 0.03, 0.022).find(image) is None


def test_a_board_with_only_some_requested_markers_is_reported(
    gatherer: ViewGatherer, monkeypatch: pytest.MonkeyPatch
) -> None:
    # OpenCV finds parts of a board in photographs, but not in clean drawings.
    view = gatherer.pattern.find(frame(0).image)

    def find(pattern: ChessboardPattern, image: np.ndarray) -> FoundPattern | None:
        return view if (pattern.columns, pattern.rows) == (10, 6) else None

    monkeypatch.setattr(ChessboardPattern, "find", find)
    assert gatherer.offer(frame(0), "photo", selective=False)
    gatherer.finish()
    assert gatherer.notices == [
        "only a part of the board is used: it is a chessboard of 10x6 inner corners "
        "(squares 25 mm): --columns 10 --rows 6"
    ]


def test_a_random_detection_does_not_hide_a_wrong_count() -> None:
    gatherer = ViewGatherer(ChessboardPattern(8, 5, 0.025))
    assert gatherer.offer(picture(ChessboardPattern(8, 5, 0.025)), "chance", selective=False)
    right = Frame(np.full_like(picture(ChessboardPattern(8, 5, 0.025)).image, 255), 0.0, 1)
    smaller = picture(ChessboardPattern(7, 4, 0.025)).image
    right.image[: smaller.shape[0], : smaller.shape[1]] = smaller
    for k in range(3):
        assert not gatherer.offer(right, f"photo {k}", selective=False)
    gatherer.finish()
    assert gatherer.notices[0] == (
        "most of the pictures show a chessboard of 7x4 inner corners (squares 25 mm): "
        "--columns 7 --rows 4"
    )
