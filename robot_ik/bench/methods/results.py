"""Results of a benchmark as data, for one JSON file. ``Results.model_validate_json`` reads it."""

from __future__ import annotations

import os
import platform
import time
import timeit
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from robot_ik.batch import usable_cores
from robot_ik.errors import DISTRIBUTION

JUMP = 0.2
"""Radians. A larger change of a joint between two warm solutions is a jump to another branch."""


class _Data(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Machine(_Data):
    """The machine of a measurement.

    Attributes:
        system: Operating system and architecture.
        processor: Name of the processor.
        cores: Usable cores.
        python: Version of Python.
        versions: Versions of distributions by name.
        calibration_us: Median time of a fixed loop of plain Python, µs. It shows speed and load.
        load: Load average of the last minute at the start.
        when: Date and time.
    """

    system: str
    processor: str
    cores: int
    python: str
    versions: dict[str, str]
    calibration_us: float
    load: float
    when: str


class Settings(_Data):
    """Settings of a benchmark. With the machine they are enough to repeat it.

    Attributes:
        command: The command line.
        count: Problems of a set.
        seed: Seed of problems and restarts.
        position_tolerance: Position tolerance of a success, m.
        angle_tolerance: Angle tolerance of a success, rad.
        seconds: Longest time of a set, s.
    """

    command: str
    count: int
    seed: int
    position_tolerance: float
    angle_tolerance: float
    seconds: float


class Cell(_Data):
    """One solver on one problem set of one robot. Lists have one number for each problem.

    Attributes:
        solver: The method.
        robot: The robot.
        set: Kind of the problems.
        goal: ``pose`` or ``position``: the goal of the tool.
        asked: Problems of the set. The lists are shorter if time ran out or it was interrupted.
        skipped: Reason for a missing measurement. Empty if the cell was measured.
        microseconds: Times of whole Python calls: 4×4 matrix in, joint array out.
        success: Within tolerance by MuJoCo's forward pass, and inside the joint limits.
        position_error: Position error by MuJoCo, m.
        angle_error: Angle error by MuJoCo, rad. 0 for a goal without rotation.
        iterations: Iterations of the solver.
        restarts: Restarts of the solver.
        status: Names of ``Status``.
        largest_step: Largest change of a joint between two solutions (warm only), rad or m.
        jumps: Changes above ``JUMP`` (warm only).
    """

    solver: str
    robot: str
    set: str
    goal: str = "pose"
    asked: int = 0
    skipped: str = ""
    microseconds: list[float] = []
    success: list[bool] = []
    position_error: list[float] = []
    angle_error: list[float] = []
    iterations: list[int] = []
    restarts: list[int] = []
    status: list[str] = []
    largest_step: float = 0.0
    jumps: int = 0

    @property
    def count(self) -> int:
        """Number of problems that were tried."""
        return len(self.microseconds)

    @property
    def rate(self) -> float:
        """Share of successes, from 0 to 1."""
        return sum(self.success) / self.count if self.count else 0.0

    def microsecond(self, which: Literal["mean", "median"] | float) -> float:
        """Return mean, median or a percentile (a number) of the times, µs. NaN without times."""
        if not self.count:
            return float("nan")
        if which == "mean":
            return float(np.mean(self.microseconds))
        return float(np.percentile(self.microseconds, 50.0 if which == "median" else which))


class Curve(_Data):
    """Convergence of a method.

    Attributes:
        solver: The method.
        robot: The robot.
        goal: ``pose`` or ``position``.
        error: Position error of the best point so far by step, median over problems, m.
    """

    solver: str
    robot: str
    goal: str
    error: list[float]


class LowerBound(_Data):
    """Cost of the kinematics alone, measured in a compiled loop.

    Attributes:
        robot: The robot.
        joints: Joints between base and tool.
        forward_us: Time of a forward pass, µs.
        jacobian_us: Time of a forward pass with Jacobian, µs.
    """

    robot: str
    joints: int
    forward_us: float
    jacobian_us: float


class Growth(_Data):
    """Cost of one step of a method.

    Attributes:
        solver: The method.
        across: The varied quantity: joints or goals.
        size: Number of joints or goals.
        step_us: Time of a step, µs.
    """

    solver: str
    across: Literal["joints", "goals"]
    size: int
    step_us: float


class Batch(_Data):
    """Many poses by one call of ``solve_batch``.

    Attributes:
        solver: The method.
        robot: The robot.
        poses: Number of poses.
        threads: Number of threads.
        per_second: Solves per second.
        success: Share of poses that were solved.
    """

    solver: str
    robot: str
    poses: int
    threads: int
    per_second: float
    success: float


class Results(_Data):
    """Results of one run.

    Attributes:
        schema_version: Version of the file. It is raised when a field changes its meaning.
        complete: Whether the run was completed.
        machine: The machine.
        settings: The settings.
        cells: Solvers on problem sets.
        curves: Convergence of the methods.
        lower_bounds: Cost of the kinematics alone.
        growth: Growth of the cost of a step.
        batches: Calls of ``solve_batch``.
    """

    schema_version: Literal[1] = 1
    complete: bool = False
    machine: Machine
    settings: Settings
    cells: list[Cell] = []
    curves: list[Curve] = []
    lower_bounds: list[LowerBound] = []
    growth: list[Growth] = []
    batches: list[Batch] = []


def this_machine() -> Machine:
    """Return the machine with its current speed."""
    packages = (DISTRIBUTION, "mujoco", "numpy", "numba")
    return Machine(
        system=f"{platform.system()} {platform.machine()}",
        processor=_processor(),
        cores=usable_cores(),
        python=platform.python_version(),
        versions={name: metadata.version(name) for name in packages},
        calibration_us=round(calibration(), 1),
        load=round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else 0.0,
        when=time.strftime("%Y-%m-%d %H:%M"),
    )


def calibration() -> float:
    """Return the median time of a fixed loop of plain Python, µs. It shows speed and load."""
    loop = "for i in range(20_000): total += (i * 0.5) ** 0.5"
    return 1e6 * float(np.median(timeit.repeat(loop, "total = 0.0", number=1, repeat=9)))


def _processor() -> str:
    """Return the name of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"
