"""Smoothed probabilities and boundary posteriors of one recording: nothing is computed that is zero.

Forward weights are kept at the end of each block and made anew on the way back, there only for the states
through which paths of any probability lead: [lowest, highest]. A state further up than any that is probable
at the block's end is out, as paths only ascend; so is one whose forward weight at the block's start, times
the most that any path can gain in the block, is nothing against the evidence. Left out so is less than
1e-290 of any probability. Where one state remains, nothing has to be made anew. Tables have one row a state,
so that memory of a state's samples is touched only where it has any probability.
"""

from __future__ import annotations

import math

import numpy as np

from hmmseg.hmm.kernels.blocks import (
    FIRST,
    PAD,
    RENORMALISE,
    doubles,
    empty_row,
    forward_block,
    integers,
    load_part,
    renormalise_row,
    row_table,
    row_width,
    to_weights,
    weights_of,
)  # fmt: skip
from hmmseg.hmm.kernels.compile import compiled, part
from hmmseg.hmm.kernels.forward import forward_pass, log_of, total
from hmmseg.hmm.kernels.simd import at, bits_of, double_of
from hmmseg.hmm.kernels.steps import LOG2E, ZERO_EXPONENT, probable_step, turn

NOTHING = -1010  # numerics: exponent of a probability that counts as zero; one of -1000 is written as zero


@part
def magnitude(m, e):
    """Exponent of a weight whose mantissa is any: the weight is at least 2^e, and less than twice that."""
    return e + (bits_of(m) >> 52) - 1023


@part
def plain(m, e):
    """A probability as an ordinary number, zero below 1e-300."""
    return m * double_of((e + 1023) << 52) if e > -1000 else 0.0


@part
def log2_of_moves(sm, se, vm, ve, num_states):
    """The most that a step's transitions multiply a weight by, as a power of two."""
    most = -np.inf
    for k in range(num_states):
        weight = log_of(sm[PAD + k], se[PAD + k])
        if k < num_states - 1:
            on = log_of(vm[PAD + k], ve[PAD + k])
            top = max(weight, on)
            if top > -math.inf:
                weight = top + math.log(math.exp(weight - top) + math.exp(on - top))
        most = max(most, weight)
    return most * LOG2E


@part
def lowest_state(kept_m, kept_e, b, hi, gain):
    """The lowest of the states up to `hi` whose forward weight times 2^gain is not nothing."""
    for k in range(hi):
        if magnitude(kept_m[b, FIRST + k], kept_e[b, FIRST + k]) + gain > NOTHING:
            return k
    return hi


@compiled
def probabilities(ll, single, num_rows, num_states, stay, advance, varying, initial, final,
                  smoothed, boundary):  # fmt: skip
    """Fills smoothed (K, T) and boundary (K - 1, T - 1), zeros before; arguments and result as `evidence`."""
    bad, log_evidence, length, kept_m, kept_e, am, ae, pm, pe, sm, se, vm, ve, gained = forward_pass(
        ll, single, num_rows, num_states, stay, advance, varying, initial, final, np.empty((0, 0)), False,
        True,
    )  # fmt: skip
    if bad >= 0 or math.isinf(log_evidence):
        return log_evidence, bad
    num_blocks, last_row = kept_m.shape[0], num_rows - 1
    moves = 0.0 if varying else log2_of_moves(sm, se, vm, ve, num_states)
    x, state, crossed = doubles(pm.size, 0.0), doubles(pm.size, 0.0), doubles(pm.size, 0.0)

    # Weights of the rest over the evidence, at the last sample.
    final_m, final_e = weights_of(final, num_states)
    count = last_row - max(num_blocks - 1, 0) * length
    sum_m, sum_e = total(am, ae, count, final_m, final_e, num_states)
    rest_m, rest_e = doubles(num_states, 1.0), integers(num_states, 0)
    for k in range(num_states):
        rest_m[k], rest_e[k] = final_m[PAD + k] / sum_m, final_e[PAD + k] - sum_e
        smoothed[k, last_row] = plain(am[count, FIRST + k] * rest_m[k], ae[count, FIRST + k] + rest_e[k])

    lo, hi = 0, num_states - 1  # states outside have no probability at the end of the block
    for b in range(num_blocks - 1, -1, -1):
        start, stop = 1 + b * length, min(1 + (b + 1) * length, num_rows)
        count, known, width = stop - start, lo, num_states
        if b < num_blocks - 1:
            lo = 0
            if not varying:
                most = ZERO_EXPONENT
                for k in range(known, hi + 1):
                    most = max(most, magnitude(rest_m[k], rest_e[k]))
                lo = lowest_state(kept_m, kept_e, b, hi, gained[b] * LOG2E + count * moves + most)
            width = hi - lo + 1
            if width == 1:  # what paths gain here need not be known: all of any probability stay
                for t in range(start - 1, stop - 1):
                    smoothed[hi, t] = 1.0
                rest_m[hi], rest_e[hi] = 1 / kept_m[b, FIRST + hi], -kept_e[b, FIRST + hi]
                continue
            load_part(ll, single, num_states, start, stop, lo, width, x)
            to_weights(x, count * width, pm, pe)
            if varying:
                load_part(stay, False, num_states, start - 1, stop - 1, lo, width, x)
                to_weights(x, count * width, sm, se)
                load_part(advance, False, num_states - 1, start - 1, stop - 1, lo, width - 1, x)
                to_weights(x, count * (width - 1), vm, ve)
            am, ae = row_table(count + 1, row_width(width))
            for k in range(width):
                am[0, FIRST + k], ae[0, FIRST + k] = kept_m[b, FIRST + lo + k], kept_e[b, FIRST + lo + k]
        # Transitions that do not vary are of all states.
        at_lo, stay_step, advance_step = (0, width, width - 1) if varying else (lo, 0, 0)
        steps = sm[at_lo:], se[at_lo:], vm[at_lo:], ve[at_lo:], stay_step, advance_step
        if b < num_blocks - 1:
            forward_block(am, ae, pm, pe, *steps, start, count, width)
        bm, be = empty_row(width)
        for k in range(max(known, lo), hi + 1):
            bm[FIRST + hi - k], be[FIRST + hi - k] = rest_m[k], rest_e[k]
        backward_block(am, ae, bm, be, pm, pe, *steps, start, count, width, state, crossed)
        spread(state, count, width, smoothed, lo, start - 1)
        spread(crossed, count, width - 1, boundary, lo, start - 1)
        top, hi = hi, lo
        for k in range(lo, top + 1):
            rest_m[k], rest_e[k] = bm[FIRST + top - k], be[FIRST + top - k]
            if magnitude(am[0, FIRST + k - lo] * rest_m[k], ae[0, FIRST + k - lo] + rest_e[k]) > NOTHING:
                hi = k
    return log_evidence, -1


@part
def spread(rows, count, width, out, lo, begin):
    """A block's probabilities (count, width), from PAD on, into the rows lo, lo + 1, ... of `out`."""
    flat, length = out.reshape(out.size), out.shape[1]
    tall, wide = count & -8, width & -8
    for k in range(0, wide, 8):
        for r in range(0, tall, 8):
            turn(at(rows, PAD + r * width + k), width, at(flat, (lo + k) * length + begin + r), length)
    for k in range(width):
        for r in range(tall if k < wide else 0, count):
            out[lo + k, begin + r] = rows[PAD + r * width + k]


@part
def backward_block(am, ae, bm, be, pm, pe, sm, se, vm, ve, stay_step, advance_step, first, count,
                   num_states, state, crossed):  # fmt: skip
    """Probabilities of the samples first - 1 to first + count - 2 from the weights of the rest in b.

    Rows of `state` (count, K) and `crossed` (count, K - 1) stand from PAD on. The rest's weights, over the
    evidence, stand in reverse order of the states, so that they too move one way: the last state at FIRST.
    They are those at the block's last sample before, at sample first - 1 after. Vectors reach below a row's
    first state into the row before, which is written after it.
    """
    width, last = bm.size, num_states - 1
    fm, fe = am.reshape(am.size), ae.reshape(ae.size)
    for r in range(count - 1, -1, -1):
        p, s, v, old = PAD + r * num_states, PAD + r * stay_step, PAD + r * advance_step, r * width + FIRST
        left_m, left_e = bm[FIRST], be[FIRST]
        bm[FIRST], be[FIRST] = left_m * (pm[p + last] * sm[s + last]), left_e + (pe[p + last] + se[s + last])
        state[p + last] = plain(fm[old + last] * bm[FIRST], fe[old + last] + be[FIRST])
        for c in range(0, last, 8):
            k = last - 8 - c  # the lowest state of these eight, below 0 where there are fewer
            next_m, next_e = bm[FIRST + 8 + c], be[FIRST + 8 + c]
            probable_step(
                at(bm, PAD + c), at(be, PAD + c), at(pm, p + k), at(pe, p + k), at(pm, p + k + 1),
                at(pe, p + k + 1), at(sm, s + k), at(se, s + k), at(vm, v + k), at(ve, v + k), left_m, left_e,
                at(fm, old + k), at(fe, old + k), at(state, p + k), at(crossed, PAD + r * last + k),
            )  # fmt: skip
            left_m, left_e = next_m, next_e
        if (first + r) % RENORMALISE == 0:
            renormalise_row(bm, be, width)
