"""Figures of a robot's diagnosis: where, windows before and after, probabilities, held-out residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.plot.style import BLUE, GREY, RED, canvas
from simgap.robots.diagnose import RobotDiagnosis

MOST = 12  # look: bars


@dataclass(frozen=True)
class Drawn:
    """A diagnosis with its document, as the page takes it."""

    found: RobotDiagnosis
    body: dict[str, Any]
    warnings: Sequence[str]


def draw_all(drawn: Drawn, path: Callable[[str], Path]) -> None:
    """All figures, at the paths that `path(name)` gives."""
    draw_where(drawn, path("gap_where.png"))
    draw_signal(drawn, path("gap_signal.png"))
    draw_probabilities(drawn, path("gap_probabilities.png"))
    draw_before_after(drawn, path("gap_before_after.png"))


def draw_page(drawn: Drawn, path: Callable[[str], Path]) -> None:
    """Those that a page shows beside its own tables."""
    draw_signal(drawn, path("gap_signal.png"))
    draw_before_after(drawn, path("gap_before_after.png"))


def draw_where(drawn: Drawn, path: Path) -> None:
    """Root mean square residual of every channel in every log, in noise's standard deviations."""
    found = drawn.found
    rows = found.composed.rows
    logs = [r.name for r in found.composed.recordings]
    size = np.sqrt(rows.variance)
    grid = np.full((len(rows.channels), len(logs)), np.nan)
    for c in range(len(rows.channels)):
        for k in range(len(logs)):
            mine = (rows.channel == c) & (rows.log == k) & np.isfinite(found.plain.residual)
            if mine.any():
                grid[c, k] = np.sqrt(np.mean((found.plain.residual[mine] / size[mine]) ** 2))
    with canvas(path, height=1.6 + 0.25 * len(rows.channels)) as figure:
        axes = figure.add_subplot()
        shown = axes.imshow(np.log10(np.maximum(grid, 1.0)), aspect="auto", cmap="Oranges")
        axes.set_yticks(range(len(rows.channels)), rows.channels)
        axes.set_xticks(range(len(logs)), [_short(n) for n in logs], rotation=30, ha="right", fontsize=6)
        for (row, column), value in np.ndenumerate(grid):
            if np.isfinite(value) and grid.size <= 160:
                dark = np.log10(max(value, 1)) > 0.6 * np.nanmax(np.log10(np.maximum(grid, 1)))
                axes.text(
                    column,
                    row,
                    f"{value:.2g}",
                    ha="center",
                    va="center",
                    fontsize=6,
                    color="white" if dark else "black",
                )
        bar = figure.colorbar(shown)
        bar.set_label("log10 of rms [sd of noise]")
        axes.set_title("Residual of restarted windows, model as it came")


def _short(name: str) -> str:
    stem = Path(name).stem
    return stem if len(stem) <= 22 else "…" + stem[-21:]


def draw_signal(drawn: Drawn, path: Path) -> None:
    """Recorded, and simulated as it came and with the causes, in the log and channel that part most."""
    found = drawn.found
    rows = found.composed.rows
    size = np.sqrt(rows.variance)
    square = np.where(np.isfinite(found.plain.residual), (found.plain.residual / size) ** 2, 0.0)
    key = rows.log * len(rows.channels) + rows.channel
    log, channel = divmod(int(np.bincount(key, square).argmax()), len(rows.channels))
    mine = (rows.log == log) & (rows.channel == channel)
    t, window = rows.time[mine], rows.window[mine]
    breaks = np.flatnonzero(np.diff(window)) + 1
    unit = found.composed.simulator.channels[rows.channels[channel]].unit
    before, after = _both(found)
    label = "with the causes, held out" if found.shrinkage is not None else "with what was fitted"

    def split(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.insert(t, breaks, np.nan), np.insert(values, breaks, np.nan)

    with canvas(path, height=4.2) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        observed = rows.observed[mine]
        above.plot(t, observed, color="black", lw=1.2, label="recorded")
        for residual, colour, name in ((before, RED, "model as it came"), (after, BLUE, label)):
            above.plot(*split(observed - residual[mine]), color=colour, lw=0.8, label=name)
            below.plot(*split(residual[mine]), color=colour, lw=0.8, label=name)
        above.set_ylabel(f"{rows.channels[channel]} [{unit}]")
        below.set(xlabel="time [s]", ylabel=f"residual [{unit}]")
        below.axhline(0, color=GREY, lw=0.5)
        above.legend(fontsize=6.5)
        above.set_title(
            f"{_short(found.composed.recordings[log].name)}: windows restarted from the recording"
        )


def _both(found: RobotDiagnosis) -> tuple[np.ndarray, np.ndarray]:
    """Residuals before and after, each log predicted from the others where that was done."""
    far = found.shrinkage
    return (found.plain.residual, found.linear.residual) if far is None else (far.plain, far.residual)


def draw_probabilities(drawn: Drawn, path: Path) -> None:
    """Probabilities of the verdicts."""
    ranked = sorted(drawn.body["probabilities"].items(), key=lambda item: item[1])[-MOST:]
    with canvas(path, height=0.8 + 0.22 * len(ranked)) as figure:
        axes = figure.add_subplot()
        axes.barh([n for n, _ in ranked], [p for _, p in ranked], color=BLUE)
        axes.set_xlim(0, 1)
        axes.set_xlabel("probability")


def draw_before_after(drawn: Drawn, path: Path) -> None:
    """Root mean square residual by log of the channel with the largest gap, before and after, held out."""
    found = drawn.found
    rows = found.composed.rows
    before, after = _both(found)
    logs = [r.name for r in found.composed.recordings]
    size = np.sqrt(rows.variance)
    at = np.arange(len(logs))
    with canvas(path, height=2.6) as figure:
        axes = figure.add_subplot()
        for place, residual, colour, name in (
            (-0.2, before, RED, "before"),
            (0.2, after, BLUE, "after"),
        ):
            each = [np.sqrt(np.nanmean(((residual / size)[rows.log == k]) ** 2)) for k in at]
            axes.bar(at + place, each, 0.4, color=colour, label=name)
        axes.axhline(1, color=GREY, lw=0.8, ls="--")
        axes.set_yscale("log")
        axes.set_xticks(at, [_short(n) for n in logs], rotation=30, ha="right", fontsize=6)
        axes.set_ylabel("rms residual [sd of noise]")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        axes.set_title("Held-out logs" if found.shrinkage is not None else "All logs")
