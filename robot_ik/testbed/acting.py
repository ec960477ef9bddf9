"""A figure of the testbed that decides by itself: the ball is all that it is given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from robot_ik.figure.abilities import Abilities
from robot_ik.figure.session import FigureSession, Reset, SetBall, Start
from robot_ik.ports import Array

FigureMode = Literal["active", "passive"]


@dataclass(frozen=True)
class FigureView:
    """What is seen of a figure that decides.

    Attributes:
        mode: ``active``: it follows the ball; ``passive``: it acts on the ball as it was when told to act.
        action, phase: What it does now, and how far it has come, from 0 to 1.
        decision, arm: What it decided to do, and with which arm; empty: none.
        reason: Why, in one sentence.
        then: What it does where it walks to; empty: it does not walk.
        waiting: Passive, and not told to act yet.
    """

    mode: FigureMode
    action: str
    phase: float
    decision: str
    arm: str
    reason: str
    then: str
    waiting: bool


class ActingFigure:
    """Runs the session of a figure, a frame for each tick.

    Args:
        abilities: Of the figure.
        mode: As ``FigureView.mode``.
        rate: Ticks a second, Hz.
    """

    def __init__(self, abilities: Abilities, mode: FigureMode, rate: float) -> None:
        self.mode: FigureMode = mode
        self._session = FigureSession(abilities, mode=mode, rate=rate)
        self._frame = self._session.step()

    def act(self) -> None:
        """Passive: now, on the ball where it is."""
        self._session.send(Start())

    def reset(self) -> None:
        """Back to where it began, at rest."""
        self._session.send(Reset())

    def step(self, ball: Array) -> Array:
        """(nq,) of the next frame, with the ball at (3,), metres."""
        x, y, z = (float(value) for value in ball)
        self._session.send(SetBall((x, y, z)))
        self._frame = self._session.step()
        return np.asarray(self._frame.q)

    def view(self) -> FigureView:
        """What is seen of it."""
        frame = self._frame
        decision = frame.decision
        return FigureView(
            self.mode, frame.action, frame.phase, decision.action, decision.arm or "", decision.reason,
            decision.then or "", self.mode == "passive" and self._session.ball is None,
        )  # fmt: skip
