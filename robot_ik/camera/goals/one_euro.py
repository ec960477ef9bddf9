"""The 1 € filter: calms a pose that is shown, or that an arm rests at."""

from __future__ import annotations

import numpy as np

from robot_ik.camera.filter import difference, moved
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose


class OneEuro:
    """The 1 € filter (Casiez, Roussel & Vogel 2012) on a pose: calm at rest, quick in motion, always behind.

    For poses that are shown, or that an arm shall rest at; not for following.

    Args:
        cutoff: Least cut-off frequency, Hz: lower is calmer at rest.
        speed_coefficient: Hz of cut-off more for each m/s, and for each rad/s.
        rate_cutoff: Cut-off of the speed itself, Hz.
    """

    def __init__(
        self,
        cutoff: float = 1.0,
        speed_coefficient: tuple[float, float] = (20.0, 2.0),
        rate_cutoff: float = 1.0,
    ) -> None:
        if not (cutoff > 0.0 and rate_cutoff > 0.0 and min(speed_coefficient) >= 0.0):
            raise CameraError("a 1 € filter needs positive cut-off frequencies", hint="for example 1.0 Hz")
        self._cutoff, self._coefficient, self._rate_cutoff = cutoff, speed_coefficient, rate_cutoff
        self.reset()

    def reset(self) -> None:
        """Forgets everything: the next pose comes out as it goes in."""
        self._time = float("nan")
        self._raw = self._shown = Pose()
        self._rate = np.zeros(6)

    def update(self, time: float, pose: Pose) -> Pose:
        """The calmed pose at ``time``, s; a time that is not later changes nothing."""
        if np.isnan(self._time):
            self._time, self._raw, self._shown = time, pose, pose
            return pose
        span = time - self._time
        if not span > 0.0:
            return self._shown
        self._rate += _share(self._rate_cutoff, span) * (difference(pose, self._raw) / span - self._rate)
        speeds = np.linalg.norm(self._rate.reshape(2, 3), axis=1)
        shares = [
            _share(self._cutoff + k * float(speed), span)
            for k, speed in zip(self._coefficient, speeds, strict=True)
        ]
        self._shown = moved(self._shown, np.repeat(shares, 3) * difference(pose, self._shown))
        self._time, self._raw = time, pose
        return self._shown


def _share(cutoff: float, span: float) -> float:
    """Weight of a new value in exponential smoothing: Casiez et al. 2012, section "Filtering"."""
    tau = 1.0 / (2.0 * np.pi * cutoff)
    return float(1.0 / (1.0 + tau / span))
