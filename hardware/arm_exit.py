"""The exit of one arm: whether it must be left, and the report of how it was left."""

from __future__ import annotations

import logging
from dataclasses import replace

from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.cycle import Cycle
from robot_ik.hardware.leaving import ExitReport, leave

log = logging.getLogger(__name__)


class ArmExit:
    """Leaves one arm, and keeps the report.

    Args:
        bus: Bus of the arm.
        config: Arm file.

    Attributes:
        energised: Torque may be on because of this arm, whatever its state.
        report: How the arm was left.  None before.
    """

    def __init__(self, bus: ServoBus, config: ArmConfig) -> None:
        self._bus = bus
        self._config = config
        self.energised = False
        self.report: ExitReport | None = None

    def leave(self, policy: str, cycle: Cycle, unparked: str | None = None) -> ExitReport:
        """Leave the arm.  Every way out uses this method.  If holding fails, torque goes off.

        Args:
            policy: One of ``leaving.ON_EXIT``.
            cycle: Control cycle of the arm.
            unparked: Why parking failed; empty: the arm was parked.  None: parking was not tried.
        """
        if not self.energised:
            return self.leave_untouched()
        goals: dict[int, int] = {}
        try:
            if policy == "hold" and cycle.goals:
                goals = cycle.begin_hold()
        except Exception as error:
            log.error("the goals to hold are unknown: %s", error)
        begin = self._bus.clock.now()
        report = leave(self._bus, self._config, policy, goals, parked=unparked == "")
        report = replace(report, unparked=unparked or "")
        self.report = report
        if report.ok:
            duration = self._bus.clock.now() - begin
            log.info("%s confirmed by all servos in %.3f s", report.done, duration)
        else:
            log.error("%s %s", report.done, report.doubt)
        return report

    def leave_untouched(self) -> ExitReport:
        """Return the report of an arm that switched no torque on.  No servo is written.

        An earlier report stays.
        """
        report = ExitReport("untouched")
        if self.report is None:
            self.report = report
        return report
