"""The rows of the camera's benchmark. Each row is one function that returns figures."""

from __future__ import annotations

import math
import pkgutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.quantity import Quantity
from robot_ik.errors import RobotIkError
from robot_ik.workcell.progress import Progress

# A quick run measures this part of the pictures, but not fewer than the second number.
_QUICK_PART = 10
_FEWEST = 3


@dataclass(frozen=True)
class Effort:
    """Extent of a run.

    Attributes:
        quick: Measure a tenth of the pictures, for a first impression.
        seed: Of pictures and noise.
        photographs: Folder of real pictures without markers. Empty: no such pictures.
    """

    quick: bool = False
    seed: int = 1
    photographs: str = ""

    def count(self, whole: int) -> int:
        """Return the number of pictures to measure, out of ``whole``."""
        return max(_FEWEST, whole // _QUICK_PART) if self.quick else whole


Measure = Callable[[Effort], Iterator[Quantity]]


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        name: For ``--rows``.
        about: One line of help.
        function: ``module:function``, imported when the row is measured.
    """

    name: str
    about: str
    function: str

    def measure(self, effort: Effort) -> Iterator[Quantity]:
        """Yield the figures."""
        measure: Measure = pkgutil.resolve_name(self.function)
        yield from measure(effort)


ROWS: tuple[Row, ...] = (
    Row(
        "marker",
        "corners and pose of one 50 mm marker",
        "benchmarks.camera.accuracy:marker",
    ),
    Row(
        "board",
        "pose of a board of 2×2 markers",
        "benchmarks.camera.accuracy:board",
    ),
    Row(
        "cameras",
        "markers and boards by the cameras that people have",
        "benchmarks.camera.cameras:cameras",
    ),
    Row(
        "occlusion",
        "pose of a board of 3×3 markers, half hidden",
        "benchmarks.camera.accuracy:occlusion",
    ),
    Row(
        "overlay",
        "where a robot on the board is drawn",
        "benchmarks.camera.accuracy:overlay",
    ),
    Row(
        "latency",
        "a robot on a board that a hand moves, drawn 66 ms late",
        "benchmarks.camera.accuracy:latency",
    ),
    Row(
        "clutter",
        "markers found in pictures that hold none",
        "benchmarks.camera.accuracy:clutter",
    ),
    Row(
        "photographs",
        "real pictures",
        "benchmarks.camera.photographs:photographs",
    ),
    Row(
        "projection",
        "drawn spheres against OpenCV's projection",
        "benchmarks.camera.accuracy:projection",
    ),
    Row(
        "calibration",
        "intrinsics from 20 views of a board",
        "benchmarks.camera.accuracy:calibration",
    ),
    Row(
        "handeye",
        "camera on the hand, from 15 poses",
        "benchmarks.camera.accuracy:handeye",
    ),
    Row(
        "consistency",
        "errors of locate, hand-eye, verify over the stated",
        "benchmarks.camera.arm:consistency",
    ),
    Row(
        "prediction",
        "a moving hand, seen 66 ms ago",
        "benchmarks.camera.arm:prediction",
    ),
    Row(
        "times",
        "finding and measuring a marker in a picture",
        "benchmarks.camera.speed:times",
    ),
    Row(
        "drawing",
        "drawing a robot over a picture",
        "benchmarks.camera.speed:drawing",
    ),
    Row(
        "exposure",
        "a picture of the synthetic camera",
        "benchmarks.camera.speed:exposure",
    ),
    Row(
        "loop",
        "picture to goal, solution and overlay",
        "benchmarks.camera.speed:loop",
    ),
    Row(
        "delay",
        "from the grab of a picture to its goal",
        "benchmarks.camera.speed:delay",
    ),
    Row(
        "first",
        "the first command, without camera and display",
        "benchmarks.camera.photographs:first_command",
    ),
    Row(
        "zeros",
        "joint zero offsets, from 30 poses",
        "benchmarks.camera.arm:joint_zero_offsets",
    ),
)


@dataclass
class MeasuredRows:
    """The results of a run.

    Attributes:
        figures: By row. The last figure of a row that failed is ``missing``.
        seconds: Time that each row took, s.
        complete: Whether all rows were measured.
    """

    figures: dict[str, list[Quantity]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    complete: bool = False

    def measure(self, rows: Sequence[Row], effort: Effort, progress: Progress) -> None:
        """Add row by row, figure by figure."""
        for k, row in enumerate(rows):
            progress(row.about, k / len(rows))
            figures = self.figures.setdefault(row.name, [])
            began = time.monotonic()
            try:
                for figure in row.measure(effort):
                    figures.append(figure)
                    progress(f"{row.about}: {figure.quantity}", k / len(rows))
                if not figures:
                    figures.append(Quantity(row.about, math.nan, missing="it gave no figure"))
            except RobotIkError as error:
                figures.append(Quantity(row.about, math.nan, missing=str(error.args[0])))
            finally:
                self.seconds[row.name] = time.monotonic() - began
        self.complete = True

    @property
    def failed(self) -> bool:
        """Whether a measured figure is outside its limits."""
        return any(
            figure.passed is False for figures in self.figures.values() for figure in figures
        )

    @property
    def unmeasured(self) -> list[str]:
        """Rows without figures, or without all of them."""
        return [
            name
            for name, figures in self.figures.items()
            if any(figure.missing for figure in figures)
        ]

    def facts(self) -> dict[str, Any]:
        """Return the results for JSON."""
        return {
            "complete": self.complete,
            "rows": {
                name: {
                    "seconds": round(self.seconds.get(name, 0.0), 1),
                    "figures": [figure.facts() for figure in figures],
                }
                for name, figures in self.figures.items()
            },
        }
