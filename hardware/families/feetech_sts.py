"""Feetech STS servos (STS3215): set-up, speed limits, errors.  Protocol 1.

Numbers are sign-magnitude.

Differences from the Dynamixel X series that decide how an arm must be driven:

* No bus watchdog.  A servo whose program died moves to its last goal and holds it with torque.
* Every reply carries the servo status as its error byte.  A read during an error has good data.
* A write of Goal Position may switch torque on.  A servo that must stay limp gets no goal.
* EEPROM writes last only while Lock is 0.
* Present Position is Actual Position minus Homing Offset.  On Dynamixel it is plus.

Facts and sources: ``docs/reference/feetech_sts.md``; registers: ``feetech_sts_table``.
"""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager

from robot_ik.errors import BusTimeoutError, HardwareError
from robot_ik.hardware.arm_registers import read_all, shared_register
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.feetech_sts_table import BAUD_RATES, STS3215
from robot_ik.hardware.family import Capabilities, CycleBlock
from robot_ik.hardware.protocol1 import Protocol1
from robot_ik.hardware.register_access import (
    check_position_limits,
    set_eeprom,
    sync_set,
    write_register,
)
from robot_ik.hardware.registers import (
    RADIANS_PER_TICK,
    TICKS_PER_REVOLUTION,
    ControlTable,
    OperatingMode,
    Register,
)
from robot_ik.hardware.servo import GRIPPER, Drive

log = logging.getLogger(__name__)

STATUS_BITS: Mapping[int, str] = {
    0: "input_voltage",
    1: "encoder",
    2: "overheating",
    3: "overcurrent",
    4: "angle",
    5: "overload",
}
"""Bit of the servo status, and of the error byte of every reply -> name [MT]."""

POSITION_MODE = 0
"""Operating Mode: position servo [MT]."""

MULTI_TURN_FEEDBACK = 1 << 4
"""Bit of Phase: Present Position is not folded into one revolution [MT].  LeRobot clears it."""

UNLOCKED = 0
"""Lock: EEPROM writes are saved [MT]."""

LOCKED = 1
"""Lock: EEPROM writes are lost at the next power cycle [MT]."""

SPEED_HEADROOM = 1.5
"""Goal Velocity over the joint's speed limit: the servo can catch up after a lost cycle."""

RAMP_SHARE = 0.25
"""Share of a control period in which the servo should reach its speed, to follow without lag."""

SMALLEST_STRENGTH = 0.25
"""Share of its torque below which a servo is refused.  The weight of an arm needs this torque."""

SMALLEST_GRIP = 0.02
"""The same for a gripper, which may press softly and carries no arm."""

FULL_EFFORT = 3910.0
"""Ticks behind times Position P Gain at which a servo gives its full duty cycle.

No Feetech document gives it. Rhoban/bam (060af88, bam/feetech/actuator.py) measured it with an
oscilloscope: the duty cycle is 0.166 per rad and count of the gain, at most 0.97. That is
0.97 / 0.166 * 652 ticks/rad = 3809. Their fit of a 12 V servo (params/feetech_sts3215_12V/m1.json)
multiplies 0.166 by 0.975: 3907. The larger value is rounded up, so that a loaded joint is not taken
for one that does not follow. Only the fault ``not_following`` depends on it.
"""

LARGEST_VELOCITY = 3400
"""tick/s.  Largest Goal Velocity [MT]."""

ACCELERATION_UNIT = 100.0
"""tick/s^2 of one count of Acceleration [MT]."""

LARGEST_ACCELERATION = 254
"""Largest value of Acceleration [MT]."""


class FeetechSts:
    """Feetech STS servos; implements ``ServoFamily``."""

    name = "feetech_sts"
    title = "Feetech STS"
    baud_rates = tuple(BAUD_RATES.values())
    common_table = STS3215
    changing_registers = ("present_position", "present_current")
    velocity_unit = RADIANS_PER_TICK
    protocol = Protocol1(model_number=STS3215["model_number"])
    capabilities = Capabilities(
        bus_watchdog=False,
        goal_enables_torque=True,
        current_goal=False,
        reboot_clears_errors=False,
        half_turn_homing=True,
    )
    mode_values: Mapping[OperatingMode, int] = {OperatingMode.POSITION: POSITION_MODE}
    unprotected_exit = (
        "STS servos have no bus watchdog: they go to their last goal, at most at the speed limit "
        "of the arm file, "
        "and keep their torque until the power goes or a program switches them off"
    )

    def prepare(self, bus: ServoBus, config: ArmConfig) -> None:
        """Set Response Status Level 1.  With level 0 a servo answers no write."""
        for drive in config.drives:
            servo = drive.servo
            register = servo.table["status_return_level"]
            if bus.read(servo.id, register).data != 1:
                shared = shared_register(config, "status_return_level")
                bus.sync_write(shared, {servo.id: 1})
            if bus.read(servo.id, register).data != 1:
                raise HardwareError(
                    f"servo id {servo.id} (joint {drive.name!r}) keeps its response level"
                )

    def watchdog_tripped(self, _bus: ServoBus, _drive: Drive, /) -> bool:
        """Return False: STS servos have no bus watchdog."""
        return False

    def clear_watchdog(self, bus: ServoBus, config: ArmConfig, drive: Drive) -> None:
        """Do nothing: STS servos have no bus watchdog."""

    def arm_watchdog(self, bus: ServoBus, config: ArmConfig) -> None:
        """Do nothing: STS servos have no bus watchdog."""

    def error_names(self, value: int) -> tuple[str, ...]:
        return tuple(STATUS_BITS.get(bit, f"bit{bit}") for bit in range(8) if value >> bit & 1)

    def set_up(self, bus: ServoBus, config: ArmConfig) -> None:
        torque = read_all(bus, config, "torque_enable")
        phase = read_all(bus, config, "phase")
        settings = {
            "return_delay_time": dict.fromkeys(config.servo_ids, 0),
            "operating_mode": {servo.id: self.mode_values[servo.mode] for servo in config.servos},
            "phase": {id: value & ~MULTI_TURN_FEEDBACK for id, value in phase.items()},
        }
        with self.eeprom_unlocked(bus, config.servo_ids):
            for name, values in settings.items():
                set_eeprom(bus, config, name, values, torque)
            self._set_gains(bus, config)
            self._set_protection_currents(bus, config)
        # A servo stops at its own limits without an error.
        check_position_limits(bus, config, config.drives)
        self.limit_speed(bus, config)

    def check_strength(self, bus: ServoBus, config: ArmConfig) -> None:
        """Check that every servo can hold the arm."""
        gains = read_all(bus, config, "position_p_gain")
        limits = read_all(bus, config, "torque_limit")
        for drive in config.drives:
            servo = drive.servo
            where = drive.label
            if not gains[servo.id]:
                raise HardwareError(
                    f"{where} has Position P Gain 0 and would not follow its goals; nothing was "
                    "switched on",
                    hint="set position_p in its [joints.gains] table",
                )
            share = limits[servo.id] / servo.table["torque_limit"].maximum
            if share < (SMALLEST_GRIP if drive.joint.group == GRIPPER else SMALLEST_STRENGTH):
                raise HardwareError(
                    f"{where} may use {100 * share:.0f} % of its torque (Torque Limit "
                    f"{limits[servo.id]}) and could not hold the arm; nothing was switched on",
                    hint="a power cycle resets Torque Limit to Max Torque, an EEPROM setting",
                )

    def check_protection(self, bus: ServoBus, config: ArmConfig) -> None:
        """Warn of servos that heat does not switch off, and of joints without a load threshold.

        The next goal ends an overload, so a servo that gets a stream of goals is never overloaded.
        """
        masks = read_all(bus, config, "unloading_condition")
        names = [drive.name for drive in config.drives if not masks[drive.id]]
        if names:
            log.warning(
                "%s: Unloading Condition is 0, so no overload and no heat switches torque off",
                ", ".join(names),
            )
        names = [joint.name for joint in config.joints if joint.stop_at.load_percent is None]
        if names:
            log.warning(
                "%s: without load_percent in [joints.stop_at] a blocked joint presses with all its "
                "torque, because every goal ends an overload of the servo",
                ", ".join(names),
            )

    def _set_gains(self, bus: ServoBus, config: ArmConfig) -> None:
        """Write the gains of the arm file.  On STS servos gains are EEPROM registers."""
        for drive in config.drives:
            servo = drive.servo
            for name, value in servo.gains.registers.items():
                if bus.read(servo.id, servo.table[name]).data != value:
                    write_register(bus, drive, name, value)

    def _set_protection_currents(self, bus: ServoBus, config: ArmConfig) -> None:
        """Write ``current_limit_ma``: a servo that exceeds it for 2 s switches its motor off."""
        for drive in config.drives:
            limit = drive.servo.current_limit
            if limit is None:
                continue
            table = drive.servo.table
            register = table["protection_current"]
            counts = min(int(limit / table.current_unit), register.maximum)
            if bus.read(drive.id, register).data != counts:
                write_register(bus, drive, register.name, counts)

    def _limit_grip(self, bus: ServoBus, config: ArmConfig) -> None:
        """Write Torque Limit of grippers with ``current_limit_ma``: they press with this current.

        Without it a gripper that holds an object presses with all it has until it overloads.
        """
        for drive in config.drives:
            limit = drive.servo.current_limit
            if limit is None or drive.joint.group != GRIPPER:
                continue
            register = drive.servo.table["torque_limit"]
            share = 1e-3 * limit / drive.servo.table.motor.stall_current
            write_register(bus, drive, register.name, min(round(1000 * share), register.maximum))

    def home_half_turn(self, bus: ServoBus, config: ArmConfig) -> None:
        """Write Homing Offset so that every servo reads 2048 here.  Limits become 0 and 4095."""
        torque = read_all(bus, config, "torque_enable")
        position = read_all(bus, config, "present_position")
        offset = read_all(bus, config, "homing_offset")
        largest = STS3215["homing_offset"].maximum
        offsets = {}
        for id in config.servo_ids:
            actual = (position[id] + offset[id]) % TICKS_PER_REVOLUTION
            offsets[id] = min(max(actual - TICKS_PER_REVOLUTION // 2, -largest), largest)
        settings = {
            "min_position_limit": dict.fromkeys(config.servo_ids, 0),
            "max_position_limit": dict.fromkeys(config.servo_ids, TICKS_PER_REVOLUTION - 1),
            "homing_offset": offsets,
        }
        with self.eeprom_unlocked(bus, config.servo_ids):
            for name, values in settings.items():
                set_eeprom(bus, config, name, values, torque)

    def limit_speed(self, bus: ServoBus, config: ArmConfig) -> None:
        """Write Goal Velocity and Acceleration, and how hard a gripper may press.

        They bound every later move, even to a stale goal.
        """
        self._limit_grip(bus, config)
        velocity = {}
        acceleration = {}
        for joint, servo in config.drives:
            speed = SPEED_HEADROOM * joint.velocity * joint.ticks_per_unit
            ramp = speed * config.rate_hz / RAMP_SHARE
            velocity[servo.id] = min(math.ceil(speed), LARGEST_VELOCITY)
            acceleration[servo.id] = min(
                max(math.ceil(ramp / ACCELERATION_UNIT), 1), LARGEST_ACCELERATION
            )
        for name, values in (("goal_velocity", velocity), ("acceleration", acceleration)):
            failed = sync_set(bus, config, name, values)
            if failed:
                names = ", ".join(dict.fromkeys(drive.name for drive in failed))
                raise HardwareError(
                    f"{name} of {names} was written and reads back otherwise; no torque was changed"
                )

    def forgot_speed(self, bus: ServoBus, config: ArmConfig) -> Drive | None:
        velocity = read_all(bus, config, "goal_velocity")
        return next((drive for drive in config.drives if not velocity[drive.id]), None)

    def plain_block(self, table: ControlTable) -> CycleBlock:
        """From torque to current: 31 bytes.

        Torque, velocity, position, load and temperature come in every cycle.
        """
        names = (
            "torque_enable",
            "goal_velocity",
            "present_velocity",
            "present_position",
            "present_load",
            "present_current",
            "present_temperature",
            "present_input_voltage",
        )
        block = table.block("torque_enable", "present_current")
        return CycleBlock(block, tuple(table[name] for name in names))

    def short_block(
        self,
        _bus: ServoBus,
        _id: int,
        table: ControlTable,
        *,
        with_health: bool,  # noqa: ARG002
    ) -> CycleBlock:
        """Return the plain block: these servos have no indirect addresses."""
        return self.plain_block(table)

    def state_blocks(self, table: ControlTable) -> tuple[Register, ...]:
        return (table.block("torque_enable", "present_current"),)

    def write_address(
        self, bus: ServoBus, table: ControlTable, at: int, id: int, baud: int
    ) -> None:
        """Write the id before the rate: if the line breaks between, the rate is still the old one.

        Lock is a RAM register.  The caller reopens the bus at the new rate and must lock the EEPROM
        again with ``eeprom_unlocked``.
        """
        bus.write(at, table["lock"], UNLOCKED)
        if bus.read(at, table["return_delay_time"]).data:
            bus.write(at, table["return_delay_time"], 0)
        if at != id:
            bus.write(at, table["id"], id)
            bus.ping(id)
            bus.write(id, table["lock"], UNLOCKED)
        if bus.read(id, table["baud_rate"]).data != table.baud_code(baud):
            with contextlib.suppress(BusTimeoutError):  # the reply may come at the new rate
                bus.write(id, table["baud_rate"], table.baud_code(baud))

    @contextmanager
    def eeprom_unlocked(self, bus: ServoBus, ids: Collection[int]) -> Iterator[None]:
        lock = STS3215["lock"]
        bus.sync_write(lock, dict.fromkeys(ids, UNLOCKED))
        try:
            yield
        finally:
            bus.sync_write(lock, dict.fromkeys(ids, LOCKED))

    def is_in_control(self, values: Mapping[str, int]) -> bool:
        """Return False for a servo without torque and for a servo that restarted.

        The next goal gives a restarted servo torque again, so torque alone shows nothing.  Goal
        Velocity, which ``limit_speed`` wrote, is 0 after a restart.
        """
        return bool(values["torque_enable"]) and values["goal_velocity"] != 0

    def load_lag(self, position_p_gain: int) -> float:
        return FULL_EFFORT / position_p_gain if position_p_gain else 0.0

    def reset(self, bus: ServoBus, drive: Drive) -> None:
        """Switch torque off.  An overload ends with the next goal position [DS 7-11]."""
        bus.write(drive.id, drive.servo.table["torque_enable"], 0)


FAMILY = FeetechSts()
