"""Joint posterior of all properties: of one recording, and of ten pooled."""

from __future__ import annotations

import warnings

import numpy as np
from matplotlib.lines import Line2D

from hmmseg.numbers import SHOWN
from hmmseg.plot.style import BLUE, GREY, RED, canvas
from paper_figs.results import load, target

SIZE = 7.2  # in
LEVELS = (0.393, 0.865)  # one and two standard deviations of a plane normal


def main() -> None:
    with warnings.catch_warnings():  # its ArviZ announces its own refactoring at import
        warnings.filterwarnings("ignore", category=FutureWarning)
        from corner.corner import corner
    found = load("posterior")
    names = found["all"]["names"]
    factors = np.array([SHOWN[key][0] for _, key in names])
    draws = {which: np.array(found[which]["draws"]) * factors for which in ("one", "all")}
    truths = [found["actual"][block][key][0] * SHOWN[key][0] for block, key in names]
    labels = [f"{block}\n{key} [{SHOWN[key][1]}]" for block, key in names]
    low, high = (draws["one"].mean(axis=0) + k * draws["one"].std(axis=0) for k in (-4, 4))
    ranges = [
        (min(a, t) - 0.05 * (b - a), max(b, t) + 0.05 * (b - a))
        for a, b, t in zip(low, high, truths, strict=True)
    ]
    with canvas(target("corner"), width=SIZE, height=SIZE, layout=None) as figure:
        for which, colour in (("one", GREY), ("all", BLUE)):
            corner(
                draws[which],
                fig=figure,
                labels=labels,
                range=ranges,
                color=colour,
                levels=LEVELS,
                bins=60,
                smooth=1.5,
                plot_datapoints=False,
                plot_density=False,
                max_n_ticks=3,
                labelpad=0.18,
                label_kwargs={"fontsize": 7.5},
                hist_kwargs={"lw": 1, "density": True},
                contour_kwargs={"linewidths": 0.9},
            )
        axes = np.array(figure.axes).reshape(len(names), len(names))
        for ax in axes[1:, 0]:  # labels near a corner would meet those of the panel beside
            low, high = ax.get_ylim()
            ticks = [tick for tick in ax.get_yticks() if low < tick < high]
            inner = [0.1 < (tick - low) / (high - low) < 0.9 for tick in ticks]
            ax.set_yticks(ticks, [f"{t:.3f}" if shown else "" for t, shown in zip(ticks, inner, strict=True)])
        for i, vertical in enumerate(truths):
            for row in range(i, len(names)):
                axes[row, i].axvline(vertical, color=RED, lw=0.7)
            for column in range(i):
                axes[i, column].axhline(vertical, color=RED, lw=0.7)
        figure.subplots_adjust(0.11, 0.11, 0.98, 0.98)
        handles = [
            Line2D([], [], color=GREY, label="one recording"),
            Line2D([], [], color=BLUE, label="ten recordings"),
            Line2D([], [], color=RED, label="actual"),
        ]
        figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.97, 0.97))


if __name__ == "__main__":
    main()
