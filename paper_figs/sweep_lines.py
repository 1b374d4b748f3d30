"""Every one-dimensional sweep: boundary error, state accuracy and property errors by method."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hmmseg.plot.style import canvas
from paper_figs.sweep_results import METHODS, load, series, target

# Sweep: label of its axis, factor to the printed unit, whether levels are spaced by ratio.
SWEEPS = {
    "noise": ("noise, × the\nrig's", 1, True),
    "rate": ("sampling rate\n[Hz]", 1, True),
    "pace": ("rate of work,\n× the usual", 1, True),
    "vibration": ("vibration after\ncontact [N]", 1, False),
    "missing": ("missing values\n[%]", 100, False),
    "grasp": ("grip above the\ncentre [mm]", 1000, False),
}
TICKS = {"noise": (0.25, 1, 4, 16), "rate": (10, 100, 1000), "pace": (0.5, 1, 2), "vibration": (0, 0.5, 1),
         "missing": (0, 20, 40), "grasp": (-4, 0, 4)}  # fmt: skip
# Measure: label, factor, limits.
MEASURES = {
    "boundary_median": ("boundary error,\nmedian [ms]", 1e3, (0.5, 1500)),
    "boundary_95": ("boundary error,\n95 % [ms]", 1e3, (2, 6000)),
    "accuracy": ("samples in the\nwrong state [%]", 100, (0.03, 100)),
    "weight": ("weight error,\nmedian [%]", 100, (0.03, 60)),
    "width": ("width error,\nmedian [%]", 100, (0.0008, 20)),
    "height": ("height error,\nmedian [%]", 100, (0.008, 60)),
}


def draw(ax: Axes, found: dict[str, Any], sweep: str, key: str) -> None:
    """One measure over one sweep; what is beyond the axis sits at its upper edge, hollow."""
    _, factor, limits = MEASURES[key]
    _, unit, ratio = SWEEPS[sweep]
    for name, (label, colour, marker) in METHODS.items():
        level, value, low, high = series(found, sweep, name, key)
        if key == "accuracy":
            value, low, high = 1 - value, 1 - high, 1 - low
        value, low, high = (np.clip(factor * v, *limits) for v in (value, low, high))
        there = value < limits[1]
        ax.fill_between(unit * level, low, high, color=colour, alpha=0.18, lw=0)
        ax.plot(unit * level, np.where(there, value, np.nan), marker=marker, ms=3, color=colour, label=label)
        edge = np.full((~there).sum(), limits[1] * 0.8)
        ax.plot(unit * level[~there], edge, ls="", marker=marker, ms=3.5, mfc="white", mec=colour)
    ax.set_yscale("log")
    ax.set_ylim(limits)
    if ratio:
        ax.set_xscale("log")
    ax.minorticks_off()


def main() -> None:
    found = load()
    with canvas(target("sweep_lines"), height=8.2) as figure:
        axes = figure.subplots(len(MEASURES), len(SWEEPS), sharex="col", sharey="row")
        for row, key in zip(axes, MEASURES, strict=True):
            for ax, sweep in zip(row, SWEEPS, strict=True):
                draw(ax, found, sweep, key)
            row[0].set_ylabel(MEASURES[key][0])
        for ax, sweep in zip(axes[-1], SWEEPS, strict=True):
            ax.set_xlabel(SWEEPS[sweep][0])
            ax.set_xticks(TICKS[sweep], [f"{v:g}" for v in TICKS[sweep]])
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=4)


if __name__ == "__main__":
    main()
