"""An arm that a person guides, as the leader of another arm.

Joint to joint, a value of the leader goes to the follower's joint of the same name, each range onto
the other's.  Hand to hand, the follower's hand repeats what the leader's has done since they were
engaged.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from robot_ik.errors import ConfigError, HardwareError
from robot_ik.geometry import Pose
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.jobs.led_hand import LedHand
from robot_ik.jobs.operator import Angles, Operator

LOST = 0.2
"""s without a good sample of the leader after which it counts as lost.

A wire loses a packet now and then.
"""


class JointCoupling:
    """Maps values of a leader to those of a follower: by name, each range onto the other's.

    Args:
        leader: Arm file.
        follower: Arm file.

    Attributes:
        names: Joints that both have, those of grippers too.

    Raises:
        ConfigError: They share no joint.
    """

    def __init__(self, leader: ArmConfig, follower: ArmConfig) -> None:
        joints = [joint for joint in leader.joints if joint.name in follower.names]
        if not joints:
            raise ConfigError(
                f"no joint of {leader.name} is one of {follower.name}",
                file=leader.file or leader.name,
                key="joints",
                allowed=f"names of {', '.join(follower.names)}; or hand to hand: --by hand",
            )
        self.names = tuple(joint.name for joint in joints)
        self._leader_limits = {joint.name: joint.limits for joint in joints}
        self._follower_limits = {name: follower.joint(name).limits for name in self.names}

    def follower(self, leader: Angles) -> dict[str, float]:
        """Return values of the follower.  Beyond an end of a range it stays there."""
        return {
            name: float(
                np.interp(leader[name], self._leader_limits[name], self._follower_limits[name])
            )
            for name in self.names
        }

    def leader(self, follower: Angles) -> dict[str, float]:
        """Return values of the leader.  Beyond an end of a range it stays there."""
        return {
            name: float(
                np.interp(follower[name], self._follower_limits[name], self._leader_limits[name])
            )
            for name in self.names
        }


class LeaderArm(Operator):
    """An arm that a person guides.  Its torque is off, unless it pushes back.

    Args:
        arm: Connected.
        follower: Arm file of the follower.
        by: ``joints`` or ``hand``.
        scale: Hand to hand: metres of the follower for one of the leader.
        force: Share of its currents by which the leader is pushed to where the follower is; 0:
            none.

    Raises:
        ConfigError: They share no joint, or these servos cannot be pushed gently.
    """

    def __init__(
        self,
        arm: Arm,
        follower: ArmConfig,
        by: Literal["joints", "hand"],
        scale: float,
        force: float,
    ) -> None:
        self._arm = arm
        self._scale = scale
        self._force = force
        self._coupling: JointCoupling | None = None
        # Poses of the leader's and the follower's hand at which they were engaged.
        self._engaged_poses: tuple[Pose, Pose] | None = None
        self._last_values: dict[str, float] = {}
        self._last_time = -np.inf
        if by == "joints":
            self._coupling = JointCoupling(arm.config, follower)
        else:
            self._leader_hand = LedHand(arm.config)
            self._follower_hand = LedHand(follower)
        if force:
            self._require_gentle()

    def _require_gentle(self) -> None:
        """Check that every servo of the leader can push with a limited current."""
        stiff = [joint.name for joint in self._arm.config.joints if not joint.servo.presses]
        if not stiff and self._coupling is not None:
            return
        problem = (
            "force feedback needs a leader whose servos push with a limited current, joint to joint"
        )
        if stiff:
            problem += f"; {', '.join(stiff)} cannot"
        raise ConfigError(
            problem,
            file=self._arm.config.file or self._arm.config.name,
            key="mode",
            allowed="current_based_position for every joint, or no --force-feedback",
        )

    def engage(self, follower: Angles) -> None:
        if self._coupling is None:
            self._follower_hand.engage(follower)
            leader_pose = self._leader_hand.engage(self._read())
            self._engaged_poses = (leader_pose, self._follower_hand.pose)
        elif self._force and self._arm.state is ArmState.CONNECTED:
            self._arm.enable()
            joints = self._arm.config.joints
            currents = {joint.name: joint.current for joint in joints if joint.current is not None}
            self._arm.limit_current({name: self._force * mA for name, mA in currents.items()})

    def command(self, now: float) -> Angles:  # noqa: ARG002 - the leader gives its present values
        values = self._read()
        if self._coupling is not None:
            return self._coupling.follower(values)
        if self._engaged_poses is None:
            raise RuntimeError("command() before engage()")
        leader, follower = self._engaged_poses
        pose = self._leader_hand.engage(values)
        step = self._scale * (pose.position - leader.position)
        rotation = pose.rotation @ leader.rotation.T @ follower.rotation
        return self._follower_hand.go(Pose.from_rotation(rotation, follower.position + step))

    def feel(self, follower: Angles) -> None:
        has_torque = self._arm.state is not ArmState.CONNECTED
        if self._force and self._coupling is not None and has_torque:
            target = self._coupling.leader(follower)
            command = {name: target[name] for name in self._arm.joints if name in target}
            self._arm.send(command, self._arm.clock.now())

    def recover(self, timeout: float) -> None:
        self._arm.reconnect(timeout)
        self._last_values = {}
        self._last_time = -np.inf

    def _read(self) -> dict[str, float]:
        """Return joint -> value, measured now, or for ``LOST`` s the last measured one."""
        now = self._arm.clock.now()
        try:
            self._arm.read()
            if float(self._arm.ages.max()) > LOST:
                raise HardwareError(
                    "the leader does not answer", hint="look at its cable and supply"
                )
        except HardwareError:
            if now - self._last_time > LOST:
                raise
            return self._last_values
        self._last_values = self._arm.positions()
        self._last_time = now
        return self._last_values
