"""``robot-ik servo``: what is done to servos by hand.  One table of subcommands, one module each."""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from robot_ik.cli.servo_backup import BackupOptions, RestoreOptions
from robot_ik.cli.servo_calibrate import CalibrateOptions
from robot_ik.cli.servo_monitor import MonitorOptions
from robot_ik.cli.servo_move import MoveOptions
from robot_ik.cli.servo_ports import PortsOptions
from robot_ik.cli.servo_scan import ScanOptions
from robot_ik.cli.servo_setup import SetupOptions
from robot_ik.cli.servo_teach import PlayOptions, TeachOptions
from robot_ik.cli.servo_torque import ResetFaultOptions, TorqueOptions

Subcommand = (
    Annotated[PortsOptions, subcommand("ports")]
    | Annotated[ScanOptions, subcommand("scan")]
    | Annotated[SetupOptions, subcommand("setup")]
    | Annotated[CalibrateOptions, subcommand("calibrate")]
    | Annotated[MonitorOptions, subcommand("monitor")]
    | Annotated[MoveOptions, subcommand("move")]
    | Annotated[TorqueOptions, subcommand("torque")]
    | Annotated[ResetFaultOptions, subcommand("reset-fault")]
    | Annotated[TeachOptions, subcommand("teach")]
    | Annotated[PlayOptions, subcommand("play")]
    | Annotated[BackupOptions, subcommand("backup")]
    | Annotated[RestoreOptions, subcommand("restore")]
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
    words = re.findall("[A-Z][a-z]+", type(chosen).__name__)[:-1]  # ResetFaultOptions: Reset, Fault
    code: int = getattr(module, "_".join(["run", *words]).lower())(chosen)
    return code
