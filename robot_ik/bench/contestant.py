"""robot_ik as a contestant in the side-by-side comparison of inverse-kinematics libraries.

The harness (its ``run.py``) looks for classes in its folder ``contestants/``.  Copy this file
there, under any name, and run it with an interpreter that has robot_ik:

    cp robot_ik/bench/contestant.py PEERS/contestants/robot_ik_contestant.py
    python PEERS/run.py --contestants robot_ik,robot_ik_lm --out results

``FourGoals`` takes part in its ``multigoal.py``; ``docs/make_performance.py`` runs both.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Asked for a little more than what is judged: rounding must not decide.
_MARGIN = 0.9
#: What the four goals are judged by, metres.
_FOUR_GOALS_TOLERANCE = 1e-4


def _harness() -> Any:
    """The harness's own base class where this file lies among its contestants, else a plain object."""
    try:
        return importlib.import_module("contestants.base").Contestant
    except ImportError:
        return object


class RobotIk(_harness()):  # type: ignore[misc]
    """The default: the closed form where the arm has one, else Levenberg-Marquardt."""

    name = "robot_ik"
    about = "robot_ik, solver auto: closed form where there is one, else Levenberg-Marquardt"
    dists: tuple[str, ...] = ("robot_ik", "mujoco", "numba")
    settings = ""
    solver = "auto"
    tol_pos, tol_ori = 1e-6, 1e-6

    def setup(self, robot: Any) -> bool:
        """Builds the problem once; ``robot`` is a ``robots.Robot`` of the harness.  False: no closed form."""
        import mujoco

        import robot_ik as rik
        from robot_ik.chain import robot_from_model

        model = mujoco.MjModel.from_xml_string(robot.mjcf())
        self.robot = robot_from_model(model, name=robot.name, tool="ee")
        tolerance = rik.Tolerance(position=_MARGIN * self.tol_pos, angle=_MARGIN * self.tol_ori)
        self.problem = rik.Problem(self.robot, rik.PoseGoal("ee", (0.0, 0.0, 0.0)), tolerance=tolerance)
        self.method = rik.make_solver(self.solver)
        self.settings = f"solver {self.solver}, its defaults; MJCF; retarget and solve"
        return self.method.applies(self.problem)

    def solve(self, T: Array, q0: Array) -> Array:
        """Target (4, 4), start (n,) -> joint angles (n,): the best found, inside the limits."""
        self.problem.retarget(T)
        return self.method.solve(self.problem, q0).q

    def fk(self, q: Array) -> Array:
        """(4, 4), compared with the harness's own."""
        return self.robot.forward(q).matrix


class RobotIkLm(RobotIk):
    """Numeric only."""

    name = "robot_ik_lm"
    about = "robot_ik, solver lm: Levenberg-Marquardt inside the limits, numeric only"
    solver = "lm"


class RobotIkAnalytic(RobotIk):
    """The closed form alone: out of reach it proves that, and looks for nothing nearest."""

    name = "robot_ik_analytic"
    about = "robot_ik, solver analytic: the closed form alone"
    solver = "analytic"


class FourGoals:
    """Four position goals on a floating-base humanoid, in the form of the harness's ``multigoal.py``."""

    name = "robot_ik"

    def setup(self, tree: Any) -> None:
        """Reads the model that ``multigoal.py prepare`` wrote; ``tree`` is its ``Tree``."""
        import robot_ik as rik

        self.robot = rik.load_robot(os.path.join(tree.work, "model.xml"))
        goals = [rik.PositionGoal(name, (0.0, 0.0, 0.0)) for name in self.sites()]
        tolerance = rik.Tolerance(position=_MARGIN * _FOUR_GOALS_TOLERANCE)
        self.problem = rik.Problem(self.robot, goals, tolerance=tolerance)
        self.method = rik.make_solver("lm")
        self.it = 0

    @staticmethod
    def sites() -> Sequence[str]:
        """The harness's names for hands and feet, in its order."""
        return ("left_palm", "right_palm", "left_foot", "right_foot")

    def solve(self, P: Array, q0: Array) -> Array:
        """Targets (4, 3), start (nq,) -> q (nq,)."""
        for index, position in enumerate(P):
            self.problem.retarget(position, index)
        solution = self.method.solve(self.problem, q0)
        self.it = solution.iterations
        return solution.q
