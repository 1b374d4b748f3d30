"""Figure 11: the virtual scene as an operator would see it, forces on the fingers drawn in."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import RED, canvas
from paper_figs.panels import scene
from paper_figs.results import load, target

NEWTON = 0.5  # cm that a force of 1 N is drawn long


def main() -> None:
    found = load("virtual_block")
    frames = found["frames"]
    x = 100 * np.array([[p[0] for p in frame["fingers"]] for frame in frames])
    y = 100 * np.array([[p[1] for p in frame["fingers"]] for frame in frames])
    with canvas(target("fig11"), height=1.85) as figure:
        axes = figure.subplots(1, len(frames), sharex=True, sharey=True)
        for ax, frame in zip(axes, frames, strict=True):
            scene(ax, frame["fingers"], {"block2": frame["block"]}, {"block2": found["size"]})
            for sign, tip, force in zip((-1, 1), frame["fingers"], frame["forces"], strict=True):
                ax.annotate(
                    "",
                    xytext=(100 * tip[0] + sign * 0.2, 100 * tip[1]),
                    zorder=5,
                    xy=(100 * tip[0] + sign * 0.2 - NEWTON * force[0], 100 * tip[1] - NEWTON * force[1]),
                    arrowprops={"arrowstyle": "->", "color": RED, "lw": 1.2, "shrinkA": 0, "shrinkB": 0},
                )
            ax.set_title(f"$t$ = {frame['t']:.2f} s", fontsize=8)
            ax.set_xlabel("$x$ [cm]")
        axes[0].set_xlim(x.min() - 2.2, x.max() + 2.2)
        axes[0].set_ylim(-0.4, y.max() + 2.6)
        axes[0].set_ylabel("$y$ [cm]")


if __name__ == "__main__":
    main()
