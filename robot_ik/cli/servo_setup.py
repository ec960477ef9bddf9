"""``robot-ik servo setup``: id and baud rate of one servo, alone on the wire."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.servo_link import BusOptions, load_arm, served_or_real
from robot_ik.cli.servo_scan import checked_rates, print_found, scanned


@dataclass(frozen=True)
class SetupOptions(BusOptions):
    """Gives one servo its id and baud rate. Exactly one servo may be connected; it is found at any rate.

        robot-ik servo setup --joint joint3    (id and rate of the arm file)
        robot-ik servo setup --id 3 --baud 1000000

    Written to EEPROM with torque off, and read back under the new address. Return delay becomes 0.
    """

    joint: Annotated[str, arg(metavar="JOINT", help_behavior_hint="(or --id)")] = ""
    """Joint of the arm file that this servo is for: its id, rate and model."""
    id: Annotated[int | None, arg(metavar="N", help_behavior_hint="(or --joint)")] = None
    """New id, 0 to 252."""
    baud: Annotated[int | None, arg(metavar="RATE", help_behavior_hint="(default: the arm file's)")] = None
    """New rate, bits/s."""
    from_baud: Annotated[
        tuple[int, ...], arg(metavar="RATE …", help_behavior_hint="(default: all rates)")
    ] = ()
    """Look for the servo at these rates only."""


def run_setup(options: SetupOptions) -> int:
    """Finds the servo, writes, reads back."""
    from robot_ik.hardware.scan import LIKELY, nobody_hint
    from robot_ik.hardware.servo_setup import set_up, the_only_one

    if (options.id is None) == (not options.joint):
        raise wrong("--id", "which servo is it to be?", "either --id N or --joint JOINT")
    config = load_arm(options.arm)
    joint = config.joint(options.joint) if options.joint else None
    id = joint.id if joint else options.id
    assert id is not None
    if not 0 <= id <= 252:
        raise wrong("--id", f"{id} is no servo id", "0..252")
    baud = config.baud if options.baud is None else options.baud
    bauds = checked_rates(options.from_baud) or LIKELY
    checked_rates([baud])
    with served_or_real(options.bus, options.arm) as port:
        found = scanned(port, bauds)
        if not found:
            console.say(f"error: no servo answers on {port}", "bold red")
            console.say(nobody_hint(bauds), "cyan")
            return console.NOT_ACHIEVED
        servo = the_only_one(found)
        if joint and servo.model != joint.model:
            raise wrong("--joint", f"{joint.name} has a {joint.model}, this is a {servo.model}", joint.model)
        set_up(port, servo, id, baud)
    print_found([servo])
    console.out().print(
        f"id {servo.id} -> {id}, {servo.baud} -> {baud} baud, return delay 0: read back, done", markup=False
    )
    return console.DONE
