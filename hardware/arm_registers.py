"""Registers of all servos of an arm: their addresses, their values, and failing servos."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from robot_ik.errors import BusCorruptError, BusTimeoutError, ServoMismatchError, ServoRefusedError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.models import model_name
from robot_ik.hardware.registers import Register

log = logging.getLogger(__name__)

NO_ACCESS = 7
"""Error number of a reply: no such register, read-only, or locked."""


def shared_register(config: ArmConfig, name: str) -> Register:
    """Return a register that all servos of the arm have at one address, for group calls.

    Raises:
        ConfigError: The models of the arm differ in it.
    """
    first = config.servos[0].table[name]
    for servo in config.servos:
        other = servo.table[name]
        if (other.address, other.size, other.signed) != (first.address, first.size, first.signed):
            problem = f"{name} lies elsewhere in {servo.model} than in {config.servos[0].model}"
            raise config.wrong(problem, "joints", "models with one layout on one bus")
    return first


def read_all(
    bus: ServoBus, config: ArmConfig, name: str, *, absent: int | None = None
) -> dict[int, int]:
    """Return one register of every servo: servo id -> value.

    A servo that does not answer the group read is read again alone.

    Args:
        bus: Open bus.
        config: Arm file.
        name: Register.
        absent: Value of servos whose firmware does not have the register.  None: all have it.

    Raises:
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError: By joint name.
    """
    if absent is not None and name not in config.servos[0].table:
        return dict.fromkeys(config.servo_ids, absent)
    return read_register(bus, config, shared_register(config, name), absent=absent)


def read_register(
    bus: ServoBus, config: ArmConfig, register: Register, *, absent: int | None = None
) -> dict[int, int]:
    """Return a register or a block of registers of every servo; see ``read_all``."""
    values: dict[int, int] = {}
    for id, status in bus.sync_read(config.servo_ids, register).items():
        value = status.data
        if value is None and (absent is None or status.error != NO_ACCESS):
            try:
                value = bus.read(id, register).data
            except ServoRefusedError as refused:
                if refused.code != NO_ACCESS or absent is None:
                    raise
        if value is None:
            value = absent
        if value is None:
            raise BusCorruptError(f"the reply of servo id {id} for {register.name} has no data")
        values[id] = value
    return values


def read_motion(bus: ServoBus, config: ArmConfig) -> tuple[dict[int, int], dict[int, float]]:
    """Return positions and velocities of all servos. Those of one servo come in one reply.

    Args:
        bus: Open bus.
        config: Arm file.

    Returns:
        Servo id -> present position, ticks; and servo id -> velocity of the shaft, rad/s, positive
        if the ticks increase.

    Raises:
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError: By joint name.
    """
    position = shared_register(config, "present_position")
    velocity = shared_register(config, "present_velocity")
    address = min(position.address, velocity.address)
    size = max(position.end, velocity.end) - address
    block = Register("present position and velocity", address, size)
    ticks = {}
    velocities = {}
    for id, value in read_register(bus, config, block).items():
        values = block.take_apart(value, (position, velocity))
        ticks[id] = values["present_position"]
        velocities[id] = values["present_velocity"] * config.family.velocity_unit
    return ticks, velocities


def require_models(bus: ServoBus, expected: Mapping[int, tuple[str, int]], source: str) -> None:
    """Check that every servo answers and is the right model.

    Args:
        bus: Open bus.
        expected: Servo id -> its joint, and its Model Number.
        source: Where the models come from, e.g. "the arm file".

    Raises:
        ServoMismatchError: A servo is missing or is another model.
        BusDisconnectedError, BusNotOpenError.
    """
    numbers: dict[int, int] = {}
    damaged: set[int] = set()
    for id in expected:
        try:
            numbers[id] = bus.ping(id)
        except BusCorruptError:
            damaged.add(id)
        except BusTimeoutError as error:
            log.debug("ping %d: %s", id, error)
    if _agree(numbers, expected):
        return
    if len(numbers) < len(expected):
        # A wrong id is the usual reason, so the error shows the other servos on the bus.
        numbers |= bus.broadcast_ping()
        if _agree(numbers, expected):
            return  # a ping was lost, and all have answered now
    hint = ""  # empty: the default hint of the error
    if damaged and numbers:
        hint = "do two servos have that id? connect one of them alone: robot-ik servo setup --id N"
    elif damaged:
        hint = "every reply is damaged: check the cable, its contacts and the adapter"
    elif not numbers:
        hint = (
            "no servo answers at all: check the servos' power and the cable; "
            "robot-ik servo scan looks for them at every baud rate"
        )
    models = dict.fromkeys(damaged, "damaged replies")
    models |= {id: model_name(number) for id, number in numbers.items()}
    expected_models = {
        id: f"{joint}: {model_name(number)}" for id, (joint, number) in expected.items()
    }
    raise ServoMismatchError(expected_models, models, port=bus.port, hint=hint, source=source)


def _agree(numbers: Mapping[int, int], expected: Mapping[int, tuple[str, int]]) -> bool:
    """Return whether every servo answered with the right Model Number."""
    return all(numbers.get(id) == number for id, (_, number) in expected.items())
