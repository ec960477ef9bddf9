"""Draw how each method converges: `python docs/make/plots.py [METHOD ...]`.

It writes docs/images/solvers/METHOD.png, by default of all methods. Steps are counted and nothing
is timed, so the same program draws the same picture. Needs matplotlib (the extra `plots`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.solvers import SOLVERS

Array = NDArray[np.float64]

FOLDER = Path(__file__).resolve().parents[1] / "images" / "solvers"
# Targets of a curve; each is the pose at random joint angles, so each can be reached.
COUNT = 100
# Tight enough to show how a method ends: 1 µm and 1 µrad.
TOLERANCE = rik.Tolerance(position=1e-6, angle=1e-6)
BUDGET = rik.Budget(iterations=3000)
# The right edge of both panels, steps.
_STEPS = 3000
_BALLS = 7
_BALL_LENGTH = 0.15
# Number of thin lines on the left.
_THIN = 25
# Number of colours of a picture.
_COLOURS = 64


@dataclass(frozen=True)
class Task:
    """A task for a method: a kind of goal on a robot.

    Attributes:
        label: Text of the legend.
        colour: Colour of the curve, the same in all pictures.
        robot: Function that makes the robot.
        pose: Whether the goal has an orientation.
    """

    label: str
    colour: str
    robot: Callable[[], rik.Robot]
    pose: bool


def _chain() -> rik.Robot:
    return rik.make_chain(_BALLS, length=_BALL_LENGTH)


TASKS = (
    Task("PUMA 560, pose", "#1f5fa8", lambda: rik.load_robot("puma560"), True),
    Task("PUMA 560, position", "#e07b1f", lambda: rik.load_robot("puma560"), False),
    Task("chain of 7 balls, position", "#3a9a4e", _chain, False),
)


@dataclass(frozen=True)
class Curves:
    """Result of a method on one task.

    Attributes:
        task: The task.
        residuals: Smallest residual so far, rad, (steps + 1,) for each target, beginning at the
            start.
        steps: (COUNT,) steps to each target; inf if it was not reached.
    """

    task: Task
    residuals: tuple[Array, ...]
    steps: Array


def curves(name: str, task: Task, count: int = COUNT) -> Curves | None:
    """Run a method from home to ``count`` seeded targets. None if it does not support the task."""
    robot = task.robot()
    rng = np.random.default_rng(7)
    pose = robot.forward(robot.home)
    goal = rik.PoseGoal.at(None, pose) if task.pose else rik.PositionGoal(None, pose.position)
    try:
        problem = rik.Problem(
            robot, goal, solver=name, tolerance=TOLERANCE, budget=BUDGET, trace=True
        )
    except rik.RobotIkError:
        return None
    residuals = []
    steps = []
    for _ in range(count):
        target = robot.forward(robot.sample(rng))
        problem.retarget(target if task.pose else target.position)
        metres, radians = pose.distance(target)
        weight = problem.compiled.block.arrays["weight"][0]
        first = np.hypot(weight[0] * metres, weight[1] * radians)
        solution = problem.solve(robot.home)
        rows = np.array([row.cost for row in solution.trace])
        residuals.append(np.minimum.accumulate([first, *np.sqrt(2.0 * rows)]))
        steps.append(float(solution.iterations) if solution.converged else np.inf)
    return Curves(task, tuple(residuals), np.array(steps))


def draw(name: str, path: Path, count: int = COUNT) -> None:
    """Draw the picture of a method.

    Args:
        name: Name of the method in ``SOLVERS``.
        path: PNG file to write.
        count: Number of targets of each task.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    measured = [c for task in TASKS if (c := curves(name, task, count)) is not None]
    style: Any = {
        "font.size": 8.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
    }
    with plt.rc_context(style):
        figure, (left, right) = plt.subplots(1, 2, figsize=(7.6, 2.9), layout="constrained")
        # The hardest task with at least half of the targets reached. TASKS has the hardest first.
        shown = next((c for c in measured if np.isfinite(c.steps).mean() >= 0.5), measured[-1])
        _draw_descents(left, shown)
        _draw_shares(right, measured)
        figure.legend(
            *right.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
        )
        figure.canvas.draw()
        pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
        plt.close(figure)
    _save(pixels, path)


def _save(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write a PNG of few colours, which has a third of the size."""
    from PIL import Image

    Image.fromarray(pixels).quantize(_COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def _frame(axes: Any, title: str, label: str) -> None:
    axes.set_xscale("symlog", linthresh=1, linscale=0.4)
    axes.set_xlim(0, _STEPS)
    axes.set_xticks([0, 1, 10, 100, 1000], ["0", "1", "10", "100", "1000"])
    axes.set_xlabel("steps")
    axes.set_ylabel(label)
    axes.set_title(title, loc="left", fontsize=9)
    axes.grid(color="#e4e4e4", linewidth=0.6)


def _draw_descents(axes: Any, curve: Curves) -> None:
    """Draw the smallest residual so far of each target, and the median of all."""
    for residual in curve.residuals[:_THIN]:
        axes.plot(residual, color=curve.task.colour, alpha=0.3, linewidth=0.8)
    half = np.median(curve.steps)
    length = int(min(_STEPS, half, max(map(len, curve.residuals)) - 1)) + 1
    table = np.array(
        [np.pad(r[:length], (0, max(0, length - len(r))), mode="edge") for r in curve.residuals]
    )
    axes.plot(np.median(table, axis=0), color=curve.task.colour, linewidth=2.4)
    _frame(axes, curve.task.label, "residual, best so far")
    axes.set_yscale("log")
    axes.set_ylim(1e-8, 10)


def _draw_shares(axes: Any, measured: Iterable[Curves]) -> None:
    """Draw the share of targets that are reached within a number of steps."""
    for curve in measured:
        steps = np.sort(curve.steps[np.isfinite(curve.steps)])
        share = 100 * np.arange(1, len(steps) + 1) / len(curve.steps)
        x = [0.0, *steps, _STEPS]
        y = [0.0, *share, share[-1] if len(share) else 0.0]
        axes.step(
            x, y, where="post", color=curve.task.colour, linewidth=1.8, label=curve.task.label
        )
    _frame(axes, "reached to 1 µm and 1 µrad", "% of targets")
    axes.set_ylim(-2, 104)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for method in sys.argv[1:] or list(SOLVERS):
        draw(method, FOLDER / f"{method}.png")
        sys.stdout.write(f"wrote {FOLDER / method}.png\n")
