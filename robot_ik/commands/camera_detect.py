"""``robot-ik camera detect``: detect markers in pictures, films and folders."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.text import Text

from robot_ik.commands.options import (
    OUTPUT_GROUP,
    Dictionary,
    IntrinsicsFile,
    JsonOption,
    MarkerIds,
    MarkerSize,
    OverwriteOption,
)
from robot_ik.commands.tables import plural, table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import CameraError, OptionError, OutputError, RobotIkError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.camera.intrinsics import CameraIntrinsics
    from robot_ik.ports import Image
    from robot_ik.workcell.pictures import DrawingFolder, PictureMarkers

DOUBTFUL_AMBIGUITY = 0.6
"""Ambiguity from which a pose is marked: it fits hardly better than its mirror image. No goals are
made from such a pose."""

MAX_NAMED_FILES = 12
"""Number of unusable files that are named on the screen."""

POSE_COLUMNS = ("position, m", "tilt", "error", "ambi-\nguity", "sigma")
"""Columns of a pose. They fit 80 characters."""

DRAWINGS = "*.png"
"""Names of the drawings. ``--overwrite`` replaces these and no other files of their folder."""


@dataclass(frozen=True)
class CameraDetect(OverwriteOption, JsonOption):
    """Detect markers in pictures, films and folders: ids, corners, and poses with --intrinsics.

    Without --intrinsics there are corners, but no poses.

        robot-ik camera detect photo.png --intrinsics camera.yaml --marker-size 0.05

    Exit code 1: no picture shows a marker, or a picture of several could not be searched. It is
    named, and the others are searched. 2: no picture could be searched.
    """

    images: Annotated[tuple[str, ...], Parameter(name="IMAGE|VIDEO|FOLDER …")] = ()
    """Files or folders. A camera index or a URL gives one picture."""
    _: KW_ONLY
    dictionary: Dictionary = "DICT_5X5_50"
    id: MarkerIds = ()
    marker_size: MarkerSize = None
    intrinsics: IntrinsicsFile = None
    bodies: Annotated[Path | None, Parameter(metavar="FILE.toml")] = None
    """Boards, cubes and other bodies with several markers, to find their poses too."""
    draw: Annotated[Path | None, Parameter(metavar="FOLDER", group=OUTPUT_GROUP)] = None
    """Folder for copies of the pictures in which the markers are drawn."""

    def run(self, terminal: Terminal = QUIET) -> CameraDetectReport:
        """Search all pictures.

        Raises:
            CameraError: No picture could be searched.
        """
        from robot_ik.camera.intrinsics import CameraIntrinsics  # NumPy and OpenCV
        from robot_ik.workcell.pictures import (
            MAX_BLANK,
            DrawingFolder,
            hint_of_other_markers,
        )
        from robot_ik.workcell.results import claimed_folder

        if not self.images:
            hint = "for example: robot-ik camera detect photo.jpg"
            raise OptionError("IMAGE|VIDEO|FOLDER", "no picture is given", hint=hint)
        intrinsics = None if self.intrinsics is None else CameraIntrinsics.load(self.intrinsics)
        blank: deque[Image] = deque(maxlen=MAX_BLANK)
        drawings = None
        with ExitStack() as stack:
            if self.draw is not None:
                require_other_folder(self.draw, self.images)
                folder = claimed_folder(self.draw, DRAWINGS, overwrite=self.overwrite)
                stack.enter_context(folder)
                drawings = DrawingFolder(self.draw)
            pictures = list(self._search(intrinsics, blank, drawings, terminal))
            require_one_searched(pictures)
        if drawings is not None and drawings.names:
            terminal.say(f"wrote {plural(len(drawings.names), 'drawing')} to {self.draw}", "green")
        hint = ""
        if not any(picture.values["markers"] for picture in pictures):
            hint = hint_of_other_markers(self.dictionary, blank, "omit --id to see which")
        return CameraDetectReport(self, pictures, hint)

    def _search(
        self,
        intrinsics: CameraIntrinsics | None,
        blank: deque[Image],
        drawings: DrawingFolder | None,
        terminal: Terminal,
    ) -> Iterator[PictureMarkers]:
        """Yield all pictures. Append the last ones without a marker to ``blank``."""
        from robot_ik.camera.target_files import load_bodies
        from robot_ik.workcell.pictures import MarkerFinder, find_markers

        bodies = () if self.bodies is None else tuple(load_bodies(self.bodies).values())
        finder = partial(
            MarkerFinder, self.dictionary, intrinsics, self.marker_size, self.id, bodies
        )
        show_count = terminal.counting("picture")
        count = 0
        for name in self.images:
            for picture in find_markers(name, finder, drawings):
                count += 1
                show_count(count, 0)
                if picture.image is not None and not picture.values["markers"]:
                    blank.append(picture.image)
                yield replace(picture, image=None)


@dataclass(frozen=True, eq=False)
class CameraDetectReport(Report):
    """The markers of all pictures.

    Attributes:
        command: The options.
        pictures: All pictures, also those that could not be searched.
        hint: Which other markers the pictures show. Empty: none, or markers were found.
    """

    command: CameraDetect
    pictures: Sequence[PictureMarkers]
    hint: str

    @property
    def unusable(self) -> list[str]:
        """Name and problem of each picture that could not be searched."""
        return [problem_text(picture) for picture in self.pictures if picture.error is not None]

    @property
    def has_markers(self) -> bool:
        """Whether a picture shows a marker."""
        return any(picture.values["markers"] for picture in self.pictures)

    @property
    def ok(self) -> bool:
        return self.has_markers and not self.unusable

    @property
    def failure(self) -> RobotIkError | None:
        if self.has_markers:
            return None
        ids = ", ".join(map(str, self.command.id))
        missing = f"none of the ids {ids}" if ids else "no marker"
        searched = plural(len(self.pictures) - len(self.unusable), "picture")
        return CameraError(
            f"{missing} of {self.command.dictionary} in {searched}",
            hint=self.hint
            or "check that the marker is large, sharp, and has white paper around it",
        )

    @property
    def notes(self) -> list[str]:
        notes = []
        if self.command.intrinsics is None:
            notes.append("without --intrinsics: corners only, no poses")
        unusable = self.unusable
        if unusable:
            count = len(self.pictures)
            notes.append(f"{len(unusable)} of {count} pictures could not be searched")
            notes += [f"  {text}" for text in unusable[:MAX_NAMED_FILES]]
        if len(unusable) > MAX_NAMED_FILES:
            notes.append(f"  and {len(unusable) - MAX_NAMED_FILES} more; --json names all")
        return notes

    def tables(self) -> Iterable[Table | Text]:
        posed = self.command.intrinsics is not None
        markers = [
            (label, values["id"], *(pose_cells(values) if posed else [centre_text(values)]))
            for label, values in self._rows("markers")
        ]
        bodies = [
            (label, values["name"], *pose_cells(values)) for label, values in self._rows("bodies")
        ]
        if markers:
            columns = POSE_COLUMNS if posed else ("centre, px",)
            yield table("picture", "id", *columns, rows=markers)
        if bodies:
            yield table("picture", "body", *POSE_COLUMNS, rows=bodies)
        for label, values in self._rows("bodies"):
            if values["rejected"]:
                ids = ", ".join(map(str, values["rejected"]))
                text = f"{label}: {values['name']} without {ids}, which contradict the others"
                yield Text(text, style="yellow")

    def _rows(self, kind: str) -> list[tuple[str, dict[str, Any]]]:
        return [
            (picture_label(picture), values)
            for picture in self.pictures
            for values in picture.values[kind]
        ]

    def facts(self) -> dict[str, Any]:
        images = [picture.as_values() for picture in self.pictures]
        return {"dictionary": self.command.dictionary, "images": images}


def require_other_folder(folder: Path, images: Iterable[str]) -> None:
    """Check that no drawing takes the name of its picture.

    Raises:
        OutputError: A picture is in the folder.
    """
    for path in map(Path, images):
        source = path if path.is_dir() else path.parent
        if path.exists() and folder.resolve() == source.resolve():
            raise OutputError(
                f"the drawings would take the names of the pictures in {folder}",
                hint="give another folder: --draw drawn",
            )


def require_one_searched(pictures: Sequence[PictureMarkers]) -> None:
    """Check that not all pictures failed.

    Raises:
        CameraError: All failed. It is the first error.
    """
    errors = [picture.error for picture in pictures if picture.error is not None]
    if not errors or len(errors) < len(pictures):
        return
    error = errors[0]
    others = len(errors) - 1
    if others:
        text = f"{error.args[0]}; {plural(others, 'other file')} cannot be used either"
        error.args = (text, *error.args[1:])
    raise error


def problem_text(picture: PictureMarkers) -> str:
    """Return the error of a picture, with its file."""
    text = "" if picture.error is None else str(picture.error.args[0])
    return text if picture.file in text else f"{picture.file}: {text}"


def picture_label(picture: PictureMarkers) -> str:
    """Return the name of a picture; in a film with its number."""
    name = Path(picture.file).name
    return f"{name} #{picture.frame}" if picture.in_film else name


def centre_text(values: dict[str, Any]) -> str:
    """Return the centre of a marker in pixels."""
    import numpy as np  # not for --help

    return " ".join(f"{value:.2f}" for value in np.mean(values["corners"], axis=0))


def pose_cells(values: dict[str, Any]) -> list[object]:
    """Return position, tilt, reprojection error, ambiguity and standard deviation."""
    import numpy as np  # not for --help

    pose = values["pose"]
    cosine = pose.rotation[:, 2] @ pose.position / -np.linalg.norm(pose.position)
    tilt = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    sigma = np.sqrt(np.diag(values["covariance"]))
    doubtful = values["ambiguity"] > DOUBTFUL_AMBIGUITY
    return [
        " ".join(f"{value:z.4f}" for value in pose.position),
        f"{tilt:.1f}°",
        f"{values['reprojection_error']:.2f} px",
        Text(f"{values['ambiguity']:.2f}", style="yellow" if doubtful else ""),
        f"{1e3 * sigma[:3].max():.2f} mm {np.degrees(sigma[3:].max()):.2f}°",
    ]
