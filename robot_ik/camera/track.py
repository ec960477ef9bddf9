"""From a frame to marker observations: detect, refine on the edges, estimate the pose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detect import Detection, Image, MarkerDetector, to_gray
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.pose import (
    BodyObservation,
    MarkerObservation,
    estimate_body,
    estimate_marker,
    marker_points,
)
from robot_ik.camera.refine import RefinedCorners, refine_markers
from robot_ik.camera.sources import Frame
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

Array = NDArray[np.float64]

# The window searched for a marker seen in the last frame: its box and so much of its size on each side.
_WINDOW_MARGIN = 0.75
# The whole frame is searched every so many frames all the same: for markers that come into view.
_FULL_EVERY = 10


class MarkerTracker:
    """Sees the markers of one dictionary through one camera.

    Only the picture and its time are used; what a synthetic camera knows (``Frame.truth``) is never read.

    Args:
        intrinsics: Of the frames' size.
        dictionary: Name as in OpenCV.
        sizes: Side of the black squares in metres: one number, or by id.
        ids: Only these are reported; None for all, or for those named in ``sizes``.
        window: Search only round the markers of the last frame, and the whole frame every tenth time or
            when one is lost.  Much faster on large frames; off, each frame is seen for itself.

    Raises:
        CameraError: Unknown dictionary, an id beyond it, an id without a size, or a size that cannot be.
    """

    def __init__(
        self,
        intrinsics: CameraIntrinsics,
        dictionary: str = "DICT_5X5_50",
        sizes: float | Mapping[int, float] = 0.05,
        ids: Iterable[int] | None = None,
        *,
        window: bool = False,
    ) -> None:
        self.intrinsics = intrinsics
        by_id = dict(sizes) if isinstance(sizes, Mapping) else None
        chosen = frozenset(ids) if ids is not None else (frozenset(by_id) if by_id is not None else None)
        self._sizes = by_id
        self._size = None if isinstance(sizes, Mapping) else float(sizes)
        missing = sorted(i for i in chosen or () if by_id is not None and i not in by_id)
        if missing:
            raise CameraError(
                f"no size is given for marker ids {missing}",
                hint="give the side of each black square in metres",
            )
        for size in by_id.values() if by_id is not None else [self._size or 0.0]:
            marker_points(size)
        self.detector = MarkerDetector(dictionary, chosen)
        self._use_window = window
        self._boxes: dict[int, Array] = {}
        self._since_full = 0

    def size_of(self, marker_id: int) -> float:
        """Side of the black square of a marker, metres."""
        if self._sizes is None:
            assert self._size is not None
            return self._size
        return self._sizes[marker_id]

    def observe(self, frame: Frame) -> list[MarkerObservation]:
        """All wanted markers in the frame, sorted by id; empty when there is none.

        The same id comes twice when two copies of a marker are in view.

        Raises:
            CalibrationError: The frame has not the size of the calibration.
        """
        observations = []
        for marker_id, corners in self._refined(frame):
            observation = estimate_marker(
                corners, self.size_of(marker_id), self.intrinsics, id=marker_id, time=frame.time
            )
            if observation is not None:
                observations.append(observation)
        return observations

    def observe_body(self, frame: Frame, layout: Mapping[int, tuple[float, Pose]]) -> BodyObservation | None:
        """A rigid body that carries several markers; see ``estimate_body``.

        Ids that come twice are left out: nobody knows which one belongs to the body.

        Raises:
            CalibrationError: The frame has not the size of the calibration.
        """
        found = self._refined(frame)
        count = Counter(i for i, _ in found)
        return estimate_body({i: c for i, c in found if count[i] == 1}, layout, self.intrinsics)

    def _refined(self, frame: Frame) -> list[tuple[int, RefinedCorners]]:
        self.intrinsics.require_size(*frame.size)
        gray = to_gray(frame.image)
        detections = self._detect(gray)
        refined = refine_markers(
            gray, [d.corners for d in detections], self.intrinsics, cells=self.detector.cells
        )
        return [(d.id, corners) for d, corners in zip(detections, refined, strict=True)]

    def _detect(self, gray: Image) -> list[Detection]:
        if not self._use_window:
            return self.detector.detect(gray)
        box = self._window(gray.shape)
        if box is not None:
            x0, y0, x1, y1 = box
            crop = np.ascontiguousarray(gray[y0:y1, x0:x1])
            found = [Detection(d.id, d.corners + np.array([x0, y0])) for d in self.detector.detect(crop)]
            if {d.id for d in found} >= set(self._boxes):
                self._since_full += 1
                self._remember(found)
                return found
        found = self.detector.detect(gray)
        self._since_full = 0
        self._remember(found)
        return found

    def _remember(self, found: list[Detection]) -> None:
        self._boxes = {d.id: d.corners for d in found}

    def _window(self, shape: tuple[int, ...]) -> tuple[int, int, int, int] | None:
        """Part of the picture that holds the last finds, or None when all of it should be searched."""
        if not self._boxes or self._since_full + 1 >= _FULL_EVERY:
            return None
        low = np.array([c.min(axis=0) - _WINDOW_MARGIN * np.ptp(c, axis=0) for c in self._boxes.values()])
        high = np.array([c.max(axis=0) + _WINDOW_MARGIN * np.ptp(c, axis=0) for c in self._boxes.values()])
        x0, y0 = np.maximum(np.floor(low.min(axis=0)), 0).astype(int)
        x1, y1 = np.minimum(np.ceil(high.max(axis=0)) + 1, (shape[1], shape[0])).astype(int)
        # A window of more than half the picture saves nothing.
        if (x1 - x0) * (y1 - y0) > 0.5 * shape[0] * shape[1]:
            return None
        return int(x0), int(y0), int(x1), int(y1)
