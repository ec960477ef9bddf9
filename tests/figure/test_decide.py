"""Decisions: by the position of a ball, and against an independent judge of reach and bend."""

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from robot_ik.errors import InvalidGoalError, ModelError
from robot_ik.figure.abilities import Abilities
from robot_ik.figure.decide import ACTIONS, Decider, Decision, inside_body
from robot_ik.figure.figure import Figure, load_figure
from robot_ik.figure.frames import Frames, PreparedRows
from robot_ik.figure.pose_search import best_pose, find_pose
from robot_ik.figure.poses import BEND, REACH, touches_itself
from robot_ik.figure.reach_map import POINTS, SHARE, SLACK
from robot_ik.geometry import axis_rotations
from robot_ik.robot import load_robot

Array = NDArray[np.float64]

# The judge is a file in this folder, outside all packages.
_spec = importlib.util.spec_from_file_location("judge", Path(__file__).with_name("judge.py"))
assert _spec is not None
assert _spec.loader is not None
judges: Any = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(judges)

BALLS = {
    "reach": (0.45, -0.25, 1.2),
    "bend": (0.5, -0.2, 0.2),
    "jump": (0.2, -0.2, 2.35),
    "walk": (2.5, 0.5, 1.2),
    "nothing": (0.5, 0.5, 3.2),
}

JUDGED = Path(__file__).with_name("judged_balls.csv")
"""Balls judged by 64 random starts each, some seconds per ball:
``python tests/figure/judge.py COUNT 2 > tests/figure/judged_balls.csv``"""


def in_world(ball: Array | tuple[float, ...], stance: tuple[float, float, float]) -> Array:
    """Return a ball in the frame of a stance in the world."""
    rotated = axis_rotations("z", stance[2]) @ np.array(ball)
    return np.asarray(rotated + np.array([stance[0], stance[1], 0.0]))


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("stance", [(0.0, 0.0, 0.0), (3.0, -2.0, 2.5)])
def test_every_action_is_decided_anywhere(
    decider: Decider, action: str, stance: tuple[float, float, float]
) -> None:
    decision = decider.decide(in_world(BALLS[action], stance), stance)
    assert decision.action == action, decision.reason
    assert (decision.stance is not None) == (action == "walk")
    assert (decision.arm is not None) == (action != "nothing")
    assert decision.reason


@pytest.mark.parametrize(
    ("ball", "reason"),
    [
        (None, "no ball is seen"),
        ((np.nan, 0, 1), "no ball is seen"),
        ((0.0, 0.0, 1.3), "inside its torso"),
        ((1.0, 0.0, -0.1), "10 cm under the floor"),
        ((30.0, 0.0, 1.0), "outside the workspace of 8 m"),
        ((0.5, 0.5, 3.2), "out of reach, jumping too"),
        ((0.0, 0.0, 0.0), "no stance was found"),
    ],
)
def test_doing_nothing_has_a_reason(
    decider: Decider, ball: tuple[float, ...] | None, reason: str
) -> None:
    decision = decider.decide(ball)
    assert decision.action == "nothing"
    assert reason in decision.reason


@pytest.mark.parametrize(
    "kind",
    [
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    ],
)
def test_a_ball_is_inside_a_body_of_any_shape(kind: mujoco.mjtGeom) -> None:
    """The ball is away from the middle of the shape by more than its first size."""
    torso = 0
    robot = load_robot("humanoid")
    figure = load_figure(robot)
    data = figure.data_at(figure.home)
    middle = data.geom_xpos[torso].copy()
    axis = data.geom_xmat[torso].reshape(3, 3)[:, 2].copy()
    robot.model.geom_type[torso] = kind
    robot.model.geom_size[torso] = (0.05, 0.5, 0.5)
    robot.model.geom_rbound[torso] = 1.0
    assert inside_body(figure, middle + 0.4 * axis) == "torso"
    assert inside_body(figure, middle - 0.4 * axis) == "torso"
    assert inside_body(figure, middle + 0.7 * axis) != "torso"


@pytest.mark.parametrize("ball", [(0.0, 0.0, 0.05), (-0.05, 0.0, 0.05), (-0.05, 0.1, 0.05)])
def test_a_ball_between_the_feet_is_stepped_away_from(
    decider: Decider, ball: tuple[float, float, float]
) -> None:
    decision = decider.decide(ball)
    assert decision.action == "walk"
    assert decision.then == BEND
    assert "from farther off" in decision.reason


def test_two_balls_are_refused(decider: Decider) -> None:
    with pytest.raises(InvalidGoalError, match="three numbers"):
        decider.decide(((0.4, 0.2, 1.0), (0.4, -0.2, 1.0)))  # type: ignore[arg-type]
    with pytest.raises(InvalidGoalError, match="three numbers"):
        decider.decide("ball")


def test_the_nearer_arm_acts_and_the_last_one_in_the_middle(decider: Decider) -> None:
    assert decider.decide((0.4, 0.25, 1.2)).arm == "left"
    assert decider.decide((0.4, -0.25, 1.2)).arm == "right"
    middle = (0.45, 0.003, 1.2)
    assert decider.decide(middle).arm == "right"
    last = Decision("reach", "left", "")
    assert decider.decide(middle, last=last).arm == "left"


def test_a_bending_figure_continues_to_bend_a_little_farther(decider: Decider) -> None:
    """The ball is 1 cm above the highest one that a figure at rest bends for."""
    low = 1.9
    high = 2.4
    while high - low > 0.002:
        middle = (low + high) / 2
        if decider.decide((0.2, -0.25, middle)).action in ("reach", "bend"):
            low = middle
        else:
            high = middle
    ball = (0.2, -0.25, high + 0.01)
    assert decider.decide(ball).action != "bend"
    continued = decider.decide(ball, last=Decision("bend", "right", ""))
    assert continued.action == "bend"
    assert "edge" in continued.reason


@settings(max_examples=10)
@given(
    ball=st.tuples(st.floats(0.2, 0.8), st.floats(-0.6, 0.6), st.floats(0.2, 2.3)),
    stance=st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3)),
)
def test_decisions_do_not_depend_on_place_and_heading(
    abilities: Abilities, ball: tuple[float, ...], stance: tuple[float, float, float]
) -> None:
    decider = Decider(abilities)
    at_origin = decider.decide(ball)
    at_stance = decider.decide(in_world(ball, stance), stance)
    assert (at_origin.action, at_origin.arm) == (at_stance.action, at_stance.arm)


@pytest.mark.parametrize("kind", [REACH, BEND])
def test_the_bundled_map_is_of_this_model(figure: Figure, abilities: Abilities, kind: str) -> None:
    """Some points are solved again, with the tolerance of ``ReachMap.is_out_of_reach``."""
    rng = np.random.default_rng(3)
    reach_map = abilities.maps[kind, "right"]
    error = reach_map.error.ravel()
    certain = np.flatnonzero(np.isfinite(error) & ((error == 0.0) | (error > 0.01)))
    for i in rng.choice(certain, 12, replace=False):
        pose = best_pose(figure, POINTS[i], "right", kind, reach_map.nearby(POINTS[i]))
        assert pose is not None
        if error[i] == 0.0:
            assert not pose.violation
        else:  # a smaller error would hide a ball in reach
            assert pose.error >= SHARE * error[i] - SLACK


@pytest.mark.parametrize(
    "ball",
    [
        (0.241, -0.3098, 0.0777),
        (0.0944, -0.1579, 0.0902),
        (0.5238, 0.0222, 0.0622),
        (0.268, 0.5217, 0.058),
        (0.6074, -0.587, 0.0501),
    ],
)
def test_a_ball_just_above_the_floor_is_reached_with_the_hand_above_the_floor(
    figure: Figure, decider: Decider, ball: tuple[float, float, float]
) -> None:
    decision = decider.decide(ball)
    assert decision.action == BEND, decision.reason
    assert decision.arm is not None
    pose = decider.abilities.confirmed_pose(BEND, np.array(ball), decision.arm)
    assert pose is not None
    judge = judges.Judge(figure)
    assert judge.admissible(pose.q, np.array(ball), decision.arm, BEND)


@pytest.mark.parametrize("ball", [(0.9574, 0.6945, 0.0822), (0.93, -0.758, 0.0617)])
def test_a_ball_on_the_floor_out_of_reach_is_walked_to(
    decider: Decider, ball: tuple[float, float, float]
) -> None:
    decision = decider.decide(ball)
    assert decision.action == "walk", decision.reason
    assert decision.then == BEND, decision.reason


@pytest.mark.parametrize(
    "ball",
    [
        (0.3, 0.04, 0.26),
        (0.22, 0.01, 0.22),
        (0.33, 0.0, 0.24),
        (0.24, 0.15, 0.31),
        (0.43, -0.06, 0.15),
    ],
)
def test_a_pose_in_which_no_bodies_touch_is_preferred(
    figure: Figure, abilities: Abilities, ball: tuple[float, float, float]
) -> None:
    arm = "right" if ball[1] <= 0.0 else "left"
    pose = abilities.natural_pose(BEND, np.array(ball), arm)
    assert not pose.violation
    assert not touches_itself(figure, pose.q[None])


def judged_balls() -> tuple[str, list[tuple[Array, str]]]:
    """Return the first line of the file, and balls with the right decision or ``border``."""
    head, *rows = JUDGED.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    return head, [(np.array([float(x) for x in row[:3]]), row[3]) for row in cells]


def disagreement(decider: Decider, judge: Any, ball: Array, label: str, k: int) -> str:
    """Return how the decision for a ball differs from its label. Empty if it does not.

    A pose that the judge accepts proves what its own search may have missed.
    """
    heading = 2 * np.pi * (k % 20) / 20  # twenty positions and headings
    stance = (3.0 * np.cos(heading), 0.1 * (k % 20), heading)
    decision = decider.decide(in_world(ball, stance), stance)
    if decision.action == label or label == "border":
        return ""
    is_better = ACTIONS.index(decision.action) < ACTIONS.index(label)
    if decision.action in (REACH, BEND) and is_better:
        assert decision.arm is not None
        pose = decider.abilities.confirmed_pose(decision.action, ball, decision.arm)
        if pose and judge.admissible(pose.q, ball, decision.arm, decision.action):
            return ""
    decided = f"decided {decision.action}, right is {label}"
    return f"ball {k} {ball.tolist()}: {decided} ({decision.reason})"


def require_agreement(decider: Decider, balls: list[tuple[Array, str]]) -> None:
    """At most 1 % of the balls are decided wrongly, and at most 8 % are border cases."""
    judge = judges.Judge(decider.figure)
    border = [k for k, (_, label) in enumerate(balls) if label == "border"]
    texts = [disagreement(decider, judge, ball, label, k) for k, (ball, label) in enumerate(balls)]
    wrong = [text for text in texts if text]
    assert len(wrong) <= 0.01 * (len(balls) - len(border)), f"border {border}\n" + "\n".join(wrong)
    assert len(border) <= 0.08 * len(balls), border


def test_decisions_agree_with_an_independent_judge(figure: Figure, decider: Decider) -> None:
    head, balls = judged_balls()
    assert judges.digest(figure) in head, "the model changed: judge the balls again (judge.py)"
    assert {label for _, label in balls} >= set(ACTIONS)
    assert len(balls) >= 100
    require_agreement(decider, balls)


def test_a_decision_takes_few_steps_at_the_edge_of_reach_too(
    decider: Decider, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Solver steps are counted. A search from random starts took 1300."""
    steps: list[int] = []
    solve = PreparedRows.solve

    def counted(self: PreparedRows, solved: Frames, first: int, end: int, *rest: Any) -> None:
        solve(self, solved, first, end, *rest)
        steps[-1] += int(solved.steps[first:end].sum())

    monkeypatch.setattr(PreparedRows, "solve", counted)
    for ball, _ in judged_balls()[1]:
        steps.append(0)
        decider.decide(ball)
    assert np.mean(steps) <= 40
    assert max(steps) <= 500


def test_the_judge_repeats_its_recorded_labels(figure: Figure) -> None:
    """Four labels are judged again, of balls that end the search early."""
    judge = judges.Judge(figure)
    _, balls = judged_balls()
    quick = [k for k, (_, label) in enumerate(balls) if label in (REACH, BEND)][:4]
    for k in quick:
        assert judge.label(balls[k][0], judges.STARTS, 2 + k) == balls[k][1]


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_decisions_agree_with_the_judge_on_a_thousand_balls(
    figure: Figure, decider: Decider
) -> None:
    judge = judges.Judge(figure)
    balls = [
        (ball, judge.label(ball, judges.STARTS, k)) for k, ball in judges.drawn_balls(1000, 77)
    ]
    require_agreement(decider, balls)


def test_an_admissible_pose_is_kept(figure: Figure) -> None:
    """The natural pose touches the body a little. A colliding start gives a smaller error."""
    ball = np.array([0.0648, -0.2155, 1.2582])
    starts = figure.posture({"left_shoulder_roll": -0.5})[None]
    nearer = best_pose(figure, ball, "right", REACH, starts)
    assert nearer is not None
    assert nearer.violation
    assert not find_pose(figure, ball, "right", REACH, starts).violation


def test_a_figure_needs_feet_but_not_hands(figure: Figure, abilities: Abilities) -> None:
    with pytest.raises(ModelError, match="left and right foot"):
        load_figure("puma560")
    robot = load_robot("humanoid")
    parts = robot.file.figure
    assert parts is not None
    file = robot.file.model_copy(update={"figure": parts | {"hands": {}}})
    armless = load_figure(replace(robot, file=file))
    decider = Decider(replace(abilities, figure=armless, maps={}))
    decision = decider.decide((0.4, -0.2, 1.2))
    assert decision.action == "nothing"
    assert "no hands" in decision.reason
