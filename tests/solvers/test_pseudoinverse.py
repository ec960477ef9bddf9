"""The pseudoinverse, its null space and goal halving against their formulas."""

from itertools import pairwise

import mujoco
import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.compiled_goals import length_scale
from robot_ik.errors import OptionError
from robot_ik.goals import PositionGoal
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solvers.pseudoinverse import Pseudoinverse
from tests.residual_rows import columns_of

# Largest distance of the end of a halved step from its subgoal, rad.
NEAR = 0.1
FREE_STEP = {"clamp": 1e6, "max_step": 1e6}
CASES = [(r, k) for r in ("puma560", "planar", "tree") for k in ("position", "orientation", "pose")]
CASES += [("tree", "two goals")]
cases = pytest.mark.parametrize(("robot_name", "kind"), CASES)
REDUNDANT = pytest.mark.parametrize("robot_name", ["puma560", "planar"])


@cases
def test_a_step_equals_the_pseudoinverse_of_numpy(
    robot_name, kind, near_problems, linear_model, one_step
):
    compared = 0
    for problem, q in near_problems(robot_name, kind):
        jacobian, e = linear_model(problem, q)
        expected = np.linalg.pinv(jacobian, rcond=1e-3) @ e
        step = one_step(Pseudoinverse(cutoff=1e-3, **FREE_STEP), problem, q)
        inside = np.abs(expected).max() < 0.4  # a longer step would be limited
        if inside:
            np.testing.assert_allclose(step, expected, atol=1e-8)
            compared += 1
    assert compared > 0


def test_the_cutoff_is_relative_to_the_largest(robots, linear_model, one_step):
    robot = robots("planar")
    q = np.array([0.3, 0.02, 0.02])  # nearly stretched
    problem = Problem(robot, PositionGoal(None, robot.forward(q).position - [0.01, 0.005, 0]))
    jacobian, e = linear_model(problem, q)
    ratio = np.linalg.svd(jacobian, compute_uv=False)
    ratio = ratio[1] / ratio[0]
    kept = one_step(Pseudoinverse(cutoff=0.9 * ratio, **FREE_STEP), problem, q)
    left_out = one_step(Pseudoinverse(cutoff=1.1 * ratio, **FREE_STEP), problem, q)
    np.testing.assert_allclose(kept, np.linalg.pinv(jacobian, rcond=0.9 * ratio) @ e, rtol=1e-6)
    np.testing.assert_allclose(left_out, np.linalg.pinv(jacobian, rcond=1.1 * ratio) @ e, rtol=1e-6)
    assert np.abs(left_out).max() < 0.1 < np.abs(kept).max()


def phi_of(aim, problem, q):
    robot = problem.robot
    if aim == "rest":
        return robot.home - q
    return ((robot.lower + robot.upper) / 2 - q) / ((robot.upper - robot.lower) / 2)


@REDUNDANT
@pytest.mark.parametrize("aim", ["rest", "limits"])
def test_the_null_space_motion_equals_the_formula(
    robot_name, aim, near_problems, linear_model, one_step
):
    for problem, q in near_problems(robot_name, "position"):
        robot = problem.robot
        jacobian, e = linear_model(problem, q)
        phi = 0.5 * phi_of(aim, problem, q)
        phi *= min(1.0, np.linalg.norm(e) / np.linalg.norm(phi))
        inverse = np.linalg.pinv(jacobian, rcond=1e-6)
        null = (np.eye(robot.nv) - inverse @ jacobian) @ phi
        plain = one_step(Pseudoinverse(cutoff=1e-6, **FREE_STEP), problem, q)
        step = one_step(Pseudoinverse(cutoff=1e-6, aim=aim, aim_gain=0.5, **FREE_STEP), problem, q)
        np.testing.assert_allclose(step - plain, null, atol=1e-6)
        # It does not move the tool, to first order, and moves the joints towards the aim.
        np.testing.assert_allclose(jacobian @ (step - plain), 0.0, atol=1e-9)
        assert null @ phi > 0.0
        moved = robot.measure(q + 0.01 * (step - plain)).position - robot.measure(q).position
        assert (
            np.linalg.norm(moved)
            < 1e-3 * 0.01 * np.linalg.norm(null) + 1e-4 * np.linalg.norm(null) ** 2
        )


@pytest.mark.parametrize("aim", ["rest", "limits"])
def test_tracking_with_an_aim_ends_nearer_to_it(aim, robots):
    """The tool moves to and fro on a line. The redundant joints drift to the aim."""
    robot = robots("puma560")
    start = robot.home + np.array([0.9, -0.6, 0.5, 0.8, 0.7, 1.0])
    here = robot.forward(start).position
    far = {}
    for name in ("none", aim):
        problem = Problem(
            robot,
            PositionGoal(None, here),
            solver=Pseudoinverse(aim=name),
            budget=Budget(restarts=0),
        )
        q = start
        for tick in range(201):
            problem.retarget(here + np.array([0.03 * np.sin(tick * np.pi / 10), 0, 0]))
            solution = problem.solve(q)
            assert solution.converged
            assert np.abs(solution.q - q).max() < 0.1
            q = solution.q
        scale = 1.0 if aim == "rest" else (robot.upper - robot.lower) / 2
        wanted = robot.home if aim == "rest" else (robot.upper + robot.lower) / 2
        far[name] = np.linalg.norm((q - wanted) / scale)
    assert far[aim] < 0.85 * far["none"]


def test_an_aim_works_on_balls_slides_and_unlimited_hinges(near_problems):
    for aim in ("rest", "limits"):
        for problem, q in near_problems("tree", "position", distance=0.3):
            assert (
                Problem(problem.robot, problem.goals, solver=Pseudoinverse(aim=aim))
                .solve(q)
                .converged
            )


def test_the_aim_rest_of_a_ball_is_a_rotation(robots, linear_model, one_step):
    robot = robots("tree")
    q = robot.integrate(robot.home, np.array([0, 0.2, 0.4, -0.3, 0.5, 0, 0, 0]))
    problem = Problem(robot, PositionGoal(None, robot.forward(q).position + np.array([0.1, 0, 0])))
    jacobian, _ = linear_model(problem, q)
    null = np.eye(7) - np.linalg.pinv(jacobian) @ jacobian
    plain = one_step(Pseudoinverse(cutoff=1e-9, **FREE_STEP), problem, q)
    step = one_step(Pseudoinverse(cutoff=1e-9, aim="rest", aim_gain=0.1, **FREE_STEP), problem, q)
    home = np.array(
        [0, -0.2, -0.4, 0.3, -0.5, 0, 0]
    )  # from the identity out and back along one axis
    np.testing.assert_allclose(step - plain, null @ (0.1 * home), atol=1e-8)


def test_the_aim_rest_of_a_floating_base_equals_that_of_mujoco(linear_model, one_step):
    robot = load_robot("humanoid")
    hinges = slice(7, None)  # after the base; inside their limits, which have no effect
    q = robot.integrate(robot.home, np.r_[0.2, -0.1, 0.3, 0.3, -0.2, 0.1, np.zeros(robot.nv - 6)])
    q[hinges] += 0.2 * ((robot.lower[6:] + robot.upper[6:]) / 2 - q[hinges])
    goals = [PositionGoal(f, robot.forward(q, f).position + 0.01) for f in ("left_hand", "gaze")]
    problem = Problem(robot, goals)
    jacobian, e = linear_model(problem, q)
    way = np.zeros(robot.nv)
    mujoco.mj_differentiatePos(robot.model, way, 1.0, q, robot.home)
    phi = way[columns_of(problem)]
    phi *= np.linalg.norm(e) / np.linalg.norm(phi)  # no longer than the residual
    null = np.eye(len(phi)) - np.linalg.pinv(jacobian) @ jacobian
    plain = one_step(Pseudoinverse(cutoff=1e-9, **FREE_STEP), problem, q)
    step = one_step(Pseudoinverse(cutoff=1e-9, aim="rest", aim_gain=1.0, **FREE_STEP), problem, q)
    np.testing.assert_allclose(plain, np.linalg.pinv(jacobian) @ e, atol=1e-9)
    np.testing.assert_allclose(step - plain, null @ phi, atol=1e-9)


# Goal halving


def distance_from_subgoal(problem, q, wanted, before, share, step):
    there = problem.robot.clip(problem.robot.integrate(q, np.asarray(step)))
    frame = problem.robot.measure(there)
    after = (problem.goals[0].target.position - frame.position) / length_scale(
        problem.robot, problem.goals[0]
    )
    return np.linalg.norm(after - (before - share * wanted))


def test_a_step_that_ends_far_from_its_subgoal_is_halved(robots, linear_model, one_step):
    robot = robots("puma560")
    rng = np.random.default_rng(8)
    halved = 0
    for _ in range(20):
        q = robot.home + rng.uniform(-0.2, 0.2, 6)
        target = robot.forward(robot.home + rng.uniform(-0.8, 0.8, 6)).position
        problem = Problem(robot, PositionGoal(None, target))
        _, e = linear_model(problem, q)
        whole = one_step(Pseudoinverse(**FREE_STEP), problem, q)
        step = one_step(Pseudoinverse(halvings=20, **FREE_STEP), problem, q)
        share = step[0] / whole[0]
        np.testing.assert_allclose(step, share * whole, atol=1e-12)
        assert np.log2(share) == pytest.approx(round(np.log2(share)), abs=1e-9)
        assert distance_from_subgoal(problem, q, e, e, share, step) <= NEAR
        if share < 1.0:
            assert distance_from_subgoal(problem, q, e, e, 2 * share, 2 * step) > NEAR
            halved += 1
    assert halved > 5


def test_halving_ends_and_never_raises_the_cost(robots):
    """No step to an unreachable goal ends at its subgoal. Steps that raise the cost are undone."""
    robot = robots("planar")
    problem = Problem(
        robot,
        PositionGoal(None, (1.4, 1.0, 0)),
        trace=True,
        budget=Budget(iterations=300, restarts=2),
        solver=Pseudoinverse(halvings=4),
    )
    solution = problem.solve(np.array([0.1, 1.2, -0.4]))
    assert not solution.converged
    first = [row.cost for row in solution.trace if row.restart == 0]
    assert len(first) > 5
    norms = np.sqrt(2 * np.array(first))
    assert all(
        b <= a + NEAR for a, b in pairwise(norms)
    )  # the cost rises by no more than the allowed distance from the subgoal


@pytest.mark.parametrize("kind", ["position", "pose"])
@pytest.mark.parametrize("robot_name", ["puma560", "planar", "tree"])
def test_halving_solves(robot_name, kind, near_problems):
    for problem, q in near_problems(robot_name, kind, distance=0.4):
        assert (
            Problem(problem.robot, problem.goals, solver=Pseudoinverse(halvings=8))
            .solve(q)
            .converged
        )


# Limits


def test_a_joint_at_its_limit_does_not_freeze_the_others(robots, linear_model, one_step):
    robot = robots("puma560")
    rng = np.random.default_rng(3)
    steps_at_limits = 0
    for _ in range(30):
        q = robot.home + rng.uniform(-0.3, 0.3, 6)
        q[1] = robot.lower[1]
        problem = Problem(
            robot, PositionGoal(None, robot.forward(q).position + rng.uniform(-0.02, 0.02, 3))
        )
        jacobian, e = linear_model(problem, q)
        whole = np.linalg.pinv(jacobian, rcond=1e-6) @ e
        step = one_step(Pseudoinverse(cutoff=1e-6, **FREE_STEP), problem, q)
        if jacobian[:, 1] @ e < 0 or whole[1] < 0:
            jacobian[:, 1] = 0.0
            whole = np.linalg.pinv(jacobian, rcond=1e-6) @ e
            steps_at_limits += 1
            assert step[1] == 0.0 and step.any()
        np.testing.assert_allclose(step, whole, atol=1e-8)
    assert steps_at_limits > 5


def test_a_clipped_step_never_raises_the_cost_of_the_linear_model(robots, linear_model, one_step):
    robot = robots("puma560")
    rng = np.random.default_rng(11)
    cut = 0
    for _ in range(100):
        q = robot.clip(robot.sample(rng) * rng.choice([0.99, 1.0, 3.0], 6))
        problem = Problem(robot, PositionGoal(None, robot.forward(robot.sample(rng)).position))
        jacobian, e = linear_model(problem, q)
        step = one_step(Pseudoinverse(**FREE_STEP), problem, q)
        assert (q + step <= robot.upper + 1e-12).all() and (q + step >= robot.lower - 1e-12).all()
        assert np.linalg.norm(e - jacobian @ step) <= np.linalg.norm(e) * (1 + 1e-12)
        cut += bool(
            (np.abs(q + step - robot.upper) < 1e-12).any()
            or (np.abs(q + step - robot.lower) < 1e-12).any()
        )
    assert cut > 20


def test_the_choices():
    with pytest.raises(OptionError, match=r"pseudoinverse.*aim.*none, rest, limits"):
        Pseudoinverse(aim="comfort")
