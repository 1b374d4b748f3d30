"""Both ensembles of a generic diagnosis where they part most."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hmmseg.plot.style import BLUE, GREY, RED, canvas
from simgap.generic.diagnose import GenericDiagnosis
from simgap.generic.features import SLOW, bin_edges
from simgap.generic.locate import both_variances


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
