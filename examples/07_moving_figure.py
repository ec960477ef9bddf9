"""A figure gets a ball, decides, and acts: it reaches, bends, or walks to a ball farther away.

    python examples/07_moving_figure.py                  three balls, one after the other
    python examples/07_moving_figure.py 0.5 -0.2 0.3     a ball of your own

Prints the decision for each ball with its reason, the time of the motion, and the distance between
hand and ball at the end, measured by MuJoCo.
"""

import sys

import numpy as np

from robot_ik.figure.abilities import load_abilities
from robot_ik.figure.figure import RATE, load_figure
from robot_ik.figure.session import FigureSession

BALLS = ((0.45, -0.25, 1.3), (0.5, -0.25, 0.25), (1.6, 0.6, 1.2))


def main(*ball: float) -> None:
    session = FigureSession(load_abilities(load_figure()))
    for position in (ball,) if ball else BALLS:
        session.set_ball(position)
        frame = session.step()
        frames = 1
        decision = None
        while session.busy and frames < 40 * RATE:
            if frame.decision is not decision:
                decision = frame.decision
                print(f"{decision.action:8} {decision.reason}")
            frame = session.step()
            frames += 1
        arm = frame.decision.arm
        if arm is None:
            continue
        hand = session.figure.robot.measure(frame.q, session.figure.hands[arm])
        error_mm = 1e3 * np.linalg.norm(hand.position - frame.ball)
        seconds = frames / RATE
        print(f"         after {seconds:.1f} s the {arm} hand is {error_mm:.2f} mm from the ball")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
