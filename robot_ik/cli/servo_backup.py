"""``robot-ik servo backup`` and ``restore``: control tables as files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.servo_link import BusOptions, opened
from robot_ik.files import claimed

if TYPE_CHECKING:
    from robot_ik.hardware.backup import Change


@dataclass(frozen=True)
class BackupOptions(BusOptions):
    """Saves the whole control table of every servo of the arm as JSON. Writes nothing to any servo."""

    file: Positional[Annotated[Path, arg(metavar="FILE.json")]]
    """Where to."""
    overwrite: bool = False
    """An older file of that name may go."""


def run_backup(options: BackupOptions) -> int:
    """Reads all registers, writes the file."""
    from robot_ik.hardware.backup import read_tables, save_backup

    with claimed(options.file, overwrite=options.overwrite):
        with opened(options) as link:
            servos = read_tables(link.bus, link.config)
        save_backup(options.file, link.config.name, servos)
    count = sum(len(servo.registers) for servo in servos)
    console.out().print(
        f"{options.file}: {len(servos)} servos, {count} registers", markup=False, soft_wrap=True
    )
    return console.DONE


@dataclass(frozen=True)
class RestoreOptions(BusOptions):
    """Puts the EEPROM of servos back as a backup has it: modes, limits, offsets, shutdown. Needs torque off.

    Only what differs is written, and read back. Ids, baud rates and RAM stay as they are. Another model
    than the file's is refused.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE.json")]]
    """A file of backup."""
    joints: Positional[Annotated[tuple[str, ...], arg(metavar="JOINT …", help_behavior_hint="")]] = ()
    """Only these joints of the file; all if none is named."""
    dry_run: bool = False
    """Only show what differs."""


def run_restore(options: RestoreOptions) -> int:
    """Writes what differs; shows it."""
    from robot_ik.hardware.backup import differences, load_backup, restore

    servos = load_backup(options.file)
    known = tuple(servo.joint for servo in servos)
    for name in options.joints:
        if name not in known:
            raise wrong("JOINT", f"{name!r} is not in {options.file}", ", ".join(known))
    servos = [servo for servo in servos if not options.joints or servo.joint in options.joints]
    with opened(options) as link:
        changes = (differences if options.dry_run else restore)(link.bus, servos)
    _show(changes, "would become" if options.dry_run else "is now")
    return console.DONE


def _show(changes: Sequence[Change], verb: str) -> None:
    if not changes:
        console.out().print("nothing differs")
        return
    shown = console.table("joint", "id", "register", "was", verb)
    for c in changes:
        shown.add_row(c.joint, str(c.id), c.register, str(c.present), str(c.saved))
    console.out().print(shown)
