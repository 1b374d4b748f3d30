"""Blocks of samples: read, made into weights, and carried forward. What all sums over paths share.

A block holds so many samples that its tables stay in the processor's cache. Tables of a block have
PAD unused numbers at either end, as vectors reach over the ends of rows. State 0 of the chain stands
at FIRST of a row of weights, the others behind it, in whole vectors.
"""

from __future__ import annotations

import numpy as np

from hmmseg.hmm.kernels.compile import compiled, part
from hmmseg.hmm.kernels.simd import ahead, at, bits_of, double_of, doubles_at, singles_at, value_at
from hmmseg.hmm.kernels.steps import ZERO_EXPONENT, exponentials, forward_step, highest, renormalise

PAD = 8  # numerics: states; tables are padded to multiples of it
FIRST = 7  # numerics: states of a vector
RENORMALISE = 16  # numerics: samples; mantissas change by less than 2^4 a sample
CELLS = 1 << 12  # numerics: of a block


@part
def block_length(num_states):
    """Samples of a block."""
    return max(128, min(1024, CELLS // num_states))


@compiled
def row_width(num_states):
    """Numbers in a row of weights."""
    return PAD + 8 * ((num_states + 6) // 8)


@part
def number(address, single, index):
    """Number of a table in single or double precision."""
    if single:
        return value_at(ahead(singles_at(address), index))
    return value_at(ahead(doubles_at(address), index))


@part
def load(address, single, num_states, start, stop, out):
    """Rows [start, stop) of a table into `out` from PAD on; rows of NaN alone become zeros, no evidence.

    Returns the first row with NaN beside numbers, -1 where there is none.
    """
    missing, begin, size = 0, start * num_states, (stop - start) * num_states
    if single:
        ones = singles_at(address)
        for i in range(size):
            out[PAD + i] = value_at(ahead(ones, begin + i))
    else:
        twos = doubles_at(address)
        for i in range(size):
            out[PAD + i] = value_at(ahead(twos, begin + i))
    for i in range(PAD, PAD + size):
        missing += out[i] != out[i]
    if missing:
        for t in range(stop - start):
            row, count = PAD + t * num_states, 0
            for k in range(num_states):
                count += out[row + k] != out[row + k]
            if 0 < count < num_states:
                return start + t
            if count:
                for k in range(num_states):
                    out[row + k] = 0.0
    return -1


@part
def load_part(address, single, num_states, start, stop, first, width, out):
    """`load` of `width` states from `first` on, of rows that are known to be sound."""
    if width == num_states:
        load(address, single, num_states, start, stop, out)
        return
    for r in range(stop - start):
        begin = (start + r) * num_states + first
        for k in range(width):
            value = number(address, single, begin + k)
            out[PAD + r * width + k] = 0.0 if value != value else value


@part
def most_gained(ll, single, num_states, start, stop):
    """Log weight of the emissions of samples [start, stop) along the best of all states at each."""
    gained = 0.0
    for t in range(start, stop):
        best = -np.inf
        if single:
            ones = ahead(singles_at(ll), t * num_states)
            if num_states >= 8:
                for k in range(0, num_states - 8, 8):
                    best = max(best, highest(ahead(ones, k)))
                best = max(best, highest(ahead(ones, num_states - 8)))
            else:
                for k in range(num_states):
                    best = max(best, value_at(ahead(ones, k)))
        else:
            twos = ahead(doubles_at(ll), t * num_states)
            if num_states >= 8:
                for k in range(0, num_states - 8, 8):
                    best = max(best, highest(ahead(twos, k)))
                best = max(best, highest(ahead(twos, num_states - 8)))
            else:
                for k in range(num_states):
                    best = max(best, value_at(ahead(twos, k)))
        if -np.inf < best:  # neither missing nor impossible
            gained += best
    return gained


@part
def any_missing(rows, count):
    """Whether there is a NaN among `count` numbers."""
    missing = 0
    for i in range(count):
        value = value_at(ahead(rows, i))
        missing += value != value
    return missing > 0


@part
def begin_of_line(numbers):
    """First of these numbers that begins a line of the cache: vectors across two lines are slow."""
    return (-(numbers.ctypes.data >> 3)) & 7


@part
def doubles(size, value):
    """So many doubles of one value, on lines of the cache (np.full takes seconds to compile)."""
    room = np.empty(size + 7)
    first = begin_of_line(room)
    out = room[first : first + size]
    for i in range(size):
        out[i] = value
    return out


@part
def integers(size, value):
    """So many integers of one value, on lines of the cache."""
    room = np.empty(size + 7, np.int64)
    first = begin_of_line(room)
    out = room[first : first + size]
    for i in range(size):
        out[i] = value
    return out


@part
def row_table(count, width):
    """Rows of weights, not yet known."""
    return doubles(count * width, 1.0).reshape(count, width), integers(count * width, 0).reshape(count, width)


@part
def copy_row(from_m, from_e, i, to_m, to_e, j):
    """Row i of one table of weights into row j of another."""
    for k in range(from_m.shape[1]):
        to_m[j, k], to_e[j, k] = from_m[i, k], from_e[i, k]


@part
def to_weights(logs, size, mantissa, exponent):
    """exp of `size` numbers from PAD on."""
    for i in range(PAD, PAD + size, 8):
        exponentials(at(logs, i), at(mantissa, i), at(exponent, i))


@part
def emissions(address, single, num_rows, num_states, start, stop, x, mantissa, exponent):
    """Rows [start, stop) of log-likelihoods as weights, x for a copy where one is needed; as `load`.

    Vectors reach beyond the last row and know no NaN: only where there are neither, nothing is copied.
    """
    begin, size = start * num_states, (stop - start) * num_states
    if begin + size + PAD <= num_rows * num_states:
        if single:
            ones = ahead(singles_at(address), begin)
            if not any_missing(ones, size):
                for i in range(0, size, 8):
                    exponentials(ahead(ones, i), at(mantissa, PAD + i), at(exponent, PAD + i))
                return -1
        else:
            twos = ahead(doubles_at(address), begin)
            if not any_missing(twos, size):
                for i in range(0, size, 8):
                    exponentials(ahead(twos, i), at(mantissa, PAD + i), at(exponent, PAD + i))
                return -1
    bad = load(address, single, num_states, start, stop, x)
    to_weights(x, size, mantissa, exponent)
    return bad


@part
def weights_of(address, size):
    """Weights of a small array of doubles, with room at both ends."""
    x, mantissa = doubles(size + 2 * PAD, 0.0), doubles(size + 2 * PAD, 1.0)
    exponent = integers(size + 2 * PAD, 0)
    load(address, False, 1, 0, size, x)
    to_weights(x, size, mantissa, exponent)
    return mantissa, exponent


@part
def empty_row(num_states):
    """A row of weights that are all zero."""
    width = row_width(num_states)
    return doubles(width, 1.0), integers(width, ZERO_EXPONENT)


@part
def renormalise_row(m, e, width):
    """Mantissas of a row back to [1, 2)."""
    for i in range(0, width, 8):
        renormalise(at(m, i), at(e, i))


@part
def add(m1, e1, m2, e2):
    """Sum of two weights."""
    if e1 < e2:
        m1, e1, m2, e2 = m2, e2, m1, e1
    apart = e2 - e1
    if apart > -1000:
        m1 += m2 * double_of((apart + 1023) << 52)
    shift = (bits_of(m1) >> 52) - 1023
    return m1 * double_of((1023 - shift) << 52), e1 + shift


@part
def first_row(am, ae, initial_m, initial_e, pm, pe, num_states):
    """Row 0 of forward weights: those at the first sample, whose emissions stand from PAD on."""
    for k in range(am.shape[1]):
        am[0, k], ae[0, k] = 1.0, ZERO_EXPONENT
    for k in range(num_states):
        am[0, FIRST + k] = initial_m[PAD + k] * pm[PAD + k]
        ae[0, FIRST + k] = initial_e[PAD + k] + pe[PAD + k]


@part
def forward_block(am, ae, pm, pe, sm, se, vm, ve, stay_step, advance_step, first, count, num_states):
    """Rows 1 to `count` of forward weights from row 0; emissions of row r + 1 stand in p's row r.

    `stay_step`, `advance_step`: how far apart the rows of the transitions s and v are; 0 where they do
    not vary. `first`: number of the first of these samples.
    """
    width = am.shape[1]
    fm, fe = am.reshape(am.size), ae.reshape(ae.size)
    for r in range(count):
        old, new, p = r * width, (r + 1) * width, PAD + r * num_states
        s, v = PAD + r * stay_step, PAD + r * advance_step
        fm[new + FIRST] = fm[old + FIRST] * (sm[s] * pm[p])
        fe[new + FIRST] = fe[old + FIRST] + (se[s] + pe[p])
        for c in range(0, num_states - 1, 8):
            forward_step(
                at(fm, old + PAD + c), at(fe, old + PAD + c), at(pm, p + 1 + c), at(pe, p + 1 + c),
                at(sm, s + 1 + c), at(se, s + 1 + c), at(vm, v + c), at(ve, v + c),
                fm[old + FIRST + c], fe[old + FIRST + c], at(fm, new + PAD + c), at(fe, new + PAD + c),
            )  # fmt: skip
        if (first + r) % RENORMALISE == 0:
            for i in range(0, width, 8):
                renormalise(at(fm, new + i), at(fe, new + i))
