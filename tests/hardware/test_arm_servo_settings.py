"""Settings of the arm file are in the servos after connect and after every restart."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from robot_ik.errors import ArmStateError, ConfigError, HardwareError, MotorFaultError
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x import SPEED_HEADROOM
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Gains, Servo
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock
from tests.hardware.joints import Twin, with_servo, with_twin

POSITION = OperatingMode.POSITION

GAINS = Gains(position_p=900, position_d=25, velocity_i=1500, feedforward_1=40, feedforward_2=50)


def changed(config: ArmConfig, index: int, **changes: object) -> ArmConfig:
    """The arm with one joint that is changed: keys of the joint, of its servos, or ``twin``."""
    joints = list(config.joints)
    joint = joints[index]
    if "twin" in changes:
        joint = with_twin(joint, changes.pop("twin"))  # type: ignore[arg-type]
    fields = {field.name for field in dataclasses.fields(Servo)}
    joint = with_servo(joint, **{key: value for key, value in changes.items() if key in fields})
    rest = {key: value for key, value in changes.items() if key not in fields}
    joints[index] = dataclasses.replace(joint, **rest)  # type: ignore[arg-type]
    return dataclasses.replace(config, joints=tuple(joints))


def servos_of(config: ArmConfig, start: object = None) -> VirtualBus:
    return VirtualBus.from_config(config, VirtualClock(), start)  # type: ignore[arg-type]


@pytest.fixture
def tuned(arm_config: ArmConfig) -> ArmConfig:
    """Joint 1 with gains, a profile and a current limit of its own."""
    return changed(
        arm_config,
        0,
        gains=GAINS,
        profile_velocity=4.0,
        profile_acceleration=100.0,
        current_limit=1000.0,
    )


def settings(bus: VirtualBus, id: int) -> dict[str, int]:
    memory = bus.servo(id).memory
    names = (*GAINS.registers, "profile_velocity", "profile_acceleration", "current_limit")
    return {name: memory.values[name] for name in names}


WANTED = {
    **GAINS.registers,
    "profile_velocity": 167,  # 4 rad/s in units of 0.229 rev/min, rounded up
    "profile_acceleration": 268,  # 100 rad/s^2 in units of 214.577 rev/min^2
    "current_limit": 371,  # 1000 mA in units of 2.69
}


def test_gains_profile_and_current_limit_are_written_at_connect(tuned: ArmConfig) -> None:
    servos = servos_of(tuned)
    untouched = dict(servos.servo(2).memory.values)
    with open_arm(tuned, "sim", virtual_bus=servos):
        assert settings(servos, 1) == WANTED
        for name in (*GAINS.registers, "current_limit"):
            # The arm file does not set them.
            assert servos.servo(2).memory.values[name] == untouched[name]


@pytest.mark.parametrize("name", ["position_p_gain", "current_limit"])
def test_a_setting_that_a_servo_does_not_take_is_refused(tuned, name, monkeypatch) -> None:
    servos = servos_of(tuned)
    memory = servos.servo(1).memory
    keep = memory.set
    monkeypatch.setattr(memory, "set", lambda n, value: None if n == name else keep(n, value))
    with pytest.raises(HardwareError, match=f"{name} of joint 'joint1'.*reads back otherwise"):
        open_arm(tuned, "sim", virtual_bus=servos).connect()
    assert not any(servo.torque for servo in servos.servos)


def test_a_current_limit_is_written_where_it_differs_and_not_under_torque(tuned: ArmConfig) -> None:
    servos = servos_of(tuned)
    memory = servos.servo(1).memory
    memory.set("current_limit", 371)
    memory.set("return_delay_time", 0)
    memory.set("torque_enable", 1)
    with open_arm(tuned, "sim", virtual_bus=servos):
        pass  # nothing to write: EEPROM is locked under torque, and the limit is there
    memory.set("torque_enable", 1)
    memory.set("current_limit", 500)
    with pytest.raises(ArmStateError, match="current_limit of joint 'joint1' must change"):
        open_arm(tuned, "sim", virtual_bus=servos).connect()


def test_what_lies_in_ram_is_back_after_reset_fault(tuned, stream, start) -> None:
    with open_arm(tuned, "sim", start=start) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        servo = arm.bus.virtual_bus.servo(1)
        servo.inject_error("overload")
        with pytest.raises(MotorFaultError):
            stream(arm, [start] * 3)
        servo.memory.set("position_p_gain", 1)  # as good as any: the reboot forgets it
        arm.reset_fault()
        assert settings(arm.bus.virtual_bus, 1) == WANTED
        arm.enable()
        stream(arm, [start] * 3)


def test_what_lies_in_ram_is_back_after_a_brown_out(tuned, stream, start) -> None:
    with open_arm(tuned, "sim", start=start) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        servo = arm.bus.virtual_bus.servo(1)
        servo.reboot()
        assert (
            servo.memory.values["position_p_gain"] == 800
            and servo.memory.values["profile_velocity"] == 0
        )
        with pytest.raises(MotorFaultError) as caught:
            stream(arm, [start] * 50)
        assert caught.value.status == ("torque_lost",)
        arm.reset_fault()
        assert settings(arm.bus.virtual_bus, 1) == WANTED


def test_what_lies_in_ram_is_back_after_the_port_was_away(tuned, stream, start) -> None:
    from robot_ik.errors import BusDisconnectedError

    with open_arm(tuned, "sim", start=start) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        arm.bus.virtual_bus.unplugged = True
        with pytest.raises(BusDisconnectedError):
            stream(arm, [start] * 3)
        for servo in arm.bus.virtual_bus.servos:
            servo.reboot()
        arm.bus.virtual_bus.unplugged = False
        arm.reconnect(timeout=2.0)
        assert settings(arm.bus.virtual_bus, 1) == WANTED


def test_no_servo_gets_torque_by_a_restart_of_its_own(tuned, stream, start) -> None:
    servos = servos_of(tuned, start)
    for servo in servos.servos:
        servo.memory.set("startup_configuration", 0b11)
    with open_arm(tuned, "sim", virtual_bus=servos) as arm:
        arm.enable()
        stream(arm, [start] * 3)
        servos.servo(1).reboot()
        assert not servos.servo(1).torque
        with pytest.raises(MotorFaultError, match="torque_lost"):
            stream(arm, [start] * 3)


@pytest.mark.parametrize("id", range(1, 7))
def test_a_servo_that_restarted_since_connect_gets_no_torque(tuned, stream, start, id) -> None:
    """Without its profile and its goal current it would be as fast and as strong as it can."""
    with open_arm(tuned, "sim", start=start) as arm:
        profile = arm.bus.virtual_bus.servo(id).memory.values["profile_velocity"]
        arm.bus.virtual_bus.servo(id).reboot()
        with pytest.raises(HardwareError, match=rf"joint{id}.*restarted.*nothing was switched on"):
            arm.enable()
        assert not any(servo.torque for servo in arm.bus.virtual_bus.servos)
        arm.reconnect()
        assert arm.bus.virtual_bus.servo(id).memory.values["profile_velocity"] == profile
        assert settings(arm.bus.virtual_bus, 1) == WANTED
        arm.enable()
        stream(arm, [start] * 3)


def test_a_profile_on_a_swing_arm_covers_the_place_where_the_finger_is_slowest() -> None:
    from tests.hardware.test_arm_file_keys import ALL

    finger = ArmConfig.parse(ALL.replace("profile_velocity_mm = 60.0\n", "")).joint("finger")
    config = ArmConfig("f", "f", 1_000_000, 100.0, 400, "torque_off", (finger,))
    with open_arm(config, "sim") as arm:
        units = arm.bus.virtual_bus.servo(9).memory.values["profile_velocity"]
    # 50 mm/s where a radian of the horn is 6.5 mm (at 37 mm) need more than where it is 15 mm.
    least = finger.gear.lever(0.037)
    assert least == pytest.approx(0.0065, abs=2e-4)
    assert units == int(np.ceil(SPEED_HEADROOM * 0.050 / least / 0.0239808))


def test_a_servo_reversed_by_its_maker_moves_as_the_file_says(
    arm_config, stream, smooth, start
) -> None:
    config = changed(arm_config, 0, mode=POSITION, reverse=True)
    servos = servos_of(config, start)
    assert servos.servo(1).memory.values["drive_mode"] == 1
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        assert np.allclose(arm.read().q, start, atol=0.002)
        stream(arm, smooth(start, start + 0.3, 0.6))
        arm.clock.sleep_until(arm.clock.now() + 0.05)
        assert np.allclose(arm.read().q, start + 0.3, atol=0.01)
        assert np.allclose(servos.true_angles(config), start + 0.3, atol=0.01)
        assert servos.servo(1).memory.values["drive_mode"] == 1  # never cleared


def test_limits_of_a_reversed_servo_are_compared_in_its_own_frame(
    arm_config, stream, start
) -> None:
    """The shoulder of a vx300s: Drive Mode 1 and 841..2867, lopsided, are -106..72 degrees."""
    lower, upper = np.radians([-106.0, 72.0])
    config = changed(
        arm_config, 0, mode=POSITION, reverse=True, zero_ticks=2048, lower=lower, upper=upper
    )
    servos = servos_of(config)
    servos.servo(1).memory.set("min_position_limit", 841)
    servos.servo(1).memory.set("max_position_limit", 2867)
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        assert arm.lower[0] == lower and arm.upper[0] == upper
    # In the unreversed frame the same angles are 1229..3255: those limits do not hold them.
    servos.servo(1).memory.set("min_position_limit", 1229)
    servos.servo(1).memory.set("max_position_limit", 3255)
    with pytest.raises(ConfigError, match=r"-72\.0 to 106\.1 deg"):
        open_arm(config, "sim", virtual_bus=servos).connect()


@pytest.mark.parametrize("said", [False, True])
def test_a_bit_that_is_not_as_the_file_says_is_refused_with_the_cure(arm_config, said) -> None:
    config = changed(arm_config, 2, reverse=said)
    servos = servos_of(config)
    servos.servo(3).memory.set("drive_mode", int(not said))
    before = dict(servos.servo(3).memory.values)
    with pytest.raises(HardwareError) as caught:
        open_arm(config, "sim", virtual_bus=servos).connect()
    assert "joint 'joint3' (servo id 3)" in str(caught.value)
    assert f"reverse = {str(not said).lower()} in its [[joints]] table" in str(caught.value)
    assert servos.servo(3).memory.values["drive_mode"] == before["drive_mode"]


def test_the_reverse_bit_of_a_twin(arm_config, start) -> None:
    """Without `reverse` in the file both states are accepted; with it, one of them."""
    for said, found in itertools.product((None, True, False), (0, 1)):
        works = said is None or said == bool(found)
        config = changed(arm_config, 1, twin=Twin(8, shadow=True, reverse=said))
        servos = servos_of(config, start)
        servos.servo(8).memory.set("drive_mode", found)
        arm = open_arm(config, "sim", virtual_bus=servos)
        if works:
            arm.connect()
            assert servos.servo(8).memory.values["drive_mode"] == found
            arm.close()
        else:
            with pytest.raises(HardwareError, match=r"in its \[joints.twin\] table"):
                arm.connect()


def test_other_bits_of_drive_mode_are_cleared_and_reverse_stays(arm_config) -> None:
    config = changed(arm_config, 0, reverse=True)
    servos = servos_of(config)
    servos.servo(1).memory.set("drive_mode", 0b0101)  # OpenMANIPULATOR-X: reverse and time-based
    with open_arm(config, "sim", virtual_bus=servos):
        assert servos.servo(1).memory.values["drive_mode"] == 0b0001


@pytest.mark.parametrize(
    ("offset", "works"), [(1024, True), (-1024, True), (1025, False), (-2047, False)]
)
def test_an_offset_that_position_mode_ignores_is_explained(arm_config, offset, works) -> None:
    config = changed(arm_config, 0, mode=POSITION, lower=-0.5, upper=0.5)
    servos = servos_of(config)
    servos.servo(1).memory.set("homing_offset", offset)
    arm = open_arm(config, "sim", virtual_bus=servos)
    if works:
        arm.connect()
        arm.close()
        return
    with pytest.raises(ConfigError) as caught:
        arm.connect()
    text = str(caught.value)
    assert caught.value.key == "joints[0].mode" and f"Homing Offset of {offset} ticks" in text
    assert "extended_position" in text and "zero_ticks" in text
    assert "ignore" in text
    many = changed(config, 0, mode=OperatingMode.EXTENDED_POSITION)
    with open_arm(many, "sim", virtual_bus=servos):
        pass  # there it counts


def test_a_virtual_servo_in_position_mode_ignores_such_an_offset(arm_config) -> None:
    """Why it is refused: the reading leaves the offset out, and the joint would be off by it."""
    servos = servos_of(changed(arm_config, 0, mode=POSITION))
    servo = servos.servo(1)
    servo.memory.set("homing_offset", 1500)
    assert servo.shaft.reading == 2048
    servo.memory.set("operating_mode", OperatingMode.EXTENDED_POSITION)
    assert servo.shaft.reading == 3548
