"""The table of measured quantities that the benchmarks print."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from rich.text import Text

from benchmarks.quantity import Quantity
from robot_ik.commands.streams import open_console
from robot_ik.commands.tables import table

MARKS = {
    None: Text(""),
    True: Text("pass", style="green"),
    False: Text("FAIL", style="bold red"),
}
"""Whether a quantity is within its limits -> its mark."""


def show_quantities(head: str, rows: Iterable[tuple[str, Quantity]], *remarks: str) -> None:
    """Print measured quantities with their limits, and the number within the limits.

    Args:
        head: Head of the column of names.
        rows: Name and quantity. A repeated name is shown once.
        remarks: Texts for the last line.
    """
    cells = []
    judged = []
    previous = None
    for name, quantity in rows:
        cells.append(
            (
                "" if name == previous else name,
                quantity.quantity,
                quantity.measured_text,
                quantity.wanted_text,
                MARKS[quantity.passed],
            )
        )
        if quantity.passed is not None:
            judged.append(quantity.passed)
        previous = name
    console = open_console(sys.stdout)
    console.print(table(head, "quantity", "measured", "wanted", "", rows=cells))
    console.print("; ".join([f"{sum(judged)} of {len(judged)} within limits", *remarks]))
