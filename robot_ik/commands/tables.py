"""Tables of the commands, in one style and readable on narrow terminals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from robot_ik.geometry import Pose

GAP = 2
"""Blank columns between two columns of a table."""


class FoldedTable(Table):
    """A table that breaks no word. If the words need more columns, each row becomes a list."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        texts = [
            [_plain(cell) for cell in (column.header, *column.cells)] for column in self.columns
        ]
        words = [_longest(word for text in column for word in text.split()) for column in texts]
        lines = [
            _longest(line for text in column for line in text.splitlines()) for column in texts
        ]
        words[0] = lines[0]  # the first column is never folded
        space = options.max_width - GAP * (len(texts) - 1)
        if sum(lines) > space >= sum(words):
            for column, width in zip(self.columns, _widths(words, lines, space), strict=True):
                column.width = width
        elif sum(lines) > space and len(texts) > 2:
            yield from self._rows_as_lists()
            return
        yield from super().__rich_console__(console, options)

    def _rows_as_lists(self) -> Iterator[RenderableType]:
        if self.title:
            yield Text(_plain(self.title), style="bold")
        names = [_plain(column.header) for column in self.columns]
        for row in zip(*(list(column.cells) for column in self.columns), strict=True):
            cells = zip(names[1:], row[1:], strict=True)
            pairs = [(f"  {name}", cell) for name, cell in cells if _plain(cell)]
            yield table(
                "", "", rows=[(Text(_plain(row[0]), style="bold"), ""), *pairs], header=False
            )


def table(
    *columns: str,
    rows: Iterable[Sequence[object]],
    header: bool = True,
    title: str | None = None,
    fold: bool = True,
) -> Table:
    """Return a table. Cells are ``Text`` or shown by ``str``. The first column is never folded.

    Args:
        columns: Heads of the columns.
        rows: The cells.
        header: Whether the heads are shown.
        title: Line above the table.
        fold: Whether cells are folded on narrow terminals.
    """
    grid = FoldedTable(
        box=None,
        pad_edge=False,
        header_style="bold",
        show_header=header,
        title=title,
        title_justify="left",
        title_style="bold",
    )
    for index, name in enumerate(columns):
        grid.add_column(name, no_wrap=index == 0 or not fold, overflow="fold")
    for row in rows:
        grid.add_row(*(cell if isinstance(cell, Text) else str(cell) for cell in row))
    return grid


def pairs_table(pairs: Iterable[Sequence[object]]) -> Table:
    """Return a table of names and values without a header."""
    return table("", "", rows=pairs, header=False)


def pose_text(pose: Pose) -> str:
    """Return a pose for people: millimetres and quaternion w x y z."""
    position = " ".join(f"{1e3 * value:z.2f}" for value in pose.position)
    wxyz = " ".join(f"{value:z.5f}" for value in pose.wxyz)
    return f"{position} mm, wxyz {wxyz}"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun: ``1 pose``, ``2 poses``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _widths(words: Sequence[int], lines: Sequence[int], space: int) -> list[int]:
    """Return the width of each column: its longest word, and a share of the spare columns.

    Columns that need the fewest additional columns come first, so that long texts are folded and
    short ones are not.
    """
    widths = list(words)
    spare = space - sum(words)
    order = sorted(range(len(words)), key=lambda index: lines[index] - words[index])
    for position, index in enumerate(order):
        share = min(lines[index] - words[index], spare // (len(order) - position))
        widths[index] += share
        spare -= share
    return widths


def _longest(texts: Iterable[str]) -> int:
    return max(map(len, texts), default=0)


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)
