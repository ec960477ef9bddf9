"""``robot-ik camera detect``: which markers are in pictures, where, and how sure that is."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.errors import OutputError
from robot_ik.files import claimed_folder
from robot_ik.geometry import Pose

if TYPE_CHECKING:
    from robot_ik.camera.intrinsics import CameraIntrinsics
    from robot_ik.camera.sources import Frame
    from robot_ik.errors import CameraError

# A pose that fits hardly better than its mirror image is marked: goals are not made from it either.
_DOUBTFUL = 0.6
# When there is no marker in any picture, so many of them are looked at again for markers of other kinds.
_GUESSED_FROM = 3
_NOTHING: Mapping[str, Any] = {"markers": [], "bodies": []}
# So many files that cannot be used are named on the screen.
_MOST_TOLD = 12


@dataclass(frozen=True)
class CameraDetectOptions:
    """Finds markers in pictures, films and folders: ids, corners, and with --intrinsics their poses.

    Exit code 1 when there is no marker in any of them, or when one of several could not be looked at: it is
    named, and the others are done. 2 when none could.
    """

    images: Annotated[
        Positional[tuple[str, ...]], arg(metavar="IMAGE|VIDEO|FOLDER …", help_behavior_hint="")
    ] = ()
    """Files or folders; a camera's index or URL gives one picture."""
    dictionary: str = "DICT_5X5_50"
    """Of the markers, as OpenCV names it: DICT_4X4_50, DICT_APRILTAG_36H11, …"""
    ids: Annotated[tuple[int, ...], arg(metavar="ID …", help_behavior_hint="(default: all)")] = ()
    """Only these markers."""
    size: Annotated[float | None, arg(metavar="M", help_behavior_hint="")] = None
    """Side of the black squares, metres."""
    intrinsics: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Calibration of the camera; without it there are corners but no poses."""
    bodies: Annotated[Path | None, arg(metavar="FILE.toml", help_behavior_hint="")] = None
    """Boards, cubes and other bodies with several markers, whose poses are wanted too."""
    draw: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Write each picture there with what was found drawn over it."""
    overwrite: bool = False
    """Replace drawings of the same names in that folder."""
    json: bool = False
    """Print one JSON object instead of a table."""


@dataclass(frozen=True, eq=False)
class _Row:
    """One picture: its place (file, number in the film or folder), its size, and what is in it.

    One that could not be looked at has an ``error``, no size and nothing in it.
    """

    file: str
    frame: int
    size: tuple[int, int] | None
    values: dict[str, Any]
    error: CameraError | None = None
    in_film: bool = False

    def as_values(self) -> dict[str, Any]:
        """For JSON."""
        found: dict[str, Any] = {"file": self.file, "frame": self.frame}
        if self.size is not None:
            found |= {"width": self.size[0], "height": self.size[1]}
        if self.error is not None:
            found["error"] = str(self.error.args[0])
        return found | self.values


def run(options: CameraDetectOptions) -> int:
    """Prints what is in the pictures; 1 when that is nothing."""
    from robot_ik.camera.intrinsics import CameraIntrinsics

    intrinsics = None if options.intrinsics is None else CameraIntrinsics.load(options.intrinsics)
    if options.draw is None:
        return _detect(options, intrinsics, None)
    _refuse_own_pictures(options.images, options.draw)
    with claimed_folder(options.draw, "*.png", overwrite=options.overwrite):
        return _detect(options, intrinsics, _Drawings(options.draw))


def _refuse_own_pictures(names: Sequence[str], folder: Path) -> None:
    """Drawings have the names of their pictures, so they must not go where those are."""
    for path in map(Path, names):
        if folder.resolve() == (path if path.is_dir() else path.parent).resolve() and path.exists():
            raise OutputError(
                f"the drawings would take the names of the pictures in {folder}",
                hint="give another folder: --draw drawn",
            )


class _Drawings:
    """A folder of drawings, each under the name of its picture."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._names = folder, set[str]()

    def save(self, file: str, number: int | None, image: Any) -> None:
        """Writes one; a name that this run has used gets a number behind it."""
        from robot_ik.camera.sources.picture_files import write_image

        stem = (Path(file).stem or "picture") + ("" if number is None else f"-{number:05d}")
        names = itertools.chain([stem], (f"{stem}_{k}" for k in itertools.count(2)))
        name = next(name for name in names if name not in self._names)
        self._names.add(name)
        write_image(self._folder / f"{name}.png", image)


def _detect(
    options: CameraDetectOptions, intrinsics: CameraIntrinsics | None, drawings: _Drawings | None
) -> int:
    blank: deque[Any] = deque(maxlen=_GUESSED_FROM)
    rows = list(_looked(options, intrinsics, blank, drawings))
    failed = [row for row in rows if row.error is not None]
    if len(failed) == len(rows):
        _raise_first(failed)
    if options.json:
        images = [row.as_values() for row in rows]
        console.print_json({"schema": 1, "dictionary": options.dictionary, "images": images})
    else:
        _print_markers(rows, posed=intrinsics is not None)
        _print_bodies(rows)
    if intrinsics is None:
        console.say("no --intrinsics: corners only, no poses", "yellow")
    if failed:
        _tell_failed(failed, len(rows))
    if any(row.values["markers"] for row in rows):
        return console.NOT_ACHIEVED if failed else console.DONE
    wanted = f"none of the ids {', '.join(map(str, options.ids))}" if options.ids else "no marker"
    console.say(
        f"error: {wanted} of {options.dictionary} in {len(rows) - len(failed)} picture(s)", "bold red"
    )
    console.say(_hint(options, blank), "cyan")
    return console.NOT_ACHIEVED


def _raise_first(failed: Sequence[_Row]) -> None:
    """Nothing could be looked at: the first error stands for all."""
    if not failed:
        return
    error = failed[0].error
    assert error is not None
    if len(failed) > 1:
        error.args = (f"{error.args[0]}; nor can the {len(failed) - 1} other(s) be used", *error.args[1:])
    raise error


def _tell_failed(failed: Sequence[_Row], count: int) -> None:
    console.say(f"error: {len(failed)} of {count} pictures could not be looked at", "bold red")
    for row in failed[:_MOST_TOLD]:
        assert row.error is not None
        said = str(row.error.args[0])
        console.say(f"  {said}" if row.file in said else f"  {row.file}: {said}")
    if len(failed) > _MOST_TOLD:
        console.say(f"  and {len(failed) - _MOST_TOLD} more; --json names all")


def _hint(options: CameraDetectOptions, blank: Sequence[Any]) -> str:
    """What may be wrong when no picture shows a marker that was asked for."""
    from robot_ik.camera.detect.dictionary_guess import guess_dictionary

    other = guess_dictionary(blank)
    if other is None:
        return "is the marker too small, blurred, or without white all round it?"
    if other == options.dictionary:
        return "other markers of this dictionary are there: leave --ids away to see which"
    return f"there are markers of {other}: --dictionary {other}"


def _looked(
    options: CameraDetectOptions,
    intrinsics: CameraIntrinsics | None,
    blank: deque[Any],
    drawings: _Drawings | None,
) -> Iterator[_Row]:
    """Looks at all pictures, draws them when wanted; keeps some of those without a marker in ``blank``."""
    from robot_ik.camera.pose.bodies import load_bodies
    from robot_ik.camera.track.sightings import Lookout, as_values, drawn
    from robot_ik.errors import CalibrationError, CameraError

    if not options.images:
        raise CameraError("no picture is given", hint="for example: robot-ik camera detect photo.jpg")
    bodies = [] if options.bodies is None else list(load_bodies(options.bodies).values())
    asked = (options.dictionary, intrinsics, options.size, options.ids, bodies)
    lookout = Lookout(*asked)
    with console.progress() as bar:
        for name in options.images:
            task = bar.add_task(name, total=None, note="")
            for file, number, frame, in_film in _pictures(name):
                if in_film and number == 0:
                    lookout = Lookout(*asked, film=True)
                bar.update(task, note=str(number))
                if isinstance(frame, CameraError):
                    yield _Row(file, number, None, dict(_NOTHING), frame)
                    continue
                try:
                    sighting = lookout.look(frame)
                except CalibrationError as error:  # of another size
                    yield _Row(file, number, frame.size, dict(_NOTHING), error)
                    if in_film:
                        break
                    continue
                if not sighting.markers:
                    blank.append(frame.image)
                yield _Row(file, number, frame.size, as_values(sighting), in_film=in_film)
                if drawings is not None:
                    drawings.save(file, number if in_film else None, drawn(sighting, intrinsics))
            bar.remove_task(task)
            lookout = Lookout(*asked)


def _pictures(name: str) -> Iterator[tuple[str, int, Frame | CameraError, bool]]:
    """File, number, picture or why there is none, and whether it is of a film; a live camera gives one."""
    from robot_ik.camera.sources import FolderSource, ImageSource, VideoSource, open_source
    from robot_ik.errors import CameraNotFoundError

    try:
        source = open_source(name)
    except CameraNotFoundError as error:
        yield name, 0, error, False
        return
    with source:
        if isinstance(source, FolderSource):
            for number, file in enumerate(source.files):
                try:
                    frame: Frame | CameraError = source.read()
                except CameraNotFoundError as error:
                    frame = error
                yield str(file), number, frame, False
        elif isinstance(source, (ImageSource, VideoSource)):
            while not source.exhausted:
                seen = source.read()
                yield name, seen.sequence, seen, isinstance(source, VideoSource)
        else:
            yield name, 0, source.read(), False


# ------------------------------------------------------------------------------------ tables


# Of a pose, short enough for 80 columns.
_POSE = ("position, m", "tilt", "error", "ambi-\nguity", "sigma")


def _print_markers(rows: Sequence[_Row], *, posed: bool) -> None:
    shown = console.table("picture", "id", *(_POSE if posed else ("centre, px",)))
    shown.columns[0].no_wrap = False
    for row in rows:
        for marker in row.values["markers"]:
            centre = " ".join(f"{x:.2f}" for x in np.mean(marker["corners"], axis=0))
            cells = _pose_cells(marker) if posed else [Text(centre)]
            shown.add_row(_place(row), str(marker["id"]), *cells)
    _show(shown, posed=posed)


def _print_bodies(rows: Sequence[_Row]) -> None:
    shown = console.table("picture", "body", *_POSE)
    shown.columns[0].no_wrap = False
    odd = []
    for row in rows:
        for body in row.values["bodies"]:
            shown.add_row(_place(row), body["name"], *_pose_cells(body))
            if body["rejected"]:
                ids = ", ".join(map(str, body["rejected"]))
                odd.append(f"{_place(row)}: {body['name']} without {ids}, at odds with its other markers")
    _show(shown, posed=True)
    for line in odd:
        console.out().print(Text(line, style="yellow"))


def _show(shown: Table, *, posed: bool) -> None:
    if posed:  # numbers stay whole, names of pictures are broken where there is no room
        for column in shown.columns[1:]:
            column.no_wrap = True
    if shown.row_count:
        console.out().print(shown)


def _place(row: _Row) -> str:
    return f"{Path(row.file).name} #{row.frame}" if row.in_film else Path(row.file).name


def _pose_cells(values: dict[str, Any]) -> list[Text]:
    """Position, tilt, reprojection error, ambiguity, and how sure the pose is."""
    position = np.array(values["pose"]["position"])
    away = Pose(position, values["pose"]["wxyz"]).rotation[:, 2] @ position / -np.linalg.norm(position)
    sigma = np.sqrt(np.diag(values["covariance"]))
    doubtful = values["ambiguity"] > _DOUBTFUL
    return [
        Text(" ".join(f"{x:.4f}" for x in position)),
        Text(f"{np.degrees(np.arccos(np.clip(away, -1.0, 1.0))):.1f}°"),
        Text(f"{values['reprojection_error']:.2f} px"),
        Text(f"{values['ambiguity']:.2f}", style="yellow" if doubtful else ""),
        Text(f"{1e3 * sigma[:3].max():.2f} mm {np.degrees(sigma[3:].max()):.2f}°"),
    ]
