"""The laws of every solver, on every robot of the contract."""

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.obstacles import Sphere
from robot_ik.collision.scene import Scene
from robot_ik.compiled_goals import length_scale
from robot_ik.geometry import Pose
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers import make_solver
from tests.solvers.law_cases import (
    FLOORS,
    NAMES,
    STEPPING,
    TOLERANCE,
    all_robots,
    cases,
    general,
    goal_of,
    inside,
    is_supported,
    measured,
    outcome,
    stepping,
)


@cases()
def test_laws_1_2_the_reported_error_and_status_are_true(name, robot_name, kind, robots, reachable):
    robot = robots(robot_name)
    solver = make_solver(name)
    for q in reachable(robot, 5):
        goal = goal_of(robot, q, kind)
        solution = Problem(robot, goal, tolerance=TOLERANCE, solver=solver).solve()
        metres, radians = measured(robot, solution.q, goal)
        assert solution.error.position == pytest.approx(metres, abs=1e-12)
        assert solution.error.angle == pytest.approx(radians, abs=1e-7)
        assert inside(robot, solution.q)
        reached = metres <= TOLERANCE.position and radians <= TOLERANCE.angle
        assert solution.converged == reached == (solution.status is Status.CONVERGED)


@cases()
def test_law_3_a_start_at_the_goal_is_the_solution(name, robot_name, kind, robots, reachable):
    robot = robots(robot_name)
    for q in reachable(robot, 5):
        solution = Problem(robot, goal_of(robot, q, kind), solver=name).solve(q)
        assert solution.converged and solution.iterations == 0 and solution.restarts == 0
        assert solution.q.tobytes() == q.tobytes() and solution.q is not q


@cases("pose", "position")
def test_laws_4_9_the_same_seed_gives_equal_bits_after_other_solves(
    name, robot_name, kind, robots, reachable
):
    robot = robots(robot_name)
    make_solver(name)
    goals = [goal_of(robot, q, kind) for q in reachable(robot, 6)]
    budget = Budget(iterations=600)
    fresh = [outcome(Problem(robot, g, budget=budget, seed=3, solver=name).solve()) for g in goals]
    hot = Problem(robot, goals[0], solver=name, budget=budget, seed=3)
    for order in (range(6), reversed(range(6))):
        for i in order:
            hot.retarget(goals[i].target)
            assert outcome(hot.solve()) == fresh[i]


@cases("pose", "position")
def test_law_5_inputs_are_not_modified_and_results_are_not_shared(
    name, robot_name, kind, robots, reachable
):
    robot = robots(robot_name)
    solver = make_solver(name)
    start, there, other = reachable(robot, 3)
    goal = goal_of(robot, there, kind)
    kept = [
        start.copy(),
        robot.lower.copy(),
        robot.upper.copy(),
        robot.home.copy(),
        goal.target.matrix,
    ]
    start.flags.writeable = False
    problem = Problem(robot, goal, solver=solver)
    first = problem.solve(start)
    solution_q = first.q.copy()
    problem.retarget(robot.forward(other))
    problem.solve(start)
    assert np.array_equal(first.q, solution_q)
    assert first.error.position == pytest.approx(measured(robot, solution_q, goal)[0], abs=1e-12)
    for before, now in zip(
        kept, [start, robot.lower, robot.upper, robot.home, goal.target.matrix], strict=True
    ):
        assert np.array_equal(before, now)


def out_of_reach(robot_name, kind, where):
    """Goals that cannot be met: far (provably), just out of reach, or behind the joint limits."""
    position = {
        ("puma560", "far"): (3.0, 1.0, 1.0),
        ("puma560", "near"): (0.85, 0.6, 0.9),
        ("puma560", "limits"): (0.02, 0.03, -0.5),
        ("planar", "far"): (4.0, 1.0, 0.0),
        ("planar", "near"): (0.6, 0.4, 0.05),
        ("planar", "limits"): (-0.02, 0.0, 0.0),
        ("tree", "far"): (5.0, 0.0, 5.0),
        ("tree", "near"): (1.2, 0.9, 1.2),
        ("tree", "limits"): (-0.6, -0.6, -0.4),
    }[robot_name, where]
    if kind == "position":
        return PositionGoal(None, position)
    return PoseGoal(None, position, (0.5, 0.5, -0.5, 0.5))


@cases("position", "pose")
@pytest.mark.parametrize("where", ["far", "near", "limits"])
def test_law_6_an_unreachable_goal_is_reported_and_approached(
    name, robot_name, where, kind, robots, reachable
):
    robot = robots(robot_name)
    goal = out_of_reach(robot_name, kind, where)
    problem = Problem(robot, goal, tolerance=TOLERANCE, budget=Budget(iterations=4000), solver=name)
    for start in reachable(robot, 2):
        solution = problem.solve(start)
        assert not solution.converged and inside(robot, solution.q)
        if where == "far":
            assert solution.status is Status.UNREACHABLE
        assert cost_of(problem, robot, solution.q, goal) <= cost_of(problem, robot, start, goal) * (
            1 + 1e-9
        )


def cost_of(problem, robot, q, goal):
    """Return the cost by MuJoCo: squares of metres over the length scale, and of radians."""
    metres, radians = measured(robot, q, goal)
    return (metres / length_scale(robot, goal)) ** 2 + radians**2


# Methods that come to rest at an unreachable target. The other methods may not.
RESTING = ("auto", "lm", "dls", "sdls", "bfgs")
TICKS = 140
SETTLING = 100
STILL = 1e-3


@cases("position", "pose", names=RESTING)
@pytest.mark.parametrize("where", ["far", "near", "limits"])
def test_law_6_tracking_comes_to_rest(name, robot_name, where, kind, robots):
    robot = robots(robot_name)
    budget = Budget(restarts=FLOORS["tracking_restarts"][name])
    problem = Problem(
        robot,
        out_of_reach(robot_name, kind, where),
        tolerance=TOLERANCE,
        budget=budget,
        solver=name,
    )
    make_solver(name)
    q = robot.home
    largest = 0.0
    for tick in range(TICKS):
        solution = problem.solve(q)
        assert not solution.converged
        if tick >= SETTLING:
            largest = max(largest, float(np.abs(solution.q - q).max()))
        q = solution.q
    assert largest <= STILL


@stepping
@all_robots
def test_law_7_budgets_hold(name, robot_name, robots):
    robot = robots(robot_name)
    goal = out_of_reach(robot_name, "pose", "near")
    solver = make_solver(name)
    for iterations in (0, 1, 7, 130):
        solution = Problem(robot, goal, budget=Budget(iterations=iterations), solver=solver).solve()
        assert solution.iterations <= iterations
        if iterations < 130:
            assert solution.status is Status.ITERATION_LIMIT
    assert np.array_equal(
        Problem(robot, goal, budget=Budget(iterations=0), solver=solver).solve().q, robot.home
    )
    assert Problem(robot, goal, budget=Budget(restarts=0), solver=solver).solve().restarts == 0
    assert Problem(robot, goal, budget=Budget(restarts=3), solver=solver).solve().restarts <= 3
    none = Problem(robot, goal, budget=Budget(seconds=0.0), solver=solver).solve()
    assert (
        none.status is Status.TIME_LIMIT
        and none.iterations == 0
        and np.array_equal(none.q, robot.home)
    )


@pytest.mark.parametrize("name", [n for n in NAMES if n not in STEPPING])
def test_law_7_methods_that_take_few_steps_keep_budgets_too(name, robots):
    robot = robots("puma560")
    never = out_of_reach(
        "puma560", "pose" if is_supported(name, "puma560", "pose") else "position", "near"
    )
    for budget, status in (
        (Budget(iterations=0), "ITERATION_LIMIT"),
        (Budget(seconds=0.0), "TIME_LIMIT"),
    ):
        none = Problem(robot, never, budget=budget, solver=name).solve()
        assert (
            none.status.name == status
            and none.iterations == 0
            and np.array_equal(none.q, robot.home)
        )
    for iterations in (1, 7):
        solution = Problem(robot, never, budget=Budget(iterations=iterations), solver=name).solve()
        assert not solution.converged and solution.iterations <= iterations


@stepping
def test_law_7_time_is_kept(name, robots):
    robot = robots("puma560")
    Problem(
        robot, PositionGoal(None, (3.0, 1.0, 1.0)), budget=Budget(iterations=1), solver=name
    ).solve()
    endless = Budget(iterations=1 << 40, seconds=0.1, restarts=1 << 40)
    solution = Problem(
        robot, out_of_reach("puma560", "pose", "near"), budget=endless, solver=name
    ).solve()
    assert solution.status is Status.TIME_LIMIT and solution.iterations > 100
    assert 0.1 <= solution.seconds < 2.0  # generous: the machine may be busy


@general
@pytest.mark.parametrize(
    ("robot_name", "active"),
    [("puma560", ["joint2", "joint3", "joint5"]), ("tree", ["rail", "shoulder", "swing"])],
)
def test_law_8_joints_that_are_frozen_or_do_not_matter_stay(
    name, robot_name, active, robots, reachable
):
    whole = robots(robot_name)
    robot = load_robot(whole.path, joints=active, tool=whole.tool)
    goal = goal_of(whole, reachable(whole, 1)[0])
    solution = Problem(robot, goal, solver=name, tolerance=TOLERANCE).solve(robot.home)
    assert solution.restarts > 0 or solution.iterations > 0
    qpos = robot.qpos(solution.q)
    for joint in whole.joints:
        first = int(robot.model.joint(joint).qposadr[0])
        if joint not in active:
            assert qpos[first] == robot.frozen_qpos[first]
    if "swing" in active:  # active, but it carries a lamp and not the tool
        assert solution.restarts > 0
        assert solution.q[-1] == robot.home[-1]


@cases("position", "pose")
def test_law_10_solve_rate(name, robot_name, kind, robots, reachable):
    robot = robots(robot_name)
    floor = FLOORS[name][robot_name][kind]
    solver = make_solver(name)
    goals = [goal_of(robot, q, kind) for q in reachable(robot, FLOORS["poses"])]
    problem = Problem(robot, goals[0], tolerance=TOLERANCE, solver=solver)
    solved = 0
    for goal in goals:
        problem.retarget(goal.target)
        solved += problem.solve().converged
    assert solved / len(goals) >= floor, f"{solved} of {len(goals)}"


@cases("pose", "position")
def test_law_11_converged_means_free_of_collisions(name, robot_name, kind, robots, reachable):
    """Two balls are at positions of the robot, so some goals have no free solution."""
    robot = robots(robot_name)
    places = [robot.forward(q).position for q in reachable(robot, 12)[10:]]
    balls = [Sphere(f"ball {k}", radius=0.05, pose=Pose(p)) for k, p in enumerate(places)]
    avoid = CollisionAvoidance(Scene(robot, balls), margin=0.01)
    budget = Budget(iterations=2000, restarts=20)
    for q in reachable(robot, 12):
        goal = goal_of(robot, q, kind)
        problem = Problem(
            robot, goal, solver=name, collisions=avoid, tolerance=TOLERANCE, budget=budget
        )
        solution = problem.solve()
        clearance = avoid.scene.clearance(solution.q).distance
        assert solution.clearance.distance == clearance
        if solution.converged:
            assert clearance >= avoid.margin - 1e-6
        if solution.status in (Status.BLOCKED_BY_COLLISION, Status.NO_FREE_BRANCH):
            metres, radians = measured(robot, solution.q, goal)
            assert metres <= TOLERANCE.position and radians <= TOLERANCE.angle
            assert clearance < avoid.margin + 1e-6


def test_law_10_floors_can_be_missed_and_low_ones_have_a_reason():
    for name in NAMES:
        for row in FLOORS[name].values():
            assert row.get("reason") or row.get("position", 1.0) >= 0.9
            assert all(row.get(kind, 1.0) > 0.0 for kind in ("position", "pose"))
