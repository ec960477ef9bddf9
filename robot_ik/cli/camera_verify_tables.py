"""What ``robot-ik camera verify`` prints: tables for people, JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.cli import console
from robot_ik.cli.camera_arm import numbers_of_seen

if TYPE_CHECKING:
    from robot_ik.camera.arm_zeros.errors import PoseError
    from robot_ik.jobs.verify import VerifyReport


def print_plan(report: VerifyReport) -> None:
    """The joint angles of all stops."""
    rows = console.table("pose", *report.robot.joints, title="planned, degrees")
    for number, q in enumerate(report.stops, 1):
        rows.add_row(str(number), *(f"{math.degrees(v):.1f}" for v in q))
    console.out().print(rows)


def print_report(report: VerifyReport, allowed_mm: float) -> None:
    """Errors of each pose, sums by region, offsets."""
    screen = console.out()
    screen.print(_poses(report))
    screen.print(_regions("the arm as it is", report.judged(corrected=False)))
    if report.by_arm:
        screen.print(
            "The camera's place was found by moving this arm: what all poses are off by alike is in it.\n"
            "Of errors, only what changes from pose to pose shows; see robot-ik camera locate."
        )
    if report.fit is not None:
        screen.print(_offsets(report))
        for one in report.fit.mixtures:
            screen.print(f"{one.words}: {one.joint} is held", soft_wrap=True)
        title = "with these zeros: each pose by the fit to all others"
        screen.print(_regions(title, report.judged(corrected=True)))
    if report.unseen:
        screen.print("board not seen at " + ", ".join(str(k + 1) for k in report.unseen))
    for corrected, words in ((False, "as it is"), (True, "with these zeros"))[: 1 + (report.fit is not None)]:
        largest = 1e3 * max(one.distance for one in report.judged(corrected=corrected))
        verdict = "within" if largest <= allowed_mm else "beyond"
        screen.print(f"largest error {words}: {largest:.2f} mm, {verdict} the allowed {allowed_mm:g} mm")


def _poses(report: VerifyReport) -> Any:
    after = () if report.fit is None else report.fit.errors
    columns = ["pose", "x", "y", "z", "off: mm", "sigma", "deg", "sigma"]
    rows = console.table(*columns, *(("then: mm", "sigma") if after else ()), "", title="poses, mm")
    numbers = numbers_of_seen(len(report.errors), report.unseen)
    for number, one in enumerate(report.errors):
        cells = [str(numbers[number]), *(f"{1e3 * x:.0f}" for x in one.place)]
        cells += [f"{1e3 * one.distance:.2f}", f"{1e3 * one.sigma:.2f}"]
        cells += [f"{math.degrees(one.angle):.3f}", f"{math.degrees(one.sigma_angle):.3f}"]
        if after:
            then = after[number]
            cells += [f"{1e3 * then.distance:.2f}", f"{1e3 * then.sigma:.2f}"]
        rows.add_row(*cells, _doubt(report, number))
    return rows


def _doubt(report: VerifyReport, number: int) -> str:
    if report.fit is not None and number in report.fit.outliers:
        return "contradicts the others: does not count"
    return "measured badly: does not count" if number in report.unsure else ""


def _regions(title: str, errors: Sequence[PoseError]) -> Any:
    from robot_ik.jobs.verify_map import regions

    rows = console.table("board at", "poses", "RMS mm", "median", "max", "RMS deg", "sigma mm", title=title)
    for one in regions(errors):
        rows.add_row(
            one.name, str(one.count), f"{1e3 * one.rms:.2f}", f"{1e3 * one.median:.2f}",
            f"{1e3 * one.largest:.2f}", f"{math.degrees(one.angle):.3f}", f"{1e3 * one.sigma:.2f}",
        )  # fmt: skip
    return rows


def _offsets(report: VerifyReport) -> Any:
    fit = report.fit
    assert fit is not None
    truth = report.true_offsets
    columns = ("joint", "ahead by: deg", "sigma", "true") if truth is not None else ("joint", "deg", "sigma")
    rows = console.table(*columns, title="joint zeros")
    for k, name in enumerate(fit.joints):
        held = name not in fit.found
        cells = [name, f"{math.degrees(fit.offsets[k]):.3f}"]
        cells.append("held" if held else f"{math.degrees(fit.sigma[k]):.3f}")
        rows.add_row(*cells, *(() if truth is None else (f"{math.degrees(truth[k]):.3f}",)))
    return rows


def as_json(report: VerifyReport, verdict: dict[str, Any] | None) -> dict[str, Any]:
    """Everything, in metres and rad; ``verdict`` None for a dry run."""
    found: dict[str, Any] = {
        "schema": 1,
        "job": "verify",
        "robot": report.samples.robot,
        "joints": report.robot.joints,
        "frame": report.frame,
        "stops": [q.tolist() for q in report.stops],
        "unseen": list(report.unseen),
    }
    if verdict is None:
        return found
    found |= verdict
    found["place_by_arm"] = report.by_arm
    found["poses"] = [_error(one) | {"q": q} for one, q in zip(report.errors, report.samples.q, strict=True)]
    found["unsure"] = list(report.unsure)
    found["regions"] = _sums(report.judged(corrected=False))
    fit = report.fit
    if fit is not None:
        found["fit"] = {
            "offsets_rad": fit.offsets,
            "sigma_rad": [float(s) if name in fit.found else None for name, s in _named(report)],
            "true_rad": report.true_offsets,
            "held": [{"joint": one.joint, "why": one.words} for one in fit.mixtures],
            "singular_values": fit.singular_values,
            "joint_noise_rad": fit.joint_noise,
            "residual_px": fit.residual_px,
            "outliers": list(fit.outliers),
            "poses": [_error(one) for one in fit.errors],
            "regions": _sums(report.judged(corrected=True)),
        }
    return found


def _named(report: VerifyReport) -> list[tuple[str, float]]:
    assert report.fit is not None
    return list(zip(report.fit.joints, np.asarray(report.fit.sigma).tolist(), strict=True))


def _error(one: PoseError) -> dict[str, Any]:
    return {
        "place_m": one.place, "off_m": one.vector, "off_rad": one.angle,
        "sigma_m": one.sigma, "sigma_rad": one.sigma_angle,
    }  # fmt: skip


def _sums(errors: Sequence[PoseError]) -> list[dict[str, Any]]:
    from robot_ik.jobs.verify_map import regions

    return [
        {
            "name": one.name, "poses": one.count, "rms_m": one.rms, "median_m": one.median,
            "largest_m": one.largest, "rms_rad": one.angle, "sigma_m": one.sigma,
        }
        for one in regions(errors)
    ]  # fmt: skip
