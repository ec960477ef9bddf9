"""``robot-ik camera calibrate``: from views of a printed pattern to a calibration file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.text import Text
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import Json, several, single
from robot_ik.errors import CalibrationError, CameraError, FrameTimeoutError
from robot_ik.files import claimed, timestamp

if TYPE_CHECKING:
    from robot_ik.camera.calibration.intrinsic import CalibrationResult
    from robot_ik.camera.calibration.views import ViewGatherer
    from robot_ik.jobs.pictures import ViewFolder


@dataclass(frozen=True)
class CameraCalibrateOptions:
    """Calibrates a camera from views of a printed pattern (see: robot-ik camera print charuco).

    Pictures and folders are taken whole. From a camera, stream, film or synthetic:charuco a view is taken by
    itself when the board is held still in a new way, until nothing is missing; Ctrl-C ends it early and keeps
    what there is. The lens must not be focused or zoomed afterwards.
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
    """Where to write the calibration; beside it come a picture of the coverage and the views taken live."""
    overwrite: bool = False
    """Replace the calibration and the picture of the coverage; views taken before are kept in any case."""
    name: str = "camera"
    """Name of the camera in the file."""
    json: Json = False


def run(options: CameraCalibrateOptions) -> int:
    """Gathers views, calibrates, writes the file and says what it is worth."""
    if not options.sources:
        raise CameraError(
            "nothing to calibrate from",
            hint="give pictures, a folder of them, a film, or a camera's index: 0",
        )
    with claimed(options.out, _coverage_file(options.out), overwrite=options.overwrite):
        return _calibrate(options)


def _calibrate(options: CameraCalibrateOptions) -> int:
    from robot_ik.camera.boards.patterns import PatternRequest
    from robot_ik.camera.calibration.coverage import coverage_picture
    from robot_ik.camera.calibration.intrinsic import calibrate
    from robot_ik.camera.calibration.views import ViewGatherer
    from robot_ik.camera.image import write_image
    from robot_ik.jobs.pictures import ViewFolder

    fields = ("columns", "rows", "square_mm", "marker_mm", "dictionary")
    wanted = PatternRequest(options.pattern, *(getattr(options, field) for field in fields))
    gatherer, kept = ViewGatherer(wanted.pattern()), ViewFolder(options.out, options.sources)
    _gather(options, gatherer, kept)
    try:
        result = calibrate(
            gatherer.views, gatherer.size or (0, 0), coefficients=options.coefficients, name=options.name
        )
    except (CalibrationError, KeyboardInterrupt):
        if kept.count:
            sources = [text for text in options.sources if Path(text) != kept.folder]
            arguments = " ".join([str(kept.folder), *sources])
            console.say(f"to go on with the views that are kept: robot-ik camera calibrate {arguments} …")
        raise
    intrinsics = replace(result.intrinsics, date=timestamp())
    intrinsics.save(options.out)
    picture = _coverage_file(options.out)
    write_image(picture, coverage_picture(result.coverage))
    if options.json:
        console.print_json(_as_json(result, options.out, intrinsics.digest))
    else:
        _print(result)
    console.say(f"wrote {options.out} and {picture}", "green")
    return console.DONE


def _gather(options: CameraCalibrateOptions, gatherer: ViewGatherer, kept: ViewFolder) -> None:
    """Views of all sources; neither Ctrl-C nor a camera that goes away loses those so far."""
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


def _coverage_file(out: Path) -> Path:
    return out.with_name(f"{out.stem}-coverage.png")


def _print(result: CalibrationResult) -> None:
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
        *(f"  {note}" for note in result.notes),
    )


_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def _as_json(result: CalibrationResult, out: Path, digest: str) -> dict[str, Any]:
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
        "views": [{"name": v.name, "corners": v.corners, "rms_px": v.rms, "left_out": v.left_out}
                  for v in result.per_view],
        "verdict": result.verdict,
        "doubts": result.doubts,
        "notes": result.notes,
        "edge_shift": camera.edge_shift,
        "edge_shift_sigma": camera.edge_shift_sigma,
    }  # fmt: skip
