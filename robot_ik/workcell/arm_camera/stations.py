"""Drive an arm through planned stations and find the board in a picture at each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_ik.execution import execute
from robot_ik.motion.trajectory import joint_move
from robot_ik.ports import Array
from robot_ik.workcell.arm_camera.camera_and_board import CameraAndBoard, HandEyeRequest
from robot_ik.workcell.arm_camera.samples import SampleSet
from robot_ik.workcell.arm_camera.view_planning import plan_views
from robot_ik.workcell.progress import Progress
from robot_ik.workcell.robot_setup import RobotSetup

# Servos may need this time to arrive after the last command, s.
_SETTLE_SECONDS = 0.3
# Time between two readings that are compared, s, and the largest number of them. The arm comes to
# rest within two seconds or not at all.
_REST_CHECK_SECONDS = 0.1
_REST_CHECKS = 20
# The arm rests if two readings differ by no more than this, ticks. A resting servo may alternate
# between two ticks.
_STILL_TICKS = 1.01


@dataclass(eq=False, kw_only=True)
class ArmCameraReport:
    """Measurements of an arm and a camera.

    Attributes:
        samples: Joint angles and observations of the stations at which the board was found.
        stations: Planned joint angles (nq,), in order.
        unseen: Indices of the stations at which the board was not found or the arm did not come to
            rest.
    """

    samples: SampleSet
    stations: tuple[Array, ...] = ()
    unseen: tuple[int, ...] = ()


def visit_stations(
    report: ArmCameraReport,
    request: HandEyeRequest,
    setup: RobotSetup,
    scene: CameraAndBoard,
    keep: Callable[[SampleSet], None],
    progress: Progress,
) -> None:
    """Plan stations, drive the arm to each, and look for the board. Updates ``report``.

    Args:
        report: Receives stations and samples.
        request: For a dry run the stations are only planned.
        setup: The arm.
        scene: Camera and board.
        keep: Called with all samples after each station.
        progress: Called with the phase and its finished share.

    Raises:
        HardwareError: The arm failed.
        TrajectoryError: There is no motion to a station.
        CameraError: The camera failed.
    """
    progress("planning", 0.0)
    planned = plan_views(
        setup.robot,
        scene.task,
        request.views,
        start=setup.q,
        seed=request.seed,
        collisions=setup.collisions,
    )
    report.stations = tuple(planned)
    if request.dry_run:
        return

    setup.enable_torque()
    count = len(planned)
    for number, station in enumerate(planned):
        move = joint_move(setup.robot, setup.q, station, **setup.caps(request.speed))
        trajectory = setup.checked(move)

        def show(tick: Any, number: int = number, ticks: int = max(1, len(trajectory))) -> None:
            share = (number + min(1.0, tick.index / ticks)) / count
            progress(f"view {number + 1} of {count}", share)

        execute(
            trajectory,
            setup.sinks,
            source=setup.opened,
            clock=setup.clock,
            on_tick=show,
            settle=0.0 if setup.arm is None else _SETTLE_SECONDS,
        )
        q_before, is_at_rest = _wait_for_rest(setup)
        frame = scene.take()
        # Mean of the angles read before and after the picture.
        q = 0.5 * (q_before + setup.q)
        view = scene.board.find(frame, scene.task.intrinsics) if is_at_rest else None
        if view is None:
            report.unseen += (number,)
            continue
        report.samples.add(q, view)
        keep(report.samples)


def _wait_for_rest(setup: RobotSetup) -> tuple[Array, bool]:
    """Read the arm until two readings agree.

    Returns:
        The last reading (nq,), and whether the last two agree.
    """
    last = setup.q
    if setup.arm is None:
        setup.shown = last.copy()
        return last, True
    for _ in range(_REST_CHECKS):
        setup.repeat(_REST_CHECK_SECONDS)
        now = setup.q
        if bool(np.all(np.abs(now - last) <= _STILL_TICKS * setup.resolution)):
            return now, True
        last = now
    return last, False
