"""[joints.stop_at]: an arm stops before a servo shuts itself down, without a longer cycle."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.errors import MotorFaultError
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.feedback import MIN_SAMPLES, SUSTAINED, Thresholds
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Drive, StopAt
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock
from tests.hardware.joints import make_joint

HOT = StopAt(temperature_c=60.0)


def watching(config: ArmConfig, stops: dict[int, StopAt]) -> ArmConfig:
    joints = [
        dataclasses.replace(joint, stop_at=stops.get(joint.servo.id, StopAt()))
        for joint in config.joints
    ]
    return dataclasses.replace(config, joints=tuple(joints))


def fix(servo: VirtualServo, register: str, value: int) -> None:
    """From here on a register reads what the test says, whatever its motor does."""
    servo._live = [(r, (lambda: value) if r.name == register else read) for r, read in servo._live]
    if register == "present_temperature":
        servo.electrics.temperature = value
    servo.memory.set(register, value)
    servo._plans.clear()


# joint id, threshold, register and the value at which it stands, status
CASES = [
    (1, StopAt(temperature_c=60.0), "present_temperature", 61, 60, "temperature_limit"),
    (1, StopAt(current_ma=500.0), "present_current", 187, 185, "current_limit"),  # 2.69 mA a count
    (1, StopAt(current_ma=500.0), "present_current", -187, -185, "current_limit"),
    (4, StopAt(load_percent=40.0), "present_load", 401, 400, "load_limit"),  # 0.1 % a count
    (4, StopAt(load_percent=40.0, temperature_c=60.0), "present_load", -401, 400, "load_limit"),
]


@pytest.mark.parametrize(("id", "stop", "register", "beyond", "within", "status"), CASES)
def test_a_servo_beyond_its_threshold_stops_the_arm_which_holds(
    arm_config, stream, start, id, stop, register, beyond, within, status
):
    with open_arm(watching(arm_config, {id: stop}), "sim", start=start) as arm:
        arm.enable()
        servo = arm.bus.virtual_bus.servo(id)
        fix(servo, register, within)
        stream(arm, [start] * 200)
        fix(servo, register, beyond)
        begin = arm.clock.now()
        with pytest.raises(MotorFaultError) as caught:
            stream(arm, [start] * 200)
        assert (caught.value.joint, caught.value.status) == (f"joint{id}", (status,))
        assert SUSTAINED <= arm.clock.now() - begin < SUSTAINED + 0.05
        assert arm.state is ArmState.FAULT
        assert all(one.torque for one in arm.bus.virtual_bus.servos)  # all hold, this one too
        assert f"servo id {id}" in str(caught.value) and "reset-fault" in str(caught.value)
        fix(servo, register, within)
        arm.reset_fault()
        arm.enable()
        stream(arm, [start] * 200)


@pytest.mark.parametrize(
    ("stop", "status", "torque"),
    [(StopAt(current_ma=1500.0), "current_limit", True), (StopAt(), "overload", False)],
)
def test_a_threshold_stops_the_arm_before_the_servo_shuts_down(
    arm_config, stream, start, stop, status, torque
):
    """A motor that presses against something shuts down and lets go.

    With a threshold the arm is held.
    """
    with open_arm(watching(arm_config, {1: stop}), "sim", start=start) as arm:
        arm.enable()
        arm.bus.virtual_bus.servo(1).jammed = True
        away = start + np.array([0.2, 0, 0, 0, 0, 0])  # less than what stops the arm by itself
        with pytest.raises(MotorFaultError) as caught:
            stream(arm, [away] * 2000)
        assert (caught.value.joint, caught.value.status) == ("joint1", (status,))
        assert arm.bus.virtual_bus.servo(1).torque is torque


def test_single_peaks_are_no_reason_to_stop(arm_config, stream, start):
    with open_arm(watching(arm_config, {1: HOT, 2: HOT}), "sim", start=start) as arm:
        arm.enable()
        servo = arm.bus.virtual_bus.servo(1)
        for _ in range(20):
            fix(servo, "present_temperature", 70)
            stream(arm, [start] * int(0.4 / 0.01))
            fix(servo, "present_temperature", 30)
            stream(arm, [start] * 4)  # two of them are its turn
        assert arm.state is ArmState.ENABLED


def test_one_servo_a_cycle_is_asked_and_only_those_with_thresholds(arm_config, stream, start):
    config = watching(arm_config, {2: HOT, 5: HOT, 6: HOT})
    with open_arm(config, "sim", start=start) as arm:
        arm.enable()
        stream(arm, [start] * 2)
        counters = arm.bus.counters
        full_reads = []
        exchange = arm.bus.exchange

        def recorded(register, values, reads, within=None):
            full_reads.append([id for id, read in reads.items() if read.size == 12])
            return exchange(register, values, reads, within)

        arm.bus.exchange = recorded
        for _ in range(6):
            received = counters.bytes_received
            cycles = counters.cycles
            stream(arm, [start])
            assert counters.cycles - cycles == 1  # the same exchange
            assert counters.bytes_received - received == 8 + 6 * (4 + 7) + 5
        assert sorted(full_reads[:3]) == [[2], [5], [6]]
        assert full_reads[:3] == full_reads[3:]


def test_without_thresholds_nothing_changes_on_the_wire(arm_config, stream, start):
    with open_arm(arm_config, "sim", start=start) as arm:
        arm.enable()
        stream(arm, [start] * 2)
        # The indirect address still has its factory value.
        assert arm.bus.virtual_bus.servo(1).memory.values["indirect_address_8"] == 231
        sent = arm.bus.counters.bytes_sent
        received = arm.bus.counters.bytes_received
        stream(arm, [start])
        assert arm.bus.counters.bytes_sent - sent == (14 + 6 * 5) + (14 + 6)
        assert arm.bus.counters.bytes_received - received == 8 + 6 * (4 + 7)


@pytest.mark.parametrize("firmware", [44, None])
def test_servos_without_indirect_addresses_are_watched_as_well(arm_config, stream, start, firmware):
    clock = VirtualClock()
    config = watching(arm_config, {1: HOT, 4: StopAt(load_percent=40.0)})
    servos = [
        VirtualServo(
            j.servo.model,
            j.servo.id,
            clock,
            position_ticks=j.nearest_ticks(q),
            mode=j.servo.mode,
            firmware=firmware,
        )
        for j, q in zip(config.joints, start, strict=True)
    ]
    with open_arm(config, "sim", virtual_bus=VirtualBus(servos, clock)) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        for id in (1, 4):
            arm._cycle.feedback.read_plainly(id)
        stream(arm, [start] * 100)
        assert np.allclose(arm.read().q, start, atol=0.003) and (arm.ages <= 0.011).all()
        fix(servos[3], "present_load", -900)
        with pytest.raises(MotorFaultError) as caught:
            stream(arm, [start] * 100)
        assert (caught.value.joint, caught.value.status) == ("joint4", ("load_limit",))


def test_torque_that_goes_is_seen_in_the_long_block_too(arm_config, stream, start):
    config = watching(arm_config, {1: HOT})  # it is asked for more in every cycle
    with open_arm(config, "sim", start=start) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        arm.bus.virtual_bus.servo(1).reboot()
        with pytest.raises(MotorFaultError) as caught:
            stream(arm, [start])
        assert caught.value.status == ("torque_lost",)


def _drive(stop: StopAt) -> Drive:
    joint = make_joint(mode=OperatingMode.POSITION, lower=-1.0, upper=1.0, stop_at=stop)
    return Drive(joint, joint.servo)


@given(
    st.lists(st.tuples(st.floats(0.005, 0.3), st.integers(50, 70)), min_size=1, max_size=60),
)
def test_a_fault_comes_after_an_unbroken_run_of_samples_and_no_earlier(samples):
    watch = Thresholds(_drive(HOT))
    now = 0.0
    run = 0
    since = 0.0
    for dt, celsius in samples:
        now += dt
        fault = watch.take({"present_temperature": celsius}, now)
        if celsius <= 60:
            run = 0
            assert fault is None
            continue
        since = since if run else now
        run += 1
        assert (fault is not None) == (run >= MIN_SAMPLES and now - since >= SUSTAINED)


def test_samples_from_before_a_pause_say_nothing():
    watch = Thresholds(_drive(HOT))
    for now in (0.0, 0.1, 10.0, 10.1):
        assert watch.take({"present_temperature": 70}, now) is None
    assert watch.take({"present_temperature": 70}, 10.6) is not None
