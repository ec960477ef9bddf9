"""Teleoperation: an operator leads, and an arm follows within its limits.

Engaging never causes a jump. Without a leader no command is sent, and ``on_stale`` of the
follower's arm file determines what the follower does.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robot_ik.errors import ArmStateError, HardwareError, UnsafeCommandError
from robot_ik.hardware import bus_row, open_arm, simulated_servos
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.watchdogs import stale_time
from robot_ik.motion.timing import minimum_jerk
from robot_ik.ports import Clock, RealClock, VirtualClock
from robot_ik.schedule import Schedule, regular
from robot_ik.workcell.arm_guard import ArmGuard
from robot_ik.workcell.guided_motion import approach_profile
from robot_ik.workcell.operator import Angles, Operator

log = logging.getLogger(__name__)

DELAYS = 4096
"""Largest number of samples for the median delay."""


class Blend:
    """Leads the follower from its present values into those of the operator, from rest.

    The difference between them decreases to zero.

    Args:
        follower: Present values of the follower.
        operator: Values of the operator's first command.
        config: Arm file of the follower.
        now: Begin, s.

    Attributes:
        seconds: Duration.
    """

    def __init__(self, follower: Angles, operator: Angles, config: ArmConfig, now: float) -> None:
        self._difference = {name: follower[name] - operator[name] for name in operator}
        distance = np.array([self._difference.get(name, 0.0) for name in config.names])
        self._begin = now
        self.seconds = approach_profile(distance, config).duration

    def __call__(self, operator: Angles, now: float) -> dict[str, float]:
        """Return the command at a time.

        Args:
            operator: Values of the operator.
            now: s.
        """
        passed = now - self._begin
        share = 0.0
        if passed < self.seconds:
            share = 1.0 - float(minimum_jerk(passed / self.seconds))
        return {
            name: value + share * self._difference.get(name, 0.0)
            for name, value in operator.items()
        }


@dataclass
class TeleopReport:
    """Result of ``teleoperate``.

    Attributes:
        ticks: Number of commands.
        engaged: How often leader and follower were engaged.
        lost: How often the leader was lost.
        seconds: Duration.
        delay: Median time from reading the leader to the follower's packet, s.
        blocked: Number of commands that were limited, because parts would have touched.
        end: Reason of the end, as text.  The default stays after a failed arm or Ctrl-C.
    """

    ticks: int = 0
    engaged: int = 0
    lost: int = 0
    seconds: float = 0.0
    delay: float = 0.0
    blocked: int = 0
    end: str = "ended early"


def teleoperate(
    operator: Operator,
    follower: Arm,
    *,
    seconds: float | None = None,
    patience: float = 10.0,
    over: Callable[[], bool] = lambda: False,
    done: Callable[[TeleopReport], None] = lambda _report: None,
    guard: ArmGuard | None = None,
) -> TeleopReport:
    """Lead a follower until ``over`` or for a given time.  The caller closes the arms.

    Args:
        operator: Gives the commands.
        follower: Connected.  It is enabled here.
        seconds: Duration.  None: until ``over``.
        patience: s to wait for a leader that was lost.
        over: Called once a tick; true ends it.
        done: Called with the report at the end, also after an error or Ctrl-C.
        guard: Stops the follower before parts touch.  None: collisions are not checked.

    Raises:
        HardwareError: The follower failed, or the leader was not connected again in time.
    """
    clock = follower.clock
    rate = follower.config.rate_hz
    if follower.state is ArmState.CONNECTED:
        follower.enable()
    report = TeleopReport()
    schedule = Schedule(clock)
    begin = clock.now()
    blend: Blend | None = None
    delays: list[float] = []
    try:
        for now, _ in schedule.ticks(regular(rate)):
            if over() or (seconds is not None and now - begin >= seconds):
                break
            report.ticks += 1
            if blend is None:
                follower.read()
            try:
                if blend is None:
                    present = follower.positions()
                    operator.engage(present)
                    blend = Blend(present, operator.command(now), follower.config, now)
                    if guard is not None:
                        guard.begin(present)
                    report.engaged += 1
                read_time = time.perf_counter()
                command = operator.command(now)
            except (UnsafeCommandError, ArmStateError):
                raise
            except HardwareError:
                report.lost += 1
                blend = None
                _wait_for(operator, follower, patience)
                continue
            if guard is None:
                follower.send(blend(command, now), now)
            else:
                _send_guarded(follower, blend(command, now), guard, operator, report)
            if len(delays) < DELAYS:
                delays.append(time.perf_counter() - read_time)
        report.end = "ended by the operator" if over() else "end of the given time"
    finally:
        report.seconds = clock.now() - begin
        report.delay = float(np.median(delays)) if delays else 0.0
        done(report)
    return report


def _send_guarded(
    follower: Arm, command: Angles, guard: ArmGuard, operator: Operator, report: TeleopReport
) -> None:
    """Send the allowed part of a command; log when a collision begins or ends to limit it."""
    before = guard.contact
    sent = guard.send(follower, command)
    if guard.contact:
        report.blocked += 1
        operator.go_on_from({name: sent[name] for name in command})
    if guard.contact and not before:
        log.warning("the arm holds: %s", guard.contact)
    elif before and not guard.contact:
        log.warning("the commands are free of collisions again")


def _wait_for(operator: Operator, follower: Arm, patience: float) -> None:
    """Send no command until the leader is back.

    The follower's heartbeat holds it, and later carries out ``on_stale``.  On virtual time no
    heartbeat runs, so the arm is held here at the same moment.

    Raises:
        HardwareError: The leader was not connected again in time, or the follower has a fault.
    """
    if isinstance(follower.clock, VirtualClock):
        config = follower.config
        stale = stale_time(config.stale_ms, 1.0 / config.rate_hz)
        follower.clock.sleep_until(follower.clock.now() + stale)
        follower.hold()
    operator.recover(patience)
    if follower.state is ArmState.FAULT and follower.fault is not None:
        raise follower.fault.with_traceback(None)


def open_pair(
    leader: ArmConfig | None,
    follower: ArmConfig,
    leader_bus: str,
    follower_bus: str,
    on_exit: str = "",
) -> tuple[Arm | None, Arm]:
    """Return leader and follower, not connected yet.

    Simulated arms share a clock.  It is virtual if the time of both buses is.

    Args:
        leader: Arm file.  None: a person leads by keys or a gamepad, and time is real.
        follower: Arm file.
        leader_bus: A name in ``BUSES``, or a serial port.
        follower_bus: The same.
        on_exit: Exit policy of the follower.  Empty: as in its arm file.
    """
    buses = (leader_bus, follower_bus)
    virtual_time = leader is not None and all(bus_row(bus).virtual_time for bus in buses)
    clock: Clock = VirtualClock() if virtual_time else RealClock()

    def opened(config: ArmConfig, bus: str, policy: str | None) -> Arm:
        servos = simulated_servos(config, clock) if bus_row(bus).virtual else None
        return open_arm(config, bus, virtual_bus=servos, on_exit=policy)

    leader_arm = None if leader is None else opened(leader, leader_bus, "torque_off")
    return leader_arm, opened(follower, follower_bus, on_exit or None)
