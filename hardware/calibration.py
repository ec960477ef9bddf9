"""From a hand that moves a limp arm to numbers: ranges first, zeros second, directions by a wiggle.

Ranges come first because only a whole sweep shows whether a joint crosses the end of its servo's turn
(4095 -> 0); a zero taken before would be wrong by a turn beyond it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from robot_ik.errors import ConfigError, HardwareError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.calibration_file import Calibration, JointCalibration
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.control_table import TICKS_PER_TURN, OperatingMode
from robot_ik.hardware.registers import read_all

LEAST_SWEEP = math.radians(10.0)
"""rad at the joint; a joint that turned by less was forgotten."""

LEAST_WIGGLE = math.radians(3.0)
"""rad at the joint; less may be a hand that touched it by chance."""

LEAST_OVERLAP = 0.5
"""Share of a swept range that must lie within the model's: a zero that is half a turn off has less."""

STILL_TICKS = 12
"""About 1 degree: a held joint moves by less while its zero is taken."""

OUTSIDE_TICKS = 60
"""About 5 degrees beyond the swept range: backlash and a soft stop, not a lost turn."""

_IN_ARM_FILE = ("id", "model", "direction", "zero_ticks")
_SAME_LIMIT = 1e-6  # rad; the file keeps a millionth of a degree
_HALF = TICKS_PER_TURN // 2


class CalibrationMismatchError(HardwareError):
    """Calibration, servos, arm file and model do not agree.

    Attributes:
        rows: (joint, what, expected, found) of each difference.
    """

    def __init__(self, what: str, rows: Sequence[tuple[str, str, str, str]], hint: str) -> None:
        self.rows = tuple(rows)
        table = [("joint", "what", "expected", "found"), *rows]
        widths = [max(len(row[k]) for row in table) for k in range(4)]
        lines = [
            "  " + "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in table
        ]
        super().__init__(f"{what}\n" + "\n".join(line.rstrip() for line in lines), hint=hint)


class Sweep:
    """Smallest and largest position of every joint's servo, whole turns counted here.

    Args:
        config: The arm.
        ticks: Servo id -> Present Position at the beginning.
    """

    def __init__(self, config: ArmConfig, ticks: Mapping[int, int]) -> None:
        # A limp servo in position mode may count on beyond its turn; with torque it counts within it.
        turn = {j.id: TICKS_PER_TURN for j in config.joints if j.mode == OperatingMode.POSITION}
        self._raw = {id: ticks[id] for id in config.ids}
        self.now = {id: value % turn[id] if id in turn else value for id, value in self._raw.items()}
        self.low, self.high = dict(self.now), dict(self.now)

    def take(self, ticks: Mapping[int, int | None]) -> None:
        """The next reading; a step of more than half a turn is the servo starting its turn anew."""
        for id, before in self._raw.items():
            value = ticks.get(id)
            if value is None:
                continue
            step = value - before
            if abs(step) > _HALF:
                step -= round(step / TICKS_PER_TURN) * TICKS_PER_TURN
            self._raw[id] = value
            self.now[id] += step
            self.low[id] = min(self.low[id], self.now[id])
            self.high[id] = max(self.high[id], self.now[id])


def check_sweep(config: ArmConfig, sweep: Sweep) -> None:
    """Raises ``HardwareError`` where a joint was not swept, or crosses the end of its servo's turn."""
    for joint in config.joints:
        low, high = sweep.low[joint.id], sweep.high[joint.id]
        way = (high - low) * joint.resolution
        if way < LEAST_SWEEP:
            raise HardwareError(
                f"joint {joint.name!r} turned by {math.degrees(way):.1f} deg only",
                hint="sweep every joint from one stop to the other",
            )
        if joint.mode == OperatingMode.POSITION and not 0 <= low <= high < TICKS_PER_TURN:
            raise HardwareError(
                f"joint {joint.name!r} crosses the end of its servo's turn: it swept ticks {low} to {high}, "
                f"and a servo in position mode counts 0 to {TICKS_PER_TURN - 1}",
                hint='mount its horn about half a turn on, or set mode = "extended_position" in the arm file',
            )


def wiggled(config: ArmConfig, joint: JointMap, before: Mapping[int, int], after: Mapping[int, int]) -> int:
    """Which way a servo counts when its joint is turned in the positive direction.

    Args:
        config: The arm.
        joint: The one that was to be turned.
        before: Servo id -> ticks.
        after: The same now.

    Returns:
        +1 or -1.

    Raises:
        HardwareError: Nothing turned, or another joint did.
    """
    moves = {j.name: (after[j.id] - before[j.id]) * j.resolution for j in config.joints}
    most = max(moves, key=lambda name: abs(moves[name]))
    if abs(moves[most]) < LEAST_WIGGLE:
        raise HardwareError(
            f"joint {joint.name!r} did not turn (most: {most} by {math.degrees(abs(moves[most])):.1f} deg)",
            hint="turn it by about 10 degrees and leave it there",
        )
    if abs(moves[joint.name]) < LEAST_WIGGLE or abs(moves[most]) > 2.0 * abs(moves[joint.name]):
        raise HardwareError(
            f"{joint.name!r} was to be turned, and {most!r} did (by {math.degrees(moves[most]):.1f} deg)",
            hint="are two ids swapped? compare cables and arm file; robot-ik servo setup changes an id",
        )
    return 1 if moves[joint.name] > 0 else -1


@dataclass(frozen=True)
class Measured:
    """What the hand has shown.

    Attributes:
        sweep: Ranges; ``zero``: servo id -> ticks at ``pose``; ``pose``: joint -> rad; ``directions``: joint
            -> +1 or -1; ``limits``: joint -> limits of the model, rad.
    """

    sweep: Sweep
    zero: Mapping[int, int]
    pose: Mapping[str, float]
    directions: Mapping[str, int]
    limits: Mapping[str, tuple[float, float]]


def calibrated(config: ArmConfig, found: Calibration) -> ArmConfig:
    """The arm file with measured zeros and directions, and limits that the sweep has reached.

    Raises:
        CalibrationMismatchError: Ranges that are mostly outside the arm file's and the model's limits.
    """
    joints, rows = [], []
    for joint, row in zip(config.joints, found.joints, strict=True):
        made = replace(joint, direction=row.direction, zero_ticks=row.zero_ticks)
        low, high = sorted(made.to_radians(t) for t in (row.range_min, row.range_max))
        most = max(joint.lower, math.radians(row.urdf_lower)), min(joint.upper, math.radians(row.urdf_upper))
        lower, upper = max(low, most[0]), min(high, most[1])
        if upper - lower < LEAST_OVERLAP * min(high - low, most[1] - most[0]):
            rows.append((joint.name, "range, deg", _range(*most), _range(low, high)))
        joints.append(replace(made, lower=lower, upper=upper))
    if rows:
        raise CalibrationMismatchError(
            "the swept ranges are not those of arm file and model",
            rows,
            "was the arm in the pose asked for when its zero was taken? is the horn half a turn off?",
        )
    return replace(config, joints=tuple(joints), file=None)


def _range(low: float, high: float) -> str:
    return f"{math.degrees(low):.1f} .. {math.degrees(high):.1f}"


def measured_calibration(
    bus: ServoBus, config: ArmConfig, measured: Measured, present: Mapping[int, int], created: str
) -> Calibration:
    """Puts the numbers together with what the servos say of themselves.

    Raises:
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError.
    """
    names = ("firmware_version", "drive_mode", "homing_offset")
    registers = {name: read_all(bus, config, name) for name in names}
    rows = []
    for joint in config.joints:
        direction = measured.directions[joint.name]
        turned = replace(joint, direction=direction)
        zero = measured.zero[joint.id] - round(turned.ticks_per_radian * measured.pose[joint.name])
        lower, upper = (math.degrees(q) for q in measured.limits[joint.name])
        rows.append(
            JointCalibration(
                joint.name,
                joint.id,
                joint.model,
                registers["firmware_version"][joint.id],
                registers["drive_mode"][joint.id],
                registers["homing_offset"][joint.id],
                measured.sweep.low[joint.id],
                measured.sweep.high[joint.id],
                direction,
                zero,
                round(lower, 6),
                round(upper, 6),
                present[joint.id],
            )
        )
    return Calibration(config.name, config.robot, created, config.baud, tuple(rows))


def check_calibration(
    bus: ServoBus, config: ArmConfig, found: Calibration, limits: Mapping[str, tuple[float, float]]
) -> None:
    """Compares a calibration with arm file, model and servos.  Writes nothing.

    Args:
        bus: Open, with the servos of the arm.
        config: The arm file in use.
        found: Its calibration.
        limits: Joint -> limits of the model now, rad; empty where the model is not at hand.

    Raises:
        CalibrationMismatchError: With a table of all differences.
        ConfigError: The calibration is of another arm.
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError.
    """
    if (others := tuple(joint.name for joint in found.joints)) != config.names:
        raise ConfigError(
            f"it is a calibration of {', '.join(others)}",
            file=found.file or found.arm,
            key="joints",
            allowed=", ".join(config.names),
        )
    names = ("drive_mode", "homing_offset", "present_position")
    servo = {name: read_all(bus, config, name) for name in names}
    rows: list[tuple[str, str, str, str]] = []
    for joint, row in zip(config.joints, found.joints, strict=True):
        said = {name: values[joint.id] for name, values in servo.items()}
        rows += _differences(joint, row, said, limits.get(joint.name))
    if rows:
        raise CalibrationMismatchError(
            f"the arm does not agree with its calibration {found.file or ''}".rstrip(),
            rows,
            "calibrate again; or bring servos, arm file and model back to what they were "
            "(a present position that is whole turns off: turn the joint by hand)",
        )


def _differences(
    joint: JointMap, row: JointCalibration, servo: Mapping[str, int], limits: tuple[float, float] | None
) -> list[tuple[str, str, str, str]]:
    """(joint, what, expected, found) of what differs at one joint; ``limits``: of the model now, rad."""
    pairs = [(key, getattr(row, key), getattr(joint, key)) for key in _IN_ARM_FILE]
    pairs += [(key, getattr(row, key), servo[key]) for key in ("drive_mode", "homing_offset")]
    rows = [(joint.name, key, str(was), str(now)) for key, was, now in pairs if was != now]
    present = servo["present_position"]
    if joint.mode == OperatingMode.POSITION:
        present %= TICKS_PER_TURN
    if not row.range_min - OUTSIDE_TICKS <= present <= row.range_max + OUTSIDE_TICKS:
        rows.append((joint.name, "present position", f"{row.range_min} .. {row.range_max}", str(present)))
    then = (math.radians(row.urdf_lower), math.radians(row.urdf_upper))
    if limits is not None and max(abs(a - b) for a, b in zip(then, limits, strict=True)) > _SAME_LIMIT:
        rows.append((joint.name, "limits of the model, deg", _range(*then), _range(*limits)))
    return rows
