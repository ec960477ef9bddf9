"""``robot-ik servo calibrate``, ``teach`` and ``play``: a person guides the arm by hand."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import OnExit, Overwrite, RecordFile, positive, several, single, wrong
from robot_ik.cli.connection import BusOptions, arm_on, attempt, driving, load_arm
from robot_ik.cli.prompts import Prompts
from robot_ik.cli.servo_motion import parse_angles, shown_value
from robot_ik.jobs.results import claimed
from robot_ik.ports import JointSink

if TYPE_CHECKING:
    from robot_ik.hardware.calibration_file import Calibration
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.motion import Trajectory


@dataclass(frozen=True)
class ServoCalibrateOptions(BusOptions):
    """Calibrates an arm by hand, torque off: sweep all joints, hold a pose, turn each joint.

    --arm gives names, ids, models, modes and limits. OUT.toml becomes the calibrated arm file, and
    OUT.calibration.toml beside it what was measured; from then on: --arm OUT.toml. The commands
    that move the arm compare both files with the servos and refuse an arm that differs.
    """

    out: Positional[Annotated[Path, arg(metavar="OUT.toml")]]
    """The calibrated arm file."""
    pose: Annotated[tuple[str, ...], several("JOINT=DEG", "all joints at 0")] = ()
    """Another pose than zero in which the zeros are taken."""
    seconds: Annotated[
        float | None, single("S", "each step until Enter"), positive(3600.0, " s")
    ] = None
    """Duration of each step, s, without Enter."""
    from_lerobot: Annotated[Path | None, single("FILE.json")] = None
    """Use a LeRobot calibration instead; its 0 degrees is the middle of a range."""
    to_lerobot: Annotated[Path | None, single("FILE.json")] = None
    """Also write LeRobot's calibration."""
    check: bool = False
    """Only compare an OUT.toml that exists, and its calibration, with the servos."""
    overwrite: Overwrite = False


def run_calibrate(options: ServoCalibrateOptions) -> int:
    """Measure, check, and write; 1 if a step failed."""
    from robot_ik.hardware.calibration_file import calibration_beside

    if options.out.suffix != ".toml" or options.out.name.endswith(".calibration.toml"):
        raise wrong("OUT.toml", f"{options.out}", "a name that ends in .toml")
    if options.check:
        return _check(options)
    # Without its file: an earlier calibration may be wrong, which is a reason to calibrate.
    config = replace(load_arm(options.arm), file=None)
    pose = dict.fromkeys(config.names, 0.0)
    if options.pose:
        pose |= parse_angles(options.pose, config)
    beside = calibration_beside(options.out)
    with claimed(options.out, beside, options.to_lerobot, overwrite=options.overwrite):
        return _calibrate(options, config, pose, beside)


def _calibrate(
    options: ServoCalibrateOptions, config: ArmConfig, pose: Mapping[str, float], beside: Path
) -> int:
    from robot_ik.hardware.lerobot_calibration import load_lerobot
    from robot_ik.hardware.model_check import model_limits
    from robot_ik.jobs.hand_guiding import calibrate_by_hand, require_limp, save_calibrated

    limits = model_limits(config)
    arm = arm_on(options, config)
    if options.from_lerobot is not None:
        measure = partial(load_lerobot, options.from_lerobot, arm.config, limits)
    else:
        # The prompts may refuse, so they come before the arm is connected.
        prompts = Prompts(arm.clock, options.seconds)
        measure = partial(calibrate_by_hand, arm, prompts, pose, limits)
    with arm:
        require_limp(arm)
        with attempt():
            calibration = measure()
            calibrated = save_calibrated(arm, calibration, options.out, options.to_lerobot)
        _show(arm.config, calibrated, calibration)
        written = f"wrote {options.out} and {beside}"
        console.say(f"{written}; from here on: --arm {options.out}", "green")
    return console.DONE


def _check(options: ServoCalibrateOptions) -> int:
    from robot_ik.hardware.calibration import check_calibration
    from robot_ik.hardware.calibration_file import Calibration, calibration_beside
    from robot_ik.hardware.lerobot_calibration import save_lerobot

    calibration = Calibration.load(calibration_beside(options.out))
    config = load_arm(str(options.out))
    with claimed(options.to_lerobot, overwrite=options.overwrite):
        with arm_on(options, config) as arm:  # opening compares the calibration with the model
            check_calibration(arm.bus, config, calibration)
        if options.to_lerobot is not None:
            save_lerobot(options.to_lerobot, calibration)
    console.result(f"{options.out}, its calibration, model and servos agree")
    return console.DONE


def _show(before: ArmConfig, after: ArmConfig, calibration: Calibration) -> None:
    """Print a row for every servo."""
    rows = []
    for old, new, row in zip(before.drives, after.drives, calibration.rows, strict=True):
        limits, old_limits = (
            f"{joint.lower / joint.per_unit:.1f} .. {joint.text(joint.upper)}"
            for joint in (new.joint, old.joint)
        )
        swept = f"{row.range_min} .. {row.range_max}"
        direction = f"{row.direction:+d}"
        rows.append((row.name, row.id, swept, row.zero_ticks, direction, limits, old_limits))
    columns = ("joint", "id", "swept ticks", "zero", "direction", "limits", "limits before")
    console.show(console.table(*columns, rows=rows))


@dataclass(frozen=True)
class ServoTeachOptions(BusOptions):
    """Records the arm while a hand guides it, torque off, until Enter or for --seconds.

    Ctrl-C ends it too: what was recorded is kept, and the exit code is 130.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE.csv")]]
    """File to write: times in s, joint angles in rad."""
    seconds: Annotated[float | None, single("S", "until Enter"), positive(3600.0, " s")] = None
    """Duration, s."""
    rate: Annotated[float, arg(metavar="HZ"), positive(200.0, " Hz")] = 50.0
    """Samples a second, at most 200."""
    overwrite: Overwrite = False


def run_teach(options: ServoTeachOptions) -> int:
    """Record and write the file."""
    from robot_ik.jobs.hand_guiding import TaughtMotion

    if options.file.suffix != ".csv":
        raise wrong("FILE.csv", f"{options.file}", "a name that ends in .csv")
    config = load_arm(options.arm)
    arm = arm_on(options, config)
    # The prompts may refuse, so they come before the arm is connected.
    prompts = Prompts(arm.clock, options.seconds, 1.0 / options.rate)
    with claimed(options.file, overwrite=options.overwrite), arm:
        taught = TaughtMotion(arm)
        with attempt():
            try:
                prompts.step("recording: guide the arm by hand", taught.sample)
            finally:
                _save_motion(options.file, taught.motion(), arm.config)
    return console.DONE if taught.motion() is not None else console.NOT_ACHIEVED


def _save_motion(path: Path, motion: Trajectory | None, config: ArmConfig) -> None:
    """Write a recording, and warn of joints that were beyond their limits."""
    from robot_ik.jobs.hand_guiding import outside

    if motion is None:
        console.refused("no servo position could be read")
        return
    motion.save_csv(path)
    console.result(f"{path}: {len(motion)} samples, {motion.duration:.2f} s")
    for joint, excess in outside(motion, config):
        text = f"{joint.name} was {joint.text(excess)} beyond its limits: play refuses that"
        console.say(text, "yellow")


@dataclass(frozen=True)
class ServoPlayOptions(BusOptions):
    """Repeats a recording: slowly to its start, then as recorded, within limits and caps.

    A recording that leaves the limits of the arm file is refused; one that is too fast is played
    slower. One without the gripper's joints, as reach writes it, moves the arm and holds the
    gripper. With [collisions] in the arm file a recording that would touch is refused.
    At the end, and on Ctrl-C, the arm is left as --on-exit says: torque_off lets it fall.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE.csv")]]
    """A file of teach."""
    speed: Annotated[float, positive(1.0, " is no share of the speed caps")] = 1.0
    """Share of the recorded speed, above 0 and up to 1."""
    record: RecordFile = None
    overwrite: Overwrite = False
    on_exit: OnExit = ""


def run_play(options: ServoPlayOptions) -> int:
    """Play the recording; 1 if the arm did not reach its end."""
    from robot_ik.jobs.hand_guiding import load_playable, play_motion
    from robot_ik.workcell.arm_guard import guard_of

    arm_config = load_arm(options.arm)
    config, motion, stretch = load_playable(options.file, arm_config, options.speed)
    held = [name for name in arm_config.names if name not in config.names]
    if held:
        console.say(f"the recording has no {', '.join(held)}: held where it stands", "dim")
    guard = guard_of(arm_config)
    arm = arm_on(options, arm_config, options.on_exit)
    with claimed(options.record, overwrite=options.overwrite), contextlib.ExitStack() as stack:
        sinks: list[JointSink] = []
        if options.record is not None:
            from robot_ik.jobs.recording import RecordingSink, open_recording

            recording = stack.enter_context(open_recording(options.record, config.names))
            sinks.append(RecordingSink(recording, config.names, arm.positions))
        stack.enter_context(driving(arm))
        report = play_motion(arm, motion, sinks, console.busy, guard)
        error = shown_value(report.late, report.tracking_error)
        console.result(
            f"played {len(motion)} samples in {motion.duration:.2f} s ({stretch:.2f} x the "
            f"recorded time); largest tracking error {error}"
        )
        report.require_arrived()
    return console.DONE
