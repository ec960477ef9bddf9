"""Pictures without their truth, and a printed marker that somebody pushes about."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_ik.camera.sources import ClosingSource, Frame, FrameSource
from robot_ik.geometry import Pose, rotation_exp

# The synthetic marker that is followed lies still for a while in the end.
REST_SECONDS = 1.5


class Blindfold(ClosingSource):
    """A source whose pictures come without their truth; the truth is kept aside for the report."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self.truth: Any = None
        self.image: Any = None

    @property
    def live(self) -> bool:
        """As the source is."""
        return self._source.live

    @property
    def exhausted(self) -> bool:
        """Whether nothing more would come."""
        return bool(getattr(self._source, "exhausted", False))

    def read(self) -> Frame:
        """The next picture, without truth."""
        frame = self._source.read()
        self.truth, self.image = frame.truth, frame.image
        return frame.without_truth()

    def close(self) -> None:
        """Closes the source."""
        self._source.close()


@dataclass(frozen=True)
class Wandering:
    """Pose of a marker that is pushed about on its table: rests, wanders, rests somewhere else."""

    home: Pose
    begin: float
    seconds: float
    size: float

    def __call__(self, now: float) -> Pose:
        """``pose_world_marker`` at ``now`` seconds."""
        share = np.clip((now - self.begin) / max(self.seconds - REST_SECONDS, 0.1), 0.0, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        x = self.size * np.sin(2.0 * np.pi * smooth)
        y = self.size * (0.5 * np.sin(4.0 * np.pi * smooth) + 0.8 * smooth)
        return self.home.compose(Pose((x, y, 0.0), rotation_exp([0.0, 0.0, 0.4 * smooth])))
