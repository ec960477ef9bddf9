"""Problems: refused arguments, and retargeting."""

import copy
import pickle
import subprocess
import sys
import textwrap
from dataclasses import astuple

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.errors import GoalError, InvalidGoalError, OptionError, UnknownFrameError
from robot_ik.geometry import Pose
from robot_ik.goals import (
    CenterOfMassGoal,
    OrientationGoal,
    PoseGoal,
    PositionGoal,
    PostureGoal,
    Tolerance,
)
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solvers import make_solver


@pytest.fixture(scope="module")
def puma():
    return load_robot("puma560")


def targets_of(problem):
    """The targets that the kernels read."""
    return problem.search.arrays["target"].copy()


def test_invalid_tolerances_and_budgets_are_refused():
    for bad in ({"position": 0.0}, {"angle": -1.0}, {"position": np.nan}):
        with pytest.raises(OptionError, match=r"tolerance: .*allowed: a positive number"):
            Tolerance(**bad)
    for bad in ({"iterations": -1}, {"restarts": -1}, {"seconds": -0.1}, {"seconds": np.nan}):
        with pytest.raises(OptionError, match=rf"budget: {next(iter(bad))}: .*allowed: 0"):
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
    problem = Problem(puma, PoseGoal.at(None, poses[0]), solver=solver)
    for pose in poses:
        fresh = Problem(puma, PoseGoal.at(None, pose), solver=solver).solve()
        for target in (pose, PoseGoal.at(None, pose), PoseGoal.at(puma.tool, pose)):
            problem.retarget(target)
            again = problem.solve()
            assert np.array_equal(again.q, fresh.q)
            assert astuple(again.error) == pytest.approx(astuple(fresh.error), abs=1e-12)
        assert problem.goals[0].target.distance(pose) == pytest.approx((0, 0), abs=1e-12)
    problem.retarget(poses[0].position)  # a position alone keeps the orientation
    assert problem.goals[0].target.distance(
        Pose(poses[0].position, poses[2].wxyz)
    ) == pytest.approx((0, 0), abs=1e-12)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ((1, 2), "finite position"),
        ((1, np.nan, 2), "finite position"),
        (PositionGoal("gripper", (1, 0, 0)), "is a pose goal"),
        (PoseGoal("flange", (1, 0, 0)), "'flange'"),
        (PoseGoal("gripper", (1, 0, 0), angle_weight=0.0), "weight"),
    ],
)
def test_a_target_of_another_kind_is_refused_and_changes_nothing(puma, target, message):
    problem = Problem(puma, PoseGoal("gripper", (0.1, 0.2, 0.3)))
    before = targets_of(problem)
    with pytest.raises(InvalidGoalError, match=message):
        problem.retarget(target)
    assert np.array_equal(targets_of(problem), before)


def test_an_orientation_has_no_position_to_move(puma):
    with pytest.raises(InvalidGoalError, match="no position"):
        Problem(puma, OrientationGoal(None, (1, 0, 0, 0))).retarget((1, 2, 3))


def test_a_copy_has_separate_memory(puma):
    problem = Problem(puma, PoseGoal.at(None, puma.forward(puma.home + 0.2)), seed=4, solver="lm")
    expected = problem.solve().q
    problem.retarget(puma.forward(puma.home - 0.2))
    moved = problem.solve().q
    for other in (copy.copy(problem), copy.deepcopy(problem), pickle.loads(pickle.dumps(problem))):
        assert other.seed == 4
        assert np.array_equal(other.solve().q, moved)  # with the target of the original
        other.retarget(puma.forward(puma.home + 0.2))
        assert np.array_equal(other.solve().q, expected)
        assert np.array_equal(problem.solve().q, moved)


def several(puma):
    """A problem of three goals, two of them on one frame."""
    here = puma.forward(puma.home)
    flange = puma.forward(puma.home, "flange")
    goals = [
        PoseGoal(None, here.position, here.wxyz),
        PositionGoal("flange", flange.position),
        OrientationGoal("flange", flange.wxyz),
    ]
    return Problem(puma, goals)


def test_several_targets_are_moved_at_once_by_frame_or_index(puma):
    there = puma.forward(puma.home + 0.1)
    lower = np.array([0.1, 0.2, 0.3])
    at_once = several(puma)
    one_by_one = several(puma)
    at_once.retarget({"gripper": there, 1: lower, 2: there.matrix})
    for index, target in enumerate((there, lower, there.matrix)):
        one_by_one.retarget(target, index)
    assert np.array_equal(targets_of(at_once), targets_of(one_by_one))
    assert at_once.goals == one_by_one.goals
    at_once.retarget({})
    assert np.array_equal(targets_of(at_once), targets_of(one_by_one))


@pytest.mark.parametrize(
    ("targets", "message"),
    [
        ({"flange": (0, 0, 1)}, "2 goals .* frame 'flange'"),
        ({"elbow": (0, 0, 1)}, "no goals .* frame 'elbow'"),
        ({0: Pose(), 3: (0, 0, 1)}, "no goal 3"),
        ({-1: Pose()}, "no goal -1"),
        ({None: Pose()}, "no goal None"),
        ({0: Pose(), "gripper": Pose()}, "mean the same goal"),
        ({0: Pose(), 1: (np.nan, 0, 1)}, "finite"),
        ({0: Pose(), 2: (0, 0, 1)}, "no position"),
        ({0: Pose(), 1: PositionGoal("gripper", (0, 0, 1))}, "is a position goal"),
    ],
)
def test_either_all_or_none_of_several_targets_are_moved(puma, targets, message):
    problem = several(puma)
    before = targets_of(problem)
    goals = problem.goals
    with pytest.raises(InvalidGoalError, match=message):
        problem.retarget(targets)
    assert np.array_equal(targets_of(problem), before) and problem.goals == goals


def test_goals_without_a_frame_are_moved_by_index_or_stay(puma):
    goals = [
        PoseGoal(None, (0.4, 0.1, 0.9)),
        PostureGoal(q=puma.home),
        CenterOfMassGoal(None, (0, 0, 1), axes="xy"),
    ]
    problem = Problem(puma, goals)
    problem.retarget({1: puma.home + 0.2, 2: (0.1, 0.0, 0.0)})
    assert problem.goals == (
        goals[0],
        PostureGoal(q=puma.home + 0.2),
        CenterOfMassGoal(None, (0.1, 0, 0), axes="xy"),
    )
    before = problem.goals
    with pytest.raises(InvalidGoalError):
        problem.retarget({1: puma.home, 0: "nothing"})
    assert problem.goals == before
    with pytest.raises(InvalidGoalError, match="no goals"):
        problem.retarget({"left_hand": (0, 0, 1)})  # a centre of mass without a body is no frame's


def test_goals_have_their_current_targets(puma):
    first = puma.forward(puma.home + 0.1)
    then = puma.forward(puma.home - 0.2)
    goal = PoseGoal("gripper", first.position, first.wxyz, position_weight=2.0)
    problem = Problem(puma, goal)
    assert problem.goals == (goal,) == problem.solve().goals
    for move in (then, then.matrix, PoseGoal.at("gripper", then)):
        problem.retarget(first)
        before = problem.solve()
        if isinstance(move, PoseGoal):
            move = PoseGoal("gripper", then.position, then.wxyz, position_weight=2.0)
        problem.retarget(move)
        for shown in (problem.goals, problem.solve().goals, copy.deepcopy(problem).goals):
            assert isinstance(shown[0], PoseGoal) and shown[0].weights == goal.weights
            assert shown[0].target.distance(then) == pytest.approx((0, 0), abs=1e-7)
        # A solution keeps the targets of its own solve.
        assert before.goals[0].target.distance(first) == pytest.approx((0, 0), abs=1e-7)
    assert problem.given[0] is move  # a goal is stored unchanged


def test_a_solve_compiles_nothing_after_the_problem_was_built():
    """In a fresh process: compiled code before and after."""
    code = """
        import sys
        import robot_ik as rik

        def loaded():
            found = {}
            for name, module in list(sys.modules.items()):
                if name.startswith("robot_ik."):
                    for key, value in vars(module).items():
                        if type(value).__name__ == "CPUDispatcher" and value.overloads:
                            found[id(value)] = key, len(value.overloads)
            return sorted(found.values())

        robot = rik.load_robot("puma560")
        here, far = robot.forward(robot.home + 0.1), rik.Pose((3.0, 1.0, 1.0))
        if sys.argv[1] == "warm_up":
            rik.warm_up(robot)
            solve = lambda pose: rik.solve(robot, pose)
        else:
            problem = rik.Problem(robot, here)
            solve = lambda pose: problem.solve(target=pose)
        before = loaded()
        assert solve(here).solver == "analytic"
        assert solve(far).status.name == "UNREACHABLE"
        assert loaded() == before, [x for x in loaded() if x not in before]
    """
    for way in ("problem", "warm_up"):
        command = [sys.executable, "-c", textwrap.dedent(code), way]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, way + done.stderr
