"""`follow` on the PUMA in virtual time: commands, step sizes and ticks."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robot_ik.errors import TrajectoryError
from robot_ik.execution import follow
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.motion import CurveSource, ManualSource, RecorderSink, ScriptSource
from robot_ik.ports import JointReading, VirtualClock


def run(puma, goals, **options):
    recorder = RecorderSink(puma.joints)
    options = {"clock": VirtualClock(), "start": puma.home, "duration": 1.0} | options
    report = follow(puma, goals, sinks=[recorder], solver=options.pop("solver", "lm"), **options)
    return report, recorder.trajectory()


def site_position(robot, q, site="gripper"):
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_kinematics(robot.model, data)
    return data.site(site).xpos.copy()


def beside(puma, shift):
    pose = puma.forward(puma.home)
    return PoseGoal("gripper", position=pose.position + shift, wxyz=pose.wxyz)


def test_no_goal_means_hold_and_the_command_is_repeated(puma):
    report, path = run(puma, ManualSource())
    assert report.ticks == report.held == 100 and report.solved == 0 and report.last is None
    assert (path.q == puma.home).all() and len(path) == 100
    assert not report.largest_step.any()


def test_a_goal_is_reached_within_the_velocity_limits_and_held(puma):
    goal = beside(puma, (0.05, -0.2, 0.1))
    report, path = run(puma, ManualSource(goal), duration=3.0)
    assert (report.largest_step <= puma.velocity_limits / 100.0 * (1 + 1e-9)).all()
    assert (path.peak_velocity <= puma.velocity_limits * (1 + 1e-6)).all()
    assert 0 < report.capped < 300 and report.solved == 300
    np.testing.assert_allclose(site_position(puma, report.q), goal.position, atol=2e-3)
    assert path.q[-1].tolist() == path.q[-2].tolist() == report.q.tolist()


def test_a_slower_follower_takes_smaller_steps(puma):
    goal = ManualSource(beside(puma, (0.05, -0.2, 0.1)))
    report, _ = run(puma, goal, speed=0.5, rate=50.0)
    assert (report.largest_step <= 0.5 * puma.velocity_limits / 50.0 * (1 + 1e-9)).all()
    assert report.ticks == 50 and report.rate == pytest.approx(50.0)


def test_a_capped_step_slows_all_joints_alike(puma):
    """The first command is on the straight line to the first solution."""
    recorded_ticks = []
    run(puma, ManualSource(beside(puma, (0.0, -0.3, 0.1))), on_tick=recorded_ticks.append)
    assert recorded_ticks[0].capped
    way = recorded_ticks[0].solution.q - puma.home
    done = recorded_ticks[0].q - puma.home
    share = done @ way / (way @ way)
    assert 0.0 < share < 1.0
    np.testing.assert_allclose(done, share * way, atol=1e-12)


def test_the_tool_stays_on_a_moving_goal(puma):
    center = puma.forward(puma.home).position + np.array([0.05, 0.0, 0.0])
    circle = CurveSource.circle("gripper", center, 0.05, 4.0, wxyz=puma.forward(puma.home).wxyz)
    recorded_ticks = []
    report, path = run(puma, circle, duration=6.0, on_tick=recorded_ticks.append)
    late = [tick for tick in recorded_ticks if tick.time > 2.0]
    assert not any(tick.capped for tick in late) and all(tick.solution.converged for tick in late)
    for tick in late[::20]:
        np.testing.assert_allclose(site_position(puma, tick.q), tick.goal.position, atol=2e-3)
    assert report.statuses["CONVERGED"] == report.solved >= len(late)
    assert np.abs(np.diff(path.q, axis=0)).max() <= max(puma.velocity_limits) / 100.0 * (1 + 1e-9)


def test_goals_may_change_their_kind_or_end_while_following(puma):
    pose = beside(puma, (0.0, -0.1, 0.0))
    up = np.array([0.0, 0.0, 0.05])
    point = PositionGoal("flange", position=puma.forward(puma.home, "flange").position + up)
    script = ScriptSource([(0.0, pose), (1.0, None), (1.5, point), (3.0, pose)])
    recorded_ticks = []
    report, _ = run(puma, script, duration=4.5, on_tick=recorded_ticks.append)
    assert report.held == 50
    at = {round(tick.time, 2): tick for tick in recorded_ticks}
    np.testing.assert_allclose(site_position(puma, at[0.99].q), pose.position, atol=2e-3)
    np.testing.assert_array_equal(at[1.49].q, at[0.99].q)
    np.testing.assert_allclose(site_position(puma, at[2.99].q, "flange"), point.position, atol=2e-3)
    np.testing.assert_allclose(site_position(puma, report.q), pose.position, atol=2e-3)


def test_several_goals_at_once_are_one_goal(puma):
    """Two points on one hand, as a list; the list is solved together."""
    q = puma.home + 0.05
    goals = [
        PositionGoal("gripper", position=puma.forward(q).position),
        PositionGoal("flange", position=puma.forward(q, "flange").position),
    ]
    report, _ = run(puma, ManualSource(goals), duration=2.0)
    for goal in goals:
        np.testing.assert_allclose(
            site_position(puma, report.q, goal.frame), goal.position, atol=2e-3
        )


def test_an_unreachable_goal_is_approached_without_oscillation(puma):
    report, path = run(puma, ManualSource(beside(puma, (3.0, 0.0, 0.0))), duration=6.0)
    assert report.solved == 0 and not report.last.converged
    assert np.abs(np.diff(path.q[-200:], axis=0)).max() <= 1e-3
    far = np.linalg.norm(site_position(puma, puma.home) - (beside(puma, (3.0, 0, 0)).position))
    near = np.linalg.norm(site_position(puma, report.q) - (beside(puma, (3.0, 0, 0)).position))
    assert near < far


def test_a_goal_behind_a_joint_limit_causes_no_oscillation(puma):
    """The goal is within arm's length, so nothing is proven, but the waist is limited."""
    lower = puma.lower.copy()
    upper = puma.upper.copy()
    lower[:3] = puma.home[:3] - 0.2
    upper[:3] = puma.home[:3] + 0.2
    narrow = puma.with_limits(lower, upper)
    report, path = run(narrow, ManualSource(beside(puma, (0.3, 0.6, 0.0))), duration=6.0)
    assert report.solved == 0
    assert np.abs(np.diff(path.q[-400:], axis=0)).max() <= 1e-3
    assert (path.q >= lower - 1e-9).all() and (path.q <= upper + 1e-9).all()


def test_until_ends_the_loop(puma):
    goal = ManualSource(beside(puma, (0.02, 0.0, 0.0)))
    report, _ = run(
        puma, goal, duration=60.0, until=lambda tick: tick.solution.converged and not tick.capped
    )
    assert report.ticks < 200 and report.last.converged


class Mirror:
    """An arm that is always at its command, with a small offset."""

    def __init__(self, clock, q, away=0.0):
        self.clock = clock
        self.q = np.array(q)
        self.away = away

    def send(self, q, now):
        self.q = np.array(q)

    def read(self):
        return JointReading(self.q + self.away, self.clock.now())


def test_it_starts_at_the_measured_position_without_clipping(puma):
    clock = VirtualClock()
    outside = puma.home.copy()
    outside[0] = puma.upper[0] + 0.05
    arm = Mirror(clock, outside)
    recorded_ticks = []
    goal = ManualSource(beside(puma, (0.0, 0.0, 0.05)))
    follow(
        puma,
        goal,
        sinks=[arm],
        solver="lm",
        clock=clock,
        source=arm,
        duration=0.1,
        on_tick=recorded_ticks.append,
    )
    first = recorded_ticks[0].q - outside
    assert (np.abs(first) <= puma.velocity_limits / 100.0 * (1 + 1e-9)).all() and first[0] < 0.0


def test_tracking_error_is_that_of_the_source(puma):
    clock = VirtualClock()
    arm = Mirror(clock, puma.home, away=0.003)
    goal = ManualSource(beside(puma, (0.0, 0.0, 0.05)))
    report = follow(
        puma, goal, sinks=[arm], solver="lm", clock=clock, source=arm, start=puma.home, duration=0.2
    )
    np.testing.assert_allclose(report.tracking_error, 0.003, atol=1e-12)


def test_a_stall_is_counted_and_not_caught_up(puma):
    clock = VirtualClock()
    recorder = RecorderSink(puma.joints)

    def stall(tick):
        if tick.index in (20, 40):
            clock.sleep_until(clock.now() + 0.1)

    goal = ManualSource(beside(puma, (0.05, -0.2, 0.1)))
    report = follow(
        puma,
        goal,
        sinks=[recorder],
        solver="lm",
        clock=clock,
        start=puma.home,
        duration=1.0,
        on_tick=stall,
    )
    assert report.overruns == 2
    assert (
        report.ticks == 100
        and report.duration == pytest.approx(0.99 + 0.18)
        and np.diff(recorder.trajectory().times).min() == pytest.approx(0.01)
    )
    assert report.rate < 90.0


def test_an_interrupt_propagates_and_ends_the_commands(puma):
    recorder = RecorderSink(puma.joints)

    def interrupt(tick):
        if tick.index == 9:
            raise KeyboardInterrupt

    options = {"clock": VirtualClock(), "start": puma.home, "on_tick": interrupt}
    with pytest.raises(KeyboardInterrupt):
        follow(puma, ManualSource(), sinks=[recorder], solver="lm", **options)
    assert len(recorder) == 10


def test_no_sink_can_change_the_command(puma):
    class Bender:
        def send(self, q, now):
            q[0] = 1e3

    class LateBender(Bender):
        def send(self, q, now):
            if now > 0.5:
                super().send(q, now)

    goal = ManualSource(beside(puma, (0.05, -0.2, 0.1)))
    for source, sink in ((ManualSource(), Bender()), (goal, LateBender())):
        with pytest.raises(ValueError, match="read-only"):
            follow(
                puma,
                source,
                sinks=[sink],
                solver="lm",
                clock=VirtualClock(),
                start=puma.home,
                duration=1.0,
            )


def test_it_stays_on_the_branch_of_the_start(puma):
    """With a flipped wrist, a solve from another start than the last command would flip it back."""
    start = puma.home + np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.2])
    start[3:] = start[3] - np.pi, -start[4], start[5] - np.pi
    goal = PoseGoal.at(
        "gripper", puma.forward(puma.home + np.array([0.1, -0.1, 0.1, 0.2, 0.0, 0.2]))
    )
    report, path = run(puma, ManualSource(goal), start=start, duration=2.0)
    assert report.last.converged and (path.q[:, 4] < 0.0).all() and (path.q[:, 3] < -1.5).all()


def test_a_problem_is_built_once_for_goals_of_one_kind(puma, monkeypatch):
    from robot_ik import problem

    built = []
    build = problem.Problem.__init__
    monkeypatch.setattr(
        problem.Problem, "__init__", lambda *a, **k: built.append(1) or build(*a, **k)
    )
    circle = CurveSource.circle("gripper", puma.forward(puma.home).position, 0.02, 1.0)
    run(puma, circle)
    assert len(built) == 1


@pytest.mark.parametrize(
    "options",
    [{"start": None}, {"start": [np.nan] * 6}, {"start": [0.0]}, {"rate": 0.0}, {"speed": 1.5}],
)
def test_malformed_options_are_refused_before_anything_is_sent(puma, options):
    recorder = RecorderSink(puma.joints)
    with pytest.raises(TrajectoryError):
        follow(
            puma,
            ManualSource(),
            sinks=[recorder],
            solver="lm",
            **({"clock": VirtualClock(), "start": puma.home, "duration": 1.0} | options),
        )
    assert len(recorder) == 0
