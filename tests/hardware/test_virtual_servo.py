"""A virtual servo: memory rules of the manual, and motion against a numeric integration written apart."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.hardware.control_table import CONTROL_TABLES, OperatingMode, Register
from robot_ik.hardware.virtual.profile import ProfileKind, brake, move
from robot_ik.hardware.virtual.protocol2 import ErrorCode
from robot_ik.hardware.virtual.servo import CLEAR_MULTI_TURN, VirtualServo
from robot_ik.ports import VirtualClock

V_UNIT = 0.229 * 4096 / 60  # ticks/s
A_UNIT = 214.577 * 4096 / 3600  # ticks/s^2
EXTENDED = OperatingMode.EXTENDED_POSITION


class Bench:
    """One servo, its clock, and access to registers by name through the checked way."""

    def __init__(self, model: str = "XM430-W350", **options: object) -> None:
        self.clock = VirtualClock(start=12.0)
        self.servo = VirtualServo(model, 1, self.clock, **options)  # type: ignore[arg-type]

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now() + seconds)

    def write(self, name: str, value: int) -> ErrorCode:
        self.servo.hear()
        register = self.servo.table[name]
        return self.servo.write(register.address, register.encode(value))

    def read(self, name: str) -> int:
        register = self.servo.table[name]
        data, error = self.servo.read(register.address, register.size)
        assert error == ErrorCode.NONE
        return register.decode(data)

    def set(self, **values: int) -> None:
        for name, value in values.items():
            assert self.write(name, value) == ErrorCode.NONE, name


# ------------------------------------------------------------------------------------------ motion


def _integrate(
    x: float, v: float, goal: float, top: float, a: float, samples: list[float], dt: float
) -> list[float]:
    """Braking-distance control in small steps: speed up while there is room to stop, else slow down."""
    found, t = [], 0.0
    for sample in samples:
        while t < sample:
            wanted = math.copysign(min(top, math.sqrt(2 * a * abs(goal - x))), goal - x)
            change = max(-a * dt, min(a * dt, wanted - v))
            x += (v + 0.5 * change) * dt
            v += change
            t += dt
        found.append(x)
    return found


@settings(max_examples=40, deadline=None)
@given(
    distance=st.floats(-3000, 3000),
    v=st.floats(-2000, 2000),
    top=st.floats(100, 2000),
    a=st.floats(500, 20_000),
)
def test_closed_form_is_the_integrated_motion(distance: float, v: float, top: float, a: float) -> None:
    motion = move(0.0, 500.0, v, 500.0 + distance, top, a)
    samples = [motion.end * k / 7 for k in range(1, 8)]
    dt = max(motion.end / 8000, 1e-5)
    found = _integrate(500.0, v, 500.0 + distance, top, a, samples, dt)
    allowed = 1e-6 + 4 * dt * max(top, abs(v)) + 4 * a * dt**2
    for t, x in zip(samples, found, strict=True):
        assert motion.at(t)[0] == pytest.approx(x, abs=allowed)


@settings(deadline=None)
@given(
    goal=st.floats(-1e6, 1e6),
    v=st.floats(-5000, 5000),
    top=st.floats(1, 6000),
    a=st.floats(100, 2e5),
)
def test_motion_laws(goal: float, v: float, top: float, a: float) -> None:
    motion = move(3.0, -70.0, v, goal, top, a)
    assert motion.at(3.0) == (-70.0, pytest.approx(v, abs=1e-6))
    assert motion.at(motion.end) == motion.at(motion.end + 100.0) == (goal, 0.0)
    scale = 1e-9 * (abs(goal) + 1e3) + 1e-6
    times = [3.0 + (motion.end - 3.0) * k / 400 for k in range(401)]
    dt = (motion.end - 3.0) / 400
    previous = motion.at(3.0)
    for t in times[1:]:
        x, speed = motion.at(t)
        assert abs(speed) <= max(top, abs(v)) * (1 + 1e-9) + 1e-6
        assert abs(speed - previous[1]) <= a * dt * (1 + 1e-6) + 1e-6
        # The position has no jump: it changes by what the speeds at both ends allow.
        reach = (max(abs(speed), abs(previous[1])) + a * dt) * dt
        assert abs(x - previous[0]) <= reach + scale
        previous = x, speed


@given(st.floats(-5000, 5000), st.floats(100, 2e5))
def test_brake_stops_within_the_braking_distance(v: float, a: float) -> None:
    motion = brake(1.0, 10.0, v, a)
    x, speed = motion.at(motion.end)
    assert speed == 0.0
    assert x == pytest.approx(10.0 + v * abs(v) / (2 * a))


def test_trapezoid_of_the_manual() -> None:
    """Ramp time t1 = 64 V / A ms and duration d / V + t1, from the manual's profile section."""
    bench = Bench(mode=EXTENDED)
    bench.set(profile_velocity=100, profile_acceleration=20, torque_enable=1, goal_position=2048 + 4096)
    ramp = 0.064 * 100 / 20
    start = bench.clock.now()
    bench.wait(ramp / 2)
    assert bench.read("present_velocity") == pytest.approx(50, abs=1)
    assert bench.read("moving") == 1
    assert bench.read("moving_status") == 0b110010  # trapezoidal, going on
    bench.wait(ramp / 2)
    assert bench.read("present_velocity") == pytest.approx(100, abs=1)
    assert bench.servo.reading - 2048 == pytest.approx(0.5 * 100 * V_UNIT * ramp, rel=2e-3)
    end = start + 4096 / (100 * V_UNIT) + ramp
    bench.clock.sleep_until(end - 0.01)
    assert bench.read("moving_status") & 0b11 == 0b10
    bench.clock.sleep_until(end + 0.01)
    assert bench.read("moving_status") == 0b000001
    assert (bench.read("present_position"), bench.read("moving")) == (6144, 0)


def test_a_short_way_is_a_triangle_and_no_profile_a_step() -> None:
    bench = Bench()
    bench.set(profile_velocity=100, profile_acceleration=10, torque_enable=1, goal_position=2100)
    assert bench.read("moving_status") >> 4 == ProfileKind.TRIANGULAR
    bench.wait(5.0)
    bench.set(profile_acceleration=0, goal_position=3000)
    assert bench.read("moving_status") >> 4 == ProfileKind.RECTANGULAR
    bench.wait(5.0)
    bench.set(profile_velocity=0, goal_position=1000)
    assert bench.read("moving_status") >> 4 == ProfileKind.STEP
    # Even a step is no faster than the motor: half a turn at 350 * 0.229 rev/min.
    bench.wait(2000 / (350 * V_UNIT))
    assert 1000 < bench.servo.reading < 1150
    bench.wait(0.1)
    assert bench.read("present_position") == 1000


def test_time_based_profile_takes_its_time() -> None:
    bench = Bench()
    bench.set(drive_mode=4)
    bench.set(profile_velocity=2000, profile_acceleration=500, torque_enable=1, goal_position=4000)
    bench.wait(1.0)
    assert bench.servo.reading == pytest.approx((2048 + 4000) / 2)
    bench.wait(0.99)
    assert bench.read("moving_status") & 2
    bench.wait(0.011)
    assert (bench.read("moving_status") & 3, bench.read("present_position")) == (1, 4000)


def test_a_ramp_is_at_most_half_the_time() -> None:
    bench = Bench()
    bench.set(drive_mode=4)
    bench.set(profile_velocity=2000, profile_acceleration=1900, torque_enable=1, goal_position=4000)
    bench.wait(1.0)
    assert bench.servo.reading == pytest.approx((2048 + 4000) / 2)
    assert bench.read("present_velocity") == pytest.approx(2 * 1952 / 2.0 / V_UNIT, abs=1)
    bench.wait(1.001)
    assert bench.read("moving_status") & 3 == 1


def test_how_often_it_is_asked_changes_nothing() -> None:
    often, rarely = Bench(mode=EXTENDED), Bench(mode=EXTENDED)
    for bench in (often, rarely):
        bench.set(profile_velocity=60, profile_acceleration=5, torque_enable=1, goal_position=9000)
    for _ in range(1000):
        often.wait(0.001)
        often.read("present_position")
    rarely.clock.sleep_until(often.clock.now())
    assert often.servo.reading == rarely.servo.reading


def test_a_new_goal_on_the_way_keeps_the_speed() -> None:
    bench = Bench(mode=EXTENDED)
    bench.set(profile_velocity=100, profile_acceleration=20, torque_enable=1, goal_position=20_000)
    bench.wait(1.0)
    before = bench.servo.reading
    bench.set(goal_position=0)
    assert (bench.servo.reading, bench.read("present_velocity")) == (before, 100)
    bench.wait(0.1)
    assert bench.servo.reading > before  # it cannot turn back at once
    bench.wait(30.0)
    assert bench.read("present_position") == 0


def test_velocity_mode_turns_until_told_otherwise() -> None:
    bench = Bench()
    bench.set(operating_mode=OperatingMode.VELOCITY, torque_enable=1, goal_velocity=-100)
    bench.wait(10.0)
    assert bench.read("present_velocity") == -100
    assert bench.servo.reading == pytest.approx(2048 - 1000 * V_UNIT, rel=1e-2)
    bench.set(goal_velocity=0)
    bench.wait(1.0)
    assert bench.read("present_velocity") == 0


# ------------------------------------------------------------------------------------------ memory


def fits(register: Register, value: int) -> bool:
    """The bytes of the register can say this value at all."""
    try:
        register.encode(value)
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("model", CONTROL_TABLES)
def test_every_register_starts_as_the_manual_says(model: str) -> None:
    bench = Bench(model)
    own = {"id", "baud_rate", "operating_mode"}
    for register in bench.servo.table:
        if register.initial is not None and register.name not in own:
            assert bench.read(register.name) == register.initial, register.name
    assert bench.read("goal_position") == bench.read("present_position") == 2048


@pytest.mark.parametrize("model", CONTROL_TABLES)
def test_every_register_keeps_its_range_and_access(model: str) -> None:
    bench = Bench(model)
    for register in bench.servo.table:
        # Pointers would redirect the data registers behind them; the others have rules of their own,
        # tested below.
        if register.name.startswith(("indirect_address", "goal_", "operating", "drive", "torque", "bus_")):
            continue
        if not register.writable:
            value = bench.read(register.name)
            assert bench.write(register.name, value) == ErrorCode.ACCESS, register.name
            continue
        for value in (register.minimum, register.maximum):
            assert bench.write(register.name, value) == ErrorCode.NONE, register.name
            assert bench.read(register.name) == value
        for value in (register.minimum - 1, register.maximum + 1):
            if fits(register, value):
                assert bench.write(register.name, value) == ErrorCode.DATA_RANGE, register.name
                assert bench.read(register.name) == register.maximum


def test_eeprom_is_locked_while_torque_is_on() -> None:
    bench = Bench()
    bench.set(torque_enable=1)
    assert bench.write("return_delay_time", 0) == ErrorCode.ACCESS
    assert bench.read("return_delay_time") == 250
    assert bench.write("led", 1) == ErrorCode.NONE
    bench.set(torque_enable=0, return_delay_time=0)
    assert bench.read("return_delay_time") == 0


@pytest.mark.parametrize(
    "address,data,error",
    [
        (116, b"\x00\x08", ErrorCode.DATA_LENGTH),  # half of goal position
        (117, b"\x00\x08\x00\x00", ErrorCode.DATA_LENGTH),  # begins inside it
        (116, b"", ErrorCode.DATA_LENGTH),
        (148, b"\x00", ErrorCode.ACCESS),  # no register
        (5000, b"\x00", ErrorCode.ACCESS),  # no memory
        (132, b"\x00\x08\x00\x00", ErrorCode.ACCESS),  # present position
        (65, b"\x02", ErrorCode.DATA_RANGE),
    ],
)
def test_wrong_writes_change_nothing(address: int, data: bytes, error: ErrorCode) -> None:
    bench = Bench()
    before = bench.servo.read(0, 148)
    assert bench.servo.write(address, data) == error
    assert bench.servo.read(0, 148) == before


def test_one_write_over_several_registers_is_all_or_nothing() -> None:
    bench = Bench()
    good = b"".join(v.to_bytes(4, "little") for v in (30, 40, 3000))
    assert bench.servo.write(108, good) == ErrorCode.NONE
    names = ("profile_acceleration", "profile_velocity", "goal_position")
    assert [bench.read(n) for n in names] == [30, 40, 3000]
    bad = b"".join(v.to_bytes(4, "little") for v in (31, 41, 5000))
    assert bench.servo.write(108, bad) == ErrorCode.DATA_LIMIT
    assert [bench.read(n) for n in names] == [30, 40, 3000]


@pytest.mark.parametrize("address,length", [(148, 4), (662, 1), (0, 0), (600, 100)])
def test_reads_of_nothing_are_refused(address: int, length: int) -> None:
    data, error = Bench().servo.read(address, length)
    assert data == b"" and error != ErrorCode.NONE


@pytest.mark.parametrize("model", CONTROL_TABLES)
def test_indirect_data_are_other_registers(model: str) -> None:
    bench = Bench(model)
    present, goal = bench.servo.table["present_position"], bench.servo.table["goal_position"]
    for k in range(4):
        bench.set(
            **{
                f"indirect_address_{k + 1}": present.address + k,
                f"indirect_address_{k + 5}": goal.address + k,
            }
        )
    first = bench.servo.table["indirect_data_1"].address
    data, error = bench.servo.read(first, 8)
    assert error == ErrorCode.NONE
    assert (present.decode(data[:4]), goal.decode(data[4:])) == (2048, 2048)
    assert bench.servo.write(first + 4, goal.encode(2222)) == ErrorCode.NONE
    assert bench.read("goal_position") == 2222
    assert bench.servo.write(first + 4, goal.encode(9999)) == ErrorCode.DATA_LIMIT
    assert bench.servo.write(first, present.encode(0)) == ErrorCode.ACCESS


def test_one_turn_mode_obeys_the_position_limits_and_extended_does_not() -> None:
    bench = Bench()
    bench.set(min_position_limit=1000, max_position_limit=3000)
    assert bench.write("goal_position", 999) == ErrorCode.DATA_LIMIT
    assert bench.write("goal_position", 3001) == ErrorCode.DATA_LIMIT
    bench.set(operating_mode=EXTENDED)
    for goal in (-1_048_575, 999, 1_048_575):
        assert bench.write("goal_position", goal) == ErrorCode.NONE
    assert bench.write("goal_position", 1_048_576) == ErrorCode.DATA_RANGE


@pytest.mark.parametrize("name,limit", [("goal_velocity", 350), ("goal_pwm", 885), ("goal_current", 1193)])
def test_goals_end_at_the_limit_registers(name: str, limit: int) -> None:
    bench = Bench()
    assert bench.write(name, limit) == bench.write(name, -limit) == ErrorCode.NONE
    bench.set(**{name.removeprefix("goal_") + "_limit": limit - 10})
    assert bench.write(name, limit) == bench.write(name, -limit) == ErrorCode.DATA_LIMIT
    assert bench.read(name) == -limit


def test_drive_mode_has_the_bits_of_the_model() -> None:
    bench = Bench()
    assert bench.write("drive_mode", 2) == ErrorCode.DATA_RANGE  # the slave bit is for larger servos
    assert bench.write("drive_mode", 13) == ErrorCode.NONE


def test_torque_by_goal() -> None:
    bench = Bench()
    bench.set(drive_mode=8, goal_position=3000)
    assert bench.read("torque_enable") == 1
    bench.wait(5.0)
    assert bench.read("present_position") == 3000
    bench.servo.inject_error("overload")
    bench.set(goal_position=1000)
    assert bench.read("torque_enable") == 0


def test_an_indirect_address_out_of_the_table_points_nowhere() -> None:
    bench = Bench()
    bench.set(indirect_address_1=65535, indirect_data_1=77)
    assert bench.read("indirect_data_1") == 77


@pytest.mark.parametrize("model,mode,error", [
    ("XM430-W350", 0, ErrorCode.DATA_RANGE),  # exists, but there is no motor to put a current through
    ("XM430-W350", 2, ErrorCode.DATA_RANGE),
    ("XM430-W350", 5, ErrorCode.NONE),
    ("XL430-W250", 5, ErrorCode.DATA_RANGE),  # the model has no current sensor
    ("XL430-W250", 4, ErrorCode.NONE),
])  # fmt: skip
def test_modes(model: str, mode: int, error: ErrorCode) -> None:
    assert Bench(model).write("operating_mode", mode) == error


def test_a_mode_change_resets_gains_and_profile() -> None:
    bench = Bench()
    bench.set(profile_velocity=50, profile_acceleration=7, position_p_gain=900, operating_mode=EXTENDED)
    names = ("profile_velocity", "profile_acceleration", "position_p_gain")
    assert [bench.read(n) for n in names] == [0, 0, 800]


@pytest.mark.parametrize("offset,mode,reading", [
    (500, OperatingMode.POSITION, 2548),
    (-1024, OperatingMode.POSITION, 1024),
    (1025, OperatingMode.POSITION, 2048),  # beyond a quarter turn: ignored
    (1025, EXTENDED, 3073),
    (-9000, EXTENDED, -6952),
])  # fmt: skip
def test_homing_offset(offset: int, mode: OperatingMode, reading: int) -> None:
    bench = Bench(mode=mode)
    bench.set(homing_offset=offset)
    assert bench.read("present_position") == reading
    assert bench.servo.true_ticks == 2048.0  # nothing turned
    bench.set(torque_enable=1, goal_position=reading + 100)
    bench.wait(5.0)
    assert bench.servo.true_ticks == 2148.0


def test_reverse_turns_the_other_way() -> None:
    bench = Bench(mode=EXTENDED, position_ticks=100)
    bench.set(drive_mode=1)
    assert bench.read("present_position") == -100
    bench.set(torque_enable=1, profile_velocity=100, goal_position=-100 + 500)
    bench.wait(0.1)
    assert bench.read("present_velocity") > 0
    bench.wait(5.0)
    assert (bench.read("present_position"), bench.servo.true_ticks) == (400, -400.0)


def test_one_turn_mode_reads_within_a_turn() -> None:
    bench = Bench(mode=EXTENDED, position_ticks=-100)
    assert bench.read("present_position") == -100
    bench.set(operating_mode=OperatingMode.POSITION)
    assert bench.read("present_position") == 3996
    assert bench.servo.true_ticks == -100.0
    assert Bench(position_ticks=4095.7).read("present_position") == 0


# ------------------------------------------------------------------------------------------ torque


def test_without_torque_nothing_moves_and_torque_on_goes_to_the_stale_goal() -> None:
    bench = Bench()
    bench.set(goal_position=3000)
    bench.wait(5.0)
    assert bench.read("present_position") == 2048
    bench.set(torque_enable=1)
    bench.wait(5.0)
    assert bench.read("present_position") == 3000


def test_torque_off_stops_on_the_way() -> None:
    bench = Bench(mode=EXTENDED)
    bench.set(profile_velocity=50, torque_enable=1, goal_position=20_000)
    bench.wait(1.0)
    bench.set(torque_enable=0)
    held = bench.read("present_position")
    bench.wait(5.0)
    assert 2048 < bench.read("present_position") == held < 20_000
    assert bench.read("moving") == 0


def test_a_hand_turns_it_only_without_torque() -> None:
    bench = Bench(mode=EXTENDED)
    bench.servo.turn_by_hand(-3000.0)
    assert bench.read("present_position") == -952
    bench.set(goal_position=-952, torque_enable=1)
    bench.servo.turn_by_hand(500.0)
    assert bench.read("present_position") == -952


def test_bus_watchdog_counts_silence_with_torque_only() -> None:
    bench = Bench(mode=EXTENDED)
    bench.set(bus_watchdog=5)
    bench.wait(10.0)
    assert bench.read("bus_watchdog") == 5  # torque is off
    bench.set(torque_enable=1, profile_velocity=50, goal_position=20_000)
    for _ in range(20):
        bench.wait(0.09)
        bench.servo.hear()  # any instruction keeps it quiet
    assert bench.read("bus_watchdog") == 5
    before = bench.servo.reading
    bench.wait(60.0)
    at_trip = before + 0.1 * 50 * V_UNIT
    assert bench.servo.reading == pytest.approx(at_trip, abs=3.0)  # it stopped then, not when it was asked
    assert bench.read("bus_watchdog") == -1
    assert bench.read("torque_enable") == 1
    for goal in ("goal_position", "goal_velocity", "goal_pwm", "goal_current"):
        assert bench.write(goal, 1) == ErrorCode.DATA_RANGE
    assert bench.write("bus_watchdog", 5) == ErrorCode.DATA_RANGE
    bench.set(bus_watchdog=0, goal_position=3000)
    bench.wait(20.0)
    assert bench.read("present_position") == 3000


def test_overload_shuts_down_until_reboot() -> None:
    bench = Bench(mode=EXTENDED)
    bench.set(profile_velocity=50, torque_enable=1, goal_position=20_000)
    bench.wait(1.0)
    bench.servo.inject_error("overload")
    held = bench.read("present_position")
    bench.wait(1.0)
    assert bench.read("present_position") == held
    assert (bench.read("torque_enable"), bench.read("hardware_error_status")) == (0, 32)
    assert bench.servo.status_byte(0) == 0x80
    bench.write("torque_enable", 1)
    assert bench.read("torque_enable") == 0
    bench.servo.reboot()
    assert bench.servo.status_byte(0) == 0
    bench.set(torque_enable=1)
    assert bench.read("torque_enable") == 1


def test_an_error_that_shutdown_does_not_name_only_alerts() -> None:
    bench = Bench()
    bench.set(torque_enable=1)
    bench.servo.inject_error("input_voltage")  # bit 0 is not in 52
    assert (bench.read("torque_enable"), bench.servo.status_byte(0)) == (1, 0x80)


def test_reboot_forgets_turns_and_ram_but_not_eeprom() -> None:
    bench = Bench(mode=EXTENDED, position_ticks=10_000)
    bench.set(return_delay_time=7, profile_velocity=50, led=1, torque_enable=1)
    bench.wait(1.0)
    bench.servo.reboot()
    assert bench.read("present_position") == bench.read("goal_position") == 10_000 % 4096
    names = ("profile_velocity", "led", "torque_enable", "realtime_tick", "return_delay_time")
    assert [bench.read(n) for n in names] == [0, 0, 0, 0, 7]
    assert bench.servo.true_ticks == 10_000.0


@pytest.mark.parametrize("option,kept", [(0xFF, (1, 1)), (1, (9, 1)), (2, (9, 3))])
def test_factory_reset_keeps_what_is_asked(option: int, kept: tuple[int, int]) -> None:
    bench = Bench()
    bench.set(id=9, return_delay_time=3)
    assert bench.servo.factory_reset(option) == ErrorCode.NONE
    assert (bench.read("id"), bench.read("baud_rate")) == kept
    assert bench.read("return_delay_time") == 250
    assert bench.servo.factory_reset(77) == ErrorCode.DATA_RANGE


def test_clear_multi_turn_only_at_a_stand() -> None:
    bench = Bench(mode=EXTENDED, position_ticks=-5000)
    bench.set(torque_enable=1, profile_velocity=50, goal_position=-4000)
    bench.wait(0.2)
    assert bench.servo.clear(CLEAR_MULTI_TURN) == ErrorCode.RESULT_FAIL
    bench.wait(10.0)
    assert bench.servo.clear(b"\x01") == ErrorCode.DATA_RANGE
    assert bench.servo.clear(CLEAR_MULTI_TURN) == ErrorCode.NONE
    assert bench.read("present_position") == 96
    bench.wait(1.0)
    assert bench.servo.true_ticks == -4000.0


def test_realtime_tick_wraps() -> None:
    bench = Bench()
    bench.wait(1.25)
    assert bench.read("realtime_tick") == 1250
    bench.wait(32.0)
    assert bench.read("realtime_tick") == 33250 - 32768


# ---------------------------------------------------------------------------------- hidden faults


def test_zero_offset_is_seen_by_nobody_on_the_bus() -> None:
    bench = Bench(zero_offset_ticks=22.75)
    assert bench.read("present_position") == 2048
    bench.set(torque_enable=1, goal_position=3000)
    bench.wait(5.0)
    assert bench.read("present_position") == 3000
    assert bench.servo.true_ticks == 3022.75


def test_a_stuck_shaft_reports_where_it_is() -> None:
    bench = Bench()
    bench.set(torque_enable=1, profile_velocity=50, goal_position=4000)
    bench.wait(0.5)
    bench.servo.stuck = True
    held = bench.servo.true_ticks
    bench.wait(10.0)
    assert bench.servo.true_ticks == held
    assert bench.read("present_position") == round(held)
    assert bench.read("position_trajectory") == 4000
    assert bench.read("moving_status") & 0b1001 == 0b1000  # not in position, following error
    bench.servo.stuck = False
    assert bench.servo.true_ticks == held
    bench.wait(10.0)
    assert bench.read("present_position") == 4000
