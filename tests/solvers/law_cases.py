"""Methods, robots and goals of the laws of solvers, and MuJoCo's error, for several test files."""

import itertools
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest

from robot_ik.errors import UnsupportedGoalError
from robot_ik.geometry import Pose
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal, Tolerance
from robot_ik.problem import Problem
from robot_ik.solvers import SOLVERS
from robot_ik.solvers.iterative import IterativeSolver

FLOORS = tomllib.loads((Path(__file__).parent / "floors.toml").read_text())
NAMES = list(SOLVERS)
ROBOTS = ["puma560", "planar", "tree"]
KINDS = ["position", "orientation", "pose"]
TOLERANCE = Tolerance(position=1e-5, angle=1e-4)


def is_supported(name, robot_name, kind):
    """Return whether floors.toml has a row for this method, robot and goal."""
    assert name in FLOORS, (
        f"tests/solvers/floors.toml has no solve rates of {name}: begin with 1.0 for each"
    )
    row = FLOORS[name].get(robot_name, {})
    if kind == "orientation":
        return (
            "position" in row and "pose" in row and issubclass(OrientationGoal, SOLVERS[name].goals)
        )
    return kind in row


def cases(*kinds, names=NAMES):
    """Every (name, robot_name, kind) of the contract."""
    products = itertools.product(names, ROBOTS, kinds or KINDS)
    return pytest.mark.parametrize(
        ("name", "robot_name", "kind"), [c for c in products if is_supported(*c)]
    )


# Methods that support every robot and every kind of goal.
GENERAL = [n for n in NAMES if all(is_supported(n, r, k) for r in ROBOTS for k in KINDS)]
# Those of them that take steps until a budget ends them.
STEPPING = [n for n in GENERAL if issubclass(SOLVERS[n], IterativeSolver)]
general = pytest.mark.parametrize("name", GENERAL)
stepping = pytest.mark.parametrize("name", STEPPING)
all_robots = pytest.mark.parametrize("robot_name", ROBOTS)


def goal_of(robot, q, kind="pose", frame=None):
    pose = robot.forward(q, frame)
    if kind == "position":
        return PositionGoal(frame, pose.position)
    return OrientationGoal(frame, pose.wxyz) if kind == "orientation" else PoseGoal.at(frame, pose)


def measured(robot, q, goal):
    """Return the error in metres and radians, by MuJoCo, from the full qpos."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_forward(robot.model, data)
    site = robot.model.site(goal.frame or robot.tool).id
    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, data.site_xmat[site])
    metres, radians = Pose(data.site_xpos[site], wxyz).distance(goal.target)
    position_weight, angle_weight = goal.weights
    return metres if position_weight > 0.0 else 0.0, radians if angle_weight > 0.0 else 0.0


def supported_problem(robot, goal, *, solver, **options):
    """Return the problem, or None if the method does not support it."""
    try:
        return Problem(robot, goal, solver=solver, **options)
    except UnsupportedGoalError:
        return None


def inside(robot, q):
    return np.abs(robot.clip(q) - q).max() < 1e-12


def outcome(solution):
    return solution.status, solution.iterations, solution.restarts, solution.q.tobytes()
