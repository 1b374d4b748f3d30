"""A healthy recording replayed through the calibrated model: forces, and what is left of them."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import BLUE, GREY, INK, RED, SKY, canvas
from paper_figs.panels import shade, state_handles
from paper_figs.results import load, target

LABELS = {"fx": "Net $f_x$ [N]", "fy": "Net $f_y$ [N]", "grip": "Grip [N]"}
SHOWN = {"free-motion": ("free motion", GREY), "hold-above-ground": ("carry", SKY)}


def main() -> None:
    found = load("replay")
    t = np.array(found["t"])
    edges = [t[0], *found["boundaries"], t[-1]]
    spans = [
        {"state": s, "start": a, "end": b}
        for s, a, b in zip(found["states"], edges[:-1], edges[1:], strict=True)
    ]
    with canvas(target("replay"), height=5.6) as figure:
        grid = figure.add_gridspec(4, 2, width_ratios=[3.4, 1])
        axes = [figure.add_subplot(grid[0, 0])]
        axes += [figure.add_subplot(grid[k, 0], sharex=axes[0]) for k in (1, 2, 3)]
        for ax, (name, label) in zip(axes, LABELS.items(), strict=False):
            shade(ax, spans)
            ax.plot(t, found["predicted"][name], color=BLUE, lw=1.6, label="predicted")
            ax.plot(t, found["measured"][name], color=INK, lw=0.7, label="recorded")
            ax.set_ylabel(label)
            ax.tick_params(labelbottom=False)
        lines = axes[0].get_legend_handles_labels()[0]
        rest = np.subtract(found["measured"]["fy"], found["predicted"]["fy"]) / found["sd_net"]
        shade(axes[3], spans)
        axes[3].axhline(0, color=GREY, lw=0.5)
        axes[3].plot(t, rest, ".", color=INK, ms=2)
        axes[3].set_ylim(-6, 6)
        axes[3].set_ylabel("Net $f_y$ residual\n[noise sd]")
        axes[3].set_xlabel("Time [s]")
        axes[3].set_xlim(t[0], t[-1])
        figure.align_ylabels(axes)
        beside = figure.add_subplot(grid[:, 1])
        for k, (state, (label, colour)) in enumerate(SHOWN.items()):
            rms = [trial[state] for trial in found["trials"]]
            place = k + np.linspace(-0.22, 0.22, len(rms))
            beside.plot(place, rms, "o", color=colour, mec=INK, mew=0.4, ms=4.5, label=label)
        beside.axhline(found["limit"], color=RED, lw=0.9, ls="--")
        beside.text(-0.45, found["limit"] + 0.015, "limit", color=RED, fontsize=7)
        beside.axhline(1, color=GREY, lw=0.6)
        beside.set_xticks(range(2), ["free\nmotion", "carry"])
        beside.set_xlim(-0.5, 1.5)
        beside.set_ylim(0, 1.75)
        beside.set_ylabel("Net force residual, rms / noise sd")
        figure.legend(handles=[*lines, *state_handles()], loc="outside lower center", ncols=5)


if __name__ == "__main__":
    main()
