"""The front door: names, options, defaults, and what is refused."""

import dataclasses

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import (
    ConfigError,
    InvalidGoalError,
    ModelError,
    UnknownSolverError,
    UnsupportedGoalError,
)
from robot_ik.goals import Goal, OrientationGoal, PoseGoal, PositionGoal
from robot_ik.solvers import SOLVERS, able_solvers, make_solver
from robot_ik.solvers.base import IterativeSolver, Solver

ITERATIVE = [name for name, kind in SOLVERS.items() if issubclass(kind, IterativeSolver)]


@pytest.fixture(scope="module")
def puma():
    return rik.load_robot("puma560")


@pytest.fixture(scope="module")
def goal(puma):
    return PoseGoal.at(None, puma.forward(puma.home + 0.3))


def test_the_table_of_solvers_is_a_mapping_that_also_knows_auto():
    assert {"auto", "lm", "dls", "ccd"} <= set(SOLVERS) and len(SOLVERS) == len(list(SOLVERS))
    assert "none" not in SOLVERS
    for name, kind in SOLVERS.items():
        assert issubclass(kind, Solver) and kind.name == name and kind.title and kind.source
    with pytest.raises(UnknownSolverError, match="did you mean 'dls'") as caught:
        SOLVERS["dlss"]
    assert "auto" in caught.value.known


@pytest.mark.parametrize("name", ITERATIVE)
def test_every_option_says_what_it_is_and_keeps_its_range(name):
    kind = SOLVERS[name]
    for field in dataclasses.fields(kind):
        meta = field.metadata
        assert meta["help"]
        if meta["choices"]:
            assert field.default in meta["choices"]
            with pytest.raises(ConfigError, match=rf"solver {name}: {field.name}: .* no choice"):
                kind(**{field.name: "none of them"})
            continue
        if isinstance(field.default, bool):
            continue
        assert meta["low"] <= field.default <= meta["high"]
        with pytest.raises(ConfigError, match=rf"solver {name}: {field.name}: .* out of range"):
            kind(**{field.name: type(field.default)(meta["high"] * 2 + 1)})
    with pytest.raises(dataclasses.FrozenInstanceError):
        kind().restarts = 3
    assert kind(restarts=7) == kind(restarts=7) != kind(restarts=8)


def test_options_go_through_by_name(puma, goal):
    assert make_solver("lm", restarts=5).restarts == 5
    ready = make_solver("dls", damping=0.1)
    assert make_solver(ready) is ready
    with pytest.raises(ConfigError, match=r"unknown option \(did you mean 'damping'\?\)(.|\n)*patience"):
        rik.solve(puma, goal, solver="lm", dampin=0.1)
    with pytest.raises(ConfigError, match="out of range"):
        rik.solve(puma, goal, solver="dls", damping=-1.0)


def test_an_instance_takes_no_options(puma, goal):
    with pytest.raises(ConfigError, match="restarts"):
        rik.solve(puma, goal, solver=make_solver("dls"), restarts=3)


@pytest.mark.parametrize("name", [name for name in ITERATIVE if rik.PoseGoal in SOLVERS[name].goals])
def test_the_answer_names_the_method_that_found_it(puma, goal, name):
    solution = rik.solve(puma, goal, solver=name, tolerance=rik.Tolerance(1e-3, 1e-2))
    assert solution.solver == name and solution.converged and solution.seconds > 0


def test_defaults_are_home_a_tenth_of_a_millimetre_and_a_milliradian(puma, goal):
    solution = rik.solve(puma, goal)
    assert solution.miss.position <= 1e-4 and solution.miss.angle <= 1e-3
    again = rik.solve(puma, goal, start=puma.home, tolerance=rik.Tolerance(1e-4, 1e-3), seed=0)
    assert np.array_equal(solution.q, again.q)
    other = rik.solve(puma, goal, solver="lm", start=puma.home + 0.25)
    assert not np.array_equal(rik.solve(puma, goal, solver="lm").q, other.q)


def test_wrong_starts_are_refused(puma, goal):
    with pytest.raises(ModelError, match=r"start must have shape \(6,\)"):
        rik.solve(puma, goal, start=[0, 0])
    with pytest.raises(ModelError, match="start must be finite"):
        rik.solve(puma, goal, start=[np.nan] * 6)


def test_a_kind_of_goal_that_a_method_cannot_serve_is_told_with_those_that_can(puma, monkeypatch):
    monkeypatch.setattr(SOLVERS["ccd"], "goals", (PositionGoal,))
    able = able_solvers(rik.Problem(puma, OrientationGoal(None, (1, 0, 0, 0))))
    assert "lm" in able and "ccd" not in able
    with pytest.raises(UnsupportedGoalError, match=r"'ccd' cannot serve a pose goal(.|\n)*lm, dls"):
        rik.solve(puma, PoseGoal(None, (0, 0, 1)), solver="ccd")


def test_a_goal_of_no_kind_is_refused(puma):
    with pytest.raises(InvalidGoalError, match="says nothing"):
        rik.solve(puma, Goal("gripper"))


def test_a_new_method_needs_no_other_change():
    """A kernel of its own and a name: all that a subclass must give."""
    assert IterativeSolver.__abstractmethods__ == {"kernel", "parameters"}


def test_every_lazy_name_of_the_package_is_there():
    assert set(rik.__all__) == {*rik._MODULE_OF, "__version__"} == set(dir(rik))
    for name in rik.__all__:
        assert getattr(rik, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = rik.nothing
