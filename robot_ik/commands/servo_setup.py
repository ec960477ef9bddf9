"""``robot-ik servo setup``: give one servo its id and baud rate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.table import Table

from robot_ik.commands.arms import load_arm, open_port
from robot_ik.commands.options import BusOptions, JsonOption
from robot_ik.commands.servo_scan import checked_bauds, servo_facts, servo_table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import HardwareError, OptionError, RobotIkError

if TYPE_CHECKING:
    from robot_ik.hardware.discovery import FoundServo


@dataclass(frozen=True, kw_only=True)
class ServoSetup(BusOptions, JsonOption):
    """Set the id and baud rate of the only connected servo, whatever its present rate.

        robot-ik servo setup --joint joint3    (id and rate of the arm file)
        robot-ik servo setup --id 3 --baud 1000000

    The values are written to EEPROM with torque off, and read back under the new id. The return
    delay becomes 0.

    Exit code 1: no servo answers.
    """

    joint: Annotated[str, Parameter(metavar="JOINT")] = ""
    """Joint of the arm file that this servo is for: its id, rate and model. Or use --id."""
    id: Annotated[int | None, Parameter(metavar="N")] = None
    """Ids of markers or servos. The new id, 0 to 252. Or use --joint."""
    baud: Annotated[int | None, Parameter(metavar="RATE")] = None
    """Baud rate of servos, in bits/s. The new rate. Default: that of the arm file."""
    from_baud: Annotated[
        tuple[int, ...],
        Parameter(metavar="RATE …", consume_multiple=True, allow_repeating=True),
    ] = ()
    """Look for the servo at these baud rates. Default: all."""

    def run(self, terminal: Terminal = QUIET) -> ServoSetupReport:
        """Find the servo, write its id and rate, and read them back."""
        from robot_ik.hardware.discovery import LIKELY  # NumPy and pydantic
        from robot_ik.hardware.servo_setup import set_up

        config = load_arm(self.arm)
        if self.joint and self.id is None:
            servo = config.joint(self.joint).servo
            id = servo.id
            model = servo.model
        elif self.id is not None and not self.joint:
            id = self.id
            model = ""
        else:
            raise OptionError("--id", "the servo is not named", "either --id N or --joint JOINT")
        bauds = checked_bauds("--from-baud", self.from_baud) or tuple(LIKELY)
        (baud,) = checked_bauds("--baud", [config.baud if self.baud is None else self.baud])
        with open_port(self.bus, self.arm) as port:
            before = set_up(port, id, baud, model=model, bauds=bauds, progress=terminal.progress)
        return ServoSetupReport(port, bauds, before, id, baud)


@dataclass(frozen=True, eq=False)
class ServoSetupReport(Report):
    """A servo before its set-up, and its new id and baud rate.

    Attributes:
        port: Serial port.
        bauds: Rates at which the servo was looked for.
        before: The servo as it was found. None: no servo answers.
        id: New id.
        baud: New rate, bits/s.
    """

    port: str
    bauds: tuple[int, ...]
    before: FoundServo | None
    id: int
    baud: int

    @property
    def ok(self) -> bool:
        return self.before is not None

    @property
    def failure(self) -> RobotIkError | None:
        from robot_ik.hardware.discovery import no_reply_hint

        if self.before is not None:
            return None
        return HardwareError(f"no servo answers on {self.port}", hint=no_reply_hint(self.bauds))

    def tables(self) -> Iterable[Table | str]:
        if self.before is None:
            return
        yield servo_table([self.before])
        change = f"id {self.before.id} -> {self.id}, {self.before.baud} -> {self.baud} baud"
        yield f"{change}, return delay 0: read back, done"

    def facts(self) -> dict[str, Any]:
        before = None if self.before is None else servo_facts(self.before)
        return {"port": self.port, "before": before, "id": self.id, "baud": self.baud}
