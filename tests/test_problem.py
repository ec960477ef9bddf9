"""Problems: what is refused before any step is taken, and retargeting."""

import copy
import pickle

import numpy as np
import pytest

from robot_ik.errors import GoalError, InvalidGoalError, UnknownFrameError
from robot_ik.geometry import Pose
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.problem import Budget, Problem, Tolerance
from robot_ik.robot import load_robot
from robot_ik.solvers import make_solver


@pytest.fixture(scope="module")
def puma():
    return load_robot("puma560")


def test_tolerances_and_budgets_must_make_sense():
    for bad in ({"position": 0.0}, {"angle": -1.0}, {"position": np.nan}):
        with pytest.raises(InvalidGoalError, match="positive"):
            Tolerance(**bad)
    for bad in ({"iterations": -1}, {"restarts": -1}, {"seconds": -0.1}, {"seconds": np.nan}):
        with pytest.raises(InvalidGoalError, match="zero or more"):
            Budget(**bad)


def test_a_problem_needs_goals_for_frames_that_exist(puma):
    for nothing in ([], ["gripper"], [None]):
        with pytest.raises(GoalError, match="one or more goals"):
            Problem(puma, nothing)
    with pytest.raises(UnknownFrameError, match="did you mean 'gripper'"):
        Problem(puma, PositionGoal("griper", (0, 0, 1)))


def test_retargeting_is_the_same_as_a_new_problem(puma):
    rng = np.random.default_rng(0)
    poses = [puma.forward(puma.sample(rng)) for _ in range(3)]
    solver = make_solver("lm")
    problem = Problem(puma, PoseGoal.at(None, poses[0]))
    for pose in poses:
        fresh = solver.solve(Problem(puma, PoseGoal.at(None, pose)))
        for target in (pose, PoseGoal.at(None, pose), PoseGoal.at(puma.tool, pose)):
            problem.retarget(target)
            again = solver.solve(problem)
            assert np.array_equal(again.q, fresh.q) and again.miss == fresh.miss
        assert problem.target_pose().distance(pose) == pytest.approx((0, 0), abs=1e-12)
    problem.retarget(poses[0].position)  # a position alone keeps the orientation
    assert problem.target_pose().distance(Pose(poses[0].position, poses[2].wxyz)) == pytest.approx(
        (0, 0), abs=1e-12
    )


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ((1, 2), "finite position"),
        ((1, np.nan, 2), "finite position"),
        (PositionGoal("gripper", (1, 0, 0)), "built for a pose goal"),
        (PoseGoal("flange", (1, 0, 0)), "'flange'"),
        (PoseGoal("gripper", (1, 0, 0), angle_weight=2.0), "weights"),
    ],
)
def test_a_target_of_another_kind_is_refused_and_changes_nothing(puma, target, says):
    problem = Problem(puma, PoseGoal("gripper", (0.1, 0.2, 0.3)))
    before = problem.target.copy()
    with pytest.raises(InvalidGoalError, match=says):
        problem.retarget(target)
    assert np.array_equal(problem.target, before)


def test_an_orientation_has_no_position_to_move(puma):
    with pytest.raises(InvalidGoalError, match="no position"):
        Problem(puma, OrientationGoal(None, (1, 0, 0, 0))).retarget((1, 2, 3))


def test_a_copy_has_work_space_of_its_own(puma):
    problem = Problem(puma, PoseGoal.at(None, puma.forward(puma.home + 0.2)), seed=4)
    expected = make_solver("lm").solve(problem).q
    problem.retarget(puma.forward(puma.home - 0.2))
    moved = make_solver("lm").solve(problem).q
    for other in (copy.copy(problem), copy.deepcopy(problem), pickle.loads(pickle.dumps(problem))):
        assert other.seed == 4
        assert np.array_equal(make_solver("lm").solve(other).q, moved)  # the target it had
        other.retarget(puma.forward(puma.home + 0.2))
        assert np.array_equal(make_solver("lm").solve(other).q, expected)
        assert np.array_equal(make_solver("lm").solve(problem).q, moved)
