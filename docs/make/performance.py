"""Write the tables and pictures of performance.md and comparison.md in docs/reference.

They come from the results of docs/make/measure_performance.py:

    python docs/make/performance.py RESULTS    # RESULTS -> performance.json, images, pages
    python docs/make/performance.py            # docs/performance.json -> pages

RESULTS may lack folders (``peers``, ``methods``, ``kernels``, ``batch``). Their earlier results
stay. A table stands between `<!-- measured: NAME -->` and `<!-- end -->`. The tests fail if a table
is out of date.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1]
PAGES = [DOCS / "reference" / name for name in ("performance.md", "comparison.md")]
DATA = DOCS / "performance.json"
IMAGES = DOCS / "images"

LINE_LENGTH = 100
"""Characters of a line of the pages."""

PLACE = re.compile(r"(<!-- measured: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)

ROBOTS = {"puma560": "PUMA 560", "ur5e": "UR5e", "panda": "Panda"}
BENCHES = ("methods", "kernels", "batch")

SOLVES = 0.99
"""Share of problems that a contestant must solve to be compared as the best."""

CLOSED_FORMS = ("robot_ik_analytic", "eaik", "ssik", "rtb_analytic")
"""Contestants that use nothing but a closed form."""

VARIANTS = ("robot_ik_lm", "robot_ik_analytic")
"""Our contestants beside the default."""

NEAREST = ("robot_ik", "placo", "mink", "pink", "pyroki")
"""Contestants whose answer is near a pose out of reach. The others give up."""

PICTURES = {
    "methods/success-puma560.png": "performance-success.png",
    "methods/convergence-puma560.png": "performance-convergence.png",
    "kernels/growth.png": "performance-growth.png",
}


def collect(results: Path) -> dict[str, Any]:
    """Return the data of the page from a folder of results. Copy the pictures to docs/images."""
    from robot_ik.bench.methods.results import Cell, Results

    def summary(cell: Cell) -> dict[str, Any]:
        times = (
            {str(k): round(cell.microsecond(k), 2) for k in ("median", "mean")}
            if cell.count
            else {}
        )
        about = {key: getattr(cell, key) for key in ("solver", "robot", "set", "goal", "count")}
        return about | {"rate": round(cell.rate, 4), **times}

    data: dict[str, Any] = {}
    if (results / "peers").is_dir():
        peers_file = json.loads((results / "peers" / "peers.json").read_text(encoding="utf-8"))
        comparison = {key: peers_file[key] for key in ("count", "rounds", "seconds", "seed")} | {
            "machine": peers_file["machine"],
            "missing": peers_file["missing"] | peers_file["failed"],
        }
        data |= {"comparison": comparison, "peers": collect_peers(peers_file)}
        data["four_goals"] = collect_four_goals(peers_file)
    runs = {
        name: Results.model_validate_json((results / name / "bench.json").read_bytes())
        for name in BENCHES
        if (results / name).is_dir()
    }
    if "methods" in runs:
        data["machine"] = runs["methods"].machine.model_dump()
        data["methods"] = [summary(cell) for cell in runs["methods"].cells]
    if "kernels" in runs:
        data["kernels"] = runs["kernels"].machine.model_dump()
        data["floors"] = [row.model_dump() for row in runs["kernels"].lower_bounds]
        data["growth"] = [row.model_dump() for row in runs["kernels"].growth]
    if "batch" in runs:
        data["batches"] = [row.model_dump() for row in runs["batch"].batches]
    for source, name in PICTURES.items():
        if (results / source).is_file():
            shutil.copy(results / source, IMAGES / name)
    return data


def collect_peers(peers_file: dict[str, Any]) -> dict[str, Any]:
    """Return contestant -> robot -> kind of problem, from the file of `benchmarks.peers`."""
    peers: dict[str, Any] = {}
    for name, library in peers_file["libraries"].items():
        keys = ("versions", "settings", "calibration_us")
        peers[name] = {key: library[key] for key in keys}
        for robot, cells in library["robots"].items():
            if robot in ROBOTS:
                peers[name][robot] = {kind: cells[kind] for kind in ("cold", "warm", "unreachable")}
            if {"wrist", "elbow"} <= set(cells):
                singular = [cells["wrist"], cells["elbow"]]
                peers[name][robot]["singular"] = {
                    "by_kind": {"wrist": singular[0]["success"], "elbow": singular[1]["success"]},
                    "median_us": max(row["median_us"] for row in singular),
                }
    return peers


def collect_four_goals(peers_file: dict[str, Any]) -> dict[str, Any]:
    """Return contestant -> cold or warm. `auto` uses `lm` for these goals."""
    return {
        name: library["robots"]["humanoid"]
        for name, library in peers_file["libraries"].items()
        if "humanoid" in library["robots"] and name != "robot_ik_lm"
    }


Data = dict[str, Any]


def table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """Return a Markdown table. All columns except the first have numbers."""
    first = [str(cell) for cell in head]
    lines = [
        first,
        ["---", *["---:"] * (len(first) - 1)],
        *([str(cell) for cell in row] for row in rows),
    ]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def us(value: float) -> str:
    """Return microseconds with the significant digits."""
    return f"{value:.2f}" if value < 1 else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def machine(data: Data) -> str:
    """Return machine, versions and time of our own benchmarks."""
    return filled_line(on_machine(data["machine"]))


def comparison(data: Data) -> str:
    """Return machine, versions, time and size of the comparison, and what is missing."""
    asked = data["comparison"]
    speeds = [speed for library in data["peers"].values() for speed in library["calibration_us"]]
    text = (
        f"{on_machine(asked['machine'])} Seed {asked['seed']}, {asked['count']} problems of a "
        f"kind, at most {asked['seconds']:g} s for each kind, rounds: {asked['rounds']}. Between "
        f"the contestants a loop of plain Python took {min(speeds):.0f} … {max(speeds):.0f} µs, "
        f"which shows how much the speed of the machine varied."
    )
    names_by_reason: dict[str, list[str]] = {}
    for name, reason in asked["missing"].items():
        names_by_reason.setdefault(reason, []).append(f"`{name}`")
    for reason, names in names_by_reason.items():
        text += f" Not measured: {', '.join(names)} ({reason})."
    return filled_line(f"{text} {asked.get('note', '')}".strip())


def on_machine(about: dict[str, Any]) -> str:
    """Return a sentence about a machine: processor, versions, time and load."""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    return (
        f"{about['processor']}, {about['cores']} cores, {about['system']}, Python "
        f"{about['python']}; {versions}; {about['when']}. The load average before was "
        f"{about['load']:.1f}."
    )


def filled_line(text: str, indent: str = "") -> str:
    """Return a paragraph in lines of the length of the page."""
    return (
        textwrap.fill(
            text,
            LINE_LENGTH,
            break_on_hyphens=False,
            break_long_words=False,
            subsequent_indent=indent,
        )
        + "\n"
    )


def contestants(data: Data) -> str:
    """Return a list of the contestants with versions and settings."""
    lines = []
    for name, library in data["peers"].items():
        first = next(iter(library["versions"].items()))
        commits = [(k, v) for k, v in library["versions"].items() if v.startswith("commit")]
        versions = ", ".join(f"{key} {version}" for key, version in [first, *commits])
        lines.append(filled_line(f"* `{name}`: {versions}; {library['settings']}", "  "))
    return "".join(lines)


def peers_cold(data: Data) -> str:
    """Return the table of cold poses for all contestants."""
    return peers_table(data, "cold", ("median_us", "mean_us", "p99_us"))


def peers_warm(data: Data) -> str:
    """Return the table of warm poses for all contestants."""
    return peers_table(data, "warm", ("median_us", "mean_us", "p99_us"))


def peers_table(data: Data, mode: str, keys: tuple[str, ...]) -> str:
    """Return the table of contestants and robots for a kind of problem."""

    def cell(library: Data, robot: str) -> str:
        row = library.get(robot, {}).get(mode)
        if row is None:
            return "-"
        jumps = f", {row['jumps']} jumps" if row["jumps"] else ""
        return f"{100 * row['success']:.1f} / " + " / ".join(us(row[key]) for key in keys) + jumps

    rows = [
        (f"`{name}`", *(cell(library, robot) for robot in ROBOTS))
        for name, library in data["peers"].items()
    ]
    return table(("contestant", *ROBOTS.values()), rows)


def peers_edge(data: Data) -> str:
    """Return the table of exactly singular targets and targets out of reach, for the PUMA."""

    def row(name: str, library: Data) -> tuple[str, ...]:
        singular = library["puma560"]["singular"]
        far = library["puma560"]["unreachable"]
        kinds = [f"{100 * share:.0f}" for share in singular["by_kind"].values()]
        return (f"`{name}`", *kinds, us(singular["median_us"]), us(far["median_us"]))

    head = (
        "contestant",
        "wrist, %",
        "elbow, %",
        "median µs",
        "out of reach: median µs until it gives up",
    )
    return table(head, [row(name, library) for name, library in data["peers"].items()])


def peers_exact(data: Data) -> str:
    """Cold poses within the tolerance itself, where fewer are than within 1 mm and 1 degree."""
    rows = []
    for name, library in data["peers"].items():
        cells = [library.get(robot, {}).get("cold") for robot in ROBOTS]
        if any(cell and cell["exact"] < cell["success"] for cell in cells):
            shown = [f"{100 * cell['exact']:.1f}" if cell else "-" for cell in cells]
            rows.append((f"`{name}`", *shown))
    return table(("within 1e-6 m and 1e-6 rad, %", *ROBOTS.values()), rows)


def ratios(data: Data) -> str:
    """Return the table of our times and those of the best other library, in the same run."""
    peers = data["peers"]
    any_method = {name: peers[name] for name in peers if name not in VARIANTS}
    numeric_names = [name for name in peers if name not in CLOSED_FORMS]
    rows = []
    for robot, title in ROBOTS.items():
        case = f"cold {title}, any method: mean"
        rows.append(ratio(case, of_set(any_method, robot, "cold"), "mean_us"))
    for robot, title in ROBOTS.items():
        numeric = of_set({name: peers[name] for name in numeric_names}, robot, "cold")
        numeric.pop("robot_ik", None)  # it uses the closed form if there is one
        for key, statistic in (("mean_us", "mean"), ("p99_us", "p99")):
            rows.append(ratio(f"cold {title}, numeric: {statistic}", numeric, key))
    for robot, title in ROBOTS.items():
        rows.append(ratio(f"warm {title}: median", of_set(peers, robot, "warm"), "median_us"))
    far = {name: library["puma560"]["unreachable"] for name, library in peers.items()}
    closed = {name: cell for name, cell in far.items() if name in CLOSED_FORMS}
    nearest = {name: cell for name, cell in far.items() if name in NEAREST}
    rows.append(ratio("out of reach, closed form: median", closed, "median_us"))
    rows.append(ratio("out of reach, nearest answer: median", nearest, "median_us"))
    for mode in ("cold", "warm"):
        cells = {name: modes[mode] for name, modes in data["four_goals"].items()}
        rows.append(ratio(f"four goals, humanoid, {mode}: median", cells, "median_us"))
    return table(("case, µs", "best of the others", "ours", "ratio"), rows)


def of_set(peers: Data, robot: str, kind: str) -> Data:
    """Return the cells of the contestants that solve a set of problems often enough."""
    cells = {name: library.get(robot, {}).get(kind) for name, library in peers.items()}
    return {name: cell for name, cell in cells.items() if cell and cell["success"] >= SOLVES}


def ratio(case: str, cells: Data, key: str) -> tuple[str, ...]:
    """Return a row: the fastest of the others, the fastest of ours, and the ratio of times."""
    best = {}
    for is_ours in (False, True):
        names = [name for name in cells if name.startswith("robot_ik") is is_ours]
        best[is_ours] = min(names, key=lambda name: cells[name][key])
    theirs = cells[best[False]][key]
    mine = cells[best[True]][key]
    return (
        case,
        f"`{best[False]}` {us(theirs)}",
        f"`{best[True]}` {us(mine)}",
        f"{mine / theirs:.2f}",
    )


def goals4(data: Data) -> str:
    """Return the table of four position goals on the humanoid."""
    rows = []
    for name, modes in data["four_goals"].items():
        cells = []
        for mode in ("cold", "warm"):
            m = modes[mode]
            times = " / ".join(us(m[key]) for key in ("median_us", "mean_us", "p99_us"))
            cells += [f"{100 * m['success']:.1f}", times]
        rows.append((f"`{name}`", *cells))
    shape = ("%", "median / mean / p99 µs")
    return table(
        (
            "contestant",
            *(f"{mode}: {statistic}" for mode in ("cold", "warm") for statistic in shape),
        ),
        rows,
    )


def batch(data: Data) -> str:
    """Return the table of solves per second."""
    rows = [
        (
            f"`{b['solver']}`",
            b["poses"],
            b["threads"],
            f"{b['per_second']:.0f}",
            f"{100 * b['success']:.2f}",
        )
        for b in data["batches"]
    ]
    return table(("method", "poses", "cores", "solves/s", "solved %"), rows)


def floors(data: Data) -> str:
    """Return the table of the times of the kinematics alone."""
    rows = [
        (ROBOTS[f["robot"]], f["joints"], us(f["forward_us"]), us(f["jacobian_us"]))
        for f in data["floors"]
    ]
    return table(("robot", "joints", "forward, µs", "forward + Jacobian, µs"), rows)


def kernels(data: Data) -> str:
    """Return date and machine of kinematics and growth, which can be measured separately."""
    m = data["kernels"]
    return f"{m['processor']}, {m['cores']} cores, {m['when']}; load {m['load']:.1f} before.\n"


def growth(data: Data, across: str) -> str:
    """Return a table of times: methods by sizes."""
    points = [point for point in data["growth"] if point["across"] == across]
    sizes = sorted({point["size"] for point in points})
    rows = []
    for solver in dict.fromkeys(point["solver"] for point in points):
        mine = {p["size"]: p["step_us"] for p in points if p["solver"] == solver}
        rows.append((f"`{solver}`", *(us(mine[n]) if n in mine else "-" for n in sizes)))
    return table((f"µs a step, {across}:", *sizes), rows)


def methods(data: Data) -> str:
    """Return the table of all methods on the PUMA."""
    sets = ("cold", "warm", "singular", "limits")
    cells = {(c["solver"], c["set"]): c for c in data["methods"] if c["robot"] == "puma560"}
    rows = []
    for solver in dict.fromkeys(c["solver"] for c in data["methods"]):
        mine = [cells.get((solver, name)) for name in sets]
        cell = "{:.1f} / {} / {}".format
        shown = [
            cell(100 * c["rate"], us(c["median"]), us(c["mean"])) if c and c["count"] else "-"
            for c in mine
        ]
        goal = mine[0]["goal"] if mine[0] else ""
        rows.append((f"`{solver}`" + (" (position)" if goal == "position" else ""), *shown))
    return table(("method", *sets), rows)


TABLES: dict[str, Callable[[Data], str]] = {
    make.__name__: make
    for make in (
        machine,
        comparison,
        contestants,
        ratios,
        peers_cold,
        peers_exact,
        peers_warm,
        peers_edge,
        goals4,
        batch,
        floors,
        kernels,
        methods,
    )
}
TABLES["growth_joints"] = lambda data: growth(data, "joints")
TABLES["growth_goals"] = lambda data: growth(data, "goals")


def filled(text: str, data: Data) -> str:
    """Return the page with all tables filled from the data."""
    return PLACE.sub(lambda m: m[1] + TABLES[m[2]](data) + m[4], text)


def write_pages() -> None:
    """Write the tables of docs/performance.json into the pages."""
    data = json.loads(DATA.read_text(encoding="utf-8"))
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8"), data), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        data = json.loads(DATA.read_text(encoding="utf-8")) | collect(Path(sys.argv[1]))
        lines = [f"{json.dumps(k)}: {json.dumps(v)}" for k, v in data.items()]
        DATA.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    write_pages()
