"""Base placement: inverse kinematics solves all poses from the place, checked by MuJoCo."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import OptionError, ReachabilityMapError


@pytest.fixture(scope="module", params=[("puma560", 0.15), ("panda", 0.2)])
def reach_map(request):
    name, cell = request.param
    robot = rik.load_robot(name)
    collisions = rik.CollisionAvoidance(rik.Scene(robot), margin=0.002)
    return rik.map_reachability(robot, cell=cell, directions=30, rolls=6, collisions=collisions)


def tasks(reach_map, base, rng, count):
    """Poses that the robot reaches without contact from a base, in front of it."""
    robot = reach_map.robot
    poses = []
    while len(poses) < count:
        q = robot.sample(rng)
        if reach_map.collisions.free(q):
            pose = robot.measure(q)
            if pose.position[0] > 0.1:
                poses.append(base.compose(pose))
    return poses


@pytest.mark.parametrize("seed", range(3))
def test_all_poses_are_solved_from_the_place(reach_map, seed):
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-3.0, 3.0)
    wxyz = (np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw))
    base = rik.Pose((*rng.uniform(-5.0, 5.0, 2), 0.3), wxyz)
    poses = tasks(reach_map, base, rng, 4)
    placement = reach_map.best_base(poses, height=0.3, tries=300)
    assert placement.solved.all()
    assert placement.base.position[2] == 0.3
    for pose, q in zip(poses, placement.q, strict=True):
        reached = placement.base.compose(reach_map.robot.measure(q, reach_map.frame))
        assert reached.distance(pose)[0] < 1e-4
        assert reached.distance(pose)[1] < 1e-3
        assert reach_map.collisions.clearance(q).distance >= reach_map.collisions.margin - 1e-6


def test_poses_that_no_place_reaches_are_reported(reach_map):
    poses = [rik.Pose((0.0, 0.0, 0.5)), rik.Pose((9.0, 0.0, 0.5))]
    placement = reach_map.best_base(poses, tries=3)
    assert not placement.solved.all()
    assert placement.votes < 2


def test_an_arm_that_cannot_choose_its_roll_is_refused():
    five = rik.map_reachability(rik.load_robot("so101"), cell=0.3, directions=1)
    with pytest.raises(ReachabilityMapError, match="too few joints"):
        five.best_base([rik.Pose((0.2, 0.0, 0.1))])


def test_wrong_arguments_are_refused(reach_map):
    pose = rik.Pose((0.3, 0.0, 0.5))
    for poses, options in (
        ([], {}),
        (pose, {}),
        ([pose], {"height": np.nan}),
        ([pose], {"yaws": 0}),
        ([pose], {"tries": 0}),
        ([pose, rik.Pose((1e5, 1e5, 0.5))], {}),
    ):
        with pytest.raises(OptionError):
            reach_map.best_base(poses, **options)


def test_a_map_loaded_without_its_condition_cannot_place_a_base(reach_map, tmp_path):
    pytest.importorskip("zarr")
    robot = reach_map.robot
    rik.map_reachability(
        robot,
        cell=0.4,
        directions=4,
        rolls=1,
        collisions=reach_map.collisions,
        out=tmp_path / "m.zarr",
    )
    loaded = rik.ReachabilityMap.load(tmp_path / "m.zarr")
    with pytest.raises(ReachabilityMapError, match="condition on collisions"):
        loaded.best_base([rik.Pose((0.3, 0.0, 0.5))])
