"""What ``camera handeye`` and ``camera verify`` share: options of arm and camera, what Ctrl-C leaves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    NEEDED,
    XYZ_WXYZ,
    ArmFile,
    Dictionary,
    Json,
    NeededBoard,
    pose_option,
    pose_text,
    request_of,
    require,
    require_share,
    robot_argument,
    single,
)
from robot_ik.cli.connection import bus_argument, resolved_robot
from robot_ik.environment import import_mujoco
from robot_ik.files import claimed

if TYPE_CHECKING:
    from robot_ik.jobs.arm_camera.handeye import ArmCameraReport, HandEyeReport, HandEyeRequest
    from robot_ik.jobs.arm_camera.samples import SampleSet
    from robot_ik.ports import Array


Report = TypeVar("Report")


@dataclass(frozen=True, kw_only=True)
class ArmCameraOptions:
    """The options of both."""

    robot: Annotated[str, robot_argument("as for reach")] = ""
    bus: Annotated[str, bus_argument()] = "sim"
    arm: ArmFile = None
    frame: Annotated[str | None, single("STR", "the robot's tool")] = None
    """Robot frame that carries camera or board."""
    camera: Annotated[str, arg(metavar="synthetic|INDEX|URL")] = "synthetic"
    """Where the pictures come from."""
    intrinsics: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=NEEDED)] = None
    """Its calibration."""
    board: NeededBoard = ""
    dictionary: Dictionary = ""
    views: Annotated[int, arg(metavar="N")] = 15
    """How many pictures to take: 4 to 100."""
    speed: float = 1.0
    """Share of the joints' speed limits, above 0 and up to 1."""
    dry_run: bool = False
    """Plan the views and print them; nothing moves."""
    seed: int = 0
    """Of the planning and of the synthetic camera's noise."""
    json: Json = False


def arm_camera_values(options: ArmCameraOptions, why_servos: str) -> dict[str, Any]:
    """What a request has under other names or in another form than the options; checks those of both.

    ``why_servos`` says what an arm without servos has not.

    Raises:
        ConfigError, CameraError: A malformed option.
    """
    from robot_ik.camera.boards.board import parse_board
    from robot_ik.camera.calibration.handeye import LEAST_VIEWS

    views = f"{LEAST_VIEWS} to 100"
    require(LEAST_VIEWS <= options.views <= 100, "--views", f"{options.views} views", views)
    require_share("--speed", options.speed)
    without = f"an arm without servos has no {why_servos}"
    require(options.bus != "none", "--bus", without, "sim, pty or a serial port")
    return {
        "robot": options.robot or resolved_robot(options.arm, options.bus),
        "arm_file": options.arm,
        "board": parse_board(options.board, options.dictionary) if options.board else None,
    }


def measured(job: Callable[..., Report], file: Path, command: str) -> Report:
    """Runs a job with its progress shown; where that is interrupted, it says how to go on.

    The job hands all its samples to ``keep`` after each station, for ``file``; ``command`` goes on with them.
    """
    from robot_ik.camera.calibration.handeye import LEAST_VIEWS

    views = 0

    def keep(samples: SampleSet) -> None:
        nonlocal views
        samples.save(file)
        views = len(samples)

    try:
        with console.progress() as bar:
            return job(keep=keep, progress=console.shares_on(bar, command))
    except KeyboardInterrupt:
        console.say(f"stopped after {console.count_of(views, 'view')}", "yellow")
        if views >= LEAST_VIEWS:
            console.say(f"they are kept; go on with them: robot-ik {command} --samples {file}")
        elif views:
            console.say(f"they are kept in {file}, but {LEAST_VIEWS} are the least that determine anything")
        raise


def numbers_of_seen(count: int, unseen: Sequence[int]) -> list[int]:
    """The numbers, from 1, of stations at which the board was seen: rows and "not seen at" count alike."""
    return [k + 1 for k in range(count + len(unseen)) if k not in unseen]


def show_plan(name: str, joints: Sequence[str], stations: Sequence[Array]) -> None:
    """The joint angles of all stations."""
    rows = [(k, *(f"{math.degrees(v):z.1f}" for v in q)) for k, q in enumerate(stations, 1)]
    console.show(console.table(name, *joints, rows=rows, title="planned, degrees"))


def planned_values(report: ArmCameraReport, job: str) -> dict[str, Any]:
    """What JSON says of a run that was planned, measured or not."""
    facts = {key: getattr(report.samples, key) for key in ("robot", "joints", "frame", "mounting")}
    return {"schema": 1, "job": job, **facts, "stations": report.stations, "unseen": report.unseen}


# ------------------------------------------------------------------------------------------
# ``robot-ik camera handeye``: how a camera is mounted, found by moving the arm.


@dataclass(frozen=True, kw_only=True)
class CameraHandeyeOptions(ArmCameraOptions):
    """Moves the arm through views that it plans itself, and finds where the camera is mounted.

    eye-to-hand: the camera stands beside the arm, the arm carries the board. eye-in-hand: the arm carries
    the camera, the board lies still. With no options everything is simulated, and the true error is printed
    beside the stated uncertainty. Ctrl-C keeps what was measured: solve it with --samples.
    """

    mounting: Literal["eye-in-hand", "eye-to-hand"] = "eye-to-hand"
    """Whether the arm carries the camera or the board."""
    camera_guess: Annotated[tuple[float, ...], single(XYZ_WXYZ, "the scene's")] = ()
    """Where the camera is, roughly, seen from the world (eye-to-hand) or from the frame that carries it."""
    board_guess: Annotated[tuple[float, ...], single(XYZ_WXYZ, "the scene's")] = ()
    """Where the board is, roughly, seen from the frame that carries it (eye-to-hand) or from the world."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("place.toml")
    """Where the camera's pose goes; the samples go beside it."""
    overwrite: bool = False
    """Replace both."""
    samples: Annotated[Path | None, single("FILE.json", "measure")] = None
    """Solve what was measured before; nothing moves."""


def run_handeye(options: CameraHandeyeOptions) -> int:
    """Runs the job; 0 when a pose was found."""
    import_mujoco()
    from robot_ik.camera.intrinsics import CameraIntrinsics
    from robot_ik.jobs.arm_camera import handeye
    from robot_ik.jobs.arm_camera.samples import SampleSet

    kept = handeye.samples_path(options.out)
    request = None if options.samples else make_request(options)
    results = () if options.dry_run else (options.out, None if request is None else kept)
    with claimed(*results, overwrite=options.overwrite):
        if request is None:
            assert options.samples is not None
            lens = None if options.intrinsics is None else CameraIntrinsics.load(options.intrinsics)
            known = SampleSet.load(options.samples)
            report = handeye.handeye_from_samples(known, lens)
        else:
            report = measured(partial(handeye.run_handeye, request), kept, "camera handeye")
        if report.result is not None:
            report.extrinsics().save(options.out)
    if options.json:
        console.print_json(_as_json(report, options))
    else:
        _print(report)
        if report.result is not None:
            console.say(f"wrote {options.out}", "green")
    if report.doubt:
        console.say(report.doubt, "yellow")
    return console.DONE


def make_request(options: CameraHandeyeOptions) -> HandEyeRequest:
    """The job's request.

    Raises:
        ConfigError, CameraError, InvalidGoalError: All that can be wrong without looking.
    """
    from robot_ik.jobs.arm_camera.handeye import HandEyeRequest

    return request_of(
        HandEyeRequest,
        options,
        **arm_camera_values(options, "angles to read"),
        mounting=options.mounting.replace("-", "_"),
        pose_parent_camera=pose_option(options.camera_guess, "--camera-guess"),
        pose_other_board=pose_option(options.board_guess, "--board-guess"),
    )


def _print(report: HandEyeReport) -> None:
    result = report.result
    if result is None:
        show_plan("view", report.samples.joints, report.stations)
        return
    rows = [
        (
            number, f"{one.pixels:.2f}", f"{one.left_out_pixels:.2f}",
            f"{1e3 * one.left_out_position:.2f}", f"{math.degrees(one.left_out_angle):.3f}",
            f"{one.sigmas:.1f}", "contradicts the others: not believed" if one.outlier else "",
        )
        for number, one in zip(
            numbers_of_seen(len(result.residuals), report.unseen), result.residuals, strict=True
        )
    ]  # fmt: skip
    board = "world" if report.parent != "world" else report.samples.frame
    spread = ", ".join(f"{math.degrees(v):.0f}" for v in result.spread)
    facts = [
        (f"camera seen from {report.parent}", pose_text(result.pose_parent_camera)),
        (f"board seen from {board}", pose_text(result.pose_other_board)),
        ("stated uncertainty", f"{_mm_deg(result.sigma_position, result.sigma_angle)} (one sigma)"),
        ("true error", _mm_deg(*report.true_error) if report.true_error is not None else ""),
        ("the arm's own error", f"{_mm_deg(result.arm_position, result.arm_angle)} (each axis)"),
        ("rotations spread", f"{spread} deg about the three axes"),
        ("board not seen at", ", ".join(str(k + 1) for k in report.unseen)),
    ]
    console.show(
        console.table("view", "px", "left out: px", "mm", "deg", "sigmas", "", rows=rows),
        console.facts(*(fact for fact in facts if fact[1])),
    )


def _mm_deg(metres: float, radians: float) -> str:
    return f"{1e3 * metres:.3f} mm, {math.degrees(radians):.4f} deg"


def _as_json(report: HandEyeReport, options: CameraHandeyeOptions) -> dict[str, Any]:
    result = report.result
    if result is None:
        return planned_values(report, "handeye")
    return planned_values(report, "handeye") | {
        "parent": report.parent,
        "file": options.out,
        "camera": result.pose_parent_camera,
        "board": result.pose_other_board,
        "sigma_position_m": result.sigma_position,
        "sigma_angle_rad": result.sigma_angle,
        "true_error": report.true_error,
        "arm_position_m": result.arm_position,
        "arm_angle_rad": result.arm_angle,
        "outliers": result.outliers,
        "doubt": report.doubt,
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
