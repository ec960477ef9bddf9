"""A standing humanoid reaches for a low ball: feet, balance, hand, gaze and comfort, in this order.

    python examples/04_whole_body.py                    a ball in front of its feet
    python examples/04_whole_body.py 1.3 -0.3 1.2       a ball too far away

A later goal never makes the error of an earlier goal larger. The program prints the error of every
goal by its priority, measured by MuJoCo. The feet stay and the balance holds even if the hand
cannot reach the ball. The posture uses the freedom that is left.
"""

import sys

import numpy as np

import robot_ik as rik

BALL = (0.60, -0.30, 0.35)


def goals(figure: rik.Robot, ball: tuple[float, ...] = BALL) -> dict[str, rik.Goal]:
    """Return the goals by their meaning."""
    home = figure.home
    left, right = (figure.forward(home, side) for side in ("left_foot", "right_foot"))
    over_the_feet = figure.center_of_mass(home)
    return {
        "left foot stays": rik.PoseGoal.at("left_foot", left),
        "right foot stays": rik.PoseGoal.at("right_foot", right),
        "balance over the feet": rik.CenterOfMassGoal(None, over_the_feet, axes="xy", priority=1),
        "right hand at the ball": rik.PositionGoal("right_hand", ball, priority=2),
        "eyes on the ball": rik.AimGoal("gaze", ball, axis="x", priority=3),
        "joints as at ease": rik.PostureGoal(q=home, joints={"root": 0.0}, priority=4, soft=True),
    }


def main(*ball: float) -> None:
    figure = rik.load_robot("humanoid")
    wanted = goals(figure, ball or BALL)
    solution = rik.solve(figure, list(wanted.values()))
    print(f"{solution.status.name} after {solution.iterations} steps: {solution.status.meaning}")
    print("priority  goal                      error                  met")
    for (name, goal), error in zip(wanted.items(), solution.errors, strict=True):
        met = error.position <= 1e-4 and error.angle <= 1e-3
        distance = f"{1e3 * error.position:9.3f} mm {np.degrees(error.angle):8.3f} deg"
        print(f"{goal.priority:8}  {name:24}{distance}  {'yes' if met else 'no'}")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
