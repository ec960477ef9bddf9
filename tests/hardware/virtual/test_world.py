"""A world: MuJoCo moves the joints, the bus reads them, and loads show as current."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from robot_ik.errors import UnknownJointError
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Direct
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.hardware.virtual.world import World
from robot_ik.ports import VirtualClock
from tests.hardware.joints import Twin, with_servo, with_twin

TABLE = X_TABLES["XM430-W350"]
NM_PER_COUNT = 2.69e-3 * 4.1 / 2.3

# Two levers in a vertical plane; q = 0 is level, positive lifts.
ARM = """
<mujoco>
  <worldbody>
    <body><joint name="shoulder" axis="0 -1 0"/>
      <geom type="capsule" fromto="0 0 0 .15 0 0" size=".01" mass=".2"/>
      <body pos=".15 0 0"><joint name="elbow" axis="0 -1 0"/>
        <geom type="capsule" fromto="0 0 0 .15 0 0" size=".01" mass="{mass}"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def joint_torques(world: World) -> np.ndarray:
    """Return the torques that hold the present pose, (n,) N m, from MuJoCo's inverse dynamics."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.data.qpos
    data.qvel[:] = 0.0
    data.qacc[:] = 0.0
    mujoco.mj_inverse(world.model, data)
    return np.array([float(data.qfrc_inverse[joint.dof]) for joint in world._joints])


class Rig:
    """The levers, their servos (the elbow's turns the other way, geared two to one) and a bus."""

    def __init__(
        self, mass: float = 0.3, start: tuple[float, float] = (0.0, 0.0), twin: Twin | None = None
    ) -> None:
        plain = ArmConfig.generic("levers", ["shoulder", "elbow"], [-3, -3], [3, 3])
        elbow = dataclasses.replace(with_servo(plain.joints[1], direction=-1), gear=Direct(2.0))
        shoulder = with_twin(plain.joints[0], twin)
        self.config = dataclasses.replace(plain, joints=(shoulder, elbow))
        self.model = mujoco.MjModel.from_xml_string(ARM.format(mass=mass))
        self.clock = VirtualClock()
        self.bus = VirtualBus.from_config(self.config, self.clock, start)
        if twin is not None and twin.shadow:  # mounted the other way round, and the file says so
            self.bus.servo(twin.id).memory.set("secondary_id", 1)
            self.bus.servo(twin.id).memory.set("drive_mode", 1)
            self.bus.servo(twin.id).shaft.rotate_by(-2 * (shoulder.nearest_ticks(start[0])))
        self.world = World(self.model, self.config, self.bus)
        self.sim = SimBus(self.bus)
        self.sim.open()

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now() + seconds)

    def write(self, name: str, value: int, *ids: int) -> None:
        for id in ids or self.config.servo_ids:
            self.sim.write(id, TABLE[name], value)

    def read(self, name: str) -> list[int]:
        return [self.sim.read(id, TABLE[name]).data or 0 for id in self.config.servo_ids]

    def q(self) -> np.ndarray:
        self.bus.advance()
        return np.array(self.world.data.qpos)


@pytest.fixture
def rig() -> Callable[..., Rig]:
    return Rig


@pytest.mark.parametrize("start", [(0.0, 0.0), (0.6, -0.4), (1.5707963, 0.0), (-0.5, 2.5)])
def test_gravity_shows_up_as_current(rig: Callable[..., Rig], start: tuple[float, float]) -> None:
    """Against MuJoCo's inverse dynamics at the pose in which the arm came to rest."""
    it = rig(start=start)
    it.write("torque_enable", 1)
    it.wait(2.0)
    shoulder, elbow = (NM_PER_COUNT * count for count in it.read("present_current"))
    expected = joint_torques(it.world)
    assert shoulder == pytest.approx(expected[0], abs=1.5 * NM_PER_COUNT)
    assert elbow == pytest.approx(-expected[1] / 2.0, abs=1.5 * NM_PER_COUNT)
    # it sags a little, as a servo without integral gain does
    assert np.abs(it.q() - start).max() < 0.02
    assert it.bus.true_angles(it.config) == pytest.approx(it.q(), abs=1e-9)


def test_a_move_arrives_and_both_sides_agree(rig: Callable[..., Rig]) -> None:
    it = rig()
    it.write("profile_velocity", 60)
    it.write("profile_acceleration", 20)
    it.write("torque_enable", 1)
    wanted = np.array([0.5, -0.7])
    for joint, angle in zip(it.config.joints, wanted, strict=True):
        it.write("goal_position", joint.nearest_ticks(float(angle)), joint.servo.id)
    it.wait(0.3)
    assert it.read("moving") == [1, 1]
    it.wait(3.0)
    assert it.q() == pytest.approx(wanted, abs=0.02)
    measured = [
        j.value(t) for j, t in zip(it.config.joints, it.read("present_position"), strict=True)
    ]
    assert measured == pytest.approx(it.q(), abs=0.002)


def test_without_torque_it_falls_and_hangs(rig: Callable[..., Rig]) -> None:
    it = rig(mass=2.0)
    it.write("torque_enable", 1)
    it.wait(1.0)
    it.write("torque_enable", 0)
    assert it.read("present_current") == [0, 0]
    it.wait(0.3)
    assert it.read("present_velocity")[0] < 0  # on its way down
    it.wait(20.0)
    assert it.q()[0] == pytest.approx(-np.pi / 2, abs=0.15)
    assert it.read("present_velocity") == [0, 0]


def test_what_is_too_heavy_sinks_and_shuts_down(rig: Callable[..., Rig]) -> None:
    it = rig(mass=2.0)  # 4.6 N m at the shoulder, of 4.1
    it.write("torque_enable", 1)
    for _ in range(60):
        it.wait(0.05)
        if not it.read("torque_enable")[0]:
            break
    assert it.q()[0] < -0.2
    assert it.read("hardware_error_status")[0] == 0b100000 and it.read("torque_enable")[0] == 0


def test_current_mode_without_current_is_limp_and_holding_it_floats(
    rig: Callable[..., Rig],
) -> None:
    it = rig(mass=1.0)
    it.write("operating_mode", OperatingMode.CURRENT)
    torques = joint_torques(it.world)
    it.write("goal_current", round(torques[0] / NM_PER_COUNT), 1)
    it.write("goal_current", round(-torques[1] / 2.0 / NM_PER_COUNT), 2)
    it.write("torque_enable", 1)
    it.wait(1.0)
    assert np.abs(it.q()).max() < 0.05  # held by nothing but the current
    it.write("goal_current", 0)
    it.wait(3.0)
    assert it.q()[0] < -1.0


def test_the_bus_watchdog_stops_a_servo_that_is_not_read(rig: Callable[..., Rig]) -> None:
    it = rig(mass=0.05)
    it.write("profile_velocity", 20)
    it.write("torque_enable", 1)
    it.write("bus_watchdog", 5)
    it.write("goal_position", 4000, 1)
    it.wait(5.0)
    where = it.q()[0]
    speed = 20 * 0.229 * 2 * np.pi / 60
    assert where == pytest.approx(0.1 * speed, abs=0.03)
    assert it.read("bus_watchdog") == [-1, -1]


def test_a_jam_holds_a_joint_and_costs_current(rig: Callable[..., Rig]) -> None:
    it = rig()
    it.write("torque_enable", 1)
    it.wait(0.5)
    it.bus.servo(1).jammed = True
    it.write("goal_position", 2548, 1)
    it.wait(0.6)
    assert abs(it.q()[0]) < 0.02
    assert it.read("present_current")[0] * NM_PER_COUNT == pytest.approx(4.1, rel=0.05)


def test_a_push_from_outside_is_held_and_felt(rig: Callable[..., Rig]) -> None:
    it = rig(start=(1.5707963, 0.0))  # upright: no gravity on the shoulder
    it.write("torque_enable", 1)
    it.bus.inject(Fault("push", 1, 1.0), Fault("push", 2, 0.5))
    it.wait(1.0)
    shoulder, elbow = (NM_PER_COUNT * count for count in it.read("present_current"))
    assert (shoulder, elbow) == (pytest.approx(1.0, abs=0.1), pytest.approx(0.5, abs=0.1))


def test_a_hidden_offset_is_one_of_the_world_and_not_of_the_registers(
    rig: Callable[..., Rig],
) -> None:
    it = rig()
    it.bus.servo(1).zero_offset_ticks = 100.0
    it.write("torque_enable", 1)
    it.wait(1.0)
    assert it.read("present_position")[0] == pytest.approx(2048, abs=10)
    assert it.q()[0] == pytest.approx(100 * 2 * np.pi / 4096, abs=0.01)


def test_the_model_given_is_not_changed_and_names_must_fit(rig: Callable[..., Rig]) -> None:
    it = rig()
    fresh = mujoco.MjModel.from_xml_string(ARM.format(mass=0.3))
    assert it.model.opt.timestep == fresh.opt.timestep
    assert (it.model.dof_armature == fresh.dof_armature).all()
    wrong = ArmConfig.generic("levers", ["shoulder", "elbw"], [-3, -3], [3, 3])
    with pytest.raises(UnknownJointError, match="elbow"):
        World(fresh, wrong, VirtualBus.from_config(wrong, it.clock))


def test_the_same_arm_driver_moves_the_world(rig: Callable[..., Rig]) -> None:
    it = rig()
    with open_arm(it.config, "sim", virtual_bus=it.bus) as arm:
        arm.enable()
        begin = arm.read().q
        target = np.array([0.3, 0.4])
        for k in range(150):
            arm.clock.sleep_until(arm.clock.now() + 0.01)
            arm.send(begin + min(1.0, k / 100) * (target - begin), arm.clock.now())
        assert arm.read().q == pytest.approx(target, abs=0.03)
        assert it.q() == pytest.approx(target, abs=0.03)
    assert not any(servo.torque for servo in it.bus.servos)


TWINS = [Twin(3, direction=-1, zero_ticks=1000), Twin(3, shadow=True)]


@pytest.mark.parametrize("twin", TWINS, ids=["two ids", "shadow, reversed"])
def test_two_servos_share_one_joint_and_its_load(rig: Callable[..., Rig], twin: Twin) -> None:
    it = rig(mass=1.0, twin=twin)
    it.write("torque_enable", 1, *it.config.servo_ids)
    it.wait(1.0)
    joint = joint_torques(it.world)[0]

    def torque(id: int) -> float:
        return NM_PER_COUNT * (it.sim.read(id, TABLE["present_current"]).data or 0)

    way = -1 if twin.direction == -1 else 1  # the register of a reversed servo counts its way
    assert torque(1) == pytest.approx(joint / 2, abs=2 * NM_PER_COUNT)
    assert torque(3) == pytest.approx(way * joint / 2, abs=2 * NM_PER_COUNT)
    # With one of them limp the other carries all of it, and sags no more.
    it.write("torque_enable", 0, 3)
    it.wait(1.0)
    assert (
        torque(1) == pytest.approx(joint_torques(it.world)[0], abs=2 * NM_PER_COUNT)
        and torque(3) == 0
    )
    assert abs(it.q()[0]) < 0.03


def test_two_servos_move_their_joint_as_one(rig: Callable[..., Rig]) -> None:
    it = rig(mass=2.5, twin=TWINS[0])  # 5.5 N m at the shoulder: too much for one of 4.1
    with open_arm(it.config, "sim", virtual_bus=it.bus) as arm:
        arm.enable()
        begin = arm.read().q
        for k in range(100):
            arm.clock.sleep_until(arm.clock.now() + 0.01)
            arm.send(begin + min(1.0, k / 80) * (np.array([0.2, 0.0]) - begin), arm.clock.now())
        assert arm.read().q[0] == pytest.approx(0.2, abs=0.03)
        first = it.config.drives[0]
        second = it.config.drives[2]
        shown = [s.value(it.bus.servo(s.id).shaft.reading) for s in (first, second)]
        assert shown[0] == pytest.approx(shown[1], abs=1e-6) == pytest.approx(it.q()[0], abs=1e-6)
