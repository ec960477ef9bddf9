"""Record two key poses of the humanoid, play them in a loop, blend into a walk, and save all.

    python examples/08_poses.py            prints the results
    python examples/08_poses.py FOLDER     also writes poses.toml, motion.csv and motion.bvh there

Each reach uses the most likely of all poses that put the hand there (a learned prior). The program
prints the duration of the motion, the height of the hand and the distance of the walk.
"""

import sys
from pathlib import Path

import numpy as np

import robot_ik as rik
from robot_ik.figure.motion.bvh import export_bvh
from robot_ik.motion import Keyframes, KeyPoses

POSITIONS = {"high": (0.35, -0.25, 1.6), "low": (0.4, -0.3, 0.9)}


def recorded(figure: rik.Robot) -> KeyPoses:
    """Return key poses: home and the two reaches."""
    book = KeyPoses(figure)
    book.record("stand", figure.home)
    natural = rik.PosePriorGoal(prior=rik.PosePrior.of(figure))
    feet = [
        rik.PoseGoal.at(foot, figure.forward(figure.home, foot))
        for foot in ("left_foot", "right_foot")
    ]
    for name, position in POSITIONS.items():
        solution = rik.solve(
            figure, [*feet, rik.PositionGoal("right_hand", position), natural], solver="lm"
        )
        book.record(name, solution.require().q)
    book.record_motion("greet", ["stand", "high", "low", "stand"], [0.8, 0.6, 0.8])
    return book


def main(folder: str = "") -> None:
    figure = rik.load_robot("humanoid")
    book = recorded(figure)
    greet = book.motion("greet")
    walk = KeyPoses.load(figure.folder / "poses.toml", figure).motion("walk")
    both: Keyframes = greet.blended(walk, 0.4)
    frames = both.sampled(60.0)
    hand = np.array([figure.forward(q, "right_hand").position for q in frames.q])
    print(f"{len(frames)} frames in {both.duration:.2f} s, interpolated without a solver")
    print(f"the hand was between {hand[:, 2].min():.2f} and {hand[:, 2].max():.2f} m high")
    print(f"the pelvis went {frames.q[-1, 0] - frames.q[0, 0]:.2f} m")
    if folder:
        book.save(Path(folder) / "poses.toml")
        frames.save_csv(Path(folder) / "motion.csv")
        export_bvh(both, 60.0).save(Path(folder) / "motion.bvh")


if __name__ == "__main__":
    main(*sys.argv[1:])
