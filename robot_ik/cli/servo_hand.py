"""``robot-ik servo calibrate``: a hand shows ranges, zeros and directions; the files say so afterwards."""

from __future__ import annotations

import contextlib
import datetime
import functools
import json
import math
import os
import queue
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import numpy as np
from pydantic import Field
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.connection import (
    BusOptions,
    Limits,
    arm_on,
    driving,
    load_arm,
    model_limits,
    require_model,
    tried,
)
from robot_ik.cli.servo_motion import parse_angles, shown_value, slowed
from robot_ik.errors import ArmStateError, ConfigError, HardwareError, TrajectoryError
from robot_ik.files import claimed, write_atomically
from robot_ik.ports import Array, Clock, JointSink
from robot_ik.reading import read_json
from robot_ik.tables import Several, Table, check_table

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.calibration import Sweep
    from robot_ik.hardware.calibration_file import Calibration
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.joint_map import JointMap, Sign
    from robot_ik.motion import Trajectory


# ------------------------------------------------------------------------------------------
# Steps in which a person does something to the arm, until Enter or for a time; meanwhile it is sampled.


class Prompts:
    """Asks for one step after the other.

    Args:
        clock: Paces the samples.
        seconds: Each step lasts so long; None: until Enter (a line on standard input).
        period: s between two samples.
    """

    def __init__(self, clock: Clock, seconds: float | None = None, period: float = 0.02) -> None:
        self._clock = clock
        self._period = period
        self._seconds = seconds
        self._lines: queue.Queue[bool] = queue.Queue()
        self._reader: threading.Thread | None = None

    @property
    def patient(self) -> bool:
        """Somebody sits there who can do a step again."""
        return self._seconds is None and sys.__stdin__ is not None and sys.__stdin__.isatty()

    def step(self, text: str, sample: Callable[[], object]) -> None:
        """Says what to do and samples until it is done, and once more then.

        Raises:
            HardwareError: Standard input has ended.  Whatever ``sample`` raises.
        """
        ending = "then press Enter" if self._seconds is None else f"{self._seconds:g} s from now"
        console.say(f"{text}; {ending}", "bold")
        self._start_reading()
        end = self._clock.now() + (self._seconds or 0.0)
        due = self._clock.now()
        while not (self._entered() if self._seconds is None else self._clock.now() >= end):
            sample()
            due = max(due + self._period, self._clock.now())
            self._clock.sleep_until(due)
        sample()

    def _entered(self) -> bool:
        try:
            more = self._lines.get_nowait()
        except queue.Empty:
            return False
        if not more:
            self._lines.put(False)
            raise HardwareError("the input ended before all steps were done", hint="or let steps take a time")
        return True

    def _start_reading(self) -> None:
        if self._reader is None and self._seconds is None:
            self._reader = threading.Thread(target=self._read, name="standard input", daemon=True)
            self._reader.start()

    def _read(self) -> None:
        # Not sys.stdin: at the end of the interpreter a thread that waits inside it would hold its lock.
        try:
            while data := os.read(sys.__stdin__.fileno() if sys.__stdin__ else 0, 1024):
                for _ in range(data.count(b"\n")):
                    self._lines.put(True)
        except (OSError, ValueError):
            pass
        self._lines.put(False)


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
    from robot_ik.hardware.bus import read_all

    torque = read_all(arm.bus, arm.config, "torque_enable")
    if on := [servo.name for servo in arm.config.servos if torque.get(servo.id)]:
        raise ArmStateError(
            f"torque of {', '.join(on)} is on: the arm cannot be moved by hand",
            hint="support the arm, then: robot-ik servo torque off",
        )


def _by_hand(arm: Arm, prompts: Prompts, pose: Mapping[str, float], limits: Limits) -> Calibration:
    from robot_ik.hardware import calibration
    from robot_ik.hardware.bus import read_all, shared_register

    config, bus = arm.config, arm.bus
    present = shared_register(config, "present_position")
    sweep = calibration.Sweep(config, read_all(bus, config, "present_position"))

    def sample() -> None:
        sweep.take({id: status.data for id, status in bus.sync_read(config.servo_ids, present).items()})

    def swept() -> None:
        calibration.check_sweep(config, sweep)

    def turned(joint: JointMap, before: Mapping[int, int]) -> dict[int, Sign]:
        return calibration.wiggled(config, joint, before, sweep.now)

    _step(prompts, "1. sweep: move every joint from one stop to the other", sample, swept)
    _show_sweep(config, sweep)
    where = ", ".join(f"{name} {config.joint(name).text(q)}" for name, q in pose.items())
    text = f"2. zero: put the arm into the pose {where} and hold it"
    zero = _step(prompts, text, sample, lambda: _held(arm, sweep, sample))
    swept()  # that pose may lie beyond what was swept
    directions: dict[int, Sign] = {}
    for k, joint in enumerate(config.joints, 1):
        about = joint.text(calibration.ASKED_WIGGLE * joint.lever, 0)
        text = f"3.{k} direction: move {joint.name} alone by about {about} in its positive direction"
        directions |= _step(prompts, text, sample, functools.partial(turned, joint, dict(sweep.now)))
    measured = calibration.Measured(sweep, zero, pose, directions, limits)
    return calibration.measured_calibration(bus, config, measured, sweep.now, _now())


def _step(prompts: Prompts, text: str, sample: Callable[[], None], judge: Callable[[], Found]) -> Found:
    """One step; where somebody sits there it is asked for again until it was done as asked."""
    from robot_ik.hardware.calibration import HandError

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
    from robot_ik.hardware.calibration import STILL_TICKS, HandError

    zero = dict(sweep.now)
    for _ in range(STILL_SAMPLES):
        arm.clock.sleep_until(arm.clock.now() + 0.05)
        sample()
        for servo in arm.config.servos:
            if abs(sweep.now[servo.id] - zero[servo.id]) > STILL_TICKS:
                raise HandError(f"joint {servo.name!r} moved while its zero was taken", hint="hold it still")
    return zero


def _imported(arm: Arm, path: Path, limits: Limits) -> Calibration:
    from robot_ik.hardware.bus import read_all
    from robot_ik.hardware.calibration_file import completed, load_lerobot

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
    from robot_ik.hardware.calibration_file import save_lerobot

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
    from robot_ik.hardware.calibration_file import Calibration, calibration_beside, save_lerobot

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


# ------------------------------------------------------------------------------------------
# ``robot-ik servo teach`` and ``play``: a hand shows a motion, the arm repeats it within its limits.


SUFFIXES = (".csv", ".json")

ALLOWED_OUTSIDE = math.radians(1.0)
"""rad by which a recording may pass a limit, as a soft stop gives; it is played at the limit."""

ARRIVED = math.radians(2.0)
"""rad between the end of a recording and the arm, up to which it counts as played."""


@dataclass(frozen=True)
class TeachOptions(BusOptions):
    """Records the arm while a hand guides it, torque off, until Enter or for --seconds.

    Ctrl-C ends it too: what was recorded is kept, and the exit code is 130.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE.csv|FILE.json")]]
    """Where to: times in s, joint angles in rad."""
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="(default: until Enter)")] = None
    """Record for so long."""
    rate: Annotated[float, arg(metavar="HZ")] = 50.0
    """Samples a second, at most 200."""
    overwrite: bool = False
    """An older file of that name may go."""


def run_teach(options: TeachOptions) -> int:
    """Records and writes the file."""
    require_suffix(options.file)
    if options.seconds is not None and not 0.0 < options.seconds <= 3600.0:
        raise wrong("--seconds", f"{options.seconds:g} s", "above 0, at most 3600")
    if not 0.0 < options.rate <= 200.0:
        raise wrong("--rate", f"{options.rate:g} Hz", "above 0, at most 200")
    config = load_arm(options.arm).whole
    require_model(config)
    with claimed(options.file, overwrite=options.overwrite):
        return _record(options, config)


def _record(options: TeachOptions, config: ArmConfig) -> int:
    from robot_ik.hardware.bus import shared_register

    times: list[float] = []
    poses: list[list[float]] = []
    with arm_on(options, config) as arm:
        require_limp(arm)
        present = shared_register(config, "present_position")
        begin = arm.clock.now()

        def sample() -> None:
            answers = arm.bus.sync_read(config.ids, present)
            ticks = [answers[id].data for id in config.ids]
            now = arm.clock.now() - begin
            if None not in ticks and (not times or now > times[-1]):
                pairs = zip(config.joints, ticks, strict=True)
                poses.append([joint.to_radians(t) for joint, t in pairs if t is not None])
                times.append(now)

        def record() -> int:
            try:
                prompts = Prompts(arm.clock, options.seconds, 1.0 / options.rate)
                prompts.step("recording: guide the arm by hand", sample)
            finally:
                _keep(options.file, times, poses, config)
            return console.DONE if times else console.NOT_ACHIEVED

        return tried(record)


def require_suffix(path: Path) -> None:
    """Raises ``ConfigError`` unless the name says one of the two forms."""
    if path.suffix not in SUFFIXES:
        raise wrong("FILE", f"{path} says no form", f"a name that ends in {' or '.join(SUFFIXES)}")


def _keep(path: Path, times: Sequence[float], poses: Sequence[Sequence[float]], config: ArmConfig) -> None:
    from robot_ik.motion import Trajectory

    if not times:
        console.say("error: no servo position could be read", "bold red")
        return
    motion = Trajectory(np.array(times) - times[0], poses, config.names)
    save_motion(path, motion)
    console.out().print(
        f"{path}: {len(motion)} samples, {motion.duration:.2f} s", markup=False, soft_wrap=True
    )
    for joint, most in zip(config.joints, outside(motion, config).tolist(), strict=True):
        if most > ALLOWED_OUTSIDE * joint.lever:
            console.say(f"{joint.name} was {joint.text(most)} beyond its limits: play refuses that", "yellow")


def save_motion(path: Path, motion: Trajectory) -> None:
    """CSV or JSON, by the name.

    Raises:
        OutputError: It cannot be written.
    """
    if path.suffix == ".csv":
        motion.save_csv(path)
        return
    content = {"schema": 1, "joints": list(motion.joints), "time_s": motion.times.tolist()}
    write_atomically(path, json.dumps({**content, "q_rad": motion.q.tolist()}) + "\n")


class _Recording(Table):
    version: Annotated[Literal[1], Field(alias="schema")] = 1
    joints: Several[str]
    time_s: Several[float]
    q_rad: Several[Several[float]]


def load_motion(path: Path, joints: Sequence[str]) -> Trajectory:
    """Reads what ``save_motion`` has written, in the order of ``joints``.

    Raises:
        ConfigError: It cannot be read, its numbers are no motion, or it is of other joints.
    """
    from robot_ik.motion import Trajectory

    require_suffix(path)
    if path.suffix == ".csv":
        motion = Trajectory.load_csv(path)
    else:
        try:
            content = check_table(_Recording, read_json(path, "the recording"), path)
            motion = Trajectory(content.time_s, content.q_rad, content.joints)
        except (TrajectoryError, ValueError) as error:  # ValueError: rows of different lengths
            raise ConfigError(f"this is no motion: {error.args[0]}", file=path, key="q_rad") from error
    if sorted(motion.joints) != sorted(joints):
        raise ConfigError(
            f"it is a motion of {', '.join(motion.joints)}", file=path, allowed=f"of {', '.join(joints)}"
        )
    order = [motion.joints.index(name) for name in joints]
    return Trajectory(motion.times, motion.q[:, order], joints)


def outside(motion: Trajectory, config: ArmConfig) -> Array:
    """(n,) rad, how far each joint is beyond its limits at most; 0 inside."""
    beyond = np.maximum(config.lower - motion.q, motion.q - config.upper)
    return np.asarray(np.maximum(beyond.max(axis=0), 0.0))


# ------------------------------------------------------------------------------------------- play


@dataclass(frozen=True)
class PlayOptions(BusOptions):
    """Repeats a recording: slowly to where it begins, then as it was, within limits and caps of the arm file.

    A recording that leaves the limits is refused; one that is too fast is played slower.
    At the end, and on Ctrl-C, the arm is left as --on-exit says: torque_off lets it fall.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE.csv|FILE.json")]]
    """A file of teach."""
    speed: float = 1.0
    """Share of the recorded speed, above 0 and up to 1."""
    record: Annotated[
        Path | None, arg(metavar="FILE.csv|FILE.mcap", help_behavior_hint="(default: none)")
    ] = None
    """Write every command and measurement while it happens (.mcap: extra `record`)."""
    on_exit: Annotated[
        str, arg(metavar="torque_off|hold|park", help_behavior_hint="(default: the arm file's)")
    ] = ""
    """How to leave the arm; park: back to where it was first."""


def run_play(options: PlayOptions) -> int:
    """Plays it; 1 when the arm did not get to its end."""
    from robot_ik.motion.recording import playable

    config = load_arm(options.arm).whole
    require_model(config)
    slowed(config, options.speed)  # its check
    motion = load_motion(options.file, config.names)
    for joint, most in zip(config.joints, outside(motion, config).tolist(), strict=True):
        if most > ALLOWED_OUTSIDE * joint.lever:
            low, high = joint.limits
            raise ConfigError(
                f"it leaves the limits by {joint.text(most)}; nothing was moved",
                file=options.file,
                key=joint.name,
                allowed=f"{low / joint.per_unit:.1f} to {joint.text(high)}",
            )
    motion, stretch = playable(motion, config, options.speed)
    arm = arm_on(options, config, options.on_exit)
    with claimed(options.record, overwrite=True), contextlib.ExitStack() as stack:
        sinks: list[JointSink] = [arm]
        if options.record is not None:
            from robot_ik.jobs.recording import RecordingSink, open_recording

            recording = stack.enter_context(open_recording(options.record, config.names))
            sinks.append(RecordingSink(recording, config.names, arm.positions))
        stack.enter_context(driving(arm))
        return tried(lambda: _play(arm, motion, stretch, sinks))


def _play(arm: Arm, motion: Trajectory, stretch: float, sinks: Sequence[JointSink]) -> int:
    from robot_ik.execution import execute
    from robot_ik.hardware.control_table import OperatingMode
    from robot_ik.motion.recording import approach

    arm.enable()
    first = approach(arm.read().q, motion.q[0], arm.config)
    with console.busy("going to where it begins", first.duration):
        execute(first, sinks, source=arm, clock=arm.clock, settle=0.2)
    with console.busy("playing", motion.duration):
        done = execute(motion, sinks, source=arm, clock=arm.clock, settle=0.4)
    assert done.final_error is not None and done.tracking_error is not None  # there was a source
    # By the last gear: a slide's way as its pinion turns.  Fingers that press may be held by something.
    levers = np.array([joint.lever for joint in arm.config.joints])
    free = np.array([joint.mode != OperatingMode.CURRENT_BASED_POSITION for joint in arm.config.joints])
    error, lag = free * np.abs(done.final_error) / levers, free * done.tracking_error / levers
    late = arm.config.joints[int(np.argmax(lag))]
    console.out().print(
        f"played {len(motion)} samples in {motion.duration:.2f} s ({stretch:.2f} x the recorded time); "
        f"largest tracking error {shown_value(late, float(done.tracking_error[int(np.argmax(lag))]))}",
        markup=False,
    )
    worst = int(np.argmax(error))
    if error[worst] > ARRIVED:
        joint = arm.config.joints[worst]
        raise HardwareError(
            f"{joint.name!r} ended {joint.text(error[worst] * joint.lever)} from where it was sent",
            hint="is something in its way, or is it too weak?",
        )
    return console.DONE
