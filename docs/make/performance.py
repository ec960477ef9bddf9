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
            "when": peers_file["machine"]["when"],
            "missing": sorted({**peers_file["missing"], **peers_file["failed"]}),
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
        peers[name] = {"versions": library["versions"], "calibration_us": library["calibration_us"]}
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
    """Return contestant -> cold or warm: placo, and ours (`auto` uses `lm` for these goals)."""
    figures = {
        name: library["robots"].get("humanoid") for name, library in peers_file["libraries"].items()
    }
    return {name: figures[name] for name in ("robot_ik", "placo") if figures.get(name)}


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
    """Return machine, versions and time of the measurement."""
    m = data["machine"]
    peers = data["peers"]
    versions: dict[str, str] = {}
    for library in peers.values():
        versions |= library["versions"]
    versions |= m["versions"]
    named = ", ".join(f"{name} {version}" for name, version in sorted(versions.items()))
    speeds = [x for library in peers.values() for x in library["calibration_us"]]
    text = (
        f"{m['processor']}, {m['cores']} cores, {m['system']}, Python {m['python']}; {named}; "
        f"{m['when']}. Between the contestants a loop of plain Python took {min(speeds):.0f} … "
        f"{max(speeds):.0f} µs, which shows how much the speed of the machine varied."
    )
    return textwrap.fill(text, LINE_LENGTH, break_on_hyphens=False) + "\n"


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
        return f"{100 * row['exact']:.1f} / " + " / ".join(us(row[key]) for key in keys) + jumps

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


def ratios(data: Data) -> str:
    """Return the table of our times and those of the best other library, in the same run."""
    peers = data["peers"]
    four = data["four_goals"]

    def line(
        case: str, other: str, theirs: float, mine: float, ours: str = "robot_ik"
    ) -> tuple[str, ...]:
        return case, f"`{other}` {us(theirs)}", f"`{ours}` {us(mine)}", f"{mine / theirs:.2f}"

    rows = []
    for robot in ("puma560", "ur5e"):
        mine = peers["robot_ik"][robot]["cold"]
        theirs = peers["eaik"][robot]["cold"]
        rows.append(
            line(
                f"cold {ROBOTS[robot]}, any method: mean",
                "eaik",
                theirs["mean_us"],
                mine["mean_us"],
            )
        )
    for robot, title in ROBOTS.items():
        mine = peers["robot_ik_lm"][robot]["cold"]
        theirs = peers["rtb_lm"][robot]["cold"]
        for key, statistic in (("mean_us", "mean"), ("p99_us", "p99")):
            case = f"cold {title}, numeric: {statistic}"
            rows.append(line(case, "rtb_lm", theirs[key], mine[key], "robot_ik_lm"))
    for robot, title in ROBOTS.items():
        warm = {
            name: peers[name][robot]["warm"]["median_us"] for name in peers if robot in peers[name]
        }
        best = min(("rtb_lm", "placo"), key=lambda name: warm[name])
        ours = min(("robot_ik", "robot_ik_lm"), key=lambda name: warm[name])
        rows.append(line(f"warm {title}: median", best, warm[best], warm[ours], ours))
    far = {name: peers[name]["puma560"]["unreachable"]["median_us"] for name in peers}
    proof = "robot_ik_analytic"
    rows.append(line("out of reach, proof: median", "eaik", far["eaik"], far[proof], proof))
    rows.append(
        line("out of reach, nearest answer: median", "placo", far["placo"], far["robot_ik"])
    )
    for mode in ("cold", "warm"):
        mine = four["robot_ik"][mode]
        theirs = four["placo"][mode]
        rows.append(
            line(
                f"four goals, humanoid, {mode}: median",
                "placo",
                theirs["median_us"],
                mine["median_us"],
            )
        )
    return table(("case, µs", "best of the others", "ours", "ratio"), rows)


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


def comparison(data: Data) -> str:
    """Return the date, seed, problems and rounds of the comparison."""
    asked = data["comparison"]
    missing = f" Not installed: {', '.join(asked['missing'])}." if asked["missing"] else ""
    return (
        f"Measured {asked['when']}: seed {asked['seed']}, {asked['count']} problems of a kind, "
        f"{asked['rounds']} rounds.{missing} {asked.get('note', '')}".strip()
        + "\n"
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
        ratios,
        peers_cold,
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
