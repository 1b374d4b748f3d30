"""One reading through all hypotheses: who moves on, how well each explains it, which are kept.

Hypotheses are rows of one table (see layout). Those in one state differ by when they entered it, so that
how long a state has lasted is known exactly; what is alike is merged by its moments.
"""

from __future__ import annotations

import math

from hmmseg.levels import MOVED
from hmmseg.online.compiled import compiled
from hmmseg.online.densities import log_sum
from hmmseg.online.layout import (
    ABOVE_KIND,
    CROSSED,
    ENTRY,
    ENTRY_VARIANCE,
    FREE_KIND,
    GROUND_KIND,
    LEFT_AT,
    LEVEL,
    MISSED,
    NUM_RING,
    OBJECTS,
    ORIGIN,
    RING,
    ROUND,
    SLIDING_KIND,
    STATE,
    WEIGHT,
    T,
)
from hmmseg.online.learning import learn
from hmmseg.online.scores import free, held, lifted, supported
from hmmseg.segmentation.conformity import BRIEF, DEPARTURE, RINGING, SETTLING, STAGES
from hmmseg.segmentation.emissions import LOST

LOG_DEPARTURE = math.log(DEPARTURE)
PACE = 1.0  # prior: s, mean time in a state; a pace ten times as fast costs 2.3 nats at a boundary
NEGLIGIBLE = -28.0  # numerics: nats below the best at which a hypothesis is dropped
SAME_STATE = 14  # numerics: hypotheses of one state that are kept apart, ...
SAME_DEPARTED = 4  # numerics: ... and of one that is off the task


@compiled
def _settled(age):
    """Probability that a contact has settled: Erlang, STAGES stages, SETTLING s on average."""
    z = age * STAGES / SETTLING
    return -math.expm1(-z) - math.exp(-z) * (z + z * z / 2)


@compiled
def _absorb(into, row):
    """Merge `row` into a hypothesis of the same history, by moments; the log weights add."""
    total = log_sum(into[WEIGHT], row[WEIGHT])
    a, b = math.exp(into[WEIGHT] - total), math.exp(row[WEIGHT] - total)
    if b > a:
        into[ROUND], into[MISSED], into[LEFT_AT], into[CROSSED] = (
            row[ROUND],
            row[MISSED],
            row[LEFT_AT],
            row[CROSSED],
        )
    for at in (ENTRY, ORIGIN):
        gap = into[at] - row[at]
        into[at + 1] = a * into[at + 1] + b * row[at + 1] + a * b * gap * gap
        into[at] = a * into[at] + b * row[at]
    for at in range(RING, RING + 2 * NUM_RING, 2):
        gap = into[at] - row[at]
        into[at + 1] = a * into[at + 1] + b * row[at + 1] + a * b * gap * gap
        into[at] = a * into[at] + b * row[at]
    for at in range(ENTRY_VARIANCE + 4, into.size):
        if at < ORIGIN or at >= OBJECTS:
            into[at] = a * into[at] + b * row[at]
    into[WEIGHT] = total


@compiled
def _enter(row, t, half, kinds, moves, rises, rise_signs, before, after):
    """Rewrite a hypothesis that leaves state `before` for `after`; whether its block rose the wrong way."""
    row[STATE] = after
    row[ENTRY], row[ENTRY_VARIANCE] = t - half, half * half / 3
    wrong = False
    known = row[LEVEL + 1] > 0.0
    if kinds[before] == GROUND_KIND and kinds[after] != FREE_KIND and known:
        row[ORIGIN], row[ORIGIN + 1] = row[LEVEL] / row[LEVEL + 1], 1.0 / row[LEVEL + 1]
    elif kinds[after] == FREE_KIND and kinds[before] == GROUND_KIND and moves[before] >= 0:
        if known and row[ORIGIN + 1] > 0.0:
            rise = row[LEVEL] / row[LEVEL + 1] - row[ORIGIN]
            sign = rise_signs[moves[before]]
            wrong = sign != 0.0 and sign * rise < -MOVED
            precision = 1.0 / (row[ORIGIN + 1] + 1.0 / row[LEVEL + 1])
            row[rises + 2 * moves[before]] += precision * rise
            row[rises + 2 * moves[before] + 1] += precision
        row[ORIGIN], row[ORIGIN + 1] = 0.0, 0.0
    elif kinds[after] == FREE_KIND:
        row[ORIGIN], row[ORIGIN + 1] = 0.0, 0.0
    if not (kinds[before] == GROUND_KIND and kinds[after] == GROUND_KIND):
        row[LEVEL], row[LEVEL + 1] = 0.0, 0.0
    return wrong


@compiled
def _crossed(row, t, half):
    """Note one more boundary of the task, right before t."""
    at = RING + 2 * (int(row[CROSSED]) % NUM_RING)
    row[at], row[at + 1] = t - half, half * half / 3
    row[CROSSED] += 1.0


@compiled
def _add(table, count, row):
    """Append a row unless one of the same state was entered at the same time, which then takes it up."""
    for i in range(count):
        if table[i, STATE] == row[STATE] and abs(table[i, ENTRY] - row[ENTRY]) < 1e-9:
            _absorb(table[i], row)
            return count
    if count < table.shape[0]:
        table[count] = row
        return count + 1
    return count


@compiled
def _advance(table, count, fresh, x, dt, half, chain, num_rounds, cyclic, rises, rise_signs):
    """Hypotheses that move on to the task's next state, and what stays of the others."""
    kinds, _, moves, num_steps = chain
    t, num_new = x[T], 0
    away = -math.expm1(-dt / PACE)
    for i in range(count):
        state = int(table[i, STATE])
        if state >= num_steps:
            continue
        off = state == num_steps - 1
        if off and not (cyclic and table[i, ROUND] + 1 < num_rounds):
            continue
        settled = _settled(t - table[i, ENTRY]) if table[i, CROSSED] > 0 else 1.0
        row = fresh[num_new]
        row[:] = table[i]
        row[WEIGHT] += math.log(away) + math.log(BRIEF + settled)
        if off:
            row[ROUND] += 1.0
        target = 1 if off else state + 1
        _crossed(row, t, half)
        wrong = _enter(row, t, half, kinds, moves, rises, rise_signs, state, target)
        if wrong:  # another block, or another place: from here on off the task
            row[STATE], row[MISSED], row[LEFT_AT] = num_steps, state, t
        table[i, WEIGHT] += math.log1p(-away)
        merged = False
        for j in range(num_new):
            if fresh[j, STATE] == row[STATE]:
                _absorb(fresh[j], row)
                merged = True
                break
        if not merged:
            num_new += 1
    for j in range(num_new):
        count = _add(table, count, fresh[j])
    return count


@compiled
def _depart(table, count, fresh, x, dt, half, chain, rises, rise_signs):
    """Hypotheses that leave the task, or what they do off it, for any other contact state."""
    kinds, blocks, moves, num_steps = chain
    num_states, t = kinds.size, x[T]
    log_away = math.log(-math.expm1(-dt / PACE))
    num_new = 0
    for target in range(num_steps, num_states):
        found = -1
        for i in range(count):
            state = int(table[i, STATE])
            if kinds[state] == kinds[target] and blocks[state] == blocks[target]:
                continue
            if kinds[state] != FREE_KIND and kinds[target] != FREE_KIND and blocks[state] != blocks[target]:
                continue
            others = 0
            for s in range(num_steps, num_states):
                if (
                    kinds[state] == FREE_KIND or kinds[s] == FREE_KIND or blocks[s] == blocks[state]
                ) and not (kinds[s] == kinds[state] and blocks[s] == blocks[state]):
                    others += 1
            settled = _settled(t - table[i, ENTRY]) if table[i, ENTRY] > table[i, LEFT_AT] else 1.0
            weight = table[i, WEIGHT] + log_away + math.log(BRIEF + settled) - math.log(others)
            if state < num_steps:
                weight += LOG_DEPARTURE
            if weight < NEGLIGIBLE:
                continue
            row = fresh[num_new if found < 0 else num_new + 1]
            row[:] = table[i]
            row[WEIGHT] = weight
            _enter(row, t, half, kinds, moves, rises, rise_signs, state, target)
            if state < num_steps:
                row[MISSED], row[LEFT_AT] = min(state + 1, num_steps - 1), t - half
            if found < 0:
                found = num_new
            else:
                _absorb(fresh[found], row)
        if found >= 0:
            num_new += 1
    for j in range(num_new):
        count = _add(table, count, fresh[j])
    return count


@compiled
def _thin(table, count, state, most, t):
    """Merge hypotheses of one state, those that differ least first, until `most` are left."""
    while True:
        members = 0
        for i in range(count):
            members += table[i, STATE] == state
        if members <= most:
            return count
        best, first, second = math.inf, -1, -1
        for i in range(count):
            if table[i, STATE] != state:
                continue
            later = -1  # the next one that entered after it
            for j in range(count):
                if table[j, STATE] != state or j == i:
                    continue
                after = table[j, ENTRY] > table[i, ENTRY] or (table[j, ENTRY] == table[i, ENTRY] and j > i)
                if after and (later < 0 or table[j, ENTRY] < table[later, ENTRY]):
                    later = j
            if later < 0:
                continue
            gap = (table[later, ENTRY] - table[i, ENTRY]) / (t - table[later, ENTRY] + 1e-6)
            cost = 0.25 * min(table[i, WEIGHT], table[later, WEIGHT]) + math.log(gap + 1e-9)
            if cost < best:
                best, first, second = cost, i, later
        _absorb(table[first], table[second])
        count -= 1
        table[second] = table[count]


@compiled
def _explained(h, x, chain, spans, pads, gravity, num_blocks):
    """Log-likelihood of a reading in the hypothesis's own state, ringing while the contact settles."""
    kinds, blocks, _, num_steps = chain
    state = int(h[STATE])
    kind, block = kinds[state], blocks[state]
    if kind == FREE_KIND:
        return free(h, x, spans)
    settled = _settled(x[T] - h[ENTRY])
    if kind == ABOVE_KIND:
        own = lifted(h, block, x, spans, gravity, num_blocks, settled)
    else:
        own = supported(h, kind, block, x, spans, pads, state < num_steps)
    ringing = RINGING * (1.0 - settled)
    if ringing > 1e-3:
        if kind == ABOVE_KIND:
            other = supported(h, SLIDING_KIND, block, x, spans, pads, False)
        else:
            other = lifted(h, block, x, spans, gravity, num_blocks, settled)
        own = log_sum(math.log1p(-ringing) + own, math.log(ringing) + max(own, other))
    own += held(h, block, x, spans, pads, num_blocks)
    if kind == ABOVE_KIND:  # a grip that slips has lost the block for a moment
        own = log_sum(math.log1p(-LOST) + own, math.log(LOST) + free(h, x, spans))
    return own


@compiled
def advance(table, count, fresh, x, dt, since, share, chain, num_rounds, cyclic, spans, pads, gravity,
            num_blocks, rises, rise_signs):  # fmt: skip
    """Take one reading in; the number of hypotheses afterwards and what the reading's log evidence is.

    `dt` [s] since the reading before, `since` [s] since departures were last allowed (0: not now), `share`:
    how much of an independent reading it is. Log weights are normalised to a maximum of 0.
    """
    kinds, _, _, num_steps = chain
    half = dt / 2
    if dt > 0.0:
        count = _advance(table, count, fresh, x, dt, half, chain, num_rounds, cyclic, rises, rise_signs)
    if since > 0.0:
        count = _depart(table, count, fresh, x, since, since / 2, chain, rises, rise_signs)
    top = -math.inf
    for i in range(count):
        h = table[i]
        h[WEIGHT] += share * _explained(h, x, chain, spans, pads, gravity, num_blocks)
        top = max(top, h[WEIGHT])
    kept = 0
    for i in range(count):
        weight = table[i, WEIGHT] - top
        if weight > NEGLIGIBLE or math.isnan(weight):
            if kept != i:
                table[kept] = table[i]
            table[kept, WEIGHT] = weight
            state = int(table[kept, STATE])
            learn(table[kept], kinds[state], chain[1][state], x, pads, gravity, share, state < num_steps)
            kept += 1
    for state in range(kinds.size):
        kept = _thin(table, kept, state, SAME_STATE if state < num_steps else SAME_DEPARTED, x[T])
    return kept, top
