"""From a frame to marker observations, picture after picture.

``MarkerTracker`` detects, refines and estimates.  Both poses of a flat marker are remembered, so that a
lucky error does not flip it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from robot_ik.camera.bodies import MarkerBody
from robot_ik.camera.corner_refinement import RefinedCorners, is_print, refine_markers
from robot_ik.camera.detection import Detection, MarkerDetector, SearchWindow
from robot_ik.camera.image import to_gray
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.observations import (
    BodyObservation,
    MarkerObservation,
    body_branches,
    marker_branches,
    marker_observation,
    marker_points,
)
from robot_ik.camera.pose_fit import BranchChoice, Branches
from robot_ik.camera.sources import Frame, require_frame
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Image

#: Marker id -> (side in metres, its pose seen from the body or board).
Layout = Mapping[int, tuple[float, Pose]]

# ------------------------------------------------------------------------------------------
# Keeps both poses of a flat marker alive from picture to picture, so that a lucky error does not flip it.
#
# Which of the two branches of each picture is the true one is a chain with two states.  Its evidence is added
# up (Rabiner 1989, forward pass): the errors of the branches in each picture, and how far the marker would
# have had to turn since the last one.  Old evidence fades, so a wrong branch cannot stay alive; the branch in
# use is left only for one that is clearly better.


# What is left of the evidence of one picture in the next: ten pictures count, nearly.
_KEPT = 0.85
# A hand turns a marker by this much, rad/s.
_ROTATION_RATE = 2.0
# No single rotation and no single picture says more than this (log odds): either may be an accident.
_MOST_BY_ROTATION, _MOST_BY_PICTURE = 4.0, 8.0
# The other branch must be better by this (log odds) before it is taken.
_HYSTERESIS = 0.5
# A marker not seen for so long is a new one; pictures without a time are taken to come at 30 Hz.
_FORGET_S, _USUAL_S = 0.5, 1.0 / 30.0


@dataclass(eq=False)
class BranchMemory:
    """The two hypotheses about one marker or board."""

    _poses: tuple[Pose, ...] = ()
    _odds: list[float] = field(default_factory=list)
    _spread: list[float] = field(default_factory=list)
    _chosen: int = 0
    _time: float = float("nan")

    def choose(self, branches: Branches, time: float) -> BranchChoice:
        """Takes in one picture.

        Args:
            branches: What fits it.
            time: When it was taken, s; NaN when unknown.
        """
        gap = time - self._time
        gap = _USUAL_S if not math.isfinite(gap) or gap == 0.0 else gap
        if not 0.0 < gap <= _FORGET_S:
            self._poses = ()
        # Errors that the corners' covariance does not explain are in both branches: they prove less.
        scale = max(1.0, branches.costs[0] / branches.expected)
        alone = [-0.5 * (cost - branches.costs[0]) / scale for cost in branches.costs]
        odds = [max(value, -_MOST_BY_PICTURE) for value in alone]
        spread = [float(c[3, 3] + c[4, 4] + c[5, 5]) for c in branches.covariances]
        index = 0
        if self._poses:
            moved = (_ROTATION_RATE * gap) ** 2
            plausible = [
                [_plausible(p, q, a + b + moved) for q, b in zip(branches.poses, spread, strict=True)]
                for p, a in zip(self._poses, self._spread, strict=True)
            ]
            for k in range(len(odds)):
                transitions = [_KEPT * old + row[k] for old, row in zip(self._odds, plausible, strict=True)]
                odds[k] += max(transitions) + math.log(
                    sum(math.exp(transition - max(transitions)) for transition in transitions)
                )
            # The continuation of the branch in use, unless another one is clearly better.
            row = plausible[self._chosen]
            same, best = row.index(max(row)), odds.index(max(odds))
            index = best if odds[best] > odds[same] + _HYSTERESIS else same
        odds = [value - max(odds) for value in odds]
        self._poses, self._odds, self._spread = branches.poses, odds, spread
        self._chosen, self._time = index, time
        if len(odds) < 2:
            return BranchChoice(index, 0.0)
        # The ratio of errors that one picture with as much evidence would have: that of this picture or,
        # where it is more, half of it and half of all, for pictures in a row share errors.
        now = alone[index] - alone[1 - index]
        more = 2.0 * scale * max(now, 0.5 * (now + odds[index] - odds[1 - index]), 0.0)
        return BranchChoice(index, 1.0 / math.sqrt(1.0 + more / (branches.costs[0] + branches.expected)))


def _plausible(one: Pose, other: Pose, variance: float) -> float:
    """How well (log odds) the rotation from one pose to the other fits what is expected of it, rad^2."""
    angle = 2.0 * math.acos(min(1.0, abs(float(one.wxyz @ other.wxyz))))
    return max(-0.5 * angle * angle / variance, -_MOST_BY_ROTATION)


class MarkerTracker:
    """Sees the markers of one dictionary through one camera.

    Only the picture and its time are used; what a synthetic camera knows (``Frame.truth``) is never read.

    Args:
        intrinsics: Of the frames' size.
        dictionary: Name as in OpenCV.
        sizes: Side of the black squares in metres: one number, or by id.
        ids: Only these are reported; None for all, or for those named in ``sizes``.
        window: The frames are of one scene in their order.  Search only round the markers of the last one,
            farther round when one is lost, and the whole frame when it is not there either, and every tenth
            time: several times faster.  Decide between the two poses of a flat marker with the last frames
            in mind.  Off, each frame is for itself.

    Raises:
        CameraError: No intrinsics, unknown dictionary, an id beyond it, an id without a size, or a size that
            cannot be.
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
        if not isinstance(intrinsics, CameraIntrinsics):
            raise CameraError(
                f"poses need the camera's intrinsics, not {intrinsics!r}",
                hint='load them: CameraIntrinsics.load("camera.yaml")',
            )
        self.intrinsics = intrinsics
        self._sizes = dict(sizes) if isinstance(sizes, Mapping) else float(sizes)
        chosen = None if ids is None else frozenset(ids)
        if isinstance(self._sizes, dict):
            chosen = frozenset(self._sizes) if chosen is None else chosen
            if missing := sorted(chosen - self._sizes.keys()):
                raise CameraError(
                    f"no size is given for marker ids {', '.join(map(str, missing))}",
                    hint="give the side of each black square in metres",
                )
        for size in self._sizes.values() if isinstance(self._sizes, dict) else [self._sizes]:
            marker_points(size)
        self.detector = MarkerDetector(dictionary, chosen)
        self._use_window = window
        self._window = SearchWindow()
        self._seen: tuple[Frame | None, list[tuple[int, RefinedCorners]]] = (None, [])
        self._memories: dict[int | frozenset[int], BranchMemory] = {}

    def observe(self, frame: Frame, ids: Iterable[int] | None = None) -> list[MarkerObservation]:
        """All wanted markers in the frame, sorted by id; empty when there is none.

        The same id comes twice when two copies of a marker are in view.

        Args:
            frame: The picture.
            ids: Only these of the wanted ones; the others' poses are not asked for.

        Raises:
            CalibrationError: The frame has not the size of the calibration.
            CameraError: It is no ``Frame``.
        """
        observations = []
        chosen = None if ids is None else frozenset(ids)
        found = [(i, c) for i, c in self.refined(frame) if chosen is None or i in chosen]
        count = Counter(i for i, _ in found)
        for marker_id, corners in found:
            size = self._sizes[marker_id] if isinstance(self._sizes, dict) else self._sizes
            branches = marker_branches(corners, size, self.intrinsics)
            if branches is None:
                continue
            # It is unknown which of two copies the last picture was about.
            choice = self._choose(marker_id, branches, frame.time, certain=count[marker_id] == 1)
            observations.append(marker_observation(marker_id, corners, branches, choice, frame.time))
        return observations

    def observe_body(self, frame: Frame, body: MarkerBody | Layout) -> BodyObservation | None:
        """A rigid body that carries several markers; see ``estimate_body``.

        Ids that come twice are left out: it is unknown which one belongs to the body.

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
        return fitting.observation(choice, frame.time)

    def corners(self, frame: Frame) -> dict[int, RefinedCorners]:
        """Corners of the wanted markers in the frame, by id; those that come twice are left out.

        Raises:
            CalibrationError: The frame has not the size of the calibration.
        """
        found = self.refined(frame)
        count = Counter(i for i, _ in found)
        return {i: c for i, c in found if count[i] == 1}

    def _choose(
        self, who: int | frozenset[int], branches: Branches, time: float, *, certain: bool = True
    ) -> BranchChoice:
        """The branch to believe in: what this picture says, or with a memory what the last ones say."""
        if not (self._use_window and certain):
            self._memories.pop(who, None)
            return branches.alone
        return self._memories.setdefault(who, BranchMemory()).choose(branches, time)

    def refined(self, frame: Frame) -> list[tuple[int, RefinedCorners]]:
        """Ids and corners of the wanted markers in the frame, sorted by id; raises as ``observe``."""
        require_frame(frame)
        if frame is self._seen[0]:  # several bodies in one picture: it is looked at once
            return self._seen[1]
        self.intrinsics.require_size(*frame.size)
        part, origin, detections, thorough = self._detect(frame.image)
        whole = part.shape == frame.image.shape[:2]
        before = {} if whole else {i: c for i, c in self._seen[1] if c.refined}

        def refine(detections: list[Detection]) -> list[tuple[int, RefinedCorners]]:
            ids = [d.id for d in detections]
            refined = refine_markers(
                part, [d.corners for d in detections], ids, self.detector.dictionary, self.intrinsics,
                origin=origin, film=self._use_window, before=before,
            )  # fmt: skip
            return list(zip(ids, refined, strict=True))

        found = refine(detections)
        if whole and not thorough and not all(one.refined for _, one in found):
            # The quick search's corners may be too rough to start from.
            better = refine(self.detector.detect(part))
            if sum(one.refined for _, one in better) > sum(one.refined for _, one in found):
                found = better
        found = [(i, one) for i, one in found if is_print(one)]
        self._seen = (frame, found)
        return found

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
