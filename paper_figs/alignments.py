"""Alignments drawn from their posterior over the signals of one recording; two boundaries enlarged."""

from __future__ import annotations

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hmmseg.plot.style import BLUE, INK, RED, canvas
from paper_figs.panels import shade, state_handles
from paper_figs.results import load, target

ENLARGED = ((1, "block 1 leaves its support"), (2, "block 1 meets the ground"))
REACH = 0.13  # s on either side


def main() -> None:
    found = load("alignments")
    t, drawn = np.array(found["t"]), np.array(found["drawn"])
    with canvas(target("alignments"), height=4.9) as figure:
        grid = figure.add_gridspec(3, 2, height_ratios=[1, 1, 1.15])
        above = [figure.add_subplot(grid[0, :])]
        above.append(figure.add_subplot(grid[1, :], sharex=above[0]))
        for ax, (name, label) in zip(above, (("fy", "Net $f_y$ [N]"), ("grip", "Grip [N]")), strict=True):
            shade(ax, found["spans"])
            ax.vlines(drawn, 0, 1, transform=ax.get_xaxis_transform(), color=BLUE, alpha=0.04, lw=0.6)
            ax.plot(t, found[name], color=INK)
            ax.set_ylabel(label)
        above[0].tick_params(labelbottom=False)
        above[1].set_xlim(t[0], t[-1])
        above[1].set_xlabel("Time [s]")
        for k, (boundary, title) in enumerate(ENLARGED):
            ax = figure.add_subplot(grid[2, k])
            near = np.abs(t - found["truth"][boundary]) < REACH
            ax.vlines(
                drawn[:, boundary], 0, 1, transform=ax.get_xaxis_transform(), color=BLUE, alpha=0.25, lw=0.6
            )
            ax.axvline(found["truth"][boundary], color=RED, lw=1.2, ls="--")
            ax.plot(t[near], np.array(found["fy"])[near], ".-", color=INK, ms=5)
            ax.margins(y=0.2)
            span = found["spans"][boundary + 1]
            ax.set_title(f"{title}: {span['start']:.3f} ± {span['start_sd']:.3f} s", fontsize=8)
            ax.xaxis.set_major_locator(MaxNLocator(5))
            ax.set_xlabel("Time [s]")
            ax.set_ylabel("Net $f_y$ [N]")
        lines = [
            Line2D([], [], color=BLUE, lw=0.9, label="boundary, drawn"),
            Line2D([], [], color=RED, lw=1.2, ls="--", label="true boundary"),
        ]
        figure.legend(handles=[*lines, *state_handles()], loc="outside lower center", ncols=5)


if __name__ == "__main__":
    main()
