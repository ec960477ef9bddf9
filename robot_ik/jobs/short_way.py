"""In which order to go to places, so that the way is short and free."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.jobs.clearance import Clearance
from robot_ik.robot import Robot

Array = NDArray[np.float64]


def short_way(robot: Robot, start: Array, stops: Sequence[Array], clearance: Clearance) -> list[int]:
    """Indices of stops, ordered by short free ways: the nearest each time, then crossings undone (2-opt).

    Stops that no free way leads to are left out.
    """
    places = [start, *stops]
    cost = np.zeros((len(places), len(places)))
    for i in range(len(places)):
        for j in range(i):
            seconds = float(np.max(np.abs(places[i] - places[j]) / robot.velocity))
            cost[i, j] = cost[j, i] = seconds if clearance.free_way(places[i], places[j]) else np.inf
    way, left = [0], set(range(1, len(places)))
    while left:
        nearest = min(left, key=lambda k: cost[way[-1], k])
        if not np.isfinite(cost[way[-1], nearest]):
            break
        way.append(nearest)
        left.remove(nearest)
    improved = True
    while improved:
        improved = False
        for i in range(1, len(way) - 1):
            for j in range(i + 1, len(way)):
                trial = [*way[:i], *way[i : j + 1][::-1], *way[j + 1 :]]
                if _length(trial, cost) < _length(way, cost) - 1e-9:
                    way, improved = trial, True
    return [k - 1 for k in way[1:]]


def _length(way: Sequence[int], cost: Array) -> float:
    return float(sum(cost[a, b] for a, b in itertools.pairwise(way)))
