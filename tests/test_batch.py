"""solve_batch: equal to single solves; forms of poses; wrong arguments."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import InvalidGoalError, ModelError, OptionError, UnknownFrameError
from robot_ik.goals import PoseGoal
from robot_ik.problem import Problem
from robot_ik.solution import Status


@pytest.fixture(scope="module")
def puma():
    return rik.load_robot("puma560")


def poses_of(robot, count, seed=1):
    rng = np.random.default_rng(seed)
    return [robot.forward(robot.sample(rng)) for _ in range(count)]


@pytest.mark.parametrize("name", ["auto", "lm", "dls", "analytic"])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_batch_gives_the_same_solutions_as_single_solves(puma, name, threads):
    poses = poses_of(puma, 800)  # enough for three threads
    matrices = np.array([pose.matrix for pose in poses])
    matrices[3, :3, 3] = 3.0  # out of reach
    rng = np.random.default_rng(2)
    starts = np.array([puma.sample(rng) for _ in poses])
    batch = rik.solve_batch(puma, matrices, starts=starts, solver=name, threads=threads)
    assert len(batch) == 800
    assert batch.converged.sum() >= 790
    assert batch.status[3] == Status.UNREACHABLE
    problem = Problem(puma, PoseGoal.at(None, poses[0]), solver=name)
    for row in [3, *range(0, 800, 40)]:
        alone = problem.solve(starts[row], target=matrices[row])
        assert batch.status[row] == alone.status
        # Two compiled versions of one source may differ in the last bits.
        np.testing.assert_allclose(batch.q[row], alone.q, atol=1e-7)
        assert batch.position_error[row] == pytest.approx(alone.error.position, abs=1e-9)
        assert batch.angle_error[row] == pytest.approx(alone.error.angle, abs=1e-6)


def test_matrices_quaternions_and_poses_are_the_same_batch(puma):
    poses = poses_of(puma, 5)
    by_matrix = rik.solve_batch(puma, np.array([pose.matrix for pose in poses]))
    rows = np.array([[*pose.position, *(2.0 * pose.wxyz)] for pose in poses])
    for given in (rows, poses, tuple(poses)):
        np.testing.assert_allclose(rik.solve_batch(puma, given).q, by_matrix.q, atol=1e-9)
    np.testing.assert_allclose(rik.solve_batch(puma, poses[0]).q, by_matrix.q[:1], atol=1e-9)


def test_positions_are_a_batch_of_position_goals(puma):
    batch = rik.solve_batch(puma, np.array([pose.position for pose in poses_of(puma, 5)]))
    assert batch.converged.all()
    assert batch.angle_error.max() == 0.0


def test_a_batch_of_poses_equals_single_solves_bit_by_bit(puma):
    poses = poses_of(puma, 60)
    alone = [rik.solve(puma, PoseGoal.at(None, pose)).q for pose in poses]
    assert np.array_equal(rik.solve_batch(puma, poses).q, alone)


@pytest.mark.parametrize(
    "poses", [np.zeros((2, 5)), np.full((2, 3), np.nan), np.zeros((2, 7)), np.zeros((3, 4, 3))]
)
def test_malformed_poses_are_refused(puma, poses):
    with pytest.raises(InvalidGoalError):
        rik.solve_batch(puma, poses)


def test_other_wrong_arguments_are_refused(puma):
    with pytest.raises(InvalidGoalError, match="starts"):
        rik.solve_batch(puma, np.zeros((2, 3)), starts=np.zeros((3, 6)))
    with pytest.raises(InvalidGoalError, match="poses"):
        rik.solve_batch(puma, [poses_of(puma, 1)[0], "nothing"])


def test_an_empty_batch_has_no_results(puma):
    assert len(rik.solve_batch(puma, np.zeros((0, 4, 4)))) == 0


@pytest.mark.parametrize("name", sorted(rik.catalogue()))
def test_forward_batch_gives_the_poses_of_mujoco(name):
    robot = rik.load_robot(name)
    rng = np.random.default_rng(6)
    q = np.array([robot.sample(rng) for _ in range(20)])
    positions, wxyz = rik.forward_batch(robot, q)
    assert (wxyz[:, 0] >= 0.0).all()
    for row in range(len(q)):
        pose = robot.measure(q[row])  # MuJoCo's mj_kinematics
        np.testing.assert_allclose(positions[row], pose.position, atol=1e-12)
        assert abs(wxyz[row] @ pose.wxyz) == pytest.approx(1.0, abs=1e-12)


def test_forward_batch_is_the_same_on_several_threads(puma):
    rng = np.random.default_rng(7)
    q = rng.uniform(-3.0, 3.0, (25_000, puma.nq))  # enough for three threads
    q.flags.writeable = False
    alone = rik.forward_batch(puma, q, frame="link3", threads=1)
    several = rik.forward_batch(puma, q, frame="link3", threads=3)
    np.testing.assert_array_equal(alone.positions, several.positions)
    np.testing.assert_array_equal(alone.wxyz, several.wxyz)
    last = puma.measure(q[-1], "link3")
    np.testing.assert_allclose(several.positions[-1], last.position, atol=1e-12)


def test_forward_batch_of_no_rows_is_empty(puma):
    positions, wxyz = rik.forward_batch(puma, np.zeros((0, puma.nq)))
    assert positions.shape == (0, 3)
    assert wxyz.shape == (0, 4)


def test_forward_batch_refuses_wrong_arguments(puma):
    with pytest.raises(ModelError, match=r"\(n, 6\)"):
        rik.forward_batch(puma, puma.home)
    with pytest.raises(ModelError, match="finite"):
        rik.forward_batch(puma, np.full((1, 6), np.nan))
    with pytest.raises(UnknownFrameError):
        rik.forward_batch(puma, puma.home[None], frame="griper")
    with pytest.raises(OptionError, match="threads"):
        rik.forward_batch(puma, puma.home[None], threads=0)
    with pytest.raises(ModelError, match="load_robot"):
        rik.forward_batch("puma560", puma.home[None])
