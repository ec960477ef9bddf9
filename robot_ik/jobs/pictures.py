"""Pictures of cameras, films and folders, one after the other: markers in them, views to calibrate from."""

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
        film: Whether the pictures are successive frames. Then the two poses of a marker are told
            apart by the last pictures too.

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
                    hint=f"search theirs: --dictionary {body.dictionary}",
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
        # Ids that are searched, and by target what the last pictures say about its two poses.
        self._search = None if self._ids is None else self._ids.union(self._sizes)
        self._memories: dict[int | str, PoseMemory] | None = {} if film else None

    def observe(self, frame: Frame) -> Sighting:
        """Return everything in one picture.

        Raises:
            CalibrationError: The picture does not have the size of the intrinsics.
        """
        require_frame(frame)
        intrinsics = self.intrinsics or _straight(*frame.size)
        corners = find_corners(frame, intrinsics, self.dictionary, self._search)
        wanted = [(i, c) for i, c in corners if self._ids is None or i in self._ids]
        if self.intrinsics is None:
            return Sighting([SeenMarker(i, c) for i, c in wanted], {})
        single = unique(corners)
        markers = []
        for i, c in wanted:
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


def _straight(width: int, height: int) -> CameraIntrinsics:
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


def draw_markers(image: Image, markers: Sequence[SeenMarker], intrinsics: CameraIntrinsics | None) -> Image:
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


# Number of pictures without a marker in which other dictionaries are tried.
GUESSED_FROM = 3


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
