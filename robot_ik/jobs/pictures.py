"""Pictures of cameras, films and folders, one after the other: markers in them, views of a board in them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.camera import sources
from robot_ik.camera.boards.board import Board, BoardView
from robot_ik.camera.boards.patterns import describe
from robot_ik.camera.calibration.views import ViewGatherer, missing_text
from robot_ik.camera.image import write_image
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import FolderSource, Frame, FrameSource, ImageSource, VideoSource
from robot_ik.camera.tracker import MarkerFinder, as_values, drawn
from robot_ik.errors import CalibrationError, CameraError, CameraNotFoundError, FrameTimeoutError
from robot_ik.files import make_folder
from robot_ik.geometry import Pose
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


@dataclass(frozen=True, eq=False)
class PictureMarkers:
    """One picture: its file, its number in the film or folder, and what is in it.

    Attributes:
        size: Width and height, px; None where it could not be read.
        values: Markers and bodies, as JSON holds them.
        image: The picture itself; None where it could not be searched, because of ``error``.
    """

    file: str
    frame: int
    size: tuple[int, int] | None
    values: dict[str, Any]
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
    for file, number, frame, in_film in _pictures(name):
        if in_film and number == 0:
            finder = make_finder(film=True)
        nothing: dict[str, Any] = {"markers": [], "bodies": []}
        if isinstance(frame, CameraError):
            yield PictureMarkers(file, number, None, nothing, error=frame)
            continue
        try:
            observation = finder.observe(frame)
        except CalibrationError as error:  # of another size
            yield PictureMarkers(file, number, frame.size, nothing, error=error)
            if in_film:
                return
            continue
        yield PictureMarkers(file, number, frame.size, as_values(observation), frame.image, in_film=in_film)
        if drawings is not None:
            drawings.save(file, number if in_film else None, drawn(observation, finder.intrinsics))


def _pictures(name: str) -> Iterator[tuple[str, int, Frame | CameraError, bool]]:
    """File, number, picture or why there is none, and whether it is of a film."""
    try:
        source = sources.open_source(name)
    except CameraNotFoundError as error:
        yield name, 0, error, False
        return
    with source:
        if isinstance(source, FolderSource):
            for number, (file, frame) in enumerate(zip(source.files, frames_of(source), strict=True)):
                yield str(file), number, frame, False
        elif isinstance(source, (ImageSource, VideoSource)):
            for seen in source:
                yield name, seen.sequence, seen, isinstance(source, VideoSource)
        else:
            yield name, 0, source.read(), False


# ------------------------------------------------------------------------------------ views of a board


def board_views(
    source: FrameSource,
    board: Board,
    intrinsics: CameraIntrinsics,
    most: int,
    *,
    progress: Callable[[int], None] = lambda searched: None,
    left_out: Callable[[str], None] = lambda why: None,
    unseen: Callable[[Image], None] = lambda image: None,
) -> tuple[list[BoardView], int]:
    """The views of a board in the next ``most`` pictures of a source, and how many were searched.

    ``progress`` is given how many have been searched, ``left_out`` why a file cannot be used, ``unseen`` each
    picture without the board.
    """
    views: list[BoardView] = []
    searched = 0
    try:
        for frame in frames_of(source):
            if isinstance(frame, CameraNotFoundError):
                left_out(str(frame.args[0]))
                continue
            searched += 1
            if (view := board.see(frame, intrinsics)) is not None:
                views.append(view)
            else:
                unseen(frame.image)
            progress(searched)
            if searched == most:
                break
    except FrameTimeoutError:
        pass
    return views, searched


def board_misses(views: Sequence[BoardView], pose: Pose, intrinsics: CameraIntrinsics) -> list[float]:
    """Median distance of the corners of each view from where a board at ``pose`` would have them, px."""
    return [
        float(np.median(np.linalg.norm(intrinsics.project(pose.apply(view.points)) - view.pixels, axis=1)))
        for view in views
    ]


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
        for number in itertools.count(1):
            folder = self._out.with_name(f"{self._out.stem}-views" + (f"-{number}" if number > 1 else ""))
            given = folder.resolve() in [Path(text).resolve() for text in self._sources]
            if given or not folder.exists() or not any(folder.iterdir()):
                return folder
        raise AssertionError("there is no last number")


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
        if isinstance(source, FolderSource):
            for path, frame in zip(source.files, frames_of(source), strict=True):
                if isinstance(frame, CameraNotFoundError):
                    gatherer.notices.append(f"left out: {frame.args[0]}")
                else:
                    gatherer.offer(frame, path.name, selective=False)
        elif isinstance(source, ImageSource):
            gatherer.offer(source.read(), Path(name).name, selective=False)
        else:
            _gather_moving(source, name, gatherer, folder, count, say)


def _gather_moving(
    source: FrameSource,
    name: str,
    gatherer: ViewGatherer,
    folder: ViewFolder,
    count: int,
    say: Callable[[str], None],
) -> None:
    live, unseen = source.live, 0
    if live:
        say("show the board, hold it still, move it on; Ctrl-C when done")
    while not source.exhausted and len(gatherer.views) < MOST_VIEWS:
        frame = source.read()
        taken = gatherer.offer(frame, f"{Path(name).name or name} {frame.sequence}", selective=True)
        unseen = 0 if gatherer.in_view else unseen + 1
        if live and unseen == UNSEEN:
            say(f"no {describe(gatherer.pattern)} in view: is it the one? light and focus?")
        if not taken:
            continue
        if live:
            folder.keep(frame)
        missing = gatherer.coverage.missing
        say(f"view {len(gatherer.views)} of {count}: {missing_text(missing)}")
        if len(gatherer.views) >= count and not missing:
            return
