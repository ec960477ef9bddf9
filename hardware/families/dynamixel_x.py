"""Dynamixel X series: set-up, speed limits, errors.  Protocol 2, two's complement."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace

from robot_ik.errors import BusTimeoutError, HardwareError, ServoRefusedError
from robot_ik.hardware.arm_registers import read_all
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import (
    ACCELERATION_UNIT,
    BAUD_RATES,
    HOMING_FIXES,
    POSITION_MODE_HOMING,
    RETURN_ALL,
    REVERSE,
    TRIPPED,
    VELOCITY_UNIT,
    X_SERIES,
    hardware_error_names,
)
from robot_ik.hardware.family import Capabilities, CycleBlock
from robot_ik.hardware.protocol2 import PROTOCOL_2
from robot_ik.hardware.register_access import (
    check_position_limits,
    set_eeprom,
    sync_set,
    write_register,
)
from robot_ik.hardware.registers import ControlTable, OperatingMode, Register
from robot_ik.hardware.servo import GRIPPER, Drive, Joint
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS

log = logging.getLogger(__name__)

NO_SECONDARY_ID = 255
"""Secondary ID of a servo that obeys its own id only."""

SPEED_HEADROOM = 1.5
"""Profile Velocity over the joint's speed limit: the servo can catch up after a lost cycle."""

RAMP_SHARE = 0.25
"""Share of a control period in which the servo reaches its speed, to follow without lag."""

SMALLEST_STRENGTH = 0.25
"""Share of its voltage below which a servo is refused.  The weight of an arm needs this torque."""

SMALLEST_GRIP = 0.02
"""The same for a gripper, which may press softly and carries no arm."""

FULL_EFFORT = 128 * 885
"""Ticks behind times Position P Gain at which a servo gives all its PWM.

ROBOTIS-GIT/emanual _includes/en/dxl/x/position_pid_gain.md: the gain is the register over 128.
"""

LARGEST_PROFILE = 32767
"""Largest value of both profile registers."""

CYCLE_REGISTERS = ("torque_enable", "present_velocity", "present_position")
"""Registers that every control cycle reads."""

SHORT_VELOCITY_SIZE = 2
"""Bytes of Present Velocity that a control cycle reads: the lower two of four.

They hold 32767 counts in both directions. The largest Velocity Limit of a model is 2047.
"""


class DynamixelX:
    """Dynamixel X series; implements ``ServoFamily``."""

    name = "dynamixel_x"
    title = "Dynamixel X"
    baud_rates = tuple(BAUD_RATES.values())
    common_table = X_SERIES
    changing_registers = ("present_position", "realtime_tick")
    velocity_unit = VELOCITY_UNIT
    protocol = PROTOCOL_2
    capabilities = Capabilities(
        bus_watchdog=True,
        goal_enables_torque=False,
        current_goal=True,
        reboot_clears_errors=True,
        indirect_addresses=True,
    )
    mode_values: Mapping[OperatingMode, int] = {mode: int(mode) for mode in OperatingMode}
    unprotected_exit = "the servos stop by themselves after watchdog_ms and hold their position"

    def prepare(self, bus: ServoBus, config: ArmConfig) -> None:
        for drive in config.drives:
            self._answer_everything(bus, drive)

    def _answer_everything(self, bus: ServoBus, drive: Drive) -> None:
        """Set Status Return Level 2.  A servo with level 0 or 1 seems to be absent."""
        servo = drive.servo
        register = servo.table["status_return_level"]
        with contextlib.suppress(BusTimeoutError):  # level 0: the servo answers no read
            if bus.read(servo.id, register).data == RETURN_ALL:
                return
        with contextlib.suppress(BusTimeoutError):  # level 1: the servo answers no write
            bus.write(servo.id, register, RETURN_ALL)
        if bus.read(servo.id, register).data != RETURN_ALL:
            raise HardwareError(
                f"servo id {servo.id} (joint {drive.name!r}) keeps its status return level"
            )

    def watchdog_tripped(self, bus: ServoBus, drive: Drive, /) -> bool:
        """Return whether Bus Watchdog has run out.  Firmware before 38 has none."""
        servo = drive.servo
        return "bus_watchdog" in servo.table and (
            bus.read(servo.id, servo.table["bus_watchdog"]).data == TRIPPED
        )

    def clear_watchdog(self, bus: ServoBus, config: ArmConfig, drive: Drive) -> None:
        """Clear a bus watchdog that is armed or has tripped.

        A tripped one makes the servo refuse goals.
        """
        servo = drive.servo
        watchdog = servo.table["bus_watchdog"]
        try:
            if bus.read(servo.id, watchdog).data != 0:
                bus.write(servo.id, watchdog, 0)
        except ServoRefusedError:
            if config.watchdog_ms:
                raise HardwareError(
                    f"servo id {servo.id} (joint {drive.name!r}) has no bus watchdog; nothing was "
                    f"switched on",
                    hint="firmware before 38 has none: update it, or set watchdog_ms = 0 and stay "
                    "beside the arm",
                ) from None

    def arm_watchdog(self, bus: ServoBus, config: ArmConfig) -> None:
        """Make every servo stop by itself when the bus is silent for ``watchdog_ms``.

        Raises:
            HardwareError: A servo did not accept the value.
        """
        value = config.watchdog_ms // WATCHDOG_UNIT_MS
        failed = sync_set(bus, config, "bus_watchdog", dict.fromkeys(config.servo_ids, value))
        if failed:
            names = ", ".join(dict.fromkeys(drive.name for drive in failed))
            raise HardwareError(
                f"{names} did not take the bus watchdog",
                hint="power-cycle the servos and try again",
            )

    def error_names(self, value: int) -> tuple[str, ...]:
        return hardware_error_names(value)

    def set_up(self, bus: ServoBus, config: ArmConfig) -> None:
        torque = read_all(bus, config, "torque_enable")
        drive_mode = read_all(bus, config, "drive_mode", absent=0)
        for drive in config.drives:
            self._check_reverse(drive, bool(drive_mode[drive.id] & REVERSE))
        self._check_homing(bus, config)
        settings = {
            "return_delay_time": dict.fromkeys(config.servo_ids, 0),
            "drive_mode": {id: value & REVERSE for id, value in drive_mode.items()},
            "operating_mode": {servo.id: self.mode_values[servo.mode] for servo in config.servos},
            # Otherwise a servo that restarts may switch torque on with none of the settings below.
            "startup_configuration": dict.fromkeys(config.servo_ids, 0),
        }
        for name, values in settings.items():
            set_eeprom(bus, config, name, values, torque)
        self._check_shadows(bus, config)
        self._check_position_limits(bus, config)
        self._set_current_limits(bus, config, torque)
        for drive in config.drives:
            for name, value in drive.servo.gains.registers.items():
                write_register(bus, drive, name, value)
        self.limit_speed(bus, config)

    def check_strength(self, bus: ServoBus, config: ArmConfig) -> None:
        """Check that every servo can hold the arm.

        Another program may have left a gain of 0, a small Goal PWM (RAM) or a small PWM Limit
        (EEPROM).  Such a servo has torque on and lets the joint fall.  Nothing is changed here,
        because a small value may be intended.
        """
        names = ("position_p_gain", "goal_pwm", "pwm_limit")
        gains, goals, limits = (read_all(bus, config, name) for name in names)
        for drive in config.drives:
            servo = drive.servo
            where = drive.label
            if not gains[servo.id]:
                raise HardwareError(
                    f"{where} has Position P Gain 0 and would not follow its goals; nothing was "
                    "switched on",
                    hint="set position_p in its [joints.gains] table; a power cycle undoes what a "
                    "program wrote",
                )
            goal = abs(goals[servo.id])
            limit = limits[servo.id]
            share = min(goal, limit) / servo.table["pwm_limit"].maximum
            text = (
                f"{where} may use {100 * share:.0f} % of its voltage "
                f"(Goal PWM {goal}, PWM Limit {limit})"
            )
            if share < (SMALLEST_GRIP if drive.joint.group == GRIPPER else SMALLEST_STRENGTH):
                raise HardwareError(
                    f"{text} and could not hold the arm; nothing was switched on",
                    hint="a power cycle resets its Goal PWM; DYNAMIXEL Wizard 2 sets PWM Limit",
                )
            if share < 1.0:
                log.warning("%s: it is weaker than its model", text)

    def check_protection(self, bus: ServoBus, config: ArmConfig) -> None:
        """Warn of servos whose Shutdown is 0: overload and heat do not switch their torque off."""
        masks = read_all(bus, config, "shutdown")
        names = [drive.name for drive in config.drives if not masks[drive.id]]
        if names:
            log.warning(
                "%s: Shutdown is 0, so no overload and no heat switches torque off",
                ", ".join(names),
            )

    def _check_position_limits(self, bus: ServoBus, config: ArmConfig) -> None:
        """In position mode a servo refuses goals outside its limits.

        A sync write has no reply that reports the refusal.
        """
        drives = [drive for drive in config.drives if drive.servo.is_single_turn]
        check_position_limits(bus, config, drives)

    def _check_reverse(self, drive: Drive, is_reversed: bool) -> None:
        """Drive Mode bit 0 reverses position, goal and limits.

        The driver accepts it and never changes it.
        """
        servo = drive.servo
        if servo.reverse is None or servo.reverse == is_reversed:
            return
        where = drive.label
        table = "[joints.twin]" if drive.is_shadow else "[[joints]]"
        if is_reversed:
            raise HardwareError(
                f"{where} is set to turn in reverse (Drive Mode bit 0), and the arm file says "
                f"nothing of it",
                hint=f"if the arm's maker has set it: reverse = true in its {table} table, usually "
                f"with "
                "direction = 1 and zero_ticks = 2048; else clear it in the servo",
            )
        raise HardwareError(
            f"{where} has reverse = true in the arm file, and bit 0 of its Drive Mode is clear",
            hint=f"reverse = false in its {table} table and another `direction`; or set the bit in "
            f"the servo, "
            "as its maker does",
        )

    def _check_homing(self, bus: ServoBus, config: ArmConfig) -> None:
        """In position mode a servo ignores a Homing Offset beyond a quarter revolution.

        ROBOTIS-GIT/emanual _includes/en/dxl/control_table_homingoffset.md.  LeRobot writes such
        offsets.
        """
        offsets = read_all(bus, config, "homing_offset")
        for drive in config.drives:
            offset = offsets[drive.id]
            if drive.servo.is_single_turn and abs(offset) > POSITION_MODE_HOMING:
                problem = (
                    f"{drive.name!r} (servo id {drive.id}) has a Homing Offset of {offset} ticks, "
                    "which servos in position mode ignore"
                )
                raise config.wrong_joint(drive.joint, problem, "mode", HOMING_FIXES)

    def _check_shadows(self, bus: ServoBus, config: ArmConfig) -> None:
        """A shadow must obey its servo's goals, and no other servo may."""
        secondary_ids = read_all(bus, config, "secondary_id", absent=NO_SECONDARY_ID)
        for drive in config.drives:
            value = secondary_ids[drive.id]
            expected_id = drive.servo.primary_id
            if value != expected_id and (expected_id is not None or value in config.servo_ids):
                expected = "but it is no shadow in the arm file"
                if expected_id is not None:
                    expected = f"but it is the shadow of id {expected_id} in the arm file"
                secondary_id = NO_SECONDARY_ID if expected_id is None else expected_id
                raise HardwareError(
                    f"servo id {drive.id} (joint {drive.name!r}) has secondary id {value}, "
                    f"{expected}",
                    hint=f"set its Secondary ID to {secondary_id}, or correct the arm file",
                )

    def _set_current_limits(
        self, bus: ServoBus, config: ArmConfig, torque: Mapping[int, int]
    ) -> None:
        limited = [joint.name for joint in config.joints if joint.servo.current_limit is not None]
        if not limited:
            return
        arm = config.only(limited)
        counts = {
            servo.id: int((servo.current_limit or 0.0) / servo.table.current_unit)
            for servo in arm.servos
        }
        set_eeprom(bus, arm, "current_limit", counts, torque)

    def limit_speed(self, bus: ServoBus, config: ArmConfig) -> None:
        profiles = {drive.id: self._profile(drive.joint, config.rate_hz) for drive in config.drives}
        for name in ("profile_acceleration", "profile_velocity"):
            values = {id: profile[name] for id, profile in profiles.items()}
            failed = sync_set(bus, config, name, values)
            if failed:
                names = ", ".join(dict.fromkeys(drive.name for drive in failed))
                raise HardwareError(
                    f"{name} of {names} was written and reads back otherwise; no torque was changed"
                )

    def _profile(self, joint: Joint, rate_hz: float) -> dict[str, int]:
        """Return the profile registers of a servo for the joint's limits."""
        # Swing arm: the position where the finger is slowest decides.
        gear = 1.0 / joint.levers[0]
        speed = gear * (joint.profile_velocity or SPEED_HEADROOM * joint.velocity)
        ramp = speed * rate_hz / RAMP_SHARE
        if joint.profile_acceleration is not None:
            ramp = gear * joint.profile_acceleration
        counts = {
            "profile_acceleration": math.ceil(ramp / ACCELERATION_UNIT),
            "profile_velocity": math.ceil(speed / VELOCITY_UNIT),
        }
        return {name: min(max(count, 1), LARGEST_PROFILE) for name, count in counts.items()}

    def forgot_speed(self, bus: ServoBus, config: ArmConfig) -> Drive | None:
        velocity = read_all(bus, config, "profile_velocity")
        return next((drive for drive in config.drives if not velocity[drive.id]), None)

    def plain_block(self, table: ControlTable) -> CycleBlock:
        """From torque to temperature: the same 83 bytes in every model."""
        block = table.block("torque_enable", "present_temperature")
        names = (*CYCLE_REGISTERS, *_health_registers(table))
        return CycleBlock(block, tuple(table[name] for name in names))

    def short_block(
        self, bus: ServoBus, id: int, table: ControlTable, *, with_health: bool
    ) -> CycleBlock:
        """Point the indirect addresses at torque, velocity and position.

        The block has 7 bytes, with health 12.
        """
        names = (*CYCLE_REGISTERS, *_health_registers(table)) if with_health else CYCLE_REGISTERS
        registers = [table[name] for name in names]
        velocity = names.index("present_velocity")
        registers[velocity] = replace(registers[velocity], size=SHORT_VELOCITY_SIZE)
        addresses = [a for register in registers for a in range(register.address, register.end)]
        first = table["indirect_address_1"].address
        pointers = Register("indirect addresses", first, 2 * len(addresses), writable=True)
        data = b"".join(address.to_bytes(2, "little") for address in addresses)
        value = int.from_bytes(data, "little")
        if bus.read(id, pointers).data != value:
            bus.write(id, pointers, value)
            if bus.read(id, pointers).data != value:
                raise HardwareError("the indirect addresses read back with other values")

        begin = table["indirect_data_1"].address
        block = Register("torque, motion and health", begin, len(addresses), signed=True)
        parts = [
            replace(register, address=begin + addresses.index(register.address))
            for register in registers
        ]
        return CycleBlock(block, tuple(parts))

    def state_blocks(self, table: ControlTable) -> tuple[Register, ...]:
        return (
            table.block(_effort_register(table), "present_temperature"),
            table.block("torque_enable", "hardware_error_status"),
        )

    def write_address(
        self, bus: ServoBus, table: ControlTable, at: int, id: int, baud: int
    ) -> None:
        """Write the id before the rate: if the line breaks between, the old rate still holds."""
        if bus.read(at, table["return_delay_time"]).data:
            bus.write(at, table["return_delay_time"], 0)
        if at != id:
            bus.write(at, table["id"], id)
            bus.ping(id)
        if bus.read(id, table["baud_rate"]).data != table.baud_code(baud):
            bus.write(id, table["baud_rate"], table.baud_code(baud))

    def eeprom_unlocked(
        self, _bus: ServoBus, _ids: Collection[int]
    ) -> AbstractContextManager[None]:
        """Return an empty context: the EEPROM is open while torque is off."""
        return contextlib.nullcontext()

    def home_half_turn(self, bus: ServoBus, config: ArmConfig) -> None:
        """Do nothing: extended position mode counts beyond one revolution."""

    def is_in_control(self, values: Mapping[str, int]) -> bool:
        return bool(values["torque_enable"])

    def load_lag(self, position_p_gain: int) -> float:
        return FULL_EFFORT / position_p_gain if position_p_gain else 0.0

    def reset(self, bus: ServoBus, drive: Drive) -> None:
        bus.reboot(drive.id)


def _effort_register(table: ControlTable) -> str:
    """Return the register of the motor's effort: current, or load if no current is measured."""
    return "present_current" if "present_current" in table else "present_load"


def _health_registers(table: ControlTable) -> tuple[str, ...]:
    """Return the registers that thresholds watch."""
    return (_effort_register(table), "present_temperature", "present_input_voltage")


FAMILY = DynamixelX()
