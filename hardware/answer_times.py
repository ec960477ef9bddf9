"""How long servos take to answer, learned from their answers: how long to wait, when to watch the port."""

from __future__ import annotations

SHORTEST_WAIT = 0.005
"""s; a servo has at least so long to answer, however quick it used to be: computers pause."""

SLOWNESS = 3.0
"""A servo has so many times the longest recent answer time."""

STEADY = 1e-4
"""s; answers whose times scatter by less are worth watching for: who sleeps wakes up about so late."""

_FORGET = 0.98  # share of the longest answer time kept from one answer to the next
_GAIN, _SPREAD_GAIN = 1 / 8, 1 / 4


class AnswerTimes:
    """Times from question to answer, s, without those of the bytes.

    The usual time and its spread are the running mean and mean deviation of Jacobson, "Congestion avoidance
    and control" (1988), appendix A.
    """

    def __init__(self) -> None:
        self._longest: float | None = None
        self._usual = 0.0
        self._spread = 1.0  # at first nothing is known

    def add(self, took: float) -> None:
        """One more answer; ``took`` may be a little below 0, for adapters hand bytes over in pieces."""
        if self._longest is None:
            self._longest, self._usual = took, took
        self._longest = max(took, _FORGET * self._longest)
        miss = took - self._usual
        self._usual += _GAIN * miss
        self._spread += _SPREAD_GAIN * (min(abs(miss), 1.0) - self._spread)

    def patience(self, at_most: float) -> float:
        """s to wait for an answer."""
        if self._longest is None:
            return at_most
        return min(max(SLOWNESS * self._longest, SHORTEST_WAIT), at_most)

    @property
    def expected(self) -> float | None:
        """s after which an answer usually comes; None where that cannot be told to ``STEADY``."""
        return self._usual if self._spread < STEADY else None
