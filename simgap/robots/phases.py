"""Phases of logs: stretches by name, given by a task or told by motion alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.robots.rows import Rows
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

WHOLE = "whole"


@dataclass(frozen=True)
class Phases:
    """`names` of phases, and of each log its boundaries [s] (ascending) with the phase that begins there."""

    names: tuple[str, ...]
    starts: tuple[np.ndarray, ...]
    number: tuple[np.ndarray, ...]

    def of(self, rows: Rows) -> np.ndarray:
        """The phase (N,) of each row."""
        out = np.zeros(rows.log.size, int)
        for log in np.unique(rows.log):
            mine = rows.log == log
            at = np.searchsorted(self.starts[log], rows.time[mine], side="right") - 1
            out[mine] = self.number[log][np.maximum(at, 0)]
        return out


def one_phase(recordings: Sequence[Recording]) -> Phases:
    """Every log is one phase."""
    first = tuple(np.array([r.t[0]]) for r in recordings)
    return Phases((WHOLE,), first, tuple(np.zeros(1, int) for _ in recordings))


def phases_by_motion(simulator: Simulator, recordings: Sequence[Recording]) -> Phases:
    """`still` and `moving`: seconds in which any position goes further than a hundredth of its range.

    Stretches shorter than half a second belong to their neighbours.
    """
    names = [n for n, c in simulator.channels.items() if c.kind == "position"]
    if not names:
        return one_phase(recordings)
    reach = {n: max(max(float(np.nanmax(r[n]) - np.nanmin(r[n])) for r in recordings), 1e-12) for n in names}
    starts, numbers = [], []
    for log in recordings:
        edges = np.arange(log.t[0], log.t[-1], 0.5)
        rows = np.searchsorted(log.t, edges)
        ends = np.append(rows[1:], len(log))
        going = [
            any(_travel(log[n][a:b]) > 0.01 * reach[n] for n in names)
            for a, b in zip(rows, ends, strict=True)
        ]
        changes = np.flatnonzero(np.diff(np.array(going, int), prepend=-1))
        starts.append(edges[changes])
        numbers.append(np.array(going, int)[changes])
    return Phases(("still", "moving"), tuple(starts), tuple(numbers))


def _travel(values: np.ndarray) -> float:
    seen = values[np.isfinite(values)]
    return float(np.ptp(seen)) if seen.size else 0.0
