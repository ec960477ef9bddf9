"""``robot-ik camera locate``: measure the pose of a camera from a board of known pose."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.options import (
    INTRINSICS_HELP,
    BoardName,
    BoardPose,
    Dictionary,
    JsonOption,
    OverwriteOption,
    ResultFile,
    parse_pose,
)
from robot_ik.commands.tables import pairs_table, pose_text
from robot_ik.commands.terminal import QUIET, Report, Terminal

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.workcell.locate import LocateReport

MAX_PICTURES = 10_000
"""Largest number of pictures that are read."""


@dataclass(frozen=True)
class CameraLocate(OverwriteOption, JsonOption):
    """Measure the pose of a camera from pictures of a board whose pose is known.

    Camera and board must not move between the pictures. The frame of a marker or a grid has its
    origin in the middle, x to the right, y up, and z out of the print. The frame of a chessboard or
    ChArUco board is that of OpenCV, with z into the board.

        robot-ik camera locate 0 --intrinsics camera.yaml --board marker:7:100

    Exit code 1, and no file: no picture shows the board, or no picture agrees with the others.
    """

    source: Annotated[str, Parameter(name="SOURCE")]
    """Picture, folder, film, camera index or URL."""
    _: KW_ONLY
    intrinsics: Annotated[Path, Parameter(metavar="FILE", help=INTRINSICS_HELP)]
    board: BoardName
    board_pose: BoardPose = ()
    dictionary: Dictionary = "DICT_5X5_50"
    count: Annotated[int, Parameter(metavar="N", validator=Number(gte=1, lte=MAX_PICTURES))] = 20
    """Number of samples. Here: pictures to read, if the source has that many."""
    out: ResultFile = Path("extrinsics.toml")

    def run(self, terminal: Terminal = QUIET) -> CameraLocateReport:
        """Find the board in the pictures, and write the pose of the camera."""
        from robot_ik.geometry import Pose  # NumPy and OpenCV
        from robot_ik.workcell import locate

        request = locate.LocateRequest(
            source=self.source,
            intrinsics=self.intrinsics,
            board=self.board,
            dictionary=self.dictionary,
            pose_world_board=parse_pose("--board-pose", self.board_pose) or Pose(),
            pictures=self.count,
        )
        result = locate.run_locate(
            request,
            progress=terminal.progress,
            left_out=lambda reason: terminal.say(f"left out: {reason}", "yellow"),
        )
        if result.believed:
            result.extrinsics.save(self.out)
        return CameraLocateReport(self.out, result)


@dataclass(frozen=True, eq=False)
class CameraLocateReport(Report):
    """The pose of the camera.

    Attributes:
        out: The file. It is written only if a picture agrees with the pose.
        result: The measurement.
    """

    out: Path
    result: LocateReport

    @property
    def ok(self) -> bool:
        return self.result.believed

    @property
    def notes(self) -> list[str]:
        notes = [f"doubtful: {self.result.doubt}"] if self.result.doubt else []
        if not self.ok:
            notes.append(f"no picture agrees with the others: {self.out} is not written")
        return notes

    @property
    def hints(self) -> list[str]:
        return [f"wrote {self.out}"] if self.ok else []

    def tables(self) -> Iterable[Table]:
        if not self.ok:
            return
        extrinsics = self.result.extrinsics
        sigma_angle = math.degrees(extrinsics.sigma_angle)
        sigma = f"{1e3 * extrinsics.sigma_position:.2f} mm, {sigma_angle:.3f} deg"
        count = len(self.result.errors)
        yield pairs_table(
            [
                (f"camera seen from {extrinsics.parent}", pose_text(extrinsics.pose_parent_camera)),
                ("uncertainty", f"{sigma} (one sigma; the board's pose is assumed to be exact)"),
                (
                    "reprojection error",
                    f"{extrinsics.residual_px:.3f} px, {extrinsics.residual_mm:.3f} mm (RMS)",
                ),
                ("pictures", f"{count} of {self.result.searched} show the board"),
            ]
        )

    def facts(self) -> dict[str, Any]:
        extrinsics = self.result.extrinsics
        return {
            "file": self.out if self.ok else None,
            "parent": extrinsics.parent,
            "camera": extrinsics.pose_parent_camera,
            "sigma_position_m": extrinsics.sigma_position,
            "sigma_angle_rad": extrinsics.sigma_angle,
            "residual_px": extrinsics.residual_px,
            "residual_mm": extrinsics.residual_mm,
            "doubt": self.result.doubt,
            "pictures": self.result.searched,
            "used": len(self.result.errors),
        }
