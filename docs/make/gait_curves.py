"""Draw the joint curves of the walk beside the norm: `python -m docs.make.gait_curves`.

It writes docs/images/figure/gait-curves.png: hip, knee and ankle of a straight walk of 5 m (mean of
the middle strides of both legs) and of Schwartz, Rozumalski & Trost 2008, at every 10 % of the
cycle. Nothing is timed, so the same program draws the same picture. It needs matplotlib (the extra
`plots`).
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

from benchmarks.figure.gait import NORM_DEG, measure_gait
from benchmarks.figure.rows import straight_walk
from robot_ik.figure.figure import load_figure

FILE = Path(__file__).resolve().parents[1] / "images" / "figure" / "gait-curves.png"

_FIGURE_COLOUR = "#1f5fa8"
_NORM_COLOUR = "#8a8a8a"


def main() -> None:
    """Walk, measure and draw."""
    figure = load_figure()
    gait = measure_gait(figure, straight_walk(figure))
    mpl.use("Agg")
    from matplotlib import pyplot as plt  # after the choice of the backend

    share = np.linspace(0, 100, 11)
    drawing, panels = plt.subplots(1, 3, figsize=(8.4, 3.0), layout="constrained")
    for panel, (joint, norm) in zip(panels, NORM_DEG.items(), strict=True):
        curve = gait.curves_deg[joint]
        panel.plot(
            share, norm, "o--", color=_NORM_COLOUR, markersize=3, label="Schwartz et al. 2008"
        )
        panel.plot(share, curve, "o-", color=_FIGURE_COLOUR, markersize=3, label="the figure")
        panel.axvline(100 * gait.stance, color="#cccccc", linewidth=0.8)
        fit = f"r {gait.correlation[joint]:.3f}, RMS {gait.rms_deg[joint]:.1f}°"
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
