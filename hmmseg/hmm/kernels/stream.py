"""One sample at a time: forward weights of the last samples in a window, and what smooths them.

Rows of the window as in hmmseg.hmm.kernels.blocks; the emissions of row r + 1 stand in p's row r.
The general functions are for chains that may pass over states: logs, am and pm hold them, the
exponents are unused.
"""

from __future__ import annotations

import math

import numpy as np

from hmmseg.hmm.kernels.blocks import (
    FIRST,
    PAD,
    add,
    empty_row,
    exponentials,
    first_row,
    forward_block,
    load,
    weights_of,
)  # fmt: skip
from hmmseg.hmm.kernels.compile import compiled
from hmmseg.hmm.kernels.forward import log_of, put_filtered, total
from hmmseg.hmm.kernels.general import log_add
from hmmseg.hmm.kernels.simd import at
from hmmseg.hmm.kernels.smoothing import backward_block, plain
from hmmseg.hmm.kernels.steps import IMPOSSIBLE_EXPONENT, ZERO_EXPONENT


@compiled
def push(row, num_states, addresses, sample, head, am, ae, pm, pe, x, filtered):
    """Sample number `sample` into row `head` of the window; the log weight of all paths up to it.

    -inf where no path is left, NaN where the row has NaN beside numbers. Fills `filtered` (1, K).
    """
    stay, advance, _, initial, _ = addresses
    if load(row, False, num_states, 0, 1, x) >= 0:
        return np.nan
    p = max(head - 1, 0) * num_states
    for i in range(PAD, PAD + num_states, 8):
        exponentials(at(x, i), at(pm, p + i), at(pe, p + i))
    if sample == 0:
        initial_m, initial_e = weights_of(initial, num_states)
        first_row(am, ae, initial_m, initial_e, pm, pe, num_states)
    else:
        sm, se = weights_of(stay, num_states)
        vm, ve = weights_of(advance, num_states - 1)
        forward_block(am[head - 1 : head + 1], ae[head - 1 : head + 1], pm[p:], pe[p:], sm, se, vm, ve,
                      0, 0, sample, 1, num_states)  # fmt: skip
    m, e = 1.0, ZERO_EXPONENT
    for k in range(num_states):
        m, e = add(m, e, am[head, FIRST + k], ae[head, FIRST + k])
    if e < IMPOSSIBLE_EXPONENT:
        return -np.inf
    put_filtered(am, ae, head, head, num_states, False, filtered, 0)
    return log_of(m, e)


@compiled
def window(num_states, addresses, first, head, am, ae, pm, pe, ended, smoothed, boundary):
    """Smoothed rows `first` to `head` into `smoothed`, the boundaries between them into `boundary`.

    `ended`: the recording ends here, in the states that the chain says. Returns whether it can.
    """
    stay, advance, _, _, final = addresses
    count, last = head - first, num_states - 1
    final_m, final_e = weights_of(final, num_states)
    if not ended:
        for k in range(num_states):
            final_m[PAD + k], final_e[PAD + k] = 1.0, 0
    sum_m, sum_e = total(am, ae, head, final_m, final_e, num_states)
    if sum_e < IMPOSSIBLE_EXPONENT:
        return False
    sm, se = weights_of(stay, num_states)
    vm, ve = weights_of(advance, last)
    bm, be = empty_row(num_states)
    for k in range(num_states):
        rest_m, rest_e = final_m[PAD + k] / sum_m, final_e[PAD + k] - sum_e
        bm[FIRST + last - k], be[FIRST + last - k] = rest_m, rest_e
        smoothed[count, k] = plain(am[head, FIRST + k] * rest_m, ae[head, FIRST + k] + rest_e)
    p, cells = first * num_states, count * num_states + 2 * PAD
    state, crossed = np.empty(cells), np.empty(cells)
    backward_block(am[first : head + 1], ae[first : head + 1], bm, be, pm[p:], pe[p:], sm, se, vm, ve, 0, 0,
                   1, count, num_states, state, crossed)  # fmt: skip
    for r in range(count):
        for k in range(num_states):
            smoothed[r, k] = state[PAD + r * num_states + k]
        for k in range(last):
            boundary[r, k] = crossed[PAD + r * last + k]
    return True


@compiled
def rebase(am, ae, first, head, num_states):
    """Moves rows `first` to `head` to the front and takes the last row's largest exponent out of all."""
    top = ZERO_EXPONENT
    for k in range(num_states):
        top = max(top, ae[head, FIRST + k])
    for r in range(head - first + 1):
        for i in range(am.shape[1]):
            am[r, i] = am[first + r, i]
            ae[r, i] = max(ae[first + r, i] - top, ZERO_EXPONENT)
    return top


@compiled
def push_general(x, bands, initial, sample, head, am, pm, filtered):
    """`push` in logs: x (K,) without NaN."""
    num_states = x.size
    norm = -np.inf
    for k in range(num_states):
        total = initial[k]
        if sample:
            total = -np.inf
            for d in range(min(bands.shape[1], k + 1)):
                total = log_add(total, am[head - 1, k - d] + bands[0, d, k - d])
        am[head, k] = total + x[k]
        pm[head, k] = x[k]
        norm = log_add(norm, am[head, k])
    if not math.isinf(norm):
        for k in range(num_states):
            filtered[0, k] = math.exp(am[head, k] - norm)
    return norm


@compiled
def window_general(bands, final, first, head, am, pm, ended, smoothed, boundary):
    """`window` in logs; who passes over states crosses all their boundaries."""
    num_states = am.shape[1]
    beta, new = np.empty(num_states), np.empty(num_states)
    norm = -np.inf
    for k in range(num_states):
        beta[k] = final[k] if ended else 0.0
        norm = log_add(norm, am[head, k] + beta[k])
    if math.isinf(norm):
        return False
    for r in range(head, first - 1, -1):
        if r < head:
            for k in range(num_states):
                total = -np.inf
                for d in range(min(bands.shape[1], num_states - k)):
                    rest = bands[0, d, k] + pm[r + 1, k + d] + beta[k + d]
                    for j in range(k, k + d):
                        boundary[r - first, j] += math.exp(am[r, k] + rest - norm)
                    total = log_add(total, rest)
                new[k] = total
            beta, new = new, beta
        for k in range(num_states):
            smoothed[r - first, k] = math.exp(am[r, k] + beta[k] - norm)
    return True
