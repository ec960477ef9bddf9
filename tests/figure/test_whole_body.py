"""Frames of a whole body against MuJoCo: hard rows, momentum, limits, speeds and conflicts."""

import itertools

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik.figure.figure import RATE, Figure
from robot_ik.figure.frames import FrameRows
from robot_ik.figure.poses import STIFFNESS
from robot_ik.motion.timing import minimum_jerk

Array = NDArray[np.float64]


def solved(
    figure: Figure, displacement: Array, frames: int = 40, speeds: str | None = "daily"
) -> Array:
    """Return frames (n, nq) that move a hand by (3,), with feet and centre of mass in place."""
    rows = FrameRows(figure, frames)
    rows.feet(figure.feet_at_home)
    rows.center(figure.center(figure.home), axes="xy")
    start = figure.pose(figure.home, "right_hand")[0]
    share = minimum_jerk(np.linspace(0, 1, frames))[:, None]
    rows.position("right_hand", start + displacement * share)
    stiffness = figure.stiffnesses(STIFFNESS)
    result = rows.solve(figure.home, stiffness, figure.home, speeds=speeds)
    assert result.error.max() < 1e-6 or speeds is not None
    return result.q


def test_hard_rows_hold_by_mujoco(figure: Figure) -> None:
    displacement = np.array([0.25, 0.05, 0.35])
    q = solved(figure, displacement)
    robot = figure.robot
    start = robot.measure(figure.home, "right_hand").position
    end = robot.measure(q[-1], "right_hand").position
    assert end == pytest.approx(start + displacement, abs=1e-6)
    center = figure.center(figure.home)[:2]
    for row in q[::8]:
        for foot in figure.feet.values():
            at_home = robot.measure(figure.home, foot.frame)
            pose = robot.measure(row, foot.frame)
            assert pose.position == pytest.approx(at_home.position, abs=1e-6)
            assert abs(pose.wxyz @ at_home.wxyz) > 1 - 1e-11
        assert robot.center_of_mass(row)[:2] == pytest.approx(center, abs=1e-6)
        assert robot.outside(row) == []


def test_a_momentum_row_keeps_the_angular_momentum(figure: Figure) -> None:
    """A swinging arm turns the body in the air the other way, by MuJoCo's momentum matrix."""
    frames = 20
    rows = FrameRows(figure, frames)
    rows.center(figure.center(figure.home))
    rows.momentum()
    goal = figure.posture({"right_shoulder_pitch": 1.5, "left_shoulder_pitch": -0.5})
    share = minimum_jerk(np.linspace(0, 1, frames))[:, None]
    postures = figure.home + (goal - figure.home) * share
    q = rows.solve(postures, figure.stiffnesses({"*": 1.0}), figure.home, speeds=None).q
    assert abs(q[-1, figure.addresses("right_shoulder_pitch")[0]] - 1.5) < 0.2
    model = figure.model
    data = mujoco.MjData(model)
    matrix = np.zeros((3, model.nv))
    velocity = np.zeros(model.nv)
    largest_of_joints = 0.0
    for a, b in itertools.pairwise(q):
        data.qpos[:] = b
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_angmomMat(model, data, matrix, 0)
        mujoco.mj_differentiatePos(model, velocity, 1 / RATE, a, b)
        assert np.abs(matrix @ velocity).max() < 1e-3
        of_joints = np.abs(matrix[:, 6:] @ velocity[6:]).max()
        largest_of_joints = max(largest_of_joints, float(of_joints))
    assert largest_of_joints > 0.3  # the joints alone would turn the body


def test_no_joint_is_faster_than_its_limit(figure: Figure) -> None:
    q = solved(figure, np.array([0.3, 0.1, 0.5]), frames=6)
    speed = np.abs(np.diff(np.vstack([figure.home, q])[:, 7:], axis=0)) * RATE
    assert (speed <= figure.speeds["daily"][6:] * (1 + 1e-9)).all()
    assert (speed > 0.99 * figure.speeds["daily"][6:]).any()


def test_conflicting_rows_are_relaxed(figure: Figure) -> None:
    """The target of the hand is five metres away: the body moves at most half the way, and the
    result reports the error."""
    rows = FrameRows(figure, 10)
    rows.feet(figure.feet_at_home)
    rows.position("right_hand", np.array([5.0, 0.0, 1.0]))
    result = rows.solve(figure.home, figure.stiffnesses(STIFFNESS), figure.home)
    assert np.isfinite(result.q).all()
    assert result.error.min() > 1.0
    assert all(figure.robot.outside(row) == [] for row in result.q)
    assert np.abs(result.q[-1, :3] - figure.home[:3]).max() < 2.5


def test_the_same_frames_are_the_same_bits(figure: Figure) -> None:
    displacement = np.array([0.2, 0.0, 0.3])
    assert solved(figure, displacement).tobytes() == solved(figure, displacement).tobytes()
