"""The most probable alignment of one recording, or of many; one bit a decision."""

from __future__ import annotations

import numpy as np

from hmmseg.hmm.kernels.blocks import FIRST, PAD, any_missing, doubles, load, row_width
from hmmseg.hmm.kernels.compile import compiled, part
from hmmseg.hmm.kernels.simd import ahead, at, doubles_at, singles_at, value_at
from hmmseg.hmm.kernels.steps import viterbi_step

LENGTH = 512  # numerics: samples of a block


@part
def decide(delta, rows, count, num_states, stay, advance, stay_step, advance_step, entered, begin):
    """Best log weights over `count` samples; which states are entered goes to entered[begin:]."""
    vectors = (num_states + 6) // 8
    for r in range(count):
        s, v = PAD + r * stay_step, PAD + r * advance_step
        row = ahead(rows, r * num_states)
        left = delta[FIRST]
        delta[FIRST] = left + stay[s] + value_at(row)
        for c in range(vectors):
            following = delta[FIRST + 8 + 8 * c]
            entered[begin + r * vectors + c] = viterbi_step(
                at(delta, PAD + 8 * c), ahead(row, 1 + 8 * c), at(stay, s + 1 + 8 * c),
                at(advance, v + 8 * c), left,
            )  # fmt: skip
            left = following


@compiled
def best_path(ll, single, num_rows, num_states, stay, advance, varying, initial, final, starts, i):
    """First sample of each state into row i of `starts`; (log weight, first row with NaN or -1).

    Addresses as in hmmseg.hmm.kernels.forward.evidence. A state that the path does not visit
    starts where the next one does, or at the end.
    """
    vectors, width = (num_states + 6) // 8, row_width(num_states)
    delta = doubles(width, -np.inf)
    cells = LENGTH * num_states + 2 * PAD
    x = doubles(cells, 0.0)
    bad = load(ll, single, num_states, 0, 1, x)
    if bad >= 0:
        return 0.0, bad
    for k in range(num_states):
        delta[FIRST + k] = value_at(ahead(doubles_at(initial), k)) + x[PAD + k]
    size = cells if varying else num_states + 2 * PAD
    s, v = doubles(size, -np.inf), doubles(size, -np.inf)
    stay_step, advance_step = (num_states, num_states - 1) if varying else (0, 0)
    if not varying:
        load(stay, False, 1, 0, num_states, s)
        load(advance, False, 1, 0, num_states - 1, v)
    entered = np.empty(num_rows * vectors, np.uint8)
    for start in range(1, num_rows, LENGTH):
        stop = min(start + LENGTH, num_rows)
        count, begin = stop - start, start * num_states
        if varying:
            load(stay, False, num_states, start - 1, stop - 1, s)
            load(advance, False, num_states - 1, start - 1, stop - 1, v)
        # Vectors reach beyond the last row, so the last block is read through a copy.
        copied = stop * num_states + PAD > num_rows * num_states
        if single:
            copied = copied or any_missing(ahead(singles_at(ll), begin), count * num_states)
        else:
            copied = copied or any_missing(ahead(doubles_at(ll), begin), count * num_states)
        if copied:
            bad = load(ll, single, num_states, start, stop, x)
            if bad >= 0:
                return 0.0, bad
            decide(delta, at(x, PAD), count, num_states, s, v, stay_step, advance_step, entered,
                   start * vectors)  # fmt: skip
        elif single:
            decide(delta, ahead(singles_at(ll), begin), count, num_states, s, v, stay_step, advance_step,
                   entered, start * vectors)  # fmt: skip
        else:
            decide(delta, ahead(doubles_at(ll), begin), count, num_states, s, v, stay_step, advance_step,
                   entered, start * vectors)  # fmt: skip
    best, last = -np.inf, 0
    for k in range(num_states):
        value = delta[FIRST + k] + value_at(ahead(doubles_at(final), k))
        if value > best:
            best, last = value, k
    for k in range(last + 1, num_states):
        starts[i, k] = num_rows
    k, t = last, num_rows - 1
    while t > 0 and k > 0:
        where, bit = (k - 1) >> 3, (k - 1) & 7
        while t > 0 and not (entered[t * vectors + where] >> bit) & 1:
            t -= 1
        if t > 0:
            starts[i, k] = t
            k, t = k - 1, t - 1
    for j in range(k + 1):
        starts[i, j] = 0
    return best, -1


@compiled
def best_paths(ll, lengths, single, num_states, stay, advance, varying, initial, final, starts, log_prob,
               first, last):  # fmt: skip
    """`best_path` of recordings `first` to `last` - 1; the first (recording, row) with NaN, or (-1, -1).

    ll, lengths, stay, advance: arrays with one entry a recording.
    """
    for i in range(first, last):
        log_prob[i], bad = best_path(ll[i], single, lengths[i], num_states, stay[i], advance[i], varying,
                                     initial[i], final[i], starts, i)  # fmt: skip
        if bad >= 0:
            return i, bad
    return -1, -1
