"""Draws the walk's joint curves beside the norm: `python docs/make/gait_curves.py`.

It writes docs/images/figure/gait-curves.png: hip, knee and ankle of the walk (5 m straight on, mean of
the middle strides of both legs) and of Schwartz, Rozumalski & Trost 2008, each 10 % of the cycle.  Nothing is
timed, so the same program draws the same picture.  Needs matplotlib (the extra `plots`).
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

from robot_ik.bench.figure import NORM_DEG, measure_gait
from robot_ik.figure.figure import load_figure
from robot_ik.figure.gait import prints_of, walk, walk_prints

FILE = Path(__file__).resolve().parents[1] / "images" / "figure" / "gait-curves.png"
_FIGURE, _NORM = "#1f5fa8", "#8a8a8a"


def main() -> None:
    """Walks, measures, draws."""
    figure = load_figure()
    prints = walk_prints(figure, prints_of(figure, figure.home), np.array([5.0, 0.0, 0.0]))
    found = measure_gait(figure, walk(figure, figure.home, prints))
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    share = np.linspace(0, 100, 11)
    drawing, panels = plt.subplots(1, 3, figsize=(8.4, 3.0), layout="constrained")
    for panel, (joint, norm) in zip(panels, NORM_DEG.items(), strict=True):
        panel.plot(share, norm, "o--", color=_NORM, markersize=3, label="Schwartz et al. 2008")
        panel.plot(share, found.curves_deg[joint], "o-", color=_FIGURE, markersize=3, label="the figure")
        panel.axvline(100 * found.stance, color="#cccccc", linewidth=0.8)
        fit = f"r {found.correlation[joint]:.3f}, RMS {found.rms_deg[joint]:.1f}°"
        panel.set_title(f"{joint}: {fit}", fontsize=9)
        panel.set_xlabel("share of the cycle from heel strike, %", fontsize=8)
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.25)
    panels[0].set_ylabel("flexion, degrees", fontsize=8)
    lines, names = panels[0].get_legend_handles_labels()
    drawing.legend(lines, names, loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    drawing.savefig(FILE, dpi=110, metadata={"Software": None})
    print(FILE)


if __name__ == "__main__":
    main()
