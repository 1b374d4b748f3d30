"""Figures of the virtual model: a block picked up in it, and a recording replayed through it."""

from __future__ import annotations

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hmmseg.plot.style import BLUE, GREY, INK, ORANGE, RED, SKY, STATE_COLOURS, canvas
from paper_figs.panels import THRESHOLD_HANDLE, forces, only, scene, shade, stacked, state_handles
from paper_figs.results import load, target

NEWTON = 0.5  # cm that a force of 1 N is drawn long
FORCES = {"fx": "Net $f_x$ [N]", "fy": "Net $f_y$ [N]", "grip": "Grip [N]"}
JUDGED = {"free-motion": ("free motion", GREY), "hold-above-ground": ("carry", SKY)}


def fig11() -> None:
    """Figure 11: the virtual scene as an operator would see it, forces on the fingers drawn in."""
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


def fig12() -> None:
    """Figure 12: forces while virtual block 2 is picked up and placed twice."""
    found = load("virtual_block")
    with canvas(target("fig12"), height=5.4) as figure:
        axes = forces(figure, found["virtual"], found["recording"])
        for ax in axes:
            for carry in found["virtual"]["carries"]:
                ax.axvspan(
                    carry["start"],
                    carry["end"],
                    color=STATE_COLOURS["hold-above-ground"],
                    alpha=0.3,
                    lw=0,
                    zorder=0,
                )
        lines = [
            Line2D([], [], color=INK, lw=0.9, label="virtual block 2, twice"),
            Line2D([], [], color=GREY, lw=0.7, label="recording: block 1, then block 2"),
        ]
        held = Patch(color=STATE_COLOURS["hold-above-ground"], alpha=0.3, lw=0, label="virtual block held")
        handles = [*lines, held, THRESHOLD_HANDLE]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)


def fig13() -> None:
    """Figure 13: the virtual block's weight, and that of the recording's block 2."""
    found = load("virtual_block")
    virtual = found["virtual"]
    held = np.any([carry["inside"] for carry in virtual["carries"]], axis=0)
    real = found["recording"]["carries"][-1]["weight"]
    with canvas(target("fig13"), height=2.6) as figure:
        ax = figure.subplots()
        ax.axhline(0, color=GREY, lw=0.5)
        ax.plot(virtual["t"], virtual["fy"], color=GREY, lw=0.9, ls=(0, (3, 1.5)), label="net vertical force")
        ax.plot(
            virtual["t"],
            only(virtual["fy"], held),
            color=BLUE,
            lw=1.6,
            label="while the virtual block is held",
        )
        ax.axhspan(
            real["mean"] - real["sd"],
            real["mean"] + real["sd"],
            color=ORANGE,
            alpha=0.35,
            lw=0,
            label="block 2 as recorded, mean ± sd",
        )
        for carry in virtual["carries"]:
            ax.text(
                (carry["start"] + carry["end"]) / 2,
                0.62,
                f"{carry['weight']['mean']:.3f} ± {carry['weight']['sd']:.3f} N",
                ha="center",
                va="bottom",
                fontsize=7.5,
            )
        ax.set_xlim(0, 10)
        ax.set_ylim(-2.4, 1)
        ax.set_xlabel("Time [s]")
        ax.set_ylabel("$f_{y1} + f_{y2}$ [N]")
        ax.legend(loc="lower center", ncols=3)


def fig14() -> None:
    """Figure 14: width while held, (a) of the recorded blocks 1 and 2, (b) of the virtual block 2."""
    found = load("virtual_block")
    with canvas(target("fig14"), height=3.8) as figure:
        axes = stacked(figure, 2)
        for ax, name in zip(axes, ("recording", "virtual"), strict=True):
            one = found[name]
            distance = 100 * np.array(one["distance"])
            held = np.any([carry["inside"] for carry in one["carries"]], axis=0)
            ax.plot(one["t"], distance, color=GREY, lw=0.9, ls=(0, (3, 1.5)), label="distance of the fingers")
            ax.plot(one["t"], only(distance, held), color=BLUE, lw=2, label="while held above ground")
            for carry in one["carries"]:
                width = 100 * carry["width"]["mean"]
                ax.text(
                    (carry["start"] + carry["end"]) / 2,
                    width - 0.12,
                    f"{carry['object']}: {width:.2f} cm\nunder {carry['grip']['mean']:.1f} N",
                    ha="center",
                    va="top",
                    fontsize=7.5,
                )
            ax.set_ylabel("$x_2 - x_1$ [cm]")
            ax.set_ylim(0.5, 4.4)
            ax.axhline(100 * found["size"][0], color=ORANGE, lw=0.9, label="block 2's identified width")
        axes[0].legend(loc="upper right", ncols=3)
        axes[-1].set_xlim(0, 10)


def replay() -> None:
    """Draw a healthy recording replayed through the calibrated model: forces and residuals."""
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
        for ax, (name, label) in zip(axes, FORCES.items(), strict=False):
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
        right = figure.add_subplot(grid[:, 1])
        for k, (state, (label, colour)) in enumerate(JUDGED.items()):
            rms = [trial[state] for trial in found["trials"]]
            place = k + np.linspace(-0.22, 0.22, len(rms))
            right.plot(place, rms, "o", color=colour, mec=INK, mew=0.4, ms=4.5, label=label)
        right.axhline(found["limit"], color=RED, lw=0.9, ls="--")
        right.text(-0.45, found["limit"] + 0.015, "limit", color=RED, fontsize=7)
        right.axhline(1, color=GREY, lw=0.6)
        right.set_xticks(range(2), ["free\nmotion", "carry"])
        right.set_xlim(-0.5, 1.5)
        right.set_ylim(0, 1.75)
        right.set_ylabel("Net force residual, rms / noise sd")
        figure.legend(handles=[*lines, *state_handles()], loc="outside lower center", ncols=5)
