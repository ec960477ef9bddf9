"""Calibration of an arm by hand: a person sweeps all joints, holds a pose, and turns each joint."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar

from robot_ik.errors import ArmStateError
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.arm_registers import read_all, shared_register
from robot_ik.hardware.calibration import (
    PROMPTED_WIGGLE,
    STILL_TICKS,
    OperatorError,
    Sweep,
    calibrated,
    check_calibration,
    check_sweep,
    counting_directions,
    measured_calibration,
)
from robot_ik.hardware.calibration_file import Calibration, calibration_beside
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.lerobot_calibration import save_lerobot
from robot_ik.hardware.servo import Sign
from robot_ik.schedule import Schedule

STILL_SAMPLES = 10
"""Number of samples in which the pose must not move."""

STILL_PERIOD = 0.05
"""s between these samples. In half a second a hand that only passes through the pose moves on."""

T = TypeVar("T")

Limits = Mapping[str, tuple[float, float]]
"""Joint -> limits, rad (slides: m)."""


class Prompter(Protocol):
    """Shows instructions to the person who moves the arm."""

    def step(self, text: str, sample: Callable[[], object]) -> None:
        """Show an instruction, call ``sample`` until the step is done, and once afterwards."""

    def note(self, text: str) -> None:
        """Show the result of a step."""

    def again(self, error: OperatorError) -> bool:
        """Show why a step failed. Return whether the person repeats it."""


def require_limp(arm: Arm) -> None:
    """Check that the arm can be moved by hand.

    Raises:
        ArmStateError: A servo has torque.
    """
    torque = read_all(arm.bus, arm.config, "torque_enable")
    stiff = [drive.name for drive in arm.config.drives if torque.get(drive.id)]
    if stiff:
        raise ArmStateError(
            f"torque of {', '.join(stiff)} is on: the arm cannot be moved by hand",
            hint="support the arm, then: robot-ik servo torque off",
        )


def calibrate_by_hand(
    arm: Arm, prompter: Prompter, pose: Mapping[str, float], limits: Limits
) -> Calibration:
    """Measure ranges, zeros and directions of an arm that a person moves.

    Args:
        arm: Connected, without torque.
        prompter: Shows the steps.
        pose: Joint -> rad (slides: m) at which the zeros are taken.
        limits: Joint -> limits of the model, rad (slides: m).

    Raises:
        OperatorError: A step failed, and the person does not repeat it.
        HardwareError: A servo did not answer, or the measurements cannot be used.
    """
    config = arm.config
    bus = arm.bus
    present = shared_register(config, "present_position")
    if config.family.capabilities.half_turn_homing:
        text = "0. middle: put every joint into the middle of its range and hold it"
        prompter.step(text, lambda: None)
        config.family.home_half_turn(bus, config)
    sweep = Sweep(config, read_all(bus, config, "present_position"))

    def sample() -> None:
        replies = bus.sync_read(config.servo_ids, present)
        sweep.take({id: status.data for id, status in replies.items()})

    check_ranges = functools.partial(check_sweep, config, sweep)
    text = "1. sweep: move every joint from one stop to the other"
    _measure(prompter, text, sample, check_ranges)
    for drive in config.drives:
        ticks = f"ticks {sweep.low[drive.id]} to {sweep.high[drive.id]}"
        travel = drive.joint.text(sweep.travel(drive), 0)
        prompter.note(f"   {drive.name}: id {drive.id}, {ticks}, {travel}")
    values = ", ".join(f"{name} {config.joint(name).text(q)}" for name, q in pose.items())
    text = f"2. zero: put the arm into the pose {values} and hold it"
    zero = _measure(prompter, text, sample, lambda: _held_ticks(arm, sweep, sample))
    check_ranges()  # the pose may be beyond the swept ranges
    directions: dict[int, Sign] = {}
    for k, joint in enumerate(config.joints, 1):
        about = joint.text(PROMPTED_WIGGLE * joint.lever, 0)
        text = (
            f"3.{k} direction: move {joint.name} alone by about {about} in its positive direction"
        )
        start = dict(sweep.now)
        evaluate = functools.partial(counting_directions, config, joint, start, sweep.now)
        directions |= _measure(prompter, text, sample, evaluate)
    return measured_calibration(bus, config, sweep, zero, pose, directions, limits)


def save_calibrated(
    arm: Arm, calibration: Calibration, out: Path, lerobot: Path | None = None
) -> ArmConfig:
    """Write a calibrated arm file, and a file with the measurements beside it.

    Both are compared with the servos before anything is written. The arm file is written last,
    because the commands use that file.

    Args:
        arm: Connected.
        calibration: The measurements.
        out: Name of the arm file.
        lerobot: Name of a file in LeRobot's format. None: not written.

    Returns:
        The calibrated arm file.

    Raises:
        HardwareError: Calibration and servos do not agree.
        OutputError: A file cannot be written.
    """
    calibration = replace(calibration, file=calibration_beside(out))
    config = calibrated(arm.config, calibration)
    check_calibration(arm.bus, config, calibration)
    if lerobot is not None:
        save_lerobot(lerobot, calibration)
    calibration.save(calibration_beside(out))
    config.save(out)
    return config


def _measure(
    prompter: Prompter, text: str, sample: Callable[[], None], evaluate: Callable[[], T]
) -> T:
    """Return the result of a step. A failed step is repeated if the person can repeat it."""
    while True:
        prompter.step(text, sample)
        try:
            return evaluate()
        except OperatorError as error:
            if not prompter.again(error):
                raise


def _held_ticks(arm: Arm, sweep: Sweep, sample: Callable[[], None]) -> dict[int, int]:
    """Return servo id -> ticks of an arm that is held still.

    Raises:
        OperatorError: A joint moved.
    """
    ticks = dict(sweep.now)
    due = ((k * STILL_PERIOD, k) for k in range(1, STILL_SAMPLES + 1))
    for _ in Schedule(arm.clock).ticks(due):
        sample()
        for drive in arm.config.drives:
            if abs(sweep.now[drive.id] - ticks[drive.id]) > STILL_TICKS:
                raise OperatorError(
                    f"joint {drive.name!r} moved while its zero was taken", hint="hold it still"
                )
    return ticks
