"""Free solutions: branches, restarts, proofs and statuses, compared with MuJoCo."""

import copy

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import NotConvergedError, OptionError

ROUNDING = 1e-6
"""m. Largest difference of MuJoCo and the compiled check."""


def shelf():
    return [
        rik.Box("board", size=(0.3, 0.1, 0.4), pose=rik.Pose((0.5, 0.2, 0.4))),
        rik.Box("table", size=(1.5, 1.5, 0.02), pose=rik.Pose((0.0, 0.0, -0.05))),
    ]


def free_postures(scene, margin, count, seed=1):
    rng = np.random.default_rng(seed)
    q = np.array([scene.robot.sample(rng) for _ in range(40 * count)])
    return q[scene.free(q, margin)][:count]


@pytest.mark.parametrize("name", ["puma560", "ur5e", "panda", "koch_v11"])
@pytest.mark.parametrize("obstacles", [False, True])
def test_poses_with_a_free_posture_are_reached_freely(name, obstacles):
    robot = rik.load_robot(name)
    scene = rik.Scene(robot, shelf() if obstacles else [])
    avoid = rik.CollisionAvoidance(scene, margin=0.002)
    problem = None
    for q in free_postures(scene, 0.003, 60):
        goal = rik.PoseGoal.at(None, robot.forward(q))
        if robot.nv < 6:
            goal = rik.PositionGoal(None, robot.forward(q).position)
        problem = problem or rik.Problem(robot, goal, collisions=avoid)
        solution = problem.solve(target=goal)
        assert solution.converged, solution
        assert solution.clearance.distance >= avoid.margin - ROUNDING
        assert scene.clearance(solution.q).distance == solution.clearance.distance
        assert not robot.outside(solution.q)


def test_a_touching_solution_is_replaced_by_the_nearest_free_branch():
    robot = rik.load_robot("ur5e")
    scene = rik.Scene(robot, shelf())
    avoid = rik.CollisionAvoidance(scene, margin=0.0)
    replaced = 0
    for q in free_postures(scene, 0.001, 120):
        goal = robot.forward(q)
        before = rik.solve(robot, goal, solver="analytic")
        after = rik.solve(robot, goal, solver="analytic", collisions=avoid)
        if scene.clearance(before.q).distance >= 0.0:
            assert np.array_equal(before.q, after.q)
            continue
        replaced += 1
        branches = rik.solve_all(robot, goal, collisions=avoid)
        assert branches[0].free
        assert after.q == pytest.approx(branches[0].q, abs=1e-6)
        nearest = np.linalg.norm(branches[0].q - robot.home)
        assert all(np.linalg.norm(b.q - robot.home) >= nearest for b in branches if b.free)
    assert replaced > 5


def test_branches_that_collide_are_named():
    robot = rik.load_robot("ur5e")
    scene = rik.Scene(robot, shelf())
    avoid = rik.CollisionAvoidance(scene, margin=0.0)
    touching = []
    for q in free_postures(scene, 0.001, 20):
        branches = rik.solve_all(robot, robot.forward(q), collisions=avoid)
        plain = rik.solve_all(robot, robot.forward(q))
        assert sorted(b.name for b in branches) == sorted(b.name for b in plain)
        for branch in branches:
            assert branch.free == (branch.clearance.distance >= 0.0)
        touching += [branch for branch in branches if not branch.free]
    assert touching
    assert all(len(branch.clearance.pair) == 2 for branch in touching)


def test_no_free_branch_is_a_proof():
    """An obstacle at the tool: every branch touches, and no numeric search finds a free one."""
    robot = rik.load_robot("puma560")
    q = free_postures(rik.Scene(robot), 0.01, 1)[0]
    pose = robot.forward(q)
    scene = rik.Scene(robot, [rik.Sphere("ball", radius=0.03, pose=rik.Pose(pose.position))])
    avoid = rik.CollisionAvoidance(scene, margin=0.0)
    solution = rik.solve(robot, pose, collisions=avoid)
    assert solution.status is rik.Status.NO_FREE_BRANCH
    assert not solution.converged
    assert solution.error.position < 1e-4
    assert solution.clearance.distance < 0.0
    for branch in rik.solve_all(robot, pose, collisions=avoid):
        assert branch.clearance.distance < 0.0
    with pytest.raises(NotConvergedError, match="NO_FREE_BRANCH"):
        solution.require()
    rng = np.random.default_rng(3)
    starts = np.array([robot.sample(rng) for _ in range(2000)])
    many = rik.solve_batch(robot, [pose] * len(starts), starts=starts, solver="lm")
    reached = many.q[many.converged]
    assert len(reached) > 1000
    assert not scene.free(reached).any()


def test_a_goal_inside_an_obstacle_is_blocked_not_unreachable():
    robot = rik.load_robot("panda")
    pose = robot.forward(robot.home)
    scene = rik.Scene(robot, [rik.Sphere("ball", radius=0.08, pose=rik.Pose(pose.position))])
    solution = rik.solve(robot, pose, collisions=rik.CollisionAvoidance(scene))
    assert solution.status is rik.Status.BLOCKED_BY_COLLISION
    assert solution.error.position < 1e-4
    assert solution.clearance.distance < 0.0
    assert "ball" in solution.clearance.pair


def test_a_goal_out_of_reach_stays_unreachable_with_collisions():
    robot = rik.load_robot("puma560")
    avoid = rik.CollisionAvoidance(rik.Scene(robot))
    solution = rik.solve(robot, (9.0, 0.0, 0.0), collisions=avoid)
    assert solution.status is rik.Status.UNREACHABLE


def test_without_the_condition_every_solution_is_bit_equal():
    robot = rik.load_robot("panda")
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=0.0)
    for q in free_postures(avoid.scene, 0.0, 20):
        goal = robot.forward(q)
        # With a condition ``auto`` begins with a closed form.
        for solver in ("auto", "lm"):
            before = rik.solve(robot, goal, solver=solver)
            after = rik.solve(robot, goal, solver=solver, collisions=avoid)
            again = rik.solve(robot, goal, solver=solver)
            assert np.array_equal(before.q, again.q)
            if solver == "lm" and before.clearance.distance >= 0.0:
                assert np.array_equal(before.q, after.q)
                assert before.iterations == after.iterations


def test_the_same_seed_gives_the_same_bits():
    robot = rik.load_robot("panda")
    scene = rik.Scene(robot, shelf())
    avoid = rik.CollisionAvoidance(scene, margin=0.01)
    for q in free_postures(scene, 0.02, 20):
        goal = robot.forward(q)
        answers = [rik.solve(robot, goal, collisions=avoid, seed=4) for _ in range(2)]
        fresh = rik.Problem(robot, goal, collisions=avoid, seed=4).solve()
        assert np.array_equal(answers[0].q, answers[1].q)
        assert np.array_equal(answers[0].q, fresh.q)
        assert answers[0].iterations == fresh.iterations


def test_budgets_hold():
    robot = rik.load_robot("panda")
    pose = robot.forward(robot.home)
    scene = rik.Scene(robot, [rik.Sphere("ball", radius=0.08, pose=rik.Pose(pose.position))])
    avoid = rik.CollisionAvoidance(scene)
    for restarts in (0, 1, 7):
        budget = rik.Budget(restarts=restarts)
        solution = rik.solve(robot, pose, collisions=avoid, budget=budget)
        assert solution.restarts <= restarts
        assert solution.status is rik.Status.BLOCKED_BY_COLLISION
    for iterations in (0, 1, 50):
        budget = rik.Budget(iterations=iterations)
        solution = rik.solve(robot, pose, collisions=avoid, budget=budget)
        assert solution.iterations <= iterations


def test_several_goals_of_different_priority_and_a_free_base():
    robot = rik.load_robot("humanoid")
    scene = rik.Scene(robot)
    avoid = rik.CollisionAvoidance(scene, margin=0.002)
    hands = [name for name in robot.frames if "hand" in name][:2]
    assert len(hands) == 2
    solved = 0
    for q in free_postures(scene, 0.005, 8):
        goals = [
            rik.PositionGoal(hands[0], robot.forward(q, hands[0]).position),
            rik.PositionGoal(hands[1], robot.forward(q, hands[1]).position, priority=1),
        ]
        solution = rik.solve(robot, goals, start=q * 0.9 + robot.home * 0.1, collisions=avoid)
        if solution.converged:
            solved += 1
            assert scene.clearance(solution.q).distance >= avoid.margin - ROUNDING
    assert solved >= 6


def test_batches_equal_single_calls():
    robot = rik.load_robot("ur5e")
    scene = rik.Scene(robot, shelf())
    avoid = rik.CollisionAvoidance(scene, margin=0.0)
    poses = [robot.forward(q) for q in free_postures(scene, 0.001, 40)]
    many = rik.solve_batch(robot, poses, collisions=avoid)
    for row, pose in enumerate(poses):
        single = rik.solve(robot, pose, collisions=avoid)
        assert single.q == pytest.approx(many.q[row], abs=1e-12)
        assert single.status == many.status[row]
    assert scene.free(many.q[many.converged]).all()


def test_a_moved_obstacle_counts_in_the_next_solve():
    robot = rik.load_robot("puma560")
    q = free_postures(rik.Scene(robot), 0.01, 1)[0]
    pose = robot.forward(q)
    far = rik.Pose((0.0, 0.0, 9.0))
    scene = rik.Scene(robot, [rik.Sphere("ball", radius=0.03, pose=far)])
    problem = rik.Problem(robot, pose, collisions=rik.CollisionAvoidance(scene))
    assert problem.solve(q).converged
    scene.move("ball", rik.Pose(pose.position))
    assert problem.solve(q).status is rik.Status.NO_FREE_BRANCH
    scene.move("ball", far)
    assert problem.solve(q).converged


def test_ignored_pairs_may_touch():
    robot = rik.load_robot("puma560")
    pose = robot.forward(robot.home)
    scene = rik.Scene(robot, [rik.Sphere("ball", radius=0.03, pose=rik.Pose(pose.position))])
    parts = {part for part in scene.clearance(robot.home).pair if part != "ball"}
    assert rik.solve(robot, pose, collisions=rik.CollisionAvoidance(scene)).converged is False
    bodies = [robot.model.body(b).name for b in range(1, robot.model.nbody)]
    ignored = [(body, "ball") for body in bodies if body]
    avoid = rik.CollisionAvoidance(scene, margin=0.0, ignore=ignored)
    assert rik.solve(robot, pose, collisions=avoid).converged
    only = rik.CollisionAvoidance(scene, margin=0.0, pairs=[(parts.pop(), "ball")])
    assert only.clearance(robot.home).distance < 0.0


def test_wrong_conditions_are_refused():
    robot = rik.load_robot("puma560")
    scene = rik.Scene(robot)
    other = rik.CollisionAvoidance(rik.Scene(rik.load_robot("ur5e")))
    for wrong in (other, scene, True):
        with pytest.raises(OptionError):
            rik.solve(robot, (0.4, 0.0, 0.4), collisions=wrong)
    for margin in (-0.1, np.nan, "5 mm"):
        with pytest.raises(OptionError):
            rik.CollisionAvoidance(scene, margin=margin)
    with pytest.raises(LookupError):
        rik.CollisionAvoidance(scene, ignore=[("no such part", "link3")])
    with pytest.raises(OptionError):
        rik.CollisionAvoidance(scene, ignore=["link3"])


def test_a_copied_problem_keeps_the_condition():
    robot = rik.load_robot("puma560")
    avoid = rik.CollisionAvoidance(rik.Scene(robot))
    problem = rik.Problem(robot, robot.forward(robot.home), collisions=avoid)
    assert copy.copy(problem).collisions is avoid


def test_every_solution_has_its_clearance():
    robot = rik.load_robot("puma560")
    solution = rik.solve(robot, robot.forward(robot.home))
    assert solution.clearance.distance == rik.Scene(robot).clearance(solution.q).distance


def test_limited_steps_free_a_redundant_arm_without_a_restart():
    """The elbow of the arm touches a ball; the hand stays where it is.

    Without limited steps and restarts none of these is solved.
    """
    robot = rik.load_robot("panda")
    rng = np.random.default_rng(6)
    scene = rik.Scene(robot, [rik.Sphere("ball", radius=0.05)])
    avoid = rik.CollisionAvoidance(scene, margin=0.004)
    bare = rik.Scene(robot)
    link = robot.model.body("panda_link4").id
    led = 0
    tried = 0
    while tried < 20:
        q = robot.sample(rng)
        elbow = robot.data_at(q).xpos[link].copy()
        hand = robot.forward(q)
        if not bare.free(q, 0.005) or np.linalg.norm(elbow - hand.position) < 0.3:
            continue
        direction = rng.normal(size=3)
        scene.move("ball", rik.Pose(elbow + 0.1 * direction / np.linalg.norm(direction)))
        if not -0.03 < scene.clearance(q).distance < 0.0:
            continue
        tried += 1
        budget = rik.Budget(restarts=0)
        solution = rik.solve(robot, hand, start=q, solver="lm", collisions=avoid, budget=budget)
        assert solution.restarts == 0
        if solution.converged:
            led += 1
            assert solution.clearance.distance >= avoid.margin - ROUNDING
            assert solution.error.position < 1e-4
    assert led >= 7


@pytest.mark.parametrize("name", ["panda", "puma560", "koch_v11"])
@pytest.mark.parametrize("solver", ["lm", "auto"])
def test_the_nearest_free_posture_is_reported_beside_a_goal_that_touches(name, solver):
    robot = rik.load_robot(name)
    goal = rik.PositionGoal(None, robot.forward(robot.home).position)
    if robot.nv >= 6:
        goal = rik.PoseGoal.at(None, robot.forward(robot.home))
    radius = 0.04
    ball = rik.Sphere("ball", radius=radius, pose=rik.Pose(robot.forward(robot.home).position))
    scene = rik.Scene(robot, [ball])
    avoid = rik.CollisionAvoidance(scene, margin=0.005)
    solution = rik.solve(robot, goal, solver=solver, collisions=avoid)
    assert solution.status in (rik.Status.BLOCKED_BY_COLLISION, rik.Status.NO_FREE_BRANCH)
    nearest = solution.nearest_free
    assert nearest is not None
    assert nearest.clearance.distance >= avoid.margin - ROUNDING
    assert not robot.outside(nearest.q)
    assert not nearest.converged
    assert 1e-4 < nearest.error.position < 3.0 * radius
    # Random search among free postures finds none that is much nearer.
    rng = np.random.default_rng(4)
    moved = nearest.q + 0.1 * rng.normal(size=(2000, robot.nv))
    around = np.array([robot.clip(row) for row in moved])
    around = around[avoid.free(around)]
    target = goal.target.position
    distances = [np.linalg.norm(robot.forward(q).position - target) for q in around]
    assert min(distances) > 0.7 * nearest.error.position
    with pytest.raises(NotConvergedError, match="nearest without a collision"):
        solution.require()


def test_a_free_solution_has_no_nearest_free_posture():
    robot = rik.load_robot("panda")
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=0.002)
    q = free_postures(avoid.scene, 0.01, 1)[0]
    solution = rik.solve(robot, robot.forward(q), collisions=avoid)
    assert solution.converged
    assert solution.nearest_free is None
    blocked = rik.solve(robot, robot.forward(q), collisions=avoid, budget=rik.Budget(iterations=0))
    assert not blocked.converged


def test_a_humanoid_whose_arm_touches_reaches_with_both_hands():
    """Several goals of different priority; the start is in collision."""
    robot = rik.load_robot("humanoid")
    scene = rik.Scene(robot)
    hands = [name for name in robot.frames if "hand" in name][:2]
    avoid = rik.CollisionAvoidance(scene, margin=0.002)
    rng = np.random.default_rng(12)
    postures = np.array([robot.sample(rng) for _ in range(400)])
    free = scene.free(postures, 0.005)
    touching = [q for q in postures[~free] if -0.05 < scene.clearance(q).distance < 0.0]
    solved = 0
    for q, start in zip(postures[free][:10], touching[:10], strict=True):
        goals = [
            rik.PositionGoal(hands[0], robot.forward(q, hands[0]).position),
            rik.PositionGoal(hands[1], robot.forward(q, hands[1]).position, priority=1),
        ]
        begin = q.copy()
        moved = start - q
        moved[:7] = 0.0  # the base stays
        begin = robot.clip(begin + moved)
        solution = rik.solve(robot, goals, start=begin, collisions=avoid)
        if solution.converged:
            solved += 1
            assert scene.clearance(solution.q).distance >= avoid.margin - ROUNDING
    assert solved >= 5
