"""Figures of one recording: subtasks, signals, states, samples used for properties, alignments."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from hmmseg.plot.style import BLUE, GREY, INK, RED, WIDTH, canvas
from paper_figs.panels import THRESHOLD_HANDLE, forces, name_marks, only, scene, shade, stacked, state_handles
from paper_figs.results import load, target

ROMAN = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII", "IX")
POSITIONS = {
    "x": "Mean $x$ [cm]",
    "y": "Mean $y$ [cm]",
    "distance": "Distance\n$x_2 - x_1$ [cm]",
    "offset": "Offset\n$y_2 - y_1$ [mm]",
}
STATES = ("none", "free motion", "hold above ground", "hold on ground")
CLEAR = {"block2": 0.66, "block1": 0.08}  # s left of the arrow, clear of the curve
ENLARGED = ((1, "block 1 leaves its support"), (2, "block 1 meets the ground"))
REACH = 0.13  # s on either side


def fig03() -> None:
    """Figure 3: the nine subtasks of the block-stacking task, as one recording shows them."""
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


def fig05() -> None:
    """Figure 5: positions of the two fingers."""
    found = load("recording")
    middle = {(s["subtask"], s["object"]): (s["start"] + s["end"]) / 2 for s in found["spans"]}
    with canvas(target("fig05"), height=5.4) as figure:
        axes = stacked(figure, len(POSITIONS))
        for ax, (name, label) in zip(axes, POSITIONS.items(), strict=True):
            shade(ax, found["spans"])
            ax.plot(
                found["t"], (1000 if name == "offset" else 100) * np.array(found["signals"][name]), color=INK
            )
            ax.set_ylabel(label)
            ax.margins(y=0.22)
        name_marks(axes[0], [(time, "m") for (name, _), time in middle.items() if name in ("carry",)])
        released = next(s for s in found["spans"] if s["subtask"] == "release")
        name_marks(axes[0], [((released["start"] + released["end"]) / 2, "m")])
        name_marks(
            axes[1], [(time, "gg") for (name, _), time in middle.items() if name in ("pickup", "place")]
        )
        name_marks(axes[2], [(middle["carry", name], f"g{name[-1]}") for name in ("block1", "block2")])
        axes[-1].set_xlim(0, 10)
        figure.align_ylabels(axes)
        figure.legend(handles=state_handles(), loc="outside lower center", ncols=3)


def fig06() -> None:
    """Figure 6: forces on the environment."""
    found = load("recording")
    carries = [s for s in found["spans"] if s["subtask"] == "carry"]
    with canvas(target("fig06"), height=5.4) as figure:
        axes = forces(figure, {"t": found["t"], **found["signals"]})
        for ax in axes:
            shade(ax, found["spans"])
            name_marks(ax, [((s["start"] + s["end"]) / 2, f"g{s['object'][-1]}") for s in carries])
        figure.legend(handles=[*state_handles(), THRESHOLD_HANDLE], loc="outside lower center", ncols=4)


def draw_states(ax: Axes, line: dict[str, Any]) -> None:
    t, state = np.array(line["t"]), np.array(line["state"])
    ax.step(t, state, where="mid", color=INK, lw=0.6)
    ax.plot(t, state, ".", color=BLUE, ms=2.8)
    sliding, none = np.array(line["sliding"], bool), state == 0
    ax.plot(t[sliding], state[sliding], "x", color=RED, ms=4)
    ax.plot(t[none], state[none], "o", color=RED, ms=4, mfc="none", mew=0.8)
    ax.set_yticks(range(4), [f"{name}  {k}" for k, name in enumerate(STATES)])
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


def fig07() -> None:
    """Figure 7: the state of every sample by the paper's rules."""
    found = load("states")
    with canvas(target("fig07"), height=3.4) as figure:
        axes = stacked(figure, 2)
        for ax, name in zip(axes, ("steady", "dropping"), strict=True):
            draw_states(ax, found[name])
        axes[-1].set_xlim(0, 10)


def fig08() -> None:
    """Figure 8: the net vertical force, and the samples that give the weights."""
    found = load("recording")
    force, used = np.array(found["signals"]["fy"]), np.array(found["used"]["weight"], bool)
    t = np.array(found["t"])
    with canvas(target("fig08"), height=2.4) as figure:
        ax = figure.subplots()
        ax.axhline(0, color=GREY, lw=0.5)
        ax.plot(t, force, color=GREY, lw=0.9, ls=(0, (3, 1.5)), label="net vertical force, all states")
        ax.plot(t, only(force, used), color=BLUE, lw=1.6, label="used for a weight (hold above ground)")
        for span in (s for s in found["spans"] if s["subtask"] == "carry"):
            inside = used & (t >= span["start"]) & (t < span["end"])
            mean, sd = force[inside].mean(), force[inside].std(ddof=1)
            ax.annotate(
                f"{span['object']}: {mean:.3f} ± {sd:.3f} N",
                ((span["start"] + span["end"]) / 2, 0.62),
                ha="center",
                va="bottom",
                fontsize=7.5,
            )
        ax.set_xlim(0, 10)
        ax.set_ylim(-2, 1)
        ax.set_xlabel("Time [s]")
        ax.set_ylabel("$f_{y1} + f_{y2}$ [N]")
        ax.legend(loc="lower left", ncols=2)


def fig09() -> None:
    """Figure 9: the height of the right finger, and the samples that give the heights."""
    found = load("recording")
    t, y = np.array(found["t"]), 100 * np.array(found["signals"]["y2"])
    used = np.array(found["used"]["height"], bool)
    level = {}
    for span in found["spans"]:
        if span["subtask"] in ("pickup", "place"):
            inside = used & (t >= span["start"]) & (t < span["end"])
            level[span["object"], span["subtask"]] = (y[inside].mean(), (span["start"] + span["end"]) / 2)
    with canvas(target("fig09"), height=2.6) as figure:
        ax = figure.subplots()
        ax.plot(t, y, color=GREY, lw=0.9, ls=(0, (3, 1.5)), label="right finger, all states")
        ax.plot(t, only(y, used), color=BLUE, lw=2.0, label="used for a height (hold on ground)")
        for moved, beneath in (("block1", "block2"), ("block2", "block1")):
            (first, start), (second, end) = level[moved, "pickup"], level[moved, "place"]
            ax.plot([start, end], [first, first], color=INK, lw=0.5, ls=":")
            at = end - 0.12
            ax.annotate(
                "",
                (at, second),
                (at, first),
                arrowprops={"arrowstyle": "<->", "lw": 0.7, "color": INK, "shrinkA": 0, "shrinkB": 0},
            )
            ax.text(
                at - CLEAR[beneath],
                (first + second) / 2,
                f"height of {beneath}\n{abs(second - first):.2f} cm",
                ha="right",
                va="center",
                fontsize=7.5,
            )
        ax.set_xlim(0, 10)
        ax.set_ylim(0, 6.5)
        ax.set_xlabel("Time [s]")
        ax.set_ylabel("$y_2$ [cm]")
        ax.legend(loc="upper right", ncols=2)


def alignments() -> None:
    """Alignments drawn from their posterior over the signals of one recording; two boundaries enlarged."""
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
