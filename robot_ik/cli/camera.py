"""``robot-ik camera list``, ``detect``, ``locate``, ``print`` and ``calibrate``."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from rich.text import Text
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    XYZ_WXYZ,
    BoardName,
    Dictionary,
    Json,
    Overwrite,
    Range,
    pose_option,
    pose_text,
    request_of,
    several,
    single,
)
from robot_ik.errors import CalibrationError, CameraError, FrameTimeoutError, OutputError
from robot_ik.files import timestamp, write_atomically
from robot_ik.geometry import Pose
from robot_ik.jobs.results import claimed, claimed_folder

if TYPE_CHECKING:
    from robot_ik.camera.calibration.intrinsic import CalibrationResult
    from robot_ik.camera.calibration.views import ViewGatherer
    from robot_ik.camera.device import CameraDevice
    from robot_ik.camera.intrinsics import CameraIntrinsics
    from robot_ik.jobs.locate import LocateReport
    from robot_ik.jobs.pictures import DrawingFolder, PictureMarkers, ViewFolder


# Ambiguity from which a pose is marked: it fits hardly better than its mirror image. No goals are
# made from such a pose.
_DOUBTFUL = 0.6
# Number of unusable files that are named on the screen.
_MOST_NAMED = 12
# Columns of a pose. They fit 80 characters.
_POSE = ("position, m", "tilt", "error", "ambi-\nguity", "sigma")
# Names of the distortion coefficients, in OpenCV's order.
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class CameraListOptions:
    """Lists cameras: index, name, path, permission, who uses them. Opens none of them.

    Exit code 1 when there is no camera. Linux only: macOS and Windows do not let cameras be listed.
    """

    json: Json = False


def run_list(options: CameraListOptions) -> int:
    """Print the cameras and return the exit code: 1 if there is none."""
    from robot_ik.camera.device import CAN_LIST, find_cameras
    from robot_ik.hardware.checks import named_users_of, permission_hint

    found = []
    for camera in find_cameras():
        do = permission_hint(camera.path) if camera.pictures and not camera.usable else ""
        found.append((camera, named_users_of(camera.path), do))
    if options.json:
        rows = [{**asdict(camera), "used_by": users, "do": do} for camera, users, do in found]
        console.print_json({"schema": 1, "can_list": CAN_LIST, "cameras": rows})
    elif found:
        cells = [
            (c.index, c.name or "?", c.stable or c.path, _state(c, users), do)
            for c, users, do in found
        ]
        console.show(console.table("index", "name", "path", "state", "what to do", rows=cells))
    elif CAN_LIST:
        console.refused(
            "there is no camera on this machine",
            "plug one in; a picture, a film, a folder, a URL or synthetic:orbit does as well "
            "wherever a camera is asked for",
        )
    else:
        console.refused(
            f"cameras cannot be listed on {sys.platform}",
            "the first one is 0, the next 1, …; try: robot-ik camera detect 0",
        )
    return console.DONE if any(camera.pictures for camera, _, _ in found) else console.NOT_ACHIEVED


def _state(camera: CameraDevice, users: list[str]) -> str:
    if not camera.pictures:
        return "no pictures: a camera's second node"
    if not camera.usable:
        return "no permission"
    return f"used by {', '.join(users)}" if users else "free"


@dataclass(frozen=True)
class CameraDetectOptions:
    """Finds markers in pictures, films and folders: ids, corners, and poses with --intrinsics.

    Exit code 1 when there is no marker in any of them, or when one of several could not be looked
    at: it is named, and the others are done. 2 when none could.
    """

    images: Annotated[Positional[tuple[str, ...]], several("IMAGE|VIDEO|FOLDER")] = ()
    """Files or folders; a camera's index or URL gives one picture."""
    dictionary: str = "DICT_5X5_50"
    """Of the markers, as OpenCV names it: DICT_4X4_50, DICT_APRILTAG_36H11, …"""
    ids: Annotated[tuple[int, ...], several("ID", "all")] = ()
    """Only these markers."""
    size: Annotated[float | None, single("M")] = None
    """Side of the black squares, metres."""
    intrinsics: Annotated[Path | None, single("FILE")] = None
    """Calibration of the camera; without it there are corners but no poses."""
    bodies: Annotated[Path | None, single("FILE.toml")] = None
    """Boards, cubes and other bodies with several markers, whose poses are wanted too."""
    draw: Annotated[Path | None, single("DIR")] = None
    """Write each picture there with what was found drawn over it."""
    overwrite: Overwrite = False
    json: Json = False


def run_detect(options: CameraDetectOptions) -> int:
    """Print the markers in the pictures and return the exit code: 1 if there are none."""
    from robot_ik.camera.intrinsics import CameraIntrinsics

    intrinsics = None if options.intrinsics is None else CameraIntrinsics.load(options.intrinsics)
    if (folder := options.draw) is None:
        return _detect(options, intrinsics, None)
    from robot_ik.jobs.pictures import DrawingFolder

    # Drawings have the names of their pictures.
    for path in map(Path, options.images):
        if folder.resolve() == (path if path.is_dir() else path.parent).resolve() and path.exists():
            raise OutputError(
                f"the drawings would take the names of the pictures in {folder}",
                hint="give another folder: --draw drawn",
            )
    drawings = DrawingFolder(folder)
    with claimed_folder(folder, "*.png", overwrite=options.overwrite):
        code = _detect(options, intrinsics, drawings)
    if drawings.names:
        console.say(
            f"wrote {console.count_of(len(drawings.names), 'drawing')} to {folder}", "green"
        )
    return code


def _detect(
    options: CameraDetectOptions,
    intrinsics: CameraIntrinsics | None,
    drawings: DrawingFolder | None,
) -> int:
    from robot_ik.jobs.pictures import GUESSED_FROM, hint_of_other_markers

    blank: deque[Any] = deque(maxlen=GUESSED_FROM)
    rows = _searched_pictures(options, intrinsics, blank, drawings)
    failed = [row for row in rows if row.error is not None]
    if failed and len(failed) == len(rows):
        # All pictures failed: raise the first error.
        error = failed[0].error
        if error is None:
            raise RuntimeError("a picture that failed has no error")
        if others := len(failed) - 1:
            besides = f"; {console.count_of(others, 'other file')} cannot be used either"
            error.args = (error.args[0] + besides, *error.args[1:])
        raise error
    if options.json:
        images = [row.as_values() for row in rows]
        console.print_json({"schema": 1, "dictionary": options.dictionary, "images": images})
    else:
        _print_found(rows, posed=intrinsics is not None)
    if intrinsics is None:
        console.say("no --intrinsics: corners only, no poses", "yellow")
    if failed:
        _report_failed(failed, len(rows))
    if any(row.values["markers"] for row in rows):
        return console.NOT_ACHIEVED if failed else console.DONE
    wanted = f"none of the ids {', '.join(map(str, options.ids))}" if options.ids else "no marker"
    looked_at = console.count_of(len(rows) - len(failed), "picture")
    hint = hint_of_other_markers(options.dictionary, blank, "leave --ids away to see which")
    hint = hint or "is the marker too small, blurred, or without white all round it?"
    return console.refused(f"{wanted} of {options.dictionary} in {looked_at}", hint)


def _report_failed(failed: Sequence[PictureMarkers], count: int) -> None:
    console.say(f"error: {len(failed)} of {count} pictures could not be looked at", "bold red")
    for row in failed[:_MOST_NAMED]:
        if row.error is None:
            raise RuntimeError("a picture that failed has no error")
        said = str(row.error.args[0])
        console.say(f"  {said}" if row.file in said else f"  {row.file}: {said}")
    if len(failed) > _MOST_NAMED:
        console.say(f"  and {len(failed) - _MOST_NAMED} more; --json names all")


def _searched_pictures(
    options: CameraDetectOptions,
    intrinsics: CameraIntrinsics | None,
    blank: deque[Any],
    drawings: DrawingFolder | None,
) -> list[PictureMarkers]:
    """Search all pictures and draw them if wanted. Append some without a marker to ``blank``."""
    from robot_ik.camera.target_files import load_bodies
    from robot_ik.jobs.pictures import MarkerFinder, find_markers

    if not options.images:
        raise CameraError(
            "no picture is given", hint="for example: robot-ik camera detect photo.jpg"
        )
    bodies = () if options.bodies is None else tuple(load_bodies(options.bodies).values())
    finder = partial(
        MarkerFinder, options.dictionary, intrinsics, options.size, options.ids, bodies
    )
    found = []
    with console.progress() as bar:
        for name in options.images:
            task = bar.add_task(name, total=None, note="")
            for row in find_markers(name, finder, drawings):
                bar.update(task, note=str(row.frame))
                if row.image is not None and not row.values["markers"]:
                    blank.append(row.image)
                found.append(replace(row, image=None))
            bar.remove_task(task)
    return found


def _print_found(rows: Sequence[PictureMarkers], *, posed: bool) -> None:
    """Print tables of markers and of bodies. Names may be broken into lines, numbers not."""
    markers = [(_picture_label(row), one) for row in rows for one in row.values["markers"]]
    bodies = [(_picture_label(row), one) for row in rows for one in row.values["bodies"]]
    marker_cells = [
        (label, one["id"], *(_pose_cells(one) if posed else [_centre(one["corners"])]))
        for label, one in markers
    ]
    body_cells = [(label, one["name"], *_pose_cells(one)) for label, one in bodies]
    for what, columns, cells in (
        ("id", _POSE if posed else ("centre, px",), marker_cells),
        ("body", _POSE, body_cells),
    ):
        shown = console.table("picture", what, *columns, rows=cells)
        for k, column in enumerate(shown.columns):
            column.no_wrap = k > 0 and len(columns) > 1
        if cells:
            console.show(shown)
    for label, one in bodies:
        if one["rejected"]:
            ids = ", ".join(map(str, one["rejected"]))
            odd = f"{label}: {one['name']} without {ids}, at odds with its other markers"
            console.show(Text(odd, style="yellow"))


def _centre(corners: Any) -> str:
    return " ".join(f"{x:.2f}" for x in np.mean(corners, axis=0))


def _picture_label(row: PictureMarkers) -> str:
    return f"{Path(row.file).name} #{row.frame}" if row.in_film else Path(row.file).name


def _pose_cells(values: dict[str, Any]) -> list[object]:
    """Return position, tilt, reprojection error, ambiguity and standard deviation."""
    pose: Pose = values["pose"]
    away = pose.rotation[:, 2] @ pose.position / -np.linalg.norm(pose.position)
    sigma = np.sqrt(np.diag(values["covariance"]))
    doubtful = values["ambiguity"] > _DOUBTFUL
    return [
        " ".join(f"{x:z.4f}" for x in pose.position),
        f"{np.degrees(np.arccos(np.clip(away, -1.0, 1.0))):.1f}°",
        f"{values['reprojection_error']:.2f} px",
        Text(f"{values['ambiguity']:.2f}", style="yellow" if doubtful else ""),
        f"{1e3 * sigma[:3].max():.2f} mm {np.degrees(sigma[3:].max()):.2f}°",
    ]


@dataclass(frozen=True)
class CameraLocateOptions:
    """Finds where a camera stands from a board whose pose is known, and writes it to a file.

    Neither camera nor board may move meanwhile. Exit code 1, and no file, when no picture shows the
    board or none agrees with the others. The board's frame: markers and grids have their origin in
    the middle, x right, y up, z out of the print; chessboard and charuco have OpenCV's, z into the
    board.
    """

    source: Annotated[Positional[str], arg(metavar="SOURCE")]
    """A picture, folder, film, camera's index or URL."""
    intrinsics: Annotated[str, arg(metavar="FILE")]
    """Calibration of the camera."""
    board: BoardName
    pose_world_board: Annotated[tuple[float, ...], single(XYZ_WXYZ, "the world's")] = ()
    """Where the board's frame is: metres, and an orientation as a quaternion."""
    dictionary: Dictionary = ""
    parent: str = "world"
    """Name of the frame that the board's pose is given in."""
    frames: Annotated[int, arg(metavar="N"), Range(1, 10_000, " pictures")] = 20
    """How many pictures to average, where the source has more than one."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("place.toml")
    """Where the extrinsics go."""
    overwrite: Overwrite = False
    json: Json = False


def run_locate(options: CameraLocateOptions) -> int:
    """Locate the camera and return the exit code: 1 if no picture is usable."""
    from robot_ik.jobs import locate

    pose = pose_option(options.pose_world_board, "--pose-world-board") or Pose()
    request = request_of(
        locate.LocateRequest, options, pose_parent_board=pose, pictures=options.frames
    )
    with claimed(options.out, overwrite=options.overwrite):
        with console.progress() as bar:
            report = locate.run_locate(
                request,
                progress=console.shares_on(bar, "locate"),
                left_out=lambda why: console.say(f"left out: {why}", "yellow"),
            )
        if report.doubt:
            console.say(f"doubtful: {report.doubt}", "yellow")
        if not report.believed:
            console.say(f"no picture is believed: {options.out} is not written", "yellow")
            return console.NOT_ACHIEVED
        report.extrinsics.save(options.out)
    _print_located(report, options)
    return console.DONE


def _print_located(report: LocateReport, options: CameraLocateOptions) -> None:
    extrinsics = report.extrinsics
    used = len(report.errors)
    if options.json:
        facts = {
            "schema": 1,
            "job": "locate",
            "file": options.out,
            "parent": extrinsics.parent,
            "camera": extrinsics.pose_parent_camera,
            "sigma_position_m": extrinsics.sigma_position,
            "sigma_angle_rad": extrinsics.sigma_angle,
            "residual_px": extrinsics.residual_px,
            "residual_mm": extrinsics.residual_mm,
            "pictures": report.searched,
            "used": used,
        }
        console.print_json(facts)
        return
    sigma = (
        f"{1e3 * extrinsics.sigma_position:.2f} mm, {math.degrees(extrinsics.sigma_angle):.3f} deg"
    )
    rows = (
        (f"camera seen from {extrinsics.parent}", pose_text(extrinsics.pose_parent_camera)),
        ("stated uncertainty", f"{sigma} (one sigma; the board's pose is assumed to be exact)"),
        (
            "corners miss by",
            f"{extrinsics.residual_px:.3f} px, {extrinsics.residual_mm:.3f} mm (RMS)",
        ),
        ("pictures", f"{used} of {report.searched} show the board"),
    )
    console.show(console.facts(*rows))
    console.say(f"wrote {options.out}", "green")


@dataclass(frozen=True)
class CameraPrintOptions:
    """Writes a sheet to print: markers, a board of them, a cube to fold, or a calibration pattern.

    Print it at 100 % ("actual size", no "fit to page") and measure both bars on it: 100 mm. What
    does not fit the page is refused.
    """

    kind: Positional[Literal["marker", "board", "cube", "charuco", "chessboard"]]
    """marker (one or more), board (a grid), cube (to cut out and fold), charuco, chessboard."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("sheet.pdf")
    """Where to write the PDF."""
    size_mm: Annotated[float | None, single("MM", "by kind")] = None
    """Side of a marker's black square (50; cube 40) or a pattern's (charuco 30, chessboard 25)."""
    columns: Annotated[int | None, single("N", "by kind")] = None
    """Board: markers (2). charuco: squares (8). chessboard: inner corners, as OpenCV counts (9)."""
    rows: Annotated[int | None, single("N", "by kind")] = None
    """The same downwards: board 2, charuco 6, chessboard 6."""
    ids: Annotated[tuple[int, ...], several("ID", "0, 1, 2, …")] = ()
    """marker: any. board: the upper left one. cube: front, right, back, left, top, bottom."""
    dictionary: Annotated[str, arg(metavar="NAME")] = "DICT_5X5_50"
    """Dictionary of the markers."""
    gap_mm: Annotated[float | None, single("MM", "by kind")] = None
    """White between the markers of a sheet or board (a quarter of the marker)."""
    edge_mm: Annotated[float | None, single("MM", "1.25 markers")] = None
    """Edge of the cube."""
    marker_mm: Annotated[float | None, single("MM", "0.73 squares")] = None
    """Side of the markers inside a charuco board."""
    page: Literal["a4", "letter", "a3"] = "a4"
    """Paper; it is turned when that makes it fit."""
    overwrite: Overwrite = False
    body: Annotated[Path | None, single("FILE", "none")] = None
    """board, cube: also write where its markers are (TOML), for whatever tracks it as one body."""


def run_print(options: CameraPrintOptions) -> int:
    """Write the sheet and print what it shows."""
    from robot_ik.camera.sheets.page import write_sheet
    from robot_ik.camera.sheets.sheets import SheetRequest, body_file, make_sheet_page

    with claimed(options.out, options.body, overwrite=options.overwrite):
        request = request_of(SheetRequest, options)
        page = make_sheet_page(request)
        if options.body is not None:
            write_atomically(options.body, body_file(request, options.body.stem))
            console.say(f"wrote {options.body}: where its markers are", "green")
        write_sheet(page, options.out)
    console.say(f"wrote {options.out}: {page.about}", "green")
    console.say("print it at 100 % (actual size) and measure both bars: 100.0 mm")
    return console.DONE


@dataclass(frozen=True)
class CameraCalibrateOptions:
    """Calibrates a camera from views of a printed pattern (see: robot-ik camera print charuco).

    Pictures and folders are taken whole. From a camera, stream, film or synthetic:charuco a view is
    taken by itself when the board is held still in a new way, until nothing is missing; Ctrl-C ends
    it early and keeps what there is. The lens must not be focused or zoomed afterwards.
    """

    sources: Annotated[Positional[tuple[str, ...]], several("SOURCE")]
    """Pictures, folders, films, a camera's index, URLs; one after the other."""
    pattern: Literal["charuco", "chessboard"] = "charuco"
    """What is shown. Both layouts of a ChArUco board are tried."""
    columns: Annotated[int | None, single("N", "by pattern")] = None
    """charuco: squares (8). chessboard: inner corners, as OpenCV and ROS count (9)."""
    rows: Annotated[int | None, single("N", "by pattern")] = None
    """The same downwards: 6 and 6."""
    square_mm: Annotated[float | None, single("MM", "by pattern")] = None
    """Side of a square as measured on the print (charuco 30, chessboard 25)."""
    marker_mm: Annotated[float | None, single("MM", "0.73 squares")] = None
    """Side of the markers of a charuco board."""
    dictionary: Annotated[str, arg(metavar="NAME")] = "DICT_5X5_50"
    """Dictionary of its markers."""
    coefficients: Literal[5, 8] = 5
    """Of the lens: 5, or 8 for a wide one."""
    views: Annotated[int, arg(metavar="N")] = 20
    """Views to take from a moving source before it may end."""
    size: Annotated[tuple[int, int] | None, single("W H", "as it is")] = None
    """Picture size to ask of a camera, pixels."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("camera.yaml")
    """Where to write the calibration. The views of a live camera are saved beside it."""
    overwrite: bool = False
    """Replace the calibration. Views that were taken before are kept."""
    name: str = "camera"
    """Name of the camera in the file."""
    json: Json = False


def run_calibrate(options: CameraCalibrateOptions) -> int:
    """Gather views, calibrate the camera, write the file and print its quality."""
    if not options.sources:
        raise CameraError(
            "nothing to calibrate from",
            hint="give pictures, a folder of them, a film, or a camera's index: 0",
        )
    with claimed(options.out, overwrite=options.overwrite):
        return _calibrate(options)


def _calibrate(options: CameraCalibrateOptions) -> int:
    from robot_ik.camera.calibration.intrinsic import calibrate
    from robot_ik.camera.calibration.views import ViewGatherer
    from robot_ik.camera.patterns import PatternRequest
    from robot_ik.jobs.pictures import ViewFolder

    wanted = request_of(PatternRequest, options, kind=options.pattern)
    gatherer = ViewGatherer(wanted.pattern())
    kept = ViewFolder(options.out, options.sources)
    _gather(options, gatherer, kept)
    try:
        result = calibrate(
            gatherer.views,
            gatherer.size or (0, 0),
            coefficients=options.coefficients,
            name=options.name,
        )
    except (CalibrationError, KeyboardInterrupt):
        if kept.count:
            sources = [text for text in options.sources if Path(text) != kept.folder]
            arguments = " ".join([str(kept.folder), *sources])
            console.say(
                f"to go on with the views that are kept: robot-ik camera calibrate {arguments} …"
            )
        raise
    intrinsics = replace(result.intrinsics, date=timestamp())
    intrinsics.save(options.out)
    if options.json:
        console.print_json(_calibration_json(result, options.out, intrinsics.digest))
    else:
        _print_calibration(result)
    console.say(f"wrote {options.out}", "green")
    return console.DONE


def _gather(options: CameraCalibrateOptions, gatherer: ViewGatherer, kept: ViewFolder) -> None:
    """Gather the views of all sources. Ctrl-C and a lost camera keep the views so far."""
    from robot_ik.jobs.pictures import gather_views

    stopped = ""
    try:
        for name in options.sources:
            gather_views(name, gatherer, kept, options.views, size=options.size, say=console.say)
    except FrameTimeoutError as error:
        if not gatherer.views:
            raise
        stopped = str(error.args[0])
    except KeyboardInterrupt:
        stopped = "stopped"
    if stopped:
        where = f" in {kept.folder}" if kept.count else ""
        console.say(f"{stopped}; {len(gatherer.views)} views are kept{where}", "yellow")
    gatherer.finish()
    for notice in gatherer.notices:
        console.say(notice, "yellow")


def _print_calibration(result: CalibrationResult) -> None:
    views = [
        (view.name, view.corners, "-" if view.rms is None else f"{view.rms:.3f} px", view.left_out)
        for view in result.per_view
    ]
    camera = result.intrinsics
    names = ("fx", "fy", "cx", "cy", *_COEFFICIENTS[: len(camera.distortion)])
    values = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    numbers = [
        (name, f"{value:.3f} px", f"{std:.3g} px")
        if name[0] in "fc"
        else (name, f"{value:.5f}", f"{std:.3g}")
        for name, value, std in zip(names, values, camera.std, strict=True)
    ]
    console.show(
        console.table("view", "corners", "error", "left out", rows=views),
        "",
        console.table("number", "value", "standard deviation", rows=numbers),
        Text(f"\n{result.verdict}", style="yellow" if result.doubts else "green"),
        *(Text(f"- {doubt}", style="yellow") for doubt in result.doubts),
    )


def _calibration_json(result: CalibrationResult, out: Path, digest: str) -> dict[str, Any]:
    camera = result.intrinsics
    return {
        "schema": 1,
        "file": out,
        "digest": digest,
        "size": camera.size,
        "f": (camera.fx, camera.fy),
        "c": (camera.cx, camera.cy),
        "model": camera.model,
        "distortion": camera.distortion,
        "std": camera.std,
        "rms_px": camera.rms,
        "hold_out_rms_px": result.hold_out_rms,
        "views": [
            {"name": v.name, "corners": v.corners, "rms_px": v.rms, "left_out": v.left_out}
            for v in result.per_view
        ],
        "verdict": result.verdict,
        "doubts": result.doubts,
    }
