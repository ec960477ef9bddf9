"""``robot-ik reachability``: map where an arm can reach, with slices and a point cloud."""

from __future__ import annotations

import contextlib
import datetime
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.options import (
    OUTPUT_GROUP,
    FrameName,
    JsonOption,
    Margin,
    RobotName,
    SceneFile,
)
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import MissingExtraError, OptionError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.reachability.reachability_map import ReachabilityMap
    from robot_ik.robot import Robot

CONNECTION_TIMEOUT = 10.0
"""s. After this time without an answer the scheduler counts as unreachable."""

MAX_DIRECTIONS = 10_000
"""Directions of the z axis. More are less than 2 degrees apart."""

MAX_ROLLS = 360
"""Turns about a direction. More are less than 1 degree apart."""

OUTCOMES = {
    "reached": "reached",
    "touching": "reached only with a collision",
    "unreachable": "proven out of reach",
    "not_found": "not found",
}
"""Outcome of a pose -> its text in the table."""


@dataclass(frozen=True, kw_only=True)
class Reachability(JsonOption):
    """Measure which poses an arm can reach, cell by cell.

    Joint limits and collisions of the arm with itself are checked. A robot without a closed form
    is solved by `lm`, which is much slower. Writes map.zarr, cloud.ply and, with the extra `plots`,
    slices as PNG. Ctrl-C keeps the finished blocks, and the same command with the same --out
    continues there.

        robot-ik reachability --robot puma560 --cell 0.1
    """

    robot: RobotName = "puma560"
    frame: FrameName = None
    scene: SceneFile = None
    margin: Margin = 0.0
    cell: Annotated[float, Parameter(metavar="M", validator=Number(gt=0, lt=math.inf))] = 0.05
    """Edge length of a cell, in metres."""
    directions: Annotated[
        int, Parameter(metavar="N", validator=Number(gte=1, lte=MAX_DIRECTIONS))
    ] = 60
    """Number of directions of the frame's z axis."""
    rolls: Annotated[int, Parameter(metavar="N", validator=Number(gte=1, lte=MAX_ROLLS))] = 6
    """Number of turns of the frame about each direction."""
    cluster: Annotated[
        str,
        Parameter(
            metavar="ADDRESS",
            help="Address of a Dask scheduler, for example tcp://host:8786 (extra `cluster`). "
            "Default: the cores of this machine.",
        ),
    ] = ""
    out: Annotated[Path | None, Parameter(metavar="FOLDER", group=OUTPUT_GROUP)] = None
    """Destination of the results. A folder; default: runs/<time>-reachability."""

    def run(self, terminal: Terminal = QUIET) -> ReachabilityReport:
        """Make the map, and write the files."""
        # MuJoCo and Numba take 0.9 s to import, --help takes 0.1 s.
        from robot_ik.files import make_folder
        from robot_ik.reachability.reachability_map import map_reachability
        from robot_ik.robot import load_robot

        if not is_installed("zarr"):
            raise MissingExtraError("zarr", "maps", "a reachability map on disk")
        robot = load_robot(self.robot)
        collisions = make_condition(robot, self.scene, self.margin, terminal)
        now = datetime.datetime.now()
        folder = make_folder(self.out or Path(f"runs/{now:%Y%m%d-%H%M%S}-reachability"))
        began = time.perf_counter()
        with contextlib.ExitStack() as stack:
            executor = stack.enter_context(connected(self.cluster)) if self.cluster else None
            terminal.progress("sweeping")
            reach_map = map_reachability(
                robot,
                frame=self.frame,
                cell=self.cell,
                directions=self.directions,
                rolls=self.rolls,
                collisions=collisions,
                out=folder / "map.zarr",
                executor=executor,
                progress=terminal.counting("block"),
            )
        seconds = time.perf_counter() - began
        files = write_files(reach_map, folder)
        return ReachabilityReport(map_facts(reach_map), seconds, files)


@dataclass(frozen=True, eq=False)
class ReachabilityReport(Report):
    """A map of the poses that an arm can reach.

    Attributes:
        map: The numbers of the map.
        seconds: Time of the sweep, s.
        files: The written files.
    """

    map: Mapping[str, Any]
    seconds: float
    files: Sequence[Path]

    @property
    def notes(self) -> Sequence[str]:
        """Warn if the slices are missing."""
        if is_installed("matplotlib"):
            return ()
        return ('no slices: they need matplotlib (the extra "plots")',)

    def facts(self) -> dict[str, Any]:
        """Return the values for programs, in SI units."""
        return {**self.map, "seconds": self.seconds, "files": [str(file) for file in self.files]}

    def tables(self) -> Iterable[Table]:
        """Return the shares of the outcomes, the reached volume and the files."""
        facts = self.map
        cells = " x ".join(map(str, facts["cells"]))
        rows: list[tuple[str, object]] = [
            ("cells", f"{cells} of {1e3 * facts['cell']:g} mm"),
            ("poses", f"{facts['poses']:,}"),
        ]
        for name, text in OUTCOMES.items():
            count = facts["counts"][name]
            if count:
                rows.append((text, f"{100.0 * count / facts['poses']:.2f} %"))
        rows.append(("volume of the reached cells", f"{facts['reached_volume']:.3f} m³"))
        rows.append(("largest index", f"{facts['largest_index']:.3f}"))
        rows.append(("time", f"{self.seconds:.1f} s"))
        rows.extend(("file", file) for file in self.files)
        yield table("map", f"{facts['robot']}, {facts['frame']}", rows=rows)


def is_installed(package: str) -> bool:
    """Return whether a Python package of an extra is installed."""
    import importlib.util  # not for --help

    return importlib.util.find_spec(package) is not None


def make_condition(
    robot: Robot, scene: Path | None, margin: float, terminal: Terminal
) -> CollisionAvoidance:
    """Return the condition on collisions: the robot's own parts, and the obstacles of a file.

    Parts that touch in every posture are left out, and named on stderr.
    """
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.collision.obstacle_file import load_obstacles
    from robot_ik.collision.scene import Scene

    surroundings = Scene(robot, [] if scene is None else load_obstacles(scene))
    touching = [item.pair for item in surroundings.touching]
    for first, second in touching:
        terminal.say(f"{first} and {second} touch in every posture and are not compared", "dim")
    return CollisionAvoidance(surroundings, margin=margin, ignore=touching)


@contextlib.contextmanager
def connected(address: str) -> Iterator[Executor]:
    """Connect to a Dask scheduler for a while.

    Raises:
        MissingExtraError: distributed is not installed.
        OptionError: No scheduler answers.
    """
    try:
        import distributed  # an extra
    except ImportError:
        raise MissingExtraError("distributed", "cluster", "a cluster") from None
    try:
        client: Any = distributed.Client(address, timeout=CONNECTION_TIMEOUT)
    except (OSError, ValueError) as error:
        problem = f"no scheduler answers at {address}: {error}"
        raise OptionError("--cluster", problem, "tcp://host:8786") from error
    with client:
        yield client.get_executor()


def write_files(reach_map: ReachabilityMap, folder: Path) -> list[Path]:
    """Write the point cloud and, with matplotlib, a slice across each axis; return the files."""
    files = [folder / "map.zarr", reach_map.cloud().save(folder / "cloud.ply")]
    if not is_installed("matplotlib"):
        return files
    from robot_ik.files import write_atomically
    from robot_ik.reachability.pictures import AXES, slice_png  # an extra

    for across, axis in AXES.items():
        # Through the middle of the arm's reach.
        at = reach_map.grid.corner[axis] + 0.5 * reach_map.grid.cell * reach_map.grid.shape[axis]
        file = folder / f"slice-{across}.png"
        write_atomically(file, slice_png(reach_map, across=across, at=at))
        files.append(file)
    return files


def map_facts(reach_map: ReachabilityMap) -> dict[str, Any]:
    """Return the numbers of a map."""
    from robot_ik.reachability.reachability_map import ReachStatus

    counts = {reach.name.lower(): int((reach_map.status == reach).sum()) for reach in ReachStatus}
    reached = reach_map.index > 0.0
    return {
        "robot": reach_map.robot.name,
        "frame": reach_map.frame,
        "method": reach_map.method,
        "cell": reach_map.grid.cell,
        "cells": list(reach_map.grid.shape),
        "orientations": reach_map.grid.orientations,
        "poses": reach_map.grid.poses,
        "counts": counts,
        "reached_volume": float(reached.sum() * reach_map.grid.cell**3),
        "largest_index": float(reach_map.index.max()),
    }
