"""New joint zeros in an arm file: only these numbers change, comments and all else stay as they are."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from robot_ik.errors import ConfigError
from robot_ik.files import write_atomically
from robot_ik.hardware.calibration_file import Calibration, calibration_beside
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.control_table import TICKS_PER_TURN

_JOINT = re.compile(r"^\s*\[\[\s*joints\s*\]\]")
_TWIN = re.compile(r"^\s*\[\s*joints\s*\.\s*twin\s*\]")
_TABLE = re.compile(r"^\s*\[")
_ZERO = re.compile(r"^(\s*zero_ticks\s*=\s*)([+-]?[0-9_]+)(.*)$", re.DOTALL)

# Where an arm file says no zero.
_MIDDLE = TICKS_PER_TURN // 2


@dataclass(frozen=True)
class ZeroChange:
    """A zero of one servo.

    Attributes:
        joint: Its name; ``id`` of the servo.
        before, after: Ticks at q = 0.
    """

    joint: str
    id: int
    before: int
    after: int


def zeros_moved(config: ArmConfig, offsets: Mapping[str, float]) -> ArmConfig:
    """The arm with zeros by which the joints are where they really are.

    Args:
        config: The arm as it was when the offsets were found.
        offsets: Joint -> rad (m of a slide) by which it is ahead of what its servos say.

    Raises:
        UnknownJointError: No such joint.
        ConfigError: A zero that no servo can have.
    """
    for name in offsets:
        config.joint(name)
    moved = [_moved(joint, offsets.get(joint.name, 0.0)) for joint in config.joints]
    return replace(config, joints=tuple(moved))


def _moved(joint: JointMap, offset: float) -> JointMap:
    made = replace(joint, zero_ticks=_ticks(joint, offset))
    if joint.twin is not None and not joint.twin.shadow:
        made = replace(made, twin=replace(joint.twin, zero_ticks=_ticks(joint.servos[1], offset)))
    return made


def _ticks(servo: JointMap, offset: float) -> int:
    """Its zero by which it is where it really is; of a bent gear in the middle of its range."""
    middle = sum(servo.limits) / 2.0 if servo.swing else 0.0
    return round(servo.zero_ticks + servo.position(middle - offset) - servo.position(middle))


def changes(before: ArmConfig, after: ArmConfig) -> tuple[ZeroChange, ...]:
    """The zeros that differ, of every servo."""
    pairs = zip(before.servos, after.servos, strict=True)
    return tuple(
        ZeroChange(a.name, a.id, a.zero_ticks, b.zero_ticks) for a, b in pairs if a.zero_ticks != b.zero_ticks
    )


def write_zeros(file: Path, used: ArmConfig, offsets: Mapping[str, float]) -> tuple[Path, ...]:
    """Writes the zeros into the arm file, and into the calibration beside it where there is one.

    The old files are kept beside the new ones.  Servos are not touched.

    Args:
        file: The arm file.
        used: The arm as it was when the offsets were found; its joints may be some of the file's.
        offsets: As for ``zeros_moved``.

    Returns:
        Where the old files are kept.

    Raises:
        ConfigError: The file has changed since, or it is written in a way that cannot be edited.
        OutputError: It cannot be written; everything is as it was.
    """
    old = ArmConfig.load(file)
    for joint in used.joints:
        if old.joint(joint.name) != joint:
            raise ConfigError(
                f"joint {joint.name!r} has been changed since the arm was measured; nothing is written",
                file=file, key="joints", hint="measure again",
            )  # fmt: skip
    new = zeros_moved(old, offsets)
    text = file.read_bytes().decode("utf-8")  # line ends as they are
    edited = _edited(text, new, file)
    calibration = calibration_beside(file)
    kept = [_backup(file, text)]
    if calibration.exists():
        found = Calibration.load(calibration)
        kept.append(_backup(calibration, calibration.read_bytes().decode("utf-8")))
        _with_zeros(found, new).save(calibration)
    write_atomically(file, edited)
    return tuple(kept)


def _with_zeros(found: Calibration, arm: ArmConfig) -> Calibration:
    """The calibration with the arm's zeros: else arm and calibration would contradict each other."""
    zeros = {servo.id: servo.zero_ticks for servo in arm.servos if servo.shadow_of is None}
    joints, twins = (
        tuple(replace(row, zero_ticks=zeros.get(row.id, row.zero_ticks)) for row in rows)
        for rows in (found.joints, found.twins)
    )
    return replace(found, joints=joints, twins=twins)


def _edited(text: str, new: ArmConfig, file: Path) -> str:
    """The text with the zeros of ``new``; checked by reading it again."""
    every = (*new.joints, *new.aside)
    lines: list[str] = []
    number, wanted = -1, None  # of the table that we are in; None: it has no zero, or had it
    for line in text.splitlines(keepends=True):
        if _TABLE.match(line):
            _complete(lines, wanted)
            number += bool(_JOINT.match(line))
            twin = every[number].twin if number >= 0 and number < len(every) else None
            wanted = None
            if _JOINT.match(line) and number < len(every):
                wanted = every[number].zero_ticks
            elif _TWIN.match(line) and twin is not None:
                wanted = twin.zero_ticks
        elif wanted is not None and (found := _ZERO.match(line)):
            if int(found[2]) != wanted:
                line = f"{found[1]}{wanted}{found[3]}"
            wanted = None
        lines.append(line)
    _complete(lines, wanted)
    edited = "".join(lines)
    if ArmConfig.parse(edited, file) != replace(new, file=file):
        zeros = ", ".join(f"{one.name} {one.zero_ticks}" for one in new.servos)
        raise ConfigError(
            "the arm file is written in a way that cannot be edited; nothing is written",
            file=file, key="joints.zero_ticks", allowed=f"by hand: {zeros}",
        )  # fmt: skip
    return edited


def _complete(lines: list[str], wanted: int | None) -> None:
    """Adds the zero to a table that ends and had none (its zero was the default)."""
    if wanted is None or wanted == _MIDDLE:
        return
    at = len(lines)
    while at > 0 and not lines[at - 1].strip():
        at -= 1
    if at > 0 and not lines[at - 1].endswith("\n"):
        lines[at - 1] += "\n"
    lines.insert(at, f"zero_ticks = {wanted}\n")


def _backup(file: Path, text: str) -> Path:
    number = 1
    while (kept := file.with_name(f"{file.name}.{number}.bak")).exists():
        number += 1
    write_atomically(kept, text)
    return kept
