"""What shall happen when the marker that is followed stays out of sight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from robot_ik.errors import CameraError

if TYPE_CHECKING:
    from robot_ik.goals import Goal

LostPolicy = Literal["hold", "park", "stop"]


@dataclass(frozen=True)
class WhenLost:
    """First the arm holds; after ``seconds`` without a goal comes the policy.

    Attributes:
        then: ``hold`` goes on holding; ``park`` goes to ``goal``; ``stop`` raises ``MarkerNotFoundError``,
            which ends the run, and the arm's exit policy decides.
        seconds: Since the last goal from a picture, or since the first look when there was none.
        goal: Where to park, for example ``PostureGoal(q=robot.home)``.

    Raises:
        CameraError: No such policy, no time, or nowhere to park.
    """

    then: LostPolicy = "hold"
    seconds: float = 2.0
    goal: Goal | None = None

    def __post_init__(self) -> None:
        if self.then not in ("hold", "park", "stop"):
            raise CameraError(
                f"{self.then!r} is nothing to do when a marker is lost", hint="hold, park or stop"
            )
        if not (np.isfinite(self.seconds) and self.seconds >= 0.0):
            raise CameraError(
                f"a marker cannot be lost for {self.seconds} s", hint="give 0 or a finite time in seconds"
            )
        if (self.then == "park") != (self.goal is not None):
            raise CameraError(
                "a goal for a lost marker is for parking, and parking needs one",
                hint='WhenLost("park", goal=PostureGoal(q=robot.home))',
            )
