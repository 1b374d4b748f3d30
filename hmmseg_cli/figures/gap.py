"""Figures of a diagnosis: heat map, residuals on the signals, before and after, probabilities."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hmmseg.plot.style import BLUE, GREY, ORANGE, RED, canvas
from simgap.effects.base import FORCES
from simgap.gap.diagnose import Diagnosis
from simgap.gap.frame import CHANNELS

if TYPE_CHECKING:
    from simgap.generic.diagnose import GenericDiagnosis

LABELS = {
    "x": "x [cm]",
    "y": "y [cm]",
    "distance": "distance [cm]",
    "offset": "offset [cm]",
    "vx": "vx [cm/s]",
    "vy": "vy [cm/s]",
    "fx": "net fx [N]",
    "fy": "net fy [N]",
    "grip": "grip [N]",
    "shear": "shear [N]",
}


def draw_all(found: Diagnosis, path: Callable[[str], Path]) -> None:
    """All figures of a diagnosis, at the paths that `path(name)` gives."""
    draw_heat_map(found, path("gap_where.png"))
    draw_signal(found, path("gap_signal.png"))
    draw_before_after(found, path("gap_before_after.png"))
    draw_probabilities(found, path("gap_probabilities.png"))


def _grid(found: Diagnosis) -> np.ndarray:
    """Largest score (channels, subtasks) over trials and bands; NaN where nothing is defined."""
    out = np.full((len(CHANNELS), len(found.problem.frame.steps)), np.nan)
    for cell in found.cells:
        at = CHANNELS.index(cell.channel), cell.subtask
        out[at] = np.nanmax([out[at], cell.z])
    return out


def draw_heat_map(found: Diagnosis, path: Path) -> None:
    """Excess by channel and subtask, in standard deviations; cells above the threshold carry their score."""
    steps, grid = found.problem.frame.steps, _grid(found)
    with canvas(path, height=3.4) as figure:
        axes = figure.add_subplot()
        top = max(2 * found.threshold, float(np.nanmax(grid)))
        shown = axes.imshow(np.clip(grid, 0, None), aspect="auto", cmap="Oranges", vmin=0, vmax=top)
        axes.set_yticks(range(len(CHANNELS)), CHANNELS)
        axes.set_xticks(range(len(steps)), [f"{s.name}\n{s.object or ''}" for s in steps])
        for (row, column), value in np.ndenumerate(grid):
            if np.isfinite(value) and value > found.threshold:
                axes.text(
                    column,
                    row,
                    f"{value:.0f}",
                    ha="center",
                    va="center",
                    color="white" if value > 0.6 * top else "black",
                )
        figure.colorbar(shown, label="largest excess of a cell [sd]")
        axes.set_title(
            f"Where recording and virtual model part (numbers: above the threshold of {found.threshold:.1f})"
        )


def _signal(found: Diagnosis, trial: int, channel: str) -> np.ndarray:
    """A recorded signal in the figure's unit."""
    import jax
    import jax.numpy as jnp

    from simgap.effects.base import tips

    w = found.problem.frame.world
    position, velocity = (np.asarray(z)[trial] for z in tips(jax.tree.map(jnp.asarray, w)))
    force = dict(zip(FORCES, w.force[trial].T, strict=True))
    x1, y1, x2, y2 = position.T
    table = {
        "x": (x1 + x2) * 50,
        "y": (y1 + y2) * 50,
        "distance": (x2 - x1) * 100,
        "offset": (y2 - y1) * 100,
        "vx": (velocity[:, 0] + velocity[:, 2]) * 50,
        "vy": (velocity[:, 1] + velocity[:, 3]) * 50,
        "fx": force["fx1"] + force["fx2"],
        "fy": force["fy1"] + force["fy2"],
        "grip": np.minimum(force["fx1"], -force["fx2"]),
        "shear": (force["fy1"] - force["fy2"]) / 2,
    }
    return table[channel]


def draw_signal(found: Diagnosis, path: Path) -> None:
    """The channel and trial of the largest excess: the signal, and its whitened residual beneath."""
    frame = found.problem.frame
    cell = max(found.cells, key=lambda c: c.energy - c.count)
    r, c, n = cell.trial, CHANNELS.index(cell.channel), frame.lengths[cell.trial]
    t, there = frame.world.t[r, :n], found.problem.whitening.weight[r, :n, c] > 0
    with canvas(path, height=3.4) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(t, _signal(found, r, cell.channel)[:n], color=BLUE)
        above.set_ylabel(LABELS[cell.channel])
        inside = t[frame.arrays.subtask[r, :n] == cell.subtask]
        for axes in (above, below):
            for event in frame.world.events[r]:
                axes.axvline(event, color=GREY, lw=0.5)
            axes.axvspan(inside[0], inside[-1], color=ORANGE, alpha=0.2, lw=0)
        below.plot(t[there], found.before[r, :n, c][there], ".", color=RED, ms=3, label="without the effect")
        below.plot(
            t[there], found.after[r, :n, c][there], ".", color=BLUE, ms=3, label="with the verdict's effect"
        )
        below.set_yscale("symlog", linthresh=3)
        below.set(xlabel="time [s]", ylabel="residual [sd]")
        below.legend()
        above.set_title(f"Largest excess: {cell.channel} in {frame.files[r]} (shaded subtask)")


def draw_before_after(found: Diagnosis, path: Path) -> None:
    """Mean squared whitened residual by channel, before and after, against the noise floor of 1."""
    there = found.problem.whitening.weight > 0
    count = np.maximum(there.sum((0, 1)), 1)
    used = np.asarray(there.any((0, 1)))
    with canvas(path, height=2.4) as figure:
        axes = figure.add_subplot()
        at = np.arange(used.sum())
        for shift, z, colour, label in (
            (-0.2, found.before, RED, "before"),
            (0.2, found.after, BLUE, "after"),
        ):
            axes.bar(at + shift, ((z**2).sum((0, 1)) / count)[used], 0.4, color=colour, label=label)
        axes.axhline(1, color=GREY, lw=0.8, ls="--")
        axes.set_yscale("log")
        axes.set_xticks(at, [c for c, u in zip(CHANNELS, used, strict=True) if u])
        axes.set_ylabel("mean square [sd²]")
        axes.legend()


def draw_probabilities(found: Diagnosis | GenericDiagnosis, path: Path) -> None:
    """The probabilities of the likeliest explanations."""
    rows = sorted(found.body["probabilities"].items(), key=lambda item: -item[1])[:8][::-1]
    with canvas(path, height=2.0) as figure:
        axes = figure.add_subplot()
        axes.barh([name for name, _ in rows], [value for _, value in rows], color=BLUE)
        axes.set(xlim=(0, 1), xlabel="probability")
