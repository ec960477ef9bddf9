"""Id and baud rate of a new servo: written while it is alone on the wire, and read back."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

from robot_ik.errors import ArmStateError, ConfigError, HardwareError
from robot_ik.hardware.discovery import LIKELY, FoundServo, Progress, no_progress, scan
from robot_ik.hardware.models import require_id
from robot_ik.hardware.registers import ControlTable
from robot_ik.hardware.serial_bus import SerialBus


def set_up(
    port: str,
    id: int,
    baud: int,
    *,
    model: str = "",
    bauds: Sequence[int] = LIKELY,
    progress: Progress = no_progress,
) -> FoundServo | None:
    """Write id and baud rate into the EEPROM of the only servo on a port, and verify them.

    Args:
        port: Serial port.
        id: New id.
        baud: New rate, bit/s.
        model: Model that the servo must be.  Empty: any.
        bauds: Rates to look for the servo at, bit/s.
        progress: Called during the search.

    Returns:
        The servo as it was found; None if none answers.

    Raises:
        ConfigError: The servo is another model, or cannot have this id or rate.
        ArmStateError: Its torque is on.
        HardwareError: More than one servo answers, two share an id, the model is not known, or the
            servo reads back other values at the new address.  Errors of the bus.
    """
    require_id(id, "--id")
    servos = scan(port, bauds, progress=progress)
    if not servos:
        return None
    servo, table = _only_servo(servos)
    if model and servo.model != model:
        raise ConfigError(
            f"this servo is a {servo.model}",
            file="command line",
            key="--joint",
            allowed=f"a {model}",
        )
    if baud not in table.baud_rates:
        raise ConfigError(
            f"{servo.model} has no baud rate of {baud} bits/s",
            file="command line",
            key="--baud",
            allowed=", ".join(map(str, table.baud_rates)),
        )
    family = servo.family
    with closing(SerialBus(port, servo.baud, family.protocol)) as bus:
        bus.open()
        if bus.read(servo.id, table["torque_enable"]).data:
            raise ArmStateError(
                f"torque of the servo (id {servo.id}) is on, so its EEPROM is locked; nothing was "
                "written",
                hint="support the parts on its horn and switch torque off: robot-ik servo torque "
                f"off --id {servo.id} --baud {servo.baud}",
            )
        family.write_address(bus, table, servo.id, id, baud)

    with closing(SerialBus(port, baud, family.protocol)) as bus:
        bus.open()
        with family.eeprom_unlocked(bus, [id]):
            names = ("model_number", "id", "baud_rate", "return_delay_time")
            values = tuple(bus.read(id, table[name]).data for name in names)
    if values != (servo.number, id, table.baud_code(baud), 0):
        raise HardwareError(f"id {id} at {baud} baud reads back model, id, rate, delay = {values}")
    return servo


def _only_servo(servos: Sequence[FoundServo]) -> tuple[FoundServo, ControlTable]:
    """Return the servo that may be set up, and its control table.

    Args:
        servos: Servos that answer, at least one.

    Raises:
        HardwareError: Two servos share an id, more than one answers, or the model is not known.
    """
    shared = [servo for servo in servos if servo.shared]
    if shared:
        raise HardwareError(
            f"id {shared[0].id} gives damaged replies: two servos with one id, or a bad cable",
            hint="connect one servo alone and try again",
        )
    if len(servos) > 1:
        names = ", ".join(f"id {servo.id} {servo.model} at {servo.baud}" for servo in servos)
        raise HardwareError(
            f"{len(servos)} servos answer ({names}); exactly one may be connected, nothing was "
            "written",
            hint="unplug the others: an id that is taken would make both of them unreachable",
        )
    table = servos[0].table
    if table is None:
        raise HardwareError(f"{servos[0].model} is not a known servo model; nothing was written")
    return servos[0], table
