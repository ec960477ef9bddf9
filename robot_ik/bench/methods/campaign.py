"""Methods × robots × sets of problems: everything that ``robot-ik bench`` measures, in its order."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from robot_ik.bench.methods import growth
from robot_ik.bench.methods.problems import make_set
from robot_ik.bench.methods.results import Results, Settings
from robot_ik.bench.methods.runner import Bench, curve, prepare
from robot_ik.errors import GoalError, UnsupportedJointError
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers.base import Solver

#: Called with what is measured and the share of it that is done.
Progress = Callable[[str, float], None]

BATCH = 500
"""Times as many poses in a batch as problems in the other sets."""

EXTRA = ("kernels", "batch")
"""What is measured beside the sets of problems: cost of kinematics and growth; ``solve_batch``."""


@dataclass(frozen=True)
class Campaign:
    """What is measured: each method on each robot.

    Attributes:
        solvers, robots: Methods and robots.
        sets: Keys of ``SETS``, and of ``EXTRA``.
        settings: Count, seed, tolerances and time.
    """

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

        Args:
            benches: Of ``prepare``.
            results: Takes the figures.
            progress: Is shown what is measured.

        Yields:
            Why something could not be measured.
        """
        # What compiling left behind need not be collected again before each method's run.
        gc.collect()
        gc.freeze()
        try:
            self._sets(benches, results, progress)
            if "kernels" in self.sets:
                self._kernels(results, progress)
            if "batch" in self.sets:
                yield from self._batches(results, progress)
        finally:
            gc.unfreeze()

    def _sets(self, benches: Sequence[Bench], results: Results, progress: Progress) -> None:
        for done, bench in enumerate(benches):
            cell = bench.cell
            what = f"{cell.set}, {cell.robot}, {cell.solver}"
            results.cells.append(cell)

            def share(part: float, what: str = what, done: int = done) -> None:
                progress(what, (done + part) / len(benches))

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
            results.growth.extend(growth.growth_with_joints(solver, seed))
            results.growth.extend(growth.growth_with_goals(solver, figure, seed))

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
