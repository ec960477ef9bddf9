"""The hand-eye job: plans views, drives the arm through them, looks, and solves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.handeye import HandEye, solve_handeye
from robot_ik.camera.handeye.model import Mount
from robot_ik.camera.handeye.places import CameraPlace, today
from robot_ik.camera.handeye.start import LEAST_VIEWS
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import MarkerNotFoundError
from robot_ik.jobs.handeye_samples import SampleSet
from robot_ik.jobs.handeye_scene import HandEyeRequest, HandEyeScene, open_scene
from robot_ik.jobs.limbs import Limbs, prepare_limbs
from robot_ik.jobs.stops import visit_stops
from robot_ik.jobs.views import plan_views

__all__ = ["HandEyeReport", "HandEyeRequest", "handeye_from_samples", "measure_stops", "run_handeye"]

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class HandEyeReport:
    """What came out.

    Attributes:
        stops: (nq,) planned, in order.
        samples: What was measured.
        unseen: Numbers of the stops where the board was not found.
        result: None for a dry run.
        truth: Where camera and board really are; None where nobody knows.
    """

    stops: tuple[Array, ...]
    samples: SampleSet
    unseen: tuple[int, ...]
    result: HandEye | None
    truth: Mount | None

    @property
    def parent(self) -> str:
        """What the camera's pose is seen from."""
        return self.samples.frame if self.samples.mounting == "eye_in_hand" else "world"

    @property
    def true_error(self) -> tuple[float, float] | None:
        """Distance from the truth in metres and rad, where it is known."""
        if self.truth is None or self.result is None:
            return None
        return self.result.pose_parent_camera.distance(self.truth.pose_parent_camera)

    def place(self) -> CameraPlace:
        """For the file."""
        result = self.result
        assert result is not None  # a dry run has no place
        return CameraPlace(
            result.pose_parent_camera, self.parent, result.covariance[:6, :6],
            result.residual_px, result.residual_mm, today(), self.samples.intrinsics.digest,
            method=f"handeye, {result.mounting.replace('_', ' ')}", views=len(self.samples),
        )  # fmt: skip


def run_handeye(
    request: HandEyeRequest,
    *,
    dry_run: bool = False,
    keep: Callable[[SampleSet], None] = lambda samples: None,
    progress: Progress = lambda stage, share: None,
) -> HandEyeReport:
    """Plans, moves, looks, solves.

    Args:
        request: What to do.
        dry_run: Plan only; nothing moves.
        keep: Handed the samples after each stop, so that an interruption loses none.
        progress: Told the stage and the share of it that is done.

    Raises:
        MarkerNotFoundError: The board was seen at fewer than four stops.
        RobotIkError: Wrong input or environment, or views that cannot tell where the camera is.
    """
    with contextlib.ExitStack() as stack:
        limbs = prepare_limbs(request.limbs())
        scene = open_scene(request, limbs, stack)
        task = scene.task
        samples = SampleSet(request.robot, limbs.robot.joints, task.frame, request.mounting, task.intrinsics)
        stack.enter_context(limbs.connected())
        progress("planning", 0.0)
        stops = plan_views(limbs.robot, task, request.views, start=limbs.q, seed=request.seed)
        if dry_run:
            return HandEyeReport(tuple(stops), samples, (), None, scene.truth)
        limbs.energise()
        unseen = measure_stops(
            limbs, scene, stops, samples, speed=request.speed, keep=keep, progress=progress
        )
    if len(samples) < LEAST_VIEWS:
        raise MarkerNotFoundError(
            f"the board was seen at {len(samples)} of {len(stops)} stops; {LEAST_VIEWS} are the least",
            hint="check board, dictionary and light, and say better where camera and board are",
        )
    progress("solving", 0.0)
    return HandEyeReport(tuple(stops), samples, unseen, _solved(samples, limbs), scene.truth)


def handeye_from_samples(samples: SampleSet, intrinsics: CameraIntrinsics | None = None) -> HandEyeReport:
    """Solves again what was measured before.

    Args:
        samples: From a file.
        intrinsics: A newer calibration of the same camera; None: the one the samples were taken with.

    Raises:
        CalibrationError: For another picture size, or views that cannot tell where the camera is.
    """
    if intrinsics is not None:
        intrinsics.require_size(*samples.intrinsics.size)
        samples.intrinsics = intrinsics
    robot = samples.load_robot()
    result = solve_handeye(samples.samples(robot), samples.intrinsics, mounting=samples.mounting)
    return HandEyeReport(tuple(samples.q), samples, (), result, None)


def samples_path(out: Path) -> Path:
    """Where the samples of a result go: beside it."""
    return out.with_name(f"{out.stem}.samples.json")


def measure_stops(
    limbs: Limbs,
    scene: HandEyeScene,
    stops: Sequence[Array],
    samples: SampleSet,
    *,
    speed: float = 1.0,
    keep: Callable[[SampleSet], None] = lambda samples: None,
    progress: Progress = lambda stage, share: None,
) -> tuple[int, ...]:
    """Goes to all stops and looks at the board.

    Args:
        limbs: Connected and energised.
        scene: Camera and board.
        stops: (nq,) each, as ``plan_views`` gives them.
        samples: Joint angles read and corners seen are added to it.
        speed: Share of the joints' speed limits.
        keep: Handed the samples after each stop.
        progress: Told "view 3 of 15" and the share of all that is done.

    Returns:
        Numbers, from 0, of the stops where the board was not found or the arm did not come to rest.

    Raises:
        HardwareError, TrajectoryError, CameraError: As the arm and the camera do.
    """
    unseen = []

    def tell(number: int, share: float) -> None:
        progress(f"view {number + 1} of {len(stops)}", (number + share) / len(stops))

    for stop in visit_stops(limbs, stops, scene.take, speed=speed, progress=tell):
        view = scene.board.see(stop.frame, scene.task.intrinsics) if stop.still else None
        if view is None:
            unseen.append(stop.number)
            continue
        samples.add(stop.q, view)
        keep(samples)
    return tuple(unseen)


def _solved(samples: SampleSet, limbs: Limbs) -> HandEye:
    return solve_handeye(samples.samples(limbs.robot), samples.intrinsics, mounting=samples.mounting)
