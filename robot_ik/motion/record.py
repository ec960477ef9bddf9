"""`RecorderSink`: keeps what was sent, and gives it back as a `Trajectory`."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from robot_ik.errors import TrajectoryError
from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Array


class RecorderSink:
    """A `JointSink` that remembers every joint vector and its time.

    Args:
        joints: Names of the nq columns.
    """

    def __init__(self, joints: Iterable[str]) -> None:
        self.joints = tuple(joints)
        self._times: list[float] = []
        self._q: list[Array] = []

    def __len__(self) -> int:
        return len(self._times)

    def send(self, q: Array, now: float) -> None:
        """Keeps a copy of ``q`` (nq,) for ``now`` in seconds; a second one for that time replaces it.

        Raises:
            TrajectoryError: ``now`` is earlier than the last one, or ``q`` has the wrong length.
        """
        if np.shape(q) != (len(self.joints),):
            raise TrajectoryError(
                f"recorder of {len(self.joints)} joints got q of shape {np.shape(q)}",
                hint=f"send one number each for {', '.join(self.joints)}",
            )
        if self._times and now < self._times[-1]:
            raise TrajectoryError(
                f"recorder got {now:.6g} s after {self._times[-1]:.6g} s", hint="clear() it before a new run"
            )
        if self._times and now == self._times[-1]:
            self._times.pop()
            self._q.pop()
        self._times.append(float(now))
        self._q.append(np.array(q, dtype=float))

    def clear(self) -> None:
        """Forgets everything."""
        self._times.clear()
        self._q.clear()

    def trajectory(self) -> Trajectory:
        """What was recorded, with times counted from the first sample.

        Raises:
            TrajectoryError: Nothing was recorded.
        """
        if not self._times:
            raise TrajectoryError("nothing was recorded", hint="pass the recorder to execute() or follow()")
        times = np.array(self._times)
        return Trajectory(times - times[0], np.stack(self._q), self.joints)
