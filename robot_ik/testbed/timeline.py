"""Key poses on a time axis: a motion that is recorded, scrubbed and played without solving."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_ik.errors import TrajectoryError
from robot_ik.motion.key_poses import KeyPoses
from robot_ik.motion.keyframes import Keyframes
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.testbed.playback import Playback

SPACING = 1.0
"""Seconds between a new key pose and the one before it."""

MIN_INTERVAL = 0.05
"""Seconds. Two key poses are at least this far apart."""

MOTION = "timeline"
"""Name of the motion in a saved file."""

_MAX_KEY_POSES = 1000
"""Key poses of a timeline."""


@dataclass(frozen=True)
class TimelineView:
    """A timeline at one tick.

    Attributes:
        times: Seconds of each key pose.
        names: Name of each key pose.
        now: Seconds of the cursor.
        playing: Whether the cursor moves.
    """

    times: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    now: float = 0.0
    playing: bool = False


@dataclass(frozen=True, eq=False)
class _Key:
    """A pose (nq,) at a time in seconds."""

    time: float
    name: str
    q: Array


class Timeline(Playback):
    """Key poses of one robot and a cursor.

    Args:
        robot: The robot of the poses.
    """

    def __init__(self, robot: Robot) -> None:
        super().__init__()
        self._robot = robot
        self._keys: list[_Key] = []
        self._motion: Keyframes | None = None
        self._recorded = 0

    @property
    def is_empty(self) -> bool:
        """Whether there is no key pose."""
        return not self._keys

    @property
    def duration(self) -> float:
        """Seconds of the last key pose, 0 without one."""
        return self._keys[-1].time if self._keys else 0.0

    def record(self, q: Array) -> None:
        """Append a pose (nq,), one spacing after the last one.

        Raises:
            TrajectoryError: A joint is outside its limits, or there are too many poses.
        """
        if len(self._keys) >= _MAX_KEY_POSES:
            raise TrajectoryError(f"the timeline has {_MAX_KEY_POSES} poses", hint="remove some")
        name = f"pose {self._recorded + 1}"
        time = self._keys[-1].time + SPACING if self._keys else 0.0
        self._set([*self._keys, _Key(time, name, np.array(q))])
        self._recorded += 1
        self.now = time

    def remove(self, index: int) -> None:
        """Remove a key pose. The others keep their distances, and the first is at 0 s."""
        if index < len(self._keys):
            self._set(self._keys[:index] + self._keys[index + 1 :])

    def move(self, index: int, time: float) -> None:
        """Move a key pose to another time in seconds. It may go past its neighbours."""
        if index < len(self._keys):
            moved = self._keys[index]
            others = self._keys[:index] + self._keys[index + 1 :]
            self._set([*others, _Key(time, moved.name, moved.q)])

    def _set(self, keys: list[_Key]) -> None:
        """Order key poses by their times, at least ``MIN_INTERVAL`` apart, the first at 0 s."""
        ordered = sorted(keys, key=lambda key: key.time)
        first = ordered[0].time if ordered else 0.0
        spread: list[_Key] = []
        for key in ordered:
            earliest = spread[-1].time + MIN_INTERVAL if spread else 0.0
            spread.append(_Key(max(key.time - first, earliest), key.name, key.q))
        times = [key.time for key in spread]
        poses = [key.q for key in spread]
        self._motion = Keyframes(self._robot, times, poses) if spread else None
        self._keys = spread
        self.now = min(self.now, self.duration)
        self.playing = self.playing and self._motion is not None

    def step(self, seconds: float) -> Array | None:
        """Advance the cursor and return the pose (nq,) there, or None without key poses."""
        if self._motion is None:
            return None
        return self._motion.at(self.advance(seconds))

    def at(self, time: float) -> Array:
        """Return the pose (nq,) at a time in seconds.

        Raises:
            TrajectoryError: There is no key pose.
        """
        if self._motion is None:
            raise TrajectoryError("the timeline is empty", hint="press Record pose first")
        return self._motion.at(time)

    def motion(self) -> Keyframes:
        """Return the motion through the key poses.

        Raises:
            TrajectoryError: There are fewer than two key poses.
        """
        if self._motion is None or len(self._keys) < 2:
            problem = "a motion needs two key poses"
            raise TrajectoryError(problem, hint="press Record pose, move the robot, press it again")
        return self._motion

    def book(self) -> KeyPoses:
        """Return the key poses, and the motion through them, as a file of poses has them."""
        book = KeyPoses(self._robot)
        for key in self._keys:
            book.record(key.name, key.q)
        if len(self._keys) > 1:
            durations = np.diff([key.time for key in self._keys]).tolist()
            book.record_motion(MOTION, [key.name for key in self._keys], durations)
        return book

    def load(self, book: KeyPoses) -> None:
        """Replace the key poses by those of a file, in the order of its timeline if it has one."""
        sequence = book.motions.get(MOTION)
        names = list(sequence.poses) if sequence else list(book.poses)
        durations = list(sequence.durations) if sequence and sequence.durations else []
        spans = durations or [SPACING] * (len(names) - 1)
        times = [0.0, *np.cumsum(spans[: len(names) - 1]).tolist()][: len(names)]
        keys = [_Key(time, name, book[name]) for time, name in zip(times, names, strict=True)]
        self._set(keys[:_MAX_KEY_POSES])
        self._recorded = len(names)
        self.now = 0.0
        self.playing = False

    def view(self) -> TimelineView:
        """Return what a front end shows."""
        times = tuple(key.time for key in self._keys)
        names = tuple(key.name for key in self._keys)
        return TimelineView(times, names, self.now, self.playing)
