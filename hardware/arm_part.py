"""Some joints of an arm as vectors: the joints of a robot, without the gripper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import UnsafeCommandError
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import Array, JointReading


class ArmPart:
    """Some joints of an arm, in an order of their own: a ``JointSink`` and a ``JointSource``.

    The other joints of the arm keep their last command.

    Args:
        arm: Arm.
        joints: n names of its joints.

    Attributes:
        arm: Arm.
        joints: Names in the order of every vector of the part.
        config: Arm file with these joints only, in this order.
    """

    def __init__(self, arm: Arm, joints: Sequence[str]) -> None:
        self.arm = arm
        self.joints = tuple(joints)
        self.config: ArmConfig = arm.config.only(self.joints)
        self._order = [arm.joints.index(name) for name in self.joints]

    def send(self, q: ArrayLike, now: float) -> Array:
        """Send joint values to the servos; see ``Arm.send``.

        Args:
            q: (n,) joint values, rad or m.
            now: Time for which ``q`` is meant, s.

        Returns:
            (n,) the joint values that were sent: ``q`` within limits and caps.
        """
        if self.joints == self.arm.joints:
            return self.arm.send(q, now)
        values = np.asarray(q)
        if values.shape != (len(self.joints),):
            raise UnsafeCommandError(
                f"a command of shape {values.shape}",
                f"{len(self.joints)} values, one for each of {', '.join(self.joints)}",
            )
        return self.arm.send(dict(zip(self.joints, values.tolist(), strict=True)), now)[self._order]

    def read(self) -> JointReading:
        """Return the measured values and velocities (n,) of these joints; see ``Arm.read``."""
        reading = self.arm.read()
        dq = None if reading.dq is None else reading.dq[self._order]
        return JointReading(reading.q[self._order], reading.time, dq)
