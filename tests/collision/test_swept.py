"""Arms of seven hinges: a free branch with the last joint near its start, checked by MuJoCo."""

import numpy as np
import pytest

import robot_ik as rik

ROUNDING = 1e-6
"""m. Largest difference of MuJoCo and the compiled check."""

LAST = "panda_joint7"


@pytest.fixture(scope="module")
def avoid():
    robot = rik.load_robot("panda")
    board = rik.Box("board", size=(0.3, 0.1, 0.4), pose=rik.Pose((0.5, 0.2, 0.4)))
    return rik.CollisionAvoidance(rik.Scene(robot, [board]), margin=0.002)


def free_postures(avoid, count, seed):
    rng = np.random.default_rng(seed)
    q = np.array([avoid.scene.robot.sample(rng) for _ in range(30 * count)])
    return q[avoid.scene.free(q, 0.003)][:count]


def test_solutions_are_exact_and_keep_the_margin(avoid):
    robot = avoid.scene.robot
    problem = rik.Problem(robot, rik.Pose(), collisions=avoid)
    by_closed_form = 0
    for q in free_postures(avoid, 100, 1):
        solution = problem.solve(target=robot.measure(q))
        assert solution.converged
        assert solution.clearance.distance >= avoid.margin - ROUNDING
        assert not robot.outside(solution.q)
        if solution.solver == "analytic":
            by_closed_form += 1
            assert max(solution.error.position, solution.error.angle) < 1e-7
    assert by_closed_form > 90


def test_the_last_joint_stays_at_its_start_if_a_branch_is_free_there(avoid):
    robot = avoid.scene.robot
    stayed = 0
    for start, q in zip(free_postures(avoid, 60, 2), free_postures(avoid, 60, 3), strict=True):
        pose = robot.measure(q)
        solution = rik.solve(robot, pose, start=start, collisions=avoid)
        branches = rik.solve_all(robot, pose, start=start, fixed={LAST: start[6]}, collisions=avoid)
        free = [branch for branch in branches if branch.free]
        if free:
            stayed += 1
            assert np.abs(solution.q - free[0].q).max() < 1e-6
        else:
            assert solution.q[6] != start[6]
    assert stayed > 15


def test_a_path_does_not_jump(avoid):
    robot = avoid.scene.robot
    first, last = free_postures(avoid, 2, 4)
    problem = rik.Problem(robot, rik.Pose(), collisions=avoid)
    q = first
    moved = []
    for share in np.linspace(0.0, 0.15, 60):
        wanted = first + share * (last - first)
        solution = problem.solve(q, target=robot.measure(wanted))
        if not solution.converged:
            break
        moved.append(np.abs(solution.q - q).max())
        q = solution.q
    assert len(moved) > 20
    assert max(moved) < 0.2


def test_a_free_start_at_the_goal_is_kept_and_a_touching_start_is_not(avoid):
    robot = avoid.scene.robot
    q = free_postures(avoid, 1, 5)[0]
    kept = rik.solve(robot, robot.forward(q), start=q, collisions=avoid)
    assert kept.converged
    assert kept.iterations == 0
    np.testing.assert_array_equal(kept.q, q)
    rng = np.random.default_rng(6)
    replaced = 0
    while replaced < 5:
        start = robot.sample(rng)
        if avoid.free(start):
            continue
        solution = rik.solve(robot, robot.forward(start), start=start, collisions=avoid)
        if solution.converged:
            replaced += 1
            assert solution.clearance.distance >= avoid.margin - ROUNDING


def test_batches_and_budgets_hold(avoid):
    robot = avoid.scene.robot
    postures = free_postures(avoid, 20, 7)
    poses = [robot.forward(q) for q in postures]
    batch = rik.solve_batch(robot, poses, collisions=avoid)
    for pose, q in zip(poses, batch.q, strict=True):
        single = rik.solve(robot, pose, collisions=avoid)
        # A single matrix becomes a quaternion and a matrix again.
        np.testing.assert_allclose(single.q, q, atol=1e-12)
    for budget in (rik.Budget(iterations=0), rik.Budget(seconds=0.0)):
        stopped = rik.solve(robot, poses[0], collisions=avoid, budget=budget)
        assert not stopped.converged
        assert stopped.iterations == 0
    far = rik.solve(robot, rik.Pose((3.0, 0.0, 0.5)), collisions=avoid)
    assert far.status is rik.Status.UNREACHABLE


def test_other_methods_and_a_trace_do_not_use_the_closed_form(avoid):
    robot = avoid.scene.robot
    pose = robot.forward(free_postures(avoid, 1, 8)[0])
    assert rik.solve(robot, pose, collisions=avoid, solver="lm").solver == "lm"
    traced = rik.Problem(robot, pose, collisions=avoid, trace=True).solve()
    assert traced.converged
    assert traced.trace_rows is not None
