"""Run solvers on problem sets. Only the call is timed, and MuJoCo measures the success."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.bench.methods import growth
from robot_ik.bench.methods.problems import SLACK, ProblemSet, make_set
from robot_ik.bench.methods.results import JUMP, Cell, Curve, Results, Settings
from robot_ik.budget import Budget
from robot_ik.errors import GoalError, UnsupportedJointError
from robot_ik.geometry import Pose
from robot_ik.goals import Tolerance
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.solution import Solution, Status
from robot_ik.solvers.base import Solver
from robot_ik.workcell.progress import Progress, share_of

WARM_UP = 5
"""Solves whose time does not count. They load the kernel and fill the caches."""

CURVE_PROBLEMS = 25
"""Problems of a convergence curve."""

CURVE_STEPS = 200
"""Steps of a convergence curve."""

LEAST_PROBLEMS = 10
"""Smallest number of problems of a set, even if its time is over."""

BATCH = 500
"""Poses of a batch for each problem of the other sets."""

EXTRA = ("kernels", "batch")
"""Measurements beside the problem sets: cost and growth of kinematics, and ``solve_batch``."""


def no_progress(_share: float) -> None:
    """Show no progress."""


@dataclass(eq=False)
class Bench:
    """One solver on one problem set, ready to run. An interrupted run keeps its results so far.

    Attributes:
        solver: The method.
        robot: The robot.
        problems: The problems.
        cell: Receives the results.
        problem: The prepared problem. None if the method does not support the set.
    """

    solver: Solver
    robot: Robot
    problems: ProblemSet
    cell: Cell
    problem: Problem | None = None

    def run(self, settings: Settings, progress: Callable[[float], None] = no_progress) -> None:
        """Solve all problems, or those for which there is time, but at least ten.

        Args:
            settings: Settings of the benchmark.
            progress: Called with the share that is done.
        """
        problem = self.problem
        if problem is None:
            return
        previous = self.problems.first
        deadline = time.perf_counter() + settings.seconds
        for index, row in enumerate(self.problems.targets):
            target = row.copy()
            start = (previous if self.problems.tracking else self.problems.first).copy()
            began = time.perf_counter_ns()
            solution = problem.solve(start, target=target)
            q = solution.q
            microseconds = (time.perf_counter_ns() - began) / 1e3
            success = self._keep(settings, microseconds, solution, target)
            if self.problems.tracking:
                step = float(np.abs(q - previous).max())
                if success:
                    self.cell.largest_step = max(self.cell.largest_step, step)
                    self.cell.jumps += step > JUMP
                # After a failure the next solve starts on the path, so that one error counts once.
                previous = q if success else self.problems.witnesses[index]
            progress((index + 1) / len(self.problems))
            if time.perf_counter() > deadline and index + 1 >= LEAST_PROBLEMS:
                break

    def _keep(
        self, settings: Settings, microseconds: float, solution: Solution, target: Array
    ) -> bool:
        """Append a solution to the cell. Return whether it is a success, by MuJoCo."""
        distance, angle = self.robot.measure(solution.q).distance(Pose.from_matrix(target))
        if self.cell.goal == "position":
            angle = 0.0
        slack = 1.0 + SLACK
        success = (
            distance <= settings.position_tolerance * slack
            and angle <= settings.angle_tolerance * slack
            and not self.robot.outside(solution.q, SLACK)
        )
        cell = self.cell
        cell.position_error.append(distance)
        cell.angle_error.append(angle)
        cell.iterations.append(solution.iterations)
        cell.restarts.append(solution.restarts)
        cell.status.append(Status(solution.status).name)
        cell.success.append(success)
        cell.microseconds.append(round(microseconds, 2))
        return success


def prepare(solver: Solver, robot: Robot, problems: ProblemSet, settings: Settings) -> Bench:
    """Load the kernels and fill the caches before the measurement.

    A method that supports no poses gets positions. If it does not support the robot, the cell has
    the reason.
    """
    cell = Cell(solver=solver.name, robot=robot.name, set=problems.name, asked=len(problems))
    bench = Bench(solver, robot, problems, cell)
    if not len(problems):
        cell.skipped = problems.reason
        return bench
    tolerance = Tolerance(settings.position_tolerance, settings.angle_tolerance)
    try:
        problem = growth.pose_problem(
            solver, robot, robot.tool, tolerance=tolerance, seed=settings.seed
        )
        cell.goal = problem.given[0].name.removesuffix(" goal")
        for target in problems.targets[:WARM_UP]:
            problem.solve(problems.first, target=target)
    except (GoalError, UnsupportedJointError) as error:
        cell.skipped = str(error.args[0])
        return bench
    bench.problem = problem
    return bench


def curve(bench: Bench, settings: Settings) -> Curve | None:
    """Return the error by step on the first problems. None for a method without steps."""
    if bench.problem is None:
        return None
    tolerance = Tolerance(settings.position_tolerance, settings.angle_tolerance)
    problem = Problem(
        bench.robot,
        bench.problem.goals,
        solver=bench.solver,
        tolerance=tolerance,
        budget=Budget(iterations=CURVE_STEPS),
        seed=settings.seed,
        trace=True,
    )
    rows = np.full((CURVE_PROBLEMS, CURVE_STEPS), np.nan)
    longest = 0
    for k, target in enumerate(bench.problems.targets[:CURVE_PROBLEMS]):
        steps = problem.solve(bench.problems.first, target=target).trace
        longest = max(longest, len(steps))
        best = np.inf
        error = np.nan
        for step in steps:
            if step.cost < best:
                best = step.cost
                error = step.position
            rows[k, min(step.iteration, CURVE_STEPS) - 1] = error
        rows[k, len(steps) :] = error
    if longest <= 1:  # a closed form
        return None
    cell = bench.cell
    median = np.nanmedian(rows, axis=0).tolist()
    return Curve(solver=cell.solver, robot=cell.robot, goal=cell.goal, error=median)


@dataclass(frozen=True)
class Campaign:
    """A whole benchmark: each method on each robot.

    Attributes:
        solvers: Methods.
        robots: Robots.
        sets: Keys of ``SETS`` and ``EXTRA``.
        settings: Settings of the benchmark.
    """

    solvers: Sequence[Solver]
    robots: Sequence[Robot]
    sets: Sequence[str]
    settings: Settings

    def prepare(self, progress: Progress) -> list[Bench]:
        """Create the problem sets and load the kernels. Nothing is measured."""
        pairs = [(name, robot) for name in self.sets if name not in EXTRA for robot in self.robots]
        benches: list[Bench] = []
        for k, (name, robot) in enumerate(pairs):
            progress(f"{name}, {robot.name}", k / len(pairs))
            problems = make_set(name, robot, self.settings.count, self.settings.seed)
            for solver in self.solvers:
                benches.append(prepare(solver, robot, problems, self.settings))
        return benches

    def measure(
        self, benches: Sequence[Bench], results: Results, progress: Progress
    ) -> Iterator[str]:
        """Write the measurements into ``results``, one by one. An interrupt keeps those so far.

        Yields:
            The reason of each measurement that could not be made.
        """
        # Garbage is not collected during a measurement.
        gc.collect()
        gc.disable()
        try:
            self._sets(benches, results, progress)
            if "kernels" in self.sets:
                self._kernels(results, progress)
            if "batch" in self.sets:
                yield from self._batches(results, progress)
        finally:
            gc.enable()

    def _sets(self, benches: Sequence[Bench], results: Results, progress: Progress) -> None:
        for done, bench in enumerate(benches):
            cell = bench.cell
            phase = f"{cell.set}, {cell.robot}, {cell.solver}"
            share = share_of(progress, phase, done, len(benches))
            results.cells.append(cell)
            share(0.0)
            bench.run(self.settings, share)
            convergence = curve(bench, self.settings) if cell.set == "cold" else None
            if convergence is not None:
                results.curves.append(convergence)

    def _kernels(self, results: Results, progress: Progress) -> None:
        progress("kernels: forward and Jacobian", 0.0)
        seed = self.settings.seed
        figure = load_robot(growth.FIGURE)
        results.lower_bounds += [growth.lower_bound(robot, seed) for robot in self.robots]
        for k, solver in enumerate(self.solvers):
            progress(f"growth, {solver.name}", k / len(self.solvers))
            results.growth.extend(growth.growth(solver, figure, seed))

    def _batches(self, results: Results, progress: Progress) -> Iterator[str]:
        pairs = [(robot, solver) for robot in self.robots for solver in self.solvers]
        for k, (robot, solver) in enumerate(pairs):
            progress(f"batches: {robot.name}, {solver.name}", k / len(pairs))
            try:
                poses = BATCH * self.settings.count
                results.batches.extend(growth.batches(robot, solver, poses, self.settings.seed))
            except (GoalError, UnsupportedJointError) as error:
                yield f"no batch: {error.args[0]}"
