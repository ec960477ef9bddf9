"""The frames of a walk by the figure's solver and by mink, with the same goals.

In every frame both get the poses of the feet, the centre of mass above the floor, rotation and
height of the pelvis, the rotation of the chest, a gaze and a posture. These are read from a solved
walk. Both begin each frame at the frame before. mink weighs all rows and steps until feet and
centre of mass are within ``TOLERANCE``. Errors are measured before times.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_ik.figure.figure import Figure
from robot_ik.figure.frames import FrameRows
from robot_ik.ports import Array

TOLERANCE = 1e-4
"""Error of feet and centre of mass, m and rad."""

QP_SOLVER = "daqp"
"""QP solver of mink."""

_MAX_STEPS = 20
"""Largest number of mink's steps per frame."""

_GAZE_DISTANCE = 3.0
"""Distance of the point at which the eyes look, m."""


@dataclass(frozen=True)
class MinkCosts:
    """Costs of mink's tasks: square roots of weights that match those of the figure.

    Attributes:
        feet: Pose of a foot.
        center: Centre of mass.
        pelvis: Rotation of the pelvis.
        height: Height of the pelvis.
        chest: Rotation of the chest.
        gaze: Direction of the gaze.
        posture: Posture.
    """

    feet: float = 100.0
    center: float = 100.0
    pelvis: float = 3.0
    height: float = 20.0
    chest: float = 3.0
    gaze: float = 1.0
    posture: float = 0.1


COSTS = MinkCosts()
"""Costs of the comparison."""


@dataclass(frozen=True, eq=False)
class FrameGoals:
    """Goals of the n frames of a walk. A pose is positions (n, 3) and rotations (n, 3, 3).

    Attributes:
        q: (n, nq) frames from which the goals were read.
        feet: Pose of each foot, by frame.
        center: (n, 3) centres of mass.
        pelvis: Pose of the pelvis.
        chest: (n, 3, 3) rotations of the chest.
        gaze_target: (n, 3) points at which the eyes look.
    """

    q: Array
    feet: dict[str, tuple[Array, Array]]
    center: Array
    pelvis: tuple[Array, Array]
    chest: Array
    gaze_target: Array

    @classmethod
    def of_frames(cls, figure: Figure, q: Array, gaze: str) -> FrameGoals:
        """Read the goals from frames (n, nq). ``gaze`` is the frame that looks."""
        eyes, rotation = figure.poses(q, gaze)
        return cls(
            q=q,
            feet={foot.frame: figure.poses(q, foot.frame) for foot in figure.feet.values()},
            center=figure.centers(q),
            pelvis=figure.poses(q, figure.pelvis),
            chest=figure.poses(q, figure.trunk)[1],
            gaze_target=eyes + _GAZE_DISTANCE * rotation[:, :, 0],
        )

    def largest_error(self, figure: Figure, q: Array) -> float:
        """Return the largest error of feet and centre of mass in frames (n, nq), m or rad."""
        error = float(np.abs(figure.centers(q) - self.center)[:, :2].max())
        for frame, (position, rotation) in self.feet.items():
            actual_position, actual_rotation = figure.poses(q, frame)
            error = max(error, float(np.abs(actual_position - position).max()))
            error = max(error, float(np.abs(actual_rotation - rotation).max()))
        return error


def solve_by_figure(figure: Figure, goals: FrameGoals) -> tuple[Array, float]:
    """Return frames (n, nq) by the figure's solver, and its processor time per frame, s.

    Feet and centre of mass are hard rows. The others are weighed.
    """
    rows = FrameRows(figure, len(goals.q))
    rows.feet({side: goals.feet[foot.frame] for side, foot in figure.feet.items()})
    rows.center(goals.center, axes="xy")
    rows.orientation(figure.pelvis, goals.pelvis[1], 60.0)
    rows.orientation(figure.trunk, goals.chest, 60.0)
    rows.position(figure.pelvis, goals.pelvis[0], 2000.0, axes="z")
    rows.aim(goals.gaze_target, 5.0)
    stiffness = figure.stiffnesses({"*": 0.02, "*toe*": 1e3})
    seconds = 0.0
    q = goals.q
    for _ in range(2):  # the first solve may load or compile the kernel
        began = time.thread_time()
        q = rows.solve(goals.q, stiffness, figure.home, speeds=None).q
        seconds = (time.thread_time() - began) / len(goals.q)
    return q, seconds


def mink_is_installed() -> bool:
    """Return whether mink and its QP solver are installed."""
    return all(importlib.util.find_spec(name) is not None for name in ("mink", QP_SOLVER))


def solve_by_mink(figure: Figure, goals: FrameGoals) -> tuple[Array, float, float]:
    """Return frames (n, nq) by mink, its processor time per frame, s, and its steps per frame."""
    mink: Any = importlib.import_module("mink")
    tasks, targets = _mink_tasks(mink, figure, goals)
    configuration = mink.Configuration(figure.model)
    configuration.update(figure.home)
    limits = [mink.ConfigurationLimit(figure.model)]
    q = np.empty_like(goals.q)
    steps = 0
    began = time.thread_time()
    for k in range(len(q)):
        for task, task_targets in zip(tasks, targets, strict=True):
            task.set_target(task_targets[k])
        for _ in range(_MAX_STEPS):
            velocity = mink.solve_ik(
                configuration, tasks, 1.0, QP_SOLVER, damping=1e-6, limits=limits
            )
            configuration.integrate_inplace(velocity, 1.0)
            steps += 1
            errors = [np.abs(task.compute_error(configuration)).max() for task in tasks[:3]]
            if max(errors) < TOLERANCE:
                break
        q[k] = configuration.q
    return q, (time.thread_time() - began) / len(q), steps / len(q)


def _mink_tasks(mink: Any, figure: Figure, goals: FrameGoals) -> tuple[list[Any], list[Any]]:
    """Return tasks, those of feet and centre of mass first, and the targets of each by frame."""
    no_cost = np.zeros(3)

    def frame_task(name: str, position_cost: Any, rotation_cost: float) -> Any:
        sites = {figure.model.site(k).name for k in range(figure.model.nsite)}
        kind = "site" if name in sites else "body"
        return mink.FrameTask(name, kind, position_cost, rotation_cost)

    def poses(position: Array, rotation: Array) -> list[Any]:
        return [
            mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(r), p)
            for p, r in zip(position, rotation, strict=True)
        ]

    pairs: list[tuple[Any, Any]] = [
        (frame_task(name, COSTS.feet, COSTS.feet), poses(*pose))
        for name, pose in goals.feet.items()
    ]
    pairs.append((mink.ComTask([COSTS.center, COSTS.center, 0.0]), goals.center))
    pelvis = frame_task(figure.pelvis, [0.0, 0.0, COSTS.height], COSTS.pelvis)
    pairs.append((pelvis, poses(*goals.pelvis)))
    zeros = np.broadcast_to(no_cost, goals.center.shape)
    chest = frame_task(figure.trunk, no_cost, COSTS.chest)
    pairs.append((chest, poses(zeros, goals.chest)))
    gaze = mink.LookAtTask(figure.gaze, "site", axis=(1.0, 0.0, 0.0), cost=COSTS.gaze)
    pairs.append((gaze, goals.gaze_target))
    pairs.append((mink.PostureTask(figure.model, cost=COSTS.posture), goals.q))
    return [task for task, _ in pairs], [targets for _, targets in pairs]
