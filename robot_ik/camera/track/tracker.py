"""From a frame to marker observations: detect, refine on the edges, estimate the pose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace

from robot_ik.camera.detect import Detection, Image, MarkerDetector, to_gray
from robot_ik.camera.detect.search_window import SearchWindow
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.pose import BodyObservation, body_branches
from robot_ik.camera.pose.bodies import MarkerBody
from robot_ik.camera.pose.branches import Branches
from robot_ik.camera.pose.cells import doubtful, fit_print, seen_by_print
from robot_ik.camera.pose.marker import MarkerObservation, marker_branches, marker_observation, marker_points
from robot_ik.camera.refine import RefinedCorners, refine_markers
from robot_ik.camera.sources import Frame
from robot_ik.camera.track.flips import BranchMemory, Choice
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

Layout = Mapping[int, tuple[float, Pose]]


class MarkerTracker:
    """Sees the markers of one dictionary through one camera.

    Only the picture and its time are used; what a synthetic camera knows (``Frame.truth``) is never read.

    Args:
        intrinsics: Of the frames' size.
        dictionary: Name as in OpenCV.
        sizes: Side of the black squares in metres: one number, or by id.
        ids: Only these are reported; None for all, or for those named in ``sizes``.
        window: Search only round the markers of the last frame, farther round when one is lost, and the
            whole frame when it is not there either, and every tenth time.  Several times faster; off, each
            frame is searched for itself.
        memory: Decide between the two poses of a flat marker with the last pictures in mind, see
            ``robot_ik.camera.track.flips``; None: as ``window``.  For pictures of one scene in their order.

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
        memory: bool | None = None,
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
        self._window = SearchWindow()
        self._use_memory = window if memory is None else memory
        self._seen: tuple[Frame | None, list[tuple[int, RefinedCorners]]] = (None, [])
        self._memories: dict[int | frozenset[int], BranchMemory] = {}

    def size_of(self, marker_id: int) -> float:
        """Side of the black square of a marker, metres."""
        if self._sizes is None:
            assert self._size is not None
            return self._size
        return self._sizes[marker_id]

    def observe(self, frame: Frame, ids: Iterable[int] | None = None) -> list[MarkerObservation]:
        """All wanted markers in the frame, sorted by id; empty when there is none.

        The same id comes twice when two copies of a marker are in view.

        Args:
            frame: The picture.
            ids: Only these of the wanted ones; the others' poses are not asked for.

        Raises:
            CalibrationError: The frame has not the size of the calibration.
        """
        observations = []
        chosen = None if ids is None else frozenset(ids)
        found = [(i, c) for i, c in self._refined(frame) if chosen is None or i in chosen]
        count = Counter(i for i, _ in found)
        for marker_id, corners in found:
            branches = marker_branches(corners, self.size_of(marker_id), self.intrinsics)
            if branches is None:
                continue
            # Nobody knows which of two copies the last picture was about.
            choice = self._choose(marker_id, branches, frame.time, certain=count[marker_id] == 1)
            seen = marker_observation(
                marker_id, corners, branches, frame.time, choice.index, choice.ambiguity
            )
            if not self._use_memory and doubtful(seen):
                seen = seen_by_print(
                    to_gray(frame.image), seen, self.size_of(marker_id), self.detector.dictionary,
                    self.intrinsics,
                )  # fmt: skip
            observations.append(seen)
        return observations

    def observe_body(self, frame: Frame, body: MarkerBody | Layout) -> BodyObservation | None:
        """A rigid body that carries several markers; see ``estimate_body``.

        Ids that come twice are left out: nobody knows which one belongs to the body.

        Args:
            frame: The picture.
            body: A ``MarkerBody``, or its layout: id -> (side in metres, ``pose_body_marker``).

        Raises:
            CalibrationError: The frame has not the size of the calibration.
            CameraError: The body's markers are of another dictionary than the tracker's.
        """
        layout = body.markers if isinstance(body, MarkerBody) else body
        if isinstance(body, MarkerBody):
            body.require_dictionary(self.detector.dictionary)
        fitting = body_branches(self.corners(frame), layout, self.intrinsics)
        if fitting is None:
            return None
        choice = self._choose(frozenset(layout), fitting.branches, frame.time)
        seen = fitting.observation(choice.index, choice.ambiguity, frame.time)
        better = fit_print(
            to_gray(frame.image), layout, seen.ids, self.detector.dictionary, self.intrinsics,
            seen.pose_camera_body, seen.covariance,
        )  # fmt: skip
        return (
            seen
            if better is None
            else replace(seen, pose_camera_body=better.pose, covariance=better.covariance)
        )

    def corners(self, frame: Frame) -> dict[int, RefinedCorners]:
        """Corners of the wanted markers in the frame, by id; those that come twice are left out.

        Raises:
            CalibrationError: The frame has not the size of the calibration.
        """
        found = self._refined(frame)
        count = Counter(i for i, _ in found)
        return {i: c for i, c in found if count[i] == 1}

    def _choose(
        self, who: int | frozenset[int], branches: Branches, time: float, *, certain: bool = True
    ) -> Choice:
        """The branch to believe in: what this picture says, or with a memory what the last ones say."""
        if not (self._use_memory and certain):
            self._memories.pop(who, None)
            return Choice(0, branches.ambiguity)
        return self._memories.setdefault(who, BranchMemory()).choose(branches, time)

    def _refined(self, frame: Frame) -> list[tuple[int, RefinedCorners]]:
        if frame is self._seen[0]:  # several bodies in one picture: it is looked at once
            return self._seen[1]
        self.intrinsics.require_size(*frame.size)
        part, origin, detections, thorough = self._detect(frame.image)
        refined = self._refine(part, detections, origin)
        whole = part.shape == frame.image.shape[:2]
        if whole and not thorough and not all(one.refined for one in refined):
            # The quick search's corners may be too rough to start from.
            again = self.detector.detect(part)
            better = self._refine(part, again, origin)
            if sum(one.refined for one in better) > sum(one.refined for one in refined):
                detections, refined = again, better
        found = [(d.id, corners) for d, corners in zip(detections, refined, strict=True)]
        self._seen = (frame, found)
        return found

    def _refine(
        self, part: Image, detections: list[Detection], origin: tuple[int, int]
    ) -> list[RefinedCorners]:
        rough = [d.corners for d in detections]
        return refine_markers(part, rough, self.intrinsics, cells=self.detector.cells, origin=origin)

    def _detect(self, image: Image) -> tuple[Image, tuple[int, int], list[Detection], bool]:
        """The part of the picture (grey) looked at, where it begins, what is in it, if by all thresholds."""
        window = self._window if self._use_window else None
        if window is not None and not window.due:
            for wide in (False, True):
                box = window.around(image.shape[1], image.shape[0], wide=wide)
                if box is None:
                    break
                x0, y0, x1, y1 = box
                part = to_gray(image[y0:y1, x0:x1])
                found = self.detector.detect_part(part, window.side, origin=(x0, y0), thorough=wide)
                if window.holds(found):
                    window.remember(found)
                    return part, (x0, y0), found, wide
        gray = to_gray(image)
        wanted = self.detector.ids
        # Quickly, when all that may be there is found that way.
        found = [] if wanted is None else self.detector.detect_quickly(gray)
        thorough = wanted is None or not {d.id for d in found} >= wanted
        if thorough:
            found = self.detector.detect(gray)
        if window is not None:
            window.remember(found, whole=True)
        return gray, (0, 0), found, thorough
