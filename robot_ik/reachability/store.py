"""``MapStore``: a reachability map on disk as zarr arrays, written block by block."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import MissingExtraError, OutputError, ReachabilityMapError
from robot_ik.files import unwritable
from robot_ik.reachability.grid import BLOCK, Grid
from robot_ik.reachability.sweep import BlockResult

FORMAT = 1
"""Version of the arrays and attributes."""

_POSE_ARRAYS = ("status", "branches")
_CELL_ARRAYS = ("manipulability", "clearance")


class MapStore:
    """The arrays of a map in a zarr folder.

    One process writes. Each block is one chunk of each array, and its entry in ``done`` is written
    after its chunks, so a killed program loses only its unfinished blocks.

    Attributes:
        path: The folder.
        grid: The poses.
        facts: Robot, frame, condition on collisions and fingerprint of the map.
        done: (blocks,) which blocks are complete.
    """

    def __init__(self, path: Path, group: Any) -> None:
        self.path = path
        self._group = group
        attributes = dict(group.attrs)
        self.grid = Grid(
            attributes["cell"],
            tuple(attributes["corner"]),
            tuple(attributes["shape"]),
            attributes["directions"],
            attributes["rolls"],
        )
        self.facts: dict[str, Any] = attributes["facts"]
        self.done: NDArray[np.bool_] = np.asarray(group["done"][:]).astype(bool)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> MapStore:
        """Open a map.

        Raises:
            MissingExtraError: zarr is not installed.
            ReachabilityMapError: The folder does not hold a map.
        """
        zarr = _zarr()
        folder = Path(path)
        try:
            group = zarr.open_group(str(folder), mode="r+")
            if group.attrs.get("format") != FORMAT:
                raise ReachabilityMapError(
                    f"{folder} is not a reachability map of format {FORMAT}",
                    hint="compute it again: robot-ik reachability",
                )
            return cls(folder, group)
        except (FileNotFoundError, KeyError, ValueError, OSError) as error:
            raise ReachabilityMapError(
                f"{folder} is not a reachability map: {error}",
                hint="compute a map with: robot-ik reachability",
            ) from error

    @classmethod
    def create(cls, path: str | os.PathLike[str], grid: Grid, facts: dict[str, Any]) -> MapStore:
        """Create a map, or open an existing map with the same grid and facts to continue it.

        Raises:
            MissingExtraError: zarr is not installed.
            OutputError: The folder has other content, or it cannot be written.
        """
        zarr = _zarr()
        folder = Path(path)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            try:
                store = cls.open(folder)
            except ReachabilityMapError as error:
                raise OutputError(
                    f"{folder} was not changed: it exists and is not a reachability map",
                    hint="choose another name",
                ) from error
            if store.grid != grid or store.facts != facts:
                raise OutputError(
                    f"{folder} was not changed: it holds the map of another robot, scene or grid",
                    hint="choose another name, or remove it",
                )
            return store
        try:
            group = zarr.create_group(str(folder))
            chunk = tuple(min(BLOCK, count) for count in grid.shape)
            for name in _POSE_ARRAYS:
                group.create_array(
                    name,
                    shape=(*grid.shape, grid.orientations),
                    chunks=(*chunk, grid.orientations),
                    dtype="uint8",
                )
            for name in _CELL_ARRAYS:
                group.create_array(
                    name, shape=grid.shape, chunks=chunk, dtype="float32", fill_value=math.nan
                )
            group.create_array("done", shape=(len(grid.blocks),), chunks=(1,), dtype="uint8")
            group.attrs.update(
                {
                    "cell": grid.cell,
                    "corner": list(grid.corner),
                    "shape": list(grid.shape),
                    "directions": grid.directions,
                    "rolls": grid.rolls,
                    "facts": facts,
                    "format": FORMAT,
                }
            )
        except OSError as error:
            raise unwritable(folder, error) from error
        return cls(folder, group)

    def write(self, result: BlockResult) -> None:
        """Write the chunks of a block, then mark it as done."""
        part = self.grid.blocks[result.block]
        try:
            for name in (*_POSE_ARRAYS, *_CELL_ARRAYS):
                self._group[name][part] = getattr(result, name)
            self._group["done"][result.block] = 1
        except OSError as error:
            raise unwritable(self.path, error) from error
        self.done[result.block] = True

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the arrays by name. Blocks that are not done hold zeros or NaN."""
        return {name: self._group[name][:] for name in (*_POSE_ARRAYS, *_CELL_ARRAYS)}


def _zarr() -> Any:
    """Return the module zarr, which is an optional dependency."""
    try:
        import zarr
    except ImportError:
        raise MissingExtraError("zarr", "maps", "a reachability map on disk") from None
    return zarr
