"""``robot-ik solvers``: the table is made from ``SOLVERS`` and complete."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import pytest

from robot_ik.commands.solvers import goals_text, solver_facts
from robot_ik.goals import GOALS, OrientationGoal, PoseGoal, PositionGoal
from robot_ik.solvers import SOLVERS
from robot_ik.solvers.damped_least_squares import DampedLeastSquares


def test_every_method_is_listed(robot_ik: Any) -> None:
    run = robot_ik("solvers")
    assert run.code == 0
    for name, kind in SOLVERS.items():
        line = next(line for line in run.out.splitlines() if line.startswith(name + " "))
        assert kind.title in line
        goals = GOALS if kind.partial_goals else (PositionGoal, OrientationGoal, PoseGoal)
        served = [goal for goal in goals if issubclass(goal, kind.goals)]
        every = kind.partial_goals and served == list(GOALS)
        for word in (
            ["every kind"] if every else [goal.name.removesuffix(" goal") for goal in served]
        ):
            assert word in line
    rows = json.loads(robot_ik("solvers", "--json").out)
    assert [row["name"] for row in rows["solvers"]] == list(SOLVERS)


def test_a_method_without_parts_of_poses_lists_no_goal_that_is_one() -> None:
    class Whole(DampedLeastSquares):
        partial_goals = False

    assert goals_text(solver_facts("whole", Whole)) == "position, orientation, pose"
    assert goals_text(solver_facts("dls", DampedLeastSquares)) == "every kind"


@pytest.mark.parametrize("name", SOLVERS)
def test_every_option_is_explained(name: str, robot_ik: Any) -> None:
    run = robot_ik("solvers", name)
    assert run.code == 0 and SOLVERS[name].title in run.out
    rows = {
        row["name"]: row for row in json.loads(robot_ik("solvers", name, "--json").out)["options"]
    }
    assert list(rows) == [field.name for field in fields(SOLVERS[name])]
    for option, row in rows.items():
        line = next(line for line in run.out.splitlines() if line.startswith(option + " "))
        assert row["help"] and row["help"] in line, option
        if isinstance(row["default"], (int, float)) and not isinstance(row["default"], bool):
            assert row["lower"] <= row["default"] <= row["upper"], option


def test_unknown_method_names_the_close_one(robot_ik: Any) -> None:
    run = robot_ik("solvers", "dsl")
    run.assert_one_screen_error()
    assert "'dls'" in run.err


def test_choices_are_shown_and_taken(robot_ik: Any) -> None:
    run = robot_ik("solvers", "pseudoinverse")
    line = next(line for line in run.out.splitlines() if line.startswith("aim "))
    assert "none | rest | limits" in line
    rows = {
        row["name"]: row
        for row in json.loads(robot_ik("solvers", "pseudoinverse", "--json").out)["options"]
    }
    assert rows["aim"]["choices"] == ["none", "rest", "limits"] and rows["clamp"]["choices"] == []
    goal = ("--goal", "-0.4", "-0.1", "0.7", "--solver", "pseudoinverse", "--set")
    solved = robot_ik("solve", "--json", *goal, "aim=rest", "alternative=true")
    assert solved.code == 0 and json.loads(solved.out)["solver"] == "pseudoinverse"
    refused = robot_ik("solve", *goal, "aim=clever")
    refused.assert_one_screen_error()
    assert "none, rest, limits" in refused.err
