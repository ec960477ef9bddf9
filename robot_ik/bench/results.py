"""What a benchmark found, as data: one JSON file, read back without loss."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from robot_ik.batch import usable_cores
from robot_ik.files import config_error, read_json

_MADE_BY = "robot-ik bench makes such files (version 1)"

#: A larger step of a joint between two warm answers is a jump to another branch, rad.
JUMP = 0.2


class _Data(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Machine(_Data):
    """Where it was measured.

    Attributes:
        calibration_us: Median time of a fixed loop of plain Python: tells how fast, and how busy, it was.
        load: Load average of the last minute at the start.
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
    """What was asked; with the machine, all that is needed to do it again."""

    command: str
    count: int
    seed: int
    position_tolerance: float
    angle_tolerance: float
    seconds: float


class Cell(_Data):
    """One solver on one problem set of one robot.  Lists have one number for each problem solved.

    Attributes:
        goal: ``pose`` or ``position``: what was asked of the frame.
        asked: Problems in the set; fewer in the lists where time ran out or it was interrupted.
        skipped: Why nothing was measured; empty otherwise.
        microseconds: Whole Python calls: 4×4 matrix in, joint array out.
        success: By MuJoCo's forward pass within tolerance, and inside the model's joint ranges.
        position_miss, angle_miss: By MuJoCo, metres and radians; 0 for a part that was not asked for.
        status: What the solver said, names of ``Status``.
        largest_step: Largest change of a joint between answers (warm only), rad or m.
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
    position_miss: list[float] = []
    angle_miss: list[float] = []
    iterations: list[int] = []
    restarts: list[int] = []
    status: list[str] = []
    largest_step: float = 0.0
    jumps: int = 0

    @property
    def count(self) -> int:
        """Problems solved or failed."""
        return len(self.microseconds)

    @property
    def rate(self) -> float:
        """Share of them that succeeded, 0 … 1."""
        return sum(self.success) / self.count if self.count else 0.0

    def microsecond(self, which: Literal["mean", "median"] | float) -> float:
        """Mean, median or a percentile (a number) of the times, µs; NaN when there are none."""
        if not self.count:
            return float("nan")
        if which == "mean":
            return float(np.mean(self.microseconds))
        return float(np.percentile(self.microseconds, 50.0 if which == "median" else which))


class Curve(_Data):
    """How a method closed in: median over problems of the position miss (m) at its best point so far."""

    solver: str
    robot: str
    goal: str
    miss: list[float]


class Floor(_Data):
    """Cost of the kinematics alone, measured in a compiled loop, µs."""

    robot: str
    joints: int
    forward_us: float
    jacobian_us: float


class Growth(_Data):
    """Cost of one step of a method; ``across`` says what grows: joints or goals."""

    solver: str
    across: Literal["joints", "goals"]
    size: int
    step_us: float
    call_us: float
    converged: float


class Batch(_Data):
    """Many poses by one call of ``solve_batch``."""

    solver: str
    robot: str
    poses: int
    threads: int
    per_second: float
    success: float


class Results(_Data):
    """Everything of one run.

    Attributes:
        schema_version: Of the file; raised when a field changes its meaning.
        complete: Whether it ran to its end.
    """

    schema_version: Literal[1] = 1
    complete: bool = False
    machine: Machine
    settings: Settings
    cells: list[Cell] = []
    curves: list[Curve] = []
    floors: list[Floor] = []
    growth: list[Growth] = []
    batches: list[Batch] = []


def read_results(path: Path) -> Results:
    """Results of a file that ``robot-ik bench`` wrote.

    Raises:
        ConfigError: It cannot be read, or is not such a file.
    """
    try:
        return Results.model_validate(read_json(path, "the results", _MADE_BY))
    except ValidationError as error:
        found = config_error(error, path)
        found.hint = _MADE_BY
        raise found from error


def results_text(results: Results) -> str:
    """The file: one line for each cell, so that people can look at it and tools can compare it."""
    data = results.model_dump(mode="json")
    lines = []
    for key, value in data.items():
        if isinstance(value, list) and value:
            rows = ",\n    ".join(json.dumps(item, allow_nan=False) for item in value)
            lines.append(f"  {json.dumps(key)}: [\n    {rows}\n  ]")
        else:
            lines.append(f"  {json.dumps(key)}: {json.dumps(value, allow_nan=False)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def this_machine() -> Machine:
    """The machine, and how fast it is just now."""
    packages = ("robot_ik", "mujoco", "numpy", "numba")
    return Machine(
        system=f"{platform.system()} {platform.machine()}",
        processor=_processor(),
        cores=usable_cores(),
        python=platform.python_version(),
        versions={name: metadata.version(name) for name in packages},
        calibration_us=round(_calibration(), 1),
        load=round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else 0.0,
        when=time.strftime("%Y-%m-%d %H:%M"),
    )


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _calibration() -> float:
    times = []
    for _ in range(9):
        began, total = time.perf_counter(), 0.0
        for i in range(20_000):
            total += (i * 0.5) ** 0.5
        times.append(1e6 * (time.perf_counter() - began))
    return statistics.median(times)
