"""From a hand that moves a limp arm to numbers: ranges first, zeros second, directions by a wiggle.

Ranges come first because only a whole sweep shows whether a joint crosses the end of its servo's revolution
(4095 -> 0); a zero taken before would be wrong by a revolution beyond it.  Two servos of one joint are swept
together; that they turn together is checked on the way.  What asks servos raises the errors of the bus too.
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

LEAST_SWEEP = math.radians(10.0)
"""rad at the joint (at the pinion of a slide); a joint that turned by less was forgotten."""

LEAST_WIGGLE = math.radians(3.0)
"""rad at the joint; less may be a hand that touched it by chance."""

ASKED_WIGGLE = math.radians(10.0)
"""rad at the joint that a hand is asked for."""

STILL_TICKS = 12
"""About 1 degree: a held joint moves by less while its zero is taken."""


class OperatorError(HardwareError):
    """A person did not do what a step asks for; the step can be repeated."""


class Sweep:
    """Smallest and largest position of every servo, whole revolutions counted here.

    ``ticks``: servo id -> Present Position at the beginning.
    """

    def __init__(self, config: ArmConfig, ticks: Mapping[int, int]) -> None:
        # A limp servo in position mode may count on beyond its revolution; with torque it counts within it.
        period = {servo.id: TICKS_PER_REVOLUTION for servo in config.servos if servo.is_single_turn}
        self._raw = {id: ticks[id] for id in config.servo_ids}
        self.now = {id: value % period[id] if id in period else value for id, value in self._raw.items()}
        self.low, self.high = dict(self.now), dict(self.now)

    def take(self, ticks: Mapping[int, int | None]) -> None:
        """The next reading; a step of more than half a revolution is a wrap of the count."""
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
        """How far its joint was turned, rad (m of a slide)."""
        return (self.high[drive.id] - self.low[drive.id]) * drive.joint.resolution


def check_sweep(config: ArmConfig, sweep: Sweep) -> None:
    """Raises ``HardwareError`` where a sweep cannot be used.

    A joint was not swept, crosses the end of its servo's revolution, or its two servos did not turn together.
    """
    for drive in config.drives:
        joint, servo = drive
        low, high = sweep.low[servo.id], sweep.high[servo.id]
        if sweep.travel(drive) < LEAST_SWEEP * joint.lever:
            which = f" (servo id {servo.id})" if servo is not joint.servo else ""
            raise OperatorError(
                f"joint {joint.name!r}{which} moved by {joint.text(sweep.travel(drive))} only",
                hint="sweep every joint from one stop to the other",
            )
        if servo.is_single_turn and not 0 <= low <= high < TICKS_PER_REVOLUTION:
            raise HardwareError(
                f"joint {joint.name!r} crosses the end of its servo's revolution: it swept ticks {low} "
                f"to {high}, and a servo in position mode counts 0 to {TICKS_PER_REVOLUTION - 1}",
                hint='mount its horn about half a revolution on, or set mode = "extended_position" '
                "in the arm file",
            )
    for joint in config.joints:
        travel = sweep.travel(Drive(joint, joint.servo))
        for other in joint.servos[1:]:
            _require_together(joint, other, travel, sweep.travel(Drive(joint, other)))


def _require_together(joint: Joint, other: Servo, travel: float, other_travel: float) -> None:
    """Raises ``HardwareError`` unless two servos of a joint have gone the same way, whatever their signs."""
    if abs(abs(travel) - abs(other_travel)) > TWIST * joint.lever:
        raise HardwareError(
            f"the two servos of joint {joint.name!r} do not turn together: id {joint.servo.id} by "
            f"{joint.text(travel)}, id {other.id} by {joint.text(other_travel)}",
            hint="does a horn or a gear slip? do both have the ratio of the arm file?",
        )


def counting_directions(
    config: ArmConfig, joint: Joint, before: Mapping[int, int], after: Mapping[int, int]
) -> dict[int, Sign]:
    """Which way the servos of a joint, by id, count when it was turned in the positive direction.

    ``before`` and ``after``: servo id -> ticks of all servos.

    Raises:
        HardwareError: Nothing turned, another joint did, or its two servos did not turn together.
    """
    ways = {
        servo.id: (after[servo.id] - before[servo.id]) * moved.resolution / moved.lever
        for moved, servo in config.drives
    }
    largest = max(config.drives, key=lambda drive: abs(ways[drive.id]))
    farthest = largest.joint.text(abs(ways[largest.id]) * largest.joint.lever)
    own = ways[joint.servo.id]
    if abs(ways[largest.id]) < LEAST_WIGGLE:
        raise OperatorError(
            f"joint {joint.name!r} did not turn (most: {largest.name} by {farthest})",
            hint=f"turn it by about {joint.text(ASKED_WIGGLE * joint.lever, 0)} and leave it there",
        )
    if abs(own) < LEAST_WIGGLE or (largest.name != joint.name and abs(ways[largest.id]) > 2.0 * abs(own)):
        raise OperatorError(
            f"{joint.name!r} was to be turned, and {largest.name!r} did (by {farthest})",
            hint="are two ids swapped? compare cables and arm file; robot-ik servo setup changes an id",
        )
    for other in joint.servos[1:]:
        _require_together(joint, other, own * joint.lever, ways[other.id] * joint.lever)
    return {servo.id: 1 if ways[servo.id] > 0 else -1 for servo in joint.servos}


def check_shadows(config: ArmConfig, directions: Mapping[int, int], zero: Mapping[int, int]) -> None:
    """Raises ``HardwareError`` where a shadow could not follow its servo: by their directions and zeros."""
    for joint, servo in config.drives:
        if servo.primary_id is None:
            continue
        which = f"the shadow of joint {joint.name!r} (servo id {servo.id})"
        if directions[servo.id] != directions[servo.primary_id]:
            raise HardwareError(
                f"{which} counts the other way round",
                hint="set bit 0 of its Drive Mode (reverse), or give it goals of its own: shadow = false",
            )
        apart = abs(zero[servo.id] - zero[servo.primary_id]) * joint.resolution
        if apart > TWIST * joint.lever:
            raise HardwareError(
                f"{which} stands {joint.text(apart)} beside the servo whose goals it takes",
                hint="turn its horn, or give it goals of its own: shadow = false in the arm file",
            )


LEAST_OVERLAP = 0.5
"""Share of a swept range that must lie within the model's: a zero that is half a revolution off has less."""

_IN_ARM_FILE = ("id", "model", "direction", "zero_ticks")
_SAME_LIMIT = 1e-6  # rad; the file keeps a millionth of a degree


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


def calibrated(config: ArmConfig, found: Calibration) -> ArmConfig:
    """The arm file with measured zeros and directions, and limits that the sweep has reached.

    Raises:
        CalibrationMismatchError: Ranges that are mostly outside the arm file's and the model's limits.
    """
    joints, rows = [], []
    second = {row.name: row for row in found.twins}
    for joint, row in zip(config.joints, found.joints, strict=True):
        servos = [replace(joint.servo, direction=row.direction, zero_ticks=row.zero_ticks)]
        for servo in joint.servos[1:]:
            shown = row if servo.primary_id is not None else second[joint.name]
            servos.append(replace(servo, direction=shown.direction, zero_ticks=shown.zero_ticks))
        made = replace(joint, servos=tuple(servos))
        low, high = sorted(made.value(ticks) for ticks in (row.range_min, row.range_max))
        limits = [joint.per_unit * limit for limit in (row.urdf_lower, row.urdf_upper)]
        common = max(joint.lower, limits[0]), min(joint.upper, limits[1])
        lower, upper = max(low, common[0]), min(high, common[1])
        if upper - lower < LEAST_OVERLAP * min(high - low, common[1] - common[0]):
            rows.append(
                (joint.name, f"range, {joint.unit}", _range(joint, *common), _range(joint, low, high))
            )
        joints.append(replace(made, lower=lower, upper=upper))
    if rows:
        raise CalibrationMismatchError(
            "the swept ranges are not those of arm file and model",
            rows,
            "was the arm in the pose asked for when its zero was taken? is the horn half a revolution off?",
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
    """Puts what the hand has shown together with what the servos say of themselves.

    ``zero``: servo id -> ticks at ``pose``, joint -> rad (m of a slide); ``limits``: joint -> those of the
    model, rad (m).
    """
    drive_mode = read_all(bus, config, "drive_mode", absent=0)
    homing = read_all(bus, config, "homing_offset")
    check_shadows(config, directions, zero)
    rows = []
    for joint, servo in config.drives:
        leader = servo.id if servo.primary_id is None else servo.primary_id  # whose goals it takes
        direction = directions[leader]
        turned = replace(servo, direction=direction)
        zero_ticks = zero[leader] - (joint.nearest_ticks(pose[joint.name], turned) - turned.zero_ticks)
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


def check_calibration(bus: ServoBus, config: ArmConfig, found: Calibration) -> None:
    """Compares a calibration with arm file and servos.  Writes nothing.

    Raises:
        CalibrationMismatchError: With a table of all differences.
        ConfigError: The calibration is of another arm.
    """
    if (others := _names(found.rows)) != _names(config.drives):
        raise ConfigError(
            f"it is a calibration of {', '.join(others)}",
            file=found.file or found.arm,
            key="joints",
            allowed=", ".join(_names(config.drives)),
        )
    names = ("drive_mode", "homing_offset", "present_position")
    servo = {name: read_all(bus, config, name, absent=0) for name in names}
    rows: list[tuple[str, str, str, str]] = []
    for drive, row in zip(config.drives, found.rows, strict=True):
        said = {name: values[drive.id] for name, values in servo.items()}
        rows += _differences(drive, row, said)
    if rows:
        raise CalibrationMismatchError(
            f"the arm does not agree with its calibration {found.file or ''}".rstrip(),
            rows,
            "calibrate again; or bring servos and arm file back to what they were "
            "(a present position that is whole revolutions off: turn the joint by hand)",
        )


def require_calibrated(config: ArmConfig) -> None:
    """Raises ``ConfigError`` for an arm file whose zeros are placeholders."""
    if config.uncalibrated:
        raise config.wrong(
            "the zeros of this arm file are placeholders: every arm of this kind has others; "
            "nothing was switched on",
            "uncalibrated",
            "an arm file with measured zeros",
            f"robot-ik servo calibrate mine.toml --arm {config.robot} --bus PORT, then --arm mine.toml",
        )


def check_model(config: ArmConfig, limits: Mapping[str, tuple[float, float]]) -> None:
    """Compares limits of the model (joint -> rad, m) with those the arm was calibrated for.  Asks no servo.

    Raises:
        CalibrationMismatchError: With a table of what differs.
        ConfigError: The calibration cannot be read.
    """
    if (found := own_calibration(config)) is None:
        return
    joints = {joint.name: joint for joint in config.joints}
    known = {name for name, ends in limits.items() if all(map(math.isfinite, ends))}
    rows = []
    for row in (row for row in found.joints if row.name in joints.keys() & known):
        joint, now = joints[row.name], limits[row.name]
        then = joint.per_unit * row.urdf_lower, joint.per_unit * row.urdf_upper
        if max(abs(a - b) for a, b in zip(then, now, strict=True)) > _SAME_LIMIT:
            what = f"limits of the model, {joint.unit}"
            rows.append((joint.name, what, _range(joint, *then), _range(joint, *now)))
    if rows:
        raise CalibrationMismatchError(
            f"the model is not the one of the calibration {found.file}", rows, "calibrate again"
        )


def own_calibration(config: ArmConfig) -> Calibration | None:
    """The calibration beside an arm file; of the joints in use, where the program uses some of them only."""
    if config.file is None or not calibration_beside(config.file).exists():
        return None
    found = Calibration.load(calibration_beside(config.file))
    names = _names(config.drives)
    if _names(found.rows) == names or sorted(_names(found.rows)) != sorted(
        _names(ArmConfig.load(config.file).drives)
    ):
        return found
    joints, twins = (
        tuple(sorted((row for row in rows if row.name in names), key=lambda row: names.index(row.name)))
        for rows in (found.joints, found.twins)
    )
    return replace(found, joints=joints, twins=twins)


def _names(rows: Sequence[JointCalibration | Drive]) -> list[str]:
    """The joint of each servo, as often as servos turn it."""
    return [row.name for row in rows]


def _differences(
    drive: Drive, row: JointCalibration, said: Mapping[str, int]
) -> list[tuple[str, str, str, str]]:
    """(joint, what, expected, found) of what differs at one joint."""
    joint, servo = drive
    pairs = [(key, getattr(row, key), getattr(servo, key)) for key in _IN_ARM_FILE]
    # The offset of a shadow is rewritten by other programs at each start, from where the first servo stands
    # (Interbotix/interbotix_xs_driver src/xs_driver.cpp); the two are compared when torque goes on.
    shadow = drive.is_shadow
    if not shadow:
        pairs.append(("homing_offset", row.homing_offset, said["homing_offset"]))
    rows = [(joint.name, key, str(was), str(now)) for key, was, now in pairs if was != now]
    # Only its reverse bit changes what a position means; the others are set as we need them.
    if (row.drive_mode ^ said["drive_mode"]) & REVERSE:
        rows.append((joint.name, "drive_mode", str(row.drive_mode), str(said["drive_mode"])))
    if shadow:
        return rows
    present = said["present_position"]
    if servo.is_single_turn:
        present %= TICKS_PER_REVOLUTION
    if not row.range_min - RANGE_TOLERANCE_TICKS <= present <= row.range_max + RANGE_TOLERANCE_TICKS:
        rows.append((joint.name, "present position", f"{row.range_min} .. {row.range_max}", str(present)))
    return rows
