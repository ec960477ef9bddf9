"""``robot-ik camera verify``: a camera checks where the arm really is, and finds joint zeros that are off."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    NEEDED,
    XYZ_WXYZ,
    joint_degrees,
    pose_option,
    request_of,
    require,
    several,
    single,
)
from robot_ik.cli.arm_camera import (
    ArmCameraOptions,
    arm_camera_values,
    measured,
    numbers_of_seen,
    planned_values,
    show_plan,
)
from robot_ik.environment import import_mujoco
from robot_ik.files import claimed, make_folder, write_atomically

if TYPE_CHECKING:
    from robot_ik.camera.calibration.kinematic import PoseError
    from robot_ik.jobs.arm_camera.verify import VerifyReport, VerifyRequest


@dataclass(frozen=True, kw_only=True)
class CameraVerifyOptions(ArmCameraOptions):
    """Moves a board carried by the tool through poses, and says how far it is from where the joints say.

    The camera stands beside the arm; its place must come from a board on the table (camera locate), not from
    the arm. With no options everything is simulated. With --fit, joint zeros that are off are estimated; they
    are written to the arm file of --arm after asking, the old file is kept; servos are never changed.
    Ctrl-C keeps what was measured: judge it with --samples.

    Exit code 0: no pose of the arm, as it now is on file, is farther off than --allowed-mm; else 1.
    """

    camera_extrinsics: Annotated[Path | None, arg(metavar="FILE.toml", help_behavior_hint=NEEDED)] = None
    """Where it stands, from camera locate; a simulated camera is put there."""
    board_pose: Annotated[tuple[float, ...], single(XYZ_WXYZ, "in the frame")] = ()
    """Where the board is, seen from the frame that carries it."""
    board_sigma: Annotated[tuple[float, ...], single("MM DEG", "0.2 0.1")] = ()
    """How well that is known, each axis: --fit cannot know the last joint better."""
    views: Annotated[int, arg(metavar="N")] = 30
    """How many pictures to take: 4 to 100."""
    allowed_mm: Annotated[float, arg(metavar="MM")] = 5.0
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


def run(options: CameraVerifyOptions) -> int:
    """Runs the job; 0 when the arm, as it now is on file, is within the bound."""
    import_mujoco()
    from robot_ik.jobs.results import require_plots

    request = make_request(options)
    if options.picture:
        require_plots("drawing the errors")
    samples = None if options.samples or options.dry_run else options.out
    picture = None if options.dry_run else options.picture
    if options.fit and options.arm:
        make_folder(options.arm.parent)  # the zeros are written there in the end
    with claimed(samples, picture, overwrite=options.overwrite):
        return _measure_and_judge(options, request)


def _measure_and_judge(options: CameraVerifyOptions, request: VerifyRequest) -> int:
    from robot_ik.jobs.arm_camera.samples import VerifySamples
    from robot_ik.jobs.arm_camera.verify import error_picture, run_verify, verify_from_samples

    if options.samples:
        samples = VerifySamples.load(options.samples)
        report = verify_from_samples(samples, request, board_sigma=bool(options.board_sigma))
    else:
        command = "camera verify --fit" if options.fit else "camera verify"
        report = measured(partial(run_verify, request), options.out, command)
    if options.dry_run:
        if options.json:
            console.print_json(as_json(report, None))
        else:
            show_plan("pose", report.robot.joints, report.stations)
        return console.DONE
    if not options.json:
        print_report(report, options.allowed_mm)
    if options.picture:
        write_atomically(options.picture, error_picture(report))
        console.say(f"wrote {options.picture}", "green")
    written = _keep_zeros(options, report)
    passed = report.passed(1e-3 * options.allowed_mm, corrected=written)
    if options.json:
        verdict = {"allowed_mm": options.allowed_mm, "passed": passed, "written": written}
        console.print_json(as_json(report, verdict))
    return console.DONE if passed else console.NOT_ACHIEVED


def _keep_zeros(options: CameraVerifyOptions, report: VerifyReport) -> bool:
    """Asks, and writes the zeros to the arm file; whether that was done."""
    from robot_ik.hardware.calibration_file import write_zeros

    offsets, config, changed = report.offsets(), report.config, report.zero_ticks()
    if not offsets:
        return False
    if config is not None and not changed:
        console.say("no zero is off by as much as a tick: the arm file is right")
    elif config is None or not options.arm or config.file != options.arm.expanduser():  # a robot's, not yours
        console.say("nothing is written: to keep these zeros, give your arm file with --arm", "yellow")
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


def make_request(options: CameraVerifyOptions) -> VerifyRequest:
    """The job's request.

    Raises:
        ConfigError, CameraError, InvalidGoalError: All that can be wrong without looking.
    """
    from robot_ik.jobs.arm_camera.verify import BOARD_SIGMA, VerifyRequest
    from robot_ik.jobs.robot_setup import Rehearsal

    sigma, allowed = options.board_sigma, options.allowed_mm
    require(0.0 < allowed < math.inf, "--allowed-mm", f"{allowed:g} mm", "above 0")
    known = len(sigma) in (0, 2) and all(0.0 < one < math.inf for one in sigma)
    exact = "a pose that is known exactly or not at all"
    require(known, "--board-sigma", exact, "two numbers above 0")
    picture = options.picture
    drawn = picture is None or picture.suffix.lower() == ".png"
    require(drawn, "--picture", f"no picture of errors is written as {picture}", "a name that ends in .png")
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


# ------------------------------------------------------------------------------------------
# What ``robot-ik camera verify`` prints: tables for people, JSON for programs.


def print_report(report: VerifyReport, allowed_mm: float) -> None:
    """Errors of each pose, sums by region, offsets."""
    console.show(_poses(report), _regions("the arm as it is", report.judged(corrected=False)))
    if report.samples.by_arm:
        console.show(
            "The camera's pose was found by moving this arm: what all poses are off by alike is in it.\n"
            "Of errors, only what changes from pose to pose shows; see robot-ik camera locate."
        )
    if report.fit is not None:
        console.show(_offset_table(report))
        for one in report.fit.unobservable:
            console.result(f"{one.text}: {one.joint} is held")
        title = "with these zeros: each pose by the fit to all others"
        console.show(_regions(title, report.judged(corrected=True)))
    if report.unseen:
        console.show("board not seen at " + ", ".join(str(k + 1) for k in report.unseen))
    for corrected, label in ((False, "as it is"), (True, "with these zeros"))[: 1 + (report.fit is not None)]:
        largest = 1e3 * max(one.distance for one in report.judged(corrected=corrected))
        verdict = "within" if largest <= allowed_mm else "beyond"
        console.show(f"largest error {label}: {largest:.2f} mm, {verdict} the allowed {allowed_mm:g} mm")


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
        rows.append((numbers[number], *position, off, sigma, *angles, *fitted, _doubt(report, number)))
    columns += ["then: mm", "sigma"] if after else []
    return console.table(*columns, "", rows=rows, title="poses, mm")


def _doubt(report: VerifyReport, number: int) -> str:
    if report.fit is not None and number in report.fit.outliers:
        return "contradicts the others: does not count"
    return "measured badly: does not count" if number in report.unsure else ""


def _regions(title: str, errors: Sequence[PoseError]) -> Any:
    from robot_ik.jobs.arm_camera.verify import regions

    columns = ("board at", "poses", "RMS mm", "median", "max", "RMS deg", "sigma mm")
    rows = [
        (
            one.name, one.poses, f"{1e3 * one.rms_m:.2f}", f"{1e3 * one.median_m:.2f}",
            f"{1e3 * one.largest_m:.2f}", f"{math.degrees(one.rms_rad):.3f}", f"{1e3 * one.sigma_m:.2f}",
        )
        for one in regions(errors)
    ]  # fmt: skip
    return console.table(*columns, rows=rows, title=title)


def _offset_table(report: VerifyReport) -> Any:
    fit = report.fit
    assert fit is not None
    truth = report.samples.true_offsets
    columns = ("joint", "ahead by: deg", "sigma", "true") if truth is not None else ("joint", "deg", "sigma")
    rows = []
    for k, name in enumerate(fit.joints):
        sigma = f"{math.degrees(fit.sigma[k]):.3f}" if name in fit.found else "held"
        true = () if truth is None else (f"{math.degrees(truth[k]):z.3f}",)
        rows.append((name, f"{math.degrees(fit.offsets[k]):z.3f}", sigma, *true))
    return console.table(*columns, rows=rows, title="joint zeros")


def as_json(report: VerifyReport, verdict: dict[str, Any] | None) -> dict[str, Any]:
    """Everything, in metres and rad; ``verdict`` None for a dry run."""
    from robot_ik.jobs.arm_camera.verify import regions

    found = planned_values(report, "verify")
    if verdict is None:
        return found
    found |= verdict
    found["extrinsics_by_arm"] = report.samples.by_arm
    found["poses"] = [_error(one) | {"q": q} for one, q in zip(report.errors, report.samples.q, strict=True)]
    found["unsure"] = report.unsure
    found["regions"] = regions(report.judged(corrected=False))
    fit = report.fit
    if fit is not None:
        sigmas = zip(fit.joints, np.asarray(fit.sigma).tolist(), strict=True)
        found["fit"] = {
            "offsets_rad": fit.offsets,
            "sigma_rad": [sigma if name in fit.found else None for name, sigma in sigmas],
            "true_rad": report.samples.true_offsets,
            "held": [{"joint": one.joint, "why": one.text} for one in fit.unobservable],
            "singular_values": fit.singular_values,
            "joint_noise_rad": fit.joint_noise,
            "residual_px": fit.residual_px,
            "outliers": fit.outliers,
            "poses": [_error(one) for one in fit.errors],
            "regions": regions(report.judged(corrected=True)),
        }
    return found


def _error(one: PoseError) -> dict[str, Any]:
    return {
        "position_m": one.position, "off_m": one.vector, "off_rad": one.angle,
        "sigma_m": one.sigma, "sigma_rad": one.sigma_angle,
    }  # fmt: skip
