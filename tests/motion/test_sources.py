"""Every source gives its goals at their times."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Pose
from robot_ik.motion import CurveSource, ManualSource, RandomSource, ScriptSource


def test_a_goal_stays_until_another_is_set():
    goal = object()
    source = ManualSource(goal)
    assert source.poll(0.0) is goal and source.poll(1e6) is goal


def test_manual_source_gives_the_newest_and_can_be_cleared():
    source = ManualSource()
    assert source.poll(0.0) is None
    source.set("left")
    source.set("right")
    assert source.poll(0.0) == "right" and source.poll(1.0) == "right"
    source.set(None)
    assert source.poll(2.0) is None


def test_manual_source_takes_goals_from_many_threads():
    source = ManualSource()
    sent = [[(worker, k) for k in range(200)] for worker in range(4)]
    polled = []
    threads = [
        threading.Thread(target=lambda mine=mine: [source.set(g) for g in mine]) for mine in sent
    ]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        polled.append(source.poll(0.0))
    assert source.poll(0.0)[1] == 199
    assert set(polled) <= {None, *(goal for mine in sent for goal in mine)}


def test_script_steps_in_order_counted_from_the_first_poll():
    source = ScriptSource([(2.0, "c"), (0.5, "a"), (1.0, None)])
    poll_times = [100.0, 100.49, 100.5, 100.99, 101.0, 101.9, 102.0, 500.0]
    assert [source.poll(t) for t in poll_times] == [None, None, "a", "a", None, None, "c", "c"]


@pytest.mark.parametrize(
    "steps", [[], [(-1.0, "a")], [(np.nan, "a")], [(np.inf, "a")], [(1.0, "a"), (1.0, "b")]]
)
def test_malformed_scripts_are_refused(steps):
    with pytest.raises(InvalidGoalError):
        ScriptSource(steps)


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (1, -2, 0.5)])
def test_circle_is_round_flat_and_runs_counter_clockwise(normal):
    center = np.array([0.4, 0.1, 0.3])
    axis = np.array(normal) / np.linalg.norm(normal)
    source = CurveSource.circle("tip", center, 0.1, 4.0, normal=normal)
    spokes = np.array([source.poll(50.0 + t).position - center for t in np.linspace(0.0, 4.0, 41)])
    np.testing.assert_allclose(np.linalg.norm(spokes, axis=1), 0.1)
    np.testing.assert_allclose(spokes @ axis, 0.0, atol=1e-12)
    np.testing.assert_allclose(spokes[0], spokes[-1], atol=1e-12)
    rotations = np.cross(spokes[:-1], spokes[1:]) @ axis
    np.testing.assert_allclose(rotations, 0.01 * np.sin(2 * np.pi / 40), atol=1e-12)


def test_lemniscate_crosses_its_center_twice_and_stays_in_its_box():
    source = CurveSource.lemniscate("tip", (0.0, 0.0, 0.5), 0.2, 2.0)
    source.poll(0.0)
    at = lambda t: source.poll(t).position  # noqa: E731
    np.testing.assert_allclose([at(0.0), at(1.0), at(2.0)], [[0, 0, 0.5]] * 3, atol=1e-12)
    points = np.array([at(t) for t in np.linspace(0.0, 2.0, 401)]) - (0, 0, 0.5)
    assert np.abs(points).max() == pytest.approx(0.2)
    assert sorted(np.abs(points).max(axis=0)) == pytest.approx([0.0, 0.1, 0.2], abs=1e-9)


def test_orientation_is_fixed_where_given_and_free_where_not():
    free = CurveSource.circle("tip", (0, 0, 0), 0.1, 1.0).poll(0.0)
    held = CurveSource.circle("tip", (0, 0, 0), 0.1, 1.0, wxyz=(0, 2, 0, 0)).poll(0.0)
    assert type(free).__name__ == "PositionGoal" and type(held).__name__ == "PoseGoal"
    np.testing.assert_allclose(np.abs(held.wxyz), [0, 1, 0, 0], atol=1e-12)
    assert held.frame == "tip"


def test_any_function_of_time_is_a_curve():
    source = CurveSource("tip", lambda t: Pose((t, 0.0, 0.0)))
    assert source.poll(10.0).position[0] == 0.0 and source.poll(12.5).position[0] == 2.5


@pytest.mark.parametrize(
    "change",
    [
        {"radius": 0.0},
        {"period": -1},
        {"normal": (0, 0, 0)},
        {"center": (0, np.nan, 0)},
        {"center": (0, 0)},
    ],
)
def test_malformed_curves_are_refused(change):
    plain = {"center": (0, 0, 0), "radius": 0.1, "period": 1.0}
    for make in (CurveSource.circle, CurveSource.lemniscate):
        with pytest.raises(InvalidGoalError):
            make("tip", **(plain | change))


# With a real robot


def test_random_goals_are_reachable_seeded_and_last_a_period(puma):
    one, same, other = (RandomSource(puma, seed=seed, period=0.5) for seed in (3, 3, 4))
    times = np.arange(0.0, 3.0, 0.1)
    goals = [one.poll(t) for t in times]
    again = [same.poll(t) for t in times]
    assert all((a.position == b.position).all() for a, b in zip(goals, again, strict=True))
    assert (other.poll(0.0).position != goals[0].position).any()
    distinct = {tuple(goal.position) for goal in goals}
    assert len(distinct) == 6
    rng = np.random.default_rng(3)
    for goal in [goals[0], goals[5]]:
        expected = puma.forward(puma.sample(rng), puma.tool)
        np.testing.assert_allclose(goal.position, expected.position, atol=1e-12)


def test_random_goals_do_not_depend_on_the_rate_of_polling(puma):
    often = RandomSource(puma, seed=1, period=1.0)
    seldom = RandomSource(puma, seed=1, period=1.0)
    for t in np.arange(0.0, 5.0, 0.25):
        last = often.poll(t)
    seldom.poll(0.0)
    np.testing.assert_array_equal(seldom.poll(4.75).position, last.position)


def test_random_goals_need_a_frame_and_a_period(puma):
    assert RandomSource(puma, "flange").poll(0.0).frame == "flange"
    assert (
        type(RandomSource(puma, "flange", free_orientation=True).poll(0.0)).__name__
        == "PositionGoal"
    )
    with pytest.raises(InvalidGoalError):
        RandomSource(puma, period=0.0)
