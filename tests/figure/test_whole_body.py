"""Frames of a whole body against MuJoCo: hard rows, momentum, limits, speeds, rows that contradict each
other."""

import itertools

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik.figure.figure import RATE, Figure
from robot_ik.figure.frames import FrameRows
from robot_ik.figure.poses import STIFF
from robot_ik.motion.timing import minimum_jerk

Array = NDArray[np.float64]


def solved(figure: Figure, hand: Array, frames: int = 40, speeds: str | None = "daily") -> Array:
    """A hand moved by ``hand`` (3,), feet pinned, the centre of mass kept."""
    rows = FrameRows(figure, frames)
    rows.feet(figure.feet_at_home)
    rows.center(figure.center(figure.home), axes="xy")
    start = figure.pose(figure.home, "right_hand")[0]
    share = minimum_jerk(np.linspace(0, 1, frames))[:, None]
    rows.position("right_hand", start + hand * share)
    found = rows.solve(figure.home, figure.stiffnesses(STIFF), figure.home, speeds=speeds)
    assert found.error.max() < 1e-6 or speeds is not None
    return found.q


def test_hard_rows_hold_by_mujoco(figure: Figure) -> None:
    hand = np.array([0.25, 0.05, 0.35])
    q = solved(figure, hand)
    start = figure.robot.measure(figure.home, "right_hand").position
    assert figure.robot.measure(q[-1], "right_hand").position == pytest.approx(start + hand, abs=1e-6)
    for row in q[::8]:
        for foot in figure.feet.values():
            there, here = figure.robot.measure(figure.home, foot.frame), figure.robot.measure(row, foot.frame)
            assert here.position == pytest.approx(there.position, abs=1e-6)
            assert abs(here.wxyz @ there.wxyz) > 1 - 1e-11
        assert figure.robot.center_of_mass(row)[:2] == pytest.approx(figure.center(figure.home)[:2], abs=1e-6)
        assert figure.robot.outside(row) == []


def test_a_momentum_row_keeps_the_angular_momentum(figure: Figure) -> None:
    """An arm that swings in the air turns the rest the other way: by MuJoCo's own momentum matrix."""
    frames = 20
    rows = FrameRows(figure, frames)
    rows.center(figure.center(figure.home))
    rows.momentum()
    goal = figure.posture({"right_shoulder_pitch": 1.5, "left_shoulder_pitch": -0.5})
    postures = figure.home + (goal - figure.home) * minimum_jerk(np.linspace(0, 1, frames))[:, None]
    q = rows.solve(postures, figure.stiffnesses({"*": 1.0}), figure.home, speeds=None).q
    assert abs(q[-1, figure.addresses("right_shoulder_pitch")[0]] - 1.5) < 0.2
    model, data = figure.model, mujoco.MjData(figure.model)
    matrix, way = np.zeros((3, model.nv)), np.zeros(model.nv)
    moved = 0.0
    for a, b in itertools.pairwise(q):
        data.qpos[:] = b
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_angmomMat(model, data, matrix, 0)
        mujoco.mj_differentiatePos(model, way, 1 / RATE, a, b)
        assert np.abs(matrix @ way).max() < 1e-3
        moved = max(moved, float(np.abs(matrix[:, 6:] @ way[6:]).max()))
    assert moved > 0.3  # the arms alone do turn the body


def test_no_joint_is_faster_than_its_limit(figure: Figure) -> None:
    q = solved(figure, np.array([0.3, 0.1, 0.5]), frames=6)
    speed = np.abs(np.diff(np.vstack([figure.home, q])[:, 7:], axis=0)) * RATE
    assert (speed <= figure.speeds["daily"][6:] * (1 + 1e-9)).all()
    assert (speed > 0.99 * figure.speeds["daily"][6:]).any()


def test_rows_that_contradict_each_other_are_missed_not_fled(figure: Figure) -> None:
    """The target of the hand is five metres away: the body moves at most half the way, and the
    result reports the error."""
    rows = FrameRows(figure, 10)
    rows.feet(figure.feet_at_home)
    rows.position("right_hand", np.array([5.0, 0.0, 1.0]))
    found = rows.solve(figure.home, figure.stiffnesses(STIFF), figure.home)
    assert np.isfinite(found.q).all() and found.error.min() > 1.0
    assert all(figure.robot.outside(row) == [] for row in found.q)
    assert np.abs(found.q[-1, :3] - figure.home[:3]).max() < 2.5


def test_the_same_frames_are_the_same_bits(figure: Figure) -> None:
    hand = np.array([0.2, 0.0, 0.3])
    assert solved(figure, hand).tobytes() == solved(figure, hand).tobytes()
