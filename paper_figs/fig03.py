"""Figure 3: the nine subtasks of the block-stacking task, as one recording shows them."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import WIDTH, canvas
from paper_figs.panels import scene
from paper_figs.results import load, target

ROMAN = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII", "IX")


def main() -> None:
    found = load("recording")
    scenes = found["scenes"]
    x = 100 * np.array([[p[0] for p in s["fingers"]] + [p[0] for p in s["blocks"]] for s in scenes])
    y = 100 * np.array([[p[1] for p in s["fingers"]] for s in scenes])
    with canvas(target("fig03"), width=WIDTH, height=5.0) as figure:
        axes = figure.subplots(3, 3, sharex=True, sharey=True)
        for ax, number, one in zip(axes.flat, ROMAN, scenes, strict=True):
            scene(ax, one["fingers"], dict(zip(found["sizes"], one["blocks"], strict=True)), found["sizes"])
            ax.set_title(f"{number}  {one['subtask']} {one['object']}: {one['state']}", fontsize=7.5)
        axes[0, 0].set_xlim(x.min() - 1.0, x.max() + 1.0)
        axes[0, 0].set_ylim(-0.4, y.max() + 2.8)
        for ax in axes[-1]:
            ax.set_xlabel("$x$ [cm]")
        for ax in axes[:, 0]:
            ax.set_ylabel("$y$ [cm]")


if __name__ == "__main__":
    main()
