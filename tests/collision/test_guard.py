"""Motions that are allowed or refused, and starts in contact. MuJoCo checks the distances."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import MotionBlockedError
from robot_ik.motion.guard import MotionGuard, parts_of
from robot_ik.motion.guarded_stream import GuardedStream

MARGIN = 0.005
"""m."""


@pytest.fixture(scope="module")
def robot():
    return rik.load_robot("tabletop_puma")


def free_postures(avoid, count, seed):
    rng = np.random.default_rng(seed)
    q = np.array([avoid.scene.robot.sample(rng) for _ in range(30 * count)])
    return q[avoid.free(q)][:count]


def sphere_at(position, radius=0.02):
    return rik.Sphere("ball", radius=radius, pose=rik.Pose(position))


def pedestal(robot, depth):
    """A scene with a box below the tool that touches the arm at home by about ``depth``, m."""
    tool = robot.forward(robot.home).position
    top = tool[2] - 0.3
    for _ in range(20):
        pose = rik.Pose((tool[0], tool[1], top - 0.05))
        scene = rik.Scene(robot, [rik.Box("pedestal", size=(0.08, 0.08, 0.1), pose=pose)])
        distance = scene.clearance(robot.home).distance
        if abs(distance + depth) < 2e-4:
            return scene
        top += 0.9 * (distance + depth)
    raise AssertionError("the box does not touch the arm as it should")


def test_a_free_motion_is_certified_and_a_blocked_one_refused(robot):
    first = robot.home
    last = first.copy()
    last[0] += 0.8
    middle = robot.forward(0.5 * (first + last)).position
    free = MotionGuard(rik.CollisionAvoidance(rik.Scene(robot), MARGIN))
    move = rik.joint_move(robot, first, last)
    checked = free.checked(move)
    assert checked.certified
    assert np.array_equal(checked.q, move.q)
    blocked = MotionGuard(rik.CollisionAvoidance(rik.Scene(robot, [sphere_at(middle)]), MARGIN))
    with pytest.raises(MotionBlockedError, match="ball") as caught:
        blocked.checked(move)
    assert 0.0 < caught.value.time < move.duration
    assert blocked.collisions.clearance(caught.value.q).distance < MARGIN


def test_an_arm_in_contact_may_move_away_but_not_closer(robot):
    """The tool presses on a box. Only motions away from it are allowed."""
    first = robot.home
    scene = pedestal(robot, 0.003)
    avoid = rik.CollisionAvoidance(scene, MARGIN)
    guard = MotionGuard(avoid)
    assert scene.clearance(first).distance < 0.0
    outcomes = {True: 0, False: 0}
    rng = np.random.default_rng(5)
    for _ in range(60):
        last = robot.clip(first + 0.15 * rng.normal(size=robot.nv))
        move = rik.joint_move(robot, first, last)
        near = avoid.near(first)
        distances = np.array([scene.pair_distances(q, near, MARGIN) for q in move.q])
        never_nearer = (distances >= distances[0] - 2e-4).all()
        try:
            checked = guard.checked(move)
        except MotionBlockedError as error:
            outcomes[False] += 1
            assert scene.clearance(error.q).distance < MARGIN
            continue
        outcomes[True] += 1
        assert never_nearer
        assert not checked.certified
    assert outcomes[True] > 3
    assert outcomes[False] > 3


def test_parts_that_have_separated_must_keep_the_margin(robot):
    first = robot.home
    scene = pedestal(robot, -0.002)
    guard = MotionGuard(rik.CollisionAvoidance(scene, MARGIN))
    pose = robot.forward(first)
    above = rik.Pose(pose.position + np.array((0.0, 0.0, 0.04)), pose.wxyz)
    out = rik.line_move(robot, first, above)
    guard.checked(out)
    times = np.concatenate([out.times, out.times[-1] + out.times[1:]])
    there_and_back = rik.Trajectory(times, np.concatenate([out.q, out.q[-2::-1]]), robot.joints)
    with pytest.raises(MotionBlockedError):
        guard.checked(there_and_back)


def test_a_long_recording_is_checked_to_its_end(robot):
    """More samples than one proof covers; the contact is in the last part."""
    first = robot.home
    last = first.copy()
    last[0] += 0.8
    move = rik.joint_move(robot, first, last)
    rng = np.random.default_rng(2)
    tremble = first + 1e-3 * rng.uniform(-1.0, 1.0, (2500, robot.nv))
    tremble[-1] = first
    q = np.concatenate([tremble, move.q])
    recording = rik.Trajectory(np.arange(len(q)) / 100.0, q, robot.joints)
    assert len(parts_of(recording)) == 3
    free = MotionGuard(rik.CollisionAvoidance(rik.Scene(robot), MARGIN))
    assert free.checked(recording).certified
    ball = sphere_at(robot.forward(last).position)
    guard = MotionGuard(rik.CollisionAvoidance(rik.Scene(robot, [ball]), MARGIN))
    with pytest.raises(MotionBlockedError) as caught:
        guard.checked(recording)
    assert caught.value.time > 25.0


def test_a_stream_of_steps_stops_at_the_margin_and_continues_elsewhere(robot):
    first = robot.home
    last = first.copy()
    last[0] += 0.8
    ball = sphere_at(robot.forward(0.5 * (first + last)).position)
    scene = rik.Scene(robot, [ball])
    guard = MotionGuard(rik.CollisionAvoidance(scene, MARGIN))

    def stream(q, goal):
        """Steps of at most 0.02 rad towards a goal, and the posture that blocked them."""
        for _ in range(200):
            change = np.clip(goal - q, -0.02, 0.02)
            blocked = guard.blocked_at(q, q + change)
            if blocked is not None:
                return q, scene.clearance(blocked)
            q = q + change
            assert scene.clearance(q).distance >= MARGIN - 1e-9
        return q, None

    q, contact = stream(first, last)
    assert contact is not None
    assert "ball" in contact.pair
    assert contact.distance < MARGIN
    assert scene.clearance(q).distance < 0.02
    q, contact = stream(q, first)
    assert contact is None
    assert q == pytest.approx(first)


def test_a_thin_plate_between_two_commands_of_a_stream_is_found(robot):
    first = robot.home
    last = first.copy()
    last[0] += 0.3
    middle = robot.forward(0.5 * (first + last)).position
    azimuth = 0.5 * (first[0] + last[0])
    wxyz = (np.cos(azimuth / 2), 0.0, 0.0, np.sin(azimuth / 2))
    plate = rik.Box("plate", size=(0.004, 0.0002, 0.004), pose=rik.Pose(middle, wxyz))
    scene = rik.Scene(robot, [plate])
    avoid = rik.CollisionAvoidance(scene, margin=0.0)
    assert avoid.free(np.array([first, last])).all()
    blocked = MotionGuard(avoid).blocked_at(first, last)
    assert blocked is not None
    assert "plate" in scene.clearance(blocked).pair


def test_a_stream_in_contact_may_move_away_but_not_closer(robot):
    first = robot.home
    scene = pedestal(robot, 0.002)
    guard = MotionGuard(rik.CollisionAvoidance(scene, MARGIN))
    near = guard.collisions.near(first)
    before = scene.pair_distances(first, near, MARGIN)
    allowed = 0
    refused = 0
    rng = np.random.default_rng(1)
    for _ in range(80):
        end = first + 0.01 * rng.normal(size=robot.nv)
        after = scene.pair_distances(end, near, MARGIN)
        if guard.blocked_at(first, end) is None:
            allowed += 1
            assert (after >= before - 1e-8).all()
        else:
            refused += 1
    assert allowed > 3
    assert refused > 3


def test_conditions_without_some_pairs_survive_a_copy(robot):
    import pickle

    avoid = rik.CollisionAvoidance(rik.Scene(robot, [sphere_at((0.1, 0.0, 0.2))]), MARGIN)
    rest = avoid.without(avoid.tables.geoms[:5])
    assert len(rest.tables.geoms) == len(avoid.tables.geoms) - 5
    copied = pickle.loads(pickle.dumps(rest))
    assert sorted(map(tuple, copied.tables.geoms)) == sorted(map(tuple, rest.tables.geoms))


def test_parts_that_are_always_near_are_named():
    text = """<mujoco><worldbody><body name="a"><joint name="i" range="-1 1"/><geom size=".1"/>
      <body name="b" pos="0 0 .15"><joint name="j" range="-1 1"/><geom size=".02"/>
      <body name="c" pos="0 0 .02"><joint name="k" range="-1 1"/><geom name="shell" size=".045"/>
      </body></body></body></worldbody></mujoco>"""
    scene = rik.Scene(rik.load_robot(text))
    avoid = rik.CollisionAvoidance(scene, margin=0.03)
    assert [item.pair for item in avoid.always_near] == [("a", "c")]
    assert not rik.CollisionAvoidance(scene, margin=0.03, ignore=[("a", "c")]).always_near
    assert not rik.CollisionAvoidance(scene, margin=0.001).always_near


def stream_towards(stream, goal, ticks):
    """Commands (ticks, nq) of a stream towards a goal."""
    return np.array([stream.next(goal) for _ in range(ticks)])


@pytest.mark.parametrize(("rate", "margin"), [(100.0, MARGIN), (500.0, MARGIN), (100.0, 0.0)])
def test_a_stream_keeps_the_margin_and_its_limits_at_full_speed(robot, rate, margin):
    first = robot.home
    last = first.copy()
    last[0] += 1.6
    last[3] -= 0.5
    ball = sphere_at(robot.forward(0.5 * (first + last)).position)
    scene = rik.Scene(robot, [ball])
    velocity = np.full(robot.nv, 3.0)
    acceleration = np.array([4.0, 8.0, 16.0, 8.0, 20.0, 9.0])  # it needs up to 64 degrees to stop
    guard = MotionGuard(rik.CollisionAvoidance(scene, margin))
    stream = GuardedStream(guard, velocity, acceleration, rate)
    stream.begin(first)
    assert scene.clearance(first).distance > 2.0 * MARGIN
    forwards = stream_towards(stream, last, int(3.0 * rate))
    assert "ball" in stream.contact.pair
    # Without a margin nothing can be proven beside a contact: postures are compared.
    allowed = 0.9 * margin if margin else -1e-4
    assert min(scene.clearance(q).distance for q in forwards) >= allowed
    assert scene.clearance(forwards[-1]).distance < 0.02
    backwards = stream_towards(stream, first, int(3.0 * rate))
    assert stream.contact is None
    assert min(scene.clearance(q).distance for q in backwards) >= allowed
    assert backwards[-1] == pytest.approx(first, abs=1e-9)
    q = np.concatenate([[first], forwards, backwards])
    speeds = np.diff(q, axis=0) * rate
    assert (np.abs(speeds) <= velocity).all()
    assert (np.abs(np.diff(speeds, axis=0)) * rate <= acceleration).all()


def test_a_stream_does_not_overshoot(robot):
    guard = MotionGuard(rik.CollisionAvoidance(rik.Scene(robot), 0.0))
    stream = GuardedStream(guard, np.full(robot.nv, 2.0), np.full(robot.nv, 5.0), 100.0)
    stream.begin(robot.home)
    goal = robot.home.copy()
    goal[0] += 0.4
    q = stream_towards(stream, goal, 300)
    assert q[:, 0].max() <= goal[0] + 1e-9
    assert q[-1] == pytest.approx(goal, abs=1e-9)


def test_a_stream_continues_from_the_sent_command(robot):
    """A limiter that halves every step: the stream still keeps the margin."""
    first = robot.home
    last = first.copy()
    last[0] += 0.8
    scene = rik.Scene(robot, [sphere_at(robot.forward(0.5 * (first + last)).position)])
    guard = MotionGuard(rik.CollisionAvoidance(scene, MARGIN))
    stream = GuardedStream(guard, np.full(robot.nv, 2.0), np.full(robot.nv, 8.0), 100.0)
    stream.begin(first)
    sent = first
    for _ in range(400):
        sent = sent + 0.5 * (stream.next(last) - sent)
        stream.was_sent(sent)
        assert scene.clearance(sent).distance >= 0.9 * MARGIN
    assert stream.contact is not None


def test_a_stream_follows_a_motion_closely(robot):
    """The lag behind a slow swing is far below the distance that braking takes."""
    guard = MotionGuard(rik.CollisionAvoidance(rik.Scene(robot), 0.0))
    stream = GuardedStream(guard, np.full(robot.nv, 2.0), np.full(robot.nv, 4.0), 100.0)
    stream.begin(robot.home)
    lag = []
    for k in range(300):
        wanted = robot.home.copy()
        wanted[0] += 0.5 * (1.0 - np.cos(2.0 * k / 100.0))
        lag.append(abs(stream.next(wanted)[0] - wanted[0]))
    assert max(lag) < 0.02
