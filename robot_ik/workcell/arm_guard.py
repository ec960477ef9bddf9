"""``ArmGuard``: checks the motions of an arm against the scene of its arm file.

Every joint of the arm counts at its present value, grippers too.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.errors import contact_text
from robot_ik.geometry import Array
from robot_ik.model import joint_names
from robot_ik.motion.trajectory import Trajectory
from robot_ik.robot import load_robot
from robot_ik.robot_arm import arm_collisions

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.robot import Robot


class ArmGuard:
    """Checks the motions of one arm."""

    def __init__(self, config: ArmConfig, robot: str | os.PathLike[str] | None = None) -> None:
        """Load the model and the scene.

        Args:
            config: Arm file with a table ``[collisions]``.
            robot: Name or path of the model. None for the robot of the arm file.

        Raises:
            ConfigError: As ``arm_collisions``.
            ModelError: The model cannot be read.
        """
        # Imported here, because they load the compiled collision checks, 50 ms. Few arms need them.
        from robot_ik.motion.guard import MotionGuard
        from robot_ik.motion.guarded_stream import GuardedStream

        self._robot = robot_with_followers(robot or config.robot_source, config.names)
        collisions = arm_collisions(config, self._robot)
        if collisions is None:
            raise ValueError(f"{config.name} has no table [collisions]")
        self._guard = MotionGuard(collisions)
        self._names = config.names
        # Joints of the arm that the model has, as indices in the arm and in the model.
        shared = [name for name in config.names if name in self._robot.joints]
        self._arm_indices = [config.names.index(name) for name in shared]
        self._robot_indices = [self._robot.joints.index(name) for name in shared]
        # Followers do not move by themselves.
        velocity_limits = self._spread(config.velocity, 0.0)
        acceleration_limits = self._spread(config.acceleration, 1.0)
        self._stream = GuardedStream(
            self._guard, velocity_limits, acceleration_limits, config.rate_hz
        )
        self._target = np.zeros(len(config.names))

    def checked(self, trajectory: Trajectory, positions: Mapping[str, float]) -> Trajectory:
        """Return a trajectory of some joints of the arm, if it is allowed.

        Args:
            trajectory: The motion.
            positions: Joint of the arm -> rad (m of a slide). Joints that are not in the
                trajectory stay there.

        Raises:
            MotionBlockedError: As ``MotionGuard.checked``.
        """
        rows = np.tile([positions[name] for name in self._names], (len(trajectory), 1))
        for column, name in enumerate(trajectory.joints):
            rows[:, self._names.index(name)] = trajectory.q[:, column]
        postures = np.array([self._posture(row) for row in rows])
        motion = Trajectory(trajectory.times, postures, self._robot.joints)
        clearance = self._guard.checked(motion).clearance
        return Trajectory(trajectory.times, trajectory.q, trajectory.joints, clearance=clearance)

    def begin(self, positions: Mapping[str, float]) -> None:
        """Begin a stream of commands where the joints (rad, m of a slide) are now, at rest."""
        self._target = np.array([positions[name] for name in self._names])
        self._stream.begin(self._posture(self._target))

    def send(self, arm: Arm, target: Mapping[str, float]) -> dict[str, float]:
        """Send the next command of a stream, which can always stop before parts touch.

        The joints follow ``target`` within their limits, and brake before they bring parts nearer
        than allowed. ``contact`` names the parts that limit the command.

        Args:
            arm: Enabled.
            target: Joint -> rad (m of a slide). The other joints stay.

        Returns:
            Joint -> sent command, for every joint of the arm.

        Raises:
            UnsafeCommandError: A value is not finite; nothing was sent.
        """
        if not all(map(math.isfinite, target.values())):
            arm.send(target, arm.clock.now())  # raises UnsafeCommandError
        for name, value in target.items():
            self._target[self._names.index(name)] = value
        posture = self._stream.next(self._posture(self._target))
        command = self._target.copy()
        command[self._arm_indices] = posture[self._robot_indices]
        named = {name: float(command[self._names.index(name)]) for name in target}
        sent = arm.send(named, arm.clock.now())
        self._stream.was_sent(self._posture(sent))
        return dict(zip(self._names, sent.tolist(), strict=True))

    @property
    def contact(self) -> str:
        """The parts that limit the last command of the stream. Empty if it is not limited."""
        contact = self._stream.contact
        if contact is None:
            return ""
        margin = self._guard.collisions.margin
        return contact_text(contact.pair or ("", ""), contact.distance, margin)

    def _spread(self, limits: Array, follower: float) -> Array:
        """Return limits (n,) of the arm as limits (nv,) of the model, and a limit for followers."""
        spread = np.full(self._robot.nv, follower)
        spread[self._robot_indices] = limits[self._arm_indices]
        return spread

    def _posture(self, q: Array) -> Array:
        """Return the posture (nq,) of the model with the joints of the arm at ``q`` (n,)."""
        posture = self._robot.home.copy()
        posture[self._robot_indices] = q[self._arm_indices]
        return self._robot.apply_couplings(posture)


def guard_of(config: ArmConfig, robot: str | os.PathLike[str] | None = None) -> ArmGuard | None:
    """Return the guard of an arm; None if its file has no table ``[collisions]``."""
    return None if config.collisions is None else ArmGuard(config, robot)


def robot_with_followers(name: str | os.PathLike[str], joints: Sequence[str]) -> Robot:
    """Return a robot with those of some joints that its model has, and with their followers."""
    robot = load_robot(name)
    names = joint_names(robot.model)
    moving = {joint for joint in joints if joint in names}
    leaders = {names[c.joint]: names[c.leader] for c in robot.couplings if c.leader >= 0}
    moving |= {joint for joint, leader in leaders.items() if leader in moving}
    return load_robot(name, joints=[joint for joint in names if joint in moving])
