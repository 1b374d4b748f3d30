"""Log evidence, filtered and smoothed probabilities and boundary posteriors of one recording.

Forward weights are kept at the end of each block and made anew block by block on the way back, so
that what is needed beside the results grows with a hundredth of the recording.
"""

from __future__ import annotations

import math

import numpy as np

from hmmseg.hmm.kernels.blocks import (
    FIRST,
    PAD,
    RENORMALISE,
    add,
    block_length,
    copy_row,
    doubles,
    emissions,
    empty_row,
    first_row,
    forward_block,
    integers,
    load,
    renormalise_row,
    row_width,
    to_logs,
    to_weights,
    weights_of,
)  # fmt: skip
from hmmseg.hmm.kernels.compile import compiled
from hmmseg.hmm.kernels.simd import at, bits_of, double_of
from hmmseg.hmm.kernels.steps import (
    IMPOSSIBLE_EXPONENT,
    ZERO_EXPONENT,
    joint_step,
    plain,
    probable_step,
    weigh,
)

LN2 = math.log(2)  # physics: a logarithm


@compiled
def log_of(m, e):
    """Logarithm of a weight; -inf for zero."""
    shift = (bits_of(m) >> 52) - 1023
    if e + shift < IMPOSSIBLE_EXPONENT:
        return -np.inf
    return math.log(m * double_of((1023 - shift) << 52)) + (e + shift) * LN2


@compiled
def total(am, ae, r, final_m, final_e, num_states):
    """Sum over the states of row r of the weights times `final`."""
    sum_m, sum_e = 1.0, ZERO_EXPONENT
    for k in range(num_states):
        i = FIRST + k
        sum_m, sum_e = add(sum_m, sum_e, am[r, i] * final_m[PAD + k], ae[r, i] + final_e[PAD + k])
    return add(sum_m, sum_e, sum_m, sum_e - 2000)  # the second is nothing: mantissa to [1, 2)


@compiled
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


@compiled
def put(m, e, count, offset, factor, logs, shift, x, out, begin):
    """`count` weights from PAD on into out[begin:]: their logarithms less `shift`, or plain numbers."""
    if logs:
        to_logs(m, e, count, x)
        for i in range(count):
            out[begin + i] = x[PAD + i] - shift
    else:
        for i in range(PAD, PAD + count, 8):
            plain(at(m, i), at(e, i), offset, factor, at(x, i))
        for i in range(count):
            out[begin + i] = x[PAD + i]


@compiled
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


@compiled
def smooth(ll, single, num_rows, num_states, stay, advance, varying, initial, final,
           filtered, smoothed, boundary, logs):  # fmt: skip
    """Fills the tables that have rows; returns (log evidence, first row with NaN beside numbers or -1).

    Addresses: ll (T, K) in single or double precision; doubles: stay (K,) or (T - 1, K), advance
    (K - 1,) or (T - 1, K - 1), `varying` says which; initial, final (K,). Arrays: filtered, smoothed
    (T, K); boundary (T - 1, K - 1).
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
    am, ae = np.empty((length + 1, width)), np.empty((length + 1, width), np.int64)
    num_blocks = (num_rows - 1 + length - 1) // length
    kept_m, kept_e = np.empty((num_blocks, width)), np.empty((num_blocks, width), np.int64)

    count = 0
    for b in range(-1, num_blocks):
        # Block -1 is the first sample alone, which no transition leads to.
        start, stop = max(1 + b * length, 0), min(1 + (b + 1) * length, num_rows)
        bad = read_block(
            ll, single, num_rows, num_states, stay, advance, varying and b >= 0, start, stop, x, pm, pe,
            sm, se, vm, ve,
        )  # fmt: skip
        if bad >= 0:
            return 0.0, bad
        if b < 0:
            first_row(am, ae, initial_m, initial_e, pm, pe, num_states)
            if filtered.shape[0]:
                put_filtered(am, ae, 0, 1, num_states, logs, filtered, 0)
            continue
        if b:
            copy_row(am, ae, count, am, ae, 0)
        copy_row(am, ae, 0, kept_m, kept_e, b)
        count = stop - start
        forward_block(am, ae, pm, pe, sm, se, vm, ve, stay_step, advance_step, start, count, num_states)
        if filtered.shape[0]:
            put_filtered(am, ae, 1, count, num_states, logs, filtered, start)
    sum_m, sum_e = total(am, ae, count, final_m, final_e, num_states)
    log_evidence = log_of(sum_m, sum_e)
    if smoothed.shape[0] == 0 or math.isinf(log_evidence):
        return log_evidence, -1

    gm, ge = doubles(cells, 1.0), integers(cells, 0)
    xm, xe = doubles(cells, 1.0), integers(cells, 0)
    bm, be = empty_row(num_states)
    flat, crossed = smoothed.reshape(smoothed.size), boundary.reshape(boundary.size)
    for b in range(num_blocks, -1, -1):
        # Block num_blocks is the last sample alone, which no transition leaves.
        start, stop = 1 + b * length, min(1 + (b + 1) * length, num_rows)
        size = (stop - start) * num_states
        if b == num_blocks:
            start, size = num_rows, num_states
            for k in range(num_states):
                i, j = FIRST + k, FIRST + num_states - 1 - k
                bm[j], be[j] = final_m[PAD + k], final_e[PAD + k]
                gm[PAD + k], ge[PAD + k] = am[count, i] * bm[j], ae[count, i] + be[j]
        else:
            if b < num_blocks - 1:
                read_block(ll, single, num_rows, num_states, stay, advance, varying, start, stop, x, pm, pe,
                           sm, se, vm, ve)  # fmt: skip
                copy_row(kept_m, kept_e, b, am, ae, 0)
                forward_block(am, ae, pm, pe, sm, se, vm, ve, stay_step, advance_step, start, stop - start,
                              num_states)  # fmt: skip
            if b > 0 and not logs:
                backward_plain(am, ae, bm, be, pm, pe, sm, se, vm, ve, stay_step, advance_step, start,
                               stop - start, num_states, sum_e, 1 / sum_m, flat, crossed)  # fmt: skip
                continue
            backward_block(am, ae, bm, be, pm, pe, sm, se, vm, ve, stay_step, advance_step, start,
                           stop - start, num_states, gm, ge, xm, xe)  # fmt: skip
            put(xm, xe, (stop - start) * (num_states - 1), sum_e, 1 / sum_m, logs, log_evidence, x, crossed,
                (start - 1) * (num_states - 1))  # fmt: skip
        put(gm, ge, size, sum_e, 1 / sum_m, logs, log_evidence, x, flat, (start - 1) * num_states)
    return log_evidence, -1


@compiled
def backward_block(am, ae, bm, be, pm, pe, sm, se, vm, ve, stay_step, advance_step, first, count,
                   num_states, gm, ge, xm, xe):  # fmt: skip
    """Joint weights of the samples first - 1 to first + count - 2, from those of the rest in b.

    The rest's weights stand in reverse order of the states, so that they too move one way: the last
    state at FIRST. They are those at the block's last sample before, at sample first - 1 after.
    """
    width = bm.size
    fm, fe = am.reshape(am.size), ae.reshape(ae.size)
    cm, ce = empty_row(num_states)
    for r in range(count - 1, -1, -1):
        p, last = PAD + r * num_states, num_states - 1
        s, v, old = PAD + r * stay_step, PAD + r * advance_step, r * width + FIRST
        cm[FIRST], ce[FIRST] = bm[FIRST] * pm[p + last], be[FIRST] + pe[p + last]
        for c in range(0, last, 8):
            k = last - 8 - c  # the lowest state of these eight, below 0 where there are fewer
            weigh(at(bm, PAD + c), at(be, PAD + c), at(pm, p + k), at(pe, p + k), at(cm, PAD + c),
                  at(ce, PAD + c))  # fmt: skip
        bm[FIRST], be[FIRST] = cm[FIRST] * sm[s + last], ce[FIRST] + se[s + last]
        g = PAD + r * num_states
        gm[g + last], ge[g + last] = fm[old + last] * bm[FIRST], fe[old + last] + be[FIRST]
        for c in range(0, last, 8):
            k = last - 8 - c
            joint_step(
                at(cm, PAD + c), at(ce, PAD + c), at(sm, s + k), at(se, s + k), at(vm, v + k), at(ve, v + k),
                cm[FIRST + c], ce[FIRST + c], at(bm, PAD + c), at(be, PAD + c), at(fm, old + k),
                at(fe, old + k), at(gm, g + k), at(ge, g + k), at(xm, PAD + r * last + k),
                at(xe, PAD + r * last + k),
            )  # fmt: skip
        if (first + r) % RENORMALISE == 0:
            renormalise_row(bm, be, width)


@compiled
def backward_plain(am, ae, bm, be, pm, pe, sm, se, vm, ve, stay_step, advance_step, first, count,
                   num_states, offset, factor, state, crossed):  # fmt: skip
    """`backward_block` that writes probabilities right away: weights over factor 2^offset, not for block 0.

    Vectors reach below a row's first state into the row before, which is written after it.
    """
    width = bm.size
    fm, fe = am.reshape(am.size), ae.reshape(ae.size)
    cm, ce = empty_row(num_states)
    for r in range(count - 1, -1, -1):
        p, last = PAD + r * num_states, num_states - 1
        s, v, old = PAD + r * stay_step, PAD + r * advance_step, r * width + FIRST
        cm[FIRST], ce[FIRST] = bm[FIRST] * pm[p + last], be[FIRST] + pe[p + last]
        for c in range(0, last, 8):
            k = last - 8 - c
            weigh(at(bm, PAD + c), at(be, PAD + c), at(pm, p + k), at(pe, p + k), at(cm, PAD + c),
                  at(ce, PAD + c))  # fmt: skip
        bm[FIRST], be[FIRST] = cm[FIRST] * sm[s + last], ce[FIRST] + se[s + last]
        row = first - 1 + r
        apart = fe[old + last] + be[FIRST] - offset
        share = fm[old + last] * bm[FIRST] * factor
        state[row * num_states + last] = 0.0 if apart <= -1000 else share * double_of((apart + 1023) << 52)
        for c in range(0, last, 8):
            k = last - 8 - c
            probable_step(
                at(cm, PAD + c), at(ce, PAD + c), at(sm, s + k), at(se, s + k), at(vm, v + k), at(ve, v + k),
                cm[FIRST + c], ce[FIRST + c], at(bm, PAD + c), at(be, PAD + c), at(fm, old + k),
                at(fe, old + k), offset, factor, at(state, row * num_states + k), at(crossed, row * last + k),
            )  # fmt: skip
        if (first + r) % RENORMALISE == 0:
            renormalise_row(bm, be, width)
