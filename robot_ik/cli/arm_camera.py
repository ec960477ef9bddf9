"""What ``camera handeye`` and ``camera verify`` share: options of arm and camera, what Ctrl-C leaves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeVar

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    ArmFile,
    Dictionary,
    optional_path,
    pose_option,
    pose_text,
    require_share,
    robot_argument,
    wrong,
)
from robot_ik.cli.connection import bus_argument, resolved_robot
from robot_ik.environment import import_mujoco
from robot_ik.files import claimed

if TYPE_CHECKING:
    from robot_ik.jobs.arm_camera.handeye import HandEyeReport, HandEyeRequest


Report = TypeVar("Report", covariant=True)

#: Fewer views determine nothing, so there is nothing to go on with.
LEAST_VIEWS = 4
#: Behind the help of an option.
NEEDED = "(needed for a real camera)"


@dataclass(frozen=True, kw_only=True)
class ArmCameraOptions:
    """The options of both."""

    robot: Annotated[str, robot_argument("as for reach")] = ""
    bus: Annotated[str, bus_argument()] = "sim"
    arm: ArmFile = ""
    frame: Annotated[str, arg(help_behavior_hint="(default: the robot's tool)")] = ""
    """Robot frame that carries camera or board."""
    camera: Annotated[str, arg(metavar="synthetic|INDEX|URL")] = "synthetic"
    """Where the pictures come from."""
    intrinsics: Annotated[str, arg(metavar="FILE", help_behavior_hint=NEEDED)] = ""
    """Its calibration."""
    board: Annotated[str, arg(metavar="BOARD", help_behavior_hint=NEEDED)] = ""
    """marker:ID:MM, grid:COLUMNSxROWS:MM:GAP_MM, charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM,
    chessboard:COLUMNSxROWS:SQUARE_MM or FILE.toml[:NAME]."""
    dictionary: Dictionary = ""
    views: Annotated[int, arg(metavar="N")] = 15
    """How many pictures to take: 4 to 100."""
    speed: float = 1.0
    """Share of the joints' speed limits, above 0 and up to 1."""
    dry_run: bool = False
    """Plan the views and print them; nothing moves."""
    seed: int = 0
    """Of the planning and of the synthetic camera's noise."""
    json: bool = False
    """Print one JSON object on stdout instead of tables."""


def arm_camera_values(options: ArmCameraOptions, why_servos: str) -> dict[str, Any]:
    """The attributes of an ``ArmCameraRequest``; what can be wrong without looking is found here.

    Args:
        options: Of the command.
        why_servos: What an arm without servos has not.

    Raises:
        ConfigError, CameraError: A malformed option.
    """
    _check(options, why_servos)
    board = None
    if options.board:
        from robot_ik.camera.boards.board import parse_board

        board = parse_board(options.board, options.dictionary)
    return {
        "robot": options.robot or resolved_robot(options.arm, options.bus),
        "bus": options.bus,
        "arm_file": optional_path(options.arm),
        "frame": options.frame or None,
        "camera": options.camera,
        "intrinsics": optional_path(options.intrinsics),
        "board": board,
        "views": options.views,
        "speed": options.speed,
        "seed": options.seed,
    }


def _check(options: ArmCameraOptions, why_servos: str) -> None:
    if not LEAST_VIEWS <= options.views <= 100:
        raise wrong("--views", f"{options.views} views", f"{LEAST_VIEWS} to 100")
    require_share("--speed", options.speed)
    if options.bus == "none":
        raise wrong("--bus", f"an arm without servos has no {why_servos}", "sim, pty or a serial port")


class SavedSamples(Protocol):
    """Samples that can be written."""

    def __len__(self) -> int: ...

    def save(self, path: Path) -> None:
        """Whole or not at all."""


class Job(Protocol[Report]):
    """Moves an arm and takes samples."""

    def __call__(
        self, *, keep: Callable[[SavedSamples], None], progress: Callable[[str, float], None]
    ) -> Report: ...


def measured(job: Job[Report], file: Path, command: str) -> Report | None:
    """Runs a job with its progress shown; None when it was interrupted, and how to go on is said.

    Args:
        job: Hands over all its samples after each station.
        file: Where they are kept.
        command: That goes on with them: ``camera verify``.
    """
    views = 0

    def keep(samples: SavedSamples) -> None:
        nonlocal views
        samples.save(file)
        views = len(samples)

    try:
        with console.progress() as bar:
            return job(keep=keep, progress=console.phases_on(bar))
    except KeyboardInterrupt:
        console.say(f"interrupted after {views} views", "yellow")
        if views >= LEAST_VIEWS:
            console.say(f"they are kept; go on with them: robot-ik {command} --samples {file}")
        elif views:
            console.say(f"they are kept in {file}, but {LEAST_VIEWS} are the least that determine anything")
        return None


def numbers_of_seen(count: int, unseen: Sequence[int]) -> list[int]:
    """The numbers, from 1, of stations at which the board was seen: rows and "not seen at" count alike."""
    return [k + 1 for k in range(count + len(unseen)) if k not in unseen]


# ------------------------------------------------------------------------------------------
# ``robot-ik camera handeye``: how a camera is mounted, found by moving the arm.


_POSE = "X Y Z [W X Y Z]"


@dataclass(frozen=True, kw_only=True)
class CameraHandeyeOptions(ArmCameraOptions):
    """Moves the arm through views that it plans itself, and finds where the camera is mounted.

    eye-to-hand: the camera stands beside the arm, the arm carries the board. eye-in-hand: the arm carries
    the camera, the board lies still. With no options everything is simulated, and the true error is printed
    beside the stated uncertainty. Ctrl-C keeps what was measured: solve it with --samples.
    """

    mounting: Literal["eye-in-hand", "eye-to-hand"] = "eye-to-hand"
    """Whether the arm carries the camera or the board."""
    camera_guess: Annotated[
        tuple[float, ...], arg(metavar=_POSE, help_behavior_hint="(default: the scene's)")
    ] = ()
    """Where the camera is, roughly, seen from the world (eye-to-hand) or from the frame that carries it."""
    board_guess: Annotated[
        tuple[float, ...], arg(metavar=_POSE, help_behavior_hint="(default: the scene's)")
    ] = ()
    """Where the board is, roughly, seen from the frame that carries it (eye-to-hand) or from the world."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("place.toml")
    """Where the camera's pose goes; the samples go beside it."""
    overwrite: bool = False
    """Replace both."""
    samples: Annotated[str, arg(metavar="FILE.json", help_behavior_hint="(default: measure)")] = ""
    """Solve what was measured before; nothing moves."""


def run_handeye(options: CameraHandeyeOptions) -> int:
    """Runs the job; 0 when a pose was found."""
    import_mujoco()
    from robot_ik.jobs.arm_camera.handeye import samples_path

    request = None if options.samples else make_request(options)
    results = [] if options.dry_run else [options.out]
    if request is not None and not options.dry_run:
        results.append(samples_path(options.out))
    with claimed(*results, overwrite=options.overwrite):
        return _measure_and_solve(options, request)


def _measure_and_solve(options: CameraHandeyeOptions, request: HandEyeRequest | None) -> int:
    from robot_ik.jobs.arm_camera import handeye

    if request is None:
        report = _again(options)
    else:
        made = measured(
            partial(handeye.run_handeye, request, dry_run=options.dry_run),
            handeye.samples_path(options.out),
            "camera handeye",
        )
        if made is None:
            return console.INTERRUPTED
        report = made
    if report.result is not None:
        report.extrinsics().save(options.out)
    if options.json:
        console.print_json(_as_json(report, options))
    else:
        _print(report)
        if report.result is not None:
            console.say(f"wrote {options.out}", "green")
    return console.DONE


def _again(options: CameraHandeyeOptions) -> HandEyeReport:
    from robot_ik.camera.intrinsics import CameraIntrinsics
    from robot_ik.jobs.arm_camera.handeye import handeye_from_samples
    from robot_ik.jobs.arm_camera.measuring import SampleSet

    lens = CameraIntrinsics.load(options.intrinsics) if options.intrinsics else None
    return handeye_from_samples(SampleSet.load(Path(options.samples)), lens)


def make_request(options: CameraHandeyeOptions) -> HandEyeRequest:
    """The job's request; everything that can be wrong without looking is found here.

    Raises:
        ConfigError, CameraError, InvalidGoalError: A malformed option.
    """
    from robot_ik.jobs.arm_camera.handeye import HandEyeRequest

    return HandEyeRequest(
        **arm_camera_values(options, "angles to read"),
        mounting="eye_in_hand" if options.mounting == "eye-in-hand" else "eye_to_hand",
        pose_parent_camera=pose_option(options.camera_guess, "--camera-guess"),
        pose_other_board=pose_option(options.board_guess, "--board-guess"),
    )


def _print(report: HandEyeReport) -> None:
    screen = console.out()
    if report.result is None:
        rows = console.table("view", *report.samples.joints, title="planned, degrees")
        for number, q in enumerate(report.stations, 1):
            rows.add_row(str(number), *(f"{math.degrees(v):.1f}" for v in q))
        screen.print(rows)
        return
    result = report.result
    rows = console.table("view", "px", "left out: px", "mm", "deg", "sigmas", "")
    numbers = numbers_of_seen(len(result.residuals), report.unseen)
    for number, one in zip(numbers, result.residuals, strict=True):
        rows.add_row(
            str(number), f"{one.pixels:.2f}", f"{one.left_out_pixels:.2f}",
            f"{1e3 * one.left_out_position:.2f}", f"{math.degrees(one.left_out_angle):.3f}",
            f"{one.sigmas:.1f}", "contradicts the others: not believed" if one.outlier else "",
        )  # fmt: skip
    screen.print(rows)
    facts = console.facts()
    facts.add_row(f"camera seen from {report.parent}", pose_text(result.pose_parent_camera))
    board = "world" if report.parent != "world" else report.samples.frame
    facts.add_row(f"board seen from {board}", pose_text(result.pose_other_board))
    facts.add_row(
        "stated uncertainty",
        f"{1e3 * result.sigma_position:.3f} mm, {math.degrees(result.sigma_angle):.4f} deg (one sigma)",
    )
    if report.true_error is not None:
        position, angle = report.true_error
        facts.add_row("true error", f"{1e3 * position:.3f} mm, {math.degrees(angle):.4f} deg")
    arm = f"{1e3 * result.arm_position:.3f} mm, {math.degrees(result.arm_angle):.4f} deg (each axis)"
    facts.add_row("the arm's own error", arm)
    spread = ", ".join(f"{math.degrees(v):.0f}" for v in result.spread)
    facts.add_row("rotations spread", f"{spread} deg about the three axes")
    if report.unseen:
        facts.add_row("board not seen at", ", ".join(str(k + 1) for k in report.unseen))
    screen.print(facts)


def _as_json(report: HandEyeReport, options: CameraHandeyeOptions) -> dict[str, Any]:
    found: dict[str, Any] = {
        "schema": 1,
        "job": "handeye",
        "mounting": report.samples.mounting,
        "robot": report.samples.robot,
        "stations": [q.tolist() for q in report.stations],
        "unseen": list(report.unseen),
    }
    result = report.result
    if result is None:
        return found
    camera, board = result.pose_parent_camera, result.pose_other_board
    return found | {
        "parent": report.parent,
        "file": str(options.out),
        "camera": {"position": camera.position, "wxyz": camera.wxyz},
        "board": {"position": board.position, "wxyz": board.wxyz},
        "sigma_position_m": result.sigma_position,
        "sigma_angle_rad": result.sigma_angle,
        "true_error": report.true_error,
        "arm_position_m": result.arm_position,
        "arm_angle_rad": result.arm_angle,
        "outliers": list(result.outliers),
        "views": [
            {
                "px": one.pixels,
                "left_out_px": one.left_out_pixels,
                "left_out_m": one.left_out_position,
                "left_out_rad": one.left_out_angle,
                "sigmas": one.sigmas,
            }
            for one in result.residuals
        ],
    }
