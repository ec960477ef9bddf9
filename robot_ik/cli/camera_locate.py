"""``robot-ik camera locate``: where a camera stands, from a board at a known place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.poses import pose_option, pose_words
from robot_ik.errors import CameraNotFoundError, FrameTimeoutError, MarkerNotFoundError
from robot_ik.files import claimed

if TYPE_CHECKING:
    from robot_ik.camera.boards.board import Board
    from robot_ik.camera.boards.view import BoardView
    from robot_ik.camera.handeye.places import CameraPlace
    from robot_ik.camera.intrinsics import CameraIntrinsics
    from robot_ik.geometry import Pose

# Corners of a good calibration and a flat board miss by a few tenths of a pixel.
_DOUBTFUL_PX = 1.0


@dataclass(frozen=True)
class CameraLocateOptions:
    """Finds where a camera stands from a board whose place is known, and writes it to a file.

    Neither camera nor board may move meanwhile. Exit code 1, and no file, when no picture shows the board or
    none agrees with the others. The board's frame: markers and grids have their origin in
    the middle, x right, y up, z out of the print; chessboard and charuco have OpenCV's, z into the board.
    """

    source: Positional[str]
    """A picture, folder, film, camera's index or URL."""
    intrinsics: Annotated[str, arg(metavar="FILE")]
    """Calibration of the camera."""
    board: Annotated[str, arg(metavar="BOARD")]
    """marker:ID:MM, grid:COLUMNSxROWS:MM:GAP_MM, charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM,
    chessboard:COLUMNSxROWS:SQUARE_MM or FILE.toml[:NAME]."""
    pose_world_board: Annotated[
        tuple[float, ...], arg(metavar="X Y Z [W X Y Z]", help_behavior_hint="(default: the world's)")
    ] = ()
    """Where the board's frame is: metres, and an orientation as a quaternion."""
    dictionary: Annotated[str, arg(metavar="NAME", help_behavior_hint="(default: DICT_5X5_50)")] = ""
    """Of the board's markers."""
    parent: str = "world"
    """Name of the frame that the board's place is given in."""
    frames: Annotated[int, arg(metavar="N")] = 20
    """How many pictures to average, where the source has more than one."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("place.toml")
    """Where the place goes."""
    overwrite: bool = False
    """Replace that file."""
    json: bool = False
    """Print one JSON object on stdout."""


def run(options: CameraLocateOptions) -> int:
    """Looks, fits, writes."""
    from robot_ik.camera.boards.board import parse_board
    from robot_ik.camera.intrinsics import CameraIntrinsics
    from robot_ik.geometry import Pose

    if not 1 <= options.frames <= 10_000:
        raise wrong("--frames", f"{options.frames} pictures", "1 to 10000")
    board = parse_board(options.board, options.dictionary)
    pose = pose_option(options.pose_world_board, "--pose-world-board") or Pose()
    intrinsics = CameraIntrinsics.load(options.intrinsics)
    with claimed(options.out, overwrite=options.overwrite):
        return _locate(options, board, pose, intrinsics)


def _locate(options: CameraLocateOptions, board: Board, pose: Pose, intrinsics: CameraIntrinsics) -> int:
    from robot_ik.camera.handeye.places import locate_camera

    views, looked = _look(options, board, intrinsics)
    if not views:
        raise MarkerNotFoundError(
            f"the board {options.board} is in none of {looked} pictures of {options.source}",
            hint="check its sizes and dictionary, light and focus; the whole board should be in view",
        )
    place = locate_camera(views, pose, intrinsics, parent=options.parent)
    doubtful = _doubtful(views, place.pose_parent_camera.inverse() @ pose, intrinsics)
    if doubtful == len(views):
        console.say(f"no picture is believed: {options.out} is not written", "yellow")
        return console.NOT_ACHIEVED
    place.save(options.out)
    if options.json:
        console.print_json(_as_json(place, options, len(views), looked))
        return console.DONE
    facts = console.table("", "")
    facts.show_header = False
    facts.add_row(f"camera seen from {place.parent}", pose_words(place.pose_parent_camera))
    sigma = f"{1e3 * place.sigma_position:.2f} mm, {math.degrees(place.sigma_angle):.3f} deg"
    facts.add_row("stated uncertainty", f"{sigma} (one sigma; the board's place is taken for exact)")
    facts.add_row("corners miss by", f"{place.residual_px:.3f} px, {place.residual_mm:.3f} mm (RMS)")
    facts.add_row("pictures", f"{len(views)} of {looked} show the board")
    console.out().print(facts)
    console.say(f"wrote {options.out}", "green")
    return console.DONE


def _doubtful(views: Sequence[BoardView], seen: Pose, intrinsics: CameraIntrinsics) -> int:
    """How many pictures have the board elsewhere than all together (``seen`` by the camera); says so."""
    off = [
        float(np.median(np.linalg.norm(intrinsics.project(seen.apply(view.points)) - view.pixels, axis=1)))
        for view in views
    ]
    count = sum(miss > _DOUBTFUL_PX for miss in off)
    if not count:
        return 0
    why = "the board is not flat or not of this size, or the calibration is of another camera"
    if len(views) > 1:
        why = f"camera or board moved, or {why}"
    told = f"doubtful: in {count} of {len(views)} pictures the board is elsewhere, by up to {max(off):.1f} px"
    console.say(f"{told}: {why}", "yellow")
    return count


def _look(
    options: CameraLocateOptions, board: Board, intrinsics: CameraIntrinsics
) -> tuple[list[BoardView], int]:
    """The views of the board, and how many pictures were looked at."""
    from robot_ik.camera.sources import open_source

    views, looked = [], 0
    with open_source(options.source) as source, console.progress() as bar:
        task = bar.add_task("looking", total=options.frames, note="")
        while looked < options.frames and not getattr(source, "exhausted", False):
            try:
                frame = source.read()
            except FrameTimeoutError:
                break
            except CameraNotFoundError as error:  # one file of a folder
                console.say(f"left out: {error.args[0]}", "yellow")
                continue
            looked += 1
            view = board.see(frame, intrinsics)
            if view is not None:
                views.append(view)
            bar.update(task, completed=looked)
    return views, looked


def _as_json(place: CameraPlace, options: CameraLocateOptions, used: int, looked: int) -> dict[str, Any]:
    camera = place.pose_parent_camera
    return {
        "schema": 1,
        "job": "locate",
        "file": str(options.out),
        "parent": place.parent,
        "camera": {"position": camera.position, "wxyz": camera.wxyz},
        "sigma_position_m": place.sigma_position,
        "sigma_angle_rad": place.sigma_angle,
        "residual_px": place.residual_px,
        "residual_mm": place.residual_mm,
        "pictures": looked,
        "used": used,
    }
