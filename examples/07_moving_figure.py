"""A figure sees a ball, decides, and does it: it reaches, bends, and walks to a ball that lies farther away.

    python examples/07_moving_figure.py                  three balls, one after the other
    python examples/07_moving_figure.py 0.5 -0.2 0.3     a ball of your own

Prints the decision for each ball and why, how long the motion took, and how far MuJoCo says the hand ended
from it.
"""

import sys

import numpy as np

from robot_ik.figure.abilities import load_abilities
from robot_ik.figure.figure import RATE, load_figure
from robot_ik.figure.session import FigureSession

BALLS = (0.45, -0.25, 1.3), (0.5, -0.25, 0.25), (1.6, 0.6, 1.2)


def main(*ball: float) -> None:
    session = FigureSession(load_abilities(load_figure()))
    for position in (ball,) if ball else BALLS:
        session.set_ball(position)
        frame, decision, frames = session.step(), None, 1
        while session.busy and frames < 40 * RATE:
            if frame.decision is not decision:
                decision = frame.decision
                print(f"{decision.action:8} {decision.reason}")
            frame, frames = session.step(), frames + 1
        if frame.decision.arm is None:
            continue
        hand = session.figure.robot.measure(frame.q, session.figure.hands[frame.decision.arm])
        error = np.linalg.norm(hand.position - frame.ball)
        line = (
            f"after {frames / RATE:.1f} s the {frame.decision.arm} hand is {1e3 * error:.2f} mm from the ball"
        )
        print(f"         {line}")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
