"""An arm calibrated by a person: without torque, a hand shows ranges, zeros and directions."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar

from robot_ik.errors import ArmStateError
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.bus import read_all, shared_register
from robot_ik.hardware.calibration import (
    ASKED_WIGGLE,
    STILL_TICKS,
    OperatorError,
    Sweep,
    calibrated,
    check_calibration,
    check_sweep,
    counting_directions,
    measured_calibration,
)
from robot_ik.hardware.calibration_file import Calibration, calibration_beside, save_lerobot
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.joint_map import Sign

STILL_SAMPLES = 10
"""At 20 Hz: a hand that only passes through the pose is noticed."""

Found = TypeVar("Found")

Limits = Mapping[str, tuple[float, float]]
"""Joint -> limits, rad (m of a slide)."""


class Person(Protocol):
    """Somebody who moves the arm as asked."""

    def step(self, text: str, sample: Callable[[], object]) -> None:
        """Asks for a step, calls ``sample`` while it is done, and once more at its end."""

    def note(self, text: str) -> None:
        """Shows what a step has given."""

    def again(self, error: OperatorError) -> bool:
        """Shows why a step was not done as asked; whether it is to be asked for once more."""


def require_limp(arm: Arm) -> None:
    """Raises ``ArmStateError`` where torque is on: the arm cannot be moved by hand."""
    torque = read_all(arm.bus, arm.config, "torque_enable")
    if on := [servo.name for servo in arm.config.servos if torque.get(servo.id)]:
        raise ArmStateError(
            f"torque of {', '.join(on)} is on: the arm cannot be moved by hand",
            hint="support the arm, then: robot-ik servo torque off",
        )


def calibrate_by_hand(arm: Arm, person: Person, pose: Mapping[str, float], limits: Limits) -> Calibration:
    """Ranges, zeros and directions of an arm without torque, as a person shows them.

    The arm is connected, torque off.  ``pose``: joint -> rad (m of a slide) at which the zeros are taken;
    ``limits``: joint -> limits of the model, rad (m).

    Raises:
        OperatorError: A step was not done as asked, and is not to be repeated.
        HardwareError: A servo did not answer, or what it shows cannot be used.
    """
    config, bus = arm.config, arm.bus
    present = shared_register(config, "present_position")
    sweep = Sweep(config, read_all(bus, config, "present_position"))

    def sample() -> None:
        sweep.take({id: status.data for id, status in bus.sync_read(config.servo_ids, present).items()})

    swept = functools.partial(check_sweep, config, sweep)
    _step(person, "1. sweep: move every joint from one stop to the other", sample, swept)
    for servo in config.servos:
        ticks = f"ticks {sweep.low[servo.id]} to {sweep.high[servo.id]}"
        person.note(f"   {servo.name}: id {servo.id}, {ticks}, {servo.text(sweep.travel(servo), 0)}")
    where = ", ".join(f"{name} {config.joint(name).text(q)}" for name, q in pose.items())
    text = f"2. zero: put the arm into the pose {where} and hold it"
    zero = _step(person, text, sample, lambda: _held(arm, sweep, sample))
    swept()  # that pose may lie beyond what was swept
    directions: dict[int, Sign] = {}
    for k, joint in enumerate(config.joints, 1):
        about = joint.text(ASKED_WIGGLE * joint.lever, 0)
        text = f"3.{k} direction: move {joint.name} alone by about {about} in its positive direction"
        judge = functools.partial(counting_directions, config, joint, dict(sweep.now), sweep.now)
        directions |= _step(person, text, sample, judge)
    return measured_calibration(bus, config, sweep, zero, pose, directions, limits)


def save_calibrated(arm: Arm, found: Calibration, out: Path, lerobot: Path | None = None) -> ArmConfig:
    """The calibrated arm, in the arm file ``out``; what was measured goes into a file beside it.

    It is compared with the servos of the connected arm before anything is written, and the arm file is
    written last: it is the one that is used.  ``lerobot``: where LeRobot's calibration goes.

    Raises:
        HardwareError: Calibration and servos do not agree.
        OutputError: A file cannot be written.
    """
    found = replace(found, file=calibration_beside(out))
    config = calibrated(arm.config, found)
    check_calibration(arm.bus, config, found)
    if lerobot is not None:
        save_lerobot(lerobot, found)
    found.save(calibration_beside(out))
    config.save(out)
    return config


def _step(person: Person, text: str, sample: Callable[[], None], judge: Callable[[], Found]) -> Found:
    """What a step shows; it is repeated until it was done as asked, where the person can do that."""
    while True:
        person.step(text, sample)
        try:
            return judge()
        except OperatorError as error:
            if not person.again(error):
                raise


def _held(arm: Arm, sweep: Sweep, sample: Callable[[], None]) -> dict[int, int]:
    """Servo id -> ticks of an arm that is held still, which is checked."""
    zero = dict(sweep.now)
    for _ in range(STILL_SAMPLES):
        arm.clock.sleep_until(arm.clock.now() + 0.05)
        sample()
        for servo in arm.config.servos:
            if abs(sweep.now[servo.id] - zero[servo.id]) > STILL_TICKS:
                raise OperatorError(
                    f"joint {servo.name!r} moved while its zero was taken", hint="hold it still"
                )
    return zero
