"""Gathers the views of a calibration: all pictures of a folder, the still and new ones of a moving source."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from robot_ik.camera.calibration.coverage import Coverage, cover
from robot_ik.camera.calibration.intrinsic import CalibrationView
from robot_ik.camera.detection import guess_dictionary, ids_text
from robot_ik.camera.image import full_dictionary_name
from robot_ik.camera.patterns import (
    CharucoPattern,
    FoundPattern,
    Pattern,
    describe,
    fitting_pattern,
    larger_chessboard,
)
from robot_ik.camera.sources import Frame
from robot_ik.errors import CalibrationError, FrameSizeError
from robot_ik.ports import Array, Image

# Corners of a board held still move less from picture to picture: 1 px where the picture has 640.
_STILL = 1.0 / 640.0
# What makes a view a new one: position in parts of the picture, scale as a ratio, tilt in degrees.
_NEW_POSITION, _NEW_SCALE, _NEW_TILT = 0.12, 1.2, 9.0
# Pictures without the pattern after which it is asked whether another one is meant; then after four times as
# many, and so on: asking takes a second, and a live board is often just not yet there.
_UNMATCHED, _PATIENCE = 12, 4
# Pictures to ask about while more are to come.
_IDENTIFIED = 3
# Markers that make a ChArUco board; fewer may be chance finds among the squares of a chessboard.
_BOARD_MARKERS = 4
# Pictures without the pattern, and views still missing, that are named.
_NAMED, _NAMED_MISSING = 5, 3


class ViewGatherer:
    """Takes views one by one.

    Args:
        pattern: What is shown; replaced when only its old layout is found.

    Attributes:
        pattern: The pattern that is found.
        views: The views so far.
        notices: What is to be said, once.
    """

    def __init__(self, pattern: Pattern) -> None:
        self.pattern = pattern
        self.views: list[CalibrationView] = []
        self.notices: list[str] = []
        self.size: tuple[int, int] | None = None
        self._previous: FoundPattern | None = None
        self._features: list[Array] = []
        self._unmatched: deque[Image] = deque(maxlen=_UNMATCHED)
        self._unmatched_count, self._identify_at = 0, _UNMATCHED
        self._found_any = False
        self._without: list[str] = []
        self._first: list[Image] = []

    @property
    def in_view(self) -> bool:
        """Whether the last picture showed the pattern."""
        return self._previous is not None

    def offer(self, frame: Frame, name: str, *, selective: bool) -> bool:
        """Looks at a picture; True when it became a view.

        Args:
            frame: The picture.
            name: What it is called in the report.
            selective: Take it only when the board is held still and in a new way (moving sources).

        Raises:
            FrameSizeError: It has another size than the others.
            CalibrationError: Another pattern than the wanted one is in the pictures.
        """
        self.size = self.size or frame.size
        if frame.size != self.size:
            raise FrameSizeError(
                f"{name} has {frame.size[0]}x{frame.size[1]} px, the pictures before it "
                f"{self.size[0]}x{self.size[1]} px",
                hint="a calibration is for one picture size: calibrate each size by itself",
            )
        found = self.pattern.find(frame.image)
        if found is None:
            self._previous = None
            if not selective:
                self._without.append(name)
            self._unmatched.append(frame.image)
            self._unmatched_count += 1
            if not self._found_any and self._unmatched_count == self._identify_at:
                self._identify_at *= _PATIENCE
                self._identify_pattern(last=False)
            return False
        self._found_any = True
        still, self._previous = self._is_still(found, frame.size), found
        features = self._view_features(found, frame.size)
        new = all(np.linalg.norm(features - other) > 1.0 for other in self._features)
        if selective and not (still and new):
            return False
        self._features.append(features)
        self.views.append(CalibrationView(name, found))
        if len(self._first) < _IDENTIFIED:
            self._first.append(frame.image)
        return True

    def finish(self) -> None:
        """Says what is wrong when the pattern was in none of the pictures, or only a part of one.

        Raises:
            CalibrationError: It was not; the hint says what was.
        """
        if not self._found_any and self._unmatched:
            self._identify_pattern(last=True)
        self._check_counts()
        if self._without and self._found_any:
            names = ", ".join(self._without[:_NAMED]) + (", …" if len(self._without) > _NAMED else "")
            self.notices.append(f"not seen well enough in {len(self._without)} of the pictures: {names}")

    @property
    def coverage(self) -> Coverage:
        """What the views so far have shown, with tilts by a guessed focal length."""
        found = [v.found for v in self.views]
        size = self.size or (1, 1)
        return cover(found, [_pose_guess(f, size)[0] for f in found], size)

    # ---------------------------------------------------------------------------------- parts

    def _identify_pattern(self, *, last: bool) -> None:
        images = list(self._unmatched) if last else list(self._unmatched)[-_IDENTIFIED:]
        other = fitting_pattern(self.pattern, images)
        if isinstance(self.pattern, CharucoPattern) and other == replace(self.pattern, legacy=True):
            self.pattern = other
            self.notices.append(
                "the board has the layout of OpenCV before 4.6 (legacy pattern): taken as such"
            )
            self._without.clear()
            for number, image in enumerate(images):
                self.offer(Frame(image, 0.0, number), f"picture {number + 1}", selective=False)
        elif other is not None:
            counted = "squares" if isinstance(other, CharucoPattern) else "inner corners, not squares"
            raise CalibrationError(
                f"there is no {describe(self.pattern)} in the pictures, but a {describe(other)}",
                hint=f"--columns {other.columns} --rows {other.rows} ({counted})",
            )
        elif last:
            raise CalibrationError(
                f"there is no {describe(self.pattern)} in any of the pictures",
                hint=_other_kind(self.pattern, images),
            )

    def _check_counts(self) -> None:
        """Reports a chessboard that was counted wrongly although it was found: in part, or by chance."""
        larger = larger_chessboard(self.pattern, self._first)
        if larger is not None:
            self.notices.append(
                f"only a part of the board is used: it is a {describe(larger)}{_option_text(larger)}"
            )
        elif 0 < len(self.views) < len(self._without):
            other = fitting_pattern(self.pattern, list(self._unmatched)[-_IDENTIFIED:])
            if other is not None and other != self.pattern:
                self.notices.append(f"most of the pictures show a {describe(other)}{_option_text(other)}")

    def _is_still(self, found: FoundPattern, size: tuple[int, int]) -> bool:
        before = self._previous
        if before is None:
            return False
        _, new, old = np.intersect1d(found.ids, before.ids, return_indices=True)
        if len(new) < 4:
            return False
        moved = np.linalg.norm(found.pixels[new] - before.pixels[old], axis=1)
        return bool(np.median(moved) < _STILL * size[0])

    def _view_features(self, found: FoundPattern, size: tuple[int, int]) -> Array:
        """How the board is held, in units in which 1 makes a difference: position (2), scale, tilt (2)."""
        rotation, depth = _pose_guess(found, size)
        centre = found.pixels.mean(axis=0) / size / _NEW_POSITION
        tilt = cover([found], [rotation], size).tilts[0] / _NEW_TILT
        return np.array([*centre, np.log(max(depth, 1e-6)) / np.log(_NEW_SCALE), *tilt])


def _other_kind(pattern: Pattern, images: Sequence[Image]) -> str:
    """What to look at when the pattern and all that is nearly the same were not found."""
    if not isinstance(pattern, CharucoPattern):
        return (
            "it must be in view as a whole, with a white margin; check --columns and --rows, light and focus"
        )
    guess = guess_dictionary(images[-_IDENTIFIED:], min_count=_BOARD_MARKERS)
    if guess is None:
        return (
            "no markers are visible; if it is a chessboard, give --pattern chessboard; else check light and "
            "focus"
        )
    name, ids = guess
    if name != full_dictionary_name(pattern.dictionary):
        return f"{ids_text(name, ids)}: --dictionary {name}, and --columns, --rows as on the print"
    return "markers of its dictionary are visible: check --columns, --rows and the sizes against the print"


def _option_text(pattern: Pattern) -> str:
    return f": --columns {pattern.columns} --rows {pattern.rows}"


def _pose_guess(found: FoundPattern, size: tuple[int, int]) -> tuple[Array, float]:
    """Rotation and distance of the board before anything is known of the camera: f = 1 width."""
    f = float(max(size))
    k = np.array([[f, 0, size[0] / 2], [0, f, size[1] / 2], [0, 0, 1.0]])
    good, rotation_vector, shift = cv2.solvePnP(found.points_board, found.pixels, k, np.zeros(5))
    if not good:
        return np.eye(3), 1.0
    rotation = np.asarray(cv2.Rodrigues(np.asarray(rotation_vector, dtype=float).reshape(3))[0], dtype=float)
    return rotation, float(np.asarray(shift, dtype=float).reshape(3)[2])


def missing_text(missing: Sequence[str]) -> str:
    """What is still to be shown, shortly."""
    if not missing:
        return "nothing is missing"
    rest = f" and {len(missing) - _NAMED_MISSING} more" if len(missing) > _NAMED_MISSING else ""
    return "still to show: " + "; ".join(missing[:_NAMED_MISSING]) + rest
