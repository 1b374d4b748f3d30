"""One step of each recursion for eight neighbouring states: what all kernels are made of.

A weight is m 2^e. A state without predecessor (the first of a chain) is not among the eight: it
comes in as the scalar `left`, the neighbour of the first. Lanes beyond the chain's end compute
something meaningless, which no state of the chain ever sees, as weight moves one way only.
"""

from __future__ import annotations

import math

from numba import types

from hmmseg.hmm.kernels.simd import MAGIC, MAGIC_BITS, Lanes, Vec, vector_function

ZERO_EXPONENT = -(1 << 60)  # numerics: of a weight that is zero; sums of a few of them still fit 64 bits
LEAST_LOG = -7e14  # numerics: a log weight below counts as -inf
IMPOSSIBLE_EXPONENT = -(1 << 49)  # numerics: a weight of a smaller exponent is zero
_LOG2E = 1.4426950408889634  # physics: a logarithm
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


@vector_function(types.void)
def exponentials(lanes: Lanes, logs, mantissa, exponent):
    """exp of eight numbers as weights: mantissas from 0.7 to 1.42.

    Cody-Waite reduction by ln 2 and the Taylor polynomial, which within ln 2 / 2 is exact to rounding.
    """
    x = lanes.load(logs).maximum(LEAST_LOG)
    rounded = x.times_plus(_LOG2E, MAGIC)
    whole = rounded - MAGIC
    rest = whole.times_plus(-_LN2_LOW, whole.times_plus(-_LN2_HIGH, x))
    value = rest * (1 / math.factorial(13)) + (1 / math.factorial(12))
    for n in range(11, -1, -1):
        value = value.times_plus(rest, 1 / math.factorial(n))
    lanes.store(value, mantissa)
    lanes.store(rounded.bits() - MAGIC_BITS, exponent)


@vector_function(types.void)
def logarithms(lanes: Lanes, mantissa, exponent, logs):
    """Natural logarithms of eight weights; -inf where they are zero.

    2 artanh(s) with s = (m - 1) / (m + 1) and m between 0.7 and 1.42.
    """
    bits = lanes.load(mantissa).bits()
    scale = (bits >> 52) - 1023
    m = ((bits & _MANTISSA) | _ONE).floats()
    high = m > math.sqrt(2)
    m = high.where(m * 0.5, m)
    scale = scale + high.where(scale * 0 + 1, 0) + lanes.load(exponent)
    s = (m - 1.0) / (m + 1.0)
    square = s * s
    series = square * (2 / 23) + 2 / 21
    for n in range(19, 0, -2):
        series = series.times_plus(square, 2 / n)
    whole = scale.maximum(-(1 << 50)).to_float()
    out = whole.times_plus(_LN2_HIGH, s.times_plus(series, whole * _LN2_LOW))
    possible = scale > IMPOSSIBLE_EXPONENT
    lanes.store(possible.where(out, -math.inf), logs)


@vector_function(types.void)
def renormalise(lanes: Lanes, mantissa, exponent):
    """Mantissas back to [1, 2); needed once in some sixteen steps."""
    bits = lanes.load(mantissa).bits()
    total = (bits >> 52) - 1023 + lanes.load(exponent)
    lanes.store(((bits & _MANTISSA) | _ONE).floats(), mantissa)
    lanes.store(total.maximum(ZERO_EXPONENT), exponent)


def _plain(m: Vec, exponent: Vec, offset: Vec, factor: Vec) -> Vec:
    e = (exponent - offset).maximum(-1022)
    value = m * _power_of_two((e > 1000).where(e * 0 + 1000, e)) * factor
    return (e > -1000).where(value, 0.0)


@vector_function(types.void)
def plain(lanes: Lanes, mantissa, exponent, offset, factor, out):
    """Weights as ordinary numbers: m 2^(e - offset) factor; zero below 1e-300."""
    lanes.store(
        _plain(lanes.load(mantissa), lanes.load(exponent), lanes.same(offset), lanes.same(factor)), out
    )


@vector_function(types.void)
def forward_step(lanes: Lanes, m, e, pm, pe, sm, se, am, ae, leftm, lefte, outm, oute):
    """Weights of paths up to the next sample: (stay + arrive from the left) times emission."""
    before, at = lanes.load(m), lanes.load(e)
    stays, stays_e = before * lanes.load(sm), at + lanes.load(se)
    enters, enters_e = before.shifted(leftm) * lanes.load(am), at.shifted(lefte) + lanes.load(ae)
    total, exponent = _added(stays, stays_e, enters, enters_e)
    lanes.store(total * lanes.load(pm), outm)
    lanes.store(exponent + lanes.load(pe), oute)


@vector_function(types.void)
def weigh(lanes: Lanes, m, e, pm, pe, outm, oute):
    """Weights of the rest times the emission; states run backwards in m and e, forwards in p."""
    lanes.store(lanes.load(m) * lanes.load(pm, back=True), outm)
    lanes.store(lanes.load(e) + lanes.load(pe, back=True), oute)


@vector_function(types.void)
def backward_step(lanes: Lanes, m, e, sm, se, am, ae, leftm, lefte, outm, oute):
    """Weights of the rest one sample earlier, from what `weigh` made; all tables run forwards."""
    after, at = lanes.load(m), lanes.load(e)
    stays, stays_e = after * lanes.load(sm, back=True), at + lanes.load(se, back=True)
    leaves = after.shifted(leftm) * lanes.load(am, back=True)
    leaves_e = at.shifted(lefte) + lanes.load(ae, back=True)
    total, exponent = _added(stays, stays_e, leaves, leaves_e)
    lanes.store(total, outm)
    lanes.store(exponent, oute)


def _joint(lanes: Lanes, m, e, sm, se, am, ae, leftm, lefte, outm, oute, fm, fe) -> tuple[Vec, Vec, Vec, Vec]:
    """`backward_step`, and with forward weights f the joint weights of states and of advances."""
    after, at = lanes.load(m), lanes.load(e)
    stays, stays_e = after * lanes.load(sm, back=True), at + lanes.load(se, back=True)
    leaves = after.shifted(leftm) * lanes.load(am, back=True)
    leaves_e = at.shifted(lefte) + lanes.load(ae, back=True)
    total, exponent = _added(stays, stays_e, leaves, leaves_e)
    lanes.store(total, outm)
    lanes.store(exponent, oute)
    forward, forward_e = lanes.load(fm, back=True), lanes.load(fe, back=True)
    return forward * total, forward_e + exponent, forward * leaves, forward_e + leaves_e


@vector_function(types.void)
def joint_step(lanes: Lanes, m, e, sm, se, am, ae, leftm, lefte, outm, oute,
               fm, fe, gm, ge, xm, xe):  # fmt: skip
    """`backward_step`, and with forward weights f the joint weights g of states and x of advances."""
    found = _joint(lanes, m, e, sm, se, am, ae, leftm, lefte, outm, oute, fm, fe)
    for vector, out in zip(found, (gm, ge, xm, xe), strict=True):
        lanes.store(vector, out, back=True)


@vector_function(types.void)
def probable_step(lanes: Lanes, m, e, sm, se, am, ae, leftm, lefte, outm, oute,
                  fm, fe, offset, factor, state, crossed):  # fmt: skip
    """`joint_step` that stores probabilities, the joint weights over 2^offset times `factor`."""
    gm, ge, xm, xe = _joint(lanes, m, e, sm, se, am, ae, leftm, lefte, outm, oute, fm, fe)
    norm = lanes.same(offset), lanes.same(factor)
    lanes.store(_plain(gm, ge, *norm), state, back=True)
    lanes.store(_plain(xm, xe, *norm), crossed, back=True)
