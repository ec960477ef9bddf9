"""Runs solvers on problem sets: times the call and nothing else, and lets MuJoCo judge the solution."""

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
from robot_ik.jobs import Progress, share_of
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.solution import Solution, Status
from robot_ik.solvers.base import Solver

#: Untimed solves before the first timed one: loads the kernel, fills the caches.
WARM_UP = 5
#: Problems and steps of a convergence curve.
CURVE_PROBLEMS, CURVE_STEPS = 25, 200


@dataclass(eq=False)
class Bench:
    """One solver on one problem set, ready to run; an interrupted run keeps what is in its cell."""

    solver: Solver
    robot: Robot
    problems: ProblemSet
    cell: Cell
    problem: Problem | None = None

    def run(self, settings: Settings, progress: Callable[[float], None] = lambda share: None) -> None:
        """Solves all problems, or as many as there is time for (at least ten); ``progress`` gets shares."""
        problem = self.problem
        if problem is None:
            return
        previous, deadline = self.problems.first, time.perf_counter() + settings.seconds
        for index, target in enumerate(self.problems.targets):
            start = previous if self.problems.tracking else self.problems.first
            target, start = target.copy(), start.copy()
            began = time.perf_counter_ns()
            solution = problem.solve(start, target=target)
            q = solution.q
            took = (time.perf_counter_ns() - began) / 1e3
            good = self._keep(settings, took, solution, target)
            if self.problems.tracking:
                step = float(np.abs(q - previous).max())
                if good:
                    self.cell.largest_step = max(self.cell.largest_step, step)
                    self.cell.jumps += step > JUMP
                # Lost: put back on the path, so that one error is one error.
                previous = q if good else self.problems.witnesses[index]
            progress((index + 1) / len(self.problems))
            if time.perf_counter() > deadline and index >= 9:
                break

    def _keep(self, settings: Settings, took: float, solution: Solution, target: Array) -> bool:
        metres, radians = self.robot.measure(solution.q).distance(Pose.from_matrix(target))
        if self.cell.goal == "position":
            radians = 0.0
        slack = 1.0 + SLACK
        good = (
            metres <= settings.position_tolerance * slack
            and radians <= settings.angle_tolerance * slack
            and not self.robot.outside(solution.q, SLACK)
        )
        cell = self.cell
        cell.position_error.append(metres)
        cell.angle_error.append(radians)
        cell.iterations.append(solution.iterations)
        cell.restarts.append(solution.restarts)
        cell.status.append(Status(solution.status).name)
        cell.success.append(good)
        cell.microseconds.append(round(took, 2))
        return good


def prepare(solver: Solver, robot: Robot, problems: ProblemSet, settings: Settings) -> Bench:
    """Loads the kernels and warms up: what is slow happens here, where no clock runs.

    A method that serves no poses gets positions; one that cannot serve this robot is skipped, and says why.
    """
    cell = Cell(solver=solver.name, robot=robot.name, set=problems.name, asked=len(problems))
    bench = Bench(solver, robot, problems, cell)
    if not len(problems):
        cell.skipped = problems.reason
        return bench
    tolerance = Tolerance(settings.position_tolerance, settings.angle_tolerance)
    try:
        problem = growth.pose_problem(solver, robot, robot.tool, tolerance=tolerance, seed=settings.seed)
        cell.goal = problem.given[0].name.removesuffix(" goal")
        for target in problems.targets[:WARM_UP]:
            problem.solve(problems.first, target=target)
    except (GoalError, UnsupportedJointError) as error:
        cell.skipped = str(error.args[0])
        return bench
    bench.problem = problem
    return bench


def curve(bench: Bench, settings: Settings) -> Curve | None:
    """How the method closes in on the first problems of its set; None for a method without steps."""
    if bench.problem is None:
        return None
    tolerance = Tolerance(settings.position_tolerance, settings.angle_tolerance)
    problem = Problem(
        bench.robot, bench.problem.goals, solver=bench.solver, tolerance=tolerance,
        budget=Budget(iterations=CURVE_STEPS), seed=settings.seed, trace=True,
    )  # fmt: skip
    rows, longest = np.full((CURVE_PROBLEMS, CURVE_STEPS), np.nan), 0
    for k, target in enumerate(bench.problems.targets[:CURVE_PROBLEMS]):
        steps = problem.solve(bench.problems.first, target=target).trace
        best, error, longest = np.inf, np.nan, max(longest, len(steps))
        for step in steps:
            if step.cost < best:
                best, error = step.cost, step.position
            rows[k, min(step.iteration, CURVE_STEPS) - 1] = error
        rows[k, len(steps) :] = error
    if longest <= 1:  # a formula
        return None
    cell, middle = bench.cell, np.nanmedian(rows, axis=0).tolist()
    return Curve(solver=cell.solver, robot=cell.robot, goal=cell.goal, error=middle)


# ------------------------------------------------------------------------------------------
# Methods × robots × sets of problems: everything that ``robot-ik bench`` measures, in its order.


BATCH = 500
"""Times as many poses in a batch as problems in the other sets."""

EXTRA = ("kernels", "batch")
"""What is measured beside the sets of problems: cost of kinematics and growth; ``solve_batch``."""


@dataclass(frozen=True)
class Campaign:
    """What is measured: each method on each robot, with the keys of ``SETS`` and ``EXTRA``."""

    solvers: Sequence[Solver]
    robots: Sequence[Robot]
    sets: Sequence[str]
    settings: Settings

    def prepare(self, progress: Progress) -> list[Bench]:
        """All that takes long and is not measured: problem sets, and kernels, which announce themselves."""
        pairs = [(name, robot) for name in self.sets if name not in EXTRA for robot in self.robots]
        benches: list[Bench] = []
        for k, (name, robot) in enumerate(pairs):
            progress(f"{name}, {robot.name}", k / len(pairs))
            problems = make_set(name, robot, self.settings.count, self.settings.seed)
            benches += [prepare(solver, robot, problems, self.settings) for solver in self.solvers]
        return benches

    def measure(self, benches: Sequence[Bench], results: Results, progress: Progress) -> Iterator[str]:
        """Fills ``results``, figure by figure: after an interrupt it holds what is done.

        Yields:
            Why something could not be measured.
        """
        # Nothing is collected while a clock runs.
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
            share = share_of(progress, f"{cell.set}, {cell.robot}, {cell.solver}", done, len(benches))
            results.cells.append(cell)
            share(0.0)
            bench.run(self.settings, share)
            if cell.set == "cold" and (found := curve(bench, self.settings)):
                results.curves.append(found)

    def _kernels(self, results: Results, progress: Progress) -> None:
        progress("kernels: forward and Jacobian", 0.0)
        seed, figure = self.settings.seed, load_robot(growth.FIGURE)
        results.lower_bounds += [growth.lower_bound(robot, seed) for robot in self.robots]
        for k, solver in enumerate(self.solvers):
            progress(f"growth, {solver.name}", k / len(self.solvers))
            results.growth.extend(growth.growth(solver, figure, seed))

    def _batches(self, results: Results, progress: Progress) -> Iterator[str]:
        pairs = [(robot, solver) for robot in self.robots for solver in self.solvers]
        for k, (robot, solver) in enumerate(pairs):
            progress(f"batches: {robot.name}, {solver.name}", k / len(pairs))
            try:
                results.batches.extend(
                    growth.batches(robot, solver, BATCH * self.settings.count, self.settings.seed)
                )
            except (GoalError, UnsupportedJointError) as error:
                yield f"no batch: {error.args[0]}"
