"""``Playback``: a time cursor on a motion. The timeline and planned motions have one."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Playback(ABC):
    """A cursor between 0 and the duration of a motion, in seconds.

    Attributes:
        now: Time of the cursor, s.
        playing: Whether the cursor moves.
    """

    def __init__(self) -> None:
        self.now = 0.0
        self.playing = False

    @property
    @abstractmethod
    def duration(self) -> float:
        """Seconds of the motion, 0 without one."""

    def seek(self, time: float) -> None:
        """Put the cursor at a time in seconds and stop it."""
        self.now = min(time, self.duration)
        self.playing = False

    def play(self, playing: bool) -> None:
        """Start or stop the cursor. A cursor at the end starts at 0 s."""
        self.playing = playing and self.duration > 0.0
        if self.playing and self.now >= self.duration:
            self.now = 0.0

    def advance(self, seconds: float) -> float:
        """Move a playing cursor, which stops at the end. Return its time in seconds."""
        if self.playing:
            self.now += seconds
            if self.now >= self.duration:
                self.now = self.duration
                self.playing = False
        return self.now
