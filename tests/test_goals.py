"""Goals: targets, weights, equality, and refused arguments."""

import copy
import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Pose
from robot_ik.goals import (
    GOALS,
    AimGoal,
    CenterOfMassGoal,
    HalfSpaceGoal,
    LineGoal,
    OrientationGoal,
    PlaneGoal,
    PoseGoal,
    PosePriorGoal,
    PositionGoal,
    PostureGoal,
    Tolerance,
)

QUARTER = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))


def test_targets_and_weights():
    assert PositionGoal("tool", (1, 2, 3), weight=2.0).target.position.tolist() == [1, 2, 3]
    assert PositionGoal("tool", (1, 2, 3), weight=2.0).weights == (2.0, 0.0)
    np.testing.assert_allclose(OrientationGoal("tool", (3, 0, 0, 3)).target.wxyz, QUARTER)
    assert OrientationGoal("tool", QUARTER).weights == (0.0, 1.0)
    pose = Pose((1, 2, 3), QUARTER)
    goal = PoseGoal.at("tool", pose)
    assert goal.target.distance(pose) == (0.0, 0.0)
    assert goal.weights == (1.0, 1.0)
    assert goal.frame == "tool"


MADE = [
    PositionGoal("tool", (1, 2, 3), weight=2.0, priority=1),
    PositionGoal("tool", (1, 2, 3), axes="zx"),
    OrientationGoal("tool", QUARTER, weight=2.0),
    OrientationGoal("tool", QUARTER, free_axis="-x", tolerance=Tolerance(1.0, 0.1)),
    PoseGoal("tool", (1, 2, 3), QUARTER, position_weight=2.0, angle_weight=3.0, length=0.4),
    PoseGoal("tool", (1, 2, 3), QUARTER, free_axis=(0, 3, 4)),
    AimGoal("tool", (1, 2, 3), axis="y"),
    LineGoal("tool", (1, 2, 3), (0, 0, 2)),
    PlaneGoal("tool", (1, 2, 3), "x"),
    HalfSpaceGoal("tool", (1, 2, 3), "-y"),
    CenterOfMassGoal("body", (1, 2, 3), axes="xy"),
]


@pytest.mark.parametrize("goal", MADE, ids=range(len(MADE)))
def test_a_moved_goal_differs_only_in_its_target(goal):
    there = Pose((4, 5, 6), (0, 1, 0, 0))
    before = goal.target
    moved = goal.moved_to(there)
    assert type(moved) is type(goal) and moved.frame == goal.frame and moved.kind == goal.kind
    if not isinstance(goal, OrientationGoal):
        assert moved.target.position.tolist() == [4, 5, 6]
    if isinstance(goal, (OrientationGoal, PoseGoal)):
        assert moved.target.wxyz.tolist() == [0, 1, 0, 0]
    if isinstance(goal, (LineGoal, PlaneGoal, HalfSpaceGoal)):
        np.testing.assert_allclose(moved.target.rotation[:, 2], [0, 0, -1], atol=1e-12)
    assert goal.target.distance(before) == (0.0, 0.0)


def test_messages_name_a_goal_with_its_article():
    assert [goal.with_article for goal in MADE[2:7:2]] == [
        "an orientation goal",
        "a pose goal",
        "an aim goal",
    ]


def test_every_kind_of_goal_is_in_the_lists_of_this_file():
    assert {type(goal) for goal in MADE} | {PostureGoal, PosePriorGoal} == set(GOALS)
    rest = PostureGoal(q=(0.1, 0.2), joints={"elbow": 2.0}, priority=3)
    assert replace(rest, q=(0.3, 0.4)).kind == rest.kind
    with pytest.raises(InvalidGoalError, match="no pose to move"):
        rest.moved_to(Pose())


@pytest.mark.parametrize(
    ("make", "message"),
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
        (lambda: PoseGoal("tool", (1, 2, 3), length=0.0), "length"),
        (lambda: PoseGoal("tool", (1, 2, 3), free_axis="w"), "free_axis"),
        (lambda: PositionGoal("tool", (1, 2, 3), axes="xx"), "letters x, y and z"),
        (lambda: PositionGoal("tool", (1, 2, 3), axes=""), "letters x, y and z"),
        (lambda: PositionGoal("tool", (1, 2, 3), priority=-1), "priority"),
        (lambda: PositionGoal("tool", (1, 2, 3), priority=0.5), "priority"),
        (lambda: PositionGoal("tool", (1, 2, 3), tolerance=1e-3), "Tolerance"),
        (lambda: AimGoal("tool", (1, 2, 3), axis=(0, 0, 0)), "zero vector"),
        (lambda: AimGoal("tool"), "point must be 3 numbers"),
        (lambda: LineGoal("tool", (1, 2, 3), (0, 0, 0)), "zero vector"),
        (lambda: PlaneGoal("tool", (1, 2, np.nan), "z"), "finite"),
        (lambda: CenterOfMassGoal(None, (1, 2, 3), axes="q"), "letters"),
        (lambda: PostureGoal(), "robot.home"),
        (lambda: PostureGoal(q=(0, np.inf)), "finite"),
        (lambda: PostureGoal(q=(0, 1), joints={"elbow": -1.0}), "elbow"),
    ],
)
def test_invalid_goals_are_refused(make, message):
    with pytest.raises(InvalidGoalError, match=message):
        make()


def test_a_goal_has_copies_of_its_numbers():
    position = np.array([1.0, 2.0, 3.0])
    goal = PositionGoal("tool", position)
    position[0] = 9.0
    assert goal.target.position.tolist() == [1, 2, 3]


@pytest.mark.parametrize("made", [PositionGoal, OrientationGoal, PoseGoal])
def test_a_position_in_place_of_the_frame_is_refused_with_a_hint(made):
    with pytest.raises(InvalidGoalError, match="the frame comes first"):
        made((0.1, 0.2, 0.3))


PLACE = (1, 2, 3)
LIST = [1.0, 2, 3]
EQUALS = [
    (partial(PositionGoal, "hand", PLACE), partial(PositionGoal, "hand", np.array(LIST))),
    (partial(PoseGoal, "hand", PLACE, (2, 0, 0, 0)), partial(PoseGoal, "hand", LIST)),
    (partial(OrientationGoal, None, (0, 1, 0, 0)), partial(OrientationGoal, None, [0, 3, 0, 0])),
    (
        partial(AimGoal, "head", PLACE, axis=(0, 0, 1)),
        partial(AimGoal, "head", LIST, axis=[0, 0, 1]),
    ),
    (partial(LineGoal, "hand", PLACE, "x"), partial(LineGoal, "hand", LIST, (2, 0, 0))),
    (
        partial(PostureGoal, q=[0.1, 0.2], joints={"a": 1, "b": 2}),
        partial(PostureGoal, q=(0.1, 0.2), joints={"b": 2, "a": 1}),
    ),
    (partial(CenterOfMassGoal, None, PLACE), partial(CenterOfMassGoal, None, LIST, axes="xyz")),
]


@pytest.mark.parametrize(("make", "again"), EQUALS)
def test_goals_are_equal_by_value_and_can_be_keys(make, again):
    assert make() == again() and hash(make()) == hash(again()) and len({make(), again()}) == 1
    assert make() == copy.deepcopy(make()) == pickle.loads(pickle.dumps(make()))
    for options in ({"priority": 1}, {"tolerance": Tolerance(1e-5)}, {"length": 0.5}):
        assert make(**options) == again(**options) != make()
    assert make() != "goal" and make() != LineGoal("hand", (9, 9, 9))


def test_goals_of_other_kinds_or_numbers_are_not_equal():
    assert LineGoal("hand", (1, 2, 3)) != PlaneGoal("hand", (1, 2, 3))
    assert PositionGoal("hand", (1, 2, 3)) != PositionGoal(None, (1, 2, 3))
    assert PositionGoal("hand", (1, 2, 3)) != PositionGoal("hand", (1, 2, 3.1))
    assert PoseGoal("hand", (1, 2, 3)) != PoseGoal("hand", (1, 2, 3), free_axis="z")


@pytest.mark.parametrize(("make", "again"), EQUALS)
def test_the_repr_of_a_goal_has_its_unusual_options_on_one_line(make, again):
    text = repr(make(priority=1, length=0.25))
    assert text.startswith(type(make()).__name__ + "(") and "priority=1, length=0.25" in text
    assert len(text) < 150 and "\n" not in text and "tolerance" not in text
    assert len(repr(PostureGoal(q=np.zeros(41)))) < 100
