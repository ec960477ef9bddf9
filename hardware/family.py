"""What the arm needs from a servo family.  A family is one file in ``robot_ik.hardware.families``.

The arm works with register names that mean the same in every family: ``goal_position``,
``present_position``, ``torque_enable``, ``hardware_error_status``, ``present_input_voltage``.
Everything else about the registers of a family is decided in its file.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple, Protocol

from robot_ik.hardware.registers import ControlTable, OperatingMode, Register
from robot_ik.hardware.wire_protocol import WireProtocol

if TYPE_CHECKING:
    from robot_ik.hardware.bus import ServoBus
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.servo import Drive


@dataclass(frozen=True)
class Capabilities:
    """What the servos of a family can do.

    Attributes:
        bus_watchdog: A servo stops by itself when the bus is silent.
        goal_enables_torque: A write of the goal position switches torque on.
        current_goal: A servo takes a goal current.
        reboot_clears_errors: A reboot instruction clears hardware errors.
        half_turn_homing: A calibration first makes the middle of every range the middle of the
            servo's revolution, so that no range crosses its end.
        indirect_addresses: A servo shows registers side by side that lie apart, so that a control
            cycle reads fewer bytes; see ``ServoFamily.short_block``.
    """

    bus_watchdog: bool
    goal_enables_torque: bool
    current_goal: bool
    reboot_clears_errors: bool
    half_turn_homing: bool = False
    indirect_addresses: bool = False


class CycleBlock(NamedTuple):
    """What a control cycle reads from one servo.

    Attributes:
        register: Bytes that are read at once.
        parts: Registers inside it: ``torque_enable``, ``present_velocity``, ``present_position``,
            and more if the family has more.
    """

    register: Register
    parts: tuple[Register, ...]


class ServoFamily(Protocol):
    """One servo family.

    Attributes:
        name: As in ``ControlTable.family``.
        title: Name for people.
        baud_rates: Rates that some model of the family knows, bit/s.
        common_table: Control table for registers that every model has at the same address.
        changing_registers: Two registers that hardly ever read the same twice.
        velocity_unit: rad/s of one count of the velocity registers.
        protocol: Wire protocol of every servo of the family.
        capabilities: What the servos can do.
        mode_values: Operating mode -> value of the Operating Mode register.
        unprotected_exit: What happens when the program dies without leaving the arm, for the user.
    """

    @property
    def name(self) -> str: ...

    @property
    def title(self) -> str: ...

    @property
    def baud_rates(self) -> Collection[int]: ...

    @property
    def common_table(self) -> ControlTable: ...

    @property
    def changing_registers(self) -> tuple[str, str]: ...

    @property
    def velocity_unit(self) -> float: ...

    @property
    def protocol(self) -> WireProtocol: ...

    @property
    def capabilities(self) -> Capabilities: ...

    @property
    def mode_values(self) -> Mapping[OperatingMode, int]: ...

    @property
    def unprotected_exit(self) -> str: ...

    def prepare(self, bus: ServoBus, config: ArmConfig) -> None:
        """Make every servo answer reads and writes."""
        ...

    def watchdog_tripped(self, bus: ServoBus, drive: Drive, /) -> bool:
        """Return whether the bus watchdog of a servo has run out.  Reads the servo."""
        ...

    def clear_watchdog(self, bus: ServoBus, config: ArmConfig, drive: Drive) -> None:
        """Disarm the bus watchdog of a servo.  Does nothing in a family without one."""
        ...

    def arm_watchdog(self, bus: ServoBus, config: ArmConfig) -> None:
        """Make every servo stop when the bus is silent for ``watchdog_ms``.

        A family without a bus watchdog does nothing: its arm files have ``watchdog_ms = 0``.
        """
        ...

    def error_names(self, value: int) -> tuple[str, ...]:
        """Return the names of the bits that are set in ``hardware_error_status``."""
        ...

    def set_up(self, bus: ServoBus, config: ArmConfig) -> None:
        """Set up every servo as program and arm file need it.

        EEPROM is written only where it differs.

        Raises:
            ArmStateError: An EEPROM register must change and torque is on.
            ConfigError, HardwareError: Servo and arm file disagree.
        """
        ...

    def check_strength(self, bus: ServoBus, config: ArmConfig) -> None:
        """Check that the settings of every servo let it hold the arm.

        Raises:
            HardwareError: A servo cannot hold the arm.
        """
        ...

    def check_protection(self, bus: ServoBus, config: ArmConfig) -> None:
        """Warn of servos that overload and heat do not switch off."""
        ...

    def limit_speed(self, bus: ServoBus, config: ArmConfig) -> None:
        """Write the largest speed and acceleration of every servo.

        They are lost when a servo restarts.
        """
        ...

    def forgot_speed(self, bus: ServoBus, config: ArmConfig) -> Drive | None:
        """Return a servo that restarted since ``limit_speed``; None if no servo did."""
        ...

    def plain_block(self, table: ControlTable) -> CycleBlock:
        """Return the block that every servo of a model can read without preparation."""
        ...

    def short_block(
        self, bus: ServoBus, id: int, table: ControlTable, *, with_health: bool
    ) -> CycleBlock:
        """Prepare a servo for a block that is shorter than ``plain_block``, and return the block.

        Its first parts are ``torque_enable`` (1 byte), ``present_velocity`` (2 bytes) and
        ``present_position`` (4 bytes), side by side.  Only called in a family with
        ``indirect_addresses``.

        Args:
            bus: Open bus.
            id: Servo id.
            table: Control table of the servo.
            with_health: Effort, temperature and supply follow.

        Raises:
            HardwareError: The servo does not take the addresses, or does not answer.
        """
        ...

    def state_blocks(self, table: ControlTable) -> tuple[Register, ...]:
        """Return the blocks that hold torque, errors and measurements of a servo."""
        ...

    def write_address(
        self, bus: ServoBus, table: ControlTable, at: int, id: int, baud: int
    ) -> None:
        """Write id and baud rate of the only servo on a bus.  It then answers at the new rate.

        Args:
            bus: Open bus at the present rate.
            table: Control table of the servo.
            at: Present id.
            id: New id.
            baud: New rate, bit/s.
        """
        ...

    def eeprom_unlocked(self, bus: ServoBus, ids: Collection[int]) -> AbstractContextManager[None]:
        """Return a context in which EEPROM registers of these servos keep what is written."""
        ...

    def home_half_turn(self, bus: ServoBus, config: ArmConfig) -> None:
        """Make the present position of every servo the middle of its revolution.

        Torque must be off.  Does nothing in a family without ``half_turn_homing``.
        """
        ...

    def is_in_control(self, values: Mapping[str, int]) -> bool:
        """Return whether a servo has torque and has not restarted.

        Args:
            values: Register name -> value of the parts of the cycle block.
        """
        ...

    def load_lag(self, position_p_gain: int) -> float:
        """Return the ticks by which a load can keep a shaft behind its goal.

        A shaft that is further behind does not follow although the servo gives all it has.

        Args:
            position_p_gain: Value of the Position P Gain register.
        """
        ...

    def reset(self, bus: ServoBus, drive: Drive) -> None:
        """Clear the hardware errors of a servo.  Its torque is off afterwards."""
        ...


FAMILY_MODULES: Mapping[str, str] = {
    "dynamixel_x": "robot_ik.hardware.families.dynamixel_x",
    "feetech_sts": "robot_ik.hardware.families.feetech_sts",
}
"""Name of a family -> its module, whose ``FAMILY`` is a ``ServoFamily``.

The only place of registration.
"""


def family_of(name: str) -> ServoFamily:
    """Return a family by name.

    Its module is imported on first use: the modules import this one.
    """
    family: ServoFamily = import_module(FAMILY_MODULES[name]).FAMILY
    return family


def families() -> Iterator[ServoFamily]:
    """Yield every servo family."""
    return (family_of(name) for name in FAMILY_MODULES)
