"""Figures of a diagnosis, drawn from its JSON: where, which suspects, how far; and one signal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hmmseg.plot.style import BLUE, GREY, RED, canvas
from simgap.report.finding import CHANNELS, by_place, chances, plain_name, share_of

Body = Mapping[str, Any]


def draw_all(body: Body, subtasks: Sequence[str], path: Callable[[str], Path]) -> None:
    """All figures that the body tells of, at the paths that `path(name)` gives."""
    draw_heat_map(body, subtasks, path("gap_where.png"))
    draw_suspects(body, path("gap_probabilities.png"))
    if body.get("shrinkage") and body["shrinkage"].get("before") is not None:
        draw_how_far(body, path("gap_before_after.png"))


def draw_heat_map(body: Body, subtasks: Sequence[str], path: Path | None = None) -> Axes:
    """Share of the gap by channel and subtask, all trials together: the numbers of the table."""
    cells = by_place(body)
    channels = [*CHANNELS, *sorted({k[0] for k in cells} - set(CHANNELS))]
    if not set(CHANNELS) & {k[0] for k in cells} and cells:
        channels = sorted({k[0] for k in cells})
    grid = np.full((len(channels), len(subtasks)), np.nan)
    for (channel, subtask), found in cells.items():
        if subtask in subtasks:
            grid[channels.index(channel), list(subtasks).index(subtask)] = 100 * share_of(found)
    with canvas(path, height=1.4 + 0.2 * len(channels)) as figure:
        axes = figure.add_subplot()
        top = float(np.nanmax(grid)) if np.isfinite(grid).any() else 1.0
        shown = axes.imshow(grid, aspect="auto", cmap="Oranges", vmin=0, vmax=max(top, 1.0))
        axes.set_yticks(range(len(channels)), channels)
        axes.set_xticks(range(len(subtasks)), [s.replace(" ", "\n") for s in subtasks])
        for (row, column), value in np.ndenumerate(grid):
            if np.isfinite(value):
                text, colour = (
                    "<1" if value < 0.5 else f"{value:.0f}",
                    "white" if value > 0.6 * top else "black",
                )
                axes.text(column, row, text, ha="center", va="center", color=colour)
        figure.colorbar(shown, label="share of the gap [%]")
        axes.set_title("Where recording and model differ (blank: within the noise)")
    return axes


def draw_suspects(body: Body, path: Path | None = None) -> Axes:
    """Whether each suspect acts, and the share of the gap that it explains; else the probabilities."""
    effects = body.get("attribution")
    if effects:
        known = chances(body)
        rows = sorted(effects.items(), key=lambda item: -known[item[0]])[:8][::-1]
        values = [known[name] for name, _ in rows]
    else:
        rows = sorted(body["probabilities"].items(), key=lambda item: -item[1])[:8][::-1]
        values = [v for _, v in rows]
    at = np.arange(len(rows))
    with canvas(path, height=2.6) as figure:
        axes = figure.add_subplot()
        axes.barh(at, values, 0.6, color=BLUE, alpha=0.85, label="probability that it acts")
        for k, (_, entry) in enumerate(rows):
            share = entry.get("share") if effects else None
            if share is not None and entry["probability"] >= 0.01:
                ends = entry.get("interval_90") or (share, share)
                axes.plot(ends, [k, k], color=RED, lw=1.4)
                axes.plot(
                    share, k, "o", color=RED, ms=4, label="share of the gap" if k == len(rows) - 1 else None
                )
        axes.set_yticks(at, [plain_name(name) for name, _ in rows])
        axes.set(xlim=(0, 1.02))
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return axes


def draw_how_far(body: Body, path: Path) -> None:
    """Mean squared residual of held-out trials before and after, against what healthy recordings leave."""
    s = body["shrinkage"]
    with canvas(path, height=1.7) as figure:
        axes = figure.add_subplot()
        axes.barh([1, 0], [s["before"], s["after"]], 0.55, color=[RED, BLUE])
        axes.axvline(s["noise_floor"], color=GREY, lw=1, ls="--", label="left by healthy recordings")
        axes.set_yticks([1, 0], ["the model as it is", "with the cause in it"])
        if s["before"] > 20 * max(s["after"], 1e-9):
            axes.set_xscale("log")
        axes.set_xlabel(f"mean squared residual on {s['evaluated_on']} [noise variances]")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))  # above the bars, which reach the edge
