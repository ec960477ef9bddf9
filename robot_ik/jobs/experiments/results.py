"""What the experiments leave behind: ``a00.json``, ``a00.csv``; ``s12.json``, ``s12.csv``, ``s12.png``."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from robot_ik.files import plain, write_atomically
from robot_ik.jobs.experiments import a00, notes, s12
from robot_ik.jobs.experiments.a00 import A00Report
from robot_ik.jobs.experiments.s12 import S12Report
from robot_ik.jobs.experiments.tracking import Track

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
        "choices": notes.A00_CHOICES,
        "tests": [_course(report, number) for number in report.courses],
        "tracks": [
            {"solver": name, "test": number, **_track(track), "lost_at": report.lost_at(name, number) or None}
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
        "choices": notes.S12_CHOICES,
        "differences": notes.S12_DIFFERENCES,
        "not_stated": notes.S12_NOT_STATED,
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
        yield {
            "parameters": variant,
            "method": name,
            "case": number,
            "milliseconds": track.milliseconds,
            "n": s12.steps_of(name, track),
            "solved": track.share,
        }


def _track(track: Track) -> dict[str, Any]:
    return {**asdict(track), "share": None if track.refused else track.share}


def save_a00(report: A00Report, folder: Path) -> list[Path]:
    """Writes what there is; returns the files.

    Raises:
        OutputError: The folder went away or is full.
    """
    summary = a00_summary(report)
    return [_json(folder / "a00.json", summary), _csv(folder / "a00.csv", summary["tracks"])]


def save_s12(report: S12Report, folder: Path, *, plot: bool = False) -> list[Path]:
    """Writes what there is, with ``plot`` (only of a complete table) a picture, too; returns the files.

    Raises:
        OutputError: The folder went away or is full.
        MissingExtraError: A picture without matplotlib.
    """
    summary = s12_summary(report)
    files = [_json(folder / "s12.json", summary), _csv(folder / "s12.csv", summary["tracks"])]
    if plot and report.complete:
        from robot_ik.jobs.experiments.plot import s12_picture

        write_atomically(folder / "s12.png", s12_picture(report))
        files.append(folder / "s12.png")
    return files


def _json(path: Path, summary: dict[str, Any]) -> Path:
    text = json.dumps(plain(summary), indent=2, allow_nan=False, ensure_ascii=False)
    write_atomically(path, text + "\n")
    return path


def _csv(path: Path, rows: list[dict[str, Any]]) -> Path:
    stream = io.StringIO()
    if rows:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    write_atomically(path, stream.getvalue())
    return path
