"""Goals: what they ask for, and what is not a goal."""

import numpy as np
import pytest

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Pose
from robot_ik.goals import GOALS, OrientationGoal, PoseGoal, PositionGoal

QUARTER = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))


def test_targets_and_weights():
    assert PositionGoal("tool", (1, 2, 3), weight=2.0).target.position.tolist() == [1, 2, 3]
    assert PositionGoal("tool", (1, 2, 3), weight=2.0).weights == (2.0, 0.0)
    np.testing.assert_allclose(OrientationGoal("tool", (3, 0, 0, 3)).target.wxyz, QUARTER)
    assert OrientationGoal("tool", QUARTER).weights == (0.0, 1.0)
    pose = Pose((1, 2, 3), QUARTER)
    goal = PoseGoal.at("tool", pose)
    assert goal.target.distance(pose) == (0.0, 0.0) and goal.weights == (1.0, 1.0) and goal.frame == "tool"


@pytest.mark.parametrize("kind", GOALS)
def test_a_goal_moves_and_keeps_its_weights_and_frame(kind):
    weights = {"position_weight": 2.0, "angle_weight": 3.0} if kind is PoseGoal else {"weight": 2.0}
    target = {"position": (1, 2, 3)} if kind.has_position else {}
    target |= {"wxyz": QUARTER} if kind.has_angle else {}
    goal = kind("tool", **target, **weights)
    there = Pose((4, 5, 6), (0, 1, 0, 0))
    moved = goal.moved_to(there)
    assert type(moved) is kind and moved.frame == "tool" and moved.weights == goal.weights
    assert moved.target.position.tolist() == ([4, 5, 6] if kind.has_position else [0, 0, 0])
    assert moved.target.wxyz.tolist() == ([0, 1, 0, 0] if kind.has_angle else [1, 0, 0, 0])
    assert goal.target.position.tolist() == ([1, 2, 3] if kind.has_position else [0, 0, 0])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: PositionGoal("tool", (1, 2)), "3 numbers"),
        (lambda: PositionGoal("tool"), "3 numbers"),
        (lambda: PositionGoal("tool", "abc"), "3 numbers"),
        (lambda: PositionGoal("tool", [[1, 2, 3]]), "3 numbers"),
        (lambda: PositionGoal("tool", (1, np.nan, 3)), "finite"),
        (lambda: PositionGoal("tool", (1, 2, 3), weight=-1.0), "zero or more"),
        (lambda: PositionGoal("tool", (1, 2, 3), weight=np.nan), "zero or more"),
        (lambda: PositionGoal("tool", (1, 2, 3), weight="heavy"), "'heavy'"),
        (lambda: OrientationGoal("tool", (0, 0, 0, 0)), "zero quaternion"),
        (lambda: OrientationGoal("tool", (1, 0, 0)), "4 numbers"),
        (lambda: OrientationGoal("tool", (np.inf, 0, 0, 0)), "finite"),
        (lambda: PoseGoal("tool", (1, 2, 3), (0, 0, 0, 0)), "w, x, y, z"),
        (lambda: PoseGoal("tool", (1, 2, 3), angle_weight=-0.1), "angle_weight"),
    ],
)
def test_what_makes_no_sense_is_refused(make, says):
    with pytest.raises(InvalidGoalError, match=says):
        make()


def test_a_goal_owns_its_numbers():
    position = np.array([1.0, 2.0, 3.0])
    goal = PositionGoal("tool", position)
    position[0] = 9.0
    assert goal.target.position.tolist() == [1, 2, 3]


@pytest.mark.parametrize("made", [PositionGoal, OrientationGoal, PoseGoal])
def test_a_place_given_where_the_frame_belongs_is_explained(made):
    with pytest.raises(InvalidGoalError, match="the frame comes first"):
        made((0.1, 0.2, 0.3))
