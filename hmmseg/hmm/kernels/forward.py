"""Weights of all paths up to each sample: log evidence and filtered probabilities of one recording.

Of the weights only those at the start of each block are kept, so that what is needed beside the results
grows with a hundredth of the recording.
"""

from __future__ import annotations

import math

import numpy as np

from hmmseg.hmm.kernels.blocks import (
    FIRST,
    PAD,
    add,
    block_length,
    copy_row,
    doubles,
    emissions,
    first_row,
    forward_block,
    integers,
    load,
    most_gained,
    row_table,
    row_width,
    to_weights,
    weights_of,
)  # fmt: skip
from hmmseg.hmm.kernels.compile import compiled, part
from hmmseg.hmm.kernels.simd import bits_of, double_of
from hmmseg.hmm.kernels.steps import IMPOSSIBLE_EXPONENT, ZERO_EXPONENT

LN2 = math.log(2)  # physics: a logarithm


@part
def log_of(m, e):
    """Logarithm of a weight; -inf for zero."""
    shift = (bits_of(m) >> 52) - 1023
    if e + shift < IMPOSSIBLE_EXPONENT:
        return -np.inf
    return math.log(m * double_of((1023 - shift) << 52)) + (e + shift) * LN2


@part
def total(am, ae, r, final_m, final_e, num_states):
    """Sum over the states of row r of the weights times `final`."""
    sum_m, sum_e = 1.0, ZERO_EXPONENT
    for k in range(num_states):
        i = FIRST + k
        sum_m, sum_e = add(sum_m, sum_e, am[r, i] * final_m[PAD + k], ae[r, i] + final_e[PAD + k])
    return add(sum_m, sum_e, sum_m, sum_e - 2000)  # the second is nothing: mantissa to [1, 2)


@part
def read_block(ll, single, num_rows, num_states, stay, advance, varying, start, stop, x, pm, pe, sm, se,
               vm, ve):  # fmt: skip
    """Emissions of samples [start, stop) as weights, and the transitions into them where they vary."""
    bad = emissions(ll, single, num_rows, num_states, start, stop, x, pm, pe)
    if varying:
        load(stay, False, num_states, start - 1, stop - 1, x)
        to_weights(x, (stop - start) * num_states, sm, se)
        load(advance, False, num_states - 1, start - 1, stop - 1, x)
        to_weights(x, (stop - start) * (num_states - 1), vm, ve)
    return bad


@part
def put_filtered(am, ae, first, last, num_states, logs, out, start):
    """Rows `first` to `last` of forward weights, each normalised, into out[start:]."""
    for r in range(first, last + 1):
        m, e = 1.0, ZERO_EXPONENT
        for k in range(num_states):
            m, e = add(m, e, am[r, FIRST + k], ae[r, FIRST + k])
        norm = log_of(m, e) if logs else 0.0
        for k in range(num_states):
            if logs:
                own = log_of(am[r, FIRST + k], ae[r, FIRST + k])
                out[start + r - first, k] = own if math.isinf(own) else own - norm
            else:
                apart = min(ae[r, FIRST + k] - e, 1000)
                share = am[r, FIRST + k] / m
                out[start + r - first, k] = 0.0 if apart < -1000 else share * double_of((apart + 1023) << 52)


@part
def forward_pass(ll, single, num_rows, num_states, stay, advance, varying, initial, final, filtered, logs,
                 gains):  # fmt: skip
    """Forward weights, kept at the start of each block; fills `filtered` if it has rows.

    Returns the first row with NaN beside numbers or -1; the log evidence; the samples of a block; the kept
    weights (num_blocks, width); of the last block's samples those, the emissions and the transitions, all as
    mantissas and exponents; and where `gains` asks for it, the most that the emissions of each block but the
    last add to a log weight.
    """
    length, width = min(block_length(num_states), max(num_rows - 1, 1)), row_width(num_states)
    cells = length * num_states + 2 * PAD
    x, pm, pe = doubles(cells, 0.0), doubles(cells, 1.0), integers(cells, 0)
    if varying:
        sm, se, vm, ve = doubles(cells, 1.0), integers(cells, 0), doubles(cells, 1.0), integers(cells, 0)
    else:
        sm, se = weights_of(stay, num_states)
        vm, ve = weights_of(advance, num_states - 1)
    stay_step, advance_step = (num_states, num_states - 1) if varying else (0, 0)
    initial_m, initial_e = weights_of(initial, num_states)
    final_m, final_e = weights_of(final, num_states)
    am, ae = row_table(length + 1, width)
    num_blocks = (num_rows - 1 + length - 1) // length
    kept_m, kept_e = np.empty((num_blocks, width)), np.empty((num_blocks, width), np.int64)
    gained = np.empty(num_blocks)
    count = 0
    for b in range(-1, num_blocks):
        # Block -1 is the first sample alone, which no transition leads to.
        start, stop = max(1 + b * length, 0), min(1 + (b + 1) * length, num_rows)
        bad = read_block(
            ll, single, num_rows, num_states, stay, advance, varying and b >= 0, start, stop, x, pm, pe,
            sm, se, vm, ve,
        )  # fmt: skip
        if bad >= 0:
            return bad, 0.0, length, kept_m, kept_e, am, ae, pm, pe, sm, se, vm, ve, gained
        if b < 0:
            first_row(am, ae, initial_m, initial_e, pm, pe, num_states)
            if filtered.shape[0]:
                put_filtered(am, ae, 0, 1, num_states, logs, filtered, 0)
            continue
        if gains and stop < num_rows:
            gained[b] = most_gained(ll, single, num_states, start, stop)
        if b:
            copy_row(am, ae, count, am, ae, 0)
        copy_row(am, ae, 0, kept_m, kept_e, b)
        count = stop - start
        forward_block(am, ae, pm, pe, sm, se, vm, ve, stay_step, advance_step, start, count, num_states)
        if filtered.shape[0]:
            put_filtered(am, ae, 1, count, num_states, logs, filtered, start)
    sum_m, sum_e = total(am, ae, count, final_m, final_e, num_states)
    return -1, log_of(sum_m, sum_e), length, kept_m, kept_e, am, ae, pm, pe, sm, se, vm, ve, gained


@compiled
def evidence(ll, single, num_rows, num_states, stay, advance, varying, initial, final, filtered, logs):
    """Fills `filtered` (T, K) if it has rows, in logs or plain; (log evidence, first row with NaN or -1).

    The row is one with NaN beside numbers. Addresses: ll (T, K) in single or double precision; doubles:
    stay (K,) or (T - 1, K), advance (K - 1,) or (T - 1, K - 1), `varying` says which; initial, final (K,).
    """
    found = forward_pass(
        ll, single, num_rows, num_states, stay, advance, varying, initial, final, filtered, logs, False
    )  # fmt: skip
    return found[1], found[0]
