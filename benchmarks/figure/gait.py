"""A walk beside human gait: joint curves over the cycle, and the numbers of its steps."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.figure.motion import soles_in
from robot_ik.figure.figure import DT, SIDES, Figure
from robot_ik.figure.walk import Walk
from robot_ik.ports import Array

NORM_DEG: Mapping[str, tuple[float, ...]] = {
    "hip": (35.8, 32.8, 22.5, 11.4, 1.6, -5.3, -0.9, 17.9, 32.0, 36.7, 35.5),
    "knee": (5.6, 18.6, 16.5, 10.1, 6.2, 11.6, 33.9, 58.2, 49.8, 18.7, 5.4),
    "ankle": (-2.1, -2.1, 5.2, 8.6, 11.1, 10.4, -13.8, -11.2, 1.1, 1.0, -2.3),
}
"""Flexion, degrees, at every 10 % of the cycle from heel strike at free speed: Schwartz, Rozumalski
& Trost, J. Biomech. 41:1639, 2008."""

_MID_SWING = (0.3, 0.8)
"""Shares of the swing between which the clearance of the sole is measured."""


@dataclass(frozen=True, eq=False)
class GaitMeasure:
    """A walk beside the norm.

    Attributes:
        curves_deg: (11,) flexion at every 10 % of the cycle, mean of the middle strides, by joint.
        correlation: Correlation with ``NORM_DEG``, by joint.
        rms_deg: Root mean square of the difference to ``NORM_DEG``, by joint.
        step: Length of a step, m.
        cadence: Steps per minute.
        speed: Mean speed, m/s.
        stance: Share of the cycle in which a foot stands.
        vertical_mm: Range of the pelvis up and down.
        lateral_mm: Range of the pelvis to the sides.
        clearance_mm: Least height of a sole in mid swing.
    """

    curves_deg: Mapping[str, Array]
    correlation: Mapping[str, float]
    rms_deg: Mapping[str, float]
    step: float
    cadence: float
    speed: float
    stance: float
    vertical_mm: float
    lateral_mm: float
    clearance_mm: float


def measure_gait(figure: Figure, walk: Walk) -> GaitMeasure:
    """Measure a straight walk along x of 4 m or more."""
    q = walk.frames.q
    strikes = walk.strikes
    times = np.arange(1, len(q) + 1, dtype=np.float64) * DT
    curves, stances = _strides(figure, walk, times)
    norm = {joint: np.array(values) for joint, values in NORM_DEG.items()}
    is_middle = (times >= strikes[2]) & (times <= strikes[min(4, len(strikes) - 2)])
    pelvis, _ = figure.poses(q[is_middle], figure.pelvis)
    centers = figure.centers(q[is_middle])
    way = float(np.linalg.norm((centers[-1] - centers[0])[:2]))
    prints = np.array([(footprint.x, footprint.y) for footprint in walk.prints])
    steps = np.linalg.norm(np.diff(prints[3:-2], axis=0), axis=1)
    return GaitMeasure(
        curves_deg=curves,
        correlation={
            joint: float(np.corrcoef(curve, norm[joint])[0, 1]) for joint, curve in curves.items()
        },
        rms_deg={
            joint: float(np.sqrt(np.mean((curve - norm[joint]) ** 2)))
            for joint, curve in curves.items()
        },
        step=float(steps.mean()),
        cadence=60.0 / float(np.diff(strikes).mean()),
        speed=way / float(times[is_middle][-1] - times[is_middle][0]),
        stance=float(np.mean(stances)),
        vertical_mm=1e3 * float(np.ptp(pelvis[:, 2])),
        lateral_mm=1e3 * float(np.ptp(pelvis[:, 1])),
        clearance_mm=1e3 * _clearance(figure, walk, times),
    )


def _strides(figure: Figure, walk: Walk, times: Array) -> tuple[dict[str, Array], list[float]]:
    """Return mean joint curves (11,) in degrees, and the share of stance of each middle stride.

    Args:
        figure: The figure.
        walk: The walk.
        times: (n,) times of its frames, s.
    """
    q = walk.frames.q
    strides: dict[str, list[Array]] = {joint: [] for joint in NORM_DEG}
    stances: list[float] = []
    for side, name in enumerate(SIDES):
        for (_, strike, off), (_, next_strike, next_off) in itertools.pairwise(walk.falls[side]):
            if strike < walk.strikes[1] or not np.isfinite(next_off):
                continue
            samples = strike + np.linspace(0, 1, 11) * (next_strike - strike)
            stances.append((off - strike) / (next_strike - strike))
            for joint, rows in strides.items():
                address = figure.addresses(f"{name}_{joint}_pitch")[0]
                rows.append(np.interp(samples, times, np.degrees(q[:, address])))
    return {joint: np.mean(rows, axis=0) for joint, rows in strides.items()}, stances


def _clearance(figure: Figure, walk: Walk, times: Array) -> float:
    """Return the smallest height of a sole in the mid swings of whole steps, m."""
    lowest = np.inf
    for side, falls in enumerate(walk.falls):
        for (_, _, off), (_, strike, next_off) in itertools.pairwise(falls):
            if not np.isfinite(next_off):
                continue
            share = (times - off) / (strike - off)
            swing = np.flatnonzero((share > _MID_SWING[0]) & (share < _MID_SWING[1]))
            soles = soles_in(figure, walk.frames.q[swing])
            lowest = min(lowest, float(soles.heights[side].min()))
    return lowest
