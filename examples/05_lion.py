"""The lion touches a ball: three paws stay, the fourth reaches, and the head turns to the ball.

    python examples/05_lion.py                    the ball in front of its right paw
    python examples/05_lion.py 0.9 -0.35 0.5      higher and to its right

The lion has 66 degrees of freedom: a floating base, ball joints along spine, neck and tail, and
hinges in the legs. The program prints the error of every goal by its priority, measured by MuJoCo.
The errors of the last goals show how far each part had to bend.
"""

import sys

import numpy as np

import robot_ik as rik

BALL = (0.92, -0.20, 0.55)
STANDING = ("front_left_paw", "hind_left_paw", "hind_right_paw")


def goals(lion: rik.Robot, ball: tuple[float, ...] = BALL) -> dict[str, rik.Goal]:
    """Return the goals by their meaning."""
    home = lion.home
    paws = {f"{paw} stays": rik.PoseGoal.at(paw, lion.forward(home, paw)) for paw in STANDING}
    parts = {
        part: rik.PostureGoal(
            q=home, joints=dict.fromkeys(lion.file.groups[part], 1.0), only_named=True, priority=4
        )
        for part in ("spine", "tail", "neck", "legs")
    }
    # Inside the triangle of the three paws: a little behind and left of its place on four paws.
    middle = np.mean([lion.forward(home, paw).position for paw in STANDING], axis=0)
    return {
        **paws,
        "weight over three paws": rik.CenterOfMassGoal(None, middle, axes="xy", priority=1),
        "right paw at the ball": rik.PositionGoal("front_right_paw", ball, priority=2),
        "eyes on the ball": rik.AimGoal("gaze", ball, axis="x", priority=3),
        **{f"{part} at ease": goal for part, goal in parts.items()},
    }


def main(*ball: float) -> None:
    lion = rik.load_robot("lion")
    wanted = goals(lion, ball or BALL)
    solution = rik.solve(lion, list(wanted.values()))
    print(f"{solution.status.name} after {solution.iterations} steps: {solution.status.meaning}")
    print("priority  goal                      error                  met")
    for (name, goal), error in zip(wanted.items(), solution.errors, strict=True):
        met = error.position <= 1e-4 and error.angle <= 1e-3
        distance = f"{1e3 * error.position:9.3f} mm {np.degrees(error.angle):8.3f} deg"
        print(f"{goal.priority:8}  {name:24}{distance}  {'yes' if met else 'no'}")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
