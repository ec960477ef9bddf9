"""``robot-ik stop``: makes an arm that another program of this user drives stop, and waits until it has."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong


@dataclass(frozen=True)
class StopOptions:
    """Stops arms that other programs drive: they hold where they are, with torque on.

    Needs neither the port nor the program's terminal. Exit code 0 only when every servo confirmed it;
    1 when one did not, or when no arm runs. It is no substitute for a switch in the servos' supply.
    """

    bus: Annotated[str, arg(metavar="PORT", help_behavior_hint="(default: every arm of this user)")] = ""
    """Only the arm on this port."""
    torque_off: bool = False
    """Let go instead: the arm may fall. Asks first."""
    yes: bool = False
    """With --torque-off: do not ask."""


def run(options: StopOptions) -> int:
    """1 when an arm did not confirm it, or none runs."""
    from robot_ik.hardware.stop_file import running_arms

    arms = running_arms(os.path.expanduser(options.bus) or None)
    if not arms:
        where = f" on {options.bus}" if options.bus else ""
        console.say(f"no arm runs{where}", "yellow")
        return console.NOT_ACHIEVED
    if options.torque_off and not options.yes and not _confirmed([arm.name for arm in arms]):
        console.say("nothing was done", "dim")
        return console.NOT_ACHIEVED
    policy = "torque_off" if options.torque_off else "hold"
    stopped = 0
    for arm in arms:
        ok, text = arm.stop(policy)
        stopped += ok
        console.say(f"{arm.name} on {arm.port} (process {arm.pid}): {text}", "" if ok else "bold red")
    return console.DONE if stopped == len(arms) else console.NOT_ACHIEVED


def _confirmed(names: list[str]) -> bool:
    if not sys.stdin.isatty():
        raise wrong("--torque-off", "there is no terminal to ask at", "--torque-off --yes")
    return console.confirm(f"{', '.join(names)}: without torque an arm falls. Support it. Torque off?")
