"""``robot-ik servo calibrate``, ``teach`` and ``play``: a hand shows, the arm repeats."""

from __future__ import annotations

import contextlib
import os
import queue
import select
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import OnExit, Overwrite, RecordFile, positive, several, single, wrong
from robot_ik.cli.connection import BusOptions, arm_on, attempt, driving, load_arm, model_limits
from robot_ik.cli.servo_motion import parse_angles, shown_value
from robot_ik.errors import HardwareError
from robot_ik.jobs.results import claimed
from robot_ik.ports import Clock, JointSink

if TYPE_CHECKING:
    from robot_ik.hardware.calibration import OperatorError
    from robot_ik.hardware.calibration_file import Calibration
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.motion import Trajectory


# ------------------------------------------------------------------------------------------
# Steps in which a person does something to the arm, until Enter or for a time; meanwhile it is sampled.


_NO_ENTER = "standard input has ended, so nobody can press Enter"


class Prompts:
    """Asks for one step after the other.

    Args:
        clock: Paces the samples.
        seconds: Each step lasts so long; None: until Enter (a line on standard input).
        period: s between two samples.

    Raises:
        ConfigError: Steps until Enter, and standard input has ended already.
    """

    def __init__(self, clock: Clock, seconds: float | None = None, period: float = 0.02) -> None:
        self._clock = clock
        self._period = period
        self._seconds = seconds
        self._lines: queue.Queue[bool] = queue.Queue()
        self._reader: threading.Thread | None = None
        with contextlib.suppress(OSError):  # Windows asks only sockets whether there is something to read
            if seconds is None and select.select([_input()], [], [], 0.0)[0] and not self._more():
                raise wrong("--seconds", _NO_ENTER, "--seconds S")

    def step(self, text: str, sample: Callable[[], object]) -> None:
        """Says what to do and samples until it is done, and once more then.

        Raises:
            HardwareError: Standard input has ended.  Whatever ``sample`` raises.
        """
        ending = "then press Enter" if self._seconds is None else f"{self._seconds:g} s from now"
        console.say(f"{text}; {ending}", "bold")
        if self._reader is None and self._seconds is None:
            self._reader = threading.Thread(target=self._read, name="standard input", daemon=True)
            self._reader.start()
        end = self._clock.now() + (self._seconds or 0.0)
        due = self._clock.now()
        while not (self._entered() if self._seconds is None else self._clock.now() >= end):
            sample()
            due = max(due + self._period, self._clock.now())
            self._clock.sleep_until(due)
        sample()

    def note(self, text: str) -> None:
        console.say(text)

    def again(self, error: OperatorError) -> bool:
        """Shows why a step was not done as asked; at a terminal it can be done again."""
        if self._seconds is not None or sys.__stdin__ is None or not sys.__stdin__.isatty():
            return False
        console.show_error(error)
        console.say("once more (Ctrl-C gives up; nothing is written)", "yellow")
        return True

    def _entered(self) -> bool:
        try:
            more = self._lines.get_nowait()
        except queue.Empty:
            return False
        if not more:
            self._lines.put(False)
            raise HardwareError(_NO_ENTER, hint="give --seconds S")
        return True

    def _read(self) -> None:
        # Not sys.stdin: at the end of the interpreter a thread that waits inside it would hold its lock.
        with contextlib.suppress(OSError, ValueError):
            while self._more():
                pass
        self._lines.put(False)

    def _more(self) -> bool:
        """Takes what was typed; False: standard input has ended."""
        data = os.read(_input(), 1024)
        for _ in range(data.count(b"\n")):
            self._lines.put(True)
        return bool(data)


def _input() -> int:
    return sys.__stdin__.fileno() if sys.__stdin__ else 0


@dataclass(frozen=True)
class ServoCalibrateOptions(BusOptions):
    """Calibrates an arm by hand, torque off: sweep every joint, hold the zero pose, turn each joint a little.

    --arm gives names, ids, models, modes and limits. OUT.toml becomes the calibrated arm file, and
    OUT.calibration.toml beside it what was measured; from then on: --arm OUT.toml. The commands that move
    the arm compare the two with the servos and refuse an arm that is another.
    """

    out: Positional[Annotated[Path, arg(metavar="OUT.toml")]]
    """The calibrated arm file."""
    pose: Annotated[tuple[str, ...], several("JOINT=DEG", "all joints at 0")] = ()
    """Another pose than zero in which the zeros are taken."""
    seconds: Annotated[float | None, single("S", "each step until Enter"), positive(3600.0, " s")] = None
    """Each step takes so long, without Enter."""
    from_lerobot: Annotated[Path | None, single("FILE.json")] = None
    """Take LeRobot's calibration instead of a hand; 0 degrees are the middle of each range, as there."""
    to_lerobot: Annotated[Path | None, single("FILE.json")] = None
    """Also write LeRobot's calibration."""
    check: bool = False
    """Only compare an OUT.toml that exists, and its calibration, with the servos."""
    overwrite: Overwrite = False


def run_calibrate(options: ServoCalibrateOptions) -> int:
    """Measures, checks, writes; 1 when a step was not done as asked."""
    from robot_ik.hardware.calibration_file import calibration_beside

    if options.out.suffix != ".toml" or options.out.name.endswith(".calibration.toml"):
        raise wrong("OUT.toml", f"{options.out}", "a name that ends in .toml")
    if options.check:
        return _check(options)
    # Without its file: what it was calibrated to before may be wrong, that is why.
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
    from robot_ik.jobs.hand_guiding import calibrate_by_hand, require_limp, save_calibrated

    limits = model_limits(config)
    arm = arm_on(options, config)
    if options.from_lerobot is not None:
        measure = partial(load_lerobot, options.from_lerobot, arm.config, limits)
    else:  # the prompts may refuse: before the arm is connected
        measure = partial(calibrate_by_hand, arm, Prompts(arm.clock, options.seconds), pose, limits)
    with arm:
        require_limp(arm)
        with attempt():
            found = measure()
            made = save_calibrated(arm, found, options.out, options.to_lerobot)
        _show(arm.config, made, found)
        console.say(f"wrote {options.out} and {beside}; from here on: --arm {options.out}", "green")
    return console.DONE


def _check(options: ServoCalibrateOptions) -> int:
    from robot_ik.hardware.calibration import check_calibration
    from robot_ik.hardware.calibration_file import Calibration, calibration_beside
    from robot_ik.hardware.lerobot_calibration import save_lerobot

    found = Calibration.load(calibration_beside(options.out))
    config = load_arm(str(options.out))
    with claimed(options.to_lerobot, overwrite=options.overwrite):
        with arm_on(options, config) as arm:  # which compares it with the model
            check_calibration(arm.bus, config, found)
        if options.to_lerobot is not None:
            save_lerobot(options.to_lerobot, found)
    console.result(f"{options.out}, its calibration, model and servos agree")
    return console.DONE


def _show(before: ArmConfig, after: ArmConfig, found: Calibration) -> None:
    rows = []
    for old, new, row in zip(before.drives, after.drives, found.rows, strict=True):
        limits, formerly = (
            f"{j.lower / j.per_unit:.1f} .. {j.text(j.upper)}" for j in (new.joint, old.joint)
        )
        swept = f"{row.range_min} .. {row.range_max}"
        rows.append((row.name, row.id, swept, row.zero_ticks, f"{row.direction:+d}", limits, formerly))
    columns = ("joint", "id", "swept ticks", "zero", "direction", "limits", "limits before")
    console.show(console.table(*columns, rows=rows))


@dataclass(frozen=True)
class ServoTeachOptions(BusOptions):
    """Records the arm while a hand guides it, torque off, until Enter or for --seconds.

    Ctrl-C ends it too: what was recorded is kept, and the exit code is 130.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE.csv")]]
    """Where to: times in s, joint angles in rad."""
    seconds: Annotated[float | None, single("S", "until Enter"), positive(3600.0, " s")] = None
    """Record for so long."""
    rate: Annotated[float, arg(metavar="HZ"), positive(200.0, " Hz")] = 50.0
    """Samples a second, at most 200."""
    overwrite: Overwrite = False


def run_teach(options: ServoTeachOptions) -> int:
    """Records and writes the file."""
    from robot_ik.jobs.hand_guiding import TaughtMotion

    if options.file.suffix != ".csv":
        raise wrong("FILE.csv", f"{options.file}", "a name that ends in .csv")
    config = load_arm(options.arm)
    arm = arm_on(options, config)
    prompts = Prompts(arm.clock, options.seconds, 1.0 / options.rate)  # may refuse: before it is connected
    with claimed(options.file, overwrite=options.overwrite), arm:
        taught = TaughtMotion(arm)
        with attempt():
            try:
                prompts.step("recording: guide the arm by hand", taught.sample)
            finally:
                _keep(options.file, taught.motion(), arm.config)
    return console.DONE if taught.motion() is not None else console.NOT_ACHIEVED


def _keep(path: Path, motion: Trajectory | None, config: ArmConfig) -> None:
    from robot_ik.jobs.hand_guiding import outside

    if motion is None:
        console.refused("no servo position could be read")
        return
    motion.save_csv(path)
    console.result(f"{path}: {len(motion)} samples, {motion.duration:.2f} s")
    for joint, most in outside(motion, config):
        console.say(f"{joint.name} was {joint.text(most)} beyond its limits: play refuses that", "yellow")


@dataclass(frozen=True)
class ServoPlayOptions(BusOptions):
    """Repeats a recording: slowly to where it begins, then as it was, within limits and caps of the arm file.

    A recording that leaves the limits is refused; one that is too fast is played slower. One without the
    gripper's joints, as reach writes it, moves the arm and leaves the gripper as it is.
    With [collisions] in the arm file a recording that would touch is refused.
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
    """Plays it; 1 when the arm did not get to its end."""
    from robot_ik.jobs.hand_guiding import load_playable, play_motion
    from robot_ik.workcell.arm_guard import guard_of

    whole = load_arm(options.arm)
    config, motion, stretch = load_playable(options.file, whole, options.speed)
    held = [name for name in whole.names if name not in config.names]
    if held:
        console.say(f"the recording has no {', '.join(held)}: held where it stands", "dim")
    guard = guard_of(whole)
    arm = arm_on(options, whole, options.on_exit)
    with claimed(options.record, overwrite=options.overwrite), contextlib.ExitStack() as stack:
        sinks: list[JointSink] = []
        if options.record is not None:
            from robot_ik.jobs.recording import RecordingSink, open_recording

            recording = stack.enter_context(open_recording(options.record, config.names))
            sinks.append(RecordingSink(recording, config.names, arm.positions))
        stack.enter_context(driving(arm))
        report = play_motion(arm, motion, sinks, console.busy, guard)
        console.result(
            f"played {len(motion)} samples in {motion.duration:.2f} s ({stretch:.2f} x the recorded time); "
            f"largest tracking error {shown_value(report.late, report.tracking_error)}"
        )
        report.require_arrived()
    return console.DONE
