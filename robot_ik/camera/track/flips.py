"""Keeps both poses of a flat marker alive from picture to picture, so that a lucky error does not flip it.

Which of the two branches of each picture is the true one is a chain with two states.  Its evidence is added
up (Rabiner 1989, forward pass): the errors of the branches in each picture, and how far the marker would have
had to turn since the last one.  Old evidence fades, so a wrong branch cannot stay alive; the branch in use
is left only for one that is clearly better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from robot_ik.camera.pose.branches import Branches
from robot_ik.geometry import Pose

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
    _odds: list[float] = field(default_factory=list)
    _spread: list[float] = field(default_factory=list)
    _chosen: int = 0
    _time: float = float("nan")

    def choose(self, branches: Branches, time: float) -> Choice:
        """Takes in one picture.

        Args:
            branches: What fits it.
            time: When it was taken, s; NaN when unknown.
        """
        gap = time - self._time
        gap = _USUAL_S if not math.isfinite(gap) or gap == 0.0 else gap
        if not 0.0 < gap <= _FORGET_S:
            self._poses = ()
        # Errors that the corners' covariance does not explain are in both branches: they prove less.
        scale = max(1.0, branches.costs[0] / branches.expected)
        alone = [-0.5 * (cost - branches.costs[0]) / scale for cost in branches.costs]
        odds = [max(value, -_MOST_BY_PICTURE) for value in alone]
        spread = [float(c[3, 3] + c[4, 4] + c[5, 5]) for c in branches.covariances]
        index = 0
        if self._poses:
            moved = (_TURN_RATE * gap) ** 2
            plausible = [
                [_plausible(p, q, a + b + moved) for q, b in zip(branches.poses, spread, strict=True)]
                for p, a in zip(self._poses, self._spread, strict=True)
            ]
            for k in range(len(odds)):
                ways = [_KEPT * old + row[k] for old, row in zip(self._odds, plausible, strict=True)]
                odds[k] += max(ways) + math.log(sum(math.exp(way - max(ways)) for way in ways))
            index = self._stay(odds, plausible[self._chosen])
        odds = [value - max(odds) for value in odds]
        self._poses, self._odds, self._spread = branches.poses, odds, spread
        self._chosen, self._time = index, time
        return Choice(index, self._ambiguity(branches, alone, odds, index, scale))

    @staticmethod
    def _stay(odds: list[float], plausible: list[float]) -> int:
        """The continuation of the branch in use, unless another one is clearly better."""
        same, best = plausible.index(max(plausible)), odds.index(max(odds))
        return best if odds[best] > odds[same] + _HYSTERESIS else same

    @staticmethod
    def _ambiguity(
        branches: Branches, alone: list[float], odds: list[float], index: int, scale: float
    ) -> float:
        """The ratio of errors that one picture with as much evidence would have.

        That of this picture or, where it is more, half of it and half of all: pictures in a row share errors.
        """
        if len(odds) < 2:
            return 0.0
        now = alone[index] - alone[1 - index]
        more = 2.0 * scale * max(now, 0.5 * (now + odds[index] - odds[1 - index]), 0.0)
        return 1.0 / math.sqrt(1.0 + more / (branches.costs[0] + branches.expected))


def _plausible(one: Pose, other: Pose, variance: float) -> float:
    """How well (log odds) the turn from one pose to the other fits what is expected of it, rad^2."""
    turn = 2.0 * math.acos(min(1.0, abs(float(one.wxyz @ other.wxyz))))
    return max(-0.5 * turn * turn / variance, -_MOST_BY_TURN)
