"""`line_move` on the PUMA; straightness and speed are measured by MuJoCo's own forward pass."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pytest

from robot_ik.errors import InvalidGoalError, TrajectoryError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp, rotation_log
from robot_ik.motion import line_move
from robot_ik.solvers import make_solver
from robot_ik.solvers.base import Solver

SLACK = 1.0 + 1e-9


def tool_poses(robot, trajectory, times, site):
    """Positions (n, 3) and quaternions (n, 4) of a site, by mj_kinematics."""
    data = mujoco.MjData(robot.model)
    index = mujoco.mj_name2id(robot.model, mujoco.mjtObj.mjOBJ_SITE, site)
    positions = []
    quats = []
    for t in times:
        data.qpos[:] = robot.qpos(trajectory.at(t))
        mujoco.mj_kinematics(robot.model, data)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, data.site_xmat[index])
        positions.append(data.site_xpos[index].copy())
        quats.append(quat)
    return np.array(positions), np.array(quats)


def goal_beside(robot, q, shift, rotation=(0.0, 0.0, 0.0), frame=None):
    begin = robot.forward(q, frame)
    return begin, Pose(begin.position + shift, quat_multiply(begin.wxyz, rotation_exp(rotation)))


def check_straight(robot, trajectory, begin, end, site, allowed=1e-4):
    """Every point, between samples too, is on the line and rotated in proportion."""
    times = np.linspace(0.0, trajectory.duration, 4 * len(trajectory) + 1)
    positions, quats = tool_poses(robot, trajectory, times, site)
    way = end.position - begin.position
    along = np.clip((positions - begin.position) @ way / (way @ way), 0.0, 1.0)
    assert (
        np.linalg.norm(positions - begin.position - along[:, None] * way, axis=1).max() <= allowed
    )
    exact, _ = tool_poses(robot, trajectory, trajectory.times, site)
    share = np.clip((exact - begin.position) @ way / (way @ way), 0.0, 1.0)
    assert (
        np.linalg.norm(exact - begin.position - share[:, None] * way, axis=1).max() <= 1e-6
    )  # samples
    full = rotation_log(quat_multiply(begin.inverse().wxyz, end.wxyz))
    for share, quat in zip(along, quats, strict=True):
        wanted = Pose((0, 0, 0), quat_multiply(begin.wxyz, rotation_exp(share * full)))
        assert wanted.distance(Pose((0, 0, 0), quat))[1] < 2e-3
    assert (np.diff(along) > -1e-9).all()
    np.testing.assert_allclose(positions[-1], end.position, atol=1e-6)
    return positions, times


@pytest.mark.parametrize(
    ("shift", "rotation"),
    [
        ((0.1, -0.15, 0.1), (0.0, 0.0, 0.0)),
        ((-0.05, 0.2, -0.1), (0.2, -0.3, 0.5)),
        ((0.0, 0.0, -0.002), (0.0, 0.0, 0.0)),
    ],
)
def test_the_tool_runs_straight_within_every_limit(puma, shift, rotation):
    begin, end = goal_beside(puma, puma.home, shift, rotation)
    path = line_move(puma, puma.home, end)
    check_straight(puma, path, begin, end, "gripper")
    assert (path.q[0] == puma.home).all()
    assert (path.peak_velocity <= puma.velocity_limits * SLACK).all()
    assert (path.peak_acceleration <= puma.acceleration_limits * SLACK).all()
    assert (path.q >= puma.lower - 1e-9).all() and (path.q <= puma.upper + 1e-9).all()
    np.testing.assert_allclose(np.diff(path.times), 0.01, rtol=1e-9)


def test_the_tool_speed_reaches_its_bound_and_keeps_it(puma):
    begin, end = goal_beside(puma, puma.home, (0.0, -0.2, 0.0))
    path = line_move(puma, puma.home, end, linear_speed=0.1)
    positions, times = check_straight(puma, path, begin, end, "gripper")
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(times)
    assert 0.09 < speed.max() <= 0.1005
    assert path.duration >= 2.0


def test_turning_on_the_spot_keeps_the_angular_bound(puma):
    begin, end = goal_beside(puma, puma.home, (0.0, 0.0, 0.0), (0.0, 0.0, 0.6))
    path = line_move(puma, puma.home, end, angular_speed=0.3)
    positions, _ = tool_poses(puma, path, np.linspace(0, path.duration, 300), "gripper")
    assert np.linalg.norm(positions - begin.position, axis=1).max() <= 1e-4
    assert 2.0 <= path.duration < 3.0


def test_a_part_of_the_speed_takes_longer(puma):
    _, end = goal_beside(puma, puma.home, (0.0, -0.15, 0.05))
    fast = line_move(puma, puma.home, end, linear_speed=9.0)
    slow = line_move(puma, puma.home, end, linear_speed=9.0, speed=0.25)
    assert slow.duration > 1.9 * fast.duration
    assert (slow.peak_velocity <= 0.25 * puma.velocity_limits * SLACK).all()
    assert (slow.peak_acceleration <= 0.25 * puma.acceleration_limits * SLACK).all()


def test_coarse_sampling_slows_down_to_keep_the_line(puma):
    begin, end = goal_beside(puma, puma.home, (0.1, -0.2, 0.0))
    path = line_move(puma, puma.home, end, linear_speed=1.0, rate=10.0)
    check_straight(puma, path, begin, end, "gripper")


@pytest.mark.parametrize("solver", ["auto", "dls"])
def test_line_move_works_with_any_method_that_converges(puma, solver):
    begin, end = goal_beside(puma, puma.home, (0.05, -0.1, 0.05))
    check_straight(puma, line_move(puma, puma.home, end, solver=solver), begin, end, "gripper")


def test_other_frames_run_straight_too(puma):
    begin, end = goal_beside(puma, puma.home, (0.05, -0.1, 0.1), frame="flange")
    path = line_move(puma, puma.home, end, frame="flange")
    check_straight(puma, path, begin, end, "flange")


def test_a_line_of_no_length_has_one_sample(puma):
    path = line_move(puma, puma.home, puma.forward(puma.home))
    assert len(path) == 1 and (path.q[0] == puma.home).all()


def test_an_unreachable_end_reports_the_possible_part_of_the_line(puma):
    begin, end = goal_beside(puma, puma.home, (2.0, 0.0, 0.0))
    with pytest.raises(TrajectoryError, match=r"can follow only (\d+\.\d) % of the line") as caught:
        line_move(puma, puma.home, end)
    reached = float(str(caught.value).split("only ")[1].split(" %")[0]) / 100.0
    assert 0.0 < reached < 0.9
    inside = Pose(begin.position + (reached - 0.01) * (end.position - begin.position), begin.wxyz)
    line_move(puma, puma.home, inside)


def test_a_joint_limit_in_the_way_is_named(puma):
    """The waist is held, so a line sideways ends early or jumps. The error names the joint."""
    lower = puma.lower.copy()
    upper = puma.upper.copy()
    upper[0] = puma.home[0] + 0.1
    lower[0] = puma.home[0] - 0.1
    narrow = puma.with_limits(lower, upper)
    _, end = goal_beside(puma, puma.home, (0.0, 0.25, 0.0))
    with pytest.raises(TrajectoryError, match="joint 'joint"):
        line_move(narrow, puma.home, end)
    assert line_move(puma, puma.home, end).duration > 0.0


@dataclass(frozen=True)
class OtherBranch(Solver):
    """A solver that changes to the other branch of the wrist half-way: same pose, other angles."""

    def __post_init__(self):
        """No options to check."""

    def prepare(self, problem):
        return _OtherBranch(make_solver("lm").prepare(problem))


class _OtherBranch:
    name = "other branch"

    def __init__(self, lm):
        self.lm = lm
        self.calls = 0

    def run(self, problem, budget):
        self.calls += 1
        solution = self.lm.run(problem, budget)
        q = np.array(solution.q)
        if self.calls > 15:
            q[3] += np.pi if q[3] < 0 else -np.pi
            q[4] = -q[4]
        return replace(solution, q=q)


def test_a_jump_is_never_planned_and_names_the_joint(puma):
    _, end = goal_beside(puma, puma.home, (0.1, -0.15, 0.1))
    with pytest.raises(TrajectoryError, match=r"joint 'joint4' would jump by 3\.1"):
        line_move(puma, puma.home, end, solver=OtherBranch())


def test_random_lines_are_straight_or_refused(puma):
    """Short lines from random starts. Every planned line keeps every bound."""
    rng = np.random.default_rng(5)
    planned = 0
    for _ in range(12):
        q = puma.sample(rng)
        begin, end = goal_beside(puma, q, rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.2, 0.2, 3))
        try:
            path = line_move(puma, q, end)
        except TrajectoryError:
            continue
        planned += 1
        check_straight(puma, path, begin, end, "gripper")
        assert (path.peak_velocity <= puma.velocity_limits * SLACK).all()
        assert (path.peak_acceleration <= puma.acceleration_limits * SLACK).all()
        assert np.abs(np.diff(path.q, axis=0)).max() <= np.max(puma.velocity_limits) / 100.0 * SLACK
    assert planned >= 6


@pytest.mark.parametrize(
    "options",
    [
        {"linear_speed": 0.0},
        {"angular_speed": np.nan},
        {"rate": -1.0},
        {"deviation": 0.0},
        {"speed": 2.0},
    ],
)
def test_malformed_options_are_refused(puma, options):
    with pytest.raises(TrajectoryError):
        line_move(puma, puma.home, puma.forward(puma.home), **options)


def test_a_goal_that_is_not_a_pose_is_refused(puma):
    with pytest.raises(InvalidGoalError, match=r"a Pose, not \(1, 2, 3\)\nPose\(position, wxyz\)"):
        line_move(puma, puma.home, (1, 2, 3))


def test_malformed_starts_are_refused(puma):
    for start in ([np.nan] * 6, [0.0] * 5):
        with pytest.raises(TrajectoryError):
            line_move(puma, start, puma.forward(puma.home))
