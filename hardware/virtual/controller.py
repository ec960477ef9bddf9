"""What goes on inside a servo by itself: watchdog, shutdown, heat, and what a written register sets off."""

from __future__ import annotations

from collections.abc import Callable

from robot_ik.hardware.config import current_unit
from robot_ik.hardware.control_table import HARDWARE_ERRORS, RADIANS_PER_TICK, WATCHDOG_UNIT, OperatingMode
from robot_ik.hardware.virtual import motor
from robot_ik.hardware.virtual.memory import FEEDFORWARD, GAINS, PROFILE, TRIPPED, Memory
from robot_ik.hardware.virtual.motor import PWM_FULL, Electrics
from robot_ik.hardware.virtual.shaft import Shaft
from robot_ik.hardware.x_series import SLAVE, TORQUE_BY_GOAL
from robot_ik.ports import Clock

_ERROR_BITS = {name: 1 << bit for bit, name in HARDWARE_ERRORS.items()}
# Heat and strain change slowly: they are updated no more often than this, s.
_ELECTRICS_PERIOD = 0.02
_NO_POSITION = frozenset(map(int, (OperatingMode.VELOCITY, *motor.TORQUE_MODES)))


class Controller:
    """The firmware's own affairs.

    Attributes:
        electrics: Temperature and strain of the motor.
        booted: When power came, s; ``heard``: when the last instruction packet went over the bus, s.
    """

    def __init__(self, memory: Memory, shaft: Shaft, clock: Clock) -> None:
        self.electrics = Electrics(memory.table.motor, clock.now())
        self.booted = self.heard = clock.now()
        self._memory = memory
        self._values = memory.values
        self._shaft = shaft
        self._clock = clock
        self._current_unit = current_unit(memory.table)

    # ------------------------------------------------------------------------ by itself

    def start(self) -> None:
        """Power came: heat of the motor stays, everything else begins anew."""
        memory = self._memory
        self.booted = self.heard = self._clock.now()
        self.electrics.strain = 0.0
        self._shaft.powered = False
        self._shaft.stop()
        memory.set("present_temperature", min(255, round(self.electrics.temperature)))
        self.stand()

    def stand(self) -> None:
        """Goals as after a start: Goal Position where it stands, the others at their limits or 0."""
        memory = self._memory
        memory.set("goal_position", self._shaft.position_register())
        memory.set("goal_velocity", 0)
        for goal, limit in (("goal_pwm", "pwm_limit"), ("goal_current", "current_limit")):
            if goal in memory.table:
                memory.set(goal, memory.get(limit))

    def update(self) -> None:
        """Lets watchdog and motor act at the time when they do, however late anyone asks."""
        self._update(self._clock.now())

    def hear(self) -> None:
        """An instruction packet went over the bus."""
        now = self._clock.now()
        self._update(now)
        self.heard = now

    def _update(self, now: float) -> None:
        if self._values.get("bus_watchdog", 0) > 0:
            self.watch(now)
        if now - self.electrics.at >= _ELECTRICS_PERIOD:
            self._warm(now)

    def watch(self, now: float) -> None:
        """Lets the bus watchdog run out if it has by ``now``, s."""
        limit = self._values.get("bus_watchdog", 0) if self._values["torque_enable"] else 0
        trip = self.heard + limit * WATCHDOG_UNIT
        if limit > 0 and now > trip:
            self._shaft.brake_at(trip)
            self._memory.set("bus_watchdog", TRIPPED)

    def _warm(self, now: float) -> None:
        electrics, memory = self.electrics, self._memory
        shown = memory.get("present_temperature")
        if shown != min(255, round(electrics.temperature)):
            electrics.temperature = float(shown)  # somebody set it from outside
        electrics.advance(now, self._shaft.torque(), self._shaft.volts)
        memory.set("present_temperature", min(255, round(electrics.temperature)))
        if electrics.strain >= 1.0:
            self.fail("overload")
        if electrics.temperature > memory.get("temperature_limit"):
            self.fail("overheating")

    def fail(self, name: str) -> None:
        """A hardware error: Shutdown says whether torque goes off; either way it is kept until a reboot."""
        memory = self._memory
        memory.set("hardware_error_status", memory.get("hardware_error_status") | _ERROR_BITS[name])
        if self._shut_down():
            self._shaft.stop()
            self._shaft.powered = False
            memory.set("torque_enable", 0)

    def readings(self) -> dict[str, Callable[[], int]]:
        """Registers that are measured, and how."""
        live = {
            **self._shaft.registers(),
            "realtime_tick": lambda: int((self._clock.now() - self.booted) * 1000.0) % 32768,
            "present_pwm": lambda: self._shaft.sign * round(PWM_FULL * self._duty()),
            "present_current": self._current,
            "present_load": lambda: self._shaft.sign * round(1000.0 * self._share()),
        }
        return {name: read for name, read in live.items() if name in self._memory.table}

    def _share(self) -> float:
        return max(-1.0, min(1.0, self._shaft.torque() / self._memory.table.motor.stall_torque))

    def _duty(self) -> float:
        if not self._shaft.powered:
            return 0.0
        shaft = self._shaft
        return self.electrics.duty(shaft.torque(), shaft.speed * RADIANS_PER_TICK, shaft.volts)

    def _current(self) -> int:
        amount = self.electrics.milliamperes(self._shaft.torque(), self._duty()) / self._current_unit
        return self._shaft.sign * max(-32768, min(32767, round(amount)))

    # ------------------------------------------------------------------- by its registers

    def written(self, name: str, had_torque: bool) -> None:
        """What a write sets off."""
        mode = self._values["operating_mode"]
        match name:
            case "torque_enable":
                self._torque_written(had_torque)
            case "goal_position":
                self._goal_written(mode not in _NO_POSITION)
            case "goal_velocity":
                self._goal_written(mode == OperatingMode.VELOCITY)
            case "goal_current" | "goal_pwm":
                # In the other modes it is a limit: what was too weak may be strong enough now.
                self._goal_written(bool(self._values["torque_enable"]) or mode in motor.TORQUE_MODES)
            case "operating_mode":
                for register in (*GAINS, *FEEDFORWARD, *PROFILE):
                    self._memory.set(register, self._memory.table[register].initial or 0)
                self._count_anew()
                self.stand()
            case "drive_mode":
                self._count_anew()

    def torque_on(self) -> None:
        """The motor takes over where the shaft stands."""
        self._memory.set("torque_enable", 1)
        self._shaft.powered = True
        self._shaft.stop()

    def _torque_written(self, had_torque: bool) -> None:
        memory, shaft = self._memory, self._shaft
        if self._shut_down():
            memory.set("torque_enable", 0)
        if not memory.get("torque_enable"):
            shaft.powered = False
            shaft.stop()
        elif not had_torque and self._values.get("bus_watchdog") != TRIPPED:
            self._count_anew()
            self.heard = self._clock.now()
            if not self._slave:
                self.torque_on()
                shaft.go()

    def _goal_written(self, of_this_mode: bool) -> None:
        if not of_this_mode or self._slave:
            return
        values = self._values
        if not values["torque_enable"] and self._drive_mode & TORQUE_BY_GOAL and not self._shut_down():
            self.torque_on()
        if values["torque_enable"]:
            self._shaft.go()

    def _count_anew(self) -> None:
        if self._memory.get("operating_mode") == OperatingMode.POSITION:
            self._shaft.fold()

    @property
    def _drive_mode(self) -> int:
        return self._values.get("drive_mode", 0)

    @property
    def _slave(self) -> bool:
        return bool(self._drive_mode & SLAVE)

    def _shut_down(self) -> bool:
        return bool(self._memory.get("hardware_error_status") & self._memory.get("shutdown"))
