"""Goals one after the other, each solved from the solution to the last: the loop of both experiments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose
from robot_ik.goals import Goal
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solvers.base import Solver

Array = NDArray[np.float64]

Progress = Callable[[str, float], None]
"""Called with what is being done and which share of all is behind."""

# Updates the progress bar this often, frames: an update costs more than a solve.
_LOOK = 25


@dataclass(frozen=True)
class Track:
    """How one method fared on one row of goals.

    Attributes:
        frames: How many goals there were.
        solved: How many were met, by MuJoCo's forward pass.
        lost: The first frame that was not met; None when all were.
        milliseconds, iterations: Mean of one solve.
        restarts: Random restarts in all.
        refused: The method does not serve this kind of goal or robot; all else is zero.
    """

    frames: int
    solved: int = 0
    lost: int | None = None
    milliseconds: float = 0.0
    iterations: float = 0.0
    restarts: int = 0
    refused: bool = False

    @property
    def share(self) -> float:
        """Share of the frames that were met."""
        return self.solved / self.frames

    @property
    def passed(self) -> bool:
        """Every frame was met."""
        return self.solved == self.frames


class Gauge:
    """How far a row of jobs has come, as a share of all of them.

    Args:
        progress: Called with what is being done and which share of all is behind.
        jobs: How many there are.
    """

    def __init__(self, progress: Progress, jobs: int) -> None:
        self._progress = progress
        self._jobs = jobs
        self._begun = 0
        self._phase, self._frames, self._behind = "", 1, 0

    def begin(self, phase: str, frames: int) -> None:
        """The next job, of so many frames."""
        self._begun += 1
        self._phase, self._frames, self._behind = phase, frames, 0
        self.tick(0)

    def tick(self, frames: int) -> None:
        """So many frames more are done."""
        self._behind += frames
        share = (self._begun - 1 + self._behind / self._frames) / self._jobs
        self._progress(self._phase, share)


class CourseJudge:
    """MuJoCo's forward pass, again and again: ``Robot.measure`` without new memory for each frame."""

    def __init__(self, robot: Robot, goal: Goal) -> None:
        self._robot = robot
        self._goal = goal
        self._frame = robot.frame(goal.frame)
        self._data = mujoco.MjData(robot.model)

    def miss(self, q: Array, target: Pose) -> tuple[float, float]:
        """How far the goal's frame is from ``target`` at ``q`` (nq,): metres, radians; 0 if not asked for."""
        data, at = self._data, self._frame
        data.qpos[:] = self._robot.qpos(q)
        mujoco.mj_kinematics(self._robot.model, data)
        pose = Pose(data.xpos[at.body], data.xquat[at.body]).compose(at.local)
        metres, radians = pose.distance(target)
        return metres if self._goal.has_position else 0.0, radians if self._goal.has_angle else 0.0


def track(
    problem: Problem,
    solver: Solver,
    targets: Sequence[Pose],
    start: Array,
    tick: Callable[[int], None] = lambda frames: None,
) -> Track:
    """Follows ``targets`` from ``start`` (nq,) on; ``tick`` is called with how many frames have gone by."""
    if not solver.applies(problem):
        tick(len(targets))
        return Track(len(targets), refused=True)
    problem.retarget(targets[0])
    solver.solve(problem, start)  # compiles what is not compiled yet: not to be counted
    judge, allowed = CourseJudge(problem.robot, problem.goals[0]), problem.tolerance
    q, solved, lost, seconds, iterations, restarts = start, 0, None, 0.0, 0, 0
    for k, target in enumerate(targets):
        problem.retarget(target)
        solution = solver.solve(problem, q)
        q = solution.q
        seconds += solution.seconds
        iterations += solution.iterations
        restarts += solution.restarts
        metres, radians = judge.miss(q, target)  # by MuJoCo, not the solver's
        if metres <= allowed.position and radians <= allowed.angle:
            solved += 1
        elif lost is None:
            lost = k
        if (k + 1) % _LOOK == 0:
            tick(_LOOK)
    tick(len(targets) % _LOOK)
    count = len(targets)
    return Track(count, solved, lost, 1e3 * seconds / count, iterations / count, restarts)
