"""``robot-ik camera handeye``: measure where a camera is mounted, by moving the arm."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from robot_ik.commands.camera_arm import (
    ArmCameraOptions,
    Views,
    found_numbers,
    measure,
    plan_facts,
    plan_table,
)
from robot_ik.commands.options import ResultFile, parse_pose
from robot_ik.commands.tables import pairs_table, pose_text, table
from robot_ik.commands.terminal import QUIET, Report, Terminal

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.camera.calibration.handeye import HandEye
    from robot_ik.workcell.arm_camera.camera_and_board import HandEyeRequest
    from robot_ik.workcell.arm_camera.handeye import HandEyeReport


@dataclass(frozen=True, kw_only=True)
class CameraHandeye(ArmCameraOptions):
    """Measure where a camera is mounted: move the arm through planned views of a board.

    eye-to-hand: the camera stands beside the arm, and the arm carries the board. eye-in-hand: the
    arm carries the camera, and the board does not move. By default everything is simulated, and the
    true error is printed beside the estimated one. Ctrl-C keeps the samples; --samples evaluates
    them.

        robot-ik camera handeye --bus /dev/ttyUSB0 --camera 0 --intrinsics camera.yaml
    """

    mounting: Literal["eye-in-hand", "eye-to-hand"] = "eye-to-hand"
    """Whether the arm carries the camera or the board."""
    camera_guess: Annotated[
        tuple[float, ...],
        Parameter(
            metavar="X Y Z [W X Y Z]",
            consume_multiple=True,
            help="Rough pose of the camera, to plan the views. It is seen from the world "
            "(eye-to-hand) or from the frame that carries the camera. Default: the scene's.",
        ),
    ] = ()
    board_guess: Annotated[
        tuple[float, ...],
        Parameter(
            metavar="X Y Z [W X Y Z]",
            consume_multiple=True,
            help="Rough pose of the board, to plan the views. It is seen from the frame that "
            "carries the board (eye-to-hand) or from the world. Default: the scene's.",
        ),
    ] = ()
    views: Views = 15
    out: ResultFile = Path("extrinsics.toml")

    def written_files(self) -> list[Path]:
        """Return the files that this run writes. The samples are beside the result."""
        from robot_ik.workcell.arm_camera.handeye import samples_path

        if self.dry_run:
            return []
        return [self.out] if self.samples else [self.out, samples_path(self.out)]

    def run(self, terminal: Terminal = QUIET) -> CameraHandeyeReport:
        """Measure, or evaluate earlier samples, and write the pose of the camera."""
        from robot_ik.camera.intrinsics import CameraIntrinsics  # NumPy and OpenCV
        from robot_ik.workcell.arm_camera import handeye
        from robot_ik.workcell.arm_camera.samples import SampleSet

        if self.samples is not None:
            lens = None if self.intrinsics is None else CameraIntrinsics.load(self.intrinsics)
            result = handeye.handeye_from_samples(SampleSet.load(self.samples), lens)
        else:
            job = partial(handeye.run_handeye, self.request())
            file = handeye.samples_path(self.out)
            result = measure(job, file, "robot-ik camera handeye", terminal)
        if result.result is not None:
            result.extrinsics().save(self.out)
        return CameraHandeyeReport(self.out, result)

    def request(self) -> HandEyeRequest:
        """Return the request of the options.

        Raises:
            OptionError: An option is invalid.
            CameraError: The board is invalid.
        """
        from robot_ik.workcell.arm_camera.camera_and_board import HandEyeRequest

        return HandEyeRequest(
            **self.request_values("angles to read"),
            views=self.views,
            mounting="eye_in_hand" if self.mounting == "eye-in-hand" else "eye_to_hand",
            pose_parent_camera=parse_pose("--camera-guess", self.camera_guess),
            pose_other_board=parse_pose("--board-guess", self.board_guess),
        )


@dataclass(frozen=True, eq=False)
class CameraHandeyeReport(Report):
    """The pose of the camera, or the planned views.

    Attributes:
        out: The file of the pose.
        measured: The measurement. A dry run has no result.
    """

    out: Path
    measured: HandEyeReport

    @property
    def notes(self) -> list[str]:
        return [self.measured.doubt] if self.measured.doubt else []

    @property
    def hints(self) -> list[str]:
        return [] if self.measured.result is None else [f"wrote {self.out}"]

    def tables(self) -> Iterable[Table]:
        measured = self.measured
        result = measured.result
        if result is None:
            yield plan_table("view", measured.samples.joints, measured.stations)
            return
        columns = ("view", "px", "left out: px", "mm", "deg", "sigmas", "")
        yield table(*columns, rows=self._view_rows(result))
        yield pairs_table(self._pairs(result))

    def _view_rows(self, result: HandEye) -> list[tuple[object, ...]]:
        numbers = found_numbers(len(result.residuals), self.measured.unseen)
        return [
            (
                number,
                f"{view.pixels:.2f}",
                f"{view.left_out_pixels:.2f}",
                f"{1e3 * view.left_out_position:.2f}",
                f"{math.degrees(view.left_out_angle):.3f}",
                f"{view.sigmas:.1f}",
                "contradicts the others: left out" if view.outlier else "",
            )
            for number, view in zip(numbers, result.residuals, strict=True)
        ]

    def _pairs(self, result: HandEye) -> list[tuple[str, str]]:
        measured = self.measured
        carrier = measured.samples.frame
        board = "world" if measured.parent != "world" else carrier
        sigma = mm_deg(result.sigma_position, result.sigma_angle)
        spread = ", ".join(f"{math.degrees(value):.0f}" for value in result.spread)
        pairs = [
            (f"camera seen from {measured.parent}", pose_text(result.pose_parent_camera)),
            (f"board seen from {board}", pose_text(result.pose_other_board)),
            ("uncertainty", f"{sigma} (one sigma)"),
        ]
        if measured.true_error is not None:
            pairs.append(("true error", mm_deg(*measured.true_error)))
        arm = mm_deg(result.arm_position, result.arm_angle)
        pairs.append(("error of the arm", f"{arm} (each axis)"))
        pairs.append(("spread of rotations", f"{spread} deg about the three axes"))
        if measured.unseen:
            numbers = ", ".join(str(k + 1) for k in measured.unseen)
            pairs.append(("board not seen at", numbers))
        return pairs

    def facts(self) -> dict[str, Any]:
        measured = self.measured
        result = measured.result
        facts = plan_facts(measured, "handeye")
        if result is None:
            return facts
        return facts | {
            "parent": measured.parent,
            "file": self.out,
            "camera": result.pose_parent_camera,
            "board": result.pose_other_board,
            "sigma_position_m": result.sigma_position,
            "sigma_angle_rad": result.sigma_angle,
            "true_error": measured.true_error,
            "arm_position_m": result.arm_position,
            "arm_angle_rad": result.arm_angle,
            "outliers": result.outliers,
            "doubt": measured.doubt,
            "views": [
                {
                    "px": view.pixels,
                    "left_out_px": view.left_out_pixels,
                    "left_out_m": view.left_out_position,
                    "left_out_rad": view.left_out_angle,
                    "sigmas": view.sigmas,
                }
                for view in result.residuals
            ],
        }


def mm_deg(position: float, angle: float) -> str:
    """Return a position error (m) and an angle error (rad) as text."""
    return f"{1e3 * position:.3f} mm, {math.degrees(angle):.4f} deg"
