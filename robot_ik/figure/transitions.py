"""Transitions between motions: a smooth start after another motion, an early end of a walk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_ik.figure.actions import Motion
from robot_ik.figure.curves import decay
from robot_ik.figure.figure import DT, Figure
from robot_ik.figure.footprints import Footprint
from robot_ik.figure.frames import FrameRows
from robot_ik.figure.walk import Walk, walk
from robot_ik.ports import Array

BLEND_TIME = 0.4
"""Time in which the difference to the motion before decays, s."""

_NO_DIFFERENCE = 1e-3
"""A smaller difference of positions (rad, m) and speeds (rad/s, m/s) needs no blending."""

_TOES_ON_FLOOR = 0.1
"""Toes whose difference is smaller do not blend, because the floor blocks them, rad."""

_LAST_STEP = 0.75
"""Length of the last step of a walk that ends early, as a share of the planned step."""


def blend_into(figure: Figure, last_but_one: Array, last: Array, motion: Motion) -> Motion:
    """Return a motion that begins smoothly after the two frames before it.

    The difference between the continuation of the old motion and the new motion decays joint by
    joint, with its speed. The feet keep the poses of the new motion.

    Args:
        figure: The figure.
        last_but_one: (nq,) frame before ``last``.
        last: (nq,) last frame of the old motion.
        motion: The new motion.
    """
    robot = figure.robot
    count = min(len(motion), round(BLEND_TIME / DT) + 3)
    old_speed = robot.difference(last_but_one, last) / DT
    continuation = robot.integrate(last, old_speed * DT)
    gap = robot.difference(motion.q[0], continuation)
    new_speed = 0 * old_speed
    if len(motion) > 1:
        new_speed = robot.difference(motion.q[0], motion.q[1]) / DT
    difference = max(np.abs(old_speed - new_speed).max(), np.abs(gap).max())
    if count < 2 or difference < _NO_DIFFERENCE:
        return motion

    t = np.arange(count, dtype=np.float64) * DT
    offset = decay(gap, old_speed - new_speed, BLEND_TIME)(t)
    for foot in figure.feet.values():
        if foot.toes is not None and abs(gap[foot.toes[1]]) < _TOES_ON_FLOOR:
            offset[:, foot.toes[1]] = 0.0
    wanted = np.array(list(map(robot.integrate, motion.q[:count], offset)))

    rows = FrameRows(figure, count)
    rows.feet(
        {side: figure.poses(motion.q[:count], foot.frame) for side, foot in figure.feet.items()}
    )
    center = figure.centers(motion.q[:count])
    last_center = figure.center(last)
    old_velocity = (last_center - figure.center(last_but_one)) / DT
    new_velocity = (center[1] - center[0]) / DT
    center_gap = last_center + old_velocity * DT - center[0]
    shift = decay(center_gap, old_velocity - new_velocity, BLEND_TIME)(t)
    rows.center(center + shift, axes="xy")
    rows.orientation(figure.trunk, figure.poses(wanted, figure.trunk)[1], 1.0)
    stiffness = figure.stiffnesses({"*": 1.0, "*toe*": 1e5})
    frames = rows.solve(wanted, stiffness, last, last_but_one, speeds=motion.speeds)

    q = motion.q.copy()
    error = motion.error.copy()
    q[:count] = frames.q
    error[:count] = frames.error
    return replace(motion, q=q, error=error)


def stop_walk(figure: Figure, current: Walk, frame: int) -> Walk:
    """Return a walk that begins as another and ends after a short and a closing step.

    Until the present step is over the feet move as in the other walk. The figure may therefore
    change from one walk to the other at any frame until then, and only the centre of mass needs
    blending (``blend_into``).

    Args:
        figure: The figure.
        current: The other walk.
        frame: Index of its last frame that is shown.
    """
    now = (frame + 1) * DT
    strikes = current.strikes
    next_strike = next((k for k, strike in enumerate(strikes) if strike > now), len(strikes))

    # The two prints of the start, those that were stepped on, and that of the present step.
    kept = next_strike + 3
    prints = list(current.prints)
    if kept + 2 < len(prints):
        before = prints[kept - 2]
        planned = prints[kept]
        x = before.x + (planned.x - before.x) * _LAST_STEP
        y = before.y + (planned.y - before.y) * _LAST_STEP
        yaw = before.yaw + (planned.yaw - before.yaw) * _LAST_STEP
        width = (1 - 2 * planned.side) * 2 * figure.half_width
        last = Footprint(planned.side, x, y, yaw)
        closing = Footprint(
            prints[kept - 1].side, x + width * np.sin(yaw), y - width * np.cos(yaw), yaw
        )
        prints = [*prints[:kept], last, closing]
    return walk(figure, current.start, prints, current.gait)


def remaining(motion: Motion, frame: int) -> Motion:
    """Return the frames of a motion from ``frame`` on."""
    return replace(
        motion,
        q=motion.q[frame:],
        contact=motion.contact[frame:],
        error=motion.error[frame:],
        zmp=motion.zmp[frame:],
        interruptible=motion.interruptible[frame:],
    )
