"""Signals, or any channels, stacked over time, with the subtasks of a segmentation behind them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from hmmseg.hand.signals import Signals
from hmmseg.io.trial import Trial
from hmmseg.plot.style import INK, canvas, state_colours
from hmmseg.segmentation.spans import Segmentation

LABEL_SLANT = 40  # look: degrees


def stacked_panels(
    figure: Figure, t: np.ndarray, panels: Mapping[str, np.ndarray], segmentation: Segmentation
) -> list[Axes]:
    """Draw signals (num_timesteps,) by label at times t [s] in stacked panels, over the subtasks."""
    axes = list(np.atleast_1d(figure.subplots(len(panels), 1, sharex=True)))
    for ax, (label, values) in zip(axes, panels.items(), strict=True):
        # Single samples between missing ones would be invisible in a line.
        there = np.r_[False, np.isfinite(values), False]
        alone = there[1:-1] & ~there[:-2] & ~there[2:]
        ax.plot(t, values, color=INK, lw=0.8)
        ax.plot(t[alone], values[alone], ".", color=INK, ms=1.5)
        ax.set_ylabel(label)
        ax.margins(y=0.08)
        shade_spans(ax, segmentation)
    figure.align_ylabels(axes)
    axes[-1].set_xlabel("Time [s]")
    axes[-1].set_xlim(t[0], t[-1])
    name_spans(axes[0], segmentation)
    if (failed := segmentation.failed) is not None:
        figure.suptitle(f"does not fit its task at {failed.label}", fontsize=8, fontweight="bold")
    colours = state_colours([span.state for span in segmentation.spans])
    handles = [Patch(color=colour, alpha=0.32, lw=0, label=state) for state, colour in colours.items()]
    handles.append(Patch(facecolor=INK, alpha=0.28, lw=0, label="boundary, 90 % interval"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 5))
    return axes


def shade_spans(ax: Axes, segmentation: Segmentation) -> None:
    """Colour the subtasks by state; draw boundaries as a thin line in their 90 % interval."""
    colours = state_colours([span.state for span in segmentation.spans])
    for span in segmentation.spans:
        ax.axvspan(span.start, span.end, color=colours[span.state], alpha=0.32, lw=0, zorder=0)
    for span in segmentation.spans[1:]:
        ax.axvspan(*span.start_90, color=INK, alpha=0.28, lw=0, zorder=1)
        ax.axvline(span.start, color=INK, lw=0.45, zorder=1.5)


def name_spans(ax: Axes, segmentation: Segmentation) -> None:
    """Write the subtasks' names above a panel, slanted so that short ones fit."""
    for span in segmentation.spans:
        anchor = 0.65 * span.start + 0.35 * span.end
        ax.annotate(
            span.label, (anchor, 1.0), xycoords=("data", "axes fraction"), xytext=(-2, 3),
            textcoords="offset points", rotation=LABEL_SLANT, ha="left", va="bottom",
            rotation_mode="anchor", fontsize=7,
        )  # fmt: skip


def draw_signals(signals: Signals, segmentation: Segmentation, path: Path | None = None) -> list[Axes]:
    """Plot position, distance, grip, net and shear forces over subtasks, after the paper's Figures 5 to 7."""
    panels = {
        "Mean $x$\n[cm]": 100 * signals.x,
        "Mean $y$\n[cm]": 100 * signals.y,
        "Distance\n[cm]": 100 * signals.distance,
        "Grip\n[N]": signals.grip,
        "Net $f_x$\n[N]": signals.fx,
        "Net $f_y$\n[N]": signals.fy,
        "Shear\n[N]": signals.shear,
    }
    with canvas(path, height=8.2) as figure:
        return stacked_panels(figure, signals.t, panels, segmentation)


MOST = 12  # look: panels that stay legible on one page


def draw_channels(trial: Trial, segmentation: Segmentation, path: Path | None = None) -> list[Axes]:
    """Plot every channel of a trial, MOST at most, over coloured subtasks, in its own units."""
    names = list(trial.channels)[:MOST]
    panels = {name: trial.channels[name] for name in names}
    with canvas(path, height=1.8 + 0.95 * len(panels)) as figure:
        axes = stacked_panels(figure, trial.t, panels, segmentation)
        left_out = len(trial.channels) - len(names)
        if left_out:
            axes[-1].set_xlabel(f"Time [s]   ({left_out} more channels not shown)")
        return axes
