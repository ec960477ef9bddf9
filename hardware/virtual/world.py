"""The arm of a virtual bus as a MuJoCo model: one world, seen from the bus and by whoever looks at the model.

The servos put torques on the joints, MuJoCo moves them, and what they read is where the joints are.  A load
shows up as current, an arm without torque falls, one that is too weak sags and shuts down.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from robot_ik.errors import UnknownJointError
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.control_table import RADIANS_PER_TICK, OperatingMode
from robot_ik.hardware.virtual import drive
from robot_ik.hardware.virtual.servo import VirtualServo

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.ports import Array

STEP = 0.002
"""s of one step of the physics."""
LONGEST = 30.0
"""s; of a longer silence only the last part is computed: the arm is at rest by then."""
STIFFNESS = 60.0
"""rad/s; natural frequency with which a servo pulls its joint to the profile.  There is no integral part (the
manual's initial Position I Gain is 0): a load of a rad/s^2 leaves it 1 / STIFFNESS^2 off its goal."""
DAMPING = 1.0
"""Critical: no overshoot that the profile has not."""
FRICTION_SHARE = 0.03
"""Of the stall torque; friction of the gear, where the model of the arm has none of its own."""
ROTOR_ACCELERATION = 300.0
"""rad/s^2 of an unloaded shaft at stall torque: what the rotor weighs, where the model says nothing."""


class World:
    """A model of an arm and the servos that move it.

    Args:
        model: Kept as it is; a copy is changed.  Its actuators are not used.
        config: Which servo turns which joint.
        bus: Its servos; the joints are put where they stand, and from here on they move its shafts.
        contacts: Bodies touch.  Off by default: models of arms often touch themselves.

    Attributes:
        model, data: The world; only ``advance`` changes it, with the lock of the bus held.

    Raises:
        UnknownJointError: The model has no joint of that name.
    """

    def __init__(
        self, model: mujoco.MjModel, config: ArmConfig, bus: VirtualBus, *, contacts: bool = False
    ) -> None:
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self._time = bus.clock.now()
        options = self.model.opt
        options.timestep = STEP
        options.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        options.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        if not contacts:
            options.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self._joints = [_Joint(self, joint, bus.servo(joint.id)) for joint in config.joints]
        self._wanted = np.zeros(self.model.nv)
        self._force = np.zeros(self.model.nv)
        mujoco.mj_forward(self.model, self.data)
        for joint in self._joints:
            joint.attach()
        bus.world = self

    def advance(self, now: float) -> None:
        """Computes what happened up to ``now``, s on the clock of the bus."""
        self._time = max(self._time, now - LONGEST)
        if now - self._time < STEP:
            return
        while now - self._time >= STEP:
            self._step()
        for joint in self._joints:
            joint.look()

    def _step(self) -> None:
        model, data = self.model, self.data
        mujoco.mj_step1(model, data)
        self._wanted[:] = 0.0
        for joint in self._joints:
            self._wanted[joint.dof] = joint.wanted(self._time)
        # Torque for the accelerations that the controllers want; gravity is left for them to feel.
        mujoco.mj_mulM(model, data, self._force, self._wanted)
        for joint in self._joints:
            data.qfrc_applied[joint.dof] = joint.push(self._force[joint.dof]) + joint.outside()
        mujoco.mj_step2(model, data)
        for joint in self._joints:
            joint.hold()
        self._time += STEP


class _Joint:
    """One joint and its servo; the ``Body`` of that servo's shaft.

    Attributes:
        position, velocity, torque: Encoder ticks, ticks/s and N m at the servo's shaft, as last seen.
        dof: Of the joint in the model.
    """

    def __init__(self, world: World, joint: JointMap, servo: VirtualServo) -> None:
        model = world.model
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint.name)
        if number < 0:
            names = [model.joint(k).name for k in range(model.njnt)]
            raise UnknownJointError(joint.name, names)
        self.dof = int(model.jnt_dofadr[number])
        self._at = int(model.jnt_qposadr[number])
        self._world, self._map, self._servo = world, joint, servo
        motor = servo.table.motor
        # N m at the joint for one at the shaft, and ticks for a radian: both signed.
        self._gear = joint.direction * joint.ratio
        self._no_load = motor.no_load_speed
        self._stall = motor.stall_torque
        strength = motor.stall_torque * joint.ratio
        if not model.dof_frictionloss[self.dof]:
            model.dof_frictionloss[self.dof] = FRICTION_SHARE * strength
        if not model.dof_armature[self.dof]:
            model.dof_armature[self.dof] = strength * joint.ratio / ROTOR_ACCELERATION
        self.position = servo.shaft.encoder
        self.velocity = self.torque = 0.0
        self._held: float | None = None
        world.data.qpos[self._at] = self._angle(self.position)

    def attach(self) -> None:
        """From here on the joint moves the shaft."""
        self._servo.shaft.stop()
        self._servo.shaft.body = self

    def look(self) -> None:
        """What the encoder says now."""
        data = self._world.data
        self.position = self._ticks(float(data.qpos[self._at]))
        self.velocity = float(data.qvel[self.dof]) * self._map.ticks_per_radian

    def turn_by(self, ticks: float) -> None:
        """Somebody turns the joint by hand."""
        self._world.data.qpos[self._at] = self._angle(self.position + ticks)
        self._world.data.qvel[self.dof] = 0.0
        mujoco.mj_forward(self._world.model, self._world.data)
        self.look()

    def wanted(self, t: float) -> float:
        """Acceleration that the position or velocity controller wants, rad/s^2 at the joint."""
        servo, data = self._servo, self._world.data
        servo.controller.watch(t)
        shaft = servo.shaft
        if not shaft.powered or servo.memory.get("operating_mode") in drive.TORQUE_MODES:
            return 0.0
        position, velocity = shaft.motion.at(t)
        q, dq = float(data.qpos[self._at]), float(data.qvel[self.dof])
        error = self._angle(position) - q
        if servo.memory.get("operating_mode") == OperatingMode.VELOCITY:
            error = max(-0.1, min(0.1, error))  # it minds its speed, not how far it has fallen behind
        rate = velocity / self._map.ticks_per_radian - dq
        return STIFFNESS**2 * error + 2.0 * DAMPING * STIFFNESS * rate

    def push(self, wish: float) -> float:
        """Torque at the joint, N m: ``wish`` within what the motor can do and is allowed to."""
        servo = self._servo
        shaft = servo.shaft
        self._hold_if_told()
        if not shaft.powered or shaft.stuck_at is not None:
            self.torque = 0.0
            return 0.0
        volts = shaft.volts
        stall = self._stall * volts / servo.table.motor.volts
        # The faster it turns, the less torque the voltage that is left can give.
        lost = stall * self._speed() / (self._no_load * volts / servo.table.motor.volts)
        limit = drive.torque_limit(servo.memory, volts)
        mode = servo.memory.get("operating_mode")
        torque = wish / self._gear
        if mode in drive.TORQUE_MODES:
            torque = shaft.sign * drive.effort(servo.memory, volts)
            torque -= lost if mode == OperatingMode.PWM else 0.0
            limit = stall
        torque = max(-limit, min(limit, torque))
        self.torque = max(min(-stall - lost, 0.0), min(max(stall - lost, 0.0), torque))
        return self.torque * self._gear

    def outside(self) -> float:
        """Torque at the joint that the fault ``push`` puts there, N m: the motor has to hold against it."""
        return -self._servo.shaft.load.push * self._gear

    def hold(self) -> None:
        """A joint that something holds stays where it is."""
        if self._held is not None:
            self._world.data.qpos[self._at] = self._held
            self._world.data.qvel[self.dof] = 0.0

    def _hold_if_told(self) -> None:
        shaft = self._servo.shaft
        held = shaft.stuck_at is not None or shaft.stops[0] == shaft.stops[1]
        if held and self._held is None:
            self._held = float(self._world.data.qpos[self._at])
        elif not held:
            self._held = None

    def _speed(self) -> float:
        """rad/s of the shaft."""
        return float(self._world.data.qvel[self.dof]) * self._map.ticks_per_radian * RADIANS_PER_TICK

    def _angle(self, ticks: float) -> float:
        return self._map.to_radians(ticks + self._servo.zero_offset_ticks)

    def _ticks(self, angle: float) -> float:
        return self._map.zero_ticks + self._map.ticks_per_radian * angle - self._servo.zero_offset_ticks


def joint_torques(world: World) -> Array:
    """(n,) N m at the joints that hold the arm at its present pose, from MuJoCo's inverse dynamics."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = world.data.qpos
    data.qvel[:] = 0.0
    data.qacc[:] = 0.0
    mujoco.mj_inverse(world.model, data)
    return np.array([float(data.qfrc_inverse[joint.dof]) for joint in world._joints])
