"""Arms that people own work with their servos as makers and other programs leave them.

Registers are those of the sources in models/<arm>/README.md; nothing here was tried on real servos.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.commands.main import main
from robot_ik.errors import (
    BusTimeoutError,
    ConfigError,
    HardwareError,
    MotorFaultError,
    UnsafeCommandError,
)
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.arm_part import ArmPart
from robot_ik.hardware.calibration import calibrated, check_calibration
from robot_ik.hardware.calibration_file import Calibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.lerobot_calibration import load_lerobot
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock
from robot_ik.workcell.hand_calibration import calibrate_by_hand
from tests.hardware.joints import with_servo

ARMS = ("koch_v11", "omx_f", "vx300s", "wx250s")
POSITION = int(OperatingMode.POSITION)
EXTENDED = int(OperatingMode.EXTENDED_POSITION)
CURRENT = int(OperatingMode.CURRENT_BASED_POSITION)
PWM = int(OperatingMode.PWM)
TIME_BASED = 0b0100  # Drive Mode bit 2


@dataclass(frozen=True)
class Left:
    """What a program leaves in the servos of an arm: servo id -> register -> value.

    Attributes:
        registers: Set as they are.
        offsets: Homing Offset, set while the shaft stays where it reads the same.
        kept: Registers that no connect of ours may change: what the maker's next start would miss.
    """

    registers: Mapping[int, Mapping[str, int]]
    offsets: Mapping[int, int] = field(default_factory=dict)
    kept: tuple[str, ...] = (
        "secondary_id",
        "homing_offset",
        "min_position_limit",
        "max_position_limit",
        "velocity_limit",
    )


def interbotix(limits: Mapping[int, tuple[int, int]], reverse: set[int], wound: int = 0) -> Left:
    """Servos after the maker's driver: limits and reverse bits of its file, profiles in time.

    ``wound``: ticks of Homing Offset that it gave the shadows 3 and 5, from where their leaders
    stand.
    """
    profile = {"profile_velocity": 2000, "profile_acceleration": 300}  # ms, its default
    registers: dict[int, dict[str, int]] = {}
    for id in range(1, 10):
        low, high = limits.get(id, (0, 4095))
        registers[id] = {
            "drive_mode": TIME_BASED | int(id in reverse),
            "velocity_limit": 131,
            "min_position_limit": low,
            "max_position_limit": high,
            "return_delay_time": 0,
            "operating_mode": PWM if id == 9 else POSITION,
            **profile,
        }
    registers[3]["secondary_id"] = 2
    registers[5]["secondary_id"] = 4
    return Left(registers, {3: wound, 5: -wound} if wound else {})


WX_LIMITS = {2: (819, 3345), 3: (819, 3345), 4: (648, 3094), 5: (648, 3094), 7: (910, 3447)}
VX_LIMITS = {2: (841, 2867), 3: (841, 2867), 4: (898, 3094), 5: (898, 3094), 7: (830, 3504)}
OMX_LIMITS = {12: (830, 3129), 13: (1024, 3140)}


def omx_by_ros() -> Left:
    """Servos after ROBOTIS' ROS 2 driver: joint1 extended, profiles of 50 and 25 ms, its gains."""
    registers: dict[int, dict[str, int]] = {}
    for id in range(11, 17):
        low, high = OMX_LIMITS.get(id, (0, 4095))
        mode = {11: EXTENDED, 16: CURRENT}.get(id, POSITION)
        registers[id] = {
            "drive_mode": TIME_BASED,
            "operating_mode": mode,
            "return_delay_time": 0,
            "min_position_limit": low,
            "max_position_limit": high,
            "position_p_gain": 1000,
            "position_i_gain": 0,
            "position_d_gain": 1000,
            "profile_velocity": 50,
            "profile_acceleration": 25,
        }
    registers[16] |= {"current_limit": 600, "shutdown": 21}
    return Left(
        registers, kept=("homing_offset", "min_position_limit", "max_position_limit", "shutdown")
    )


def omx_by_lerobot() -> Left:
    """After LeRobot: extended mode all over, whole-turn limits, its gains at the elbow."""
    registers: dict[int, dict[str, int]] = {
        id: {
            "drive_mode": 0,
            "operating_mode": CURRENT if id == 16 else EXTENDED,
            "return_delay_time": 0,
            "min_position_limit": 0,
            "max_position_limit": 4095,
        }
        for id in range(11, 17)
    }
    registers[13] |= {"position_p_gain": 1500, "position_i_gain": 0, "position_d_gain": 600}
    return Left(registers, kept=("homing_offset",))


def koch_by_lerobot() -> Left:
    """Servos after a calibration by LeRobot: the middle of each range reads 2047."""
    registers: dict[int, dict[str, int]] = {
        id: {
            "drive_mode": 0,
            "operating_mode": CURRENT if id == 6 else EXTENDED,
            "return_delay_time": 0,
            "min_position_limit": 0 if id in (1, 5) else 900,
            "max_position_limit": 4095 if id in (1, 5) else 3200,
        }
        for id in range(1, 7)
    }
    registers[3] |= {"position_p_gain": 1500, "position_i_gain": 0, "position_d_gain": 600}
    offsets = {1: 37, 2: -1900, 3: 2047, 4: -2047, 5: 1500, 6: -610}
    return Left(registers, offsets, ("homing_offset", "min_position_limit", "max_position_limit"))


PROGRAMS: Mapping[str, tuple[Left, Left]] = {
    "wx250s": (interbotix(WX_LIMITS, {3, 5, 7}), interbotix(WX_LIMITS, {3, 5, 7}, wound=13)),
    "vx300s": (interbotix(VX_LIMITS, {2, 4, 7}), interbotix(VX_LIMITS, {2, 4, 7}, wound=-9)),
    "omx_f": (omx_by_ros(), omx_by_lerobot()),
    "koch_v11": (Left({}), koch_by_lerobot()),
}
"""Arm -> what its servos hold when they come, and after the other program has run in between."""


@cache
def robot(name: str) -> rik.Robot:
    return rik.load_robot(name)


@cache
def arm_file(name: str) -> ArmConfig:
    path = robot(name).arm_file
    assert path is not None
    return ArmConfig.load(path)


def rest(name: str) -> np.ndarray[Any, Any]:
    """Where the arm may be let go: the maker's sleep pose, where he names one."""
    keys = [robot(name).model.key(k).name for k in range(robot(name).model.nkey)]
    key = next((key for key in ("sleep", "rest") if key in keys), "home")
    return np.array(robot(name).model.key(key).qpos[: robot(name).nq])


def leave(servos: VirtualBus, left: Left) -> None:
    """The other program runs: torque off afterwards, as after its end."""
    for id, registers in left.registers.items():
        memory = servos.servo(id).memory
        memory.set("torque_enable", 0)
        for register, value in registers.items():
            memory.set(register, value)
    for id, offset in left.offsets.items():
        _wind(servos.servo(id), offset)


def _wind(servo: VirtualServo, offset: int) -> None:
    """Change the Homing Offset and the horn by the same angle: the reading stays."""
    before = servo.shaft.reading
    servo.memory.set("homing_offset", offset)
    back = -1.0 if servo.memory.values["drive_mode"] & 1 else 1.0
    servo.rotate_by_hand(back * (before - servo.shaft.reading))
    assert servo.shaft.reading == pytest.approx(before, abs=1.0)


def servos_of(name: str) -> VirtualBus:
    return VirtualBus.from_config(arm_file(name), VirtualClock(), rest(name))


def registers_of(
    servos: VirtualBus, ids: Mapping[int, Any], names: tuple[str, ...]
) -> dict[tuple[int, str], int]:
    return {(id, name): servos.servo(id).memory.values[name] for id in ids for name in names}


def run_once(name: str, servos: VirtualBus) -> None:
    """Connect, enable, move home, open and close the gripper, and park at the start."""
    config = arm_file(name)
    begin = rest(name)
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        part = ArmPart(arm, robot(name).joints)
        chain = part.config
        assert np.abs(part.read().q - begin).max() < 0.01
        move = rik.joint_move(
            robot(name),
            part.read().q,
            robot(name).home,
            velocity_limits=chain.velocity,
            acceleration_limits=chain.acceleration,
        )
        rik.execute(move, [part], source=part, clock=arm.clock, settle=0.4)
        assert np.abs(part.read().q - robot(name).home).max() < 0.01
        finger = config.group("gripper")[0]
        for share in (0.9, 0.1):
            to = finger.lower + share * (finger.upper - finger.lower)
            (grip,) = arm.grip(to)
            assert not grip.held and abs(grip.q - to) < 5 * finger.resolution
    assert arm.exit_report is not None and arm.exit_report.ok and arm.exit_report.parked
    assert arm.exit_report.done == "torque_off" and not any(servo.torque for servo in servos.servos)
    parked = [
        joint.value(servos.servo(joint.servo.id).shaft.reading) for joint in config.chain.joints
    ]
    assert np.abs(np.array(parked) - begin).max() < 0.01


@pytest.mark.parametrize("name", ARMS)
def test_an_arm_connects_moves_grips_parks_and_again_after_the_other_program(name: str) -> None:
    servos = servos_of(name)
    for left in PROGRAMS[name] * 2:
        leave(servos, left)
        kept = registers_of(servos, left.registers, left.kept)
        reverse = {id: servos.servo(id).memory.values["drive_mode"] & 1 for id in left.registers}
        run_once(name, servos)
        assert registers_of(servos, left.registers, left.kept) == kept
        for id, bit in reverse.items():
            assert (
                servos.servo(id).memory.values["drive_mode"] == bit
            )  # reverse stays, the time-based profile goes


@pytest.mark.parametrize("name", ["wx250s", "vx300s"])
def test_the_limits_of_the_file_lie_within_the_makers_registers_to_a_tick(name: str) -> None:
    for joint in arm_file(name).joints:
        low, high = (WX_LIMITS if name == "wx250s" else VX_LIMITS).get(joint.servo.id, (0, 4095))
        first, last = joint.ticks_range()
        assert low <= first <= last <= high, joint.name
        if joint.servo.id in WX_LIMITS:  # and no narrower than whole degrees make them
            assert first - low <= 2 and high - last <= 2, joint.name


@pytest.mark.parametrize("name", ["wx250s", "vx300s"])
def test_a_cleared_reverse_bit_is_refused_with_advice(name: str) -> None:
    servos = servos_of(name)
    leave(servos, PROGRAMS[name][0])
    servos.servo(7).memory.set("drive_mode", 0)
    with pytest.raises(HardwareError, match=r"wrist_angle.*servo id 7"):
        open_arm(arm_file(name), "sim", virtual_bus=servos).connect()
    assert not any(servo.torque for servo in servos.servos)


@pytest.mark.parametrize("name", ["wx250s", "vx300s"])
def test_a_shadow_whose_offset_fights_its_leader_gets_no_torque(name: str) -> None:
    servos = servos_of(name)
    leave(servos, PROGRAMS[name][0])
    # The horn was not turned with it, so this servo is 13 deg from servo 2.
    servos.servo(3).memory.set("homing_offset", 150)
    with (
        open_arm(arm_file(name), "sim", virtual_bus=servos) as arm,
        pytest.raises(HardwareError, match="two servos of joint 'shoulder'"),
    ):
        arm.enable()
    assert not any(servo.torque for servo in servos.servos)


def test_a_gripper_that_cannot_close_does_not_overload_where_the_servo_knows_current() -> None:
    servos = servos_of("vx300s")
    config = arm_file("vx300s")
    finger = config.group("gripper")[0]
    assert finger.current == 300.0 and finger.servo.presses
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        servos.servo(9).jammed = True
        (grip,) = arm.grip(finger.lower)
        assert grip.held and grip.current == pytest.approx(300.0, rel=0.05)
        arm.clock.sleep_until(arm.clock.now() + 5.0)
        assert servos.servo(9).memory.values["hardware_error_status"] == 0


def test_an_xl430_gripper_that_cannot_close_stops_the_arm_before_it_shuts_down() -> None:
    servos = servos_of("wx250s")
    config = arm_file("wx250s")
    with open_arm(config, "sim", virtual_bus=servos) as arm:
        arm.enable()
        servos.servo(9).jammed = True
        with pytest.raises(MotorFaultError) as caught:
            arm.grip(config.group("gripper")[0].lower)
            for _ in range(300):
                arm.clock.sleep_until(arm.clock.now() + 0.01)
                ArmPart(arm, robot("wx250s").joints).send(rest("wx250s"), arm.clock.now())
        assert caught.value.joint == "left_finger"
        assert servos.servo(9).memory.values["hardware_error_status"] == 0


@pytest.mark.parametrize("name", ARMS)
def test_a_finger_outside_its_range_is_not_asked_for(name: str) -> None:
    config = arm_file(name)
    with open_arm(config, "sim", virtual_bus=servos_of(name)) as arm:
        arm.enable()
        with pytest.raises(UnsafeCommandError):
            arm.grip(config.group("gripper")[0].upper + 0.2)


class Hand:
    """Does what each step of a calibration asks for; knows the true zeros and directions."""

    def __init__(self, true: ArmConfig, servos: VirtualBus) -> None:
        self.true = true
        self.servos = servos
        self.q = {
            joint.name: joint.value(servos.servo(joint.servo.id).shaft.reading)
            for joint in true.joints
        }

    def put(self, name: str, q: float, sample: Callable[[], object]) -> None:
        for part in np.linspace(self.q[name], q, 24):
            joint = self.true.joint(name)
            for servo in joint.servos:
                ticks = joint.position(part, servo) - joint.position(self.q[name], servo)
                back = -1.0 if self.servos.servo(servo.id).memory.values["drive_mode"] & 1 else 1.0
                self.servos.servo(servo.id).rotate_by_hand(back * ticks)
            self.q[name] = float(part)
            sample()

    def step(self, text: str, sample: Callable[[], object]) -> None:
        for joint in self.true.joints:
            low, high = joint.limits
            if text[0] == "1":
                for q in (0.9 * low, 0.9 * high) if not joint.slides else (low + 1e-3, high - 1e-3):
                    self.put(joint.name, q, sample)
            elif text[0] == "2":
                self.put(joint.name, 0.0 if not joint.slides else 0.5 * (low + high), sample)
            elif f"move {joint.name} alone" in text:
                self.put(joint.name, self.q[joint.name] + 0.2 * joint.lever, sample)

    def note(self, text: str) -> None:
        pass

    def again(self, error: Exception) -> bool:
        return False


def true_arm(name: str) -> ArmConfig:
    """A Koch as built by its owner: horns at any angle, two joints count backwards."""
    config = arm_file(name)
    if name != "koch_v11":
        return config
    zeros = (1900, 3050, 700, 2048, 5100, 2500)
    ways = (1, -1, 1, 1, -1, 1)
    joints = tuple(
        with_servo(joint, zero_ticks=zero, direction=way)
        for joint, zero, way in zip(config.joints, zeros, ways, strict=True)
    )
    return dataclasses.replace(config, joints=joints, uncalibrated=False, file=None)


@pytest.mark.parametrize("name", ARMS)
def test_a_calibration_by_hand_finds_the_zeros_of_the_arm(name: str, tmp_path: Path) -> None:
    true = true_arm(name)
    # q = 0 is within no X-Series finger's range: there the pose of the zeros is the middle of it.
    pose = {joint.name: 0.0 if not joint.slides else sum(joint.limits) / 2 for joint in true.joints}
    servos = VirtualBus.from_config(true, VirtualClock(), list(pose.values()))
    limits = {joint.name: (joint.lower, joint.upper) for joint in true.joints}
    unknown = dataclasses.replace(arm_file(name), file=None)
    with open_arm(unknown, "sim", virtual_bus=servos) as arm:
        found = calibrate_by_hand(arm, Hand(true, servos), pose, limits)
        made = calibrated(arm.config, found)
        check_calibration(arm.bus, made, found)
    for mine, truth in zip(made.servos, true.servos, strict=True):
        assert (mine.id, mine.direction) == (truth.id, truth.direction)
        assert mine.zero_ticks == pytest.approx(truth.zero_ticks, abs=2), mine.id
    assert not made.uncalibrated and arm_file(name).uncalibrated == (name == "koch_v11")
    path = tmp_path / "mine.toml"
    made.save(path)
    found.save(tmp_path / "mine.calibration.toml")
    again = ArmConfig.load(path)
    assert [j.servo.zero_ticks for j in again.joints] == [j.servo.zero_ticks for j in made.joints]
    # The same servos, from the side that does not know that they are simulated.
    wire = SimBus(servos, real=True)
    with Arm(again, wire) as arm:
        arm.enable()
        arm.move_to(dict.fromkeys(arm.joints[:1], 0.3))
    assert arm.exit_report is not None and arm.exit_report.ok


def test_an_arm_of_placeholders_gets_no_torque_on_real_servos() -> None:
    config = arm_file("koch_v11")
    servos = servos_of("koch_v11")
    # these servos are treated as real ones
    with Arm(config, SimBus(servos, real=True)) as arm:
        assert arm.read().q.shape == (6,)  # looking is allowed
        with pytest.raises(ConfigError, match=r"placeholders.*\n.*servo calibrate") as caught:
            arm.enable()
        assert caught.value.key == "uncalibrated"
    assert not any(servo.torque for servo in servos.servos)


def test_lerobots_calibration_of_a_koch_is_read_with_its_offsets(tmp_path: Path) -> None:
    """Its zero is the middle of each range, not the model's: joints move, the tool is elsewhere."""
    servos = servos_of("koch_v11")
    leave(servos, koch_by_lerobot())
    names = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    rows = ", ".join(
        f'"{name}": {{"id": {id}, "drive_mode": 0, '
        f'"homing_offset": {koch_by_lerobot().offsets[id]}, '
        f'"range_min": {900 if id not in (1, 5) else 0}, '
        f'"range_max": {3194 if id not in (1, 5) else 4094}}}'
        for id, name in enumerate(names, 1)
    )
    path = tmp_path / "koch.json"
    path.write_text(f"{{{rows}}}")
    config = dataclasses.replace(arm_file("koch_v11"), file=None)
    limits = dict.fromkeys(config.names, (-math.inf, math.inf))
    found = load_lerobot(path, config, limits)
    assert isinstance(found, Calibration)
    assert [joint.zero_ticks for joint in found.joints] == [2047] * 6
    in_one_turn = dataclasses.replace(
        config,
        joints=tuple(
            with_servo(j, mode=OperatingMode.POSITION) if j.current is None else j
            for j in config.joints
        ),
    )
    # Position mode ignores an offset of this size.
    with pytest.raises(ConfigError, match=r"Homing Offset of -1900"):
        load_lerobot(path, in_one_turn, limits)


@pytest.mark.parametrize("name", ["omx_f", "wx250s"])  # the others: tests/models/test_owned_arms.py
def test_robot_ik_reach_on_the_command_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reach", "--robot", name, "--bus", "sim", "--out", str(tmp_path / "run")]) == 0
    said = capsys.readouterr().out
    assert "REACHED" in said and "NOT REACHED" not in said
    assert ("z axis as seen, free to turn about it" in said) == (name in ("koch_v11", "omx_f"))


@pytest.mark.parametrize("name", ARMS)
def test_robot_ik_servo_on_a_pty(
    name: str, capsys: pytest.CaptureFixture[str], real_time: None
) -> None:
    joint = arm_file(name).joints[0].name
    assert main(["servo", "move", f"{joint}=5", "--arm", name, "--bus", "pty"]) == 0
    assert main(["servo", "monitor", "--arm", name, "--bus", "pty", "--count", "1"]) == 0
    assert arm_file(name).group("gripper")[0].name in capsys.readouterr().out


def stream(arm: Arm, joint: str, to: float) -> None:
    """Moves a joint evenly for 0.4 s, then lets it arrive."""
    q = np.array(arm.read().q)
    k = arm.joints.index(joint)
    for goal in (*np.linspace(q[k], to, 40), *[to] * 40):
        arm.clock.sleep_until(arm.clock.now() + 0.01)
        q[k] = goal
        arm.send(q, arm.clock.now())


def test_two_arms_with_a_bus_each() -> None:
    """Both halves of an ALOHA in one program: what happens to one is nothing to the other."""
    left = servos_of("vx300s")
    right = servos_of("wx250s")
    with open_arm(arm_file("vx300s"), "sim", virtual_bus=left) as follower:
        with open_arm(arm_file("wx250s"), "sim", virtual_bus=right) as leader:
            follower.enable()
            leader.enable()
            stream(leader, "waist", 0.1)
            stream(follower, "waist", -0.1)
            assert leader.read().q[0] == pytest.approx(0.1, abs=0.01)
            right.servo(1).inject_error("overload")
            with pytest.raises(MotorFaultError):
                stream(leader, "waist", 0.2)
        assert not any(servo.torque for servo in right.servos)
        assert all(servo.torque for servo in left.servos)
        stream(follower, "waist", 0.0)  # goes on
        assert follower.read().q[0] == pytest.approx(0.0, abs=0.01)
    assert follower.exit_report is not None and follower.exit_report.ok
    assert not any(servo.torque for servo in left.servos)


@pytest.fixture
def one_wire() -> tuple[VirtualBus, ArmConfig, ArmConfig]:
    """An OMX-F (ids 11 to 16) and a Koch (1 to 6) on one wire."""
    first = arm_file("omx_f")
    second = arm_file("koch_v11")
    clock = VirtualClock()
    ours, theirs = (
        VirtualBus.from_config(c, clock, rest(n))
        for c, n in ((first, "omx_f"), (second, "koch_v11"))
    )
    return VirtualBus([*ours.servos, *theirs.servos], clock), first, second


@pytest.mark.parametrize("policy", ["torque_off", "hold", "park"])
def test_leaving_an_arm_never_touches_another_on_the_same_wire(
    one_wire: tuple[VirtualBus, ArmConfig, ArmConfig], policy: str
) -> None:
    """Two arms share an open bus. Leaving one writes to the ids of its own file only."""
    servos, first, second = one_wire
    with closing(SimBus(servos)) as wire:
        wire.open()
        with Arm(second, wire) as stays:
            stays.enable()
            with Arm(first, wire, on_exit=policy) as leaves:
                leaves.enable()
                stream(leaves, "joint1", 0.1)
                stream(stays, "shoulder_pan", 0.1)
            report = leaves.exit_report
            assert report is not None and report.ok and len(report.verified) == 6
            assert wire.is_open
            torque = {id: servos.servo(id).torque for id in (*first.servo_ids, *second.servo_ids)}
            assert torque == dict.fromkeys(first.servo_ids, policy == "hold") | dict.fromkeys(
                second.servo_ids, True
            )
            stream(stays, "shoulder_pan", 0.0)  # and goes on as if nothing had been
            assert stays.read().q[0] == pytest.approx(0.0, abs=0.01)
        assert stays.exit_report is not None and stays.exit_report.ok
        assert not any(servos.servo(id).torque for id in second.servo_ids)


def test_a_fault_of_one_arm_on_a_shared_wire_is_none_of_the_other(
    one_wire: tuple[VirtualBus, ArmConfig, ArmConfig],
) -> None:
    servos, first, second = one_wire
    with closing(SimBus(servos)) as wire:
        wire.open()
        with (
            Arm(first, wire) as ours,
            Arm(second, wire) as theirs,
        ):
            ours.enable()
            theirs.enable()
            servos.servo(12).inject_error("overload")
            with pytest.raises(MotorFaultError) as caught:
                stream(ours, "joint1", 0.1)
            assert caught.value.joint == "joint2"
            stream(theirs, "shoulder_pan", 0.1)
            assert ours.reset_fault() == ("joint2",)
            for id in (11, 2):  # an error of the wire names the joint, of either arm
                servos.inject(Fault("silent", id))
                with pytest.raises(BusTimeoutError) as silent:
                    wire.ping(id)
                assert silent.value.joint == {11: "joint1", 2: "shoulder_lift"}[id]
                servos.clear("silent")
            ours.enable()
            stream(ours, "joint1", 0.2)
            stream(theirs, "shoulder_pan", 0.0)
