"""Markers and calibration views in the pictures of cameras, films and folders."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.camera import sources
from robot_ik.camera.calibration.views import ViewGatherer, missing_text
from robot_ik.camera.corners import Corners
from robot_ik.camera.detection import check_ids, guess_dictionary, ids_text
from robot_ik.camera.drawing.overlay import draw_axes, draw_marker_outline
from robot_ik.camera.image import full_dictionary_name, write_image
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import describe
from robot_ik.camera.sources import (
    FolderSource,
    Frame,
    FrameSource,
    ImageSource,
    VideoSource,
    require_frame,
)
from robot_ik.camera.targets import (
    MarkerFits,
    MarkerTarget,
    Observation,
    find_corners,
    marker,
    marker_points,
    unique,
)
from robot_ik.camera.tracker import PoseMemory
from robot_ik.errors import CalibrationError, CameraError, CameraNotFoundError
from robot_ik.files import make_folder
from robot_ik.ports import Image

MAX_VIEWS = 40
"""Largest number of views. More views do not improve a calibration."""

MAX_UNSEEN = 60
"""Number of successive pictures of a live camera without the board before a message appears."""

MAX_BLANK = 3
"""Largest number of pictures without a marker in which other dictionaries are tried."""

_AXES = 0.6
"""Length of drawn axes in marker sizes."""


def frames_of(source: FrameSource) -> Iterator[Frame | CameraNotFoundError]:
    """Yield all pictures of a source. A file that is no picture yields its error instead."""
    while not source.exhausted:
        try:
            frame: Frame | CameraNotFoundError = source.read()
        except CameraNotFoundError as error:
            frame = error
        yield frame


@dataclass(frozen=True, eq=False)
class SeenMarker:
    """One marker in one picture.

    Attributes:
        id: Id in the dictionary.
        corners: Its corners.
        observation: Its pose; None without intrinsics.
    """

    id: int
    corners: Corners
    observation: Observation | None = None


@dataclass(frozen=True, eq=False)
class Sighting:
    """Markers and bodies in one picture.

    Attributes:
        markers: Sorted by id. An id comes twice if two copies of the marker are visible.
        bodies: Observations by the name of the body.
    """

    markers: Sequence[SeenMarker]
    bodies: Mapping[str, Observation]


class MarkerFinder:
    """Finds markers and bodies in pictures.

    Args:
        dictionary: OpenCV's name of the dictionary of all markers.
        intrinsics: Intrinsics of the pictures. None: corners only, in pictures of any size.
        size: Side of the black squares, metres. Those of bodies are known.
        ids: Ids to report. If empty: all, or those of the bodies if only bodies are given.
        bodies: Bodies to find.
        film: Whether the pictures are successive frames. Then the last pictures help to choose
            between the two poses of a marker.

    Raises:
        CameraError: Unknown dictionary, an id that it does not have, an impossible or missing size,
            or bodies without intrinsics or of another dictionary.
    """

    def __init__(
        self,
        dictionary: str,
        intrinsics: CameraIntrinsics | None = None,
        size: float | None = None,
        ids: Sequence[int] = (),
        bodies: Sequence[MarkerTarget] = (),
        *,
        film: bool = False,
    ) -> None:
        self.dictionary = full_dictionary_name(dictionary)
        self.intrinsics = intrinsics
        self.bodies = tuple(bodies)
        self._size = size
        self._sizes: dict[int, float] = {}
        for body in self.bodies:
            if body.dictionary != self.dictionary:
                raise CameraError(
                    f"the markers of the body {body.name!r} are of {body.dictionary}, but "
                    f"{self.dictionary} is searched",
                    hint=f"search the dictionary of the body: --dictionary {body.dictionary}",
                )
            self._sizes |= {i: side for i, (side, _) in body.markers.items()}
        if size is not None:
            marker_points(size)
        if intrinsics is None and self.bodies:
            raise CameraError(
                "the pose of a body needs the camera's intrinsics",
                hint="make them with: camera calibrate",
            )
        if intrinsics is not None and size is None and not self._sizes:
            raise CameraError(
                "a pose needs the size of the marker",
                hint="give the side of its black square in metres",
            )
        self._ids: frozenset[int] | None = frozenset(ids) or None
        if not ids and self.bodies and size is None:
            self._ids = frozenset(self._sizes)
        check_ids(self._ids or (), self.dictionary)
        unknown = sorted((self._ids or frozenset()) - self._sizes.keys())
        if intrinsics is not None and size is None and unknown:
            raise CameraError(
                f"the size of marker {', '.join(map(str, unknown))} is unknown",
                hint="give the side of the black square in metres",
            )
        # Ids that are searched, and target -> memory that chooses one of its two poses.
        self._search = None if self._ids is None else self._ids.union(self._sizes)
        self._memories: dict[int | str, PoseMemory] | None = {} if film else None

    def observe(self, frame: Frame) -> Sighting:
        """Return everything in one picture.

        Raises:
            CalibrationError: The picture does not have the size of the intrinsics.
        """
        require_frame(frame)
        intrinsics = self.intrinsics or _undistorted(*frame.size)
        corners = find_corners(frame, intrinsics, self.dictionary, self._search)
        reported = [(i, c) for i, c in corners if self._ids is None or i in self._ids]
        if self.intrinsics is None:
            return Sighting([SeenMarker(i, c) for i, c in reported], {})
        single = unique(corners)
        markers = []
        for i, c in reported:
            size = self._sizes.get(i, self._size)
            if size is not None:
                fits = marker(i, size, self.dictionary).fit({i: c}, intrinsics, frame.time)
                # The last picture may have been of another copy.
                observation = self._choose(i, fits, remember=i in single)
                markers.append(SeenMarker(i, c, observation))
        bodies = {}
        for body in self.bodies:
            observation = self._choose(body.name, body.fit(single, intrinsics, frame.time))
            if observation is not None:
                bodies[body.name] = observation
        return Sighting([m for m in markers if m.observation is not None], bodies)

    def _choose(
        self, name: int | str, fits: MarkerFits | None, *, remember: bool = True
    ) -> Observation | None:
        if fits is None:
            return None
        if self._memories is None or not remember:
            return fits.observation()
        return self._memories.setdefault(name, PoseMemory()).choose(fits)


def _undistorted(width: int, height: int) -> CameraIntrinsics:
    """Return intrinsics without distortion for a camera whose lens is unknown."""
    return CameraIntrinsics(width, height, width, width, 0.5 * (width - 1), 0.5 * (height - 1))


def _values(sighting: Sighting) -> dict[str, Any]:
    """Return a sighting by the names of JSON; corners in pixels (integer pixel centres)."""
    markers = []
    for seen in sighting.markers:
        values = {
            "id": seen.id,
            "corners": seen.corners.pixels,
            "corner_sigma": seen.corners.sigma,
            "refined": seen.corners.refined,
        }
        if seen.observation is not None:
            values |= _pose_values(seen.observation)
        markers.append(values)
    bodies = [
        {"name": name, "ids": seen.ids, "rejected": seen.rejected} | _pose_values(seen)
        for name, seen in sighting.bodies.items()
    ]
    return {"markers": markers, "bodies": bodies}


def _pose_values(observation: Observation) -> dict[str, Any]:
    names = ("pose", "alternative", "reprojection_error", "ambiguity", "covariance")
    return {name: getattr(observation, name) for name in names}


def draw_markers(
    image: Image, markers: Sequence[SeenMarker], intrinsics: CameraIntrinsics | None
) -> Image:
    """Return a picture with the outlines and ids of markers, and axes where poses are known."""
    drawn = np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image.copy()
    for seen in markers:
        if seen.observation is not None and intrinsics is not None:
            drawn = draw_observations(drawn, [seen.observation], intrinsics)
        else:
            drawn = draw_marker_outline(drawn, seen.corners.pixels, label=str(seen.id))
    return drawn


def draw_observations(
    image: Image, observations: Sequence[Observation], intrinsics: CameraIntrinsics
) -> Image:
    """Return a picture with the outlines, ids and axes of single markers."""
    drawn = image.copy()
    for seen in observations:
        corners = seen.pixels
        drawn = draw_marker_outline(drawn, corners, label=str(seen.ids[0]))
        side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
        length = _AXES * side * seen.pose.position[2] / intrinsics.fx
        drawn = draw_axes(drawn, seen.pose, length, intrinsics, width=2)
    return drawn


@dataclass(frozen=True, eq=False)
class PictureMarkers:
    """One picture and its markers.

    Attributes:
        file: File of the picture, or name of the source.
        frame: Index in the film or folder.
        size: Width and height, px. None if the picture could not be read.
        values: Markers and bodies by their JSON names.
        image: The picture. None if it could not be searched.
        error: Reason why the picture could not be searched. None if it was searched.
        in_film: Whether the picture is a frame of a film.
    """

    file: str
    frame: int
    size: tuple[int, int] | None = None
    values: dict[str, Any] = field(default_factory=lambda: {"markers": [], "bodies": []})
    image: Any = None
    error: CameraError | None = None
    in_film: bool = False

    def as_values(self) -> dict[str, Any]:
        """Return the fields of this picture for JSON."""
        values: dict[str, Any] = {"file": self.file, "frame": self.frame}
        if self.size is not None:
            values |= {"width": self.size[0], "height": self.size[1]}
        if self.error is not None:
            values["error"] = str(self.error.args[0])
        return values | self.values


class DrawingFolder:
    """A folder of drawings. Each drawing has the name of its picture.

    Attributes:
        names: Names of the drawings of this run, without suffix.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.names: set[str] = set()

    def save(self, file: str, number: int | None, image: Any) -> None:
        """Write a drawing. If this run has already used its name, a number is appended.

        Args:
            file: File of the picture.
            number: Index of the frame in a film. None for single pictures.
            image: The drawing.
        """
        stem = (Path(file).stem or "picture") + ("" if number is None else f"-{number:05d}")
        names = itertools.chain([stem], (f"{stem}_{k}" for k in itertools.count(2)))
        name = next(name for name in names if name not in self.names)
        self.names.add(name)
        write_image(self._folder / f"{name}.png", image)


def find_markers(
    name: str, make_finder: Callable[..., MarkerFinder], drawings: DrawingFolder | None = None
) -> Iterator[PictureMarkers]:
    """Search the pictures of a file, folder, film or camera.

    A live camera gives one picture. A picture that cannot be read or searched has an ``error``. In
    a film this picture is the last one, because all frames of a film have the same size.

    Args:
        name: Name of the source.
        make_finder: Function that returns a finder for single pictures, or with ``film=True`` a
            finder for successive frames.
        drawings: Folder for pictures with drawn markers. None: no drawings.

    Yields:
        Each picture with its markers.
    """
    finder = make_finder()
    try:
        source = sources.open_source(name)
    except CameraNotFoundError as error:
        yield PictureMarkers(name, 0, error=error)
        return

    is_film = isinstance(source, VideoSource)
    if is_film:
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
            except (
                CalibrationError
            ) as error:  # the picture does not have the size of the intrinsics
                yield PictureMarkers(str(file), number, frame.size, error=error)
                if is_film:
                    return
                continue
            yield PictureMarkers(
                str(file), number, frame.size, _values(sighting), frame.image, in_film=is_film
            )
            if drawings is not None:
                drawing = draw_markers(frame.image, sighting.markers, finder.intrinsics)
                drawings.save(str(file), number if is_film else None, drawing)


def hint_of_other_markers(dictionary: str, blank: Sequence[Image], others: str = "") -> str:
    """Return what to do about other markers in pictures where none was found.

    Args:
        dictionary: The dictionary that was searched.
        blank: The pictures.
        others: Hint for other markers of the same dictionary.

    Returns:
        One sentence; empty if there are no other markers.
    """
    guess = guess_dictionary(blank)
    if guess is None:
        return ""
    name, ids = guess
    if name == full_dictionary_name(dictionary):
        return f"other markers of this dictionary are visible: {others}" if others else ""
    return f"{ids_text(name, ids)}: --dictionary {name}"


class ViewFolder:
    """A folder that keeps the views of live cameras as pictures.

    The folder is beside the calibration file. If that folder is one of the sources, views are added
    to it.

    Attributes:
        folder: The folder. It is chosen when the first view is kept.
        count: Number of views that this run has kept.

    Args:
        out: The calibration file.
        sources: Names of the sources of the calibration.
    """

    def __init__(self, out: Path, sources: Sequence[str]) -> None:
        self._out = out
        self._sources = sources
        self.folder = Path()
        self.count = 0

    def keep(self, frame: Frame) -> None:
        """Write a view under the next free number."""
        if not self.count:
            self.folder = make_folder(self._free_folder())
        suffixes = [file.stem.removeprefix("view") for file in self.folder.glob("view*.png")]
        numbers = [int(suffix) for suffix in suffixes if suffix.isdigit()]
        write_image(self.folder / f"view{max(numbers, default=0) + 1:02d}.png", frame.image)
        self.count += 1

    def _free_folder(self) -> Path:
        """Return a folder that is new, empty, or one of the sources.

        Views of different runs are not mixed unless requested: the focus may have changed.
        """
        source_paths = [Path(source).resolve() for source in self._sources]
        name = f"{self._out.stem}-views"
        names = itertools.chain([name], (f"{name}-{k}" for k in itertools.count(2)))
        return next(
            folder
            for folder in map(self._out.with_name, names)
            if folder.resolve() in source_paths or not folder.exists() or not any(folder.iterdir())
        )


def gather_views(
    name: str,
    gatherer: ViewGatherer,
    folder: ViewFolder,
    count: int,
    *,
    size: tuple[int, int] | None = None,
    say: Callable[[str], None] = lambda _text: None,
) -> None:
    """Add the views of a source to a calibration.

    All pictures of a file or folder are offered. From a film or camera only views that show
    something new are added, until there are ``count`` views and no part of the coverage is missing.

    Args:
        name: Name of the source.
        gatherer: Receives the views.
        folder: Keeps the views of a live camera.
        count: Number of views after which a film or camera may end.
        size: Requested picture size of a camera, px. None: the default of the camera.
        say: Receives messages for the user at the camera.
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
        while not source.exhausted and len(gatherer.views) < MAX_VIEWS:
            frame = source.read()
            taken = gatherer.offer(
                frame, f"{Path(name).name or name} {frame.sequence}", selective=True
            )
            unseen = 0 if gatherer.in_view else unseen + 1
            if source.live and unseen == MAX_UNSEEN:
                say(f"no {describe(gatherer.pattern)} in view: check pattern, light and focus")
            if not taken:
                continue
            if source.live:
                folder.keep(frame)
            missing = gatherer.coverage.missing
            say(f"view {len(gatherer.views)} of {count}: {missing_text(missing)}")
            if len(gatherer.views) >= count and not missing:
                return
