"""Options and output of ``camera handeye`` and ``camera verify``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.arms import default_robot
from robot_ik.commands.options import (
    BUS_HELP,
    BUS_METAVAR,
    NO_BUS,
    ArmName,
    BoardName,
    Dictionary,
    FrameName,
    IntrinsicsFile,
    JsonOption,
    OverwriteOption,
    RobotName,
    Speed,
    ViewCount,
)
from robot_ik.commands.tables import plural, table
from robot_ik.commands.terminal import Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.ports import Array
    from robot_ik.workcell.arm_camera.samples import SampleSet
    from robot_ik.workcell.arm_camera.stations import ArmCameraReport

Result = TypeVar("Result")

Views = Annotated[ViewCount, Parameter(validator=Number(gte=4, lte=100))]
"""Number of views of both commands."""

SAMPLES_HELP = "File of samples of an earlier run. They are evaluated again, and nothing moves."
"""Help of ``--samples``."""


@dataclass(frozen=True, kw_only=True)
class ArmCameraOptions(OverwriteOption, JsonOption):
    """Base of the commands that measure an arm and a camera with a board."""

    robot: RobotName = ""
    bus: Annotated[
        str, Parameter(alias="--port", metavar=BUS_METAVAR, help=f"Servo bus. {BUS_HELP}.")
    ] = "sim"
    arm: ArmName = ""
    frame: FrameName = None
    camera: Annotated[str, Parameter(metavar="synthetic|INDEX|URL")] = "synthetic"
    """Image source."""
    intrinsics: IntrinsicsFile = None
    board: BoardName = ""
    dictionary: Dictionary = "DICT_5X5_50"
    speed: Speed = 1.0
    dry_run: bool = False
    """Plan the views and print them. Nothing moves, and no file is written."""
    samples: Annotated[Path | None, Parameter(metavar="FILE.json", help=SAMPLES_HELP)] = None

    def request_values(self, missing: str) -> dict[str, Any]:
        """Return the fields of a ``HandEyeRequest`` that both commands set.

        Args:
            missing: What an arm without servos does not have, for the message.

        Raises:
            OptionError: The bus has no servos.
            CameraError: The board is invalid.
        """
        from robot_ik.camera.target_files import parse_target  # NumPy and OpenCV

        if self.bus == NO_BUS:
            problem = f"an arm without servos has no {missing}"
            raise OptionError("--bus", problem, "sim, pty or a serial port")
        return {
            "robot": self.robot or default_robot(self.arm, self.bus),
            "frame": self.frame,
            "bus": self.bus,
            "arm_file": Path(self.arm) if self.arm else None,
            "speed": self.speed,
            "camera": self.camera,
            "intrinsics": self.intrinsics,
            "board": parse_target(self.board, self.dictionary) if self.board else None,
            "dry_run": self.dry_run,
        }


def measure(job: Callable[..., Result], file: Path, command: str, terminal: Terminal) -> Result:
    """Run a job and save its samples. After an interruption, print how to continue.

    Args:
        job: Calls its argument ``keep`` with all samples after each station.
        file: File of the samples.
        command: Command that continues with the samples.
        terminal: Shows the progress.
    """
    from robot_ik.camera.calibration.handeye import MIN_VIEWS

    count = 0

    def keep(samples: SampleSet) -> None:
        nonlocal count
        samples.save(file)
        count = len(samples)

    try:
        return job(keep=keep, progress=terminal.progress)
    except KeyboardInterrupt:
        terminal.say(f"stopped after {plural(count, 'view')}", "yellow")
        if count >= MIN_VIEWS:
            terminal.say(f"the samples are saved; to continue: {command} --samples {file}")
        elif count:
            text = f"the samples are saved in {file}, but a result needs {MIN_VIEWS} views"
            terminal.say(text)
        raise


def found_numbers(count: int, unseen: Sequence[int]) -> list[int]:
    """Return the numbers, from 1, of the stations at which the board was found.

    Args:
        count: Number of these stations.
        unseen: Indices of the other stations.
    """
    return [k + 1 for k in range(count + len(unseen)) if k not in unseen]


def plan_table(name: str, joints: Sequence[str], stations: Iterable[Array]) -> Table:
    """Return the joint angles of all stations, in degrees."""
    rows = [(k, *(f"{math.degrees(v):z.1f}" for v in q)) for k, q in enumerate(stations, 1)]
    return table(name, *joints, rows=rows, title="planned, degrees")


def plan_facts(report: ArmCameraReport, job: str) -> dict[str, Any]:
    """Return the values of a planned run, measured or not."""
    samples = report.samples
    return {
        "job": job,
        "robot": samples.robot,
        "joints": samples.joints,
        "frame": samples.frame,
        "mounting": samples.mounting,
        "stations": report.stations,
        "unseen": report.unseen,
    }
