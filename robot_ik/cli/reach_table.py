"""The compact table of a reach on the terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from rich.text import Text

from robot_ik.cli import console
from robot_ik.errors import apart

if TYPE_CHECKING:
    from robot_ik.jobs.limbs import JointLimits
    from robot_ik.jobs.reach_report import ReachReport


def print_report(report: ReachReport) -> None:
    """The compact table of a reach."""
    screen = console.out()
    _print_limits(report, screen)
    rows = console.table("reach", report.robot.file.title or report.robot.name)
    for name, text in _rows(report):
        rows.add_row(name, Text(text))
    verdict = report.decision
    word = ("REACHED", "bold green") if verdict.reached else ("NOT REACHED", "bold red")
    rows.add_row("result", Text.assemble(word, f"  {verdict.text}" if verdict.text else ""))
    screen.print(rows)


def _rows(report: ReachReport) -> list[tuple[str, str]]:
    return [*_goal_rows(report), *_solve_rows(report), *_motion_rows(report), *_judgement_rows(report)]


def _goal_rows(report: ReachReport) -> list[tuple[str, str]]:
    rows = []
    seen = report.seen
    if seen is not None:
        rows.append((f"marker {seen.observation.id}", f"seen at {_mm(seen.pose_world_marker.position)} mm"))
        if seen.true_pose is not None:
            metres, radians = seen.pose_world_marker.distance(seen.true_pose)
            text = (
                f"true at {_mm(seen.true_pose.position)} mm; "
                f"seen {1e3 * metres:.2f} mm, {math.degrees(radians):.2f}° off"
            )
            rows.append(("", text))
        elif report.eyes is not None:
            pose = seen.observation.pose
            quaternion = " ".join(f"{v:.4f}" for v in pose.wxyz)
            rows.append(("", f"in the camera's frame {_mm(pose.position)} mm, wxyz {quaternion}"))
    if report.target is not None:
        free = getattr(report.goal, "free_axis", None)
        axis = f", {free} axis as seen, free to turn about it" if free else ""
        rows.append(("goal", f"{report.frame} at {_mm(report.target.position)} mm{axis}"))
    return rows


def _solve_rows(report: ReachReport) -> list[tuple[str, str]]:
    solution = report.solution
    if solution is None:
        return []
    steps = f"{solution.iterations} iteration{'s' if solution.iterations != 1 else ''}"
    restarts = f", {solution.restarts} restarts" if solution.restarts else ""
    took = f", {report.microseconds:.0f} µs" if report.microseconds is not None else ""
    miss = solution.miss
    return [
        ("solver", f"{solution.solver}: {solution.status.name.lower()}, {steps}{restarts}{took}"),
        ("its miss", f"{1e3 * miss.position:.4f} mm, {math.degrees(miss.angle):.4f}°  (by MuJoCo)"),
    ]


def _motion_rows(report: ReachReport) -> list[tuple[str, str]]:
    rows = []
    run, following = report.execution, report.following
    if run is not None:
        text = f"{run.duration:.2f} s"
        if run.tracking_error is not None:
            worst = int(run.tracking_error.argmax())
            error = math.degrees(float(run.tracking_error[worst]))
            text += f"; largest tracking error {error:.2f}° ({run.joints[worst]})"
        rows.append(("motion", text))
    if following is not None:
        text = f"{following.duration:.1f} s; {following.held} of {following.ticks} ticks without a goal"
        rows.append(("following", text))
    if report.behind is not None:
        median, largest = (1e3 * metres for metres in report.behind)
        rows.append(("", f"tool from the goal seen: median {median:.1f} mm, largest {largest:.1f} mm"))
    delays = None if report.eyes is None else report.eyes.delays
    if delays is not None and delays[1].count:
        made, used = delays
        ready = f"goal after {made}; " if made.count else ""
        rows.append(("delay", f"{ready}age of the picture at a tick {used}"))
    if report.counters:
        rates = [f"{part.rate:.1f} Hz" for part in (run, following) if part is not None]
        counts = ", ".join(
            f"{report.counters[name]} {name}"
            for name in ("cycles", "timeouts", "corrupt", "retries", "alerts")
        )
        rows.append((f"bus {_shortened(report.request.bus)}", "; ".join([*rates, counts])))
    return rows


def _shortened(bus: str) -> str:
    """The last part of a port's path: the column of names stays narrow."""
    return bus.rsplit("/", 1)[-1]


def _judgement_rows(report: ReachReport) -> list[tuple[str, str]]:
    rows = []
    if report.read_back is not None:
        judged = report.read_back
        why = "servo ticks" if report.limbs.arm is not None else "tolerance of the solver"
        if judged.sigma.position > 0.0:
            why = f"3 σ of the goal + {why}"
        rows.append(("read back", f"{_judged(judged)} ({why})"))
    if report.by_camera is not None:
        judged = report.by_camera
        ticks = "ticks" if report.limbs.arm is not None else "tolerance"
        sigma = f"σ {1e3 * judged.sigma.position:.2f} mm {math.degrees(judged.sigma.angle):.2f}°"
        rows.append(("camera", f"{_judged(judged)} (3 σ + {ticks}, {sigma})"))
    return rows


def _print_limits(report: ReachReport, screen: Any) -> None:
    rows = console.table("joint", "limits used", "narrowed by")
    for limit in report.limbs.limits:
        rows.add_row(limit.joint, _range(limit.used, limit.unit), _narrowed(limit))
    screen.print(rows)
    screen.print()


def _narrowed(limit: JointLimits) -> str:
    """Which side gave way to the servo, and what the model alone would allow."""
    sides = [
        f"{name} end by the servo (model: {_limit(model, limit.unit)})"
        for name, model, used in zip(("lower", "upper"), limit.model, limit.used, strict=True)
        if abs(model - used) > 1e-9
    ]
    return ", ".join(sides) or ("-" if limit.servo is not None else "")


def _range(pair: tuple[float, float], unit: str) -> str:
    return " … ".join(_limit(value, unit) for value in pair)


def _limit(value: float, unit: str) -> str:
    if math.isinf(value):
        return "free"
    return f"{value:.3f} m" if unit == "m" else f"{math.degrees(value):.1f}°"


def _mm(position: Any) -> str:
    return " ".join(f"{1e3 * float(v):.1f}" for v in position)


def _judged(judged: Any) -> str:
    mm, most_mm = apart(1e3 * judged.position, 1e3 * judged.allowed.position, digits=2)
    deg, most_deg = apart(math.degrees(judged.angle), math.degrees(judged.allowed.angle), digits=2)
    return f"{mm} mm, {deg}°; allowed {most_mm} mm, {most_deg}°"
