"""Tune the parameters of the walk by an evolution strategy against the rows of the benchmark.

    python -m benchmarks.figure.tune_gait [--generations N] [--seed N]

Every candidate walks 5 m and is judged as in ``python -m benchmarks.figure``. The cost is the
violation of the rows, with a margin, and the distance of the joint curves from the norm. The
strategy is CMA-ES (Hansen, *The CMA evolution strategy: a tutorial*, 2016). It begins at the walk
of ``gait.WALK`` and prints the fields of the best gait. Ctrl-C prints the best so far.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from benchmarks.figure.gait import measure_gait
from benchmarks.figure.motion import measure_motion
from benchmarks.figure.rows import motion_rows, walk_quantities
from benchmarks.quantity import Quantity
from robot_ik.errors import RobotIkError
from robot_ik.figure.figure import Figure, load_figure
from robot_ik.figure.footprints import prints_of, walk_prints
from robot_ik.figure.gait import WALK, Gait
from robot_ik.figure.walk import walk
from robot_ik.ports import Array

FIXED = ("gap", "toe_out_deg", "lean_deg", "swing_deg")
"""Fields that the tuner does not change: the rows do not judge them."""

_FAILED = 1e3
"""Cost of a gait that cannot be walked."""


@dataclass(frozen=True)
class TuneOptions:
    """Numbers of the tuner.

    Attributes:
        generations: Number of generations.
        seed: Seed of the candidates.
        step: Standard deviation of the first candidates, as a share of each field.
        min_scale: Smallest scale of a field. A field near zero changes by this.
        margin: Share of a bound by which a row must keep it, so that rounding does not decide.
        curve_weight: Weight of the distance from the norm.
    """

    generations: int = 100
    seed: int = 0
    step: float = 0.02
    min_scale: float = 0.05
    margin: float = 0.002
    curve_weight: float = 0.01


TUNED = tuple(item.name for item in fields(Gait) if item.name not in FIXED)
"""Fields that the tuner changes."""


def cost(figure: Figure, gait: Gait, options: TuneOptions) -> float:
    """Return the cost of a gait. 0 would keep every row with its margin on the norm itself."""
    goal = np.array([5.0, 0.0, 0.0])
    try:
        prints = walk_prints(figure, prints_of(figure, figure.home), goal, gait)
        result = walk(figure, figure.home, prints, gait)
        measure = measure_motion(figure, result.frames.q, result.contact)
        judged = measure_gait(figure, result)
    except (RobotIkError, ValueError, IndexError, np.linalg.LinAlgError):
        return _FAILED
    quantities = [quantity for _, quantity in motion_rows("walk", measure)]
    quantities += walk_quantities(measure, judged)
    total = sum(violation(quantity, options.margin) ** 2 for quantity in quantities)
    distance = sum(judged.rms_deg.values())
    value = total + options.curve_weight * distance
    return value if math.isfinite(value) else _FAILED


def violation(quantity: Quantity, margin: float) -> float:
    """Return by which share of its bound a row misses the bound with a margin."""
    missed = 0.0
    for bound, sign in ((quantity.most, 1.0), (quantity.least, -1.0)):
        if bound is not None:
            scale = max(abs(bound), 1.0)
            missed = max(missed, sign * (quantity.value - bound) / scale + margin)
    return missed


def minimise(
    function: Callable[[Array], float],
    x: Array,
    scales: Array,
    *,
    generations: int,
    seed: int,
) -> Iterator[tuple[Array, float]]:
    """Yield the best point and its value after each generation of CMA-ES.

    Args:
        function: Function of a point (n,).
        x: (n,) first mean.
        scales: (n,) standard deviations of the first generation.
        generations: Number of generations.
        seed: Seed of the candidates.
    """
    rng = np.random.default_rng(seed)
    size = len(x)
    candidates = 4 + int(3 * math.log(size))
    parents = candidates // 2
    weights = math.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    effective = 1.0 / float((weights**2).sum())

    # Learning rates of the tutorial: of the step size, of its path, of the covariance.
    step_rate = (effective + 2) / (size + effective + 5)
    damping = 1 + 2 * max(0.0, math.sqrt((effective - 1) / (size + 1)) - 1) + step_rate
    path_rate = (4 + effective / size) / (size + 4 + 2 * effective / size)
    rank_one = 2 / ((size + 1.3) ** 2 + effective)
    rank_mu = min(1 - rank_one, 2 * (effective - 2 + 1 / effective) / ((size + 2) ** 2 + effective))
    expected_norm = math.sqrt(size) * (1 - 1 / (4 * size) + 1 / (21 * size**2))

    mean = np.zeros(size)
    step = 1.0
    covariance = np.eye(size)
    step_path = np.zeros(size)
    path = np.zeros(size)
    best = x.copy()
    best_value = function(x)
    for generation in range(1, generations + 1):
        values, axes = np.linalg.eigh(covariance)
        lengths = np.sqrt(np.maximum(values, 1e-20))
        draws = rng.standard_normal((candidates, size)) * lengths @ axes.T
        points = mean + step * draws
        costs = np.array([function(x + scales * point) for point in points])
        order = np.argsort(costs, kind="stable")[:parents]
        if costs[order[0]] < best_value:
            best = x + scales * points[order[0]]
            best_value = float(costs[order[0]])

        change = weights @ draws[order]
        mean = mean + step * change
        whitened = axes @ ((axes.T @ change) / lengths)
        rate = math.sqrt(step_rate * (2 - step_rate) * effective)
        step_path = (1 - step_rate) * step_path + rate * whitened
        norm = float(np.linalg.norm(step_path))
        limit = 1.4 + 2 / (size + 1)
        expected = math.sqrt(1 - (1 - step_rate) ** (2 * generation))
        is_normal = norm / expected < limit * expected_norm
        path = (1 - path_rate) * path
        if is_normal:
            path = path + math.sqrt(path_rate * (2 - path_rate) * effective) * change
        old_share = 1 - rank_one - rank_mu
        if not is_normal:
            old_share += rank_one * path_rate * (2 - path_rate)
        spread = (weights[:, None] * draws[order]).T @ draws[order]
        covariance = old_share * covariance + rank_one * np.outer(path, path) + rank_mu * spread
        step *= math.exp(step_rate / damping * (norm / expected_norm - 1))
        yield best, best_value


def gait_of(values: Array) -> Gait:
    """Return the walk with other values (n,) of the tuned fields."""
    return replace(WALK, **dict(zip(TUNED, values.tolist(), strict=True)))


def tune(figure: Figure, options: TuneOptions) -> Iterator[tuple[Gait, float]]:
    """Yield the best gait and its cost after each generation."""
    first = np.array([getattr(WALK, name) for name in TUNED])
    scales = options.step * np.maximum(np.abs(first), options.min_scale)

    def function(values: Array) -> float:
        return cost(figure, gait_of(values), options)

    for values, value in minimise(
        function, first, scales, generations=options.generations, seed=options.seed
    ):
        yield gait_of(values), value


def main(arguments: Sequence[str] | None = None) -> int:
    """Tune and print. Return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.figure.tune_gait",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    defaults = TuneOptions()
    parser.add_argument("--generations", type=int, default=defaults.generations)
    parser.add_argument("--seed", type=int, default=defaults.seed)
    parsed = parser.parse_args(arguments)
    options = replace(defaults, generations=parsed.generations, seed=parsed.seed)
    figure = load_figure()
    print(f"cost of the present walk: {cost(figure, WALK, options):.5f}")
    best = WALK
    try:
        for number, (gait, value) in enumerate(tune(figure, options), start=1):
            best = gait
            sys.stderr.write(f"generation {number}: {value:.5f}\n")
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
    for name in TUNED:
        print(f"{name}: float = {getattr(best, name):.5f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
