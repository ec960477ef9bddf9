"""Faults of a script: they begin when the script says so, counted from there, and can be taken back."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

from robot_ik.errors import ConfigError
from robot_ik.hardware.control_table import CONTROL_TABLES, HARDWARE_ERRORS, model_by_number
from robot_ik.hardware.virtual.fault_file import parse_faults
from robot_ik.hardware.virtual.fault_kinds import KINDS, Fault

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.servo import VirtualServo


def fault_for(
    config: ArmConfig,
    kind: str,
    *,
    joint: str | None = None,
    id: int | None = None,
    value: float | None = None,
    file: Path | str = "<text>",
    key: str = "fault",
) -> Fault:
    """The fault of these parameters, as a file of faults would say it.

    Raises:
        ConfigError: No such kind, joint or value; ``file`` and ``key`` say where it stands.
    """
    given = {"kind": kind, "joint": joint, "id": id, "value": value}
    rows = [f"{name} = {json.dumps(entry)}" for name, entry in given.items() if entry is not None]
    try:
        (fault,) = parse_faults("schema = 1\n[[faults]]\n" + "\n".join(rows), config, file).faults
    except ConfigError as error:
        problem = str(error.args[0]).removeprefix(f"{file}: {error.key}: ")
        problem = problem.removesuffix(f"; allowed: {error.allowed}")
        there = error.key.replace("faults[0]", key)
        raise ConfigError(problem, file=file, key=there, allowed=error.allowed, hint=error.hint) from None
    if kind == "model" and model_by_number(int(fault.value)) is None:
        known = ", ".join(str(table.number) for table in CONTROL_TABLES.values())
        raise ConfigError(
            f"no model has the number {fault.value:g}", file=file, key=f"{key}.value", allowed=known
        )
    return fault


@dataclass
class _Booking:
    """One fault on its way: what ``VirtualBus.inject`` takes for a ``Fault``."""

    fault: Fault
    delay: float
    lasts: float | None
    undos: list[Callable[[], None]] = field(default_factory=list)
    over: bool = False

    def book(self, bus: VirtualBus) -> None:
        """Puts it into the schedule; without delay it happens at once."""
        if self.fault.id is not None:
            bus.servo(self.fault.id)
        if self.fault.at_packet is not None:
            bus.schedule.at_packet(bus.schedule.packets + self.fault.at_packet, lambda: self._begin(bus))
        elif self.delay > 0.0:
            bus.schedule.at(bus.clock.now() + self.delay, lambda: self._begin(bus))
        else:
            self._begin(bus)

    def end(self) -> None:
        """Takes it back, or off the schedule."""
        if not self.over:
            self.over = True
            for undo in reversed(self.undos):
                undo()

    def _begin(self, bus: VirtualBus) -> None:
        if self.over:
            return
        kind, id = KINDS[self.fault.kind], self.fault.id
        if kind.on_servo is not None:
            for servo in bus.servos if id is None else (bus.servo(id),):
                undo = kind.on_servo(servo, self.fault.value)
                self.undos.append(undo or _restart(servo, self.fault.kind))
        if kind.on_bus is not None and (undo := kind.on_bus(bus, self.fault.value)) is not None:
            self.undos.append(undo)
        if self.lasts is not None:
            bus.schedule.at(bus.clock.now() + self.lasts, self.end)
        elif self.fault.lasts_packets is not None:
            bus.schedule.at_packet(bus.schedule.upcoming + self.fault.lasts_packets, self.end)


def _restart(servo: VirtualServo, kind: str) -> Callable[[], None]:
    """A servo that shut down is well again after a restart; what else has no way back stays."""
    return servo.reboot if kind in HARDWARE_ERRORS.values() else lambda: None


@dataclass
class _Healing:
    """Ends bookings where ``VirtualBus.inject`` holds the lock and wakes whoever sleeps."""

    bookings: list[_Booking]

    def book(self, bus: VirtualBus) -> None:
        for booking in reversed(self.bookings):
            booking.end()


class Mischief:
    """Faults injected into one virtual bus, and the way back."""

    def __init__(self, bus: VirtualBus) -> None:
        self._bus = bus
        self._booked: list[_Booking] = []

    def inject(self, fault: Fault, delay: float = 0.0, lasts: float | None = None) -> None:
        """Lets ``fault`` happen in ``delay`` s, for ``lasts`` s or for good.

        Packets, where the fault counts those instead, are counted from here, too.
        """
        booking = _Booking(fault, delay, lasts)
        self._booked.append(booking)
        self._bus.inject(cast(Fault, booking))

    def clear(self, kind: str | None = None) -> int:
        """Takes back what was injected, the last first; of one kind, or all.  How many there were."""
        chosen = [b for b in self._booked if kind in (None, b.fault.kind)]
        self._booked = [b for b in self._booked if b not in chosen]
        running = [b for b in chosen if not b.over]
        self._bus.inject(cast(Fault, _Healing(chosen)))
        return len(running)
