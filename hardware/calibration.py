"""Calibration of a limp arm by hand: first ranges, then zeros, then directions.

Ranges come first, because only a full sweep shows whether a joint crosses the end of its servo's
revolution (4095 -> 0). A zero taken earlier could be wrong by a revolution. Two servos of one joint
are swept together, and the sweep checks that they turn together. Functions that read servos also
raise the errors of the bus.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from robot_ik.errors import ConfigError, HardwareError
from robot_ik.files import timestamp
from robot_ik.hardware.arm_registers import read_all
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.calibration_file import Calibration, JointCalibration, calibration_beside
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import REVERSE
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import RANGE_TOLERANCE_TICKS, TWIST, Drive, Joint, Servo, Sign

MIN_SWEEP = math.radians(10.0)
"""rad at the joint (at the pinion of a slide). A joint that turns by less counts as not swept."""

MIN_WIGGLE = math.radians(3.0)
"""rad at the joint. A person may turn a joint by less by accident."""

PROMPTED_WIGGLE = math.radians(10.0)
"""rad at the joint by which the user is prompted to turn it."""

STILL_TICKS = 12
"""Ticks (about 1 degree). A held joint moves by less while its zero is taken."""


class OperatorError(HardwareError):
    """The user did not do what a step requires. The step can be repeated."""


class Sweep:
    """Smallest and largest position of every servo. Whole revolutions are counted here.

    Args:
        config: Arm.
        ticks: Servo id -> Present Position at the beginning.

    Attributes:
        now: Servo id -> present position, ticks.
        low: Servo id -> smallest position, ticks.
        high: Servo id -> largest position, ticks.
    """

    def __init__(self, config: ArmConfig, ticks: Mapping[int, int]) -> None:
        # Without torque a servo in position mode may count beyond its revolution.
        period = {servo.id: TICKS_PER_REVOLUTION for servo in config.servos if servo.is_single_turn}
        self._raw = {id: ticks[id] for id in config.servo_ids}
        self.now = {
            id: value % period[id] if id in period else value for id, value in self._raw.items()
        }
        self.low = dict(self.now)
        self.high = dict(self.now)

    def take(self, ticks: Mapping[int, int | None]) -> None:
        """Take the next sample. A step of more than half a revolution is a wrap of the count."""
        for id, before in self._raw.items():
            value = ticks.get(id)
            if value is None:
                continue
            step = value - before
            if abs(step) > TICKS_PER_REVOLUTION // 2:
                step -= round(step / TICKS_PER_REVOLUTION) * TICKS_PER_REVOLUTION
            self._raw[id] = value
            self.now[id] += step
            self.low[id] = min(self.low[id], self.now[id])
            self.high[id] = max(self.high[id], self.now[id])

    def travel(self, drive: Drive) -> float:
        """Return the range of the joint, rad (m of a slide)."""
        return (self.high[drive.id] - self.low[drive.id]) * drive.joint.resolution


def check_sweep(config: ArmConfig, sweep: Sweep) -> None:
    """Check that a sweep can be used.

    Raises:
        OperatorError: A joint was not swept.
        HardwareError: A joint crosses the end of its servo's revolution, or its two servos did not
            turn together.
    """
    for drive in config.drives:
        joint, servo = drive
        low = sweep.low[servo.id]
        high = sweep.high[servo.id]
        if sweep.travel(drive) < MIN_SWEEP * joint.lever:
            which = f" (servo id {servo.id})" if servo is not joint.servo else ""
            raise OperatorError(
                f"joint {joint.name!r}{which} moved only by {joint.text(sweep.travel(drive))}",
                hint="sweep every joint from one stop to the other",
            )
        if servo.is_single_turn and not 0 <= low <= high < TICKS_PER_REVOLUTION:
            raise HardwareError(
                f"joint {joint.name!r} crosses the end of its servo's revolution: it swept ticks "
                f"{low} to {high}, and a servo in position mode counts 0 to "
                f"{TICKS_PER_REVOLUTION - 1}",
                hint='mount its horn about half a revolution on, or set mode = "extended_position" '
                "in the arm file",
            )
    for joint in config.joints:
        travel = sweep.travel(Drive(joint, joint.servo))
        for other in joint.servos[1:]:
            _require_together(joint, other, travel, sweep.travel(Drive(joint, other)))


def _require_together(joint: Joint, other: Servo, travel: float, other_travel: float) -> None:
    """Raise ``HardwareError`` if two servos of a joint turned by different amounts."""
    if abs(abs(travel) - abs(other_travel)) > TWIST * joint.lever:
        raise HardwareError(
            f"the two servos of joint {joint.name!r} do not turn together: id {joint.servo.id} by "
            f"{joint.text(travel)}, id {other.id} by {joint.text(other_travel)}",
            hint="check that no horn or gear slips and that both have the ratio of the arm file",
        )


def counting_directions(
    config: ArmConfig, joint: Joint, before: Mapping[int, int], after: Mapping[int, int]
) -> dict[int, Sign]:
    """Return servo id -> counting direction of a joint that was turned positively.

    Args:
        config: Arm.
        joint: Joint that was turned.
        before: Servo id -> ticks of all servos before.
        after: Servo id -> ticks of all servos after.

    Raises:
        OperatorError: No joint was turned, or another one.
        HardwareError: The two servos of the joint did not turn together.
    """
    turns = {
        servo.id: (after[servo.id] - before[servo.id]) * moved.resolution / moved.lever
        for moved, servo in config.drives
    }
    largest = max(config.drives, key=lambda drive: abs(turns[drive.id]))
    farthest = largest.joint.text(abs(turns[largest.id]) * largest.joint.lever)
    turn = turns[joint.servo.id]
    if abs(turns[largest.id]) < MIN_WIGGLE:
        raise OperatorError(
            f"joint {joint.name!r} did not turn (most: {largest.name} by {farthest})",
            hint=f"turn it by about {joint.text(PROMPTED_WIGGLE * joint.lever, 0)} and leave it",
        )
    if abs(turn) < MIN_WIGGLE or (
        largest.name != joint.name and abs(turns[largest.id]) > 2.0 * abs(turn)
    ):
        raise OperatorError(
            f"joint {largest.name!r} turned instead of {joint.name!r}, by {farthest}",
            hint="two ids may be swapped: compare cables and arm file; robot-ik servo setup "
            "changes an id",
        )
    for other in joint.servos[1:]:
        _require_together(joint, other, turn * joint.lever, turns[other.id] * joint.lever)
    return {servo.id: 1 if turns[servo.id] > 0 else -1 for servo in joint.servos}


def check_shadows(
    config: ArmConfig, directions: Mapping[int, int], zero: Mapping[int, int]
) -> None:
    """Check that every shadow can follow its servo, by directions and zeros.

    Raises:
        HardwareError: A shadow cannot follow its servo.
    """
    for joint, servo in config.drives:
        if servo.primary_id is None:
            continue
        which = f"the shadow of joint {joint.name!r} (servo id {servo.id})"
        if directions[servo.id] != directions[servo.primary_id]:
            raise HardwareError(
                f"{which} counts the other way round",
                hint="set bit 0 of its Drive Mode (reverse), or give it goals of its own: "
                "shadow = false",
            )
        apart = abs(zero[servo.id] - zero[servo.primary_id]) * joint.resolution
        if apart > TWIST * joint.lever:
            raise HardwareError(
                f"{which} stands {joint.text(apart)} beside the servo whose goals it takes",
                hint="turn its horn, or give it goals of its own: shadow = false in the arm file",
            )


MIN_OVERLAP = 0.5
"""Share of a swept range that must lie within the model's range.

A zero that is wrong by half a revolution leaves less.
"""

_IN_ARM_FILE = ("id", "model", "direction", "zero_ticks")
"""Keys of a calibration that the arm file has, too."""
_SAME_LIMIT = 1e-6
"""rad. The calibration file keeps a millionth of a degree."""


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
            "  " + "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True))
            for row in table
        ]
        super().__init__(f"{what}\n" + "\n".join(line.rstrip() for line in lines), hint=hint)


def calibrated(config: ArmConfig, calibration: Calibration) -> ArmConfig:
    """Return the arm with measured zeros and directions, within the swept ranges.

    Raises:
        CalibrationMismatchError: A range is mostly outside the limits of arm file and model.
    """
    joints = []
    rows = []
    second = {row.name: row for row in calibration.twins}
    for joint, row in zip(config.joints, calibration.joints, strict=True):
        servos = [replace(joint.servo, direction=row.direction, zero_ticks=row.zero_ticks)]
        for servo in joint.servos[1:]:
            measured = row if servo.primary_id is not None else second[joint.name]
            servos.append(
                replace(servo, direction=measured.direction, zero_ticks=measured.zero_ticks)
            )
        calibrated_joint = replace(joint, servos=tuple(servos))
        low, high = sorted(
            calibrated_joint.value(ticks) for ticks in (row.range_min, row.range_max)
        )
        limits = [joint.per_unit * limit for limit in (row.urdf_lower, row.urdf_upper)]
        common = max(joint.lower, limits[0]), min(joint.upper, limits[1])
        lower = max(low, common[0])
        upper = min(high, common[1])
        if upper - lower < MIN_OVERLAP * min(high - low, common[1] - common[0]):
            rows.append(
                (
                    joint.name,
                    f"range, {joint.unit}",
                    _range(joint, *common),
                    _range(joint, low, high),
                )
            )
        joints.append(replace(calibrated_joint, lower=lower, upper=upper))
    if rows:
        raise CalibrationMismatchError(
            "the swept ranges do not match arm file and model",
            rows,
            "check that the arm was in the requested pose when its zero was taken, and that no "
            "horn is mounted half a revolution off",
        )
    return replace(config, joints=tuple(joints), file=None, uncalibrated=False)


def _range(joint: Joint, low: float, high: float) -> str:
    return f"{low / joint.per_unit:.1f} .. {high / joint.per_unit:.1f}"


def measured_calibration(
    bus: ServoBus,
    config: ArmConfig,
    sweep: Sweep,
    zero: Mapping[int, int],
    pose: Mapping[str, float],
    directions: Mapping[int, Sign],
    limits: Mapping[str, tuple[float, float]],
) -> Calibration:
    """Return the calibration of the sweep, the zeros, the directions and the servos' registers.

    Args:
        bus: Open bus.
        config: Arm.
        sweep: Ranges.
        zero: Servo id -> ticks at ``pose``.
        pose: Joint -> rad (m of a slide).
        directions: Servo id -> counting direction.
        limits: Joint -> limits of the model, rad (m).
    """
    drive_mode = read_all(bus, config, "drive_mode", absent=0)
    homing = read_all(bus, config, "homing_offset")
    check_shadows(config, directions, zero)
    rows = []
    for joint, servo in config.drives:
        # A shadow takes the goals of its primary servo.
        leader = servo.id if servo.primary_id is None else servo.primary_id
        direction = directions[leader]
        turned = replace(servo, direction=direction)
        zero_ticks = zero[leader] - (
            joint.nearest_ticks(pose[joint.name], turned) - turned.zero_ticks
        )
        lower, upper = (q / joint.per_unit for q in limits[joint.name])
        rows.append(
            JointCalibration(
                joint.name,
                servo.id,
                servo.model,
                drive_mode[servo.id],
                homing[servo.id],
                sweep.low[servo.id],
                sweep.high[servo.id],
                direction,
                zero_ticks,
                round(lower, 6),
                round(upper, 6),
            )
        )
    n = len(config.joints)
    return Calibration(config.name, config.robot, timestamp(), tuple(rows[:n]), tuple(rows[n:]))


def check_calibration(bus: ServoBus, config: ArmConfig, calibration: Calibration) -> None:
    """Compare a calibration with arm file and servos. Writes nothing.

    Raises:
        CalibrationMismatchError: With a table of all differences.
        ConfigError: The calibration is of another arm.
    """
    if (calibrated_names := _names(calibration.rows)) != _names(config.drives):
        raise ConfigError(
            f"the calibration is of {', '.join(calibrated_names)}",
            file=calibration.file or calibration.arm,
            key="joints",
            allowed=", ".join(_names(config.drives)),
        )
    names = ("drive_mode", "homing_offset", "present_position")
    registers = {name: read_all(bus, config, name, absent=0) for name in names}
    rows: list[tuple[str, str, str, str]] = []
    for drive, row in zip(config.drives, calibration.rows, strict=True):
        present = {name: values[drive.id] for name, values in registers.items()}
        rows += _differences(drive, row, present)
    if rows:
        raise CalibrationMismatchError(
            f"the arm does not agree with its calibration {calibration.file or ''}".rstrip(),
            rows,
            "calibrate again; or bring servos and arm file back to what they were "
            "(a present position that is whole revolutions off: turn the joint by hand)",
        )


def require_calibrated(config: ArmConfig) -> None:
    """Raise ``ConfigError`` for an arm file whose zeros are placeholders."""
    if config.uncalibrated:
        raise config.wrong(
            "the zeros of this arm file are placeholders: every arm of this kind has others; "
            "nothing was switched on",
            "uncalibrated",
            "an arm file with measured zeros",
            f"robot-ik servo calibrate mine.toml --arm {config.robot} --bus PORT, then "
            "--arm mine.toml",
        )


def check_model(config: ArmConfig, limits: Mapping[str, tuple[float, float]]) -> None:
    """Compare the limits of a model with those of the calibration. Reads no servo.

    Args:
        config: Arm.
        limits: Joint -> limits of the model, rad (m).

    Raises:
        CalibrationMismatchError: With a table of the differences.
        ConfigError: The calibration cannot be read.
    """
    calibration = own_calibration(config)
    if calibration is None:
        return
    joints = {joint.name: joint for joint in config.joints}
    known = {name for name, ends in limits.items() if all(map(math.isfinite, ends))}
    rows = []
    for row in (row for row in calibration.joints if row.name in joints.keys() & known):
        joint = joints[row.name]
        now = limits[row.name]
        then = joint.per_unit * row.urdf_lower, joint.per_unit * row.urdf_upper
        if max(abs(a - b) for a, b in zip(then, now, strict=True)) > _SAME_LIMIT:
            what = f"limits of the model, {joint.unit}"
            rows.append((joint.name, what, _range(joint, *then), _range(joint, *now)))
    if rows:
        raise CalibrationMismatchError(
            f"the model is not the one of the calibration {calibration.file}",
            rows,
            "calibrate again",
        )


def own_calibration(config: ArmConfig) -> Calibration | None:
    """Return the calibration beside an arm file; None if there is none.

    If the program uses some of the arm's joints, the calibration of these joints is returned.
    """
    if config.file is None or not calibration_beside(config.file).exists():
        return None
    calibration = Calibration.load(calibration_beside(config.file))
    names = _names(config.drives)
    calibrated_names = _names(calibration.rows)
    if calibrated_names == names or sorted(calibrated_names) != sorted(
        _names(ArmConfig.load(config.file).drives)
    ):
        return calibration
    joints, twins = (
        tuple(
            sorted(
                (row for row in rows if row.name in names), key=lambda row: names.index(row.name)
            )
        )
        for rows in (calibration.joints, calibration.twins)
    )
    return replace(calibration, joints=joints, twins=twins)


def _names(rows: Sequence[JointCalibration | Drive]) -> list[str]:
    """Return the joint of each servo, in the same order."""
    return [row.name for row in rows]


def _differences(
    drive: Drive, row: JointCalibration, present: Mapping[str, int]
) -> list[tuple[str, str, str, str]]:
    """Return (joint, what, expected, found) of the differences at one joint.

    Args:
        drive: Joint and servo of the arm file.
        row: Their calibration.
        present: Register name -> value in the servo.
    """
    joint, servo = drive
    pairs = [(key, getattr(row, key), getattr(servo, key)) for key in _IN_ARM_FILE]
    # Other programs rewrite the offset of a shadow at each start, from the position of the first
    # servo (Interbotix/interbotix_xs_driver src/xs_driver.cpp). The two are compared when torque
    # goes on.
    shadow = drive.is_shadow
    if not shadow:
        pairs.append(("homing_offset", row.homing_offset, present["homing_offset"]))
    rows = [(joint.name, key, str(was), str(now)) for key, was, now in pairs if was != now]
    # Only the reverse bit changes the meaning of a position. The driver sets the other bits.
    if (row.drive_mode ^ present["drive_mode"]) & REVERSE:
        rows.append((joint.name, "drive_mode", str(row.drive_mode), str(present["drive_mode"])))
    if shadow:
        return rows
    position = present["present_position"]
    if servo.is_single_turn:
        position %= TICKS_PER_REVOLUTION
    if (
        not row.range_min - RANGE_TOLERANCE_TICKS
        <= position
        <= row.range_max + RANGE_TOLERANCE_TICKS
    ):
        rows.append(
            (joint.name, "present position", f"{row.range_min} .. {row.range_max}", str(position))
        )
    return rows
