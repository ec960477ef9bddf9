"""``robot-ik camera calibrate``: measure the lens of a camera from views of a pattern."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.text import Text

from robot_ik.commands.options import (
    CharucoMarkerMm,
    Dictionary,
    JsonOption,
    OverwriteOption,
    PatternColumns,
    PatternRows,
    ResultFile,
    ViewCount,
)
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import CalibrationError, FrameTimeoutError, OptionError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from robot_ik.camera.calibration.intrinsic import CalibrationResult
    from robot_ik.camera.calibration.views import ViewGatherer
    from robot_ik.workcell.pictures import ViewFolder

COEFFICIENT_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Names of the distortion coefficients, in OpenCV's order."""


@dataclass(frozen=True)
class CameraCalibrate(OverwriteOption, JsonOption):
    """Measure focal length and distortion of a camera from views of a printed pattern.

    All pictures of a folder are used. From a camera, a stream or a film, a view is taken whenever
    the board is held still in a new pose, until no view is missing. Ctrl-C ends the recording
    early, and the views are used. Do not focus or zoom the lens afterwards.

        robot-ik camera print charuco
        robot-ik camera calibrate 0 --out webcam.yaml
    """

    sources: Annotated[tuple[str, ...], Parameter(name="SOURCE …")] = ()
    """Pictures, folders, films, camera indices or URLs, used one after the other."""
    _: KW_ONLY
    pattern: Literal["charuco", "chessboard"] = "charuco"
    """The printed pattern. Both layouts of a ChArUco board are tried."""
    columns: PatternColumns = None
    rows: PatternRows = None
    square_mm: Annotated[float | None, Parameter(metavar="MM")] = None
    """Side of a square of the print in mm. Default: charuco 30, chessboard 25."""
    marker_mm: CharucoMarkerMm = None
    dictionary: Dictionary = "DICT_5X5_50"
    views: Annotated[ViewCount, Parameter(validator=Number(gte=1))] = 20
    size: Annotated[tuple[int, int] | None, Parameter(metavar="W H")] = None
    """Picture size in pixels. Default: the current size of the camera."""
    out: ResultFile = Path("camera.yaml")

    def run(self, terminal: Terminal = QUIET) -> CameraCalibrateReport:
        """Gather views, calibrate, and write the file. Views of a live camera are saved beside it.

        Raises:
            CalibrationError: The views do not determine the camera.
        """
        from robot_ik.camera.calibration.intrinsic import calibrate  # NumPy and OpenCV
        from robot_ik.camera.calibration.views import ViewGatherer
        from robot_ik.camera.patterns import PatternRequest
        from robot_ik.files import timestamp
        from robot_ik.workcell.pictures import ViewFolder

        if not self.sources:
            hint = "give pictures, a folder of pictures, a film, or a camera index: 0"
            raise OptionError("SOURCE", "there is nothing to calibrate from", hint=hint)
        request = PatternRequest(
            kind=self.pattern,
            columns=self.columns,
            rows=self.rows,
            square_mm=self.square_mm,
            marker_mm=self.marker_mm,
            dictionary=self.dictionary,
        )
        gatherer = ViewGatherer(request.pattern())
        folder = ViewFolder(self.out, self.sources)
        self._gather(gatherer, folder, terminal)
        terminal.progress("calibrating")
        try:
            result = calibrate(
                gatherer.views, gatherer.size or (0, 0), coefficients=None, name=self.out.stem
            )
        except (CalibrationError, KeyboardInterrupt):
            if folder.count:
                sources = [name for name in self.sources if Path(name) != folder.folder]
                arguments = " ".join([str(folder.folder), *sources])
                command = f"robot-ik camera calibrate {arguments}"
                terminal.say(f"to continue with the saved views: {command}")
            raise
        result = replace(result, intrinsics=replace(result.intrinsics, date=timestamp()))
        result.intrinsics.save(self.out)
        return CameraCalibrateReport(self.out, result)

    def _gather(self, gatherer: ViewGatherer, folder: ViewFolder, terminal: Terminal) -> None:
        """Gather the views of all sources. Ctrl-C and a lost camera keep the views so far."""
        from robot_ik.workcell.pictures import gather_views

        reason = ""
        try:
            for name in self.sources:
                gather_views(name, gatherer, folder, self.views, size=self.size, say=terminal.say)
        except FrameTimeoutError as error:
            if not gatherer.views:
                raise
            reason = str(error.args[0])
        except KeyboardInterrupt:
            reason = "stopped"
        if reason:
            place = f" in {folder.folder}" if folder.count else ""
            terminal.say(f"{reason}; {len(gatherer.views)} views are kept{place}", "yellow")
        gatherer.finish()
        for notice in gatherer.notices:
            terminal.say(notice, "yellow")


@dataclass(frozen=True, eq=False)
class CameraCalibrateReport(Report):
    """The calibration.

    Attributes:
        out: The file.
        result: Intrinsics, errors of the views and doubts.
    """

    out: Path
    result: CalibrationResult

    @property
    def hints(self) -> list[str]:
        return [f"wrote {self.out}"]

    def tables(self) -> Iterable[RenderableType]:
        yield table("view", "corners", "error", "left out", rows=self._view_rows())
        yield table("number", "value", "standard deviation", rows=self._number_rows())
        yield ""
        yield Text(self.result.verdict, style="yellow" if self.result.doubts else "green")
        for doubt in self.result.doubts:
            yield Text(f"- {doubt}", style="yellow")

    def _view_rows(self) -> list[tuple[object, ...]]:
        return [
            (
                view.name,
                view.corners,
                "-" if view.rms is None else f"{view.rms:.3f} px",
                view.left_out,
            )
            for view in self.result.per_view
        ]

    def _number_rows(self) -> list[tuple[object, ...]]:
        camera = self.result.intrinsics
        pixels = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
        count = len(pixels)
        rows: list[tuple[object, ...]] = [
            (name, f"{value:.3f} px", f"{sigma:.3g} px")
            for (name, value), sigma in zip(pixels.items(), camera.std[:count], strict=True)
        ]
        names = COEFFICIENT_NAMES[: len(camera.distortion)]
        for name, value, sigma in zip(names, camera.distortion, camera.std[count:], strict=True):
            rows.append((name, f"{value:.5f}", f"{sigma:.3g}"))
        return rows

    def facts(self) -> dict[str, Any]:
        result = self.result
        camera = result.intrinsics
        return {
            "file": self.out,
            "digest": camera.digest,
            "size": camera.size,
            "f": (camera.fx, camera.fy),
            "c": (camera.cx, camera.cy),
            "model": camera.model,
            "distortion": camera.distortion,
            "std": camera.std,
            "rms_px": camera.rms,
            "hold_out_rms_px": result.hold_out_rms,
            "views": [
                {
                    "name": view.name,
                    "corners": view.corners,
                    "rms_px": view.rms,
                    "left_out": view.left_out,
                }
                for view in result.per_view
            ],
            "verdict": result.verdict,
            "doubts": result.doubts,
        }
