"""``Sweep``: the work of a reachability map, block by block, on threads or any executor."""

from __future__ import annotations

import functools
import hashlib
import pickle
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import ModelError
from robot_ik.geometry import Array
from robot_ik.kernels import jit
from robot_ik.kernels.tree import HINGE
from robot_ik.model import qpos_addresses
from robot_ik.reachability import cells
from robot_ik.reachability.grid import Grid
from robot_ik.reachability.numeric_sweep import NumericMemory
from robot_ik.robot import Robot
from robot_ik.solvers.analytic import form_block
from robot_ik.solvers.analytic.recognise import Form, recognise

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance

SWEPT_VALUES = 24
"""Values of the joint that is fixed in turn on an arm of seven joints."""

METHODS = {
    "closed form": "all branches of a closed form; a pose without one is proven out of reach",
    "swept joint": f"closed forms with a joint fixed at {SWEPT_VALUES} values; nothing is proven",
    "lm": "damped least squares from several starts, one solution a pose; nothing is proven",
}
"""Methods that solve the poses of a map, with descriptions."""

CELLS_PER_CALL = 8
"""Cells of one call of the kernel. A thread checks between two calls whether it must stop."""

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class ArmForm:
    """The closed forms of an arm, one for each value of the swept joint.

    Attributes:
        forms: The closed forms.
        robots: The robot of each closed form: without the swept joint.
        swept: Name of the swept joint, None for an arm of six joints.
        values: (f,) values of the swept joint; one 0 without such a joint.
    """

    forms: tuple[Form, ...]
    robots: tuple[Robot, ...]
    swept: str | None
    values: Array

    @property
    def is_complete(self) -> bool:
        """Whether a pose without a branch is proven out of reach."""
        return self.swept is None


def arm_form(robot: Robot, frame: str | None, values: int = SWEPT_VALUES) -> ArmForm | None:
    """Return the closed forms with which a frame is swept; None if none is known.

    For an arm of seven hinges, one joint is fixed at ``values`` values, each in the middle of an
    equal part of its range: the last joint for which the other six have a closed form.
    """
    node, local = robot.attachment(frame)
    chain = robot.tree.ancestors(node)
    # A closed form moves each joint independently.
    is_coupled = bool(np.isin(robot.tree.coupled[:, 0], chain).any())
    form = None if is_coupled else recognise(robot.tree, node, local, full_pose=True)
    if form is not None:
        return ArmForm((form,), (robot,), None, np.zeros(1))
    hinges = all(robot.tree.kind[k] == HINGE for k in chain)
    if len(chain) == 7 and hinges and not is_coupled:
        for k in reversed(chain):
            v = robot.tree.vadr[k]
            lower = float(robot.tree.sample_lower[v])
            upper = float(robot.tree.sample_upper[v])
            shares = (np.arange(values) + 0.5) / values
            fixed = lower + shares * (upper - lower)
            if swept := _swept_forms(robot, frame, robot.joints[k], fixed):
                return swept
    return None


def _swept_forms(robot: Robot, frame: str | None, joint: str, values: Array) -> ArmForm | None:
    """Return the closed forms with a joint fixed at values (f,), None without a closed form."""
    forms = []
    robots = []
    for value in values.tolist():
        fixed = robot.with_fixed({joint: value})
        node, local = fixed.attachment(frame)
        form = recognise(fixed.tree, node, local, full_pose=True)
        if form is None:
            return None
        forms.append(form)
        robots.append(fixed)
    return ArmForm(tuple(forms), tuple(robots), joint, values)


@dataclass(frozen=True, eq=False)
class BlockResult:
    """Results of the sweep of one block.

    Attributes:
        block: Number of the block.
        status: (x, y, z, o) UNREACHABLE … REACHED of each pose.
        branches: (x, y, z, o) number of free branches of each pose.
        manipulability: (x, y, z) largest of the free branches.
        clearance: (x, y, z) largest of the free branches, m; NaN without one.
    """

    block: int
    status: Bytes
    branches: Bytes
    manipulability: NDArray[np.float32]
    clearance: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sweep:
    """All poses of a grid, to be swept block by block in any order.

    Attributes:
        robot: The arm.
        frame: Frame that should reach the poses; None for the tool.
        grid: The poses.
        arm: The closed forms of the arm; None for a sweep by ``lm``.
        collisions: Condition that a branch must keep to be free; None for no condition.
    """

    robot: Robot
    frame: str | None
    grid: Grid
    arm: ArmForm | None
    collisions: CollisionAvoidance | None

    @property
    def method(self) -> str:
        """Name of the method, one of ``METHODS``."""
        if self.arm is None:
            return "lm"
        return "closed form" if self.arm.swept is None else "swept joint"

    def _memory(self) -> SweepMemory | NumericMemory:
        if self.arm is None:
            return NumericMemory(self.robot, self.frame, self.grid.rotations, self.collisions)
        return SweepMemory(self, self.arm)

    def run(self, block: int, stop: threading.Event | None = None) -> BlockResult | None:
        """Sweep one block. The result does not depend on the blocks before it.

        Args:
            block: Number of the block.
            stop: Ends the sweep early when it is set; the result is None then.
        """
        positions = self.grid.block_positions(block)
        memory = self._memory()
        count = len(positions)
        orientations = self.grid.orientations
        status = np.zeros((count, orientations), dtype=np.uint8)
        branches = np.zeros((count, orientations), dtype=np.uint8)
        manipulability = np.zeros(count, dtype=np.float32)
        clearance = np.zeros(count, dtype=np.float32)
        for first in range(0, count, CELLS_PER_CALL):
            if stop is not None and stop.is_set():
                return None
            part = slice(first, first + CELLS_PER_CALL)
            memory.sweep(
                positions[part], status[part], branches[part], manipulability[part], clearance[part]
            )
        shape = tuple(part.stop - part.start for part in self.grid.blocks[block])
        return BlockResult(
            block,
            status.reshape(*shape, orientations),
            branches.reshape(*shape, orientations),
            manipulability.reshape(shape),
            clearance.reshape(shape),
        )

    def fingerprint(self) -> str:
        """Return a digest of all inputs of the results. The version of the program is not in it."""
        digest = hashlib.sha256()
        robot = self.robot
        model = robot.model if self.collisions is None else self.collisions.scene.model
        buffer = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        digest.update(buffer.tobytes())
        node, local = robot.attachment(self.frame)
        values = np.zeros(0) if self.arm is None else self.arm.values
        for array in (robot.lower, robot.upper, robot.frozen_qpos, local, values):
            digest.update(np.ascontiguousarray(array).tobytes())
        swept = None if self.arm is None else self.arm.swept
        words: list[object] = [robot.joints, node, self.grid, swept]
        if self.collisions is not None:
            digest.update(self.collisions.tables.geoms.tobytes())
            words.append(self.collisions.margin)
            words += [(item.name, *item.pose.row) for item in self.collisions.scene.obstacles]
        digest.update(repr(words).encode())
        return digest.hexdigest()


class SweepMemory:
    """The memory of one thread's sweep of one block.

    Each block has its own memory. A collision check starts from the result of the check before it,
    and its rounding depends on that start. With one memory for several blocks their order would
    change the last bits.
    """

    def __init__(self, sweep: Sweep, arm: ArmForm) -> None:
        robot = sweep.robot
        tree = robot.tree
        node, local = robot.attachment(sweep.frame)
        chain = np.array(tree.ancestors(node), dtype=np.int64)
        addresses = qpos_addresses(robot.model, tree)
        self._forms = []
        for form, fixed in zip(arm.forms, arm.robots, strict=True):
            block = form_block(form, fixed.tree)
            block.arrays["start"][...] = fixed.home[block.arrays["qadr"]]
            self._forms.append(block)
        self._addresses = np.array([block.address for block in self._forms], dtype=np.int64)
        # Coordinates in q of the complete robot for the joints of the closed forms.
        fixed_addresses = qpos_addresses(robot.model, arm.robots[0].tree)
        columns = np.searchsorted(addresses, fixed_addresses[self._forms[0].arrays["qadr"]])
        reach = tree.reach(node, local)
        if reach is None:
            raise ModelError(f"the reach of {robot.name!r} is not bounded")
        sizes = {"nq": tree.nq, "n": tree.size, "d": len(chain)}
        arrays: Mapping[str, Any] = {
            "reach": np.append(reach[0], reach[1]),
            "rotations": np.ascontiguousarray(sweep.grid.rotations.reshape(-1, 9)),
            "values": arm.values,
            "columns": columns.astype(np.int64),
            "nodes": chain,
            "dofs": np.ascontiguousarray(tree.vadr[chain]),
            "local": np.ascontiguousarray(local[None, :]),
            "tree": tree.block,
        }
        self._cells = cells.CELLS.allocate(sizes, arrays)
        self._cells.arrays["q"][...] = robot.home
        self._cells["no_branch"] = cells.UNREACHABLE if arm.is_complete else cells.NOT_FOUND
        self._cells["node"] = node
        self._cells["swept"] = -1
        if arm.swept is not None:
            swept = robot.joints.index(arm.swept)
            self._cells["swept"] = int(tree.qadr[swept])
        self._collisions = None
        if sweep.collisions is not None:
            self._collisions = sweep.collisions.memory()
            self._cells["checked"] = True
            self._cells["margin"] = sweep.collisions.margin
        jit.announce(cells.sweep_cells, "reachability maps")

    def sweep(
        self,
        positions: Array,
        status: Bytes,
        branches: Bytes,
        manipulability: NDArray[np.float32],
        clearance: NDArray[np.float32],
    ) -> None:
        """Write the results of ``cells.sweep_cells`` for the cells at ``positions`` (c, 3)."""
        collisions = 0 if self._collisions is None else self._collisions.address
        cells.sweep_cells(
            self._cells.address,
            self._addresses,
            collisions,
            positions,
            status,
            branches,
            manipulability,
            clearance,
        )


def run_pickled(data: bytes, block: int) -> BlockResult | None:
    """Sweep one block of a pickled ``Sweep``, in a process of an executor."""
    return _loaded(data).run(block)


@functools.lru_cache(maxsize=1)
def _loaded(data: bytes) -> Sweep:
    """Return the sweep of a pickle. A worker process keeps it from block to block."""
    sweep: Sweep = pickle.loads(data)
    return sweep
