"""The only way to leave an arm: torque off or hold, each servo by itself and verified."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from robot_ik.config import KeyProblem
from robot_ik.hardware.arm_registers import shared_register
from robot_ik.hardware.bus import BROADCAST_ID, ServoBus
from robot_ik.hardware.config import ArmConfig

log = logging.getLogger(__name__)

ON_EXIT = ("torque_off", "hold", "park")
"""Ways to leave an arm; ``park`` ends in torque off."""

PATIENCE = 1.0
"""s after which servos that still do not confirm are given up.

A dead servo must not keep the program from leaving the others.
"""

PAUSE = 0.02
"""s between two attempts.  On a virtual clock a request takes no time, and ``PATIENCE`` would never
end without a pause.
"""

DISARM_ATTEMPTS = 3
"""How often a sync write, which has no reply, is repeated if its values do not read back."""


def checked_policy(name: str, file: Path | str, key: str) -> str:
    """Return ``name`` if it is one of ``ON_EXIT``.

    Args:
        name: Exit policy.
        file: Source of the policy, for the error.
        key: Key in that source.

    Raises:
        ConfigError: No such policy.
    """
    if name not in ON_EXIT:
        raise KeyProblem.unknown("way to leave an arm", name, ON_EXIT, key).in_file(file)
    return name


@dataclass(frozen=True)
class ExitReport:
    """How an arm was left.

    Attributes:
        done: ``torque_off``, ``hold`` or ``untouched`` (torque was never switched on here).
        verified: Joints of which every servo confirmed it.
        unverified: Joints that did not.  ``torque_off``: their torque may still be on; ``hold``:
            they may have no torque, or another goal.
        parked: The arm reached the park pose before.
        limp: Joints of ``unverified`` that were to hold and report that they have no torque.
        unparked: Why parking failed; empty if it succeeded or was not the policy.
    """

    done: str
    verified: tuple[str, ...] = ()
    unverified: tuple[str, ...] = ()
    parked: bool = False
    limp: tuple[str, ...] = ()
    unparked: str = ""

    @property
    def ok(self) -> bool:
        """Whether every servo confirmed it."""
        return not self.unverified

    @property
    def doubt(self) -> str:
        """Joints that did not confirm it, and what that may mean; empty if all did."""
        parts = []
        if self.limp:
            parts.append(f"{', '.join(self.limp)} does NOT hold: no torque")
        silent = [name for name in self.unverified if name not in self.limp]
        if silent:
            danger = "torque may be off"
            if self.done == "torque_off":
                danger = "torque may be ON, cut the power"
            parts.append(f"not confirmed by {', '.join(silent)}: {danger}")
        return "; ".join(parts)

    @property
    def text(self) -> str:
        """The result as one sentence, for messages."""
        result = {
            "torque_off": "torque is off",
            "hold": "it holds with torque ON",
            "untouched": "not touched",
        }[self.done]
        parking = ""
        if self.parked:
            parking = " (parked first)"
        elif self.unparked:
            parking = f" (not parked: {self.unparked})"
        if self.ok:
            return result + parking
        if not self.verified:
            return self.doubt + parking
        return f"{result} at {', '.join(self.verified)}{parking}; {self.doubt}"


def leave(
    bus: ServoBus,
    config: ArmConfig,
    policy: str,
    goals: Mapping[int, int],
    *,
    parked: bool = False,
    servos: Mapping[int, str] | None = None,
    broadcast: bool = False,
) -> ExitReport:
    """Leave an arm: torque off or hold, written to the arm's own servos only, and read back.

    Every servo is written before it is read.  No error of the bus is raised: failures are
    in the report and in the log.  Servos that confirm have no Bus Watchdog armed afterwards, so
    that they take the goals of the next program.

    Args:
        bus: Bus.  If it is not open, the report has every servo as unconfirmed.
        config: Arm file.
        policy: One of ``ON_EXIT``; ``park`` is torque off here.
        goals: Servo id -> goal position, ticks, for ``hold``.  Without them torque goes off.
        parked: For the report.
        servos: Servo id -> name of the servos to leave.  None: every servo of the arm.
        broadcast: First switch torque off at all servos on the wire, by a packet without a reply.
    """
    names = servos or {drive.id: drive.name for drive in config.drives}
    steps = _Exit(bus, config, names)
    done = "hold" if policy == "hold" and set(names) <= set(goals) else "torque_off"
    if done == "hold":
        steps.hold(goals)
    else:
        if broadcast:
            with steps.step("torque off for all servos on the wire"):
                bus.write(BROADCAST_ID, shared_register(config, "torque_enable"), 0)
        steps.torque_off()
    unverified = tuple(dict.fromkeys(steps.remaining.values()))
    verified = tuple(name for name in dict.fromkeys(names.values()) if name not in unverified)
    limp_names = (name for id, name in steps.remaining.items() if id in steps.limp)
    return ExitReport(done, verified, unverified, parked, tuple(dict.fromkeys(limp_names)))


class _Exit:
    """The servos that are left.

    Args:
        bus: Bus.
        config: Arm file.
        servos: Servo id -> name.

    Attributes:
        remaining: Servo id -> name of servos that have not confirmed.
        limp: Ids of servos that report that they have no torque.
    """

    def __init__(self, bus: ServoBus, config: ArmConfig, servos: Mapping[int, str]) -> None:
        self.remaining = dict(servos)
        self.limp: set[int] = set()
        self._bus = bus
        self._config = config
        self._end = bus.clock.now() + PATIENCE
        self._reported: set[str] = set()

    def torque_off(self) -> None:
        """Switch torque off at all servos at once, then at each, until Torque Enable reads 0."""
        bus = self._bus
        remaining = self.remaining
        torque = shared_register(self._config, "torque_enable")
        # A packet without a reply works even if no reply arrives.  Twice: a signal may have cut off
        # a packet, and its rest can spoil the first one.
        for _ in range(2 if bus.is_open else 0):
            with self.step("torque off for all"):
                bus.sync_write(torque, dict.fromkeys(remaining, 0))
        while remaining and bus.is_open:
            with self.step("reading torque"):
                statuses = bus.sync_read(list(remaining), torque)
                self._confirm([id for id, status in statuses.items() if status.data == 0])
            for id, name in remaining.items():
                if bus.clock.now() > self._end:
                    return
                with self.step(f"torque off for {name}"):
                    bus.write(id, torque, 0)
            if remaining:
                bus.clock.sleep_until(bus.clock.now() + PAUSE)

    def hold(self, goals: Mapping[int, int]) -> None:
        """Keep the goals, and disarm the Bus Watchdog: another program may take over.

        Args:
            goals: Servo id -> ticks.
        """
        bus = self._bus
        remaining = self.remaining
        torque = shared_register(self._config, "torque_enable")
        goal = shared_register(self._config, "goal_position")
        capabilities = self._config.family.capabilities
        while remaining and bus.is_open and bus.clock.now() < self._end:
            with self.step("hold"):
                if capabilities.bus_watchdog:
                    watchdog = shared_register(self._config, "bus_watchdog")
                    bus.sync_write(watchdog, dict.fromkeys(remaining, 0))
                if capabilities.goal_enables_torque:
                    # A goal would give torque to a servo that has none, without its speed limit.
                    powered = bus.sync_read(list(remaining), torque)
                    self.limp = {id for id in remaining if powered[id].data == 0}
                bus.sync_write(goal, {id: goals[id] for id in remaining if id not in self.limp})
                present_goals = bus.sync_read(list(remaining), goal)
                powered = bus.sync_read(list(remaining), torque)
                self.limp = {id for id in remaining if powered[id].data == 0}
                self._confirm(
                    [
                        id
                        for id in remaining
                        if present_goals[id].data == goals[id] and powered[id].data == 1
                    ]
                )
            if remaining and self.limp.issuperset(remaining):
                break  # no goal gives these servos torque
            if remaining:
                bus.clock.sleep_until(bus.clock.now() + PAUSE)

    def _confirm(self, ids: Sequence[int]) -> None:
        """Disarm the Bus Watchdogs of servos that confirmed, and take them off the list."""
        self._disarm(ids)
        for id in ids:
            del self.remaining[id]

    def _disarm(self, ids: Sequence[int]) -> None:
        """Clear Bus Watchdogs.  A servo whose watchdog has tripped refuses goals until then."""
        if not self._config.watchdog_ms:
            return
        armed = list(ids)
        for _ in range(DISARM_ATTEMPTS):
            if not armed:
                return
            with self.step("bus watchdog"):
                watchdog = shared_register(self._config, "bus_watchdog")
                self._bus.sync_write(watchdog, dict.fromkeys(armed, 0))
                statuses = self._bus.sync_read(armed, watchdog)
                armed = [id for id, status in statuses.items() if status.data != 0]

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Log an error of one step, so that it does not prevent the next; once for each step.

        Args:
            what: Name of the step.
        """
        try:
            yield
        except Exception as error:
            reason = error.args[0] if error.args else error  # the hint is the same for every servo
            level = logging.DEBUG if what in self._reported else logging.WARNING
            log.log(level, "%s: %s", what, reason)
            self._reported.add(what)
