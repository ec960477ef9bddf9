"""``robot-ik servo calibrate``: a hand shows ranges, zeros and directions; the files say so afterwards."""

from __future__ import annotations

import datetime
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.servo_link import BusOptions, Limits, arm_on, load_arm, model_limits, tried
from robot_ik.cli.servo_move import parse_angles
from robot_ik.cli.servo_prompt import Prompts
from robot_ik.errors import ArmStateError
from robot_ik.files import claimed

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.calibration_file import Calibration
    from robot_ik.hardware.calibration_sweep import Sweep
    from robot_ik.hardware.config import ArmConfig, JointMap

Found = TypeVar("Found")

STILL_SAMPLES = 10
"""At 20 Hz: a hand that only passes through the pose is noticed."""


@dataclass(frozen=True)
class CalibrateOptions(BusOptions):
    """Calibrates an arm by hand, torque off: sweep every joint, hold the zero pose, turn each joint a little.

    --arm gives names, ids, models, modes and limits. OUT.toml becomes the calibrated arm file, and
    OUT.calibration.toml beside it what was measured; from then on: --arm OUT.toml. The commands that move
    the arm compare the two with the servos and refuse an arm that is another.
    """

    out: Positional[Annotated[Path, arg(metavar="OUT.toml")]]
    """The calibrated arm file."""
    pose: Annotated[
        tuple[str, ...], arg(metavar="JOINT=DEG …", help_behavior_hint="(default: all joints at 0)")
    ] = ()
    """Another pose than zero in which the zeros are taken."""
    seconds: Annotated[
        float | None, arg(metavar="S", help_behavior_hint="(default: each step until Enter)")
    ] = None
    """Each step takes so long, without Enter."""
    from_lerobot: Annotated[Path | None, arg(metavar="FILE.json", help_behavior_hint="")] = None
    """Take LeRobot's calibration instead of a hand; 0 degrees are the middle of each range, as there."""
    to_lerobot: Annotated[Path | None, arg(metavar="FILE.json", help_behavior_hint="")] = None
    """Also write LeRobot's calibration."""
    check: bool = False
    """Only compare an OUT.toml that exists, and its calibration, with the servos."""
    overwrite: bool = False
    """Older files of these names may go."""


def run_calibrate(options: CalibrateOptions) -> int:
    """Measures, checks, writes; 1 when a step was not done as asked."""
    from robot_ik.hardware.calibration_file import calibration_beside

    if options.seconds is not None and not 0.0 < options.seconds <= 3600.0:
        raise wrong("--seconds", f"{options.seconds:g} s", "above 0, at most 3600")
    if options.out.suffix != ".toml" or options.out.name.endswith(".calibration.toml"):
        raise wrong("OUT.toml", f"{options.out}", "a name that ends in .toml")
    if options.check:
        return _check(options)
    # Without its file: what it was calibrated to before may be wrong, that is why.
    config = replace(load_arm(options.arm).whole, file=None)
    pose = dict.fromkeys(config.names, 0.0)
    if options.pose:
        pose |= parse_angles(options.pose, config)
    beside = calibration_beside(options.out)
    with claimed(options.out, beside, options.to_lerobot, overwrite=options.overwrite):
        return _calibrate(options, config, pose, beside)


def _calibrate(options: CalibrateOptions, config: ArmConfig, pose: Mapping[str, float], beside: Path) -> int:
    limits = model_limits(config)
    arm = arm_on(options, config)

    def measure() -> int:
        if options.from_lerobot is not None:
            found = _imported(arm, options.from_lerobot, limits)
        else:
            found = _by_hand(arm, Prompts(arm.clock, options.seconds), pose, limits)
        _write(options, arm, replace(found, file=beside), limits)
        return console.DONE

    with arm:
        require_limp(arm)
        return tried(measure)


def require_limp(arm: Arm) -> None:
    """Raises ``ArmStateError`` where torque is on: nobody could move the arm by hand."""
    from robot_ik.hardware.startup import read_all

    torque = read_all(arm.bus, arm.config, "torque_enable")
    if on := [servo.name for servo in arm.config.servos if torque.get(servo.id)]:
        raise ArmStateError(
            f"torque of {', '.join(on)} is on: the arm cannot be moved by hand",
            hint="support the arm, then: robot-ik servo torque off",
        )


def _by_hand(arm: Arm, prompts: Prompts, pose: Mapping[str, float], limits: Limits) -> Calibration:
    from robot_ik.hardware import calibration, calibration_sweep
    from robot_ik.hardware.startup import read_all, shared_register

    config, bus = arm.config, arm.bus
    present = shared_register(config, "present_position")
    sweep = calibration_sweep.Sweep(config, read_all(bus, config, "present_position"))

    def sample() -> None:
        sweep.take({id: status.data for id, status in bus.sync_read(config.servo_ids, present).items()})

    def swept() -> None:
        calibration_sweep.check_sweep(config, sweep)

    def turned(joint: JointMap, before: Mapping[int, int]) -> dict[int, int]:
        return calibration_sweep.wiggled(config, joint, before, sweep.now)

    _step(prompts, "1. sweep: move every joint from one stop to the other", sample, swept)
    _show_sweep(config, sweep)
    where = ", ".join(f"{name} {config.joint(name).text(q)}" for name, q in pose.items())
    text = f"2. zero: put the arm into the pose {where} and hold it"
    zero = _step(prompts, text, sample, lambda: _held(arm, sweep, sample))
    swept()  # that pose may lie beyond what was swept
    directions: dict[int, int] = {}
    for k, joint in enumerate(config.joints, 1):
        about = joint.text(calibration_sweep.ASKED_WIGGLE * joint.lever, 0)
        text = f"3.{k} direction: move {joint.name} alone by about {about} in its positive direction"
        directions |= _step(prompts, text, sample, functools.partial(turned, joint, dict(sweep.now)))
    measured = calibration.Measured(sweep, zero, pose, directions, limits)
    return calibration.measured_calibration(bus, config, measured, sweep.now, _now())


def _step(prompts: Prompts, text: str, sample: Callable[[], None], judge: Callable[[], Found]) -> Found:
    """One step; where somebody sits there it is asked for again until it was done as asked."""
    from robot_ik.hardware.calibration_sweep import HandError

    while True:
        prompts.step(text, sample)
        try:
            return judge()
        except HandError as error:
            if not prompts.patient:
                raise
            console.show_error(error)
            console.say("once more (Ctrl-C gives up; nothing is written)", "yellow")


def _held(arm: Arm, sweep: Sweep, sample: Callable[[], None]) -> dict[int, int]:
    """Servo id -> ticks of an arm that is held still, which is looked at."""
    from robot_ik.hardware.calibration_sweep import STILL_TICKS, HandError

    zero = dict(sweep.now)
    for _ in range(STILL_SAMPLES):
        arm.clock.sleep_until(arm.clock.now() + 0.05)
        sample()
        for servo in arm.config.servos:
            if abs(sweep.now[servo.id] - zero[servo.id]) > STILL_TICKS:
                raise HandError(f"joint {servo.name!r} moved while its zero was taken", hint="hold it still")
    return zero


def _imported(arm: Arm, path: Path, limits: Limits) -> Calibration:
    from robot_ik.hardware.lerobot_file import completed, load_lerobot
    from robot_ik.hardware.startup import read_all

    found = load_lerobot(path, arm.config, _now())
    firmware = read_all(arm.bus, arm.config, "firmware_version")
    present = read_all(arm.bus, arm.config, "present_position")
    units = {joint.name: joint.per_unit for joint in arm.config.joints}
    shown = {name: (low / units[name], high / units[name]) for name, (low, high) in limits.items()}
    return completed(found, firmware, present, shown)


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def _write(options: CalibrateOptions, arm: Arm, found: Calibration, limits: Limits) -> None:
    """Checks against the servos first; then both files, the arm file last: it is the one that is used."""
    from robot_ik.hardware.calibration import calibrated, check_calibration
    from robot_ik.hardware.lerobot_file import save_lerobot

    config = calibrated(arm.config, found)
    check_calibration(arm.bus, config, found, limits)
    if options.to_lerobot is not None:
        save_lerobot(options.to_lerobot, found)
    assert found.file is not None
    found.save(found.file)
    config.save(options.out)
    _show(arm.config, config, found)
    console.say(f"wrote {options.out} and {found.file}; from here on: --arm {options.out}", "green")


def _check(options: CalibrateOptions) -> int:
    from robot_ik.hardware.calibration import check_calibration
    from robot_ik.hardware.calibration_file import Calibration, calibration_beside
    from robot_ik.hardware.lerobot_file import save_lerobot

    found = Calibration.load(calibration_beside(options.out))
    config = load_arm(str(options.out)).whole
    limits = model_limits(config)
    with claimed(options.to_lerobot, overwrite=options.overwrite):
        with arm_on(options, replace(config, file=None)) as arm:
            check_calibration(arm.bus, config, found, limits)
        if options.to_lerobot is not None:
            save_lerobot(options.to_lerobot, found)
    console.out().print(
        f"{options.out}, its calibration, model and servos agree", markup=False, soft_wrap=True
    )
    return console.DONE


def _show_sweep(config: ArmConfig, sweep: Sweep) -> None:
    for servo in config.servos:
        low, high = sweep.low[servo.id], sweep.high[servo.id]
        console.say(
            f"   {servo.name}: id {servo.id}, ticks {low} to {high}, {servo.text(sweep.way(servo), 0)}"
        )


def _show(before: ArmConfig, after: ArmConfig, found: Calibration) -> None:
    shown = console.table("joint", "id", "swept ticks", "zero", "direction", "limits", "limits before")
    for old, new, row in zip(before.servos, after.servos, found.rows, strict=True):
        limits, formerly = (f"{j.lower / j.per_unit:.1f} .. {j.text(j.upper)}" for j in (new, old))
        swept = f"{row.range_min} .. {row.range_max}"
        shown.add_row(
            row.name, str(row.id), swept, str(row.zero_ticks), f"{row.direction:+d}", limits, formerly
        )
    console.out().print(shown)
