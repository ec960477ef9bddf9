"""Keeps both poses of a flat marker alive from picture to picture, so that a lucky error does not flip it.

Which of the two branches of each picture is the true one is a chain with two states.  Its evidence is added
up (Rabiner 1989, forward pass): the errors of the branches in each picture, and how far the marker would have
had to turn since the last one.  Old evidence fades, so a wrong branch cannot stay alive; the branch in use
is left only for one that is clearly better.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.pose.branches import Branches
from robot_ik.geometry import Pose

Array = NDArray[np.float64]

# What is left of the evidence of one picture in the next: ten pictures count, nearly.
_KEPT = 0.85
# A hand turns a marker by this much, rad/s.
_TURN_RATE = 2.0
# No single turn and no single picture says more than this (log odds): either may be an accident.
_MOST_BY_TURN, _MOST_BY_PICTURE = 4.0, 8.0
# The other branch must be better by this (log odds) before it is taken.
_HYSTERESIS = 0.5
# A marker not seen for so long is a new one; pictures without a time are taken to come at 30 Hz.
_FORGET_S, _USUAL_S = 0.5, 1.0 / 30.0


@dataclass(frozen=True, eq=False)
class Choice:
    """Which branch, and how sure.

    Attributes:
        index: Of the branch.
        ambiguity: As in ``MarkerObservation``, with the evidence of the last pictures.
    """

    index: int
    ambiguity: float


@dataclass(eq=False)
class BranchMemory:
    """The two hypotheses about one marker or board."""

    _poses: tuple[Pose, ...] = ()
    _odds: Array = field(default_factory=lambda: np.zeros(0))
    _spread: Array = field(default_factory=lambda: np.zeros(0))
    _chosen: int = 0
    _time: float = float("nan")

    def choose(self, branches: Branches, time: float) -> Choice:
        """Takes in one picture.

        Args:
            branches: What fits it.
            time: When it was taken, s; NaN when unknown.
        """
        gap = time - self._time
        gap = _USUAL_S if not np.isfinite(gap) or gap == 0.0 else gap
        if not 0.0 < gap <= _FORGET_S:
            self._poses = ()
        # Errors that the corners' covariance does not explain are in both branches: they prove less.
        scale = max(1.0, branches.costs[0] / branches.expected)
        alone = -0.5 * (np.array(branches.costs) - branches.costs[0]) / scale
        odds = np.maximum(alone, -_MOST_BY_PICTURE)
        spread = np.array([covariance[3:, 3:].trace() for covariance in branches.covariances])
        index = 0
        if self._poses:
            cosines = [[abs(p.wxyz @ q.wxyz) for q in branches.poses] for p in self._poses]
            turns = 2.0 * np.arccos(np.minimum(cosines, 1.0))
            variance = self._spread[:, None] + spread + (_TURN_RATE * gap) ** 2
            plausible = np.maximum(-0.5 * turns**2 / variance, -_MOST_BY_TURN)
            odds = odds + np.logaddexp.reduce(_KEPT * self._odds[:, None] + plausible, axis=0)
            index = self._stay(odds, plausible[self._chosen])
        odds -= odds.max()
        self._poses, self._odds, self._spread = branches.poses, odds, spread
        self._chosen, self._time = index, time
        return Choice(index, self._ambiguity(branches, alone, odds, index, scale))

    @staticmethod
    def _stay(odds: Array, plausible: Array) -> int:
        """The continuation of the branch in use, unless another one is clearly better."""
        same, best = int(np.argmax(plausible)), int(np.argmax(odds))
        return best if odds[best] > odds[same] + _HYSTERESIS else same

    @staticmethod
    def _ambiguity(branches: Branches, alone: Array, odds: Array, index: int, scale: float) -> float:
        """The ratio of errors that one picture with as much evidence would have.

        That of this picture or, where it is more, half of it and half of all: pictures in a row share errors.
        """
        if len(odds) < 2:
            return 0.0
        lead = [values[index] - values[1 - index] for values in (alone, 0.5 * (alone + odds))]
        more = 2.0 * scale * max(*lead, 0.0) / (branches.costs[0] + branches.expected)
        return float(1.0 / np.sqrt(1.0 + more))
