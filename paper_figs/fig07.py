"""Figure 7: the state of every sample by the paper's rules."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hmmseg.plot.style import BLUE, INK, RED, canvas
from paper_figs.panels import stacked
from paper_figs.results import load, target

NAMES = ("none", "free motion", "hold above ground", "hold on ground")


def draw(ax: Axes, line: dict[str, Any]) -> None:
    t, state = np.array(line["t"]), np.array(line["state"])
    ax.step(t, state, where="mid", color=INK, lw=0.6)
    ax.plot(t, state, ".", color=BLUE, ms=2.8)
    sliding, none = np.array(line["sliding"], bool), state == 0
    ax.plot(t[sliding], state[sliding], "x", color=RED, ms=4)
    ax.plot(t[none], state[none], "o", color=RED, ms=4, mfc="none", mew=0.8)
    ax.set_yticks(range(4), [f"{name}  {k}" for k, name in enumerate(NAMES)])
    ax.set_ylim(-0.3, 3.55)
    ax.text(
        0.995,
        0.97,
        line["file"].removesuffix(".csv").replace("_", " "),
        transform=ax.transAxes,
        ha="right",
        va="top",
        fontsize=7,
    )


def main() -> None:
    found = load("states")
    with canvas(target("fig07"), height=3.4) as figure:
        axes = stacked(figure, 2)
        for ax, name in zip(axes, ("steady", "dropping"), strict=True):
            draw(ax, found[name])
        axes[-1].set_xlim(0, 10)


if __name__ == "__main__":
    main()
