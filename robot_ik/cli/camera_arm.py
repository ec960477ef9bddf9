"""What ``camera handeye`` and ``camera verify`` share: options of arm and camera, what Ctrl-C leaves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.bus_argument import robot_meant

Report = TypeVar("Report", covariant=True)

#: Fewer views tell nothing, so there is nothing to go on with.
LEAST_VIEWS = 4


class ArmCameraOptions(Protocol):
    """The options of both."""

    @property
    def robot(self) -> str: ...
    @property
    def bus(self) -> str: ...
    @property
    def arm(self) -> str: ...
    @property
    def frame(self) -> str: ...
    @property
    def camera(self) -> str: ...
    @property
    def intrinsics(self) -> str: ...
    @property
    def board(self) -> str: ...
    @property
    def dictionary(self) -> str: ...
    @property
    def views(self) -> int: ...
    @property
    def speed(self) -> float: ...
    @property
    def seed(self) -> int: ...


def arm_camera_values(options: ArmCameraOptions, why_servos: str) -> dict[str, Any]:
    """The attributes of an ``ArmCameraRequest``; what can be wrong without looking is found here.

    Args:
        options: Of the command.
        why_servos: What an arm without servos has not.

    Raises:
        ConfigError, CameraError: A malformed option.
    """
    _check(options, why_servos)
    board = None
    if options.board:
        from robot_ik.camera.boards.board import parse_board

        board = parse_board(options.board, options.dictionary)
    return {
        "robot": options.robot or robot_meant(options.arm, options.bus),
        "bus": options.bus,
        "arm_file": Path(options.arm) if options.arm else None,
        "frame": options.frame or None,
        "camera": options.camera,
        "intrinsics": Path(options.intrinsics) if options.intrinsics else None,
        "board": board,
        "views": options.views,
        "speed": options.speed,
        "seed": options.seed,
    }


def _check(options: ArmCameraOptions, why_servos: str) -> None:
    if not LEAST_VIEWS <= options.views <= 100:
        raise wrong("--views", f"{options.views} views", f"{LEAST_VIEWS} to 100")
    if not (math.isfinite(options.speed) and 0.0 < options.speed <= 1.0):
        raise wrong("--speed", f"{options.speed:g} is no share of the speed limits", "above 0, at most 1")
    if options.bus == "none":
        raise wrong("--bus", f"an arm without servos has no {why_servos}", "sim, pty or a serial port")


class Kept(Protocol):
    """Samples that can be written."""

    def __len__(self) -> int: ...

    def save(self, path: Path) -> None:
        """Whole or not at all."""


class Job(Protocol[Report]):
    """Moves an arm and takes samples."""

    def __call__(self, *, keep: Callable[[Kept], None], progress: Callable[[str, float], None]) -> Report: ...


def measured(job: Job[Report], file: Path, command: str) -> Report | None:
    """Runs a job with its progress shown; None when it was interrupted, and how to go on is said.

    Args:
        job: Hands over all its samples after each stop.
        file: Where they are kept.
        command: That goes on with them: ``camera verify``.
    """
    views = 0

    def keep(samples: Kept) -> None:
        nonlocal views
        samples.save(file)
        views = len(samples)

    try:
        with console.progress() as bar:
            task = bar.add_task("opening", total=1.0, note="")

            def progress(stage: str, share: float) -> None:
                bar.update(task, description=stage, completed=share)

            return job(keep=keep, progress=progress)
    except KeyboardInterrupt:
        console.say(f"interrupted after {views} views", "yellow")
        if views >= LEAST_VIEWS:
            console.say(f"they are kept; go on with them: robot-ik {command} --samples {file}")
        elif views:
            console.say(f"they are kept in {file}, but {LEAST_VIEWS} are the least that tell anything")
        return None


def numbers_of_seen(count: int, unseen: Sequence[int]) -> list[int]:
    """The numbers, from 1, of the stops at which the board was seen: rows and "not seen at" count alike."""
    return [k + 1 for k in range(count + len(unseen)) if k not in unseen]
