"""Frames of a walk with equal goals by the figure's solver and by mink: misses first, then time.

Both get, frame by frame, the poses of the feet, the centre of mass over the floor, the pelvis (rotation and
height), the rotation of the chest, gaze and a posture, read off a solved walk, and begin where their frame
before ended.  mink weighs all rows; it steps until feet and centre of mass miss no more than ``MISS``.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_ik.figure.figure import Figure
from robot_ik.figure.frames import FrameRows, Frames
from robot_ik.figure.gait import Walk
from robot_ik.ports import Array

MISS = 1e-4
"""Of feet and centre of mass, m and rad."""
SOLVER, MOST = "daqp", 20
"""mink's QP solver, and most of its steps a frame."""
COSTS = {
    "feet": 100.0,
    "center": 100.0,
    "pelvis": 3.0,
    "height": 20.0,
    "chest": 3.0,
    "gaze": 1.0,
    "posture": 0.1,
}
"""mink's: square roots of weights that count as much as the figure's own."""
_AHEAD = 3.0  # m: the point that the eyes follow


@dataclass(frozen=True)
class Peer:
    """What one solver did: seconds of processor time and steps a frame, mean; largest miss, m or rad."""

    seconds: float
    miss: float
    steps: float


@dataclass(frozen=True, eq=False)
class FrameGoals:
    """(n, …) goals of the frames (n, nq) of a walk."""

    q: Array
    feet: dict[str, tuple[Array, Array]]
    center: Array
    pelvis: tuple[Array, Array]
    chest: Array
    gaze_target: Array


def goals_of(figure: Figure, walk: Walk) -> FrameGoals:
    """Read off the frames of a walk."""
    q = walk.frames.q
    assert figure.gaze is not None
    eyes, matrix = figure.poses(q, figure.gaze)
    return FrameGoals(
        q, {foot.frame: figure.poses(q, foot.frame) for foot in figure.feet.values()},
        np.array([figure.center(row) for row in q]), figure.poses(q, figure.pelvis),
        figure.poses(q, figure.trunk)[1], eyes + _AHEAD * matrix[:, :, 0],
    )  # fmt: skip


def by_figure(figure: Figure, goals: FrameGoals) -> Peer:
    """The figure's solver: feet and centre of mass are needed, the rest is weighed."""
    rows = FrameRows(figure, len(goals.q))
    for frame, (position, matrix) in goals.feet.items():
        rows.position(frame, position)
        rows.orientation(frame, matrix)
    rows.center(goals.center, axes="xy")
    rows.orientation(figure.pelvis, goals.pelvis[1], 60.0)
    rows.orientation(figure.trunk, goals.chest, 60.0)
    rows.position(figure.pelvis, goals.pelvis[0], 2000.0, axes="z")
    assert figure.gaze is not None
    rows.aim(figure.gaze, goals.gaze_target, 5.0, figure.neck or None)
    stiffness = figure.stiffnesses({"*": 0.02, "*toe*": 1e3})

    def solve() -> Frames:
        return rows.solve(goals.q, stiffness, figure.home, speeds=None)

    solve()
    began = time.thread_time()
    found = solve()
    seconds = (time.thread_time() - began) / len(goals.q)
    return Peer(seconds, _worst(figure, goals, found.q), float(found.steps.mean()))


def has_mink() -> bool:
    """Whether mink and its QP solver are installed: no part of this package needs them."""
    return all(importlib.util.find_spec(name) is not None for name in ("mink", SOLVER))


def by_mink(figure: Figure, goals: FrameGoals) -> Peer:
    """mink's tasks with the same goals."""
    mink: Any = importlib.import_module("mink")
    tasks, aims = _tasks(mink, figure, goals)
    configuration = mink.Configuration(figure.model)
    configuration.update(figure.home)
    limits, q, steps = [mink.ConfigurationLimit(figure.model)], np.empty_like(goals.q), 0
    began = time.thread_time()
    for k in range(len(q)):
        for task, targets in zip(tasks, aims, strict=True):
            task.set_target(targets[k])
        for _ in range(MOST):
            velocity = mink.solve_ik(configuration, tasks, 1.0, SOLVER, damping=1e-6, limits=limits)
            configuration.integrate_inplace(velocity, 1.0)
            steps += 1
            if max(float(np.abs(task.compute_error(configuration)).max()) for task in tasks[:3]) < MISS:
                break
        q[k] = configuration.q
    seconds = (time.thread_time() - began) / len(q)
    return Peer(seconds, _worst(figure, goals, q), steps / len(q))


def _tasks(mink: Any, figure: Figure, goals: FrameGoals) -> tuple[list[Any], list[Any]]:
    """Tasks, the needed ones first, and the targets of each, frame by frame."""
    free = np.zeros(3)

    def frame(name: str, position: Any, matrix: float) -> Any:
        sites = {figure.model.site(k).name for k in range(figure.model.nsite)}
        return mink.FrameTask(name, "site" if name in sites else "body", position, matrix)

    def poses(position: Array, matrix: Array) -> list[Any]:
        return [
            mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(r), p)
            for p, r in zip(position, matrix, strict=True)
        ]

    still = np.broadcast_to(free, goals.center.shape)
    pairs: list[tuple[Any, Any]] = [
        (frame(name, COSTS["feet"], COSTS["feet"]), poses(*pose)) for name, pose in goals.feet.items()
    ]
    pairs += [
        (mink.ComTask([COSTS["center"], COSTS["center"], 0.0]), goals.center),
        (frame(figure.pelvis, [0.0, 0.0, COSTS["height"]], COSTS["pelvis"]), poses(*goals.pelvis)),
        (frame(figure.trunk, free, COSTS["chest"]), poses(still, goals.chest)),
        (mink.LookAtTask(figure.gaze, "site", axis=(1.0, 0.0, 0.0), cost=COSTS["gaze"]), goals.gaze_target),
        (mink.PostureTask(figure.model, cost=COSTS["posture"]), goals.q),
    ]
    return [task for task, _ in pairs], [targets for _, targets in pairs]


def _worst(figure: Figure, goals: FrameGoals, q: Array) -> float:
    """Largest miss of feet and centre of mass, by MuJoCo."""
    worst = 0.0
    for frame, (position, matrix) in goals.feet.items():
        there, rotation = figure.poses(q, frame)
        worst = max(worst, float(np.abs(there - position).max()), float(np.abs(rotation - matrix).max()))
    center = np.array([figure.center(row) for row in q])
    return max(worst, float(np.abs(center - goals.center)[:, :2].max()))
