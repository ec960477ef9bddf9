"""robot_ik as a contestant beside other libraries."""

from __future__ import annotations

import robot_ik as rik
from robot_ik.bench.peers.worker import Library, Task
from robot_ik.errors import DISTRIBUTION
from robot_ik.ports import Array

#: Asked for a little more than what is judged: rounding must not decide.
_MARGIN = 0.9


class OursAuto(Library):
    """The default: the closed form where the arm has one, else Levenberg-Marquardt."""

    needs = (DISTRIBUTION, "mujoco", "numba")
    solver = "auto"

    def setup(self, task: Task) -> bool:
        self._robot = rik.load_robot(task.folder / "model.xml")
        self._sites = task.sites
        tolerance = rik.Tolerance(position=_MARGIN * task.position, angle=_MARGIN * task.angle)
        zero = (0.0, 0.0, 0.0)
        goals: list[rik.Goal] = [rik.PoseGoal(task.sites[0], zero)]
        if len(task.sites) > 1:
            goals = [rik.PositionGoal(site, zero) for site in task.sites]
        self.settings = f"solver {self.solver}, its defaults; Problem.solve"
        try:
            self._problem = rik.Problem(self._robot, goals, solver=self.solver, tolerance=tolerance)
        except rik.RobotIkError:
            return False
        return True

    def solve(self, target: Array, start: Array) -> Array:
        if len(self._sites) == 1:
            return self._problem.solve(start, target=target).q
        return self._problem.solve(start, target=dict(enumerate(target))).q

    def forward(self, q: Array) -> Array | None:
        return self._robot.forward(q, self._sites[0]).matrix if len(self._sites) == 1 else None


class Numeric(OursAuto):
    """Levenberg-Marquardt inside the limits, numeric only."""

    solver = "lm"


class ClosedForm(OursAuto):
    """The closed form alone: out of reach it proves that, and searches for nothing nearest."""

    solver = "analytic"
