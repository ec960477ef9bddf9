"""``robot-ik reachability``: where an arm can reach, as a map, pictures and a point cloud."""

from __future__ import annotations

import contextlib
import datetime
import importlib.util
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import Json, Range, positive, single
from robot_ik.errors import MissingExtraError
from robot_ik.files import make_folder, write_atomically

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.reachability.reachability_map import ReachabilityMap
    from robot_ik.robot import Robot

SCHEMA = 1
"""Version of the JSON object."""

CONNECTION_TIMEOUT = 10.0
"""s. After this time without an answer the scheduler counts as unreachable."""


@dataclass(frozen=True)
class ReachabilityOptions:
    """Measure in which poses an arm can stand, cell by cell.

    Joint limits and collisions of the arm with itself count. Writes map.zarr, cloud.ply and, with
    the extra `plots`, slices as PNG. Ctrl-C keeps the blocks that are done, and the same command
    with the same `--out` goes on from there.

        robot-ik reachability puma560 --cell 0.1
    """

    robot: Annotated[Positional[str], arg(metavar="NAME|PATH")] = "puma560"
    """A name of `robot-ik robots`, or any MJCF or URDF file. It needs a closed form for poses."""
    frame: Annotated[str | None, single("STR", "the robot's tool")] = None
    """Frame that stands in the poses: a tool, site or body of the robot."""
    scene: Annotated[Path | None, single("FILE", "none")] = None
    """MJCF file of the obstacles around the arm, without joints, in the world of its model."""
    margin: Annotated[float, arg(metavar="M"), Range(0.0, 10.0, " m")] = 0.0
    """Smallest allowed distance between parts, metres."""
    cell: Annotated[float, arg(metavar="M"), positive(what=" m")] = 0.05
    """Edge length of a cell, metres."""
    directions: Annotated[int, arg(metavar="N"), Range(1, 10_000, " directions")] = 60
    """Directions of the frame's z axis."""
    rolls: Annotated[int, arg(metavar="N"), Range(1, 360, " rolls")] = 6
    """Turns of the frame about each direction."""
    out: Annotated[str, single("FOLDER", "runs/<time>-reachability")] = ""
    """Where the map, the cloud and the slices go."""
    cluster: Annotated[str, single("ADDRESS", "the cores of this machine")] = ""
    """Address of a Dask scheduler, such as tcp://host:8786 (extra `cluster`)."""
    json: Json = False


def run(options: ReachabilityOptions) -> int:
    """Make the map, write the files and print a summary."""
    from robot_ik.reachability.reachability_map import map_reachability
    from robot_ik.robot import load_robot

    if importlib.util.find_spec("zarr") is None:
        raise MissingExtraError("zarr", "maps", "a reachability map on disk")
    robot = load_robot(options.robot)
    collisions = make_condition(robot, options.scene, options.margin)
    folder = make_folder(Path(options.out or f"runs/{_now()}-reachability"))
    began = time.perf_counter()
    with contextlib.ExitStack() as stack:
        executor = stack.enter_context(connected(options.cluster)) if options.cluster else None
        bar = stack.enter_context(console.progress())
        reach_map = map_reachability(
            robot,
            frame=options.frame,
            cell=options.cell,
            directions=options.directions,
            rolls=options.rolls,
            collisions=collisions,
            out=folder / "map.zarr",
            executor=executor,
            progress=console.counted_on(bar, "sweeping", "blocks"),
        )
    seconds = time.perf_counter() - began
    files = write_files(reach_map, folder)
    facts = map_facts(reach_map) | {"seconds": seconds, "files": [str(file) for file in files]}
    if options.json:
        console.print_json(facts)
    else:
        _print_table(facts)
    return console.DONE


def make_condition(robot: Robot, scene: Path | None, margin: float) -> CollisionAvoidance:
    """Return the condition on collisions: the robot's own parts, and the obstacles of a file.

    Parts that touch in every posture are left out, and named on stderr.
    """
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.collision.obstacle_file import load_obstacles
    from robot_ik.collision.scene import Scene

    surroundings = Scene(robot, [] if scene is None else load_obstacles(scene))
    touching = [item.pair for item in surroundings.touching]
    for first, second in touching:
        console.say(f"{first} and {second} touch in every posture and are not compared", "dim")
    return CollisionAvoidance(surroundings, margin=margin, ignore=touching)


@contextlib.contextmanager
def connected(address: str) -> Iterator[Executor]:
    """Connect to a Dask scheduler for a while.

    Raises:
        MissingExtraError: distributed is not installed.
        OptionError: No scheduler answers.
    """
    from robot_ik.errors import OptionError

    try:
        import distributed
    except ImportError:
        raise MissingExtraError("distributed", "cluster", "a cluster") from None
    try:
        client: Any = distributed.Client(address, timeout=CONNECTION_TIMEOUT)
    except (OSError, ValueError) as error:
        raise OptionError(
            "--cluster", f"no scheduler answers at {address}: {error}", "tcp://host:8786"
        ) from error
    with client:
        yield client.get_executor()


def write_files(reach_map: ReachabilityMap, folder: Path) -> list[Path]:
    """Write the point cloud and, with matplotlib, a slice across each axis; return the files."""
    files = [folder / "map.zarr", reach_map.cloud().save(folder / "cloud.ply")]
    if importlib.util.find_spec("matplotlib") is None:
        console.say('no slices: they need matplotlib (the extra "plots")', "dim")
        return files
    from robot_ik.reachability.pictures import AXES, slice_png

    for across, axis in AXES.items():
        # Through the middle of the arm's reach.
        at = reach_map.grid.corner[axis] + 0.5 * reach_map.grid.cell * reach_map.grid.shape[axis]
        file = folder / f"slice-{across}.png"
        write_atomically(file, slice_png(reach_map, across=across, at=at))
        files.append(file)
    return files


def map_facts(reach_map: ReachabilityMap) -> dict[str, Any]:
    """Return the JSON object of a map, without time and files."""
    from robot_ik.reachability.reachability_map import ReachStatus

    counts = {reach.name.lower(): int((reach_map.status == reach).sum()) for reach in ReachStatus}
    reached = reach_map.index > 0.0
    return {
        "schema": SCHEMA,
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


def _print_table(facts: dict[str, Any]) -> None:
    titles = {
        "reached": "reached",
        "touching": "reached only with a collision",
        "unreachable": "proven out of reach",
        "not_found": "not found",
    }
    rows: list[tuple[str, object]] = [
        ("cells", f"{' x '.join(map(str, facts['cells']))} of {1e3 * facts['cell']:g} mm"),
        ("poses", f"{facts['poses']:,}"),
    ]
    for name, title in titles.items():
        count = facts["counts"][name]
        if count:
            rows.append((title, f"{100.0 * count / facts['poses']:.2f} %"))
    rows += [
        ("volume of the reached cells", f"{facts['reached_volume']:.3f} m³"),
        ("largest index", f"{facts['largest_index']:.3f}"),
        ("time", f"{facts['seconds']:.1f} s"),
    ]
    rows += [("file", file) for file in facts["files"]]
    console.show(console.table("map", f"{facts['robot']}, {facts['frame']}", rows=rows))


def _now() -> str:
    return f"{datetime.datetime.now():%Y%m%d-%H%M%S}"
