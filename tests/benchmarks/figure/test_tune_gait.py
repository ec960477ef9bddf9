"""The tuner of the gait: its evolution strategy on known functions, and its cost of a walk."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.figure.tune_gait import TuneOptions, cost, minimise, violation
from benchmarks.quantity import Quantity
from robot_ik.figure.figure import load_figure
from robot_ik.figure.gait import WALK

Array = NDArray[np.float64]


def ellipsoid(x: Array) -> float:
    """A quadratic function with a condition of a million, and its minimum at 1."""
    return float((np.logspace(0, 6, len(x)) * (x - 1.0) ** 2).sum())


def rosenbrock(x: Array) -> float:
    """The curved valley with its minimum at 1."""
    return float((100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum())


@pytest.mark.parametrize("function", [ellipsoid, rosenbrock])
def test_the_strategy_finds_the_minimum(function: Callable[[Array], float]) -> None:
    *_, (best, value) = minimise(function, np.zeros(6), np.full(6, 0.5), generations=600, seed=1)
    assert value < 1e-8
    assert best == pytest.approx(np.ones(6), abs=1e-3)


def test_the_best_value_never_increases_and_repeats() -> None:
    def run() -> list[float]:
        points = minimise(rosenbrock, np.zeros(4), np.full(4, 0.3), generations=40, seed=2)
        return [value for _, value in points]

    values = run()
    assert all(after <= before for before, after in pairwise(values))
    assert run() == values


def test_a_row_is_missed_by_the_share_of_its_bound() -> None:
    assert violation(Quantity("speed", 1.2, least=1.1, most=1.25), 0.0) == 0.0
    assert violation(Quantity("speed", 1.5, least=1.0, most=1.25), 0.0) == pytest.approx(0.2)
    assert violation(Quantity("speed", 0.9, least=1.0, most=1.25), 0.0) == pytest.approx(0.1)
    assert violation(Quantity("speed", 1.25, most=1.25), 0.01) == pytest.approx(0.01)


def test_the_walk_costs_less_than_a_worse_one() -> None:
    figure = load_figure()
    options = TuneOptions()
    walk_cost = cost(figure, WALK, options)
    assert walk_cost < cost(figure, replace(WALK, off_deg=30.0), options)
    assert walk_cost < cost(figure, replace(WALK, length=0.9), options)
