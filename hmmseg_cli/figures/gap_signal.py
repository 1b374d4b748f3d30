"""The recorded signal and its residual where a diagnosis finds the largest gap."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
from hmmseg.plot.style import BLUE, GREY, ORANGE, RED, canvas
from simgap.gap.diagnose import Diagnosis
from simgap.gap.trial_arrays import CHANNELS

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


def _signal(found: Diagnosis, trial: int, channel: str) -> np.ndarray:
    """A recorded signal in the figure's unit."""
    import jax
    import jax.numpy as jnp

    from simgap.effects.base import tips

    w = found.problem.frame.world
    position, velocity = (np.asarray(z)[trial] for z in tips(jax.tree.map(jnp.asarray, w)))
    force = dict(zip(FORCE_CHANNELS, w.force[trial].T, strict=True))
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
