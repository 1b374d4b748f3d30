"""Signals behind a first-order filter, for many of its time constants at once."""

from __future__ import annotations

import numpy as np

from hmmseg.hmm.kernels.compile import compiled


def lagging(values: np.ndarray, kept: np.ndarray, place: np.ndarray, share: np.ndarray) -> np.ndarray:
    """What filters make of even steps of signals (..., num_steps), at times between two steps (..., N, C).

    `kept` (C,): the share of what was before that each filter keeps in a step; before the first step it was
    as in that. `place` (N,), never falling: the step before each time, `share` (N,): how far it is on the way
    to the next.
    """
    rows = np.ascontiguousarray(values.reshape(-1, values.shape[-1]))
    out = np.empty((len(rows), place.size, kept.size))
    _lagging(rows, kept, place, share, out)
    return out.reshape(*values.shape[:-1], place.size, kept.size)


@compiled
def _lagging(rows, kept, place, share, out):
    """y = (1 - kept) x + kept y of every row x (R, S) for every filter, read into out (R, N, C)."""
    num_filters = kept.size
    before, now = np.empty(num_filters), np.empty(num_filters)
    for r in range(rows.shape[0]):
        for c in range(num_filters):
            now[c] = rows[r, 0]
        n = 0
        for s in range(rows.shape[1]):
            for c in range(num_filters):
                before[c] = now[c]
                now[c] = (1 - kept[c]) * rows[r, s] + kept[c] * before[c]
            while n < place.size and place[n] + 1 == s:
                for c in range(num_filters):
                    out[r, n, c] = (1 - share[n]) * before[c] + share[n] * now[c]
                n += 1
