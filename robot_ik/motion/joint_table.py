"""The CSV table of joint positions over time: its columns, its rows and its reader.

docs/reference/recordings.md describes the columns. Positions are in rad, or m for slides.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path

import numpy as np

from robot_ik.config import LARGEST_NUMBER, is_number, read_csv, shown
from robot_ik.errors import ConfigError
from robot_ik.geometry import Array, Pose

TIME = "time_s"
"""Column of the time since the start, s. It is the first column of every table."""

ROBOT = "robot"
"""Column of the index of the robot, if there are several side by side."""

COMMANDED = "commanded."
"""Start of the column of a commanded position. The name of the joint follows."""

MEASURED = "measured."
"""Start of the column of a measured position. The name of the joint follows."""

GOAL = ("goal_x", "goal_y", "goal_z", "goal_qw", "goal_qx", "goal_qy", "goal_qz")
"""Columns of the goal in the world: position in m, then the quaternion."""

TEXT = "text"
"""Column of events."""

ALLOWED_HEADER = f"{TIME},{COMMANDED}JOINT,…"
"""A header that can be read, for messages."""


@dataclass(frozen=True, eq=False)
class Moment:
    """One row of a recording.

    Attributes:
        now: Time since the start of the recording, s.
        commanded: Commanded positions (n,), rad for hinges and m for slides.
        measured: Measured positions (n,), in the same units.
        goal: Goal in the world.
        text: Event at this time. Empty if there is none.
        robot: Index of the robot, if there are several side by side.
        extra: Values of further columns by name. MCAP files do not contain them.
    """

    now: float
    _: KW_ONLY
    commanded: Array | None = None
    measured: Array | None = None
    goal: Pose | None = None
    text: str = ""
    robot: int = 0
    extra: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class JointTable:
    """Writes moments as rows of one table.

    Attributes:
        joints: Names of the positions, in the order of the vectors.
        extra: Names of further columns.
    """

    joints: Sequence[str]
    extra: Sequence[str] = ()

    @property
    def header(self) -> list[str]:
        """Names of all columns."""
        commanded = [COMMANDED + joint for joint in self.joints]
        measured = [MEASURED + joint for joint in self.joints]
        return [TIME, ROBOT, *commanded, *measured, *GOAL, TEXT, *self.extra]

    def row(self, moment: Moment) -> list[object]:
        """Return the cells of a moment. Cells of unknown values are empty."""
        goal: list[object] = [""] * len(GOAL)
        if moment.goal is not None:
            goal = [*moment.goal.position.tolist(), *moment.goal.wxyz.tolist()]
        return [
            float(moment.now),
            moment.robot,
            *self._cells(moment.commanded),
            *self._cells(moment.measured),
            *goal,
            moment.text,
            *(moment.extra.get(name, "") for name in self.extra),
        ]

    def _cells(self, positions: Array | None) -> list[object]:
        return [""] * len(self.joints) if positions is None else positions.tolist()


def table_text(joints: Sequence[str], moments: Iterable[Moment], extra: Sequence[str] = ()) -> str:
    """Return a table whose moments are all known. Columns without a value are left out.

    Args:
        joints: Names of the positions, in the order of the vectors.
        moments: The rows. The column ``robot`` is left out if it is always 0.
        extra: Names of further columns.
    """
    table = JointTable(joints, extra)
    header = table.header
    rows = [table.row(moment) for moment in moments]
    unused: dict[str, object] = dict.fromkeys(header, "")
    unused[ROBOT] = 0
    used = [
        k
        for k, name in enumerate(header)
        if name == TIME or any(row[k] != unused[name] for row in rows)
    ]
    return csv_text([header[k] for k in used], ([row[k] for k in used] for row in rows))


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a header and rows of text and numbers as CSV, with numbers in full precision."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([header, *rows])
    return stream.getvalue()


@dataclass(frozen=True, eq=False)
class JointPositions:
    """Positions that were read from a table.

    Attributes:
        joints: Names of the n columns.
        times: Times (m,), s.
        q: Positions (m, n), rad or m.
    """

    joints: tuple[str, ...]
    times: Array
    q: Array


def read_positions(path: Path, joints: Sequence[str] = ()) -> JointPositions:
    """Read the commanded positions of a table, or the measured ones if none were commanded.

    Rows without these positions are left out.

    Args:
        path: The file.
        joints: Names of the joints to read, in this order. Empty for all.

    Raises:
        ConfigError: The file is missing or is not such a table. The message names the line.
    """
    lines = [(k, row) for k, row in enumerate(read_csv(path, "the motion"), 1) if row]
    header = [cell.strip() for cell in lines[0][1]] if lines else []
    columns = _position_columns(header, path)
    if joints:
        missing = [name for name in joints if name not in columns]
        if missing:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            problem = f"no column of the joint {missing[0]!r}{more}"
            raise ConfigError(problem, file=path, key="line 1", allowed=ALLOWED_HEADER)
        columns = {name: columns[name] for name in joints}

    cells = list(columns.values())
    kept = [
        (k, row)
        for k, row in lines[1:]
        if len(row) != len(header) or any(row[cell] for cell in cells)
    ]
    samples = [_numbers(row, [0, *cells], len(header), path, k) for k, row in kept]
    if not samples:
        raise ConfigError("has no samples", file=path, key="line 2", allowed="a row of numbers")
    if ROBOT in header and len({row[header.index(ROBOT)] for _, row in kept}) > 1:
        raise ConfigError("is of several robots", file=path, key=ROBOT, allowed="of one robot")
    values = np.array(samples)
    return JointPositions(tuple(columns), values[:, 0], values[:, 1:])


def _position_columns(header: Sequence[str], path: Path) -> dict[str, int]:
    """Return the index of the column of each joint, or raise ``ConfigError``."""
    if header and header[0] == TIME:
        for start in (COMMANDED, MEASURED):
            columns = {
                name.removeprefix(start): k
                for k, name in enumerate(header)
                if name.startswith(start)
            }
            if columns:
                return columns
    problem = "is not a table of joint positions"
    raise ConfigError(problem, file=path, key="line 1", allowed=ALLOWED_HEADER)


def _numbers(
    row: Sequence[str], cells: Sequence[int], width: int, path: Path, line: int
) -> list[float]:
    """Return the numbers in cells of a row of ``width`` cells, or raise ``ConfigError``."""
    if len(row) == width and all(is_number(row[k]) for k in cells):
        values = [float(row[k]) for k in cells]
        if all(abs(value) <= LARGEST_NUMBER for value in values):  # not NaN
            return values
    allowed = f"{width} cells, positions as numbers up to {LARGEST_NUMBER:g}"
    problem = f"got {shown(','.join(row))}"
    raise ConfigError(problem, file=path, key=f"line {line}", allowed=allowed)
