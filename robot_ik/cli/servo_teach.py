"""``robot-ik servo teach`` and ``play``: a hand shows a motion, the arm repeats it within its limits."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.servo_calibrate import require_limp
from robot_ik.cli.servo_link import BusOptions, arm_on, driving, load_arm, require_model, tried
from robot_ik.cli.servo_move import shown_value, slowed
from robot_ik.cli.servo_prompt import Prompts
from robot_ik.errors import ConfigError, HardwareError, TrajectoryError
from robot_ik.files import claimed, config_error, read_json, write_atomically
from robot_ik.ports import Array

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.motion import Trajectory

SUFFIXES = (".csv", ".json")

APPROACH = 0.25
"""Share of the caps on the way to where a recording begins."""

ALLOWED_OUTSIDE = math.radians(1.0)
"""rad by which a recording may pass a limit, as a soft stop gives; it is played at the limit."""

SMOOTHING = 0.1
"""s over which a recording is averaged before it is played."""

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
    from robot_ik.hardware.startup import shared_register

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
    """Raises ``ConfigError`` unless the name tells one of the two forms."""
    if path.suffix not in SUFFIXES:
        raise wrong("FILE", f"{path} tells no form", f"a name that ends in {' or '.join(SUFFIXES)}")


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


class _Recording(BaseModel):
    model_config = ConfigDict(strict=True)

    joints: list[str]
    time_s: list[float]
    q_rad: list[list[float]]


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
            content = _Recording.model_validate(read_json(path, "the recording"))
            motion = Trajectory(content.time_s, content.q_rad, content.joints)
        except ValidationError as error:
            raise config_error(error, path) from error
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
    on_exit: Annotated[
        str, arg(metavar="torque_off|hold|park", help_behavior_hint="(default: the arm file's)")
    ] = ""
    """How to leave the arm; park: back to where it was first."""


def run_play(options: PlayOptions) -> int:
    """Plays it; 1 when the arm did not get to its end."""
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
    with driving(arm):
        return tried(lambda: _play(arm, motion, stretch))


def playable(motion: Trajectory, config: ArmConfig, speed: float) -> tuple[Trajectory, float]:
    """The motion within limits and velocity caps, at the arm's rate; and how much longer it takes."""
    from robot_ik.motion import Trajectory

    smooth = smoothed(motion, config.rate_hz)
    q = np.clip(smooth.q, config.lower, config.upper)
    needed = float((Trajectory(smooth.times, q, motion.joints).peak_velocity / config.velocity).max())
    stretch = max(1.0 / speed, needed)
    return Trajectory(stretch * smooth.times, q, motion.joints).resampled(config.rate_hz), stretch


def smoothed(motion: Trajectory, rate: float) -> Trajectory:
    """The running mean over ``SMOOTHING``, at ``rate`` Hz; it begins and ends where the motion does.

    Whole ticks, read at uneven times, have steps in them that no hand has made.
    """
    from robot_ik.motion import Trajectory

    count = math.ceil(motion.duration * rate) + 1
    q = np.array([motion.at(motion.times[0] + k / rate) for k in range(count)])
    width = max(round(SMOOTHING * rate), 1)
    padded = np.pad(q, ((width - 1, width - 1), (0, 0)), "edge")
    mean = np.lib.stride_tricks.sliding_window_view(padded, width, axis=0).mean(axis=-1)
    return Trajectory(np.arange(len(mean)) / rate, mean, motion.joints)


def _play(arm: Arm, motion: Trajectory, stretch: float) -> int:
    from robot_ik.execution import execute
    from robot_ik.hardware.control_table import OperatingMode

    arm.enable()
    first = approach(arm.read().q, motion.q[0], arm.config)
    with console.busy("going to where it begins", first.duration):
        execute(first, [arm], source=arm, clock=arm.clock, settle=0.2)
    with console.busy("playing", motion.duration):
        done = execute(motion, [arm], source=arm, clock=arm.clock, settle=0.4)
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


def approach(here: Array, there: Array, config: ArmConfig) -> Trajectory:
    """From rest to rest by a quintic, at ``APPROACH`` of the caps; its peaks: 1.875 d/T and 5.774 d/T^2."""
    from robot_ik.motion import Trajectory

    way = np.abs(there - here)
    times = (
        1.875 * way / (APPROACH * config.velocity),
        np.sqrt(5.774 * way / (APPROACH * config.acceleration)),
    )
    seconds = max(float(np.max(times)), 2.0 / config.rate_hz)
    t = np.linspace(0.0, seconds, math.ceil(seconds * config.rate_hz) + 1)
    s = t / seconds
    return Trajectory(t, here + np.outer(10 * s**3 - 15 * s**4 + 6 * s**5, there - here), config.names)
