"""The arm of a virtual bus as a MuJoCo model: a world shared by the bus and the viewers.

The servos put torques on the joints, MuJoCo moves the joints, and the servos read where the joints
are. A load shows as current. An arm without torque falls. An arm that is too weak sags and shuts
down. Two servos of one joint are rigidly coupled, and each gives half of what the joint needs.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from robot_ik.errors import UnknownJointError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.registers import RADIANS_PER_TICK, OperatingMode
from robot_ik.hardware.servo import Drive, Joint
from robot_ik.hardware.virtual.motor import TORQUE_MODES, effort
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.model import compiled, read_spec

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.bus import VirtualBus


STIFFNESS = 60.0
"""rad/s. Natural frequency with which a servo pulls its joint to the profile.

There is no integral part, because the manual's initial Position I Gain is 0. A load of 1 rad/s^2
leaves the joint 1 / STIFFNESS^2 from its goal.
"""
DAMPING = 1.0
"""Critical damping: no overshoot beyond that of the profile."""


class JointMotor:
    """One servo on a joint of the world; the ``body`` of its shaft.

    Args:
        joint: Joint of the world.
        drive: Joint and servo of the arm file.
        servo: Virtual servo.
        start: Joint value where this shaft stands, rad (m).

    Attributes:
        position: Encoder ticks, as last read.
        velocity: ticks/s of the encoder, as last read.
        torque: N m at the servo's shaft.
        gear: rad of the shaft for one rad (m) of the joint at its present value, signed.
        strength: N m (N) at the joint, at its first value.
    """

    def __init__(self, joint: _Joint, drive: Drive, servo: VirtualServo, start: float) -> None:
        self._joint = joint
        self._servo = servo
        self._drive = drive
        motor = servo.table.motor
        # A servo with a reversed Drive Mode is mounted the other way round.
        self._sign = servo.shaft.sign
        self._ticks_per = self._sign * drive.joint.ticks_per(start, drive.servo)
        self.gear = self._ticks_per * RADIANS_PER_TICK
        self.strength = motor.stall_torque * abs(self.gear)
        self._no_load = motor.no_load_speed
        self._stall = motor.stall_torque
        self.position = servo.shaft.encoder
        self.velocity = 0.0
        self.torque = 0.0
        # Two shafts that do not agree at first are coupled as they stand.
        self._zero = self.position + servo.zero_offset_ticks - self._sign * drive.position(start)

    @property
    def stuck(self) -> bool:
        """The gear is broken, or the shaft is held."""
        return self._servo.stuck or self._servo.jammed

    @property
    def stops(self) -> tuple[float, float]:
        """Joint values between which the shaft can turn."""
        low, high = sorted(self._angle(ticks) for ticks in self._servo.shaft.stops)
        return low, high

    def attach(self) -> None:
        """Let the joint move the shaft from now on."""
        self._servo.shaft.stop()
        self._servo.shaft.body = self

    def read_encoder(self) -> None:
        """Set position and velocity of the encoder from the joint."""
        angle = self._joint.angle
        self._ticks_per = self._sign * self._drive.joint.ticks_per(
            angle, self._drive.servo
        )  # of a swing arm this depends on the position
        self.gear = self._ticks_per * RADIANS_PER_TICK
        self.position = (
            self._zero + self._sign * self._drive.position(angle) - self._servo.zero_offset_ticks
        )
        self.velocity = self._joint.rate * self._ticks_per

    def rotate_by(self, ticks: float) -> None:
        """Turn the joint as a hand does."""
        self._joint.put(self._angle(self.position + ticks))

    def acceleration_demand(self, t: float) -> float | None:
        """Return the acceleration that the controller demands at the joint, rad/s^2 (m/s^2).

        None if the servo has no torque or no position goal.
        """
        servo = self._servo
        shaft = self._servo.shaft
        servo.watch(t)
        if not shaft.powered or servo.mode in TORQUE_MODES:
            return None
        position, velocity = shaft.motion.at(t)
        error = self._angle(position) - self._joint.angle
        if servo.mode == OperatingMode.VELOCITY:
            # This limits the distance of the goal from a blocked joint.
            limit = 0.1 * self._drive.joint.lever
            error = max(-limit, min(limit, error))
        rate = velocity / self._ticks_per - self._joint.rate
        return STIFFNESS**2 * error + 2.0 * DAMPING * STIFFNESS * rate

    def push(self, demand: float) -> float:
        """Return ``demand`` in N m (N) at the joint, within the limits of the motor."""
        servo = self._servo
        shaft = servo.shaft
        if not shaft.powered or shaft.stuck_at is not None:
            self.torque = 0.0
            return 0.0
        volts = shaft.volts
        stall = servo.table.motor.stall_at(volts)
        # Back EMF: the faster the shaft turns, the less torque is left.
        lost = self._stall / self._no_load * self._joint.rate * self.gear
        limit = servo.torque_limit(volts)
        mode = servo.mode
        torque = demand / self.gear
        if mode in TORQUE_MODES:
            torque = shaft.sign * effort(servo.memory, volts)
            torque -= lost if mode == OperatingMode.PWM else 0.0
            limit = stall
        torque = max(-limit, min(limit, torque))
        self.torque = max(min(-stall - lost, 0.0), min(max(stall - lost, 0.0), torque))
        return self.torque * self.gear

    def outside(self) -> float:
        """Return the torque of the fault ``push`` at the joint, N m (N)."""
        return -self._servo.push * self.gear

    def _angle(self, ticks: float) -> float:
        return self._drive.value(self._sign * (ticks + self._servo.zero_offset_ticks - self._zero))


STEP = 0.002
"""s of one step of the physics."""
MAX_CATCH_UP = 30.0
"""s. After a longer silence only the last part is computed: the arm is at rest by then."""
FRICTION_SHARE = 0.03
"""Share of the stall torque: friction of a gear for which the model has none."""
ROTOR_ACCELERATION = 300.0
"""rad/s^2 of an unloaded shaft at stall torque, for a joint without armature in the model."""


class World:
    """A model of an arm and the servos that move it.

    Args:
        model: Model of the arm. It is copied, and its actuators are not used.
        config: Arm file, which assigns servos to joints.
        bus: Virtual bus. The joints start where its shafts stand, and then move them.
        contacts: Bodies touch. Off by default: models of arms often touch themselves.

    Attributes:
        model: Model of the world.
        data: State of the world. Only ``advance`` changes it, under the lock of the bus.

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
        self._joints = [_Joint(self, joint, bus) for joint in config.joints]
        self._followers = _followers(self.model, {joint.dof for joint in self._joints})
        self._accelerations = np.zeros(self.model.nv)
        self._force = np.zeros(self.model.nv)
        for leader, follower, share in self._followers:
            at, to = (
                self.model.jnt_qposadr[self.model.dof_jntid[dof]] for dof in (leader, follower)
            )
            self.data.qpos[to] = self.model.qpos0[to] + share * (
                self.data.qpos[at] - self.model.qpos0[at]
            )
        mujoco.mj_forward(self.model, self.data)
        for joint in self._joints:
            for motor in joint.motors:
                motor.attach()
        bus.world = self

    def advance(self, now: float) -> None:
        """Compute the motion up to ``now``, s on the clock of the bus."""
        self._time = max(self._time, now - MAX_CATCH_UP)
        if now - self._time < STEP:
            return
        while now - self._time >= STEP:
            self._step()
        for joint in self._joints:
            joint.read_encoders()

    def _step(self) -> None:
        model = self.model
        data = self.data
        mujoco.mj_step1(model, data)
        self._accelerations[:] = 0.0
        for joint in self._joints:
            self._accelerations[joint.dof] = joint.acceleration_demand(self._time)
        for leader, follower, share in self._followers:
            self._accelerations[follower] = share * self._accelerations[leader]
        # Torque for the demanded accelerations. Gravity is not compensated.
        mujoco.mj_mulM(model, data, self._force, self._accelerations)
        for leader, follower, share in self._followers:
            self._force[leader] += share * self._force[follower]
        for joint in self._joints:
            data.qfrc_applied[joint.dof] = joint.push(self._force[joint.dof])
        mujoco.mj_step2(model, data)
        for joint in self._joints:
            joint.hold()
        self._time += STEP


def _followers(model: mujoco.MjModel, driven: set[int]) -> list[tuple[int, int, float]]:
    """Return (leading dof, following dof, ratio) of equality constraints.

    With such a constraint one servo moves both fingers of a gripper.
    """
    followers = []
    for k in range(model.neq):
        if (
            model.eq_type[k] != mujoco.mjtEq.mjEQ_JOINT
            or not model.eq_active0[k]
            or model.eq_obj2id[k] < 0
        ):
            continue
        follower, leader = (int(model.jnt_dofadr[j[k]]) for j in (model.eq_obj1id, model.eq_obj2id))
        if leader in driven and follower not in driven:
            followers.append((leader, follower, float(model.eq_data[k][1])))
    return followers


class _Joint:
    """One joint of the model and the motors that turn it.

    Attributes:
        dof: Index of the joint's degree of freedom.
        motors: Its motors.
    """

    def __init__(self, world: World, joint: Joint, bus: VirtualBus) -> None:
        model = world.model
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint.name)
        if number < 0:
            names = [model.joint(k).name for k in range(model.njnt)]
            raise UnknownJointError(joint.name, names)
        self.dof = int(model.jnt_dofadr[number])
        self._at = int(model.jnt_qposadr[number])
        self._world = world
        first = bus.servo(joint.servo.id)
        start = joint.value(
            (-1 if joint.servo.reverse else 1) * (first.shaft.encoder + first.zero_offset_ticks)
        )
        world.data.qpos[self._at] = start
        self.motors = [
            JointMotor(self, Drive(joint, servo), bus.servo(servo.id), start)
            for servo in joint.servos
        ]
        strength = sum(motor.strength for motor in self.motors)
        if not model.dof_frictionloss[self.dof]:
            model.dof_frictionloss[self.dof] = FRICTION_SHARE * strength
        if not model.dof_armature[self.dof]:
            torque = sum(motor.strength * abs(motor.gear) for motor in self.motors)
            model.dof_armature[self.dof] = torque / ROTOR_ACCELERATION
        self._held: float | None = None
        self._demands: list[float | None] = []

    @property
    def angle(self) -> float:
        """rad (m)."""
        return float(self._world.data.qpos[self._at])

    @property
    def rate(self) -> float:
        """rad/s (m/s)."""
        return float(self._world.data.qvel[self.dof])

    def put(self, angle: float) -> None:
        """Place the joint at ``angle`` at rest."""
        model = self._world.model
        data = self._world.data
        data.qpos[self._at] = angle
        data.qvel[self.dof] = 0.0
        mujoco.mj_forward(model, data)
        self.read_encoders()

    def read_encoders(self) -> None:
        """Set the encoders of all motors from the joint."""
        for motor in self.motors:
            motor.read_encoder()

    def acceleration_demand(self, t: float) -> float:
        """Return the acceleration that the controllers demand, the mean of two, rad/s^2 (m/s^2)."""
        self._demands = [motor.acceleration_demand(t) for motor in self.motors]
        demands = [demand for demand in self._demands if demand is not None]
        return sum(demands) / len(demands) if demands else 0.0

    def push(self, force: float) -> float:
        """Return the torque of all motors together at the joint, N m (N), within their limits.

        Two motors with different goals pull against each other, harder the more they differ. The
        fault ``push`` is included: the motors must hold against it.
        """
        if not any(motor.stuck for motor in self.motors):
            self._held = None
        elif self._held is None:
            self._held = self.angle
        demands = [demand for demand in self._demands if demand is not None]
        mean = sum(demands) / len(demands) if demands else 0.0
        inertia = 0.0
        if len(demands) > 1:
            model = self._world.model
            unit = np.zeros(model.nv)
            column = np.zeros(model.nv)
            unit[self.dof] = 1.0
            mujoco.mj_mulM(model, self._world.data, column, unit)
            inertia = float(column[self.dof])
        total = 0.0
        for motor, demand in zip(self.motors, self._demands, strict=True):
            share = 0.0 if demand is None else (force + inertia * (demand - mean)) / len(demands)
            total += motor.push(share)
        return total + sum(motor.outside() for motor in self.motors)

    def hold(self) -> None:
        """Keep a held joint where it is, and stop a joint at its stops."""
        data = self._world.data
        q = self.angle
        if self._held is not None:
            q = self._held
        else:
            for motor in self.motors:
                low, high = motor.stops
                q = min(max(q, low), high)
        if q != data.qpos[self._at]:
            data.qpos[self._at] = q
            data.qvel[self.dof] = 0.0


FRICTION = (1.0, 0.02, 0.0005)
"""Friction of rubber pads on wood: sliding, torsional (m), rolling (m)."""
SOLREF = (0.004, 1.0)
"""Contact stiffness of objects, with ``SOLIMP``.

As stiff as the step of the world allows: at 10 N an object of 50 g gives by less than 0.1 mm.
"""
SOLIMP = (0.95, 0.99, 0.0005, 0.5, 2.0)
"""Contact impedance of objects."""


@dataclass(frozen=True)
class WorldObject:
    """A box beside the robot that can be moved and gripped.

    Attributes:
        name: Name of its body.
        position: Centre in the world frame, m.
        size: Edge lengths, m.
        mass: kg.
        wxyz: Orientation in the world frame.
    """

    name: str
    position: tuple[float, float, float]
    size: tuple[float, float, float]
    mass: float
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


def model_with(
    path: Path, objects: Sequence[WorldObject], floor: float | None = None
) -> mujoco.MjModel:
    """Return the model of a robot with objects beside it, for a ``World`` with contacts.

    Args:
        path: Model of the robot.
        objects: Objects.
        floor: Height of a floor plane, m; None: no floor.

    Raises:
        ModelError: The model cannot be read.
        ValueError: MuJoCo cannot compile it, for example because a name is in use.
    """
    spec, _ = read_spec(path, path)
    for key in list(spec.keys):
        spec.delete(key)  # keyframes have no positions for the objects
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.noslip_iterations = 3  # without it a grip creeps
    if floor is not None:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.01], pos=[0, 0, floor]
        )
    for item in objects:
        body = spec.worldbody.add_body(name=item.name, pos=item.position, quat=item.wxyz)
        body.add_freejoint()
        geom = body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5 * edge for edge in item.size], mass=item.mass
        )
        geom.condim = 4
        geom.priority = 1
        geom.friction = FRICTION
        geom.solref = SOLREF
        geom.solimp = SOLIMP
    return compiled(spec)
