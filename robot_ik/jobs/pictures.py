"""Pictures of cameras, films and folders, one after the other: markers in them, views to calibrate from."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.camera import sources
from robot_ik.camera.boards.patterns import describe
from robot_ik.camera.bodies import MarkerBody
from robot_ik.camera.calibration.views import ViewGatherer, missing_text
from robot_ik.camera.detection import guess_dictionary
from robot_ik.camera.drawing.overlay import draw_axes, draw_marker_outline
from robot_ik.camera.image import dictionary_size, write_image
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.observations import BodyObservation, MarkerObservation, marker_points
from robot_ik.camera.sources import FolderSource, Frame, FrameSource, ImageSource, VideoSource, require_frame
from robot_ik.camera.tracker import MarkerTracker
from robot_ik.errors import CalibrationError, CameraError, CameraNotFoundError
from robot_ik.files import make_folder
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image

#: More views than these make a calibration no better.
MOST_VIEWS = 40
#: Pictures of a live camera without the board before that is said.
UNSEEN = 60


def frames_of(source: FrameSource) -> Iterator[Frame | CameraNotFoundError]:
    """Picture after picture to the end of the source; in place of a file that is no picture, its error."""
    while not source.exhausted:
        try:
            frame: Frame | CameraNotFoundError = source.read()
        except CameraNotFoundError as error:
            frame = error
        yield frame


# ------------------------------------------------------------------------------------------ markers


# Length of drawn axes in marker sizes.
_AXES = 0.6


@dataclass(frozen=True, eq=False)
class Corners:
    """A marker without a pose, for there are no intrinsics; attributes as in ``MarkerObservation``."""

    id: int
    corners: Array
    sigma: float
    refined: bool


@dataclass(frozen=True, eq=False)
class Sighting:
    """What one picture shows.

    Attributes:
        markers: Sorted by id; with poses when the camera's intrinsics are known.
        bodies: Name -> what was seen of it; only bodies that were seen.
    """

    markers: Sequence[MarkerObservation | Corners]
    bodies: Mapping[str, BodyObservation]


class MarkerFinder:
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
        if size is not None:
            marker_points(size)
        if intrinsics is None and self.bodies:
            raise CameraError(
                "the pose of a body needs the camera's intrinsics", hint="make them with: camera calibrate"
            )
        if intrinsics is not None and size is None and not known:
            raise CameraError(
                "a pose needs the size of the marker", hint="give the side of its black square in metres"
            )
        sizes: float | dict[int, float] = size if size is not None else 1.0
        if known:
            every = wanted if wanted is not None else range(dictionary_size(dictionary))
            sizes = {i: known.get(i, size) for i in every if known.get(i, size) is not None}  # type: ignore[misc]
        lens, window = intrinsics or _straight(1, 1), film and intrinsics is not None
        self._tracker = MarkerTracker(lens, dictionary, sizes, wanted, window=window)

    def observe(self, frame: Frame) -> Sighting:
        """Everything in one picture.

        Raises:
            CalibrationError: The picture has not the size of the calibration.
        """
        if self.intrinsics is None:
            require_frame(frame)
            self._tracker.intrinsics = _straight(*frame.size)
            seen = self._tracker.refined(frame)
            return Sighting([Corners(i, one.corners, one.sigma, one.refined) for i, one in seen], {})
        markers = self._tracker.observe(frame)
        found = {body.name: self._tracker.observe_body(frame, body) for body in self.bodies}
        return Sighting(markers, {name: seen for name, seen in found.items() if seen is not None})


def _straight(width: int, height: int) -> CameraIntrinsics:
    """Of an unknown lens: edges are taken to be straight in the picture."""
    return CameraIntrinsics(width, height, width, width, 0.5 * (width - 1), 0.5 * (height - 1))


def _values(sighting: Sighting) -> dict[str, Any]:
    """A sighting by the names of JSON; corners in pixels (integer pixel centres)."""
    markers = [
        {"id": one.id, "corners": one.corners, "corner_sigma": one.sigma, "refined": one.refined}
        | ({} if isinstance(one, Corners) else _fit_values(one, one.pose))
        for one in sighting.markers
    ]
    bodies = [
        {"name": name, "ids": seen.ids, "rejected": seen.rejected} | _fit_values(seen, seen.pose_camera_body)
        for name, seen in sighting.bodies.items()
    ]
    return {"markers": markers, "bodies": bodies}


def _fit_values(seen: MarkerObservation | BodyObservation, pose: Pose) -> dict[str, Any]:
    names = ("alternative", "reprojection_error", "ambiguity", "covariance")
    return {"pose": pose, **{name: getattr(seen, name) for name in names}}


def draw_markers(
    image: Image, markers: Sequence[MarkerObservation | Corners], intrinsics: CameraIntrinsics | None
) -> Image:
    """The picture with outlines (the first corner marked), ids, and axes where poses are known."""
    drawn = np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image.copy()
    for marker in markers:
        corners = marker.corners
        drawn = draw_marker_outline(drawn, corners, label=str(marker.id))
        if isinstance(marker, MarkerObservation) and intrinsics is not None:
            side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
            length = _AXES * side * marker.pose.position[2] / intrinsics.fx
            drawn = draw_axes(drawn, marker.pose, length, intrinsics, width=2)
    return drawn


@dataclass(frozen=True, eq=False)
class PictureMarkers:
    """One picture: its file, its number in the film or folder, and what is in it.

    Attributes:
        size: Width and height, px; None where it could not be read.
        values: Markers and bodies, by the names that JSON has for them.
        image: The picture itself; None where it could not be searched, because of ``error``.
    """

    file: str
    frame: int
    size: tuple[int, int] | None = None
    values: dict[str, Any] = field(default_factory=lambda: {"markers": [], "bodies": []})
    image: Any = None
    error: CameraError | None = None
    in_film: bool = False

    def as_values(self) -> dict[str, Any]:
        found: dict[str, Any] = {"file": self.file, "frame": self.frame}
        if self.size is not None:
            found |= {"width": self.size[0], "height": self.size[1]}
        if self.error is not None:
            found["error"] = str(self.error.args[0])
        return found | self.values


class DrawingFolder:
    """A folder of drawings, each under the name of its picture; ``names`` are those of this run."""

    def __init__(self, folder: Path) -> None:
        self._folder, self.names = folder, set[str]()

    def save(self, file: str, number: int | None, image: Any) -> None:
        """Writes one; a name that this run has used gets a number behind it."""
        stem = (Path(file).stem or "picture") + ("" if number is None else f"-{number:05d}")
        names = itertools.chain([stem], (f"{stem}_{k}" for k in itertools.count(2)))
        name = next(name for name in names if name not in self.names)
        self.names.add(name)
        write_image(self._folder / f"{name}.png", image)


def find_markers(
    name: str, make_finder: Callable[..., MarkerFinder], drawings: DrawingFolder | None = None
) -> Iterator[PictureMarkers]:
    """What is in the pictures of a file, folder, film or camera; a live camera gives one.

    ``make_finder`` makes what searches single pictures or, with ``film=True``, those of a film.
    A picture that cannot be read or searched has an ``error`` and nothing in it; of a film, where all
    pictures have one size, it is the last.
    """
    finder = make_finder()
    try:
        source = sources.open_source(name)
    except CameraNotFoundError as error:
        yield PictureMarkers(name, 0, error=error)
        return
    if film := isinstance(source, VideoSource):
        finder = make_finder(film=True)
    files = source.files if isinstance(source, FolderSource) else itertools.repeat(name)
    count = None if isinstance(source, (FolderSource, ImageSource, VideoSource)) else 1
    with source:
        frames = itertools.islice(frames_of(source), count)
        for number, (file, frame) in enumerate(zip(files, frames, strict=False)):
            if isinstance(frame, CameraError):
                yield PictureMarkers(str(file), number, error=frame)
                continue
            try:
                sighting = finder.observe(frame)
            except CalibrationError as error:  # of another size
                yield PictureMarkers(str(file), number, frame.size, error=error)
                if film:
                    return
                continue
            yield PictureMarkers(str(file), number, frame.size, _values(sighting), frame.image, in_film=film)
            if drawings is not None:
                drawing = draw_markers(frame.image, sighting.markers, finder.intrinsics)
                drawings.save(str(file), number if film else None, drawing)


# Pictures without a marker that are looked at again for markers of other kinds.
GUESSED_FROM = 3


def hint_of_other_markers(dictionary: str, blank: Sequence[Image], others: str = "") -> str:
    """What to do about markers that are in pictures where none was found; empty: there are no such.

    ``others`` is for those of this ``dictionary``.
    """
    found = guess_dictionary(blank)
    if found == dictionary:
        return f"other markers of this dictionary are there: {others}" if others else ""
    return f"there are markers of {found}, none of {dictionary}: --dictionary {found}" if found else ""


# ------------------------------------------------------------------------------- views to calibrate from


class ViewFolder:
    """Keeps the views of live cameras as pictures, so that nothing that was shown is lost.

    The folder is beside ``out``, the calibration file; one that is among the ``sources`` is added to.
    """

    def __init__(self, out: Path, sources: Sequence[str]) -> None:
        self._out, self._sources = out, sources
        self.folder, self.count = Path(), 0

    def keep(self, frame: Frame) -> None:
        if not self.count:
            self.folder = make_folder(self._free_folder())
        numbers = [int(file.stem[4:]) for file in self.folder.glob("view*.png") if file.stem[4:].isdigit()]
        write_image(self.folder / f"view{max(numbers, default=0) + 1:02d}.png", frame.image)
        self.count += 1

    def _free_folder(self) -> Path:
        """A new or empty one, or one that is a source: views of another day may be of another focus."""
        name, given = f"{self._out.stem}-views", [Path(text).resolve() for text in self._sources]
        names = itertools.chain([name], (f"{name}-{k}" for k in itertools.count(2)))
        return next(
            folder
            for folder in map(self._out.with_name, names)
            if folder.resolve() in given or not folder.exists() or not any(folder.iterdir())
        )


def gather_views(
    name: str,
    gatherer: ViewGatherer,
    folder: ViewFolder,
    count: int,
    *,
    size: tuple[int, int] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> None:
    """Adds the views of a source: all of a picture or folder; of what moves, those that show something new.

    A moving source may end after ``count`` views where nothing is missing; ``folder`` keeps those of a live
    camera, ``size`` is asked of it, and ``say`` is given what happens, for the person at it.
    """
    with sources.open_source(name, size=size) as source:
        if isinstance(source, (FolderSource, ImageSource)):
            files = source.files if isinstance(source, FolderSource) else [Path(name)]
            for path, frame in zip(files, frames_of(source), strict=True):
                if isinstance(frame, CameraNotFoundError):
                    gatherer.notices.append(f"left out: {frame.args[0]}")
                else:
                    gatherer.offer(frame, path.name, selective=False)
            return
        unseen = 0
        if source.live:
            say("show the board, hold it still, move it on; Ctrl-C when done")
        while not source.exhausted and len(gatherer.views) < MOST_VIEWS:
            frame = source.read()
            taken = gatherer.offer(frame, f"{Path(name).name or name} {frame.sequence}", selective=True)
            unseen = 0 if gatherer.in_view else unseen + 1
            if source.live and unseen == UNSEEN:
                say(f"no {describe(gatherer.pattern)} in view: is it the one? light and focus?")
            if not taken:
                continue
            if source.live:
                folder.keep(frame)
            missing = gatherer.coverage.missing
            say(f"view {len(gatherer.views)} of {count}: {missing_text(missing)}")
            if len(gatherer.views) >= count and not missing:
                return
