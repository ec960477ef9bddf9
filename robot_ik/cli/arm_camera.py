"""``robot-ik camera handeye`` and ``camera verify``: measure an arm and a camera by each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    NEEDED,
    XYZ_WXYZ,
    ArmFile,
    Dictionary,
    Json,
    Lens,
    NeededBoard,
    Overwrite,
    Range,
    Speed,
    joint_degrees,
    pose_option,
    pose_text,
    positive,
    request_of,
    require,
    robot_argument,
    several,
    single,
)
from robot_ik.cli.connection import bus_argument, resolved_robot
from robot_ik.files import make_folder, write_atomically
from robot_ik.jobs.results import claimed

if TYPE_CHECKING:
    from robot_ik.camera.calibration.kinematic import PoseError
    from robot_ik.camera.calibration.observability import Unobservable
    from robot_ik.jobs.arm_camera.camera_and_board import HandEyeRequest
    from robot_ik.jobs.arm_camera.handeye import HandEyeReport
    from robot_ik.jobs.arm_camera.samples import SampleSet
    from robot_ik.jobs.arm_camera.stations import ArmCameraReport
    from robot_ik.jobs.arm_camera.verify import VerifyReport, VerifyRequest
    from robot_ik.ports import Array


Report = TypeVar("Report")
#: Number of views that both commands accept.
VIEWS = Range(4, 100, " views")
# Parts of a direction smaller than this share of its largest are not named.
_NAMED_SHARE = 0.25
# A shift that goes with a rotation of the joints is named from this length on, metres per rad.
_NAMED_LEVER = 0.02
# Cosine of the angle to an axis up to which a direction is along it.
_ALONG_AXIS = 0.98


@dataclass(frozen=True, kw_only=True)
class ArmCameraOptions:
    """The common options of both commands."""

    robot: Annotated[str, robot_argument("as for reach")] = ""
    bus: Annotated[str, bus_argument()] = "sim"
    arm: ArmFile = None
    frame: Annotated[str | None, single("STR", "the robot's tool")] = None
    """Robot frame that carries camera or board."""
    camera: Annotated[str, arg(metavar="synthetic|INDEX|URL")] = "synthetic"
    """Where the pictures come from."""
    intrinsics: Lens = None
    board: NeededBoard = ""
    dictionary: Dictionary = ""
    views: Annotated[int, arg(metavar="N"), VIEWS] = 15
    """How many pictures to take: 4 to 100."""
    speed: Speed = 1.0
    dry_run: bool = False
    """Plan the views and print them; nothing moves."""
    seed: int = 0
    """Of the planning and of the synthetic camera's noise."""
    json: Json = False


def arm_camera_values(options: ArmCameraOptions, why_servos: str) -> dict[str, Any]:
    """Return the values of a request that differ from the options in name or form.

    Args:
        options: Options of either command. They are checked.
        why_servos: What an arm without servos does not have, for the message.

    Raises:
        ConfigError: An option is invalid.
        CameraError: The board is invalid.
    """
    from robot_ik.camera.target_files import parse_target

    without = f"an arm without servos has no {why_servos}"
    require(options.bus != "none", "--bus", without, "sim, pty or a serial port")
    return {
        "robot": options.robot or resolved_robot(options.arm, options.bus),
        "arm_file": options.arm,
        "board": parse_target(options.board, options.dictionary) if options.board else None,
    }


def measured(job: Callable[..., Report], file: Path, command: str) -> Report:
    """Run a job and show its progress. After an interruption, print how to go on.

    Args:
        job: Calls its argument ``keep`` with all samples after each station.
        file: Where the samples are saved.
        command: Command that goes on with them.
    """
    from robot_ik.camera.calibration.handeye import MIN_VIEWS

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
        if views >= MIN_VIEWS:
            console.say(f"they are kept; go on with them: robot-ik {command} --samples {file}")
        elif views:
            console.say(
                f"they are kept in {file}, but {MIN_VIEWS} are the least that determine anything"
            )
        raise


def numbers_of_seen(count: int, unseen: Sequence[int]) -> list[int]:
    """Return the numbers, from 1, of the stations at which the board was seen."""
    return [k + 1 for k in range(count + len(unseen)) if k not in unseen]


def show_plan(name: str, joints: Sequence[str], stations: Sequence[Array]) -> None:
    """Print the joint angles of all stations."""
    rows = [(k, *(f"{math.degrees(v):z.1f}" for v in q)) for k, q in enumerate(stations, 1)]
    console.show(console.table(name, *joints, rows=rows, title="planned, degrees"))


def planned_values(report: ArmCameraReport, job: str) -> dict[str, Any]:
    """Return the JSON values of a planned run, measured or not."""
    facts = {key: getattr(report.samples, key) for key in ("robot", "joints", "frame", "mounting")}
    return {"schema": 1, "job": job, **facts, "stations": report.stations, "unseen": report.unseen}


@dataclass(frozen=True, kw_only=True)
class CameraHandeyeOptions(ArmCameraOptions):
    """Moves the arm through views that it plans itself, and finds where the camera is mounted.

    eye-to-hand: the camera stands beside the arm, the arm carries the board. eye-in-hand: the arm
    carries the camera, the board lies still. With no options everything is simulated, and the true
    error is printed beside the stated uncertainty. Ctrl-C keeps what was measured: solve it with
    --samples.
    """

    mounting: Literal["eye-in-hand", "eye-to-hand"] = "eye-to-hand"
    """Whether the arm carries the camera or the board."""
    camera_guess: Annotated[tuple[float, ...], single(XYZ_WXYZ, "the scene's")] = ()
    """Rough pose of the camera, seen from the world (eye-to-hand) or the frame that carries it."""
    board_guess: Annotated[tuple[float, ...], single(XYZ_WXYZ, "the scene's")] = ()
    """Rough pose of the board, seen from the frame that carries it (eye-to-hand) or the world."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("place.toml")
    """Where the camera's pose goes; the samples go beside it."""
    overwrite: Overwrite = False
    samples: Annotated[Path | None, single("FILE.json", "measure")] = None
    """Solve what was measured before; nothing moves."""


def run_handeye(options: CameraHandeyeOptions) -> int:
    """Run the job and return the exit code: 0 if a pose was found."""
    from robot_ik.camera.intrinsics import CameraIntrinsics
    from robot_ik.jobs.arm_camera import handeye
    from robot_ik.jobs.arm_camera.samples import SampleSet

    kept = handeye.samples_path(options.out)
    request = None if options.samples else _handeye_request(options)
    results = () if options.dry_run else (options.out, None if request is None else kept)
    with claimed(*results, overwrite=options.overwrite):
        if request is None:
            if options.samples is None:
                raise RuntimeError("neither a request nor samples are given")
            lens = None if options.intrinsics is None else CameraIntrinsics.load(options.intrinsics)
            known = SampleSet.load(options.samples)
            report = handeye.handeye_from_samples(known, lens)
        else:
            report = measured(partial(handeye.run_handeye, request), kept, "camera handeye")
        if report.result is not None:
            report.extrinsics().save(options.out)
    if options.json:
        console.print_json(_handeye_json(report, options))
    else:
        _print_handeye(report)
        if report.result is not None:
            console.say(f"wrote {options.out}", "green")
    if report.doubt:
        console.say(report.doubt, "yellow")
    return console.DONE


def _handeye_request(options: CameraHandeyeOptions) -> HandEyeRequest:
    """Return the request of the options.

    Raises:
        ConfigError: An option is invalid.
        CameraError: The board is invalid.
        InvalidGoalError: A pose is invalid.
    """
    from robot_ik.jobs.arm_camera.camera_and_board import HandEyeRequest

    return request_of(
        HandEyeRequest,
        options,
        **arm_camera_values(options, "angles to read"),
        mounting=options.mounting.replace("-", "_"),
        pose_parent_camera=pose_option(options.camera_guess, "--camera-guess"),
        pose_other_board=pose_option(options.board_guess, "--board-guess"),
    )


def _print_handeye(report: HandEyeReport) -> None:
    result = report.result
    if result is None:
        show_plan("view", report.samples.joints, report.stations)
        return
    rows = [
        (
            number,
            f"{one.pixels:.2f}",
            f"{one.left_out_pixels:.2f}",
            f"{1e3 * one.left_out_position:.2f}",
            f"{math.degrees(one.left_out_angle):.3f}",
            f"{one.sigmas:.1f}",
            "contradicts the others: not believed" if one.outlier else "",
        )
        for number, one in zip(
            numbers_of_seen(len(result.residuals), report.unseen), result.residuals, strict=True
        )
    ]
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


def _handeye_json(report: HandEyeReport, options: CameraHandeyeOptions) -> dict[str, Any]:
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


@dataclass(frozen=True, kw_only=True)
class CameraVerifyOptions(ArmCameraOptions):
    """Moves a board on the tool through poses and measures how far it is from where the joints say.

    The camera stands beside the arm; its place must come from a board on the table (camera locate),
    not from the arm. With no options everything is simulated. With --fit, joint zeros that are off
    are estimated; they are written to the arm file of --arm after asking, the old file is kept;
    servos are never changed. Ctrl-C keeps what was measured: judge it with --samples.

    Exit code 0: no pose of the arm, as it now is on file, is farther off than --allowed-mm; else 1.
    """

    camera_extrinsics: Annotated[
        Path | None, arg(metavar="FILE.toml", help_behavior_hint=NEEDED)
    ] = None
    """Where it stands, from camera locate; a simulated camera is put there."""
    board_pose: Annotated[tuple[float, ...], single(XYZ_WXYZ, "in the frame")] = ()
    """Where the board is, seen from the frame that carries it."""
    board_sigma: Annotated[tuple[float, ...], single("MM DEG", "0.2 0.1")] = ()
    """How well that is known, each axis: --fit cannot know the last joint better."""
    views: Annotated[int, arg(metavar="N"), VIEWS] = 30
    """How many pictures to take: 4 to 100."""
    allowed_mm: Annotated[float, arg(metavar="MM"), positive(what=" mm")] = 5.0
    """Largest error of a pose with which the arm passes."""
    fit: bool = False
    """Estimate by how much each joint's zero is off."""
    yes: bool = False
    """Write the zeros without asking."""
    out: Annotated[Path, arg(metavar="FILE.json")] = Path("verify.samples.json")
    """Where all that is measured is kept, pose by pose."""
    overwrite: bool = False
    """Replace what --out and --picture name; the arm file is written as --fit says."""
    samples: Annotated[Path | None, single("FILE.json", "measure")] = None
    """Judge what was measured before; nothing moves."""
    picture: Annotated[Path | None, single("FILE.png")] = None
    """Draw the errors, from above and from the side (needs the extra plots)."""
    rehearse_zero_offset: Annotated[tuple[str, ...], several("JOINT=DEG")] = ()
    """Simulated servos whose shaft is some degrees ahead of what their registers say."""


def run_verify(options: CameraVerifyOptions) -> int:
    """Run the job and return the exit code: 0 if the arm, as now on file, is within the bound."""
    from robot_ik.jobs.results import require_plots

    request = _verify_request(options)
    if options.picture:
        require_plots("drawing the errors")
    samples = None if options.samples or options.dry_run else options.out
    picture = None if options.dry_run else options.picture
    if options.fit and options.arm:
        # The zeros are written there at the end.
        make_folder(options.arm.parent)
    with claimed(samples, picture, overwrite=options.overwrite):
        return _measure_and_judge(options, request)


def _measure_and_judge(options: CameraVerifyOptions, request: VerifyRequest) -> int:
    from robot_ik.jobs.arm_camera import verify
    from robot_ik.jobs.arm_camera.error_map import error_picture
    from robot_ik.jobs.arm_camera.samples import VerifySamples

    if options.samples:
        samples = VerifySamples.load(options.samples)
        report = verify.verify_from_samples(samples, request, board_sigma=bool(options.board_sigma))
    else:
        command = "camera verify --fit" if options.fit else "camera verify"
        report = measured(partial(verify.run_verify, request), options.out, command)
    if options.dry_run:
        if options.json:
            console.print_json(_verify_json(report, None))
        else:
            show_plan("pose", report.robot.joints, report.stations)
        return console.DONE
    if not options.json:
        _print_verified(report, options.allowed_mm)
    if options.picture:
        write_atomically(options.picture, error_picture(report.error_maps()))
        console.say(f"wrote {options.picture}", "green")
    written = _keep_zeros(options, report)
    passed = report.passed(1e-3 * options.allowed_mm, corrected=written)
    if options.json:
        verdict = {"allowed_mm": options.allowed_mm, "passed": passed, "written": written}
        console.print_json(_verify_json(report, verdict))
    return console.DONE if passed else console.NOT_ACHIEVED


def _keep_zeros(options: CameraVerifyOptions, report: VerifyReport) -> bool:
    """Ask the user and write the zeros to the arm file. Return whether they were written."""
    from robot_ik.hardware.calibration_file import write_zeros

    offsets = report.offsets()
    config = report.config
    changed = report.zero_ticks()
    if not offsets:
        return False
    if config is not None and not changed:
        console.say("no zero is off by as much as a tick: the arm file is right")
    elif config is None or not options.arm or config.file != options.arm.expanduser():
        # The arm file of a bundled robot is never changed.
        console.say(
            "nothing is written: to keep these zeros, give your arm file with --arm", "yellow"
        )
    elif not report.better:
        console.say("with these zeros the arm is no better: nothing is written", "yellow")
    else:
        zeros = (f"{name} {before} -> {after}" for name, (before, after) in changed.items())
        console.say(f"zero_ticks: {', '.join(zeros)}")
        if options.yes or console.confirm(f"write them to {options.arm}?"):
            kept = write_zeros(options.arm, config, offsets)
            console.say(f"wrote {options.arm}; before: {', '.join(map(str, kept))}", "green")
            return True
        console.say(f"{options.arm} stays as it is", "yellow")
    return False


def _verify_request(options: CameraVerifyOptions) -> VerifyRequest:
    """Return the request of the options.

    Raises:
        ConfigError: An option is invalid.
        CameraError: The board is invalid.
        InvalidGoalError: A pose is invalid.
    """
    from robot_ik.jobs.arm_camera.verify import BOARD_SIGMA, VerifyRequest
    from robot_ik.jobs.robot_setup import Rehearsal

    sigma = options.board_sigma
    known = len(sigma) in (0, 2) and all(0.0 < one < math.inf for one in sigma)
    exact = "a pose that is known exactly or not at all"
    require(known, "--board-sigma", exact, "two numbers above 0")
    picture = options.picture
    drawn = picture is None or picture.suffix.lower() == ".png"
    unwritable = f"no picture of errors is written as {picture}"
    require(drawn, "--picture", unwritable, "a name that ends in .png")
    writes = not options.yes or bool(options.fit and options.arm)
    require(writes, "--yes", "there is nothing to write", "with --fit and --arm FILE.toml")
    return request_of(
        VerifyRequest,
        options,
        **arm_camera_values(options, "zeros"),
        extrinsics=options.camera_extrinsics,
        pose_other_board=pose_option(options.board_pose, "--board-pose"),
        board_sigma=(1e-3 * sigma[0], math.radians(sigma[1])) if sigma else BOARD_SIGMA,
        rehearsal=Rehearsal(joint_degrees("--rehearse-zero-offset", options.rehearse_zero_offset)),
    )


def unobservable_text(found: Unobservable, frame: str) -> str:
    """Return what the views cannot tell apart, in one sentence.

    Args:
        found: The combination of joint offsets.
        frame: Frame of the robot that carries the board.
    """
    largest = np.abs(found.direction).max()
    order = np.argsort(-np.abs(found.direction), kind="stable")
    parts = []
    for k in order.tolist():
        if abs(found.direction[k]) >= _NAMED_SHARE * largest:
            parts.append(f"the offset of {found.joints[k]}")
    for name, parent, twist in (
        ("camera", "the world", found.poses[:6]),
        ("board", frame, found.poses[6:]),
    ):
        if np.linalg.norm(twist[3:]) >= _NAMED_SHARE:
            parts.append(f"the rotation of the {name} about {_axis_text(twist[3:])} of {parent}")
        elif np.linalg.norm(twist[:3]) >= _NAMED_LEVER:
            parts.append(f"the shift of the {name} along {_axis_text(twist[:3])} of {parent}")
    if len(parts) == 1:
        return f"{parts[0]} does not show in these views"
    return f"{', '.join(parts[:-1])} and {parts[-1]} look the same"


def _axis_text(vector: Array) -> str:
    """Return ``z``, or the components of a direction that is along no axis."""
    unit = vector / np.linalg.norm(vector)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > _ALONG_AXIS:
        return "xyz"[k]
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in unit) + ")"


def _print_verified(report: VerifyReport, allowed_mm: float) -> None:
    """Print the error of each pose, the errors by region, and the offsets."""
    console.show(_poses(report), _regions("the arm as it is", report.judged(corrected=False)))
    if report.samples.by_arm:
        console.show(
            "The camera's pose was found by moving this arm: "
            "what all poses are off by alike is in it.\n"
            "Of errors, only what changes from pose to pose shows; see robot-ik camera locate."
        )
    if report.fit is not None:
        console.show(_offset_table(report))
        for one in report.fit.unobservable:
            console.result(f"{unobservable_text(one, report.samples.frame)}: {one.joint} is held")
        title = "with these zeros: each pose by the fit to all others"
        console.show(_regions(title, report.judged(corrected=True)))
    if report.unseen:
        console.show("board not seen at " + ", ".join(str(k + 1) for k in report.unseen))
    verdicts = [(False, "as it is")]
    if report.fit is not None:
        verdicts.append((True, "with these zeros"))
    for corrected, label in verdicts:
        largest = 1e3 * max(one.distance for one in report.judged(corrected=corrected))
        verdict = "within" if largest <= allowed_mm else "beyond"
        console.show(
            f"largest error {label}: {largest:.2f} mm, {verdict} the allowed {allowed_mm:g} mm"
        )


def _poses(report: VerifyReport) -> Any:
    after = () if report.fit is None else report.fit.errors
    columns = ["pose", "x", "y", "z", "off: mm", "sigma", "deg", "sigma"]
    numbers = numbers_of_seen(len(report.errors), report.unseen)
    rows = []
    for number, one in enumerate(report.errors):
        then = [one.distance, one.sigma]
        if after:
            then += [after[number].distance, after[number].sigma]
        off, sigma, *fitted = (f"{1e3 * metres:.2f}" for metres in then)
        angles = (f"{math.degrees(radians):.3f}" for radians in (one.angle, one.sigma_angle))
        position = (f"{1e3 * x:z.0f}" for x in one.position)
        rows.append(
            (numbers[number], *position, off, sigma, *angles, *fitted, _doubt(report, number))
        )
    columns += ["then: mm", "sigma"] if after else []
    return console.table(*columns, "", rows=rows, title="poses, mm")


def _doubt(report: VerifyReport, number: int) -> str:
    if report.fit is not None and number in report.fit.outliers:
        return "contradicts the others: does not count"
    return "measured badly: does not count" if number in report.excluded else ""


def _regions(title: str, errors: Sequence[PoseError]) -> Any:
    from robot_ik.jobs.arm_camera.error_map import regions

    columns = ("board at", "poses", "RMS mm", "median", "max", "RMS deg", "sigma mm")
    rows = [
        (
            one.name,
            one.poses,
            f"{1e3 * one.rms_m:.2f}",
            f"{1e3 * one.median_m:.2f}",
            f"{1e3 * one.largest_m:.2f}",
            f"{math.degrees(one.rms_rad):.3f}",
            f"{1e3 * one.sigma_m:.2f}",
        )
        for one in regions(errors)
    ]
    return console.table(*columns, rows=rows, title=title)


def _offset_table(report: VerifyReport) -> Any:
    fit = report.fit
    if fit is None:
        raise RuntimeError("the report has no fit")
    truth = report.samples.true_offsets
    columns: tuple[str, ...] = ("joint", "deg", "sigma")
    if truth is not None:
        columns = ("joint", "ahead by: deg", "sigma", "true")
    rows = []
    for k, name in enumerate(fit.joints):
        sigma = f"{math.degrees(fit.sigma[k]):.3f}" if name in fit.determined else "held"
        true = () if truth is None else (f"{math.degrees(truth[k]):z.3f}",)
        rows.append((name, f"{math.degrees(fit.offsets[k]):z.3f}", sigma, *true))
    return console.table(*columns, rows=rows, title="joint zeros")


def _verify_json(report: VerifyReport, verdict: dict[str, Any] | None) -> dict[str, Any]:
    """Return all values, in metres and rad. ``verdict`` is None for a dry run."""
    from robot_ik.jobs.arm_camera.error_map import regions

    found = planned_values(report, "verify")
    if verdict is None:
        return found
    found |= verdict
    found["extrinsics_by_arm"] = report.samples.by_arm
    found["poses"] = [
        _error_json(one) | {"q": q} for one, q in zip(report.errors, report.samples.q, strict=True)
    ]
    found["excluded"] = report.excluded
    found["regions"] = regions(report.judged(corrected=False))
    fit = report.fit
    if fit is not None:
        sigmas = zip(fit.joints, np.asarray(fit.sigma).tolist(), strict=True)
        found["fit"] = {
            "offsets_rad": fit.offsets,
            "sigma_rad": [sigma if name in fit.determined else None for name, sigma in sigmas],
            "true_rad": report.samples.true_offsets,
            "held": [
                {"joint": one.joint, "why": unobservable_text(one, report.samples.frame)}
                for one in fit.unobservable
            ],
            "singular_values": fit.singular_values,
            "joint_noise_rad": fit.joint_noise,
            "residual_px": fit.residual_px,
            "outliers": fit.outliers,
            "poses": [_error_json(one) for one in fit.errors],
            "regions": regions(report.judged(corrected=True)),
        }
    return found


def _error_json(one: PoseError) -> dict[str, Any]:
    return {
        "position_m": one.position,
        "off_m": one.vector,
        "off_rad": one.angle,
        "sigma_m": one.sigma,
        "sigma_rad": one.sigma_angle,
    }
