"""Policy of a source of goals for a lost target."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from robot_ik.errors import CameraError
from robot_ik.goals import Goal

LostPolicy = Literal["hold", "park", "stop"]


@dataclass(frozen=True)
class WhenLost:
    """Policy for a lost target. The arm holds first; the policy follows after ``seconds``.

    Attributes:
        then: ``hold`` keeps holding. ``park`` moves to ``goal``. ``stop`` raises
            ``MarkerNotFoundError``, which ends the run. The arm's exit policy decides what follows.
        seconds: Time since the last goal, or since the first request if there was none.
        goal: Where to park, for example ``PostureGoal(q=robot.home)``.

    Raises:
        CameraError: Unknown policy, impossible time, or a goal that does not suit the policy.
    """

    then: LostPolicy = "hold"
    seconds: float = 2.0
    goal: Goal | None = None

    def __post_init__(self) -> None:
        if self.then not in ("hold", "park", "stop"):
            raise CameraError(
                f"unknown lost-marker policy {self.then!r}", hint="use 'hold', 'park' or 'stop'"
            )
        if not (math.isfinite(self.seconds) and self.seconds >= 0.0):
            raise CameraError(
                f"a lost-marker policy cannot wait for {self.seconds} s",
                hint="give 0 or a finite time in seconds",
            )
        if (self.then == "park") != (self.goal is not None):
            raise CameraError(
                f"the lost-marker policy {self.then!r} "
                f"{'needs a goal' if self.goal is None else 'takes no goal'}",
                hint='parking needs a goal: WhenLost("park", goal=PostureGoal(q=robot.home))',
            )
