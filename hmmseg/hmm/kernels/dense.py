"""Any state after any other: recursions over the transitions that are possible, in logs.

Transitions are lists: `first` (num_states + 1,) says where each state's sources begin in `source` and
`weight`. Rows x (num_samples, num_states) hold no NaN.
"""

from __future__ import annotations

import math

import numpy as np

from hmmseg.hmm.kernels.compile import compiled


@compiled
def dense_evidence(x, initial, first, source, weight):
    """Log of the summed weight of all paths."""
    num_rows, num_states = x.shape
    alpha, new = np.empty(num_states), np.empty(num_states)
    for k in range(num_states):
        alpha[k] = initial[k] + x[0, k]
    for t in range(1, num_rows):
        for k in range(num_states):
            top = -np.inf
            for i in range(first[k], first[k + 1]):
                top = max(top, alpha[source[i]] + weight[i])
            total = 0.0
            if top > -np.inf:
                for i in range(first[k], first[k + 1]):
                    total += math.exp(alpha[source[i]] + weight[i] - top)
                new[k] = top + math.log(total) + x[t, k]
            else:
                new[k] = -np.inf
        alpha, new = new, alpha
    top = -np.inf  # written out: the same by NumPy's functions takes a third of a second to compile
    for k in range(num_states):
        top = max(top, alpha[k])
    total = 0.0
    for k in range(num_states):
        total += math.exp(alpha[k] - top)
    return top + math.log(total) if math.isfinite(top) else top


@compiled
def dense_path(x, initial, first, source, weight, path):
    """Most probable states into `path` (num_samples,); its log weight. A tie goes to the lower state."""
    num_rows, num_states = x.shape
    came = np.empty((num_rows, num_states), np.int32)
    delta, new = np.empty(num_states), np.empty(num_states)
    for k in range(num_states):
        delta[k] = initial[k] + x[0, k]
    for t in range(1, num_rows):
        for k in range(num_states):
            best, at = -np.inf, k
            for i in range(first[k], first[k + 1]):
                value = delta[source[i]] + weight[i]
                if value > best:
                    best, at = value, source[i]
            new[k], came[t, k] = best + x[t, k], at
        delta, new = new, delta
    k = 0
    for i in range(1, num_states):
        if delta[i] > delta[k]:
            k = i
    best = delta[k]
    for t in range(num_rows - 1, -1, -1):
        path[t] = k
        k = came[t, k]
    return best
