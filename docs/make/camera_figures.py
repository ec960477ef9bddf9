"""Write the measured figures of the camera into the documentation.

    make bench-camera ARGS="--json FILE"
    python -m docs.make.camera_figures FILE    # FILE -> docs/camera.json -> pages
    python -m docs.make.camera_figures         # docs/camera.json, docs/performance.json -> pages

Rows of FILE replace the rows of the same names in docs/camera.json. Several files may be given. A
table stands between `<!-- measured: NAME -->` and `<!-- end -->`. The tests fail if a table is out
of date.
"""

from __future__ import annotations

import json
import re
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.camera.arm import DELAYS, compare_filters
from benchmarks.camera.rows import ROWS
from benchmarks.quantity import Quantity

DOCS = Path(__file__).resolve().parents[1]
DATA = DOCS / "camera.json"
OTHERS = DOCS / "performance.json"
PAGES = (
    DOCS / "reference" / "camera_accuracy.md",
    DOCS / "theory" / "registration.md",
    DOCS.parent / "README.md",
)
PLACE = re.compile(r"(<!-- measured: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)

# Length of a line of the pages.
_LINE_LENGTH = 100

#: Row with the same figures for every camera.
BY_CAMERA = "cameras"
#: Rows that have their own table, and where it is.
TABLES_OF_ROWS = {
    BY_CAMERA: "[below](#other-cameras)",
    "latency": "[registration and delay](../theory/registration.md)",
}

Data = dict[str, Any]

#: Azuma's remedies as the page names them, with their options.
_LATENCY_CASES = {
    "nothing": '`"latest"`',
    "less delay (half)": "half of the delay, newest picture",
    "image shifting": "`shift=True`",
    "prediction": "`predict=True`",
    "prediction and shifting": "`predict=True, shift=True`",
    "delayed video": '`"tracked"`',
}


def collect(data: Data, files: Sequence[Data]) -> Data:
    """Return the content of docs/camera.json: each row with its machine, and the prediction."""
    rows = dict(data.get("rows", {}))
    for facts in files:
        machine = {key: facts["machine"][key] for key in ("processor", "cores", "load", "when")}
        for name, row in facts["rows"].items():
            rows[name] = {"machine": machine, "seed": facts["seed"], **row}
    moving, _ = compare_filters(hands=6)
    return {
        "rows": {row.name: rows[row.name] for row in ROWS if row.name in rows},
        "prediction": [[delay, *row] for delay, row in zip(DELAYS, moving.tolist(), strict=True)],
    }


def figures(row: Data) -> list[Quantity]:
    """Return the figures of a row of the data."""
    return [
        Quantity(**{key: value for key, value in quantity.items() if key != "passed"})
        for quantity in row["figures"]
    ]


def camera(data: Data, _others: Data) -> str:
    """Return a table of all figures: quantity, value and bound; then machine and date."""
    lines = ["| quantity | measured | wanted |", "| --- | ---: | ---: |"]
    places = {}
    for row in ROWS:
        if row.name not in data["rows"]:
            lines.append(f"| **{row.about}** | not measured | |")
            continue
        facts = data["rows"][row.name]
        places.setdefault(json.dumps(facts["machine"]), []).append(row.name)
        if row.name in TABLES_OF_ROWS:
            lines.append(f"| **{row.about}** | {TABLES_OF_ROWS[row.name]} | |")
            continue
        lines.append(f"| **{row.about}** | | |")
        for quantity in figures(facts):
            missed = " (missed)" if quantity.passed is False else ""
            measured = quantity.measured_text + missed
            lines.append(f"| {quantity.quantity} | {measured} | {quantity.wanted_text} |")
    for where, names in places.items():
        m = json.loads(where)
        place = f"{m['processor']}, {m['cores']} cores, load {m['load']}, {m['when']}"
        sentence = f"{', '.join(f'`{name}`' for name in names)}: {place}."
        lines += ["", textwrap.fill(sentence, _LINE_LENGTH, break_on_hyphens=False)]
    return "\n".join([*lines, ""])


def other_cameras(data: Data, _others: Data) -> str:
    """Return a table with a line for each camera and mark, and the bounds in brackets."""
    cameras: dict[tuple[str, str], dict[str, Quantity]] = {}
    for quantity in figures(data["rows"][BY_CAMERA]):
        camera, mark, what = quantity.quantity.split(", ", 2)
        cameras.setdefault((camera, mark), {})[what] = quantity
    columns = next(iter(cameras.values()))
    heads = [
        f"{column}, {quantity.unit}" if quantity.unit else column
        for column, quantity in columns.items()
    ]
    lines = [f"| camera | mark | {' | '.join(heads)} |", "| --- | --- |" + " ---: |" * len(columns)]
    for (camera, mark), cells in cameras.items():
        texts = [_with_bounds(cells.get(column)) for column in columns]
        lines.append(f"| {camera} | {mark} | {' | '.join(texts)} |")
    return "\n".join([*lines, ""])


def _with_bounds(quantity: Quantity | None) -> str:
    """Return a value and its bounds."""
    if quantity is None:
        return ""
    bounds = (
        quantity.wanted_text.removesuffix(quantity.unit).strip().replace(" ", "\N{NO-BREAK SPACE}")
    )
    missed = "; missed" if quantity.passed is False else ""
    return f"{quantity.value:.3g} ({bounds}{missed})"


def prediction(data: Data, _others: Data) -> str:
    """Return a table of the errors of a waving hand by the age of its picture."""
    lines = ["| age | not predicted | predicted |", "| ---: | ---: | ---: |"]
    for delay, *values in data["prediction"]:
        lines.append(
            f"| {1e3 * delay:.0f} ms | {' | '.join(f'{1e3 * value:.1f}' for value in values)} |"
        )
    return "\n".join([*lines, ""])


def latency_options(data: Data, _others: Data) -> str:
    """Return a table of the errors that a delay of 66 ms causes, by remedy."""
    lines = [
        "| what is done | `LatencyOptions` | RMS, px | worst, px |",
        "| --- | --- | ---: | ---: |",
    ]
    values = {quantity.quantity: quantity.value for quantity in figures(data["rows"]["latency"])}
    for name, options in _LATENCY_CASES.items():
        rms = values[f"{name}, RMS"]
        worst = values[f"{name}, worst"]
        lines.append(f"| {name} | {options} | {rms:.1f} | {worst:.1f} |")
    return "\n".join([*lines, ""])


def headlines(data: Data, others: Data) -> str:
    """Return a table for the README, with a few figures and the command of each."""

    def of(row: str, start: str) -> str:
        chosen = [
            quantity
            for quantity in figures(data["rows"][row])
            if quantity.quantity.startswith(start)
        ]
        return " / ".join(f"{quantity.value:.2f}" for quantity in chosen) + f" {chosen[0].unit}"

    cells = {(c["solver"], c["set"]): c for c in others["methods"] if c["robot"] == "puma560"}
    cold = cells["auto", "cold"]
    warm = cells["lm", "warm"]
    bench = "[`robot-ik bench`](docs/reference/performance.md)"
    pictures = "[`make bench-camera`](docs/reference/camera_accuracy.md)"
    spread = f"{cold['median']:.0f} µs median, {cold['mean']:.0f} µs mean"
    rows = [
        ("a PUMA's pose from home (`auto`)", f"{100 * cold['rate']:.0f} % solved; {spread}", bench),
        ("tracking a pose in small steps (`lm`)", f"{warm['median']:.1f} µs median", bench),
        ("a 50 mm marker at 0.3 / 0.6 / 1.0 m, RMS", of("marker", "position"), pictures),
        ("a robot drawn on a 2×2 board at 0.7 / 1.0 m, RMS", _rms(data), pictures),
    ]
    lines = ["| what | measured | command |", "| --- | --- | --- |"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows), ""])


def _rms(data: Data) -> str:
    values = [
        quantity.value
        for quantity in figures(data["rows"]["overlay"])
        if quantity.quantity.endswith("RMS")
    ]
    return " / ".join(f"{value:.2f}" for value in values) + " px"


TABLES: dict[str, Callable[[Data, Data], str]] = {
    make.__name__: make for make in (camera, other_cameras, prediction, latency_options, headlines)
}


def filled(text: str) -> str:
    """Return the text of a page with all its tables filled from the data."""
    data, others = (json.loads(path.read_text(encoding="utf-8")) for path in (DATA, OTHERS))
    return PLACE.sub(lambda m: m[1] + TABLES[m[2]](data, others) + m[4], text)


def main(names: Sequence[str]) -> None:
    """Merge the named files of figures into docs/camera.json and fill the pages."""
    if names:
        data = json.loads(DATA.read_text(encoding="utf-8")) if DATA.exists() else {}
        data = collect(data, [json.loads(Path(name).read_text(encoding="utf-8")) for name in names])
        DATA.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        after = filled(before)
        if after != before:
            page.write_text(after, encoding="utf-8")
            sys.stdout.write(f"wrote {page}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
