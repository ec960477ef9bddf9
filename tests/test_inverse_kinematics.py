"""``solve``: names, options, defaults, and refused arguments."""

import dataclasses
import gc
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.errors import (
    InvalidGoalError,
    ModelError,
    OptionError,
    RobotIkError,
    UnknownSolverError,
    UnsupportedGoalError,
)
from robot_ik.goals import Goal, OrientationGoal, PoseGoal, PositionGoal
from robot_ik.problem import Problem
from robot_ik.solvers import SOLVERS, able_solvers, make_solver
from robot_ik.solvers.base import Solver
from robot_ik.solvers.iterative import IterativeSolver

ITERATIVE = [
    name
    for name, kind in SOLVERS.items()
    if (issubclass(kind, IterativeSolver) or hasattr(kind, "first_steps"))
]


@pytest.fixture(scope="module")
def puma():
    return rik.load_robot("puma560")


@pytest.fixture(scope="module")
def goal(puma):
    return PoseGoal.at(None, puma.forward(puma.home + 0.3))


def test_solvers_is_a_mapping_with_auto():
    assert {"auto", "lm", "dls", "ccd"} <= set(SOLVERS) and len(SOLVERS) == len(list(SOLVERS))
    assert "none" not in SOLVERS
    for name, kind in SOLVERS.items():
        assert issubclass(kind, Solver) and kind.name == name and kind.title and kind.source
    with pytest.raises(UnknownSolverError, match="did you mean 'dls'") as caught:
        SOLVERS["dlss"]
    assert "auto" in caught.value.known


@pytest.mark.parametrize("name", ITERATIVE)
def test_every_option_has_a_help_text_and_a_range(name):
    kind = SOLVERS[name]
    for field in dataclasses.fields(kind):
        meta = field.metadata
        assert meta["help"]
        if meta["choices"]:
            assert field.default in meta["choices"]
            with pytest.raises(OptionError, match=rf"solver {name}: {field.name}: .* not allowed"):
                kind(**{field.name: "none of them"})
            continue
        if isinstance(field.default, bool):
            continue
        assert meta["lower"] <= field.default <= meta["upper"]
        with pytest.raises(OptionError, match=rf"solver {name}: {field.name}: .* not allowed"):
            kind(**{field.name: type(field.default)(meta["upper"] * 2 + 1)})
    with pytest.raises(dataclasses.FrozenInstanceError):
        kind().patience = 3
    assert kind(patience=7) == kind(patience=7) != kind(patience=8)


def test_options_are_passed_by_name(puma, goal):
    assert make_solver("lm", patience=5).patience == 5
    ready = make_solver("dls", damping=0.1)
    assert make_solver(ready) is ready
    with pytest.raises(
        OptionError, match=r"unknown option \(did you mean 'damping'\?\)(.|\n)*patience"
    ):
        rik.solve(puma, goal, solver="lm", dampin=0.1)
    with pytest.raises(OptionError, match="not allowed"):
        rik.solve(puma, goal, solver="dls", damping=-1.0)


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("damping", "much", "a number"),
        ("patience", None, "a whole number"),
        ("patience", 2.5, "a whole number"),
        ("alternative", "yes", "True or False"),
        ("alternative", 2, "True or False"),
    ],
)
def test_an_option_of_another_type_is_refused(option, value, allowed):
    with pytest.raises(
        OptionError, match=f"solver lm: {option}: .* is not allowed; allowed: {allowed}"
    ):
        make_solver("lm", **{option: value})
    with pytest.raises(OptionError, match="solver combined: methods: "):
        make_solver("combined", methods=3)


def test_equal_numbers_of_another_type_are_accepted(puma, goal):
    plain = rik.solve(puma, goal, solver="lm", patience=3, damping=1.0, alternative=True)
    same = {"patience": 3.0, "damping": np.float32(1.0), "alternative": np.int64(1)}
    assert np.array_equal(rik.solve(puma, goal, solver="lm", **same).q, plain.q)


def test_an_instance_takes_no_options(puma, goal):
    with pytest.raises(OptionError, match="patience"):
        rik.solve(puma, goal, solver=make_solver("dls"), patience=3)


@pytest.mark.parametrize(
    "name", [n for n in ITERATIVE if issubclass(rik.PoseGoal, SOLVERS[n].goals)]
)
def test_the_solution_has_the_name_of_its_method(puma, goal, name):
    solution = rik.solve(puma, goal, solver=name, tolerance=rik.Tolerance(1e-3, 1e-2))
    assert solution.solver == name and solution.converged and solution.seconds > 0


def test_defaults_are_home_a_tenth_of_a_millimetre_and_a_milliradian(puma, goal):
    solution = rik.solve(puma, goal)
    assert solution.error.position <= 1e-4 and solution.error.angle <= 1e-3
    again = rik.solve(puma, goal, start=puma.home, tolerance=rik.Tolerance(1e-4, 1e-3), seed=0)
    assert np.array_equal(solution.q, again.q)
    other = rik.solve(puma, goal, solver="lm", start=puma.home + 0.25)
    assert not np.array_equal(rik.solve(puma, goal, solver="lm").q, other.q)


def test_wrong_starts_are_refused(puma, goal):
    with pytest.raises(ModelError, match="start must be 6 numbers, not 2"):
        rik.solve(puma, goal, start=[0, 0])
    with pytest.raises(ModelError, match="start must be finite"):
        rik.solve(puma, goal, start=[np.nan] * 6)


def test_an_unsupported_goal_is_refused_with_supporting_methods(puma, monkeypatch):
    monkeypatch.setattr(SOLVERS["ccd"], "goals", (PositionGoal,))
    able = able_solvers(rik.Problem(puma, OrientationGoal(None, (1, 0, 0, 0))))
    assert "lm" in able and "ccd" not in able
    with pytest.raises(
        UnsupportedGoalError, match=r"'ccd' does not support a pose goal(.|\n)*lm, (.*, )?dls"
    ):
        rik.solve(puma, PoseGoal(None, (0, 0, 1)), solver="ccd")


def test_the_base_class_of_goals_is_refused(puma):
    with pytest.raises(InvalidGoalError, match="one of the kinds"):
        rik.solve(puma, Goal("gripper"))


def test_every_lazy_name_of_the_package_exists():
    assert set(rik.__all__) == {*rik._MODULE_OF, "__version__"} == set(dir(rik))
    for name in rik.__all__:
        assert getattr(rik, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = rik.nothing


@pytest.fixture
def compiled(monkeypatch):
    """Return the list of problems that ``solve`` builds."""
    built = []

    class Counted(Problem):
        def __init__(self, *args, **options):
            built.append(args)
            super().__init__(*args, **options)

    monkeypatch.setattr(sys.modules["robot_ik.inverse_kinematics"], "Problem", Counted)
    return built


def fresh_answer(robot, goal, name, start, budget, seed):
    problem = Problem(robot, goal, budget=budget, seed=seed, solver=name)
    return problem.solve(start)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_loop_of_calls_compiles_once_and_keeps_no_solution(name, compiled):
    robot = rik.load_robot("puma560")
    rng = np.random.default_rng(3)
    kind = PoseGoal if issubclass(PoseGoal, SOLVERS[name].goals) else PositionGoal
    cases = []
    for _ in range(12):
        position = robot.forward(robot.sample(rng)).position
        goal = kind(None, position * rng.choice([1.0, 4.0]))
        budget = Budget(int(rng.integers(5, 300)), restarts=int(rng.integers(3)))
        cases.append((goal, robot.sample(rng), budget, int(rng.integers(9))))
    for k in [*range(12), *rng.permutation(12)]:
        goal, start, budget, seed = cases[k]
        result = rik.solve(robot, goal, solver=name, start=start, budget=budget, seed=seed)
        wanted = fresh_answer(robot, goal, name, start, budget, seed)
        assert np.array_equal(result.q, wanted.q) and result.status is wanted.status
        assert (result.iterations, result.restarts) == (wanted.iterations, wanted.restarts)
        assert result.goals == (goal,) and result.error == wanted.error
    assert len(compiled) == 1


def test_other_kinds_frames_methods_options_and_tolerances_get_new_problems(compiled):
    robot = rik.load_robot("puma560")
    pose = robot.forward(robot.home + 0.1)
    calls = [
        lambda: rik.solve(robot, PoseGoal.at(None, pose)),
        lambda: rik.solve(robot, PoseGoal.at("flange", pose)),
        lambda: rik.solve(robot, PositionGoal(None, pose.position)),
        lambda: rik.solve(robot, PositionGoal(None, pose.position, axes="xy")),
        lambda: rik.solve(robot, [PoseGoal.at(None, pose), PositionGoal("flange", pose.position)]),
        lambda: rik.solve(robot, PoseGoal.at(None, pose), solver="lm"),
        lambda: rik.solve(robot, PoseGoal.at(None, pose), solver="lm", patience=7),
        lambda: rik.solve(robot, PoseGoal.at(None, pose), tolerance=rik.Tolerance(1e-6, 1e-6)),
        lambda: rik.solve(robot, PoseGoal.at(None, pose), solver=make_solver("dls", damping=0.3)),
    ]
    results = [call() for call in calls]
    assert len(compiled) == len(calls)
    for call, before in zip(calls, results, strict=True):
        assert np.array_equal(call().q, before.q)
    assert len(compiled) == len(calls)


def test_the_number_of_kept_problems_is_bounded():
    robot = rik.load_robot("puma560")
    pose = robot.forward(robot.home + 0.1)
    for k in range(100):
        rik.solve(robot, PositionGoal(None, pose.position, length=0.1 + 0.01 * k), solver="lm")
    problems = [one for one in gc.get_objects() if isinstance(one, Problem)]
    assert 1 <= len([one for one in problems if one.robot is robot]) <= 64


def test_calls_in_several_threads_use_separate_problems(puma):
    rng = np.random.default_rng(5)
    goals = [PoseGoal.at(None, puma.forward(puma.sample(rng))) for _ in range(12)]
    alone = [rik.solve(puma, goal, solver="lm").q for goal in goals]

    def many(_):
        return all(
            np.array_equal(rik.solve(puma, goal, solver="lm").q, q)
            for _ in range(10)
            for goal, q in zip(goals, alone, strict=True)
        )

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(many, range(8)))


def test_an_error_does_not_affect_the_next_call(puma, goal):
    wanted = rik.solve(puma, goal).q
    for wrong in (
        {"start": [0, 0]},
        {"start": [np.nan] * 6},
        {"seed": 0.5},
        {"budget": 3},
        {"tolerance": 1},
    ):
        with pytest.raises(RobotIkError):
            rik.solve(puma, goal, **wrong)
    with pytest.raises(UnsupportedGoalError):
        rik.solve(puma, goal, solver="recursive")
    assert np.array_equal(rik.solve(puma, goal).q, wanted)
    with pytest.raises(ModelError, match="needs a robot"):
        rik.solve("puma560", goal)


def test_all_branches_of_a_pose_and_of_an_array(puma, goal):
    wanted = rik.solve_all(puma, goal)
    pose = goal.target
    for given in (pose, pose.matrix):
        result = rik.solve_all(puma, given)
        assert [b.name for b in result] == [b.name for b in wanted]
        assert np.allclose([b.q for b in result], [b.q for b in wanted])


def test_warm_up_supports_every_method_and_refuses_as_solve_does(puma, goal):
    for name in SOLVERS:
        kind = (
            goal
            if issubclass(PoseGoal, SOLVERS[name].goals)
            else PositionGoal(None, (0.1, 0.2, 0.3))
        )
        rik.warm_up(puma, kind, solver=name)
    rik.warm_up(puma, [goal, PositionGoal("flange", (0, 0, 1))], solver="lm", patience=3)
    with pytest.raises(UnsupportedGoalError):
        rik.warm_up(puma, goal, solver="recursive")
    with pytest.raises(UnknownSolverError):
        rik.warm_up(puma, solver="none")
