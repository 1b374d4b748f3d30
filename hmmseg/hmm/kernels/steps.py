"""One step of each recursion for eight neighbouring states: what all kernels are made of.

A weight is m 2^e. A state without predecessor (the first of a chain) is not among the eight: it
comes in as the scalar `left`, the neighbour of the first. Lanes beyond the chain's end compute
something meaningless, which no state of the chain ever sees, as weight moves one way only.
"""

from __future__ import annotations

import math

from numba import types

from hmmseg.hmm.kernels.simd import MAGIC, MAGIC_BITS, WIDTH, Lanes, Vec, vector_function

ZERO_EXPONENT = -(1 << 60)  # numerics: of a weight that is zero; sums of a few of them still fit 64 bits
LEAST_LOG = -7e14  # numerics: a log weight below counts as -inf
IMPOSSIBLE_EXPONENT = -(1 << 49)  # numerics: a weight of a smaller exponent is zero
LOG2E = 1.4426950408889634  # physics: a logarithm
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10  # physics: the first has 33 significant bits
_ONE = 0x3FF0000000000000  # numerics: the bits of 1.0
_MANTISSA = 0x000FFFFFFFFFFFFF  # numerics: the bits of a mantissa


def _power_of_two(exponent: Vec) -> Vec:
    """2^exponent for integers from -1022 to 1023."""
    return ((exponent + 1023) << 52).floats()


def _added(m1: Vec, e1: Vec, m2: Vec, e2: Vec) -> tuple[Vec, Vec]:
    """Sum of two weights; what is 2^-1000 of the other in exponent is lost."""
    difference = e1 - e2
    first = difference > 0
    apart = first.where(e2 - e1, difference).maximum(-1000)
    small = _power_of_two(apart)
    exponent = first.where(e1, e2)
    larger, smaller = first.where(m1, m2), first.where(m2, m1)
    return smaller.times_plus(small, larger), exponent


@vector_function(types.int64)
def viterbi_step(lanes: Lanes, delta, log_likelihood, stay, advance, left):
    """Best log weights in place; bit j of the result says whether state j is entered from its left.

    A tie goes to staying.
    """
    before = lanes.load(delta)
    stays = before + lanes.load(stay)
    enters = before.shifted(left) + lanes.load(advance)
    entered = enters > stays
    lanes.store(entered.where(enters, stays) + lanes.load(log_likelihood), delta)
    return entered.mask()


@vector_function(types.float64)
def highest(lanes: Lanes, numbers):
    """The highest of eight numbers."""
    best = lanes.load(numbers)
    for apart in (4, 2, 1):
        best = best.maximum(best.shuffled([(i + apart) % WIDTH for i in range(WIDTH)]))
    return best.first()


@vector_function(types.void)
def exponentials(lanes: Lanes, logs, mantissa, exponent):
    """exp of eight numbers as weights: mantissas from 0.7 to 1.42.

    Cody-Waite reduction by ln 2 and the Taylor polynomial, which within ln 2 / 2 is exact to rounding.
    """
    x = lanes.load(logs).maximum(LEAST_LOG)
    rounded = x.times_plus(LOG2E, MAGIC)
    whole = rounded - MAGIC
    rest = whole.times_plus(-_LN2_LOW, whole.times_plus(-_LN2_HIGH, x))
    value = rest * (1 / math.factorial(13)) + (1 / math.factorial(12))
    for n in range(11, -1, -1):
        value = value.times_plus(rest, 1 / math.factorial(n))
    lanes.store(value, mantissa)
    lanes.store(rounded.bits() - MAGIC_BITS, exponent)


@vector_function(types.void)
def renormalise(lanes: Lanes, mantissa, exponent):
    """Mantissas back to [1, 2); needed once in some sixteen steps."""
    bits = lanes.load(mantissa).bits()
    total = (bits >> 52) - 1023 + lanes.load(exponent)
    lanes.store(((bits & _MANTISSA) | _ONE).floats(), mantissa)
    lanes.store(total.maximum(ZERO_EXPONENT), exponent)


def _plain(m: Vec, exponent: Vec) -> Vec:
    """Probabilities as ordinary numbers, zero below 1e-300."""
    return (exponent > -1000).where(m * _power_of_two(exponent.maximum(-1022)), 0.0)


@vector_function(types.void)
def forward_step(lanes: Lanes, m, e, pm, pe, sm, se, am, ae, leftm, lefte, outm, oute):
    """Weights of paths up to the next sample: (stay + arrive from the left) times emission."""
    emission, emission_e = lanes.load(pm), lanes.load(pe)
    before, at = lanes.load(m), lanes.load(e)
    # What does not wait for the last sample is multiplied first.
    stays, stays_e = before * (lanes.load(sm) * emission), at + (lanes.load(se) + emission_e)
    enters = before.shifted(leftm) * (lanes.load(am) * emission)
    enters_e = at.shifted(lefte) + (lanes.load(ae) + emission_e)
    total, exponent = _added(stays, stays_e, enters, enters_e)
    lanes.store(total, outm)
    lanes.store(exponent, oute)


@vector_function(types.void)
def probable_step(lanes: Lanes, m, e, pm, pe, upm, upe, sm, se, am, ae, leftm, lefte, fm, fe, state, crossed):
    """Weights of the rest one sample earlier, in place, and what they make of forward weights f.

    The rest's states run backwards in m and e, those of all other tables forwards; `up`: emissions of the
    states above. With f over the evidence they are the probabilities of states, and of advances from them,
    `crossed`.
    """

    def back(pointer) -> Vec:
        return lanes.load(pointer, back=True)

    after, at = lanes.load(m), lanes.load(e)
    # What does not wait for the sample behind is multiplied first.
    stays, stays_e = after * (back(pm) * back(sm)), at + (back(pe) + back(se))
    leaves = after.shifted(leftm) * (back(upm) * back(am))
    leaves_e = at.shifted(lefte) + (back(upe) + back(ae))
    total, exponent = _added(stays, stays_e, leaves, leaves_e)
    lanes.store(total, m)
    lanes.store(exponent, e)
    lanes.store(_plain(back(fm) * total, back(fe) + exponent), state, back=True)
    lanes.store(_plain(back(fm) * leaves, back(fe) + leaves_e), crossed, back=True)


@vector_function(types.void)
def turn(lanes: Lanes, rows, step, out, out_step):
    """Eight rows of eight numbers, `step` apart, as columns of `out`, whose rows are `out_step` apart."""
    builder, found = lanes.builder, []
    for _ in range(WIDTH):
        found.append(lanes.load(rows))
        rows = builder.gep(rows, [step])
    for apart in (4, 2, 1):  # squares on the diagonal stay, those beside it change places
        for i in range(WIDTH):
            if not i & apart:
                upper, lower = found[i], found[i + apart]
                found[i] = upper.shuffled(
                    [WIDTH + j - apart if j & apart else j for j in range(WIDTH)], lower
                )
                found[i + apart] = upper.shuffled(
                    [WIDTH + j if j & apart else j + apart for j in range(WIDTH)], lower
                )
    for column in found:
        lanes.store(column, out)
        out = builder.gep(out, [out_step])
