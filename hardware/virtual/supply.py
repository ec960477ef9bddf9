"""What feeds the servos of a virtual bus, and faults of that which come, overlap and go."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from robot_ik.hardware.virtual.servo import VirtualServo

BROWN_OUT = 0.4
"""Share of the nominal supply below which a servo loses its mind and starts anew when power is back."""


def feed(servo: VirtualServo, volts: float) -> None:
    """This supply for one servo; so low that it cannot run, it starts anew once power is back."""
    servo.set_supply(volts)
    starved = volts < BROWN_OUT * servo.table.supply
    if starved != servo.off:
        (servo.switch_off if starved else servo.switch_on)()


class SupplyFaults:
    """Voltages that all servos get instead of their own, the one that began last while it lasts."""

    def __init__(self) -> None:
        self._volts: list[list[float]] = []  # a list each, so that two of one voltage are told apart
        self._own: dict[VirtualServo, float] = {}

    def begin(self, servos: Iterable[VirtualServo], volts: float) -> Callable[[], None]:
        """Feeds all ``servos`` with ``volts``; the way back gives each what it had when none was wrong."""
        fault = [volts]
        self._volts.append(fault)
        for servo in servos:
            self._own.setdefault(servo, servo.shaft.volts)
            feed(servo, volts)
        return lambda: self._end(fault)

    def _end(self, fault: list[float]) -> None:
        left = [other for other in self._volts if other is not fault]
        if len(left) == len(self._volts):
            return  # it is over
        was_last, self._volts = self._volts[-1] is fault, left
        if was_last:
            for servo, own in self._own.items():
                feed(servo, left[-1][0] if left else own)
        if not left:
            self._own.clear()
