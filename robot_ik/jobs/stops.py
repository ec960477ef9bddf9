"""Drives an arm from stop to stop; at each it stands still, its joints are read and a picture is taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.sources import Frame
from robot_ik.execution import execute
from robot_ik.jobs.limbs import Limbs
from robot_ik.motion.trajectory import joint_move

Array = NDArray[np.float64]

# Servos may take this long to arrive after the last command, and then to come to rest.
_SETTLE_SECONDS, _LOOK_SECONDS, _LOOKS = 0.3, 0.1, 20
# Two readings that differ by no more than this many ticks are of an arm at rest.
_STILL_TICKS = 1.01


@dataclass(frozen=True, eq=False)
class Stop:
    """The arm at one stop.

    Attributes:
        number: From 0.
        asked: (nq,) where it was sent.
        q: (nq,) where its servos say it is: mean of the readings before and after the picture.
        still: Whether it had come to rest.
        frame: The picture.
    """

    number: int
    asked: Array
    q: Array
    still: bool
    frame: Frame


def visit_stops(
    limbs: Limbs,
    stops: Sequence[Array],
    take: Callable[[], Frame],
    *,
    speed: float = 1.0,
    progress: Callable[[int, float], None] = lambda number, share: None,
) -> Iterator[Stop]:
    """Goes to each stop in turn; a generator, so that what was seen before an interruption is kept.

    Args:
        limbs: Connected and energised (``limbs.connected()``, ``limbs.energise()``).
        stops: (nq,) each, inside the limits; see ``plan_views``.
        take: Takes a picture.
        speed: Share of the joints' speed limits.
        progress: Told the number of the stop and the share of the way to it.

    Raises:
        TrajectoryError, HardwareError: As ``joint_move`` and ``execute``; the arm is left as its exit policy
            says.
    """
    for number, asked in enumerate(stops):
        trajectory = joint_move(
            limbs.robot, limbs.q, asked, speed=speed, rate=limbs.rate,
            velocity=limbs.velocity, acceleration=limbs.acceleration,
        )  # fmt: skip
        count = max(1, len(trajectory))

        def show(tick: Any, number: int = number, count: int = count) -> None:
            progress(number, min(1.0, tick.index / count))

        execute(
            trajectory, limbs.sinks, source=limbs.source, clock=limbs.clock, on_tick=show,
            settle=0.0 if limbs.source is None else _SETTLE_SECONDS,
        )  # fmt: skip
        before, still = _come_to_rest(limbs)
        frame = take()
        yield Stop(number, np.array(asked), 0.5 * (before + limbs.q), still, frame)


def _come_to_rest(limbs: Limbs) -> tuple[Array, bool]:
    """Reads until two readings agree: the last one (nq,), and whether they did."""
    last = limbs.q
    if limbs.arm is None:
        limbs.scene.send(last, limbs.clock.now())
        return last, True
    for _ in range(_LOOKS):
        limbs.settle(_LOOK_SECONDS)
        now = limbs.q
        if bool(np.all(np.abs(now - last) <= _STILL_TICKS * limbs.resolution)):
            return now, True
        last = now
    return last, False
