"""Draw the success rate of a policy during its training: `python docs/make/learning_curve.py`.

It reads docs/learn_to_reach.csv and writes docs/images/learn_to_reach.png. The CSV file comes from

    python examples/09_learn_to_reach.py --steps 4000 --curve docs/learn_to_reach.csv

in an environment with stable-baselines3. Needs matplotlib (the extra `plots`).
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

DOCS = Path(__file__).resolve().parents[1]
CURVE = DOCS / "learn_to_reach.csv"
PICTURE = DOCS / "images" / "learn_to_reach.png"

SIZE = (6.0, 3.0)
"""Width and height, inches."""

RESOLUTION = 110
"""Pixels per inch."""


def main() -> None:
    """Draw the picture."""
    mpl.use("Agg")
    from matplotlib import pyplot  # after the choice of the backend

    steps, success = np.loadtxt(CURVE, delimiter=",", skiprows=1, unpack=True)
    figure, axes = pyplot.subplots(figsize=SIZE, dpi=RESOLUTION, layout="constrained")
    axes.plot(steps, 100.0 * success, marker="o")
    axes.set_xlabel("steps of the training")
    axes.set_ylabel("50 new goals reached, %")
    axes.set_ylim(0.0, 103.0)
    axes.set_xlim(0.0, steps[-1])
    axes.grid(alpha=0.3)
    figure.savefig(PICTURE)


if __name__ == "__main__":
    main()
