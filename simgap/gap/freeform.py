"""A free-form discrepancy: what any description of the residual could explain on held-out trials.

In every channel and subtask a parabola over the subtask's own time, common to all trials. It never
takes a name; it gives the ceiling for shrinkage.
"""

from __future__ import annotations

import numpy as np

from simgap.gap.fit import Problem

RIDGE = 1.0


def heldout_square(given: Problem, z: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Squared residual (trials, S) left on blocks whose parabolas were fitted to the other blocks."""
    frame, there = given.frame, given.whitening.weight > 0
    trials = frame.num_trials
    out = np.zeros((trials, len(frame.steps)))
    for s in range(len(frame.steps)):
        for c in range(z.shape[2]):
            rows = [
                (r, inside)
                for r in range(trials)
                if (inside := np.flatnonzero((frame.arrays.subtask[r] == s) & there[r, :, c])).size
            ]
            parts = {r: (_basis(inside.size), z[r, inside, c]) for r, inside in rows}
            for r, (basis, values) in parts.items():
                others = [q for q in parts if labels[q, s] != labels[r, s]]
                h = RIDGE * np.eye(3) + sum((parts[q][0].T @ parts[q][0] for q in others), np.zeros((3, 3)))
                g = sum((parts[q][0].T @ parts[q][1] for q in others), np.zeros(3))
                out[r, s] += float(((values - basis @ np.linalg.solve(h, g)) ** 2).sum())
    return out


def _basis(n: int) -> np.ndarray:
    s = np.linspace(-1, 1, n) if n > 1 else np.zeros(1)
    return np.stack([np.ones(n), s, s**2], 1)
