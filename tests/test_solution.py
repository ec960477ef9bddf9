"""Solutions: status, error, meaning and ``require``."""

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.errors import NotConvergedError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.robot import load_robot
from robot_ik.solution import Status


@pytest.fixture(scope="module")
def puma():
    return load_robot("puma560")


def test_require_returns_the_solution_or_raises_with_the_error(puma):
    good = solve(puma, PoseGoal.at(None, puma.forward(puma.home + 0.1)))
    assert good.require() is good
    bad = solve(puma, PositionGoal(None, (3, 0, 1)), solver="lm")
    with pytest.raises(
        NotConvergedError, match=r"lm did not reach the goal \(UNREACHABLE: proven.* mm"
    ) as caught:
        bad.require()
    assert caught.value.solution is bad
    assert f"{1000 * bad.error.position:.2f} mm" in str(caught.value)


def test_every_status_has_its_meaning():
    assert len({status.meaning for status in Status}) == len(Status) == 9
    assert repr(Status.STALLED.name) == "'STALLED'"


def test_the_error_has_only_the_parts_of_the_goal(puma):
    far = Budget(iterations=0)
    q = puma.home + 0.2
    pose = puma.forward(q)
    metres, radians = puma.measure(puma.home).distance(pose)
    for goal, expected in [
        (PositionGoal(None, pose.position), (metres, 0.0)),
        (OrientationGoal(None, pose.wxyz), (0.0, radians)),
        (PoseGoal.at(None, pose), (metres, radians)),
        (PoseGoal(None, pose.position, pose.wxyz, angle_weight=0.0), (metres, 0.0)),
    ]:
        error = solve(puma, goal, budget=far).error
        assert (error.position, error.angle) == pytest.approx(expected, abs=1e-12)
    both = solve(
        puma,
        [PoseGoal.at(None, puma.forward(puma.home)), PositionGoal(None, pose.position)],
        budget=far,
    )
    assert both.errors[0].position == pytest.approx(0, abs=1e-12)
    assert both.error.position == pytest.approx(metres) and both.error.angle == pytest.approx(
        0, abs=1e-7
    )


def test_a_goal_with_a_part_of_weight_zero_is_met_by_the_other_part(puma):
    pose = puma.forward(puma.home + 0.2)
    solution = solve(puma, PoseGoal(None, pose.position, (0, 0, 1, 0), angle_weight=0.0))
    assert (
        solution.converged
        and np.linalg.norm(puma.measure(solution.q).position - pose.position) <= 1e-4
    )


def test_the_repr_of_a_solution_is_one_line(puma):
    text = repr(solve(puma, PositionGoal(None, (3, 0, 1)), solver="lm"))
    assert text.startswith("Solution(UNREACHABLE, q=[") and "solver='lm'" in text
