"""Servos: from joint angles to a bus and back, guarded.  Imported as ``robot_ik.hardware``.

``open_arm(ArmConfig.load(...), "pty")`` gives an arm; ``BUSES`` are the ways to reach one.  Importing this
opens nothing and loads neither the SDK nor pyserial.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from robot_ik.errors import BusNotOpenError, ConfigError

if __name__ != "robot_ik.hardware":
    raise ImportError(
        "this is the hardware package of robot_ik: `import robot_ik.hardware`, not `import hardware` "
        "(other distributions own that name)"
    )

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.bus import ServoBus
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.pty import PtyPort
    from robot_ik.ports import Clock

__all__ = [
    "BUSES",
    "SIMULATED",
    "Bus",
    "bus_row",
    "open_arm",
    "open_bus",
    "pty_port",
    "simulated_servos",
    "virtual_servos",
]


@dataclass(frozen=True)
class Bus:
    """One way to reach servos.

    Attributes:
        name: As the user says it; ``PORT`` stands for any name of a serial port.
        title: One line for help texts.
        virtual: Its servos are simulated.
        make: (name given, config, servos or None) -> bus, not open yet.
        virtual_time: Its simulated servos run on a clock of their own.
    """

    name: str
    title: str
    virtual: bool
    make: Callable[[str, ArmConfig, VirtualBus | None], ServoBus]
    virtual_time: bool = False


def _sim(name: str, config: ArmConfig, servos: VirtualBus | None) -> ServoBus:
    from robot_ik.hardware.simulated import SimBus

    if servos is None:
        raise RuntimeError("a simulated bus needs servos")
    return SimBus(servos, config.family.protocol)


def _pty(name: str, config: ArmConfig, servos: VirtualBus | None) -> ServoBus:
    from robot_ik.hardware.simulated import ServedBus

    pty_port()  # now, not when it is opened
    if servos is None:
        raise RuntimeError("a simulated bus needs servos")
    return ServedBus(servos, config.baud, config.family.protocol)


def pty_port() -> type[PtyPort]:
    """The class of ports; raises ``BusNotOpenError`` where termios or fcntl is missing: Windows."""
    try:
        from robot_ik.hardware.virtual.pty import PtyPort
    except ImportError as reason:
        problem = f"this system has no pseudo terminals ({reason})"
        raise BusNotOpenError(problem, hint="use --bus sim: the same servos in process") from reason
    return PtyPort


def _port(name: str, config: ArmConfig, servos: VirtualBus | None) -> ServoBus:
    from robot_ik.hardware.serial_bus import SerialBus

    return SerialBus(name, config.baud, config.family.protocol)


BUSES: Mapping[str, Bus] = MappingProxyType(
    {
        bus.name: bus
        for bus in (
            Bus("sim", "virtual servos in this process, on virtual time", True, _sim, True),
            Bus("pty", "virtual servos behind a real pty, driven as real ones", True, _pty),
            Bus("PORT", "servos on a serial port, e.g. /dev/ttyUSB0", False, _port),
        )
    }
)
"""Every way to reach servos; the only place of registration."""

SIMULATED = "--bus " + " or ".join(bus.name for bus in BUSES.values() if bus.virtual)
"""Where servos are simulated, for messages."""


def bus_row(name: str) -> Bus:
    """The row for what the user said: any other name is that of a port."""
    return BUSES.get(name, BUSES["PORT"])


def open_arm(
    config: ArmConfig,
    bus: str = "pty",
    *,
    on_exit: str | None = None,
    virtual_bus: VirtualBus | None = None,
    start: ArrayLike | Mapping[str, float] | None = None,
    park_at: ArrayLike | Mapping[str, float] | None = None,
    clock: Clock | None = None,
) -> Arm:
    """Makes an arm on a bus, still disconnected: a ``with`` block connects it, ``enable`` gives it torque.

    Args:
        config: The arm file.
        bus: A name in ``BUSES``, or a serial port.
        on_exit: ``torque_off``, ``hold`` or ``park``; the arm file's by default.
        virtual_bus: Servos made by the caller (faults, true angles), for "sim" and "pty"; else healthy ones.
        start: (n,) rad, where those default servos stand at first.
        park_at: (n,) rad, for ``park``; by default where the arm was enabled.
        clock: Clock of the default servos; virtual time on "sim" and real time on "pty" by default.

    Raises:
        ConfigError: ``config`` is none, ``on_exit`` or ``start`` is impossible, or ``virtual_bus`` or
            ``start`` is for a real port.
    """
    from robot_ik.hardware.arm import Arm

    servos = _servos(config, bus, virtual_bus, start, clock)
    made = bus_row(bus).make(bus, config, servos)
    return Arm(config, made, on_exit=on_exit, park_at=park_at)


def open_bus(name: str, config: ArmConfig, *, virtual_bus: VirtualBus | None = None) -> ServoBus:
    """The bus alone, open.

    Args:
        name: A name in ``BUSES``, or a serial port.
        config: Says which baud rate, and which servos where they are virtual.
        virtual_bus: As for ``open_arm``.

    Raises:
        BusNotOpenError: Missing, not a serial port, not permitted, already open.
        ConfigError: ``config`` is none, or ``virtual_bus`` for a real port.
    """
    bus = bus_row(name).make(name, config, _servos(config, name, virtual_bus, None))
    bus.names |= {drive.id: drive.name for drive in config.drives}
    bus.open()
    return bus


def _servos(
    config: ArmConfig,
    bus: str,
    servos: VirtualBus | None,
    start: ArrayLike | Mapping[str, float] | None,
    clock: Clock | None = None,
) -> VirtualBus | None:
    """The servos where they are virtual; their clock is that of the bus."""
    from robot_ik.hardware.config import ArmConfig

    given: object = config
    if not isinstance(given, ArmConfig):
        raise ConfigError(
            f"{given!r} is no arm configuration",
            file="robot_ik.hardware", key="config", allowed='an ArmConfig, e.g. ArmConfig.load("arm.toml")',
        )  # fmt: skip
    row = bus_row(bus)
    if not row.virtual:
        if servos is not None or start is not None:
            raise ConfigError(
                f"{bus} is a real port",
                file="robot_ik.hardware",
                key="virtual_bus, start",
                allowed="for sim and pty",
            )
        return None
    if servos is not None:
        return servos
    from robot_ik.ports import (  # they bring numpy: commands ask for names only
        RealClock,
        VirtualClock,
    )

    if clock is None:
        clock = VirtualClock() if row.virtual_time else RealClock()
    return simulated_servos(config, clock, start)


def simulated_servos(
    config: ArmConfig, clock: Clock, start: ArrayLike | Mapping[str, float] | None = None
) -> VirtualBus:
    """Return simulated servos of the arm's family, without torque.

    Args:
        config: Arm.
        clock: Clock of the servos.
        start: Where the joints stand at first, see ``virtual.bus.start_values``.
    """
    from robot_ik.hardware.virtual.bus import VirtualBus

    return VirtualBus.from_config(config, clock, start)


def virtual_servos(bus: ServoBus) -> VirtualBus | None:
    """Return the simulated servos behind a bus; None if its servos are real."""
    servos: VirtualBus | None = getattr(bus, "virtual_bus", None)
    return servos
