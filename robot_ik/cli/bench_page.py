"""``robot-ik bench page``: what the testbed's page costs, beside what is wanted of it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

from rich.text import Text

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.environment import import_mujoco
from robot_ik.errors import MissingExtraError

if TYPE_CHECKING:
    from robot_ik.bench.page import PageRow


@dataclass(frozen=True)
class BenchPageOptions:
    """Measures the testbed's page: its loop, its drawing, its start, and how soon a drag is answered.

    Needs a quiet machine: the rows are times by the clock and processor time of the page alone. The start is
    that of `robot-ik view` with Chromium already open; cold: with an empty cache of kernels. Ctrl-C keeps
    what is done.

    Exit code 0 where every figure was measured and is as wanted, else 1.
    """

    seconds: float = 10.0
    """For which processor time and bytes are counted, three times."""
    json: bool = False
    """Print JSON."""


def run(options: BenchPageOptions) -> int:
    """Measures and prints."""
    import_mujoco()
    if not 1.0 <= options.seconds <= 600.0:
        raise wrong("--seconds", f"{options.seconds:g} s", "1 to 600")
    if find_spec("viser") is None:
        raise MissingExtraError("viser", "web", "the page in the browser")
    from robot_ik.bench.page import measure_page

    rows: list[PageRow] = []
    try:
        with console.progress() as bar:
            task = bar.add_task("measuring", total=None, note="")
            for row in measure_page(options.seconds, lambda text: bar.update(task, note=text)):
                rows.append(row)
    finally:
        _print(rows, options)
    return console.DONE if all(row.passed for row in rows) else console.NOT_ACHIEVED


def _print(rows: list[PageRow], options: BenchPageOptions) -> None:
    if options.json:
        console.print_json({"schema": 1, "rows": [asdict(row) | {"passed": row.passed} for row in rows]})
        return
    shown = console.table("what", "measured", "wanted", "", "")
    for row in rows:
        value = "–" if math.isnan(row.value) else f"{row.value:.3g} {row.unit}"
        mark = Text("yes", style="green") if row.passed else Text("NO", style="bold red")
        shown.add_row(row.what, value, f"≤ {row.most:g}", mark, Text(row.note, style="dim"))
    console.out().print(shown)
