"""Gather the views of a calibration.

All pictures of a folder are taken. Of a moving source those are taken that are still and new.
"""

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

# Corners of a board held still move less than this from picture to picture, widths of the picture.
_STILL = 1.0 / 640.0
# Smallest number of common corners that tell whether a board is still.
_MIN_COMMON = 4
# Differences that make a view new: position in pictures, scale as a ratio, tilt in degrees.
_NEW_POSITION = 0.12
_NEW_SCALE = 1.2
_NEW_TILT = 9.0
# Number of pictures without the pattern after which similar patterns are tried. That takes a
# second. In the first pictures of a camera the board is often not visible yet.
_UNMATCHED = 12
# Factor by which that number grows after each trial.
_UNMATCHED_GROWTH = 4
# Number of pictures in which similar patterns are tried while more pictures follow.
_IDENTIFIED = 3
# Smallest number of markers of a ChArUco board. Fewer may be false detections on a chessboard.
_BOARD_MARKERS = 4
# Largest number of pictures without the pattern, and of missing views, that a message names.
_NAMED = 5
_NAMED_MISSING = 3


class ViewGatherer:
    """Gathers the views of a calibration one at a time.

    Args:
        pattern: The pattern in the pictures.

    Attributes:
        pattern: The pattern; replaced if only its old layout is found.
        views: The views so far.
        notices: Messages for the report.
        size: (width, height) of the pictures, px; None before the first.
    """

    def __init__(self, pattern: Pattern) -> None:
        self.pattern = pattern
        self.views: list[CalibrationView] = []
        self.notices: list[str] = []
        self.size: tuple[int, int] | None = None
        self._previous: FoundPattern | None = None
        self._features: list[Array] = []
        self._unmatched: deque[Image] = deque(maxlen=_UNMATCHED)
        self._unmatched_count = 0
        self._identify_at = _UNMATCHED
        self._is_found = False
        self._names_without: list[str] = []
        self._first: list[Image] = []

    @property
    def in_view(self) -> bool:
        """Whether the last picture showed the pattern."""
        return self._previous is not None

    def offer(self, frame: Frame, name: str, *, selective: bool) -> bool:
        """Search a picture. Return whether it became a view.

        Args:
            frame: The picture.
            name: Its name in the report.
            selective: Take it only if the board is held still and in a new way (moving sources).

        Raises:
            FrameSizeError: It does not have the size of the others.
            CalibrationError: The pictures show another pattern.
        """
        self.size = self.size or frame.size
        if frame.size != self.size:
            raise FrameSizeError(
                f"{name} has {frame.size[0]}x{frame.size[1]} px, the pictures before it "
                f"{self.size[0]}x{self.size[1]} px",
                hint="a calibration is for one picture size: calibrate each size separately",
            )
        found = self.pattern.find(frame.image)
        if found is None:
            self._add_unmatched(frame.image, name, selective=selective)
            return False
        self._is_found = True
        is_still = self._is_still(found, frame.size)
        self._previous = found
        features = self._view_features(found, frame.size)
        is_new = all(np.linalg.norm(features - other) > 1.0 for other in self._features)
        if selective and not (is_still and is_new):
            return False
        self._features.append(features)
        self.views.append(CalibrationView(name, found))
        if len(self._first) < _IDENTIFIED:
            self._first.append(frame.image)
        return True

    def finish(self) -> None:
        """Check the views and add notices.

        Raises:
            CalibrationError: No picture shows the pattern. The hint says what they show.
        """
        if not self._is_found and self._unmatched:
            self._identify_pattern(last=True)
        self._check_counts()
        if self._names_without and self._is_found:
            names = ", ".join(self._names_without[:_NAMED])
            if len(self._names_without) > _NAMED:
                names += ", …"
            count = len(self._names_without)
            self.notices.append(f"the pattern was not found in {count} of the pictures: {names}")

    @property
    def coverage(self) -> Coverage:
        """Coverage by the views so far, with tilts by a guessed focal length."""
        found = [view.found for view in self.views]
        size = self.size or (1, 1)
        return cover(found, [_guess_pose(view, size)[0] for view in found], size)

    def _add_unmatched(self, image: Image, name: str, *, selective: bool) -> None:
        self._previous = None
        if not selective:
            self._names_without.append(name)
        self._unmatched.append(image)
        self._unmatched_count += 1
        if not self._is_found and self._unmatched_count == self._identify_at:
            self._identify_at *= _UNMATCHED_GROWTH
            self._identify_pattern(last=False)

    def _identify_pattern(self, *, last: bool) -> None:
        images = list(self._unmatched) if last else list(self._unmatched)[-_IDENTIFIED:]
        other = fitting_pattern(self.pattern, images)
        is_charuco = isinstance(self.pattern, CharucoPattern)
        if is_charuco and other == replace(self.pattern, legacy=True):  # type: ignore[call-arg]
            self.pattern = other
            self.notices.append(
                "the board has the layout of OpenCV before 4.6 (legacy pattern), which is used"
            )
            self._names_without.clear()
            for number, image in enumerate(images):
                self.offer(Frame(image, 0.0, number), f"picture {number + 1}", selective=False)
        elif other is not None:
            is_charuco = isinstance(other, CharucoPattern)
            counted = "squares" if is_charuco else "inner corners, not squares"
            raise CalibrationError(
                f"there is no {describe(self.pattern)} in the pictures, but a {describe(other)}",
                hint=f"--columns {other.columns} --rows {other.rows} ({counted})",
            )
        elif last:
            raise CalibrationError(
                f"there is no {describe(self.pattern)} in any of the pictures",
                hint=_hint_when_missing(self.pattern, images),
            )

    def _check_counts(self) -> None:
        """Add a notice for a miscounted chessboard that was found in part, or by chance."""
        larger = larger_chessboard(self.pattern, self._first)
        if larger is not None:
            self.notices.append(
                "only a part of the board is used: it is a "
                f"{describe(larger)}{_option_text(larger)}"
            )
        elif 0 < len(self.views) < len(self._names_without):
            other = fitting_pattern(self.pattern, list(self._unmatched)[-_IDENTIFIED:])
            if other is not None and other != self.pattern:
                self.notices.append(
                    f"most of the pictures show a {describe(other)}{_option_text(other)}"
                )

    def _is_still(self, found: FoundPattern, size: tuple[int, int]) -> bool:
        previous = self._previous
        if previous is None:
            return False
        _, new, old = np.intersect1d(found.ids, previous.ids, return_indices=True)
        if len(new) < _MIN_COMMON:
            return False
        moves = np.linalg.norm(found.pixels[new] - previous.pixels[old], axis=1)
        return bool(np.median(moves) < _STILL * size[0])

    def _view_features(self, found: FoundPattern, size: tuple[int, int]) -> Array:
        """Return position (2), scale and tilt (2) of a board, in units of a new view."""
        rotation, depth = _guess_pose(found, size)
        center = found.pixels.mean(axis=0) / size / _NEW_POSITION
        tilt = cover([found], [rotation], size).tilts[0] / _NEW_TILT
        return np.array([*center, np.log(max(depth, 1e-6)) / np.log(_NEW_SCALE), *tilt])


def _hint_when_missing(pattern: Pattern, images: Sequence[Image]) -> str:
    """Return what to check if neither the pattern nor a similar one was found."""
    if not isinstance(pattern, CharucoPattern):
        return (
            "the whole pattern must be in view, with a white margin; check --columns and --rows, "
            "light and focus"
        )
    guess = guess_dictionary(images[-_IDENTIFIED:], min_count=_BOARD_MARKERS)
    if guess is None:
        return (
            "no markers are visible; for a chessboard give --pattern chessboard; otherwise check "
            "light and focus"
        )
    name, ids = guess
    if name != full_dictionary_name(pattern.dictionary):
        return f"{ids_text(name, ids)}: --dictionary {name}, and --columns, --rows as on the print"
    return (
        "markers of its dictionary are visible: check --columns, --rows and the sizes against the "
        "print"
    )


def _option_text(pattern: Pattern) -> str:
    return f": --columns {pattern.columns} --rows {pattern.rows}"


def _guess_pose(found: FoundPattern, size: tuple[int, int]) -> tuple[Array, float]:
    """Return rotation and distance of a board with a focal length of one width."""
    f = float(max(size))
    k = np.array([[f, 0, size[0] / 2], [0, f, size[1] / 2], [0, 0, 1.0]])
    success, vector, translation = cv2.solvePnP(found.points_board, found.pixels, k, np.zeros(5))
    if not success:
        return np.eye(3), 1.0
    rotation, _ = cv2.Rodrigues(np.asarray(vector, dtype=float).reshape(3))
    distance = np.asarray(translation, dtype=float).reshape(3)[2]
    return np.asarray(rotation, dtype=float), float(distance)


def missing_text(missing: Sequence[str]) -> str:
    """Return the first missing views as text."""
    if not missing:
        return "nothing is missing"
    text = "still to show: " + "; ".join(missing[:_NAMED_MISSING])
    if len(missing) > _NAMED_MISSING:
        text += f" and {len(missing) - _NAMED_MISSING} more"
    return text
