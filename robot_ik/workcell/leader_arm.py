"""An arm that a person guides, as the leader of another arm.

In the mode ``joints`` each joint of the follower takes the value of the leader's joint of the same
name, mapped from the range of the leader to that of the follower.  In the mode ``tool`` the
follower's tool repeats the motion of the leader's tool since both were engaged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from robot_ik.errors import ConfigError, HardwareError
from robot_ik.geometry import Pose
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.workcell.operator import Angles, Operator
from robot_ik.workcell.tool_follower import ToolFollower

LOST = 0.2
"""s without a good sample of the leader after which it counts as lost.

Single lost packets are usual and must not end the teleoperation.
"""


_Limits = Mapping[str, tuple[float, float]]
"""Joint -> lower and upper limit, rad (m of a slide)."""


class JointCoupling:
    """Maps joint values of a leader to a follower, by joint name, from range to range.

    Args:
        leader: Arm file.
        follower: Arm file.

    Attributes:
        names: Joints that both have, those of grippers too.

    Raises:
        ConfigError: The two arms share no joint.
    """

    def __init__(self, leader: ArmConfig, follower: ArmConfig) -> None:
        joints = [joint for joint in leader.joints if joint.name in follower.names]
        if not joints:
            raise ConfigError(
                f"no joint of {leader.name} is one of {follower.name}",
                file=leader.file or leader.name,
                key="joints",
                allowed=f"names of {', '.join(follower.names)}; or tool to tool: --mode tool",
            )
        self.names = tuple(joint.name for joint in joints)
        self._leader_limits = {joint.name: joint.limits for joint in joints}
        self._follower_limits = {name: follower.joint(name).limits for name in self.names}

    def follower(self, leader: Angles) -> dict[str, float]:
        """Return the values of the follower, clipped to its ranges."""
        return _mapped(leader, self._leader_limits, self._follower_limits)


def _mapped(values: Angles, source: _Limits, target: _Limits) -> dict[str, float]:
    """Return values mapped linearly from one range to another, clipped at its ends.

    Args:
        values: Joint -> value, rad (m of a slide).
        source: Joint -> lower and upper limit of ``values``.
        target: Joint -> lower and upper limit of the result.
    """
    return {
        name: float(np.interp(values[name], ends, target[name])) for name, ends in source.items()
    }


class LeaderArm(Operator):
    """An arm that a person guides.  Its torque is off.

    Args:
        arm: Connected.
        follower: Arm file of the follower.
        mode: ``joints`` or ``tool``.
        scale: In the mode ``tool``: metres of the follower for one metre of the leader.

    Raises:
        ConfigError: The two arms share no joint.
    """

    def __init__(
        self,
        arm: Arm,
        follower: ArmConfig,
        mode: Literal["joints", "tool"],
        scale: float,
    ) -> None:
        self._arm = arm
        self._scale = scale
        self._coupling: JointCoupling | None = None
        # Poses of the leader's and the follower's tool at which they were engaged.
        self._engaged_poses: tuple[Pose, Pose] | None = None
        self._last_values: dict[str, float] = {}
        self._last_time = -np.inf
        if mode == "joints":
            self._coupling = JointCoupling(arm.config, follower)
        else:
            self._leader_tool = ToolFollower(arm.config)
            self._follower_tool = ToolFollower(follower)

    def engage(self, follower: Angles) -> None:
        if self._coupling is None:
            self._follower_tool.engage(follower)
            leader_pose = self._leader_tool.engage(self._read())
            self._engaged_poses = (leader_pose, self._follower_tool.pose)

    def command(self, now: float) -> Angles:  # noqa: ARG002 - the leader gives its present values
        values = self._read()
        if self._coupling is not None:
            return self._coupling.follower(values)
        if self._engaged_poses is None:
            raise RuntimeError("command() before engage()")
        leader, follower = self._engaged_poses
        pose = self._leader_tool.engage(values)
        step = self._scale * (pose.position - leader.position)
        rotation = pose.rotation @ leader.rotation.T @ follower.rotation
        return self._follower_tool.go(Pose.from_rotation(rotation, follower.position + step))

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
                raise HardwareError("the leader does not answer", hint="check its cable and supply")
        except HardwareError:
            if now - self._last_time > LOST:
                raise
            return self._last_values
        self._last_values = self._arm.positions()
        self._last_time = now
        return self._last_values
