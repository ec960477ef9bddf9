"""Certified motions: dense samples by MuJoCo have no contact, and refuted motions have one."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_ik as rik
from robot_ik.errors import MotionBlockedError, OptionError
from robot_ik.motion.certificate import certify

STEP = 0.002
"""rad or m. Distance of the samples that check a certificate."""


def random_plates(robot, rng):
    """Thin plates with slots between them around a robot, without plates that always touch it."""
    samples = np.array([robot.sample(rng) for _ in range(50)])
    bare = rik.Scene(robot).free(samples).mean()
    plates = []
    while len(plates) < 6:
        position = rng.normal(size=3) * 0.35 + (0.0, 0.0, 0.5)
        size = (0.002, *rng.uniform(0.1, 0.6, 2))
        pose = rik.Pose(position, rng.normal(size=4))
        plate = rik.Box(f"plate {len(plates)}", size=size, pose=pose)
        if rik.Scene(robot, [plate]).free(samples).mean() > 0.7 * bare:
            plates.append(plate)
    return plates


def dense_postures(robot, first, last):
    """Postures (n, nq) on the line between two postures."""
    change = robot.difference(first, last)
    count = int(np.linalg.norm(change) / STEP) + 2
    return np.array([robot.integrate(first, s * change) for s in np.linspace(0.0, 1.0, count)])


@pytest.mark.parametrize("name", ["puma560", "panda", "ur5e", "humanoid", "omx_f"])
def test_certified_edges_have_no_contact_and_refuted_edges_have_a_contact(name):
    rng = np.random.default_rng(7)
    robot = rik.load_robot(name)
    scene = rik.Scene(robot, random_plates(robot, rng))
    avoid = rik.CollisionAvoidance(scene, margin=0.001)
    certified = 0
    refuted = 0
    for _ in range(120):
        first = robot.sample(rng)
        last = robot.integrate(first, rng.normal(size=robot.nv) * rng.choice([0.02, 0.1, 0.4]))
        try:
            certificate = certify([first, last], avoid)
        except MotionBlockedError as error:
            refuted += 1
            assert scene.clearance(error.q).distance < avoid.margin
            assert 0.0 <= error.time <= 1.0
            assert error.distance < avoid.margin
            continue
        if certificate.certified:
            certified += 1
            assert certificate.clearance == avoid.margin
            assert avoid.free(dense_postures(robot, first, last)).all()
    assert certified > 10
    assert refuted > 10
    assert certified + refuted >= 115


def test_a_plate_between_two_samples_is_found():
    """The arm passes a plate of 0.2 mm between two postures that are both free."""
    robot = rik.load_robot("puma560")
    first = robot.home.copy()
    last = first.copy()
    last[0] += 1.0
    middle = robot.forward(0.5 * (first + last)).position
    azimuth = float(np.arctan2(middle[1], middle[0]))
    plate = rik.Box(
        "plate",
        size=(0.02, 0.0002, 0.02),
        pose=rik.Pose(middle, (np.cos(azimuth / 2), 0.0, 0.0, np.sin(azimuth / 2))),
    )
    scene = rik.Scene(robot, [plate])
    assert scene.free(np.array([first, last])).all()
    avoid = rik.CollisionAvoidance(scene, margin=0.0)
    with pytest.raises(MotionBlockedError, match="plate"):
        rik.joint_move(robot, first, last, collisions=avoid)


@given(st.integers(0, 2**32 - 1), st.sampled_from(["puma560", "humanoid", "lion", "panda"]))
def test_no_point_of_a_link_moves_farther_than_the_bound(seed, name):
    """Displacement of the links relative to each other, measured by MuJoCo's kinematics."""
    from robot_ik.kernels import certificate

    rng = np.random.default_rng(seed)
    robot = rik.load_robot(name)
    scene = rik.Scene(robot)
    avoid = rik.CollisionAvoidance(scene)
    memory = avoid.memory()
    tables = memory.nested["shapes"].arrays
    sizes = {"nq": robot.nq, "nv": robot.nv, "l": len(tables["node"]), "n": robot.tree.size, "h": 4}
    proof = certificate.PROOF.allocate(sizes, {"collision": memory})
    middle = robot.sample(rng)
    change = rng.normal(size=robot.nv) * 10.0 ** rng.uniform(-3, 0.3)
    certificate.bound_of_motion(proof.address, middle, change, 0.5)
    motion = memory.nested["check"].arrays["motion"]
    links = memory.nested["pairs"].arrays["links"]
    first = {
        int(tables["link"][g]): int(scene._tables.geoms[g]) for g in range(len(tables["link"]))
    }
    before = poses(scene, middle)
    for share in (-0.5, 0.5):
        after = poses(scene, robot.integrate(middle, share * change))
        for k, (a, b) in enumerate(links):
            geom_a = first[int(a)]
            geom_b = first[int(b)]
            # A point of a, seen from b: it moves no farther than both bounds together.
            point = before[geom_a].inverse().apply(before[geom_a].position)
            seen_before = before[geom_b].inverse().apply(before[geom_a].apply(point))
            seen_after = after[geom_b].inverse().apply(after[geom_a].apply(point))
            distances = np.linalg.norm(seen_before), np.linalg.norm(seen_after)
            assert abs(distances[0] - distances[1]) <= motion[k]


def poses(scene, q):
    data = scene.data_at(q)
    wxyz = np.zeros(4)
    found = []
    for geom in range(scene.model.ngeom):
        mujoco.mju_mat2Quat(wxyz, data.geom_xmat[geom])
        found.append(rik.Pose(data.geom_xpos[geom], wxyz.copy()))
    return found


def test_joint_moves_are_certified_or_refused_with_time_pair_and_depth():
    robot = rik.load_robot("puma560")
    scene = rik.Scene(robot, [rik.Box("post", size=(0.05, 0.05, 3.0), pose=rik.Pose((0, 0.5, 0)))])
    avoid = rik.CollisionAvoidance(scene, margin=0.005)
    rng = np.random.default_rng(4)
    free = np.array([robot.sample(rng) for _ in range(400)])
    free = free[avoid.free(free)]
    outcomes = {True: 0, False: 0}
    for first, last in zip(free[:60:2], free[1:60:2], strict=True):
        plain = rik.joint_move(robot, first, last)
        assert not plain.certified
        assert plain.clearance is None
        try:
            move = rik.joint_move(robot, first, last, collisions=avoid)
        except MotionBlockedError as error:
            outcomes[False] += 1
            at = plain.at(error.time)
            assert np.abs(at - error.q).max() < 1e-6
            assert scene.clearance(error.q).distance < avoid.margin
            assert error.pair == scene.clearance(error.q).pair
            assert f"at {error.time:.2f} s" in str(error)
            continue
        assert np.array_equal(move.q, plain.q)
        if move.certified:
            outcomes[True] += 1
            assert move.clearance >= avoid.margin
            assert avoid.free(dense_postures(robot, first, last)).all()
    assert outcomes[True] > 3
    assert outcomes[False] > 3


def test_line_moves_are_certified_or_refused():
    robot = rik.load_robot("ur5e")
    start = np.array([0.0, -1.6, 1.8, -1.7, -1.57, 0.0])
    tool = robot.forward(start)
    goal = rik.Pose(tool.position + np.array((0.0, 0.25, 0.0)), tool.wxyz)
    scene = rik.Scene(robot)
    move = rik.line_move(robot, start, goal, collisions=rik.CollisionAvoidance(scene))
    assert move.certified
    wall = rik.Box(
        "wall", size=(0.2, 0.02, 0.2), pose=rik.Pose(tool.position + np.array((0, 0.2, 0)))
    )
    blocked = rik.CollisionAvoidance(rik.Scene(robot, [wall]))
    with pytest.raises(MotionBlockedError, match="wall") as caught:
        rik.line_move(robot, start, goal, collisions=blocked)
    assert 0.0 < caught.value.time < move.duration


def test_a_motion_that_starts_in_contact_is_blocked_at_its_start():
    robot = rik.load_robot("puma560")
    scene = rik.Scene(robot, [rik.Box("hall", size=(9, 9, 9))])
    with pytest.raises(MotionBlockedError) as caught:
        rik.joint_move(
            robot, robot.home, robot.home + 0.1, collisions=rik.CollisionAvoidance(scene)
        )
    assert caught.value.time == 0.0


def test_a_free_base_and_balls_are_certified():
    text = """<mujoco><worldbody>
      <geom name="gate" type="box" size=".01 1 1" pos="1 0 0"/>
      <body name="a"><freejoint/><geom size=".1"/>
        <body name="b" pos=".3 0 0"><joint name="j" type="ball"/>
          <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/></body></body>
      </worldbody></mujoco>"""
    robot = rik.load_robot(text)
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=0.001)
    start = robot.home
    aside = start.copy()
    aside[1] = 0.5
    assert certify([start, aside], avoid).certified
    beyond = start.copy()
    beyond[0] = 3.0
    assert avoid.free(beyond)
    with pytest.raises(MotionBlockedError, match="gate"):
        certify([start, beyond], avoid)


def test_conditions_on_other_robots_are_refused():
    robot = rik.load_robot("puma560")
    other = rik.CollisionAvoidance(rik.Scene(rik.load_robot("ur5e")))
    with pytest.raises(OptionError):
        rik.joint_move(robot, robot.home, robot.home, collisions=other)


CRANK = """<mujoco><compiler angle="radian"/><worldbody>
  <geom name="gate" type="box" size=".002 .05 .05" pos="{gate} .3 0"/>
  <body name="crank"><joint name="lead" range="-2 2" axis="0 0 1"/>
    <geom type="capsule" size=".01" fromto="0 0 0 .08 0 0"/></body>
  <body name="sled" pos="0 .3 0"><joint name="ride" type="slide" axis="1 0 0" range="-1 1"/>
    <geom size=".02"/></body>
</worldbody><equality>
  <joint joint1="ride" joint2="lead" polycoef="{law}"/>
</equality></mujoco>"""
"""A hinge and a slide that follows it by a polynomial."""


@pytest.mark.parametrize(
    ("law", "gate", "turn", "blocked"),
    [
        ("0 .2 0 0 0", 0.15, 1.5, True),
        ("0 .2 0 0 0", 0.35, 1.5, False),
        ("0 0 .2 0 0", 0.3, 1.5, True),
        ("0 0 .2 0 0", 0.5, 1.5, False),
        # The sled is at the same place at both ends, and passes the gate between them.
        ("0 .6 -.3 0 0", 0.2, 2.0, True),
        ("0 .6 -.3 0 0", 0.33, 2.0, False),
    ],
)
def test_a_coupled_joint_moves_as_its_leader_determines(law, gate, turn, blocked):
    robot = rik.load_robot(CRANK.format(law=law, gate=gate))
    scene = rik.Scene(robot)
    avoid = rik.CollisionAvoidance(scene, margin=0.002)
    first = robot.apply_couplings(np.zeros(2))
    last = robot.apply_couplings([turn, 0.0])
    leads = np.linspace(0.0, turn, 2000)
    way = np.array([robot.apply_couplings([lead, 0.0]) for lead in leads])
    smallest = min(scene.clearance(q).distance for q in way)
    assert (smallest < avoid.margin) == blocked
    if blocked:
        with pytest.raises(MotionBlockedError, match="gate") as caught:
            certify([first, last], avoid)
        assert scene.clearance(caught.value.q).distance < avoid.margin
        with pytest.raises(MotionBlockedError, match="gate"):
            rik.joint_move(robot, first, last, collisions=avoid)
    else:
        certificate = certify([first, last], avoid)
        assert certificate.certified
        assert smallest >= certificate.clearance


@given(st.integers(0, 2**32 - 1))
def test_random_couplings_are_certified_or_refuted_rightly(seed):
    rng = np.random.default_rng(seed)
    law = " ".join(f"{value:.3f}" for value in rng.normal(size=5) * (0.1, 0.3, 0.2, 0.1, 0.05))
    try:
        robot = rik.load_robot(CRANK.format(law=law, gate=rng.uniform(-0.6, 0.6)))
    except rik.RobotIkError:
        return  # the sled has no range left
    scene = rik.Scene(robot)
    avoid = rik.CollisionAvoidance(scene, margin=0.001)
    lead = robot.lower[0], robot.upper[0]
    first = robot.apply_couplings([rng.uniform(*lead), 0.0])
    last = robot.apply_couplings([rng.uniform(*lead), 0.0])
    leads = np.linspace(first[0], last[0], 1000)
    smallest = min(scene.clearance(robot.apply_couplings([lead, 0.0])).distance for lead in leads)
    try:
        certificate = certify([first, last], avoid)
    except MotionBlockedError as error:
        assert scene.clearance(error.q).distance < avoid.margin
        return
    if certificate.certified:
        assert smallest >= avoid.margin - 1e-9


@given(st.integers(0, 2**32 - 1))
def test_a_free_base_with_an_arm_is_certified_rightly(seed):
    """A floating base that turns and moves with an arm, past a post."""
    text = """<mujoco><worldbody>
      <geom name="post" type="capsule" size=".03" fromto="1 0 -1 1 0 1"/>
      <body name="a"><freejoint/><geom type="box" size=".2 .1 .05"/>
        <body name="b" pos=".2 0 .1"><joint name="i" axis="0 0 1" range="-2 2"/>
          <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/>
          <body name="c" pos=".3 0 0"><joint name="j" axis="0 1 0" range="-2 2"/>
            <geom type="capsule" size=".02" fromto="0 0 0 .2 0 0"/></body></body></body>
      </worldbody></mujoco>"""
    rng = np.random.default_rng(seed)
    robot = rik.load_robot(text)
    scene = rik.Scene(robot)
    avoid = rik.CollisionAvoidance(scene, margin=0.001)
    first = robot.home.copy()
    first[:3] = rng.uniform((0.0, -0.8, -0.3), (1.2, 0.8, 0.3))
    first = robot.integrate(first, rng.normal(size=robot.nv) * 0.4)
    last = robot.integrate(first, rng.normal(size=robot.nv) * 0.3)
    postures = dense_postures(robot, first, last)
    smallest = min(scene.clearance(q).distance for q in postures)
    try:
        certificate = certify([first, last], avoid)
    except MotionBlockedError as error:
        assert scene.clearance(error.q).distance < avoid.margin
        return
    if certificate.certified:
        assert smallest >= avoid.margin - 1e-9
    else:
        assert smallest < avoid.margin + 1e-4
