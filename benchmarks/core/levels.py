"""Count the steps of goals with priorities, soft goals and frames of the figure on seeded sets.

    python benchmarks/core/levels.py

Prints one line for each set: solves, goals that are met, steps, random restarts and median time.
Two versions of the package solve equally well if all columns but the last agree. MuJoCo judges
which goals are met.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import robot_ik as rik
from robot_ik.figure.figure import load_figure
from robot_ik.figure.frames import FrameRows
from robot_ik.figure.poses import STIFFNESS
from robot_ik.motion.timing import minimum_jerk

Case = tuple[rik.Robot, list[rik.Goal], np.ndarray | None]
Cases = Callable[[], Iterator[Case]]


def arm_poses(**posture: Any) -> Iterator[Case]:
    """A pose within reach, and a posture."""
    arm = rik.load_robot("srs_arm")
    rng = np.random.default_rng(0)
    for _ in range(200):
        pose = rik.PoseGoal.at(None, arm.forward(arm.sample(rng)))
        yield arm, [pose, rik.PostureGoal(q=arm.home, **posture)], None


def puma_poses() -> Iterator[Case]:
    """A pose within reach of six joints, which often needs random restarts, and a posture."""
    puma = rik.load_robot("puma560")
    rng = np.random.default_rng(6)
    for _ in range(200):
        pose = rik.PoseGoal.at(None, puma.forward(puma.sample(rng)))
        yield puma, [pose, rik.PostureGoal(q=puma.home, priority=1)], None


def arm_far() -> Iterator[Case]:
    """A position out of reach before a position within reach and a posture."""
    arm = rik.load_robot("srs_arm")
    rng = np.random.default_rng(1)
    for _ in range(100):
        direction = rng.normal(size=3)
        far = 3.0 * direction / np.linalg.norm(direction)
        elbow = arm.forward(arm.sample(rng), "elbow").position
        yield (
            arm,
            [
                rik.PositionGoal(None, far),
                rik.PositionGoal("elbow", elbow),
                rik.PostureGoal(q=arm.home, priority=1),
            ],
            None,
        )


def arm_three_levels() -> Iterator[Case]:
    """Positions of tool and elbow that exclude each other, and a plane."""
    arm = rik.load_robot("srs_arm")
    rng = np.random.default_rng(2)
    for _ in range(100):
        yield (
            arm,
            [
                rik.PositionGoal(None, arm.forward(arm.sample(rng)).position),
                rik.PlaneGoal("elbow", (0, 0, rng.uniform(0.2, 0.6)), "z", priority=1),
                rik.PositionGoal(
                    "elbow", arm.forward(arm.sample(rng), "elbow").position, priority=2
                ),
            ],
            None,
        )


def stack(figure: rik.Robot, ball: np.ndarray, **posture: Any) -> list[rik.Goal]:
    """Feet, balance, hand, gaze and posture."""
    home = figure.home
    return [
        rik.PoseGoal.at("left_foot", figure.forward(home, "left_foot")),
        rik.PoseGoal.at("right_foot", figure.forward(home, "right_foot")),
        rik.CenterOfMassGoal(None, figure.center_of_mass(home), axes="xy", priority=1),
        rik.PositionGoal("right_hand", ball, priority=2),
        rik.AimGoal("gaze", ball, axis="x", priority=3),
        rik.PostureGoal(q=home, joints={"root": 0.0}, **posture),
    ]


def figure_reaches(**posture: Any) -> Iterator[Case]:
    """Balls inside and outside the reach of the hand."""
    figure = rik.load_robot("humanoid")
    hand = figure.forward(figure.home, "right_hand").position
    rng = np.random.default_rng(3)
    for _ in range(40):
        yield figure, stack(figure, hand + rng.uniform(-0.6, 0.6, size=3), **posture), None


def figure_prior() -> Iterator[Case]:
    """Hand and feet, and a pose prior."""
    figure = rik.load_robot("humanoid")
    prior = rik.PosePriorGoal(prior=rik.PosePrior.of(figure))
    rng = np.random.default_rng(4)
    for _ in range(30):
        ball = np.array([0.35, -0.25, 1.1]) + rng.uniform(-0.15, 0.15, size=3)
        yield figure, [*stack(figure, ball)[:4], prior], None


SETS: dict[str, Cases] = {
    "arm, posture of priority 1": lambda: arm_poses(priority=1),
    "arm, soft posture": lambda: arm_poses(soft=True),
    "PUMA, posture of priority 1": puma_poses,
    "arm, out of reach": arm_far,
    "arm, three levels": arm_three_levels,
    "figure, five levels": lambda: figure_reaches(priority=4),
    "figure, soft posture": lambda: figure_reaches(soft=True),
    "figure, pose prior": figure_prior,
}


def report(name: str, solves: int, met: int, steps: int, restarts: int, seconds: float) -> None:
    """Print one line."""
    print(f"{name:28}{solves:6}{met:6}{steps:9}{restarts:7}{1e6 * seconds:10.0f} us", flush=True)


def count_solves(name: str, cases: Cases) -> None:
    """Solve each case with ``lm`` and report."""
    solutions = [
        rik.solve(robot, goals, start=start, solver="lm", budget=rik.Budget(restarts=50))
        for robot, goals, start in cases()
    ]
    report(
        name,
        len(solutions),
        sum(
            error.position <= 1e-4 and error.angle <= 1e-3
            for solution in solutions
            for error in solution.errors
        ),
        sum(solution.iterations for solution in solutions),
        sum(solution.restarts for solution in solutions),
        float(np.median([solution.seconds for solution in solutions])),
    )


def count_frames() -> None:
    """Move a hand of the figure along seeded lines, frame by frame, and report."""
    figure = load_figure()
    rng = np.random.default_rng(5)
    steps = 0
    met = 0
    times = []
    for _ in range(20):
        rows = FrameRows(figure, 40)
        rows.feet(figure.feet_at_home)
        rows.center(figure.center(figure.home), axes="xy")
        rows.momentum(0.1)
        rows.aim(np.array([1.0, 0.0, 1.0]), 8.0)
        hand = figure.pose(figure.home, "right_hand")[0]
        share = minimum_jerk(np.linspace(0, 1, 40))[:, None]
        rows.position("right_hand", hand + rng.uniform(-0.3, 0.3, size=3) * share)
        began = time.perf_counter()
        frames = rows.solve(figure.home, figure.stiffnesses(STIFFNESS), figure.home)
        times.append((time.perf_counter() - began) / 40)
        steps += int(frames.steps.sum())
        met += int((frames.error < 1e-6).sum())
    report("figure, frames", 800, met, steps, 0, float(np.median(times)))


if __name__ == "__main__":
    for name, cases in SETS.items():
        count_solves(name, cases)
    count_frames()
