"""Cells of reachability maps against brute-force inverse kinematics and MuJoCo."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import OptionError, UnknownFrameError
from robot_ik.reachability.reachability_map import QUANTITIES
from robot_ik.reachability.sweep import METHODS, SWEPT_VALUES
from tests.solvers.analytic.test_six_axes import UPRIGHT

MARGIN = 0.002
TIGHT = rik.Tolerance(position=1e-7, angle=1e-7)
STARTS = 150
SHELF = rik.Box("shelf", size=(0.3, 0.1, 0.4), pose=rik.Pose((0.5, 0.2, 0.4)))


def condition(robot, obstacles=(SHELF,)):
    return rik.CollisionAvoidance(rik.Scene(robot, obstacles), margin=MARGIN)


def small_map(name, checked=True, **options):
    robot = rik.load_robot(name)
    collisions = condition(robot) if checked else None
    settings = {"cell": 0.25, "directions": 7, "rolls": 2} | options
    return rik.map_reachability(robot, collisions=collisions, **settings)


@pytest.fixture(scope="module", params=["puma560", "ur5e"])
def reach_map(request):
    return small_map(request.param)


@pytest.fixture(scope="module")
def panda():
    return small_map("panda", cell=0.3)


def pose_of(reach_map, cell, orientation):
    position = np.array(reach_map.grid.corner) + reach_map.grid.cell * (np.array(cell) + 0.5)
    return rik.Pose.from_rotation(reach_map.grid.rotations[orientation], position)


def entries(reach_map, reach, count, seed=0):
    """Random (cell, orientation) with a status."""
    chosen = np.argwhere(reach_map.status == reach)
    rng = np.random.default_rng(seed)
    picked = rng.choice(len(chosen), min(count, len(chosen)), replace=False)
    return [(tuple(row[:3]), int(row[3])) for row in chosen[picked]]


def reached_by_brute_force(robot, pose, rng):
    """Whether any of many random starts leads to the pose, by MuJoCo."""
    problem = rik.Problem(robot, pose, solver="lm", tolerance=TIGHT, budget=rik.Budget(restarts=0))
    for _ in range(STARTS):
        solution = problem.solve(robot.sample(rng))
        if solution.converged:
            return max(robot.measure(solution.q).distance(pose)) < 1e-6
    return False


def test_reached_entries_are_those_that_brute_force_reaches(reach_map):
    robot = reach_map.robot
    rng = np.random.default_rng(1)
    within = [rik.ReachStatus.REACHED, rik.ReachStatus.TOUCHING]
    for reach in rik.ReachStatus:
        for cell, orientation in entries(reach_map, reach, 25):
            pose = pose_of(reach_map, cell, orientation)
            assert reached_by_brute_force(robot, pose, rng) == (reach in within), (cell, reach)
            assert reach_map.reach_at(pose) is reach


def test_free_branches_are_those_that_mujoco_calls_free(reach_map):
    compared = 0
    for reach in (rik.ReachStatus.REACHED, rik.ReachStatus.TOUCHING):
        for cell, orientation in entries(reach_map, reach, 60):
            pose = pose_of(reach_map, cell, orientation)
            branches = rik.solve_all(reach_map.robot, pose, collisions=reach_map.collisions)
            assert reach_map.branches[(*cell, orientation)] == sum(
                branch.free for branch in branches
            )
            compared += len(branches)
    assert compared > 100


def test_manipulability_and_clearance_are_the_largest_of_the_free_branches(reach_map):
    robot = reach_map.robot
    for cell in {cell for cell, _ in entries(reach_map, rik.ReachStatus.REACHED, 6)}:
        best = 0.0
        farthest = -np.inf
        for orientation in range(reach_map.grid.orientations):
            pose = pose_of(reach_map, cell, orientation)
            for branch in rik.solve_all(robot, pose, collisions=reach_map.collisions):
                if branch.free:
                    jacobian = robot.jacobian(branch.q)
                    best = max(best, float(np.sqrt(np.linalg.det(jacobian @ jacobian.T))))
                    farthest = max(farthest, branch.clearance.distance)
        assert reach_map.manipulability[cell] == pytest.approx(best, rel=1e-5)
        assert reach_map.clearance[cell] == pytest.approx(min(farthest, 0.1), abs=1e-6)


def test_the_panda_is_swept_over_its_last_joint(panda):
    robot = panda.robot
    lower = robot.lower[6]
    upper = robot.upper[6]
    values = lower + (np.arange(SWEPT_VALUES) + 0.5) / SWEPT_VALUES * (upper - lower)
    # Without a proof, only cells outside the ball that the frame cannot leave are UNREACHABLE.
    center, radius = robot.reach(panda.frame)
    axes = [panda.grid.centers(axis) for axis in range(3)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    is_outside = np.linalg.norm(cells - center, axis=-1) > radius
    assert 0 < is_outside.sum() < is_outside.size
    for orientation in range(panda.grid.orientations):
        unreachable = panda.status[..., orientation] == rik.ReachStatus.UNREACHABLE
        np.testing.assert_array_equal(unreachable, is_outside)
    for reach in (rik.ReachStatus.REACHED, rik.ReachStatus.TOUCHING, rik.ReachStatus.NOT_FOUND):
        for cell, orientation in entries(panda, reach, 8):
            pose = pose_of(panda, cell, orientation)
            branches = [
                branch
                for value in values
                for branch in rik.solve_all(
                    robot, pose, fixed={"panda_joint7": value}, collisions=panda.collisions
                )
            ]
            for branch in branches:
                assert max(robot.measure(branch.q).distance(pose)) < 1e-6
            assert panda.branches[(*cell, orientation)] == sum(b.free for b in branches)
            assert (reach is rik.ReachStatus.NOT_FOUND) == (not branches)


def test_without_a_condition_collisions_do_not_count(reach_map):
    plain = small_map(reach_map.robot.name, checked=False)
    within = np.isin(reach_map.status, [rik.ReachStatus.REACHED, rik.ReachStatus.TOUCHING])
    np.testing.assert_array_equal(plain.status == rik.ReachStatus.REACHED, within)
    assert np.isnan(plain.clearance).all()
    assert (plain.branches >= reach_map.branches).all()


def test_the_index_is_the_share_of_directions_that_are_reached_with_any_roll(reach_map):
    shape = (*reach_map.grid.shape, reach_map.grid.directions, reach_map.grid.rolls)
    reached = (reach_map.status == rik.ReachStatus.REACHED).reshape(shape)
    for cell, _ in entries(reach_map, rik.ReachStatus.REACHED, 5):
        share = np.mean([reached[cell][d].any() for d in range(reach_map.grid.directions)])
        assert reach_map.index[cell] == pytest.approx(share)
        center = np.array(reach_map.grid.corner) + reach_map.grid.cell * (np.array(cell) + 0.5)
        assert reach_map.index_at(center) == reach_map.index[cell]
    assert reach_map.index_at((9.0, 0.0, 0.0)) == 0.0
    assert reach_map.reach_at(rik.Pose((9.0, 0.0, 0.0))) is rik.ReachStatus.UNREACHABLE


def test_orientations_are_rotations_with_evenly_spread_directions():
    reach_map = small_map("puma560", checked=False, cell=0.6, directions=200, rolls=3)
    rotations = reach_map.grid.rotations
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    products = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(products, [np.eye(3)] * 600, atol=1e-12)
    axes = rotations[::3, :, 2]
    nearest = np.sort(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)), axis=1)[:, 1]
    assert nearest.min() > 0.6 * nearest.max()
    np.testing.assert_array_equal(reach_map.grid.orientation_of(rotations), np.arange(600))


def test_the_cloud_has_the_reached_cells_and_a_file_that_others_read(reach_map, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    for quantity in QUANTITIES:
        cloud = reach_map.cloud(quantity)
        assert len(cloud.points) == (reach_map.quantity(quantity) > 0.0).sum()
        assert cloud.colours.dtype == np.uint8
    cloud = reach_map.cloud()
    assert len(cloud.points) == (reach_map.index > 0.0).sum()
    loaded = trimesh.load(cloud.save(tmp_path / "cloud.ply"))
    np.testing.assert_allclose(loaded.vertices, cloud.points, atol=1e-6)
    np.testing.assert_array_equal(loaded.colors[:, :3], cloud.colours)
    assert len(reach_map.cloud(above=0.99).points) < len(cloud.points)


def test_slices_are_drawn(reach_map):
    pytest.importorskip("matplotlib")
    from robot_ik.reachability.pictures import draw_slice, slice_png

    figure = draw_slice(reach_map, across="y", at=0.1)
    values = figure.axes[0].images[0].get_array()
    layer = int((0.1 - reach_map.grid.corner[1]) / reach_map.grid.cell)
    shown = np.ma.filled(values, np.nan).T
    np.testing.assert_array_equal(shown, reach_map.quantity("index")[:, layer])
    assert slice_png(reach_map, across="z", at=0.3, quantity="clearance").startswith(b"\x89PNG")
    with pytest.raises(OptionError, match="across"):
        draw_slice(reach_map, across="w")
    with pytest.raises(OptionError, match="at"):
        draw_slice(reach_map, at=50.0)


@pytest.fixture(scope="module")
def five_joints():
    """An arm without a closed form for poses, which cannot choose its roll either."""
    return small_map("so101", cell=0.12, directions=9, checked=True)


def test_an_arm_without_a_closed_form_is_solved_by_lm(five_joints):
    assert five_joints.method == "lm" and five_joints.grid.rolls == 1
    robot = five_joints.robot
    rng = np.random.default_rng(2)
    scene = five_joints.collisions.scene
    arm = [robot.tree.vadr[k] for k in robot.tree.ancestors(robot.attachment()[0])]
    assert len(arm) == 5
    for reach in (rik.ReachStatus.REACHED, rik.ReachStatus.TOUCHING, rik.ReachStatus.NOT_FOUND):
        for cell, orientation in entries(five_joints, reach, 12):
            pose = pose_of(five_joints, cell, orientation)
            goal = rik.PoseGoal(None, pose.position, pose.wxyz, free_axis="z")
            problem = rik.Problem(robot, goal, solver="lm", budget=rik.Budget(restarts=0))
            solutions = [problem.solve(robot.sample(rng)) for _ in range(STARTS)]
            solutions = [one for one in solutions if one.converged]
            for solution in solutions:
                measured = robot.measure(solution.q)
                assert np.linalg.norm(np.array(measured.position) - pose.position) < 2e-4
                assert measured.rotation[:, 2] @ pose.rotation[:, 2] > np.cos(2e-3)
            clearances = [scene.clearance(one.q).distance for one in solutions]
            is_free = max(clearances, default=-1.0) > MARGIN
            assert is_free == (reach is rik.ReachStatus.REACHED), (reach, cell, orientation)
            assert bool(solutions) == (reach is not rik.ReachStatus.NOT_FOUND)
    cell, _ = entries(five_joints, rik.ReachStatus.REACHED, 1)[0]
    assert five_joints.manipulability[cell] > 0.0
    assert MARGIN <= five_joints.clearance[cell] <= 0.1
    assert five_joints.branches.max() == 1
    outside = tuple(np.array(five_joints.grid.corner) + 1e-3)
    assert five_joints.reach_at(rik.Pose(outside)) is rik.ReachStatus.UNREACHABLE


def test_the_number_of_threads_does_not_change_a_map_by_lm(five_joints):
    again = small_map("so101", cell=0.12, directions=9, threads=3)
    for name in ("status", "branches", "manipulability", "clearance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(five_joints, name))


def test_every_map_has_the_name_of_its_method(reach_map, panda):
    assert reach_map.method == "closed form" and panda.method == "swept joint"
    assert {reach_map.method, panda.method, "lm"} == set(METHODS)


def test_coupled_joints_have_no_closed_form():
    coupled = UPRIGHT.replace('axis="0 1 0" range="-1.5', 'name="a" axis="0 1 0" range="-1.5')
    coupled = coupled.replace('axis="0 1 0" range="-2.4', 'name="b" axis="0 1 0" range="-2.4')
    equality = '<equality><joint joint1="b" joint2="a"/></equality></mujoco>'
    tiny = {"cell": 0.5, "directions": 1, "rolls": 1}
    assert rik.map_reachability(rik.load_robot(coupled), **tiny).method == "closed form"
    followers = rik.load_robot(coupled.replace("</mujoco>", equality))
    assert rik.map_reachability(followers, **tiny).method == "lm"


def test_wrong_arguments_are_refused():
    robot = rik.load_robot("puma560")
    for options in (
        {"cell": 0.0},
        {"cell": np.nan},
        {"cell": "big"},
        {"directions": 0},
        {"rolls": 1.5},
        {"threads": 0},
        {"cell": 0.002, "directions": 1000, "rolls": 36},
        {"collisions": condition(rik.load_robot("ur5e"))},
    ):
        with pytest.raises(OptionError):
            rik.map_reachability(robot, **options)
    with pytest.raises(UnknownFrameError):
        rik.map_reachability(robot, frame="griper")
    with pytest.raises(OptionError, match="quantity"):
        small_map("puma560", checked=False, cell=0.9, directions=1, rolls=1).quantity("size")
