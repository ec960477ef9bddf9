"""What is in a picture, told in plain values: markers, bodies, their poses; and drawn over it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detect import MarkerDetector, to_gray
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.opencv import dictionary_size
from robot_ik.camera.pose import BodyObservation
from robot_ik.camera.pose.bodies import MarkerBody
from robot_ik.camera.pose.marker import MarkerObservation
from robot_ik.camera.refine import RefinedCorners, refine_markers
from robot_ik.camera.sources import Frame
from robot_ik.camera.track.tracker import MarkerTracker
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose

Image = NDArray[np.uint8]

# Of the drawing: subpixel bits, colours (BGR), length of the axes in marker sizes.
_SHIFT = 4
_OUTLINE, _FIRST_CORNER = (0, 220, 0), (0, 0, 255)
_AXES = 0.6


@dataclass(frozen=True, eq=False)
class Corners:
    """A marker whose pose nobody asked for: no intrinsics."""

    id: int
    seen: RefinedCorners


@dataclass(frozen=True, eq=False)
class Sighting:
    """What one picture shows.

    Attributes:
        frame: The picture.
        markers: Sorted by id; with poses when the camera's intrinsics are known.
        bodies: Name -> what was seen of it; only bodies that were seen.
    """

    frame: Frame
    markers: Sequence[MarkerObservation | Corners]
    bodies: Mapping[str, BodyObservation]

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the markers."""
        return tuple(m.id for m in self.markers)


class Lookout:
    """Looks for markers and bodies in pictures.

    Args:
        dictionary: Of the markers, and of bodies that do not name theirs.
        intrinsics: Of the pictures; None: corners only, of pictures of any size.
        size: Side of the black squares in metres; those of bodies are known already.
        ids: Only these; none: all, or when only bodies are asked for those on them.
        bodies: What to look for.
        film: The pictures show one scene in their order, so the last ones help with the next.

    Raises:
        CameraError: Unknown dictionary, an id beyond it, a size that cannot be or is missing, bodies without
            intrinsics or of another dictionary.
    """

    def __init__(
        self,
        dictionary: str,
        intrinsics: CameraIntrinsics | None = None,
        size: float | None = None,
        ids: Sequence[int] = (),
        bodies: Sequence[MarkerBody] = (),
        *,
        film: bool = False,
    ) -> None:
        self.intrinsics, self.bodies = intrinsics, tuple(bodies)
        for body in self.bodies:
            body.require_dictionary(dictionary)
        known = {i: side for body in self.bodies for i, side in body.sizes.items()}
        wanted = sorted(ids) or (sorted(known) if known and size is None else None)
        self._detector = MarkerDetector(dictionary, wanted)
        self._tracker: MarkerTracker | None = None
        if intrinsics is None:
            if self.bodies:
                raise CameraError(
                    "the pose of a body needs the camera's intrinsics",
                    hint="make them with: camera calibrate",
                )
            return
        if size is None and not known:
            raise CameraError(
                "a pose needs the size of the marker", hint="give the side of its black square in metres"
            )
        sizes: float | dict[int, float] = size if size is not None else 0.0
        if known:
            every = wanted if wanted is not None else range(dictionary_size(dictionary))
            sizes = {i: known.get(i, size) for i in every if known.get(i, size) is not None}  # type: ignore[misc]
        self._tracker = MarkerTracker(intrinsics, dictionary, sizes, wanted, window=film)

    def look(self, frame: Frame) -> Sighting:
        """Everything in one picture.

        Raises:
            CalibrationError: The picture has not the size of the calibration.
        """
        if self._tracker is None:
            return Sighting(frame, self._corners(frame), {})
        markers = self._tracker.observe(frame)
        found = {body.name: self._tracker.observe_body(frame, body) for body in self.bodies}
        return Sighting(frame, markers, {name: seen for name, seen in found.items() if seen is not None})

    def _corners(self, frame: Frame) -> list[Corners]:
        width, height = frame.size
        # Nobody knows the lens: edges are taken to be straight in the picture.
        straight = CameraIntrinsics(width, height, width, width, 0.5 * (width - 1), 0.5 * (height - 1))
        gray = to_gray(frame.image)
        found = self._detector.detect(gray)
        refined = refine_markers(gray, [d.corners for d in found], straight, cells=self._detector.cells)
        return [Corners(d.id, seen) for d, seen in zip(found, refined, strict=True)]


# ---------------------------------------------------------------------------------- as values


def as_values(sighting: Sighting) -> dict[str, Any]:
    """A sighting for JSON: corners in pixels (integer pixel centres), poses in metres and wxyz."""
    return {
        "markers": [_marker_values(m) for m in sighting.markers],
        "bodies": [_body_values(name, seen) for name, seen in sighting.bodies.items()],
    }


def _marker_values(marker: MarkerObservation | Corners) -> dict[str, Any]:
    if isinstance(marker, Corners):
        return {
            "id": marker.id,
            "corners": marker.seen.corners.tolist(),
            "corner_sigma": marker.seen.sigma,
            "refined": marker.seen.refined,
        }
    return {
        "id": marker.id,
        "corners": marker.corners.tolist(),
        "corner_sigma": marker.sigma,
        "refined": marker.refined,
        "pose": _pose_values(marker.pose),
        "alternative": _pose_values(marker.alternative),
        "reprojection_error": marker.reprojection_error,
        "ambiguity": marker.ambiguity,
        "covariance": marker.covariance.tolist(),
    }


def _body_values(name: str, seen: BodyObservation) -> dict[str, Any]:
    return {
        "name": name,
        "ids": list(seen.ids),
        "rejected": list(seen.rejected),
        "pose": _pose_values(seen.pose_camera_body),
        "alternative": _pose_values(seen.alternative),
        "reprojection_error": seen.reprojection_error,
        "ambiguity": seen.ambiguity,
        "covariance": seen.covariance.tolist(),
    }


def _pose_values(pose: Pose | None) -> dict[str, list[float]] | None:
    return None if pose is None else {"position": pose.position.tolist(), "wxyz": pose.wxyz.tolist()}


# ----------------------------------------------------------------------------------- as picture


def drawn(sighting: Sighting, intrinsics: CameraIntrinsics | None) -> Image:
    """The picture with outlines (the first corner marked), ids, and axes where poses are known."""
    from robot_ik.camera.overlay import draw_axes  # imported here: drawing needs MuJoCo, looking does not

    image = sighting.frame.image.copy()
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for marker in sighting.markers:
        corners = marker.seen.corners if isinstance(marker, Corners) else marker.corners
        outline = np.rint(corners * 2**_SHIFT).astype(np.int32)
        cv2.polylines(image, [outline], True, _OUTLINE, 2, cv2.LINE_AA, _SHIFT)
        first = (int(outline[0, 0]), int(outline[0, 1]))
        cv2.circle(image, first, 4 * 2**_SHIFT, _FIRST_CORNER, -1, cv2.LINE_AA, _SHIFT)
        place = (int(corners[:, 0].min()), int(corners[:, 1].min()) - 6)
        cv2.putText(image, str(marker.id), place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 4, cv2.LINE_AA)
        cv2.putText(image, str(marker.id), place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, _OUTLINE, 2, cv2.LINE_AA)
        if isinstance(marker, MarkerObservation) and intrinsics is not None:
            side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
            length = _AXES * side * marker.pose.position[2] / intrinsics.fx
            image = draw_axes(image, marker.pose, length, intrinsics, width=2)
    return image
