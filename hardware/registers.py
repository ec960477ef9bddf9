"""One register of all servos of an arm: where it lies, what it reads, whose fault an error is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from robot_ik.errors import BusTimeoutError, ConfigError, ServoRefusedError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import Register

NO_ACCESS = 7
"""ERR number: no such register, read-only, or locked."""


def shared_register(config: ArmConfig, name: str) -> Register:
    """The register all servos of the arm have at one address: what sync read and write need.

    Raises:
        ConfigError: The models of the arm differ in it.
    """
    first = config.servos[0].table[name]
    for joint in config.servos:
        other = joint.table[name]
        if (other.address, other.size, other.signed) != (first.address, first.size, first.signed):
            raise ConfigError(
                f"{name} lies elsewhere in {joint.model} than in {config.servos[0].model}",
                file=config.file or config.name,
                key="joints",
                allowed="models with one layout on one bus",
            )
    return first


@contextmanager
def joint_named(config: ArmConfig) -> Iterator[None]:
    """Adds the joint's name to errors of the bus, which knows ids only."""
    names = {servo.id: servo.name for servo in config.servos}
    try:
        yield
    except BusTimeoutError as error:
        raise BusTimeoutError(
            id=error.id,
            register=error.register,
            port=error.port,
            joint=names.get(error.id, ""),
            last_good=error.last_good,
        ) from error
    except ServoRefusedError as error:
        raise ServoRefusedError(
            id=error.id,
            register=error.register,
            code=error.code,
            reason=error.reason,
            joint=names.get(error.id, ""),
        ) from error


def read_all(bus: ServoBus, config: ArmConfig, name: str, *, absent: int | None = None) -> dict[int, int]:
    """One register of every servo; who misses the common read is asked alone.

    Args:
        bus: Open.
        config: The arm.
        name: Of the register.
        absent: What it is taken to read where older firmware does not have it.

    Raises:
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError: By joint name.
    """
    register = shared_register(config, name)
    values: dict[int, int] = {}
    with joint_named(config):
        for id, status in bus.sync_read(config.servo_ids, register).items():
            value = status.data
            if value is None and status.error == NO_ACCESS and absent is not None:
                value = absent
            if value is None:
                value = bus.read(id, register).data
            assert value is not None  # read() answers or raises
            values[id] = value
    return values
