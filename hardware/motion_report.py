"""What happened to the commands of an arm."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from robot_ik.hardware.limiter import LimiterReport
from robot_ik.ports import Array


@dataclass
class MotionReport:
    """What happened to the commands since torque came on.

    Attributes:
        sent: Commands sent.
        stale: Times no command came for too long and the arm was held by itself.
        clipped: Joint -> number of ticks in which its command lay outside the limits.
        capped: Joint -> number of ticks in which a cap held it back.
        last: What the limiter did to the last command.
        tracking_error: (n,) rad, shaft against the goal of one cycle before; newest.
        largest_tracking_error: (n,) rad.
    """

    tracking_error: Array
    largest_tracking_error: Array
    sent: int = 0
    stale: int = 0
    clipped: dict[str, int] = field(default_factory=dict)
    capped: dict[str, int] = field(default_factory=dict)
    last: LimiterReport = field(default_factory=LimiterReport)

    @classmethod
    def empty(cls, n: int) -> MotionReport:
        """Before the first command of ``n`` joints."""
        return cls(np.zeros(n), np.zeros(n))

    def count(self, report: LimiterReport) -> None:
        """Adds one command."""
        self.sent += 1
        self.last = report
        for counts, names in ((self.clipped, report.clipped), (self.capped, report.capped)):
            for name in names:
                counts[name] = counts.get(name, 0) + 1

    def track(self, error: Array) -> None:
        """Adds (n,) rad, one cycle's tracking error."""
        self.tracking_error = error
        self.largest_tracking_error = np.fmax(self.largest_tracking_error, error)
