"""``robot-ik servo``: what is done to servos by hand.  One table of subcommands, one module each."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from robot_ik.cli.servo_ports import PortsOptions
from robot_ik.cli.servo_scan import ScanOptions
from robot_ik.cli.servo_setup import SetupOptions

Subcommand = (
    Annotated[PortsOptions, subcommand("ports")]
    | Annotated[ScanOptions, subcommand("scan")]
    | Annotated[SetupOptions, subcommand("setup")]
)


@dataclass(frozen=True)
class ServoOptions:
    """Servos by hand: find, set up, calibrate, watch, move, record, save.

    Each subcommand explains itself: robot-ik servo scan --help
    """

    command: Annotated[OmitArgPrefixes[OmitSubcommandPrefixes[Subcommand]], None]


def run(options: ServoOptions) -> int:
    """Runs the subcommand: the function ``run`` beside its options."""
    chosen = options.command
    module = importlib.import_module(type(chosen).__module__)
    runner = getattr(module, f"run_{type(chosen).__name__.removesuffix('Options').lower()}")
    code: int = runner(chosen)
    return code
