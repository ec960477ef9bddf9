"""The option ``--bus`` in all commands that have it: names and help come from the table of buses."""

from __future__ import annotations

from typing import Any

from tyro.conf import arg

from robot_ik.hardware import BUSES

NONE = "none"
"""Where a command can do without servos."""


def bus_argument(*, none: bool = False, default: str = "") -> Any:
    """Annotation of a field of type ``str``.

    Args:
        none: There may be no servos at all.
        default: What it says behind the help; empty: the field's own default.
    """
    names, told = list(BUSES), [f"{bus.name}: {bus.title}" for bus in BUSES.values()]
    if none:
        names.append(NONE)
        told.append(f"{NONE}: no servos")
    hint = f"(default: {default})" if default else None
    text = "Where the servos are. " + "; ".join(told) + "."
    return arg(metavar="|".join(names), help=text, help_behavior_hint=hint)
