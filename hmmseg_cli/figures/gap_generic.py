"""Figures of a generic diagnosis: heat map, both ensembles where they part most, before and after."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from hmmseg.plot.style import BLUE, GREY, RED, canvas
from hmmseg_cli.figures.gap import draw_probabilities
from simgap.generic.diagnose import GenericDiagnosis
from simgap.generic.features import SLOW, bin_edges
from simgap.generic.locate import both_variances, cell_means
from simgap.generic.report import DURATIONS, channel_name

MOST = 24  # scores beyond are one colour


def draw_all(found: GenericDiagnosis, path: Callable[[str], Path]) -> None:
    """All figures, at the paths that `path(name)` gives."""
    draw_heat_map(found, path("gap_where.png"))
    draw_signal(found, path("gap_signal.png"))
    draw_before_after(found, path("gap_before_after.png"))
    draw_probabilities(found, path("gap_probabilities.png"))


def _table(found: GenericDiagnosis) -> tuple[np.ndarray, list[str], list[str]]:
    """Scores (rows, subtasks), row labels (channel and part of the spectrum) and subtasks."""
    lay = found.scene.layout
    subtasks, rows = list(lay.ensembles.subtasks), {}
    for k, (c, s, *_) in enumerate(lay.cells):
        before = [other for other in lay.cells[:k] if other[:2] == (c, s)]
        part = "" if c < 0 else (" course", " low", " middle", " high")[len(before)]
        row = rows.setdefault(f"{channel_name(lay, c)}{part}", np.full(len(subtasks), np.nan))
        row[s] = found.located.z[k]
    order = sorted(rows, key=lambda name: name == DURATIONS)
    return np.array([rows[name] for name in order]), order, subtasks


def draw_heat_map(found: GenericDiagnosis, path: Path) -> None:
    """Score of every cell; those above the threshold carry it as a number."""
    grid, rows, subtasks = _table(found)
    limit = found.located.threshold
    with canvas(path, height=1.2 + 0.16 * len(rows)) as figure:
        axes = figure.add_subplot()
        top = float(np.clip(np.nanmax(grid), 2 * limit, MOST))
        shown = axes.imshow(np.clip(grid, 0, top), aspect="auto", cmap="Oranges", vmin=0, vmax=top)
        axes.set_yticks(range(len(rows)), rows)
        axes.set_xticks(range(len(subtasks)), subtasks)
        for (row, column), value in np.ndenumerate(grid):
            if np.isfinite(value) and value > limit:
                colour = "white" if value > 0.6 * top else "black"
                axes.text(column, row, f"{value:.0f}", ha="center", va="center", color=colour, fontsize=6.5)
        figure.colorbar(shown, label="score of the difference [sd]")
        axes.set_title(f"Where real and simulated trials part (numbers: above the threshold of {limit:.1f})")


def draw_signal(found: GenericDiagnosis, path: Path) -> None:
    """The slow course of the channel with the largest excess in one: real, simulated, with the effects in."""
    lay = found.scene.layout
    slow = [k for k, cell in enumerate(lay.cells) if cell[0] >= 0 and lay.kind[lay.cell == k][0] == SLOW]
    cell = max(slow, key=lambda k: found.located.z[k])
    channel, worst = lay.cells[cell][:2]
    index = np.concatenate([lay.where(SLOW, channel, k) for k in range(len(lay.ensembles.subtasks))])
    ends = found.scene.edges
    edges = [bin_edges(lay, ends[k], ends[k + 1], k) for k in range(ends.size - 1)]
    t = np.concatenate([(e[1:] + e[:-1]) / 2 for e in edges])
    real, sim = found.real[:, index], found.sim[:, index]
    with canvas(path, height=3.8) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        for rows, colour, label in ((real, RED, "real"), (sim, BLUE, "simulated")):
            above.plot(t, rows.T, color=colour, lw=0.5, alpha=0.35)
            above.plot(t, rows.mean(0), color=colour, lw=1.4, label=label)
        moved = sim.mean(0) + found.leading.shift[index]
        above.plot(
            t, moved, color="black", lw=1, ls="--", label=f"simulated + {' + '.join(found.leading.effects)}"
        )
        above.legend(fontsize=6.5)
        above.set_ylabel(lay.ensembles.channels[channel])
        a, b = both_variances(lay, found.real, found.sim)
        sd = np.sqrt(a + b / len(found.sim))[index]
        below.plot(t, (real.mean(0) - sim.mean(0)) / sd, ".-", color=RED, ms=3, lw=0.6, label="before")
        below.plot(t, (real.mean(0) - moved) / sd, ".-", color=BLUE, ms=3, lw=0.6, label="after")
        below.set_yscale("symlog", linthresh=3)
        below.set(xlabel="time [s], subtasks at their mean real durations", ylabel="residual [sd]")
        below.legend()
        for axes in (above, below):
            for edge in found.scene.edges[1:-1]:
                axes.axvline(edge, color=GREY, lw=0.5)
            axes.axvspan(*found.scene.edges[worst : worst + 2], color="#E69F00", alpha=0.15, lw=0)
        above.set_title(f"Largest difference of a course: {lay.ensembles.channels[channel]} (shaded subtask)")


def draw_before_after(found: GenericDiagnosis, path: Path) -> None:
    """Mean squared residual of single real trials by channel, in units of the scatter between trials."""
    lay = found.scene.layout
    a, b = both_variances(lay, found.real, found.sim)
    difference = found.real - found.sim.mean(0)
    size = np.bincount(lay.cell)
    channel = np.array([c for c, *_ in lay.cells])
    names = [channel_name(lay, c) for c in (*range(len(lay.ensembles.channels)), -1)]
    with canvas(path, height=2.4) as figure:
        axes = figure.add_subplot()
        at = np.arange(len(names))
        for place, shift, colour, label in (
            (-0.2, 0.0, RED, "before"),
            (0.2, found.leading.shift, BLUE, "after"),
        ):
            square = cell_means(lay, ((difference - shift) ** 2 / (a + b / len(found.sim))).mean(0)) * size
            bars = [square[channel == c].sum() / size[channel == c].sum() for c in (*at[:-1], -1)]
            axes.bar(at + place, bars, 0.4, color=colour, label=label)
        axes.axhline(1, color=GREY, lw=0.8, ls="--")
        axes.set_yscale("log")
        axes.set_xticks(at, names)
        axes.set_ylabel("mean square [sd²]")
        axes.legend()
