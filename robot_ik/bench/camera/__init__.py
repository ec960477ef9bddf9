"""What ``robot-ik bench camera`` measures: one row, one function that gives figures beside what is wanted."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from robot_ik.errors import RobotIkError


@dataclass(frozen=True)
class Quantity:
    """One measured number.

    Attributes:
        quantity: What was measured, as text, with its unit in ``unit``.
        value: What came out.
        unit: mm, °, px, ms, …
        wanted: The bound; None where none was set.
        at_least: Whether ``wanted`` is the least rather than the most.
        timed: Whether it depends on the machine and what else it does.
    """

    quantity: str
    value: float
    unit: str
    wanted: float | None = None
    at_least: bool = False
    timed: bool = False

    @property
    def passed(self) -> bool | None:
        """Whether the value meets what is wanted; None where nothing is."""
        if self.wanted is None:
            return None
        return self.value >= self.wanted if self.at_least else self.value <= self.wanted

    def facts(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "passed": self.passed}


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        quick: A tenth of the pictures: for a first impression, not for the record.
        seed: Of everything random.
        photographs: A folder of real ones without markers; empty: none.
    """

    quick: bool = False
    seed: int = 1
    photographs: str = ""

    def count(self, whole: int) -> int:
        """How many of ``whole`` to do."""
        return max(3, whole // 10) if self.quick else whole


class NotMeasuredError(RobotIkError):
    """A row cannot be measured here; the message says why."""


Measure = Callable[[Effort], Iterator[Quantity]]


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        name: What it is called on the command line.
        about: What it does, as text.
        function: ``module:function``, imported when it is measured.
    """

    name: str
    about: str
    function: str

    def measure(self, effort: Effort) -> Iterator[Quantity]:
        """Measures; figures come as they are ready.

        Raises:
            NotMeasuredError: Something that it needs is not here.
        """
        module, _, name = self.function.partition(":")
        measure: Measure = getattr(importlib.import_module(module), name)
        yield from measure(effort)


_HERE = "robot_ik.bench.camera."

ROWS: tuple[Row, ...] = (
    Row("corners", "corners of one marker", _HERE + "accuracy:corners"),
    Row("marker", "pose of one 50 mm marker", _HERE + "accuracy:marker"),
    Row("board", "pose of a board of 2×2 markers", _HERE + "accuracy:board"),
    Row("cameras", "markers and boards by the cameras that people have", _HERE + "cameras:cameras"),
    Row("occlusion", "pose of a board of 3×3 markers, half hidden", _HERE + "accuracy:occlusion"),
    Row("overlay", "where a robot on the board is drawn", _HERE + "accuracy:overlay"),
    Row("clutter", "goals from pictures that hold no marker", _HERE + "accuracy:clutter"),
    Row("photographs", "real pictures, of --photographs", _HERE + "photographs:photographs"),
    Row("projection", "drawn spheres against OpenCV's projection", _HERE + "accuracy:projection"),
    Row("gl", "the same, drawn by OpenGL", _HERE + "accuracy:gl_projection"),
    Row("calibration", "intrinsics from 20 views of a board", _HERE + "accuracy:calibration"),
    Row("handeye", "camera on the hand, from 15 poses", _HERE + "accuracy:handeye"),
    Row(
        "offsets",
        "joint zeros from 30 pictures of a board in the hand",
        _HERE + "arm:offsets",
    ),
    Row(
        "honesty", "locate, hand-eye and verify by pictures of a webcam, 20 seeds", _HERE + "arm:consistency"
    ),
    Row("prediction", "a moving hand, seen 66 ms ago", _HERE + "arm:prediction"),
    Row("times", "finding and measuring a marker in a picture", _HERE + "speed:times"),
    Row("drawing", "drawing a robot over a picture", _HERE + "speed:drawing"),
    Row("loop", "picture to goal, solution and overlay", _HERE + "speed:loop"),
    Row("delay", "from the grab of a picture to its goal", _HERE + "speed:delay"),
    Row("first", "the first command, without camera and display", _HERE + "photographs:first_command"),
)
