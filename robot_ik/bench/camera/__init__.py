"""What ``robot-ik bench camera`` measures: one row, one function that gives figures beside what is wanted."""

from __future__ import annotations

import math
import pkgutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from robot_ik.bench.quantity import Quantity
from robot_ik.errors import RobotIkError
from robot_ik.jobs import Progress


@dataclass(frozen=True)
class Effort:
    """How much is measured: to be ``quick``, a tenth of the pictures, for a first impression.

    ``photographs``: a folder of real ones without markers; empty: none.
    """

    quick: bool = False
    seed: int = 1
    photographs: str = ""

    def count(self, whole: int) -> int:
        """How many of ``whole`` to do."""
        return max(3, whole // 10) if self.quick else whole


Measure = Callable[[Effort], Iterator[Quantity]]


@dataclass(frozen=True)
class Row:
    """One row of the table; ``function`` is ``module:function``, imported when it is measured."""

    name: str
    about: str
    function: str

    def measure(self, effort: Effort) -> Iterator[Quantity]:
        """Measures; figures come as they are ready."""
        measure: Measure = pkgutil.resolve_name(self.function)
        yield from measure(effort)


_HERE = "robot_ik.bench.camera."

ROWS: tuple[Row, ...] = (
    Row("marker", "corners and pose of one 50 mm marker", _HERE + "accuracy:marker"),
    Row("board", "pose of a board of 2×2 markers", _HERE + "accuracy:board"),
    Row("cameras", "markers and boards by the cameras that people have", _HERE + "cameras:cameras"),
    Row("occlusion", "pose of a board of 3×3 markers, half hidden", _HERE + "accuracy:occlusion"),
    Row("overlay", "where a robot on the board is drawn", _HERE + "accuracy:overlay"),
    Row("latency", "a robot on a board that a hand moves, drawn 66 ms late", _HERE + "accuracy:latency"),
    Row("clutter", "markers found in pictures that hold none", _HERE + "accuracy:clutter"),
    Row("photographs", "real pictures, of --photographs", _HERE + "photographs:photographs"),
    Row("projection", "drawn spheres against OpenCV's projection", _HERE + "accuracy:projection"),
    Row("calibration", "intrinsics from 20 views of a board", _HERE + "accuracy:calibration"),
    Row("handeye", "camera on the hand, from 15 poses", _HERE + "accuracy:handeye"),
    Row("consistency", "errors of locate, hand-eye, verify over the stated", _HERE + "arm:consistency"),
    Row("prediction", "a moving hand, seen 66 ms ago", _HERE + "arm:prediction"),
    Row("times", "finding and measuring a marker in a picture", _HERE + "speed:times"),
    Row("drawing", "drawing a robot over a picture", _HERE + "speed:drawing"),
    Row("loop", "picture to goal, solution and overlay", _HERE + "speed:loop"),
    Row("delay", "from the grab of a picture to its goal", _HERE + "speed:delay"),
    Row("first", "the first command, without camera and display", _HERE + "photographs:first_command"),
    Row("zeros", "joint zero offsets, from 30 poses", _HERE + "arm:joint_zero_offsets"),
)


@dataclass
class MeasuredRows:
    """What a run has found.

    Attributes:
        figures: By row; the last one of a row that was broken off is ``missing``.
        seconds: That each row took.
        complete: Whether the run came to its end.
    """

    figures: dict[str, list[Quantity]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    complete: bool = False

    def measure(self, rows: Sequence[Row], effort: Effort, progress: Progress) -> None:
        """Adds row by row, figure by figure."""
        for k, row in enumerate(rows):
            progress(row.about, k / len(rows))
            figures = self.figures.setdefault(row.name, [])
            began = time.monotonic()
            try:
                for one in row.measure(effort):
                    figures.append(one)
                    progress(f"{row.about}: {one.quantity}", k / len(rows))
                if not figures:
                    figures.append(Quantity(row.about, math.nan, missing="it gave no figure"))
            except RobotIkError as error:
                figures.append(Quantity(row.about, math.nan, missing=str(error.args[0])))
            finally:
                self.seconds[row.name] = time.monotonic() - began
        self.complete = True

    @property
    def failed(self) -> bool:
        """Whether a figure is not as wanted; one that was not measured is not among these."""
        return any(one.passed is False for figures in self.figures.values() for one in figures)

    @property
    def unmeasured(self) -> list[str]:
        """Rows without figures, or not with all."""
        return [name for name, figures in self.figures.items() if any(one.missing for one in figures)]

    def facts(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "complete": self.complete,
            "rows": {
                name: {
                    "seconds": round(self.seconds.get(name, 0.0), 1),
                    "figures": [one.facts() for one in figures],
                }
                for name, figures in self.figures.items()
            },
        }
