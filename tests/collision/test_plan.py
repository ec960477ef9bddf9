"""Planned motions: MuJoCo finds no pair within the margin at dense samples."""

import itertools

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import (
    GoalError,
    OptionError,
    PlanningError,
    TrajectoryError,
    UnknownPartError,
    UnsupportedJointError,
)

MARGIN = 0.003
"""m. Distance that the plans keep."""

STEP = 0.015
"""rad or m. Distance of the samples that MuJoCo checks."""

SHARE = 0.6
"""Share of the distance from home to random joint angles, for random postures."""


def smallest_distance(scene, rows, pairs=None):
    """Distance of the nearest pair on straight lines between rows (n, nq), by MuJoCo."""
    return min(scene.clearance(q, pairs).distance for q in dense_postures(rows))


def dense_postures(rows):
    """Samples of straight lines between rows (n, nq)."""
    samples = []
    for first, last in itertools.pairwise(rows):
        count = int(np.linalg.norm(last - first) / STEP) + 1
        samples.extend(first + k / count * (last - first) for k in range(count))
    return [*samples, rows[-1]]


def board(name, size, position):
    return rik.Box(name, size=size, pose=rik.Pose(position))


def rack(middle):
    """Two boards with a gap between them, and a post before the gap."""
    x, y, z = middle
    return [
        board("lower board", (0.3, 0.8, 0.02), (x, y, z - 0.2)),
        board("upper board", (0.3, 0.8, 0.02), (x, y, z + 0.2)),
        board("post", (0.03, 0.03, 0.4), (x - 0.15, y, z)),
    ]


def free_postures(avoid, count, seed=0):
    """Random postures (count, nq) that keep twice the margin."""
    rng = np.random.default_rng(seed)
    robot = avoid.scene.robot
    samples = np.array([robot.sample(rng) for _ in range(40 * count)])
    rows = robot.home + SHARE * (samples - robot.home)
    return rows[avoid.scene.free(rows, 2.0 * avoid.margin)][:count]


def blocked_ends(avoid, count, seed=0):
    """Pairs of free postures whose straight line is blocked."""
    rows = free_postures(avoid, 20 * count, seed)
    pairs = []
    for first, last in itertools.pairwise(rows):
        if not avoid.free(np.array(dense_postures(np.array([first, last])))).all():
            pairs.append((first, last))
    return pairs[:count]


@pytest.mark.parametrize("name", ["puma560", "panda", "ur5e", "so101", "omx_f"])
def test_planned_motions_keep_the_margin_and_the_limits(name):
    robot = rik.load_robot(name)
    reach = robot.reach()[1]
    obstacles = rack((0.6 * reach, 0.0, 0.4 * reach))
    avoid = rik.CollisionAvoidance(rik.Scene(robot, obstacles), margin=MARGIN)
    ends = blocked_ends(avoid, 3)
    assert len(ends) == 3
    for start, goal in ends:
        result = rik.plan(robot, start, goal, collisions=avoid)
        assert result.found, result
        trajectory = result.require()
        assert trajectory.certified
        assert trajectory.clearance == MARGIN
        assert np.array_equal(trajectory.q[0], start)
        assert np.array_equal(trajectory.q[-1], goal)
        assert len(result.corners) > 2
        assert (trajectory.peak_velocity <= robot.velocity_limits * (1 + 1e-9)).all()
        assert (trajectory.peak_acceleration <= robot.acceleration_limits * (1 + 1e-9)).all()
        assert not robot.outside(trajectory.q[len(trajectory) // 2])
        assert smallest_distance(avoid.scene, trajectory.q) >= MARGIN - 1e-6


def test_a_free_straight_line_is_the_fastest_move():
    robot = rik.load_robot("ur5e")
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=MARGIN)
    goal = robot.home + 0.2
    result = rik.plan(robot, robot.home, goal, collisions=avoid)
    move = rik.joint_move(robot, robot.home, goal, collisions=avoid)
    assert len(result.corners) == 2
    assert result.iterations == 0
    assert np.abs(result.require().q - move.q).max() < 1e-12


def test_a_plan_to_the_start_does_not_move():
    robot = rik.load_robot("ur5e")
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=MARGIN)
    result = rik.plan(robot, robot.home, robot.home, collisions=avoid)
    assert result.require().duration == 0.0
    assert result.require().certified


@pytest.mark.parametrize("name", ["puma560", "panda"])
def test_a_plan_to_a_pose_may_end_in_any_posture(name):
    """All branches of the PUMA, and several solutions of the Panda, may be the end."""
    robot = rik.load_robot(name)
    avoid = rik.CollisionAvoidance(rik.Scene(robot, rack((0.5, 0.0, 0.5))), margin=MARGIN)
    largest_count = 0
    for start, goal in blocked_ends(avoid, 3, seed=5):
        pose = robot.forward(goal)
        result = rik.plan(robot, start, pose, collisions=avoid)
        trajectory = result.require()
        position, angle = robot.measure(trajectory.q[-1]).distance(pose)
        assert position <= 1e-4
        assert angle <= 1e-3
        assert smallest_distance(avoid.scene, trajectory.q) >= MARGIN - 1e-6
        largest_count = max(largest_count, result.goal_postures)
    assert largest_count > 1


def test_the_same_seed_gives_equal_bits_and_another_seed_another_path():
    robot = rik.load_robot("panda")
    avoid = rik.CollisionAvoidance(rik.Scene(robot, rack((0.5, 0.0, 0.5))), margin=MARGIN)
    start, goal = blocked_ends(avoid, 1)[0]
    first, again, other = (
        rik.plan(robot, start, goal, collisions=avoid, seed=seed) for seed in (4, 4, -5)
    )
    assert np.array_equal(first.require().q, again.require().q)
    assert np.array_equal(first.require().times, again.require().times)
    assert first.iterations == again.iterations
    assert other.found
    assert not np.array_equal(first.corners, other.corners)


def wall_of_slides(gap):
    """A ball on two slides, and a wall of 20 mm with a gap between it and its other half."""
    half = 0.5 * (2.0 - gap)
    text = f"""<mujoco><worldbody>
      <geom name="left" type="box" size=".01 {half / 2} .5" pos="0 {(gap + half) / 2} 0"/>
      <geom name="right" type="box" size=".01 {half / 2} .5" pos="0 {-(gap + half) / 2} 0"/>
      <body name="car"><joint name="x" type="slide" axis="1 0 0" range="-1 1"/>
        <joint name="y" type="slide" axis="0 1 0" range="-.8 .8"/>
        <geom type="sphere" size=".05"/></body>
      </worldbody></mujoco>"""
    return rik.load_robot(text)


def test_a_passage_narrower_than_the_reserve_is_found():
    robot = wall_of_slides(gap=0.1 + 2 * (MARGIN + 0.002))
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=MARGIN)
    start = np.array([-0.5, 0.5])
    result = rik.plan(robot, start, np.array([0.5, 0.5]), collisions=avoid)
    trajectory = result.require()
    assert trajectory.certified
    assert smallest_distance(avoid.scene, trajectory.q) >= MARGIN - 1e-6


def test_a_plan_without_a_path_reports_its_iterations():
    robot = wall_of_slides(gap=0.08)
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=MARGIN)
    start = np.array([-0.5, 0.5])
    goal = np.array([0.5, 0.5])
    budget = rik.Budget(iterations=300)
    result = rik.plan(robot, start, goal, collisions=avoid, budget=budget)
    assert result.status is rik.PlanStatus.NO_PATH
    assert result.iterations == 300
    assert result.trajectory is None
    assert min(result.nodes) > 1
    assert "300 iterations" in result.meaning
    with pytest.raises(PlanningError, match="within the budget") as caught:
        result.require()
    assert caught.value.plan is result


def test_budgets_hold():
    robot = wall_of_slides(gap=0.08)
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=MARGIN)
    ends = np.array([-0.5, 0.5]), np.array([0.5, 0.5])
    nothing = rik.plan(robot, *ends, collisions=avoid, budget=rik.Budget(iterations=0))
    assert nothing.status is rik.PlanStatus.NO_PATH
    assert nothing.iterations == 0
    late = rik.plan(robot, *ends, collisions=avoid, budget=rik.Budget(1 << 40, seconds=0.05))
    assert late.status is rik.PlanStatus.NO_PATH
    assert late.out_of_time
    assert "seconds" in late.meaning
    once = rik.plan(robot, *ends, collisions=avoid, budget=rik.Budget(1 << 40, restarts=1))
    assert once.restarts == 1


def test_a_start_or_goal_in_collision_is_reported_with_its_depth():
    robot = rik.load_robot("puma560")
    tool = robot.forward(robot.home).position
    scene = rik.Scene(robot, [rik.Sphere("ball", radius=0.03, pose=rik.Pose(tool))])
    avoid = rik.CollisionAvoidance(scene, margin=MARGIN)
    free = free_postures(avoid, 1)[0]
    start = rik.plan(robot, robot.home, free, collisions=avoid)
    assert start.status is rik.PlanStatus.START_BLOCKED
    assert "ball" in start.blocked.pair
    assert start.blocked.distance == scene.clearance(robot.home).distance < 0.0
    assert f"{-1e3 * start.blocked.distance:.1f} mm" in start.meaning
    goal = rik.plan(robot, free, robot.home, collisions=avoid)
    assert goal.status is rik.PlanStatus.GOAL_BLOCKED
    assert "ball" in goal.blocked.pair
    pose = rik.plan(robot, free, robot.forward(robot.home), collisions=avoid)
    assert pose.status is rik.PlanStatus.GOAL_BLOCKED
    assert pose.solution.status is rik.Status.NO_FREE_BRANCH
    with pytest.raises(PlanningError, match="ball"):
        pose.require()


def test_a_goal_out_of_reach_is_a_proof():
    robot = rik.load_robot("puma560")
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=MARGIN)
    far = rik.Pose((5.0, 0.0, 0.5))
    result = rik.plan(robot, robot.home, far, collisions=avoid)
    assert result.status is rik.PlanStatus.GOAL_UNREACHABLE
    assert result.solution.status is rik.Status.UNREACHABLE


def test_an_attached_part_keeps_the_margin():
    robot = rik.load_robot("ur5e")
    scene = rik.Scene(robot, rack((0.55, 0.0, 0.5)))
    rod = rik.Cylinder("rod", radius=0.01, length=0.4, pose=rik.Pose((0.0, 0.0, 0.25)))
    holding = scene.attached(rod)
    avoid = rik.CollisionAvoidance(holding, margin=MARGIN)
    touches_without = 0
    for start, goal in blocked_ends(avoid, 4, seed=2):
        trajectory = rik.plan(robot, start, goal, collisions=avoid).require()
        assert smallest_distance(holding, trajectory.q) >= MARGIN - 1e-6
        bare = rik.CollisionAvoidance(scene, margin=MARGIN)
        without = rik.plan(robot, start, goal, collisions=bare).require()
        touches_without += smallest_distance(holding, without.q) < MARGIN
    assert touches_without


def grasp():
    """A gripper of two fingers on an arm of slides that holds a part on a table."""
    text = """<mujoco><worldbody>
      <geom name="table" type="box" size="1 1 .01" pos="0 0 -.01"/>
      <geom name="wall" type="box" size=".01 .3 .15" pos=".2 0 .15"/>
      <geom name="part" type="box" size=".02 .02 .03" pos="0 0 .031"/>
      <body name="carriage" pos="0 0 0">
        <joint name="x" type="slide" axis="1 0 0" range="-.6 .6"/>
        <joint name="y" type="slide" axis="0 1 0" range="-.6 .6"/>
        <joint name="z" type="slide" axis="0 0 1" range="0 .6"/>
        <geom name="left" type="box" size=".005 .01 .03" pos=".0255 0 .06"/>
        <geom name="right" type="box" size=".005 .01 .03" pos="-.0255 0 .06"/>
        <geom name="palm" type="box" size=".04 .02 .01" pos="0 0 .1"/>
        <site name="tcp" pos="0 0 .05" quat="0 1 0 0"/></body>
      </worldbody></mujoco>"""
    return rik.load_robot(text, tool="tcp")


def test_the_retreat_from_a_grasp_is_straight_and_only_the_allowed_pair_is_near():
    robot = grasp()
    scene = rik.Scene(robot)
    avoid = rik.CollisionAvoidance(scene, margin=MARGIN)
    start = np.zeros(3)
    goal = np.array([0.4, 0.0, 0.0])
    refused = rik.plan(robot, start, goal, collisions=avoid)
    assert refused.status is rik.PlanStatus.START_BLOCKED
    assert set(refused.blocked.pair) == {"carriage", "part"}
    allowed = [("carriage", "part")]
    result = rik.plan(robot, start, goal, collisions=avoid, allowed=allowed)
    trajectory = result.require()
    assert trajectory.certified
    fingers = [scene.model.geom(name).id for name in ("left", "right", "palm")]
    with_part = np.isin(scene.pairs, fingers).any(axis=1)
    with_part &= (scene.pairs == scene.model.geom("part").id).any(axis=1)
    assert smallest_distance(scene, trajectory.q, scene.pairs[~with_part]) >= MARGIN - 1e-6
    distances = [
        scene.clearance(q, scene.pairs[with_part]).distance for q in dense_postures(trajectory.q)
    ]
    assert min(distances) >= distances[0] - 1e-3
    leaves = int(np.argmax(np.array(distances) >= MARGIN))
    assert min(distances[leaves:]) >= MARGIN - 1e-6
    # In the other direction the grasp is approached along the same path.
    back = rik.plan(robot, goal, start, collisions=avoid, allowed=allowed)
    assert np.array_equal(back.require().q[-1], start)


def test_an_arm_retreats_from_a_part_that_its_hand_touches():
    robot = rik.load_robot("puma560")
    part = rik.Sphere("part", radius=0.02, pose=robot.forward(robot.home))
    scene = rik.Scene(robot, [part])
    assert scene.clearance(robot.home).distance < 0.0
    avoid = rik.CollisionAvoidance(scene, margin=MARGIN)
    goal = robot.home.copy()
    goal[0] += 0.8
    result = rik.plan(robot, robot.home, goal, collisions=avoid, allowed=[("hand", "part")])
    trajectory = result.require()
    assert trajectory.certified
    distances = np.array([scene.clearance(q).distance for q in dense_postures(trajectory.q)])
    leaves = int(np.argmax(distances >= MARGIN))
    assert distances[:leaves].min() >= distances[0] - 1e-3
    assert distances[leaves:].min() >= MARGIN - 1e-6


def test_a_gripper_moves_only_between_its_two_values():
    names = [*(f"joint{k}" for k in range(1, 6)), "gripper_joint_1", "gripper_joint_2"]
    robot = rik.load_robot("omx_f", joints=names)
    gripper = [names.index("gripper_joint_1"), names.index("gripper_joint_2")]
    reach = robot.reach()[1]
    scene = rik.Scene(robot, rack((0.6 * reach, 0.0, 0.4 * reach)))
    avoid = rik.CollisionAvoidance(scene, margin=0.001)
    start, goal = blocked_ends(avoid, 1)[0]
    trajectory = rik.plan(robot, start, goal, collisions=avoid).require()
    lower = np.minimum(start, goal)[gripper] - 1e-9
    upper = np.maximum(start, goal)[gripper] + 1e-9
    assert (trajectory.q[:, gripper] >= lower).all()
    assert (trajectory.q[:, gripper] <= upper).all()
    coupled = [robot.apply_couplings(q) for q in trajectory.q]
    assert np.abs(trajectory.q - coupled).max() < 1e-6


def test_wrong_input_is_refused():
    robot = rik.load_robot("puma560")
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=MARGIN)
    home = robot.home
    with pytest.raises(OptionError):
        rik.plan(robot, home, home, collisions=rik.Scene(robot))
    with pytest.raises(OptionError):
        rik.plan(rik.load_robot("ur5e"), home, home, collisions=avoid)
    with pytest.raises(TrajectoryError, match="start"):
        rik.plan(robot, [0.0] * 5, home, collisions=avoid)
    with pytest.raises(TrajectoryError, match="goal"):
        rik.plan(robot, home, [np.nan] * 6, collisions=avoid)
    with pytest.raises(TrajectoryError, match="allowed"):
        rik.plan(robot, home, [100.0] * 6, collisions=avoid)
    with pytest.raises(GoalError):
        rik.plan(robot, home, None, collisions=avoid)
    with pytest.raises(OptionError):
        rik.plan(robot, home, home, collisions=avoid, budget=5)
    with pytest.raises(OptionError):
        rik.plan(robot, home, home, collisions=avoid, seed="one")
    with pytest.raises(OptionError):
        rik.plan(robot, home, home, collisions=avoid, allowed="gripper")
    with pytest.raises(UnknownPartError):
        rik.plan(robot, home, home, collisions=avoid, allowed=[("hand", "moon")])
    with pytest.raises(TrajectoryError, match="speed"):
        rik.plan(robot, home, home, collisions=avoid, speed=2.0)
    with pytest.raises(GoalError):
        rik.plan(robot, home, [rik.Pose((0.4, 0.0, 0.3)), 1.0], collisions=avoid)


def test_free_bases_are_refused_with_a_message():
    robot = rik.load_robot("humanoid")
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=MARGIN)
    with pytest.raises(UnsupportedJointError, match="ball or free"):
        rik.plan(robot, robot.home, robot.home, collisions=avoid)
