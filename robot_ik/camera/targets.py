"""Targets that the camera can find, and their observations.

Frame of a marker: x right, y up, z out of the print, origin in its centre.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from types import MappingProxyType

import numpy as np

from robot_ik.camera.corners import MIN_SIGMA, Corners, refine_markers
from robot_ik.camera.detection import Detection, MarkerDetector, check_ids
from robot_ik.camera.image import full_dictionary_name, to_gray
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import Pattern
from robot_ik.camera.pose import PoseFit, fit_flat_pose, fit_pose
from robot_ik.camera.sources import Frame, require_frame
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image

DEFAULT_DICTIONARY = "DICT_5X5_50"

#: Squares on a rigid body: id -> (side in metres, pose of the square in the body's frame).
Squares = Mapping[int, tuple[float, Pose]]

# A marker size beyond this is in millimetres, metres.
_MAX_SIZE = 2.0
# Standard deviation of the corners of a pattern, px. Measured by the calibration.
_PATTERN_SIGMA = 0.1
# Part of a pattern that planned views keep in the picture.
_PATTERN_PLAN_SHARE = 0.8
# Sides of a cube.
_CUBE_SIDES = 6

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Observation:
    """A target in one picture.

    Attributes:
        points: (n, 3) in the target's frame, metres, n >= 4. Four for each marker.
        pixels: (n, 2) distorted pixels of the same points.
        pose: ``pose_camera_target``.
        sigma: Standard deviation of the pixels, px.
        bias: Standard deviation of a systematic error of markers, px: the corners of all of them
            lie farther outwards in all pictures. 0 for other points.
        covariance: (6, 6) of the pose: translation (m) over rotation (rad), both along the camera's
            axes, rotation about the target's origin. NaN if unknown.
        target: The target; None if unknown, for example in an observation from a file.
        ids: Markers that were used, or corners of a pattern.
        rejected: Markers, or corners of a pattern, that were found but contradict the others.
        alternative: The other pose that a flat target allows, or None.
        ambiguity: Error of ``pose`` over the error of ``alternative``, 0 to 1. Near 1 the picture
            does not distinguish them.
        reprojection_error: RMS distance of the points from their projection, px.
        time: Time of the picture, s, monotonic. NaN if unknown.

    Raises:
        CameraError: The arrays do not belong together, a number is not finite, or there are fewer
            than four points.
    """

    points: Array
    pixels: Array
    pose: Pose
    sigma: float = _PATTERN_SIGMA
    bias: float = 0.0
    covariance: Array = field(default_factory=lambda: np.full((6, 6), math.nan))
    target: Target | None = None
    ids: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()
    alternative: Pose | None = None
    ambiguity: float = 0.0
    reprojection_error: float = 0.0
    time: float = math.nan

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=float)
        pixels = np.array(self.pixels, dtype=float)
        if points.ndim != 2 or points.shape[1] != 3 or pixels.shape != (len(points), 2):
            raise CameraError(
                f"points {points.shape} and pixels {pixels.shape} do not belong together",
                hint="give points (n, 3) and pixels (n, 2)",
            )
        if len(points) < 4:
            raise CameraError(
                f"{len(points)} points do not determine a pose", hint="at least 4 are needed"
            )
        finite = np.isfinite(points).all() and np.isfinite(pixels).all()
        if not (finite and 0.0 < self.sigma < math.inf):
            raise CameraError(
                "a point, a pixel or the standard deviation of the pixels is not finite"
            )
        if not 0.0 <= self.bias < math.inf or (self.bias > 0.0 and len(points) % 4):
            raise CameraError(
                f"a bias of {self.bias} px is impossible for {len(points)} points",
                hint="only markers have a bias, and they have four corners each",
            )
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "pixels", pixels)

    def seen_from(self, pose_target_frame: Pose) -> Observation:
        """Return the observation of another frame that is fixed to the target."""
        lever = self.pose.rotation @ pose_target_frame.position
        jacobian = np.eye(6)
        # A small rotation w moves the frame by w x lever.
        jacobian[:3, 3:] = -np.cross(np.eye(3), lever)
        alternative = self.alternative
        return replace(
            self,
            points=pose_target_frame.inverse().apply(self.points),
            pose=self.pose.compose(pose_target_frame),
            covariance=jacobian @ self.covariance @ jacobian.T,
            alternative=None if alternative is None else alternative.compose(pose_target_frame),
        )


class Target(ABC):
    """A rigid object whose pose the camera can estimate."""

    @abstractmethod
    def find(self, frame: Frame, intrinsics: CameraIntrinsics) -> Observation | None:
        """Find the target in a frame. Return None if it is not visible.

        Raises:
            CalibrationError: The frame does not have the size of the intrinsics.
            CameraError: ``frame`` is not a ``Frame``.
        """

    @property
    @abstractmethod
    def squares(self) -> Squares:
        """Squares that views are planned for, id -> (side in metres, ``pose_target_square``).

        The frame of a square is that of a marker.
        """

    @property
    @abstractmethod
    def pose_target_stand(self) -> Pose:
        """Frame in which a robot is drawn, with x right, y up and z out of the print."""


@dataclass(frozen=True, eq=False)
class MarkerTarget(Target):
    """Markers on a rigid body: a single marker, a board, a cube or any other arrangement.

    Attributes:
        markers: Id -> (side of the black square in metres, ``pose_target_marker``).
        dictionary: OpenCV's name of the dictionary.
        name: Name in messages.

    Raises:
        CameraError: There is no marker, a size is impossible, or an id is unknown.
    """

    markers: Squares
    dictionary: str = DEFAULT_DICTIONARY
    name: str = "target"

    def __post_init__(self) -> None:
        if not self.markers:
            raise CameraError(f"{self.name!r} has no markers", hint="give at least one")
        object.__setattr__(self, "markers", MappingProxyType(dict(self.markers)))
        object.__setattr__(self, "dictionary", full_dictionary_name(self.dictionary))
        check_ids(self.markers, self.dictionary)
        for size, _ in self.markers.values():
            marker_points(size)

    @cached_property
    def ids(self) -> frozenset[int]:
        """Ids of the markers."""
        return frozenset(self.markers)

    @property
    def squares(self) -> Squares:
        return self.markers

    @property
    def pose_target_stand(self) -> Pose:
        return Pose()

    def points(self, ids: Iterable[int]) -> Array:
        """Return the corners (m, 4, 3) of some markers in the target's frame, metres."""
        corners = []
        for marker_id in ids:
            size, pose = self.markers[marker_id]
            corners.append(pose.apply(marker_points(size)))
        return np.array(corners)

    def find(self, frame: Frame, intrinsics: CameraIntrinsics) -> Observation | None:
        corners = find_corners(frame, intrinsics, self.dictionary, self.ids)
        fits = self.fit(unique(corners), intrinsics, frame.time)
        return None if fits is None else fits.observation()

    def fit(
        self, corners: Mapping[int, Corners], intrinsics: CameraIntrinsics, time: float = math.nan
    ) -> MarkerFits | None:
        """Fit the pose to corners of markers by id.

        Args:
            corners: Ids that the target does not have are ignored.
            intrinsics: Intrinsics of the picture.
            time: Time of the picture, s.

        Returns:
            All poses that fit, for a tracker to choose from; None if no pose fits.
        """
        # Where the lens model folds back, a pixel has no undistorted coordinates.
        ids = [
            i for i in sorted(self.ids & corners.keys()) if np.isfinite(corners[i].normalized).all()
        ]
        if any(corners[i].refined for i in ids):
            # Unrefined corners are 50 times less accurate and add nothing.
            ids = [i for i in ids if corners[i].refined]
        if not ids:
            return None
        points = self.points(ids)
        found = fit_pose(points, [corners[i] for i in ids], intrinsics)
        if found is None:
            return None
        fits, used = found
        return MarkerFits(self, ids, used, points, corners, fits, time)


@dataclass(frozen=True, eq=False)
class MarkerFits:
    """The poses of a target that fit one picture.

    Attributes:
        target: The target.
        ids: Markers that were found.
        used: Indices of those that agree with each other.
        points: (m, 4, 3) corners of the markers found, in the target's frame, metres.
        corners: The same corners in the picture, by id.
        fits: One or two poses, the better one first.
        time: Time of the picture, s.
    """

    target: MarkerTarget
    ids: Sequence[int]
    used: Sequence[int]
    points: Array
    corners: Mapping[int, Corners]
    fits: Sequence[PoseFit]
    time: float

    def observation(self, choice: int = 0, ambiguity: float | None = None) -> Observation:
        """Return the observation with the pose number ``choice``.

        Args:
            choice: Index of the pose.
            ambiguity: Ambiguity of the choice; None: that of this picture alone.
        """
        ids = [self.ids[k] for k in self.used]
        fit = self.fits[choice]
        return Observation(
            points=self.points[list(self.used)].reshape(-1, 3),
            pixels=np.concatenate([self.corners[i].pixels for i in ids]),
            pose=fit.pose,
            sigma=float(np.sqrt(np.mean([self.corners[i].sigma ** 2 for i in ids]))),
            bias=MIN_SIGMA,
            covariance=fit.covariance,
            target=self.target,
            ids=tuple(ids),
            rejected=tuple(i for i in self.ids if i not in ids),
            alternative=self.fits[1 - choice].pose if len(self.fits) > 1 else None,
            ambiguity=pose_ambiguity(self.fits) if ambiguity is None else ambiguity,
            reprojection_error=float(np.sqrt(np.mean(fit.pixel_errors**2))),
            time=self.time,
        )


@dataclass(frozen=True, eq=False)
class PatternTarget(Target):
    """A chessboard or ChArUco board.

    Its frame is that of ``Pattern``: x right, y down, z into the board.
    """

    pattern: Pattern

    @property
    def squares(self) -> Squares:
        return {0: (_PATTERN_PLAN_SHARE * min(self.pattern.size), self.pose_target_stand)}

    @property
    def pose_target_stand(self) -> Pose:
        width, height = self.pattern.size
        left, top = self.pattern.origin
        return Pose((left + 0.5 * width, top + 0.5 * height, 0.0), (0.0, 1.0, 0.0, 0.0))

    def find(self, frame: Frame, intrinsics: CameraIntrinsics) -> Observation | None:
        _check_input(frame, intrinsics)
        found = self.pattern.find(frame.image)
        if found is None:
            return None
        fitted = fit_flat_pose(found.points_board, found.pixels, _PATTERN_SIGMA, intrinsics)
        if fitted is None:
            return None
        fits, used = fitted
        rejected = np.setdiff1d(np.arange(len(found.ids)), used)
        return Observation(
            points=found.points_board[used],
            pixels=found.pixels[used],
            pose=fits[0].pose,
            sigma=_PATTERN_SIGMA,
            covariance=fits[0].covariance,
            target=self,
            ids=tuple(found.ids[used].tolist()),
            rejected=tuple(found.ids[rejected].tolist()),
            alternative=fits[1].pose if len(fits) > 1 else None,
            ambiguity=pose_ambiguity(fits),
            reprojection_error=float(np.sqrt(np.mean(fits[0].pixel_errors ** 2))),
            time=frame.time,
        )


def pose_ambiguity(fits: Sequence[PoseFit]) -> float:
    """Return the ratio of the errors of two poses, the better one first; 0 if there is only one.

    The expected cost is added to both, so that a pose that fits the noise by chance is not certain.
    """
    if len(fits) < 2:
        return 0.0
    best, other = fits
    return math.sqrt((best.cost + best.redundancy) / (other.cost + other.redundancy))


def marker_points(size: float) -> Array:
    """Return the corners (4, 3) of a marker in its own frame, metres, in the detector's order.

    Raises:
        CameraError: The size is not positive, or given in millimetres.
    """
    if not 0.0 < size <= _MAX_SIZE:
        hint = f"give the side of the black square in metres, up to {_MAX_SIZE:g}"
        if _MAX_SIZE < size <= 1000.0 * _MAX_SIZE:
            hint = f"{hint}: {size:g} mm are {size / 1000.0:g}"
        raise CameraError(f"a marker size of {size} m is impossible", hint=hint)
    h = 0.5 * size
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def marker(marker_id: int, size: float, dictionary: str = DEFAULT_DICTIONARY) -> MarkerTarget:
    """Return a target of a single marker. Its frame is that of the marker.

    Args:
        marker_id: Id in the dictionary.
        size: Side of the black square, metres.
        dictionary: OpenCV's name of the dictionary.

    Raises:
        CameraError: The size is impossible, or the dictionary does not have the id.
    """
    return MarkerTarget({marker_id: (size, Pose())}, dictionary, f"marker {marker_id}")


def marker_grid(
    columns: int,
    rows: int,
    size: float,
    gap: float,
    first_id: int = 0,
    dictionary: str = DEFAULT_DICTIONARY,
    *,
    name: str = "",
) -> MarkerTarget:
    """Return a flat board of markers. Ids count from the upper left, row by row.

    Frame: centre of the board, x right, y up, z out of the print.

    Args:
        columns: Number of columns.
        rows: Number of rows.
        size: Side of the black squares, metres.
        gap: White between them, metres.
        first_id: Id of the upper left marker.
        dictionary: OpenCV's name of the dictionary.
        name: Name in messages.

    Raises:
        CameraError: A number is impossible, or the dictionary has too few markers.
    """
    if columns < 1 or rows < 1 or not gap > 0.0:
        raise CameraError(
            f"a board of {columns} x {rows} markers with gaps of {1e3 * gap:g} mm is impossible",
            hint="at least 1 x 1 markers and a gap above 0; a quarter of the size is a good gap",
        )
    pitch = size + gap
    markers = {}
    for k in range(columns * rows):
        row, column = divmod(k, columns)
        position = ((column - 0.5 * (columns - 1)) * pitch, (0.5 * (rows - 1) - row) * pitch, 0.0)
        markers[first_id + k] = (size, Pose(position))
    return MarkerTarget(markers, dictionary, name or f"board of {columns}x{rows} markers")


def marker_cube(
    ids: Sequence[int], size: float, edge: float, dictionary: str = DEFAULT_DICTIONARY
) -> MarkerTarget:
    """Return a cube with a marker in the middle of up to six sides.

    Frame: centre of the cube. The y axes of the first four markers are the cube's. The x axes of
    those of top and bottom are the cube's.

    Args:
        ids: One to six, in the order front (+z), right (+x), back (-z), left (-x), top (+y),
            bottom (-y).
        size: Side of the black squares, metres.
        edge: Edge of the cube, metres.
        dictionary: OpenCV's name of the dictionary.

    Raises:
        CameraError: Too many or repeated ids, or markers larger than the cube.
    """
    if not 1 <= len(ids) <= _CUBE_SIDES or len(set(ids)) != len(ids):
        raise CameraError(
            f"a cube cannot have the markers {list(ids)}", hint="give one to six different ids"
        )
    if not size < edge:
        raise CameraError(
            f"markers of {size} m do not fit on a cube of {edge} m",
            hint="leave white around them, at least a fifth of their size",
        )
    quarter = 0.5 * math.pi
    rotations = [(0.0, k * quarter, 0.0) for k in range(4)]
    rotations += [(-quarter, 0.0, 0.0), (quarter, 0.0, 0.0)]
    out = Pose((0.0, 0.0, 0.5 * edge))
    markers = {}
    for marker_id, rotation in zip(ids, rotations, strict=False):
        side = Pose().plus((0.0, 0.0, 0.0, *rotation))
        markers[marker_id] = (size, side.compose(out))
    return MarkerTarget(markers, dictionary, "cube")


def find_corners(
    frame: Frame,
    intrinsics: CameraIntrinsics,
    dictionary: str,
    ids: frozenset[int] | None = None,
    *,
    select: Callable[[Sequence[Detection]], list[Detection]] = list,
    max_pixels: int | None = None,
) -> list[tuple[int, Corners]]:
    """Detect and refine markers in a frame.

    Args:
        frame: The frame.
        intrinsics: Intrinsics of the frame.
        dictionary: OpenCV's name of the dictionary.
        ids: Ids of the wanted markers. If a quick detection finds all of them, the slower thorough
            one is skipped. None for all ids of the dictionary.
        select: Returns the detections to refine. The others are left out.
        max_pixels: See ``refine_markers``.

    Returns:
        Ids and corners, sorted by id. An id appears twice if two copies of the marker are visible.

    Raises:
        CalibrationError: The frame does not have the size of the intrinsics.
        CameraError: ``frame`` is not a ``Frame``, or the dictionary is unknown.
    """
    _check_input(frame, intrinsics)
    gray = to_gray(frame.image)
    detector = _detector(dictionary, ids)
    if ids is not None:
        detections = detector.detect_quickly(gray)
        if ids <= {d.id for d in detections}:
            corners = _refine(gray, select(detections), dictionary, intrinsics, max_pixels)
            if all(c.refined for _, c in corners):
                return [(i, c) for i, c in corners if c.verified]
            # The corners of the quick detection may be too inaccurate to start from.
    detections = select(detector.detect(gray))
    corners = _refine(gray, detections, dictionary, intrinsics, max_pixels)
    return [(i, c) for i, c in corners if c.verified]


def _check_input(frame: Frame, intrinsics: CameraIntrinsics) -> None:
    require_frame(frame)
    if not isinstance(intrinsics, CameraIntrinsics):
        raise CameraError(
            f"poses need the camera's intrinsics, not {intrinsics!r}",
            hint='load them: CameraIntrinsics.load("camera.yaml")',
        )
    intrinsics.require_size(*frame.size)


def _refine(
    gray: Image,
    detections: list[Detection],
    dictionary: str,
    intrinsics: CameraIntrinsics,
    max_pixels: int | None,
) -> list[tuple[int, Corners]]:
    ids = [d.id for d in detections]
    pixels = [d.corners for d in detections]
    corners = refine_markers(gray, pixels, ids, dictionary, intrinsics, max_pixels=max_pixels)
    return list(zip(ids, corners, strict=True))


def unique(corners: Iterable[tuple[int, Corners]]) -> dict[int, Corners]:
    """Return corners by id, without ids that appear twice: the right copy is unknown."""
    pairs = list(corners)
    copies = Counter(marker_id for marker_id, _ in pairs)
    for marker_id, count in copies.items():
        if count > 1:
            _log.warning("marker %d is visible %d times and is not used", marker_id, count)
    return {marker_id: c for marker_id, c in pairs if copies[marker_id] == 1}


@lru_cache(maxsize=16)
def _detector(dictionary: str, ids: frozenset[int] | None) -> MarkerDetector:
    return MarkerDetector(dictionary, ids)
