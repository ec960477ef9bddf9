"""Following with limited steps: the margin is kept, and collisions at the start are left."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_ik as rik
from robot_ik.kernels import collision, quadratic_program
from robot_ik.motion.trajectory import RecorderSink
from robot_ik.solvers.limited_step import LimitedStep

READY = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


class Push:
    """A goal that moves down through a box and back."""

    def __init__(self, robot, begin, seconds):
        self.begin = begin
        self.seconds = seconds
        self.robot = robot

    def poll(self, now):
        u = 2.0 * np.pi * min(now / self.seconds, 1.0)
        shift = (0.12 * np.sin(u), 0.25 * np.sin(2 * u), -0.25 * (1 - np.cos(u)) / 2)
        return rik.PoseGoal.at(None, rik.Pose(self.begin.position + shift, self.begin.wxyz))


@pytest.mark.parametrize(("rate", "share"), [(200.0, 0.8), (1000.0, 0.95)])
def test_following_keeps_the_margin(rate, share):
    robot = rik.load_robot("panda")
    box = rik.Box("box", size=(0.2, 0.3, 0.4), pose=rik.Pose((0.5, 0.0, 0.2)))
    table = rik.Box("table", size=(1.1, 1.0, 0.03), pose=rik.Pose((0.3, 0.0, -0.03)))
    scene = rik.Scene(robot, [box, table])
    start = READY
    avoid = rik.CollisionAvoidance(scene, margin=0.005)
    assert avoid.free(start)
    recorder = RecorderSink(robot.joints)
    report = rik.follow(
        robot,
        Push(robot, robot.forward(start), 2.0),
        sinks=[recorder],
        start=start,
        rate=rate,
        duration=2.0,
        clock=rik.VirtualClock(),
        collisions=avoid,
    )
    q = recorder.trajectory().q
    smallest = min(scene.clearance(row).distance for row in q)
    assert share * avoid.margin - 1e-6 <= smallest
    assert smallest < 0.02  # the box blocked the motion
    limits = robot.velocity_limits / rate
    assert (np.abs(np.diff(q, axis=0)) <= limits * (1 + 1e-9)).all()
    assert report.statuses["ITERATION_LIMIT"] > 0


def test_without_an_obstacle_the_goal_is_reached():
    robot = rik.load_robot("panda")
    start = READY
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=0.002)
    goal = robot.forward(start)
    goal = rik.Pose(goal.position + np.array((0.05, 0.1, 0.0)), goal.wxyz)

    class Still:
        def poll(self, now):
            return rik.PoseGoal.at(None, goal)

    report = rik.follow(
        robot,
        Still(),
        sinks=[],
        start=start,
        duration=2.0,
        clock=rik.VirtualClock(),
        collisions=avoid,
    )
    assert report.last.converged
    assert report.last.error.position < 1e-4


def test_a_goal_behind_a_wall_is_blocked():
    robot = rik.load_robot("panda")
    start = READY
    tool = robot.forward(start)
    wall = rik.Box(
        "wall", size=(0.6, 0.02, 1.2), pose=rik.Pose(tool.position + np.array((0, 0.3, 0)))
    )
    scene = rik.Scene(robot, [wall])
    avoid = rik.CollisionAvoidance(scene, margin=0.005)

    class Behind:
        def poll(self, now):
            return rik.PositionGoal(None, tool.position + np.array((0.0, 0.3, 0.0)))

    report = rik.follow(
        robot,
        Behind(),
        sinks=[],
        start=start,
        duration=6.0,
        clock=rik.VirtualClock(),
        collisions=avoid,
    )
    assert report.last.status is rik.Status.BLOCKED_BY_COLLISION
    assert report.last.clearance.distance > 0.0
    assert "wall" in report.last.clearance.pair


def test_an_obstacle_that_comes_nearer_pushes_the_arm_away():
    robot = rik.load_robot("panda")
    start = READY
    tool = robot.forward(start)
    ball = rik.Sphere("ball", radius=0.05, pose=rik.Pose(tool.position + np.array((0, 0.4, 0))))
    scene = rik.Scene(robot, [ball])
    avoid = rik.CollisionAvoidance(scene, margin=0.01)
    distances = []

    class Stay:
        def poll(self, now):
            shift = np.array((0.0, 0.4 - 0.1 * min(now, 3.0), 0.0))
            scene.move("ball", rik.Pose(tool.position + shift))
            return rik.PositionGoal(None, tool.position)

    rik.follow(
        robot,
        Stay(),
        sinks=[],
        start=start,
        rate=200.0,
        duration=3.5,
        clock=rik.VirtualClock(),
        collisions=avoid,
        on_tick=lambda tick: distances.append(scene.clearance(tick.q).distance),
    )
    assert min(distances) > 0.5 * avoid.margin


@pytest.mark.parametrize("name", ["panda", "puma560", "ur5e"])
def test_a_start_in_collision_is_left(name):
    robot = rik.load_robot(name)
    rng = np.random.default_rng(8)
    scene = rik.Scene(robot, [rik.Box("box", size=(0.2, 0.3, 0.4), pose=rik.Pose((0.5, 0.0, 0.4)))])
    avoid = rik.CollisionAvoidance(scene, margin=0.002)
    q = np.array([robot.sample(rng) for _ in range(600)])
    touching = [row for row in q if -0.02 < scene.clearance(row).distance < 0.0][:20]
    free = q[avoid.free(q)]
    assert len(touching) == 20
    out = 0
    for start in touching:
        goal = rik.PoseGoal.at(None, robot.forward(free[0]))
        problem = rik.Problem(robot, goal)
        step = LimitedStep(problem, avoid, np.full(robot.nv, 0.02))
        posture = start
        before = scene.clearance(start).distance
        for _ in range(60):
            posture = step.solve(problem, posture).q
            distance = scene.clearance(posture).distance
            assert distance >= min(before, 0.9 * avoid.margin) - 5e-4
            before = distance
        out += before >= 0.9 * avoid.margin - 1e-6
    assert out >= 18


@pytest.mark.parametrize("name", ["puma560", "panda", "humanoid", "seven_segment"])
def test_gradients_equal_finite_differences(name):
    robot = rik.load_robot(name)
    rng = np.random.default_rng(9)
    scene = rik.Scene(
        robot, [rik.Capsule("rod", radius=0.03, length=0.4, pose=rik.Pose((0.4, 0, 0.4)))]
    )
    avoid = rik.CollisionAvoidance(scene)
    memory = avoid.memory()
    check = memory.nested["check"]
    compared = 0
    for _ in range(12):
        q = robot.sample(rng)
        collision.near_pairs(memory.address, q, 0.05)
        for k in range(check["near_count"]):
            distance = check.arrays["near_distance"][k]
            if distance < 1e-3:
                continue
            pair = avoid.tables.geoms[check.arrays["near_pair"][k]][None]
            row = check.arrays["near_rows"][k].copy()
            direction = rng.normal(size=robot.nv)
            h = 1e-6
            ends = [
                scene.clearance(robot.integrate(q, s * h * direction), pair).distance
                for s in (-1.0, 1.0)
            ]
            middle = scene.clearance(q, pair).distance
            assert distance == pytest.approx(middle, abs=1e-6)
            slopes = (middle - ends[0]) / h, (ends[1] - middle) / h
            if abs(slopes[0] - slopes[1]) < 1e-3:  # the nearest points are unique
                assert row @ direction == pytest.approx(0.5 * sum(slopes), abs=5e-3)
                compared += 1
    assert compared > 10


@given(st.integers(0, 2**32 - 1), st.integers(2, 8), st.integers(0, 12))
def test_quadratic_programs_keep_their_conditions_of_optimality(seed, size, count):
    rng = np.random.default_rng(seed)
    program = quadratic_program.PROGRAM.allocate({"u": size, "r": max(count, 1), "s": size + 1})
    root = rng.normal(size=(size, size))
    hessian = root @ root.T + 0.1 * np.eye(size)
    gradient = rng.normal(size=size)
    rows = rng.normal(size=(count, size))
    low = -rng.uniform(0.1, 1.0, size)
    high = rng.uniform(0.1, 1.0, size)
    inside = rng.uniform(low, high)
    bounds = rows @ inside - rng.uniform(0.0, 0.3, count)
    arrays = program.arrays
    arrays["hessian"][...] = hessian
    arrays["gradient"][...] = gradient
    arrays["lower"][...] = low
    arrays["upper"][...] = high
    arrays["rows"][:count] = rows
    arrays["bounds"][:count] = bounds
    program["row_count"] = count
    assert quadratic_program.solve(program.address)
    d = arrays["solution"]
    assert (rows @ d >= bounds - 1e-8).all()
    assert (d >= low - 1e-8).all()
    assert (d <= high + 1e-8).all()
    # The gradient is a sum of active normals with positive multipliers.
    active = program["active"]
    normals = arrays["normals"][:active]
    multipliers = arrays["multiplier"][:active]
    assert (multipliers >= -1e-9).all()
    assert hessian @ d - gradient == pytest.approx(multipliers @ normals, abs=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_depths_are_close_to_those_of_mujoco(seed):
    """Compiled depths are used to leave a collision. Reported depths are those of MuJoCo."""
    rng = np.random.default_rng(seed)
    robot = rik.load_robot(rng.choice(["puma560", "panda", "ur5e", "humanoid"]))
    scene = rik.Scene(robot, [rik.Box("box", size=(0.2, 0.3, 0.4), pose=rik.Pose((0.5, 0, 0.4)))])
    avoid = rik.CollisionAvoidance(scene)
    memory = avoid.memory()
    check = memory.nested["check"]
    q = robot.sample(rng)
    collision.near_pairs(memory.address, q, 0.0)
    for k in range(check["near_count"]):
        pair = avoid.tables.geoms[check.arrays["near_pair"][k]][None]
        depth = -scene.clearance(q, pair).distance
        found = -check.arrays["near_distance"][k]
        assert found >= depth - 1e-4
        assert found <= 3.0 * depth + 2e-3  # not the smallest depth of all directions
