"""Writes what was measured of the camera into its page: `python docs/make_camera_figures.py FILE`.

FILE is what `robot-ik bench camera --json FILE` has written; several are joined.  A table stands between
`<!-- measured: NAME -->` and `<!-- end -->`.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robot_ik.bench.camera_motion import compare_filters
from robot_ik.bench.camera_rows import ROWS as CAMERA_ROWS
from robot_ik.bench.camera_rows import Figure
from robot_ik.cli.bench_camera import measured, wanted

PLACE = re.compile(r"(<!-- measured: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
PAGE = Path(__file__).parent / "camera.md"


def camera_table(files: Sequence[dict[str, Any]]) -> str:
    """Quantity, value and wanted of every figure under what it is of, and the machine."""
    lines = ["| quantity | measured | wanted |", "| --- | ---: | ---: |"]
    rows: dict[str, Any] = {}
    for facts in files:
        rows |= facts["rows"]
    for row in (one for one in CAMERA_ROWS if one.name in rows):
        lines.append(f"| **{row.about}** | | |")
        for facts in rows[row.name]["figures"]:
            one = Figure(**{name: value for name, value in facts.items() if name != "passed"})
            missed = " (missed)" if one.passed is False else ""
            lines.append(f"| {one.quantity} | {measured(one)}{missed} | {wanted(one)} |")
    machine = files[-1]["machine"]
    where = f"{machine['processor']}, {machine['cores']} cores, load {machine['load']}, {machine['when']}."
    return "\n".join([*lines, "", where, ""])


def prediction_table() -> str:
    """Errors of a waving hand by the age of its picture."""
    moving, _ = compare_filters(hands=6)
    lines = ["| age | as it was seen | predicted | 1 € filter |", "| ---: | ---: | ---: | ---: |"]
    for row in moving:
        errors = " | ".join(f"{1e3 * value:.1f}" for value in (row.hold, row.predicted, row.calmed))
        lines.append(f"| {1e3 * row.delay:.0f} ms | {errors} |")
    return "\n".join([*lines, ""])


def main(names: Sequence[str]) -> None:
    """Fills the page."""
    files = [json.loads(Path(name).read_text(encoding="utf-8")) for name in names]
    tables = {"prediction": prediction_table()}
    if files:
        tables["camera"] = camera_table(files)
    before = PAGE.read_text(encoding="utf-8")
    after = PLACE.sub(lambda m: m[1] + tables.get(m[2], m[3]) + m[4], before)
    if after != before:
        PAGE.write_text(after, encoding="utf-8")
        sys.stdout.write(f"wrote {PAGE}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
