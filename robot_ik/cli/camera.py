"""``robot-ik camera``: from a sheet of paper to a camera that measures.  One table, one module each."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from robot_ik.cli.camera_calibrate import CameraCalibrateOptions
from robot_ik.cli.camera_detect import CameraDetectOptions
from robot_ik.cli.camera_handeye import CameraHandeyeOptions
from robot_ik.cli.camera_list import CameraListOptions
from robot_ik.cli.camera_locate import CameraLocateOptions
from robot_ik.cli.camera_print import CameraPrintOptions
from robot_ik.cli.camera_verify import CameraVerifyOptions

# Each module has its options and a function run(options) -> exit code.
Subcommand = (
    Annotated[CameraListOptions, subcommand("list")]
    | Annotated[CameraPrintOptions, subcommand("print")]
    | Annotated[CameraCalibrateOptions, subcommand("calibrate")]
    | Annotated[CameraDetectOptions, subcommand("detect")]
    | Annotated[CameraLocateOptions, subcommand("locate")]
    | Annotated[CameraHandeyeOptions, subcommand("handeye")]
    | Annotated[CameraVerifyOptions, subcommand("verify")]
)


@dataclass(frozen=True)
class CameraOptions:
    """The camera by hand: find it, print markers, calibrate, detect, tell where it stands, check the arm.

    Each subcommand explains itself: robot-ik camera calibrate --help
    """

    command: Annotated[OmitArgPrefixes[OmitSubcommandPrefixes[Subcommand]], None]


def run(options: CameraOptions) -> int:
    """Runs the subcommand: the function ``run`` beside its options."""
    chosen = options.command
    code: int = importlib.import_module(type(chosen).__module__).run(chosen)
    return code
