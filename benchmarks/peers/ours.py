"""robot_ik in the comparison with other libraries."""

from __future__ import annotations

import robot_ik as rik
from benchmarks.peers.library import Library, Task
from robot_ik.errors import DISTRIBUTION
from robot_ik.ports import Array

_TOLERANCE_SHARE = 0.9
"""Share of the judged tolerance that the solver gets, so that rounding does not decide."""


class OursAuto(Library):
    """The default: the closed form of the arm if there is one, otherwise Levenberg-Marquardt."""

    needs = (DISTRIBUTION, "mujoco", "numba")
    solver = "auto"

    def setup(self, task: Task) -> bool:
        self._robot = rik.load_robot(task.folder / "model.xml")
        self._sites = task.sites
        tolerance = rik.Tolerance(
            position=_TOLERANCE_SHARE * task.position, angle=_TOLERANCE_SHARE * task.angle
        )
        origin = (0.0, 0.0, 0.0)
        goals: list[rik.Goal] = [rik.PoseGoal(task.sites[0], origin)]
        if len(task.sites) > 1:
            goals = [rik.PositionGoal(site, origin) for site in task.sites]
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
        if len(self._sites) > 1:
            return None
        return self._robot.forward(q, self._sites[0]).matrix


class Numeric(OursAuto):
    """Levenberg-Marquardt inside the limits."""

    solver = "lm"


class ClosedForm(OursAuto):
    """The closed form alone. It proves that a pose is out of reach and searches no nearest one."""

    solver = "analytic"
