"""Servos: joint values to a bus and back, with safety checks. Import as ``robot_ik.hardware``.

``open_arm(ArmConfig.load(...), "pty")`` returns an arm. ``BUSES`` lists the ways to reach servos.
Importing this package opens nothing and loads neither the SDK nor pyserial.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from robot_ik.errors import BusNotOpenError, ConfigError

if __name__ != "robot_ik.hardware":
    raise ImportError(
        "this is the hardware package of robot_ik: `import robot_ik.hardware`, not "
        "`import hardware` (other distributions own that name)"
    )

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.bus import ServoBus
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.pty import PtyPort
    from robot_ik.ports import Clock
    from robot_ik.robot import Robot

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
        name: Name on the command line; ``PORT`` stands for any name of a serial port.
        title: One line for help texts.
        virtual: The servos are simulated.
        make: (given name, config, servos or None) -> bus that is not open yet.
        virtual_time: The simulated servos run on virtual time.
    """

    name: str
    title: str
    virtual: bool
    make: Callable[[str, ArmConfig, VirtualBus | None], ServoBus]
    virtual_time: bool = False


def _sim(_name: str, config: ArmConfig, servos: VirtualBus | None) -> ServoBus:
    from robot_ik.hardware.simulated import SimBus

    if servos is None:
        raise RuntimeError("a simulated bus needs servos")
    return SimBus(servos, config.family.protocol)


def _pty(_name: str, config: ArmConfig, servos: VirtualBus | None) -> ServoBus:
    from robot_ik.hardware.simulated import ServedBus

    pty_port()  # raises here, not when the bus is opened
    if servos is None:
        raise RuntimeError("a simulated bus needs servos")
    return ServedBus(servos, config.baud, config.family.protocol)


def pty_port() -> type[PtyPort]:
    """Return the class ``PtyPort``.

    Raises:
        BusNotOpenError: This system (Windows) has neither termios nor fcntl.
    """
    try:
        from robot_ik.hardware.virtual.pty import PtyPort
    except ImportError as reason:
        problem = f"this system has no pseudo terminals ({reason})"
        raise BusNotOpenError(problem, hint="use --bus sim: the same servos in process") from reason
    return PtyPort


def _port(name: str, config: ArmConfig, _servos: VirtualBus | None) -> ServoBus:
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
"""Every way to reach servos. The only place of registration."""

SIMULATED = "--bus " + " or ".join(bus.name for bus in BUSES.values() if bus.virtual)
"""Options that select simulated servos, for messages."""


def bus_row(name: str) -> Bus:
    """Return the row of a bus. Any name that is not in ``BUSES`` is that of a serial port."""
    return BUSES.get(name, BUSES["PORT"])


def open_arm(
    config: ArmConfig,
    bus: str = "pty",
    *,
    on_exit: str | None = None,
    virtual_bus: VirtualBus | None = None,
    start: ArrayLike | Mapping[str, float] | None = None,
    park_at: ArrayLike | Mapping[str, float] | None = None,
    robot: Robot | None = None,
    clock: Clock | None = None,
) -> Arm:
    """Return an arm on a bus, not connected yet.

    A ``with`` block connects it. ``Arm.enable`` switches torque on. If a calibration is beside the
    arm file, the model must be the one that was calibrated. This check cannot be skipped.

    Args:
        config: Arm file.
        bus: A name in ``BUSES``, or a serial port.
        on_exit: ``torque_off``, ``hold`` or ``park``; by default that of the arm file.
        virtual_bus: Servos of the caller (with faults, for example), for "sim" and "pty". By
            default new servos without faults.
        start: (n,) rad. Start values of the joints of the new servos.
        park_at: (n,) rad, for ``park``; by default the pose at which the arm was enabled.
        robot: Model of the arm; by default the robot that the arm file names.
        clock: Clock of the new servos; by default virtual time on "sim" and real time on "pty".

    Raises:
        CalibrationMismatchError: The model is not the one of the calibration.
        ConfigError: ``config`` is no ``ArmConfig``, ``on_exit`` or ``start`` is not allowed, or
            ``virtual_bus`` or ``start`` is given for a real port.
    """
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.model_check import check_own_model

    servos = _servos(config, bus, virtual_bus, start, clock)
    check_own_model(config, robot)
    servo_bus = bus_row(bus).make(bus, config, servos)
    return Arm(config, servo_bus, on_exit=on_exit, park_at=park_at)


def open_bus(name: str, config: ArmConfig, *, virtual_bus: VirtualBus | None = None) -> ServoBus:
    """Return an open bus without an arm.

    Args:
        name: A name in ``BUSES``, or a serial port.
        config: Baud rate, and servos of a virtual bus.
        virtual_bus: As for ``open_arm``.

    Raises:
        BusNotOpenError: The port is missing, no serial port, not permitted or already open.
        ConfigError: ``config`` is no ``ArmConfig``, or ``virtual_bus`` is given for a real port.
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
    """Return the servos of a virtual bus; None for a serial port."""
    from robot_ik.hardware.config import ArmConfig

    given: object = config
    if not isinstance(given, ArmConfig):
        raise ConfigError(
            f"{given!r} is no arm configuration",
            file="robot_ik.hardware",
            key="config",
            allowed='an ArmConfig, e.g. ArmConfig.load("arm.toml")',
        )
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
    # Imported here because it loads numpy, and some commands need names of buses only.
    from robot_ik.ports import RealClock, VirtualClock

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
