"""The arm of a virtual bus as a MuJoCo model: one world, shared by the bus and the viewers of the model.

The servos put torques on the joints, MuJoCo moves them, and what they read is where the joints are.  A load
shows up as current, an arm without torque falls, one that is too weak sags and shuts down.  Two servos of one
joint share it: its shafts are rigidly coupled, and each gives half of what the joint needs.
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
from robot_ik.hardware.virtual import motor as drive
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.model import compiled, read_spec

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.bus import VirtualBus


STIFFNESS = 60.0
"""rad/s; natural frequency with which a servo pulls its joint to the profile.  There is no integral part (the
manual's initial Position I Gain is 0): a load of a rad/s^2 leaves it 1 / STIFFNESS^2 off its goal."""
DAMPING = 1.0
"""Critical: no overshoot that the profile has not."""


class JointMotor:
    """One servo on a joint of the world; the ``body`` of its shaft.

    ``drive`` is the servo and its joint; ``start``, rad (m), is the joint's value where this shaft stands.

    Attributes:
        position, velocity, torque: Encoder ticks, ticks/s and N m at the servo's shaft, as last seen.
        gear: rad of the shaft for one of the joint (for a metre) where it stands, signed.
        strength: N m (N) at the joint, where it stood at first.
    """

    def __init__(self, joint: _Joint, drive: Drive, servo: VirtualServo, start: float) -> None:
        self._joint = joint
        self._servo = servo
        self._drive = drive
        motor = servo.table.motor
        # A servo whose Drive Mode reverses it was mounted the other way round.
        self._sign = servo.shaft.sign
        self._ticks_per = self._sign * drive.joint.ticks_per(start, drive.servo)
        self.gear = self._ticks_per * RADIANS_PER_TICK
        self.strength = motor.stall_torque * abs(self.gear)
        self._no_load, self._stall = motor.no_load_speed, motor.stall_torque
        self.position = servo.shaft.encoder
        self.velocity = self.torque = 0.0
        # Where two shafts do not agree at first, they are coupled as they stand.
        self._zero = self.position + servo.zero_offset_ticks - self._sign * drive.position(start)

    @property
    def stuck(self) -> bool:
        """Broken, or held fast."""
        return self._servo.stuck or self._servo.jammed

    @property
    def stops(self) -> tuple[float, float]:
        """Joint values between which its shaft can turn."""
        low, high = sorted(self._angle(ticks) for ticks in self._servo.shaft.stops)
        return low, high

    def attach(self) -> None:
        """From here on the joint moves the shaft."""
        self._servo.shaft.stop()
        self._servo.shaft.body = self

    def read_encoder(self) -> None:
        angle = self._joint.angle
        self._ticks_per = self._sign * self._drive.joint.ticks_per(
            angle, self._drive.servo
        )  # of a swing arm it depends on the position
        self.gear = self._ticks_per * RADIANS_PER_TICK
        self.position = self._zero + self._sign * self._drive.position(angle) - self._servo.zero_offset_ticks
        self.velocity = self._joint.rate * self._ticks_per

    def rotate_by(self, ticks: float) -> None:
        """Somebody turns the joint by hand."""
        self._joint.put(self._angle(self.position + ticks))

    def wanted(self, t: float) -> float | None:
        """Acceleration that its controller wants, rad/s^2 (m/s^2) at the joint; None where it wants none."""
        servo, shaft = self._servo, self._servo.shaft
        servo.watch(t)
        if not shaft.powered or servo.mode in drive.TORQUE_MODES:
            return None
        position, velocity = shaft.motion.at(t)
        error = self._angle(position) - self._joint.angle
        if servo.mode == OperatingMode.VELOCITY:
            limit = 0.1 * self._drive.joint.lever  # it minds its speed, not how far it has fallen behind
            error = max(-limit, min(limit, error))
        rate = velocity / self._ticks_per - self._joint.rate
        return STIFFNESS**2 * error + 2.0 * DAMPING * STIFFNESS * rate

    def push(self, demand: float) -> float:
        """N m (N) at the joint: ``demand`` within what the motor can do and is allowed to."""
        servo = self._servo
        shaft = servo.shaft
        if not shaft.powered or shaft.stuck_at is not None:
            self.torque = 0.0
            return 0.0
        volts = shaft.volts
        stall = servo.table.motor.stall_at(volts)
        # The faster it turns, the less torque the voltage that is left can give.
        lost = self._stall / self._no_load * self._joint.rate * self.gear
        limit = servo.torque_limit(volts)
        mode = servo.mode
        torque = demand / self.gear
        if mode in drive.TORQUE_MODES:
            torque = shaft.sign * drive.effort(servo.memory, volts)
            torque -= lost if mode == OperatingMode.PWM else 0.0
            limit = stall
        torque = max(-limit, min(limit, torque))
        self.torque = max(min(-stall - lost, 0.0), min(max(stall - lost, 0.0), torque))
        return self.torque * self.gear

    def outside(self) -> float:
        return -self._servo.push * self.gear

    def _angle(self, ticks: float) -> float:
        return self._drive.value(self._sign * (ticks + self._servo.zero_offset_ticks - self._zero))


STEP = 0.002
"""s of one step of the physics."""
MAX_CATCH_UP = 30.0
"""s; of a longer silence only the last part is computed: the arm is at rest by then."""
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
        self._joints = [_Joint(self, joint, bus) for joint in config.joints]
        self._followers = _followers(self.model, {joint.dof for joint in self._joints})
        self._wanted = np.zeros(self.model.nv)
        self._force = np.zeros(self.model.nv)
        for leader, follower, share in self._followers:
            at, to = (self.model.jnt_qposadr[self.model.dof_jntid[dof]] for dof in (leader, follower))
            self.data.qpos[to] = self.model.qpos0[to] + share * (self.data.qpos[at] - self.model.qpos0[at])
        mujoco.mj_forward(self.model, self.data)
        for joint in self._joints:
            for motor in joint.motors:
                motor.attach()
        bus.world = self

    def advance(self, now: float) -> None:
        """Computes what happened up to ``now``, s on the clock of the bus."""
        self._time = max(self._time, now - MAX_CATCH_UP)
        if now - self._time < STEP:
            return
        while now - self._time >= STEP:
            self._step()
        for joint in self._joints:
            joint.read_encoders()

    def _step(self) -> None:
        model, data = self.model, self.data
        mujoco.mj_step1(model, data)
        self._wanted[:] = 0.0
        for joint in self._joints:
            self._wanted[joint.dof] = joint.wanted(self._time)
        for leader, follower, share in self._followers:
            self._wanted[follower] = share * self._wanted[leader]
        # Torque for the accelerations that the controllers want; gravity is left for them to feel.
        mujoco.mj_mulM(model, data, self._force, self._wanted)
        for leader, follower, share in self._followers:
            self._force[leader] += share * self._force[follower]
        for joint in self._joints:
            data.qfrc_applied[joint.dof] = joint.push(self._force[joint.dof])
        mujoco.mj_step2(model, data)
        for joint in self._joints:
            joint.hold()
        self._time += STEP


def _followers(model: mujoco.MjModel, driven: set[int]) -> list[tuple[int, int, float]]:
    """(leading dof, dof that an equality makes follow it, ratio): one servo moves both fingers."""
    found = []
    for k in range(model.neq):
        if model.eq_type[k] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[k] or model.eq_obj2id[k] < 0:
            continue
        follower, leader = (int(model.jnt_dofadr[j[k]]) for j in (model.eq_obj1id, model.eq_obj2id))
        if leader in driven and follower not in driven:
            found.append((leader, follower, float(model.eq_data[k][1])))
    return found


class _Joint:
    """One joint of the model, and the motors that turn it.

    Attributes:
        dof: Of the joint in the model.
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
            JointMotor(self, Drive(joint, servo), bus.servo(servo.id), start) for servo in joint.servos
        ]
        strength = sum(motor.strength for motor in self.motors)
        if not model.dof_frictionloss[self.dof]:
            model.dof_frictionloss[self.dof] = FRICTION_SHARE * strength
        if not model.dof_armature[self.dof]:
            heft = sum(motor.strength * abs(motor.gear) for motor in self.motors)
            model.dof_armature[self.dof] = heft / ROTOR_ACCELERATION
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
        """Puts it elsewhere, at rest."""
        model, data = self._world.model, self._world.data
        data.qpos[self._at], data.qvel[self.dof] = angle, 0.0
        mujoco.mj_forward(model, data)
        self.read_encoders()

    def read_encoders(self) -> None:
        for motor in self.motors:
            motor.read_encoder()

    def wanted(self, t: float) -> float:
        """Acceleration that the controllers want, rad/s^2 (m/s^2): of two the mean."""
        self._demands = [motor.wanted(t) for motor in self.motors]
        demands = [demand for demand in self._demands if demand is not None]
        return sum(demands) / len(demands) if demands else 0.0

    def push(self, force: float) -> float:
        """N m (N) at the joint of all motors together: ``force`` within what each can do and is allowed to.

        Two that want different things pull against each other, as hard as they differ.  What the fault
        ``push`` puts there is in it: the motors have to hold against that.
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
            unit, column = np.zeros(model.nv), np.zeros(model.nv)
            unit[self.dof] = 1.0
            mujoco.mj_mulM(model, self._world.data, column, unit)
            inertia = float(column[self.dof])
        total = 0.0
        for motor, demand in zip(self.motors, self._demands, strict=True):
            share = 0.0 if demand is None else (force + inertia * (demand - mean)) / len(demands)
            total += motor.push(share)
        return total + sum(motor.outside() for motor in self.motors)

    def hold(self) -> None:
        """A joint that something holds stays where it is; one that meets a stop goes no further."""
        data, q = self._world.data, self.angle
        if self._held is not None:
            q = self._held
        else:
            for motor in self.motors:
                low, high = motor.stops
                q = min(max(q, low), high)
        if q != data.qpos[self._at]:
            data.qpos[self._at] = q
            data.qvel[self.dof] = 0.0


# ------------------------------------------------------------------------------------------
# Objects to grip in a MuJoCo world: boxes that lie about and fall.

FRICTION = (1.0, 0.02, 0.0005)
"""Of rubber pads on wood: sliding, and so many metres of turning and rolling."""
SOLREF, SOLIMP = (0.004, 1.0), (0.95, 0.99, 0.0005, 0.5, 2.0)
"""As stiff as the step of the world allows: at 10 N an object of 50 g gives by less than 0.1 mm."""


@dataclass(frozen=True)
class WorldObject:
    """A box that lies about; ``name``: of its body."""

    name: str
    position: tuple[float, float, float]  # centre, m, world
    size: tuple[float, float, float]  # edges, m
    mass: float  # kg
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


def model_with(path: Path, objects: Sequence[WorldObject], floor: float | None = None) -> mujoco.MjModel:
    """The model of a robot with objects beside it, for a ``World`` with contacts.

    ``floor``: height of a plane to lie on, m; None: there is none.

    Raises:
        ModelError: It cannot be read.
        ValueError: MuJoCo cannot compile it, e.g. a name is taken.
    """
    spec, _ = read_spec(path, path)
    for key in list(spec.keys):
        spec.delete(key)  # they know nothing of the objects' positions
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.noslip_iterations = 3  # else a grip creeps
    if floor is not None:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.01], pos=[0, 0, floor])
    for one in objects:
        body = spec.worldbody.add_body(name=one.name, pos=one.position, quat=one.wxyz)
        body.add_freejoint()
        geom = body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5 * edge for edge in one.size], mass=one.mass
        )
        geom.condim, geom.priority, geom.friction = 4, 1, FRICTION
        geom.solref, geom.solimp = SOLREF, SOLIMP
    return compiled(spec)
