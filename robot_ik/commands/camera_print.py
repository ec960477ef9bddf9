"""``robot-ik camera print``: make a sheet of markers or a pattern to print."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from robot_ik.commands.options import (
    OUTPUT,
    OUTPUT_GROUP,
    CharucoMarkerMm,
    Dictionary,
    MarkerIds,
    OverwriteOption,
    PatternColumns,
    PatternRows,
    ResultFile,
)
from robot_ik.commands.terminal import QUIET, Report, Terminal


@dataclass(frozen=True)
class CameraPrint(OverwriteOption):
    """Make a PDF of markers, a board of markers, a cube to fold, or a calibration pattern.

    Print it at 100 % ("actual size", not "fit to page"), and measure both bars on the sheet: they
    must be 100 mm long. A sheet that does not fit the page is refused.

        robot-ik camera print board --size-mm 40 --body table.toml
    """

    kind: Annotated[
        Literal["marker", "board", "cube", "charuco", "chessboard"], Parameter(name="KIND")
    ]
    """marker (one or more), board (a grid of markers), cube (to fold), charuco or chessboard."""
    _: KW_ONLY
    size_mm: Annotated[
        float | None,
        Parameter(
            metavar="MM",
            help="Side of the black square of a marker, or of a square of a pattern, in mm. "
            "Default: 50, cube 40, charuco 30, chessboard 25.",
        ),
    ] = None
    columns: PatternColumns = None
    rows: PatternRows = None
    id: MarkerIds = ()
    dictionary: Dictionary = "DICT_5X5_50"
    gap_mm: Annotated[float | None, Parameter(metavar="MM")] = None
    """White between the markers in mm. Default: a quarter of a marker."""
    marker_mm: CharucoMarkerMm = None
    page: Literal["a4", "letter", "a3"] = "a4"
    """Paper. The sheet is turned if it fits only then."""
    out: ResultFile = Path("sheet.pdf")
    body: Annotated[
        Path | None,
        Parameter(
            metavar="FILE.toml",
            group=OUTPUT_GROUP,
            help="For board and cube: also write the poses of the markers, for programs that track "
            "the board or cube as one body.",
        ),
        OUTPUT,
    ] = None

    def run(self, _terminal: Terminal = QUIET) -> CameraPrintReport:
        """Write the sheet and, with ``body``, the poses of its markers."""
        from robot_ik.camera.sheets.page import write_sheet  # NumPy and OpenCV
        from robot_ik.camera.sheets.sheets import SheetRequest, body_file, make_sheet_page
        from robot_ik.files import write_atomically

        request = SheetRequest(
            kind=self.kind,
            size_mm=self.size_mm,
            columns=self.columns,
            rows=self.rows,
            id=self.id,
            dictionary=self.dictionary,
            gap_mm=self.gap_mm,
            marker_mm=self.marker_mm,
            page=self.page,
        )
        page = make_sheet_page(request)
        if self.body is not None:
            write_atomically(self.body, body_file(request, self.body.stem))
        write_sheet(page, self.out)
        return CameraPrintReport(self.out, self.body, page.about)


@dataclass(frozen=True)
class CameraPrintReport(Report):
    """The files.

    Attributes:
        out: The sheet.
        body: Poses of the markers, or None.
        about: What the sheet shows.
    """

    out: Path
    body: Path | None
    about: str

    def tables(self) -> Iterable[str]:
        if self.body is not None:
            yield f"{self.body}: poses of the markers"
        yield f"{self.out}: {self.about}"
        yield "print it at 100 % (actual size) and measure both bars: 100.0 mm"

    def facts(self) -> dict[str, Any]:
        return {"file": self.out, "body": self.body, "about": self.about}
