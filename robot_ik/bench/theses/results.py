"""What the experiments leave behind: ``a00.json``, ``a00.csv``; ``s12.json``, ``s12.csv``, ``s12.png``."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from robot_ik.bench.theses import a00, s12
from robot_ik.bench.theses.a00 import A00Report
from robot_ik.bench.theses.s12 import S12Report
from robot_ik.files import write_atomically
from robot_ik.jobs.results import save_json

# ------------------------------------------------------------------------------------------
# What has to be said beside the numbers: what is chosen, what differs, what the theses do not state.


A00_CHOICES = (
    *a00.SHARED,
    "tolerance 0.1 mm and 1 mrad (his: 0.5 length units and at most 16 iterations)",
    "each goal has a witness: the chain is drawn to it (a circular arc; the last link as the orientation "
    "says), or, in test 13, the goal is made from joint angles; MuJoCo's forward pass checks it",
    "a frame counts where MuJoCo's forward pass finds the goal met",
)

S12_CHOICES = (
    "model: seven_segment, 7 segments of 1 m, three hinges a joint (21); limits, where there are any: "
    f"±{s12.LIMIT:g}° about x and z, the twist free",
    f"curve: segment 1 upright, twisted once round in {s12.LAP} frames; joints 2 to 7 bent alike about x, "
    f"by {s12.BEND:g}° + {s12.WAVE:g}° sin {s12.WAVES}φ: a closed wave round the arm",
    "random: where random joint angles (inside the limits of the case, else ±180°) put the tip, a new one "
    "each frame",
    "so each target has a witness; each frame starts from the last answer, the first from its witness",
    "a frame counts where MuJoCo's forward pass finds the tip within 0.05 m",
)

S12_DIFFERENCES = (
    "t: a compiled kernel on a machine of today against a program of 2012; the unit ms is assumed for his",
    "N: of ccd, turns of single bones; here a sweep turns 21 hinges and counts as 7",
    "ccd solves more: each hinge takes its exact optimum inside its limits, and all targets can be reached",
    f"α = {s12.ALPHA:g}, read as the share of a step that is taken: an exact step then leaves 99 % of the "
    "way, 100 of them 37 %, so that only what begins within 0.14 m can end within 0.05 m. Hence nearly 0 % "
    "of random targets. His 15 and 47 % of transpose and pseudoinverse cannot come from α so read, his 0 % "
    "of dls can",
    f"so α is also read in degrees, {s12.IN_DEGREES:.3f} of a step in radians: then nearly all is solved, "
    "more than his. Neither reading gives his table",
    f"dls: λ = {s12.LAMBDA:g} in metres, as in his equation, with our segments of 1 m; his are unknown. A "
    "longest step shortens the whole step here, so that its direction stays",
    "Jacobian: 21 real hinges here; he gives each bone one axis, (s - p) × (t - p), chosen anew at each "
    "step. The target is in the Jacobian as in his (the option alternative)",
    "cases 3 and 4: here a joint at its limit leaves the step to the others, and his share drops far more "
    "than ours",
    "no restarts in the two columns of his parameters; with ours, methods may restart",
)

S12_NOT_STATED = (
    "the lengths of the segments",
    "the curve, and the pace along it",
    "the box of the random targets, and how many of them can be reached at all",
    "the joints' freedoms, and how the Jacobian methods keep inside the limits",
    "the units of t and of α",
    "whether and where e is clamped (ClampMag)",
    "from where each solve starts",
)


#: Version of the JSON files; raised when a field changes its meaning.
SCHEMA = 1


def a00_summary(report: A00Report) -> dict[str, Any]:
    """The content of ``a00.json``: metres, radians, shares of 1, milliseconds."""
    return {
        "schema": SCHEMA,
        "experiment": "a00",
        "complete": report.complete,
        "passed": report.passed,
        "seed": report.seed,
        "tolerance_position_m": a00.TOLERANCE.position,
        "tolerance_angle_rad": a00.TOLERANCE.angle,
        "must_pass": [name for name in a00.MUST_PASS if name in report.solvers],
        "choices": A00_CHOICES,
        "tests": [_course(report, number) for number in report.courses],
        "tracks": [
            {
                "solver": name,
                "test": number,
                **asdict(track),
                "share": None if track.refused else track.share,
                "lost_at": report.lost_at(name, number) or None,
            }
            for (name, number), track in report.tracks.items()
        ],
    }


def _course(report: A00Report, number: int) -> dict[str, Any]:
    course = report.courses[number]
    metres, radians = report.witness_miss[number]
    return {
        "test": number,
        "joints": len(course.robot.joints),
        "goal": course.goal.name,
        "moves": course.moves,
        "frames": len(course.at),
        "witness_miss_position_m": metres,
        "witness_miss_angle_rad": radians,
        "his_result": a00.HIS[number],
    }


def s12_summary(report: S12Report) -> dict[str, Any]:
    """The content of ``s12.json``: metres, shares of 1, milliseconds."""
    return {
        "schema": SCHEMA,
        "experiment": "s12",
        "complete": report.complete,
        "passed": report.passed,
        "seed": report.seed,
        "frames": report.frames,
        "tolerance_position_m": s12.TOLERANCE.position,
        "must_pass": s12.MUST_PASS,
        "choices": S12_CHOICES,
        "differences": S12_DIFFERENCES,
        "not_stated": S12_NOT_STATED,
        "cases": [
            {"case": case.number, "title": case.title, "witness_miss_m": report.witness_miss[case.number]}
            for case in s12.CASES
            if case.number in report.witness_miss
        ],
        "tracks": list(s12_rows(report)),
    }


def s12_rows(report: S12Report) -> Iterable[dict[str, Any]]:
    """His cells, then ours: parameters, method, case, t (ms), N, η (share)."""
    for name, cells in s12.HIS.items():
        for number, (t, n, eta) in enumerate(cells, 1):
            row = {"parameters": "S12", "method": name, "case": number}
            yield row | {"milliseconds": t, "n": n, "solved": eta / 100.0}
    for (variant, name, number), track in report.tracks.items():
        row = {"parameters": variant, "method": name, "case": number}
        steps = s12.steps_of(name, track)
        yield row | {"milliseconds": track.milliseconds, "n": steps, "solved": track.share}


def save_a00(report: A00Report, folder: Path) -> list[Path]:
    """Writes what there is; returns the files.  OutputError: the folder went away or is full."""
    summary = a00_summary(report)
    return [save_json(folder / "a00.json", summary), _csv(folder / "a00.csv", summary["tracks"])]


def save_s12(report: S12Report, folder: Path, *, plot: bool = False) -> list[Path]:
    """Writes what there is, with ``plot`` (only of a complete table) a picture, too; returns the files.

    Raises:
        OutputError: The folder went away or is full.
        MissingExtraError: A picture without matplotlib.
    """
    summary = s12_summary(report)
    files = [save_json(folder / "s12.json", summary), _csv(folder / "s12.csv", summary["tracks"])]
    if plot and report.complete:
        write_atomically(folder / "s12.png", s12.s12_picture(report))
        files.append(folder / "s12.png")
    return files


def _csv(path: Path, rows: list[dict[str, Any]]) -> Path:
    stream = io.StringIO()
    if rows:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    write_atomically(path, stream.getvalue())
    return path
