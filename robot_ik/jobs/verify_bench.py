"""Joint zero offsets hidden in simulated servos, and found again: a row of ``robot-ik bench camera``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.camera_rows import Effort, Figure
from robot_ik.camera.arm_zeros.fit import ArmView, fit_zero_offsets
from robot_ik.camera.boards.view import BoardView
from robot_ik.camera.handeye.model import moved
from robot_ik.jobs.stage import stage_for
from robot_ik.jobs.verify import VerifyReport, run_verify
from robot_ik.jobs.verify_map import summary
from robot_ik.jobs.verify_request import VerifyRequest
from robot_ik.robot import load_robot

Array = NDArray[np.float64]

_ROBOT, _VIEWS = "tabletop_puma", 30
# Hidden: up to so many degrees in each joint.
_LARGEST_DEG = 3.0
# Errors that simulated servos and pictures do not have: px of each corner, rad of each joint.
_PIXEL, _JOINT = 0.15, float(np.deg2rad(0.05))
# How well the board sits in the hand where its drawing says, each axis: m, rad.
_MOUNTED = (1e-4, float(np.deg2rad(0.03)))
# How often the same pictures are spoilt anew.
_SPOILT = 4


def joint_zero_offsets(effort: Effort) -> Iterator[Figure]:
    """The whole job on the simulated arm, then the same views with the noise of metal added."""
    worst, largest, ratio, spoilt = [], [], [], []
    robot = load_robot(_ROBOT, joints=[f"joint{k}" for k in range(1, 7)])
    stage = stage_for(robot, robot.tool)
    for trial in range(1 if effort.quick else 2):
        seed = 1000 * effort.seed + trial
        rng = np.random.default_rng(seed)
        hidden = rng.uniform(-_LARGEST_DEG, _LARGEST_DEG, robot.nv)
        offsets = dict(zip(robot.joints, hidden.tolist(), strict=True))
        # What is known of the board is the drawing of its mount, off by what the mount is made to.
        board = moved(stage.cube_offset, rng.normal(0.0, 1.0, 6) * np.repeat(_MOUNTED, 3))
        request = VerifyRequest(
            _ROBOT, views=_VIEWS, fit=True, seed=seed, zero_offset_deg=offsets, frame=stage.cube_frame,
            pose_frame_board=board, board_sigma=_MOUNTED,
        )  # fmt: skip
        report = run_verify(request)
        assert report.fit is not None and report.true_offsets is not None
        worst.append(float(np.abs(report.fit.offsets - report.true_offsets).max()))
        largest.append(summary(report.judged(corrected=True)).largest)
        for _ in range(_SPOILT):
            off, sigma = _spoilt(report, rng)
            spoilt.append(off)
            ratio.append(off / sigma)
    yield Figure("zero offsets, worst joint off by", float(np.degrees(max(worst))), "°", 0.1)
    yield Figure("board after that, worst pose off by", 1e3 * max(largest), "mm")
    yield Figure("the same with noise, worst joint off by", float(np.degrees(np.abs(spoilt).max())), "°", 0.1)
    size = float(np.sqrt(np.mean(np.square(ratio))))
    yield Figure("stated uncertainty off by a factor of", max(size, 1.0 / size), "", 2.0)


def _spoilt(report: VerifyReport, rng: np.random.Generator) -> tuple[Array, Array]:
    """Errors and standard deviations (nv,) with noise in corners and joints."""
    views = _noisy(report.samples.q, report.samples.views, rng)
    fit = fit_zero_offsets(
        views, report.robot, report.frame, report.samples.intrinsics,
        camera=report.camera, board=report.board,
    )  # fmt: skip
    assert report.true_offsets is not None and fit.found == report.robot.joints
    return fit.offsets - report.true_offsets, fit.sigma


def _noisy(q: Sequence[Array], views: Sequence[BoardView], rng: np.random.Generator) -> list[ArmView]:
    found = []
    for one, view in zip(q, views, strict=True):
        pixels = view.pixels + rng.normal(0, _PIXEL, view.pixels.shape)
        said = one + rng.normal(0, _JOINT, one.shape)
        found.append(ArmView(said, BoardView(view.points, pixels, view.pose_camera_board, _PIXEL)))
    return found
