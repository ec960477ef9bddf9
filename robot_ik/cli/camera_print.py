"""``robot-ik camera print``: markers, boards, cubes and calibration patterns on paper, at true scale."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.files import claimed, write_atomically

Kind = Literal["marker", "board", "cube", "charuco", "chessboard"]


@dataclass(frozen=True)
class CameraPrintOptions:
    """Writes a sheet to print: markers, a board of markers, a cube to fold, or a pattern to calibrate with.

    Print it at 100 % ("actual size", no "fit to page") and measure the bar of 100 mm on it. What does not
    fit the page is refused.
    """

    kind: Positional[Kind]
    """marker (one or more), board (markers in a grid), cube (to cut out and fold), charuco, chessboard."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("sheet.pdf")
    """Where to write: .pdf (exact lines) or .png (pixels, with its resolution inside)."""
    size_mm: Annotated[float | None, arg(metavar="MM", help_behavior_hint="(default: by kind)")] = None
    """Side of a marker's black square (marker 50, board 50, cube 40), or of a square of a pattern (charuco
    30, chessboard 25)."""
    columns: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: by kind)")] = None
    """Board: markers (2). charuco: squares (8). chessboard: inner corners, as OpenCV counts (9)."""
    rows: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: by kind)")] = None
    """The same downwards: board 2, charuco 6, chessboard 6."""
    ids: Annotated[tuple[int, ...], arg(metavar="ID …", help_behavior_hint="(default: 0, 1, 2, …)")] = ()
    """marker: any. board: the upper left one. cube: front, right, back, left, top, bottom."""
    dictionary: Annotated[str, arg(metavar="NAME")] = "DICT_5X5_50"
    """Dictionary of the markers."""
    gap_mm: Annotated[float | None, arg(metavar="MM", help_behavior_hint="(default: by kind)")] = None
    """White between the markers of a sheet or board (a quarter of the marker)."""
    edge_mm: Annotated[float | None, arg(metavar="MM", help_behavior_hint="(default: 1.25 markers)")] = None
    """Edge of the cube."""
    marker_mm: Annotated[float | None, arg(metavar="MM", help_behavior_hint="(default: 0.73 squares)")] = None
    """Side of the markers inside a charuco board."""
    page: Literal["a4", "letter", "a3"] = "a4"
    """Paper; it is turned when that makes it fit."""
    dpi: int = 300
    """Pixels per inch of a .png."""
    overwrite: bool = False
    """Replace files that are there."""
    body: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """board, cube: also write where its markers are (TOML), for whatever tracks it as one body."""


def run(options: CameraPrintOptions) -> int:
    """Writes the sheet and says what is on it."""
    with claimed(options.out, options.body, overwrite=options.overwrite):
        return _print_sheet(options)


def _print_sheet(options: CameraPrintOptions) -> int:
    from robot_ik.camera.sheets.blocks import SheetWish
    from robot_ik.camera.sheets.page import write_sheet
    from robot_ik.camera.sheets.sheet import make_sheet_page

    wish = SheetWish(**{name: getattr(options, name) for name in SheetWish.__dataclass_fields__})
    page = make_sheet_page(wish)
    if options.body is not None:
        from robot_ik.camera.sheets.bodies import body_file

        write_atomically(options.body, body_file(wish, options.body.stem))
        console.say(f"wrote {options.body}: where its markers are", "green")
    write_sheet(page, options.out, dpi=options.dpi)
    console.say(f"wrote {options.out}: {page.about}", "green")
    console.say("print it at 100 % (actual size) and measure the bar: 100.0 mm")
    return console.DONE
