"""``robot-ik servo torque``: switch torque on or off."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from robot_ik.commands.arms import ServoReport, driving, load_arm, open_arm_on, open_servo_bus
from robot_ik.commands.options import BusOptions, JsonOption
from robot_ik.commands.servo_scan import checked_bauds
from robot_ik.commands.terminal import QUIET, Terminal
from robot_ik.errors import HardwareError, OptionError, RobotIkError

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.leaving import ExitReport


@dataclass(frozen=True)
class ServoTorque(BusOptions, JsonOption):
    """Switch torque on (every joint holds its pose) or off (support the arm: it may fall).

        robot-ik servo torque on --bus /dev/ttyUSB0
        robot-ik servo torque off

    on checks the servos as every start of the arm does, leaves them holding without a watchdog, and
    requires --bus. off needs no confirmation and works in every state of the arm. Both are read
    back.

    Exit code 1: a servo did not confirm it.
    """

    to: Annotated[Literal["on", "off"], Parameter(name="on|off", required=True)]
    """New state."""
    joints: Annotated[tuple[str, ...], Parameter(name="JOINT …")] = ()
    """Joints. Default: all."""
    id: Annotated[
        tuple[int, ...],
        Parameter(metavar="N …", consume_multiple=True, allow_repeating=True),
    ] = field(default=(), kw_only=True)
    """Ids of markers or servos. Only for off, also for servos that are not in the arm file."""
    baud: Annotated[int | None, Parameter(metavar="RATE")] = field(default=None, kw_only=True)
    """Baud rate of servos, in bits/s. Only with --id. Default: that of the arm file."""

    def run(self, terminal: Terminal = QUIET) -> ServoTorqueReport:
        """Switch torque and read it back."""
        if self.id and (self.joints or self.to == "on"):
            problem = "only for torque off, and not together with joints"
            raise OptionError("--id", problem, "torque off --id N …")
        if self.to == "on" and not self.bus:
            raise OptionError("--bus", "torque on can move an arm", "the port of its servos")
        config = load_arm(self.arm)
        report = ServoTorqueReport(self.to)
        if self.to == "on":
            self._switch_on(config, report, terminal)
        else:
            self._switch_off(config, report)
        return report

    def _switch_on(self, config: ArmConfig, report: ServoTorqueReport, terminal: Terminal) -> None:
        from robot_ik.hardware.model_check import check_own_model

        check_own_model(config)  # also if only some joints of the model get torque
        arm = open_arm_on(self.bus, config.only(self.joints), "hold")
        with driving(arm, report, terminal):
            arm.enable()
        report.set_exit(arm.exit_report)

    def _switch_off(self, config: ArmConfig, report: ServoTorqueReport) -> None:
        from robot_ik.hardware.leaving import leave
        from robot_ik.hardware.models import require_id

        servos = {drive.id: drive.name for drive in config.only(self.joints).drives}
        if self.id:
            for id in self.id:
                require_id(id, "--id")
            servos = {id: f"servo {id}" for id in self.id}
            if self.baud is not None:
                (baud,) = checked_bauds("--baud", [self.baud])
                config = replace(config, baud=baud)
        with open_servo_bus(self.bus, config) as bus:
            broadcast = not self.id and not self.joints
            report.set_exit(
                leave(bus, config, "torque_off", {}, servos=servos, broadcast=broadcast)
            )


@dataclass(eq=False)
class ServoTorqueReport(ServoReport):
    """Servos that confirmed their torque.

    Attributes:
        to: ``on`` or ``off``.
        confirmed: Joints, or ``servo ID``.
        doubt: What is not certain about the other servos. Empty: all have confirmed.
    """

    to: str
    confirmed: Sequence[str] = ()
    doubt: str = ""

    def set_exit(self, exit_report: ExitReport | None) -> None:
        """Store the result of the exit policy. None: the arm was not connected."""
        if exit_report is not None:
            self.confirmed = exit_report.verified
            self.doubt = "" if exit_report.ok else exit_report.doubt

    @property
    def ok(self) -> bool:
        return self.error is None and not self.doubt

    @property
    def failure(self) -> RobotIkError | None:
        if self.error is None and self.doubt and self.to == "off":  # driving() has printed "on"
            return HardwareError(self.doubt)
        return self.error

    def tables(self) -> Iterable[str]:
        if self.confirmed and self.to == "off":
            yield f"torque off, read back: {', '.join(self.confirmed)}"

    def facts(self) -> dict[str, Any]:
        return {"torque": self.to, "confirmed": list(self.confirmed), "doubt": self.doubt}
