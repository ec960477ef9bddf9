"""``robot-ik servo reset-fault``: restart servos that have shut down."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from robot_ik.commands.arms import load_arm, open_servo_bus
from robot_ik.commands.options import BusOptions, JsonOption
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.hardware.recovery import ServoReset


@dataclass(frozen=True)
class ServoResetFault(BusOptions, JsonOption):
    """Restart servos that have shut down (overload, heat, voltage …), and check them again.

    Remove the cause first. A restarted servo has no torque: support the arm. Nothing is switched
    on.

    Exit code 1: an error remains, or a servo has lost whole revolutions.
    """

    joints: Annotated[tuple[str, ...], Parameter(name="JOINT …")] = ()
    """Joints. Default: all."""

    def run(self, terminal: Terminal = QUIET) -> ServoResetFaultReport:  # noqa: ARG002
        """Restart the servos with an error and read all of them."""
        from robot_ik.hardware.recovery import reset_servos

        config = load_arm(self.arm).only(self.joints)
        with open_servo_bus(self.bus, config) as bus:
            return ServoResetFaultReport(reset_servos(bus, config))


@dataclass(frozen=True, eq=False)
class ServoResetFaultReport(Report):
    """The servos before and after the reset."""

    servos: Sequence[ServoReset]

    @property
    def ok(self) -> bool:
        return all(servo.ok for servo in self.servos)

    def tables(self) -> Iterable[Table]:
        yield table("joint", "id", "was", "is", "what to do", rows=map(_row, self.servos))

    def facts(self) -> dict[str, Any]:
        return {
            "servos": [
                {
                    "joint": servo.joint,
                    "id": servo.id,
                    "before": list(servo.before),
                    "after": None if servo.after is None else list(servo.after),
                    "turned_ticks": servo.turned,
                    "ok": servo.ok,
                }
                for servo in self.servos
            ]
        }


def _row(servo: ServoReset) -> tuple[object, ...]:
    before = ", ".join(servo.before) or ("healthy" if servo.silence is None else "no answer")
    after = "no answer" if servo.after is None else ", ".join(servo.after) or "healthy"
    return servo.joint, servo.id, before, after, _advice(servo)


def _advice(servo: ServoReset) -> str:
    if servo.ok:
        return "torque is off: robot-ik servo torque on" if servo.before else ""
    if servo.after is None:
        return "check power, cable, id and baud rate"
    if servo.after:
        return "remove the cause: load, heat or supply"
    return (
        f"its reading changed by {servo.turned} ticks: it lost whole revolutions; "
        "turn the joint by hand"
    )
