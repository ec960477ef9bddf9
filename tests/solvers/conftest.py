"""The robots of the contract: the PUMA, a planar arm, and a tree of slides and balls."""

from collections.abc import Callable

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.compiled_goals import length_scale
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, OrientationGoal, PoseGoal, PositionGoal
from robot_ik.kernels.tree import BALL
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers.iterative import IterativeSolver

PLANAR = """<mujoco model="planar"><compiler angle="radian"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 0 1" range="-2.8 2.8"/><geom size="0.02"/>
 <body name="lower" pos="0.5 0 0"><joint name="elbow" axis="0 0 1" range="-2.6 2.6"/>
 <geom size="0.02"/>
  <body name="hand" pos="0.4 0 0"><joint name="wrist" axis="0 0 1" range="-2 2"/><geom size="0.02"/>
   <site name="tool" pos="0.2 0 0"/></body></body></body>
<site name="nail" pos="0.3 0.3 0"/>
</worldbody><keyframe><key name="home" qpos="0.2 0.4 0.3"/></keyframe></mujoco>"""

# A carriage on a rail with a column. The column carries an arm with a ball joint, and a branch.
TREE = """<mujoco model="tree"><compiler angle="radian"/><worldbody>
<body name="carriage" pos="0 0 0.2" quat="0.9 0.1 -0.2 0.3">
 <joint name="rail" type="slide" axis="1 0 0" range="-0.5 0.5"/>
 <joint name="column" type="slide" axis="0 0 1" range="0 0.6" ref="0.1"/><geom size="0.05"/>
 <body name="arm" pos="0 0 0.3"><joint name="shoulder" type="ball" range="0 1.2" limited="true"/>
  <geom size="0.05"/>
  <body name="forearm" pos="0.4 0 0">
  <joint name="elbow" pos="0.05 0 0" axis="0 1 0.2" range="-2.2 2.2"/>
   <geom size="0.05"/>
   <body name="hand" pos="0.3 0 0"><joint name="roll" axis="1 0 0"/><geom size="0.05"/>
    <site name="tool" pos="0.1 0 0" quat="0.7 0 0.7 0.1"/></body></body></body>
 <body name="branch" pos="0 0.2 0"><joint name="swing" axis="0 0 1" range="-1 1"/>
 <geom size="0.05"/>
  <site name="lamp" pos="0 0.3 0"/></body>
</body></worldbody></mujoco>"""


@pytest.fixture(scope="session")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Robot]:
    """``robots("planar")``: a robot of the contract, loaded once."""
    folder = tmp_path_factory.mktemp("robots")
    (folder / "planar.xml").write_text(PLANAR)
    (folder / "tree.xml").write_text(TREE)
    loaded: dict[str, Robot] = {}

    def get(name: str) -> Robot:
        if name not in loaded:
            loaded[name] = load_robot(
                "puma560" if name == "puma560" else folder / f"{name}.xml", tool=TOOLS[name]
            )
        return loaded[name]

    return get


TOOLS = {"puma560": None, "planar": "tool", "tree": "tool"}


@pytest.fixture(scope="session")
def reachable() -> Callable[..., list[np.ndarray]]:
    """``reachable(robot, count)``: the seeded q whose poses are the set of the solve rates."""

    def draw(robot: Robot, count: int, seed: int = 20) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        return [robot.sample(rng) for _ in range(count)]

    return draw


def _right_jacobian_inverse(phi: np.ndarray) -> np.ndarray:
    """J_r⁻¹ of phi = log(R_target Rᵀ), for a rotation of R (Solà et al. 2018, eq. 144)."""
    cross = np.cross(np.eye(3), -phi)
    angle = float(np.linalg.norm(phi))
    if angle < 1e-9:
        return np.eye(3)
    k = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.eye(3) + 0.5 * cross + k * cross @ cross


@pytest.fixture(scope="session")
def linear_model() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """``linear_model(problem, q, alternative=False)``: J (m, nu) and e (m,).

    J is from ``robot.jacobian`` and e from MuJoCo. With ``alternative`` the target replaces the
    frame in the rows of positions: v × (t − p) = v × (s − p) + v × (t − s).
    """

    def model(
        problem: Problem, q: np.ndarray, alternative: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        robot = problem.robot
        rows = []
        errors = []
        for goal in problem.goals:
            here = robot.measure(q, goal.frame)
            whole = robot.jacobian(q, goal.frame)
            off = goal.target.position - here.position
            if goal.weights[0] > 0.0:
                weight = goal.weights[0] / length_scale(robot, goal)
                moved = np.cross(whole[3:].T, off).T if alternative else 0.0
                rows.append(weight * (whole[:3] + moved))
                errors.append(weight * off)
            if goal.weights[1] > 0.0:
                quat = Pose.from_rotation(goal.target.rotation @ here.rotation.T, np.zeros(3)).wxyz
                quat = quat if quat[0] >= 0 else -quat
                sine = float(np.linalg.norm(quat[1:]))
                phi = 2 * np.arctan2(sine, quat[0]) * quat[1:] / sine
                rows.append(goal.weights[1] * _right_jacobian_inverse(phi) @ whole[3:])
                errors.append(goal.weights[1] * phi)
        return np.vstack(rows)[:, problem.compiled.block.arrays["dofs"]], np.concatenate(errors)

    return model


@pytest.fixture(scope="session")
def one_step() -> Callable[..., np.ndarray]:
    """``one_step(solver, problem, q)``: the step (nu,) that a method takes from q."""

    def step(solver: IterativeSolver, problem: Problem, q: np.ndarray) -> np.ndarray:
        budget = Budget(iterations=1, restarts=0)
        one = Problem(problem.robot, problem.goals, solver=solver, budget=budget)
        solution = one.solve(q)
        assert solution.iterations == 1
        taken: np.ndarray = one.search.arrays["step"].copy()
        assert np.isfinite(taken).all()
        return taken

    return step


@pytest.fixture(scope="session")
def near_problems(
    robots: Callable[[str], Robot],
) -> Callable[..., list[tuple[Problem, np.ndarray]]]:
    """``near_problems(robot name, kind, distance)``: starts inside the limits, goals near them."""

    def make(
        name: str, kind: str, distance: float = 0.05, count: int = 6
    ) -> list[tuple[Problem, np.ndarray]]:
        robot = robots(name)
        rng = np.random.default_rng(7)
        ball = robot.tree.kind[robot.tree.dof_node] >= BALL
        margin = np.where(np.isfinite(robot.lower), 0.25 * (robot.upper - robot.lower), 0.5)
        lower = np.where(ball, -np.inf, np.maximum(robot.lower, -9) + margin)
        upper = np.where(ball, np.pi / 2, np.minimum(robot.upper, 9) - margin)
        inner = robot.with_limits(lower, upper)
        problems = []
        for _ in range(count):
            q = inner.sample(rng)
            there = robot.clip(robot.integrate(q, rng.uniform(-distance, distance, robot.nv)))
            frames = [None, "lamp"] if kind == "two goals" else [None]
            goals = [_goal(robot, there, kind, frame) for frame in frames]
            problems.append((Problem(robot, goals), q))
        return problems

    return make


def _goal(robot: Robot, q: np.ndarray, kind: str, frame: str | None) -> Goal:
    pose = robot.forward(q, frame)
    if kind in ("position", "two goals"):
        return PositionGoal(frame, pose.position, weight=1.0 if frame is None else 2.0)
    if kind == "orientation":
        return OrientationGoal(frame, pose.wxyz)
    return PoseGoal(frame, pose.position, pose.wxyz, position_weight=1.5)
