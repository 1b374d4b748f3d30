"""Processing of one reading by all hypotheses: transitions, weights, learning, merging, and summaries.

Hypotheses of one state differ by the time at which they entered it, so the duration of a state is known
exactly; similar ones are merged by their moments.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmmseg.contact.equations import Pads
from hmmseg.levels import MOVED, SETTLING
from hmmseg.online.compiled import compiled
from hmmseg.online.hypothesis import (
    ABOVE_KIND,
    FREE_KIND,
    GROUND_KIND,
    NUM_RING,
    SLIDING_KIND,
    Record,
    free,
    held,
    learn,
    lifted,
    log_sum,
    lowered,
    opened,
    sliding_out,
    supported,
)
from hmmseg.segmentation.conformity import BRIEF, DEPARTURE, STAGES
from hmmseg.segmentation.emissions import MAX_RATE
from hmmseg.segmentation.free_contacts import RINGING

LOG_DEPARTURE = math.log(DEPARTURE)
PACE = 1.0  # prior: s, mean time in a state; a pace ten times as fast costs 2.3 nats at a boundary
NEGLIGIBLE = -28.0  # numerics: nats below the best at which a hypothesis is dropped
SAME_STATE = 14  # numerics: most hypotheses of one state of the task
SAME_DEPARTED = 4  # numerics: most hypotheses of one state off the task


class Table(NamedTuple):
    """Hypotheses (most,) with their knowledge of the task's blocks and moves (most, num_quantities, 2)."""

    rows: np.ndarray
    known: np.ndarray


class Chain(NamedTuple):
    """States of one round, then those off the task: kind, block (num_states,) and move (-1: none).

    `signs` (num_moves,): direction in which a move raises its block where known, otherwise 0.
    """

    kinds: np.ndarray
    blocks: np.ndarray
    moves: np.ndarray
    signs: np.ndarray
    num_steps: int
    num_blocks: int
    num_rounds: int


@compiled
def _settled(age: float) -> float:
    """Probability that a contact has settled: STAGES stages, each of a sample at MAX_RATE or more.

    SETTLING s on average, as off line: where a block is `placed` for less it falls as the fingers open.
    """
    n, p = math.floor(age * MAX_RATE + 1e-9), STAGES / (SETTLING * MAX_RATE)
    q = 1.0 - p
    return 1.0 - q ** (n - 2) * (q * q + n * p * q + n * (n - 1) * p * p / 2) if n >= STAGES else 0.0


@compiled
def _copy(into: Table, i: int, other: Table, j: int) -> None:
    """Overwrite hypothesis i of a table by hypothesis j of another."""
    into.rows[i] = other.rows[j]
    for q in range(into.known.shape[1]):
        into.known[i, q, 0], into.known[i, q, 1] = other.known[j, q, 0], other.known[j, q, 1]


@compiled
def _average(one: np.ndarray, other: np.ndarray, a: float, b: float) -> None:
    """Evidence (n, 2) of a mixture."""
    for k in range(one.shape[0]):
        one[k, 0] = a * one[k, 0] + b * other[k, 0]
        one[k, 1] = a * one[k, 1] + b * other[k, 1]


@compiled
def _mix(one: np.ndarray, other: np.ndarray, a: float, b: float) -> None:
    """Mean and variance (2,) of a mixture."""
    gap = one[0] - other[0]
    one[1] = a * one[1] + b * other[1] + a * b * gap * gap
    one[0] -= b * gap  # equal means stay equal, however large


@compiled
def absorb(into: Table, i: int, other: Table, j: int) -> None:
    """Merge hypothesis j of `other` into i of `into`, of the same state, by moments; their weights add."""
    h, g = into.rows[i], other.rows[j]
    total = log_sum(h.weight, g.weight)
    a, b = math.exp(h.weight - total), math.exp(g.weight - total)
    if b > a:
        h.round, h.missed, h.left_at, h.crossed = g.round, g.missed, g.left_at, g.crossed
    _mix(h.entered, g.entered, a, b)
    _mix(h.origin, g.origin, a, b)
    for k in range(NUM_RING):
        _mix(h.ring[k], g.ring[k], a, b)
    _average(h.bias, g.bias, a, b)
    _average(h.scale, g.scale, a, b)
    for k in range(2):
        h.level[k] = a * h.level[k] + b * g.level[k]
        h.apart[k] = a * h.apart[k] + b * g.apart[k]
        h.firm[k] = a * h.firm[k] + b * g.firm[k]
    _average(into.known[i], other.known[j], a, b)
    h.weight = total


@compiled
def _enter(
    h: Record, known: np.ndarray, t: float, half: float, chain: Chain, before: int, after: int
) -> bool:
    """Move a hypothesis from state `before` to `after`; returns whether its block rose the wrong way."""
    kinds = chain.kinds
    h.state = after
    h.entered[0], h.entered[1] = t - half, half * half / 3
    wrong = False
    if kinds[before] == FREE_KIND:
        h.apart[:], h.firm[:] = 0.0, 0.0
    placed = h.level[1] > 0.0
    if kinds[before] == GROUND_KIND and kinds[after] != FREE_KIND and placed:
        h.origin[0], h.origin[1] = h.level[0] / h.level[1], 1.0 / h.level[1]
    elif kinds[after] == FREE_KIND:
        move = chain.moves[before] if kinds[before] == GROUND_KIND else -1
        if move >= 0 and placed and h.origin[1] > 0.0:
            rise = h.level[0] / h.level[1] - h.origin[0]
            sign = chain.signs[move]
            wrong = sign != 0.0 and sign * rise < -MOVED
            precision = 1.0 / (h.origin[1] + 1.0 / h.level[1])
            at = 2 * (chain.num_blocks + 1) + move
            known[at, 0] += precision * rise
            known[at, 1] += precision
        h.origin[0] = h.origin[1] = 0.0
    if not (kinds[before] == GROUND_KIND and kinds[after] == GROUND_KIND):
        h.level[0] = h.level[1] = 0.0
    return wrong


@compiled
def _add(table: Table, count: int, fresh: Table, j: int) -> int:
    """Append a hypothesis, or merge it into one of its state that was entered at the same time.

    The last row of a table stays free: it is the workspace of those who write hypotheses.
    """
    state, entered = fresh.rows[j].state, fresh.rows[j].entered[0]
    for i in range(count):
        if table.rows[i].state == state and abs(table.rows[i].entered[0] - entered) < 1e-9:
            absorb(table, i, fresh, j)
            return count
    if count < table.rows.shape[0] - 1:
        _copy(table, count, fresh, j)
        return count + 1
    return count


@compiled
def _advance(
    table: Table, count: int, fresh: Table, x: Record, dt: float, chain: Chain, span: Record, pads: Pads
) -> int:
    """Let hypotheses move on to the task's next state, in part.

    Within the task, a block is lowered and fingers open to release it; one that departs may lose it.
    """
    t, kinds = x.t, chain.kinds
    num_new, half, away = 0, dt / 2, -math.expm1(-dt / PACE)
    for i in range(count):
        state = table.rows[i].state
        off = state == chain.num_steps - 1
        if state >= chain.num_steps or (off and table.rows[i].round + 1 >= chain.num_rounds):
            continue
        settled = _settled(t - table.rows[i].entered[0]) if table.rows[i].crossed > 0 else 1.0
        _copy(fresh, num_new, table, i)
        h = fresh.rows[num_new]
        h.weight += math.log(away) + math.log(BRIEF + settled)
        after = 1 if off else state + 1
        if kinds[after] == FREE_KIND:
            h.weight += opened(h, fresh.known[num_new], chain.blocks[state], x)
        elif kinds[state] == ABOVE_KIND:
            h.weight += lowered(h, x, span, pads)
        if off:
            h.round += 1
        at = h.crossed % NUM_RING  # one more boundary of the task, right before t
        h.ring[at, 0], h.ring[at, 1] = t - half, half * half / 3
        h.crossed += 1
        if _enter(h, fresh.known[num_new], t, half, chain, state, after):
            # another block, or another place: a departure
            h.state, h.missed, h.left_at = chain.num_steps, state, t
        num_new = _add(fresh, num_new, fresh, num_new)
    for j in range(num_new):
        count = _add(table, count, fresh, j)
    return count


@compiled
def _may_follow(chain: Chain, before: int, after: int) -> bool:
    """Whether one contact state may follow another: a hand changes blocks only through free motion."""
    kinds, blocks = chain.kinds, chain.blocks
    same = blocks[before] == blocks[after]
    if kinds[before] == kinds[after] and same:
        return False
    return same or kinds[before] == FREE_KIND or kinds[after] == FREE_KIND


@compiled
def _depart(table: Table, count: int, fresh: Table, t: float, dt: float, chain: Chain) -> int:
    """Let hypotheses leave the task, or change state off the task, in part."""
    num_steps, num_states = chain.num_steps, chain.kinds.size
    log_away = math.log(-math.expm1(-dt / PACE))
    num_new = 0
    for target in range(num_steps, num_states):
        for i in range(count):
            state = table.rows[i].state
            if not _may_follow(chain, state, target):
                continue
            others = 0
            for s in range(num_steps, num_states):
                others += _may_follow(chain, state, s)
            h = table.rows[i]
            settled = _settled(t - h.entered[0]) if h.entered[0] > h.left_at else 1.0
            weight = h.weight + log_away + math.log(BRIEF + settled) - math.log(others)
            if state < num_steps:
                weight += LOG_DEPARTURE
            if weight < NEGLIGIBLE:
                continue
            _copy(fresh, num_new, table, i)
            h = fresh.rows[num_new]
            h.weight = weight
            _enter(h, fresh.known[num_new], t, dt / 2, chain, state, target)
            if state < num_steps:
                h.missed, h.left_at = min(state + 1, num_steps - 1), t - dt / 2
            num_new = _add(fresh, num_new, fresh, num_new)
    for j in range(num_new):
        count = _add(table, count, fresh, j)
    return count


@compiled
def _thin(table: Table, count: int, state: int, most: int, t: float) -> int:
    """Merge the most similar hypotheses of one state until `most` are left."""
    rows = table.rows
    while True:
        members = 0
        for i in range(count):
            members += rows[i].state == state
        if members <= most:
            return count
        best, first, second = math.inf, -1, -1
        for i in range(count):
            if rows[i].state != state:
                continue
            later, here = -1, rows[i].entered[0]  # the next one that entered after it
            for j in range(count):
                if rows[j].state != state or j == i:
                    continue
                there = rows[j].entered[0]
                after = there > here or (there == here and j > i)
                if after and (later < 0 or there < rows[later].entered[0]):
                    later = j
            if later < 0:
                continue
            gap = (rows[later].entered[0] - here) / (t - rows[later].entered[0] + 1e-6)
            cost = 0.25 * min(rows[i].weight, rows[later].weight) + math.log(gap + 1e-9)
            if cost < best:
                best, first, second = cost, i, later
        absorb(table, first, table, second)
        count -= 1
        _copy(table, second, table, count)


@compiled
def _explained(
    h: Record, known: np.ndarray, x: Record, chain: Chain, span: Record, pads: Pads, gravity: float
) -> float:
    """Log-likelihood of a reading in the hypothesis's own state, ringing while the contact settles."""
    kind, block = chain.kinds[h.state], chain.blocks[h.state]
    settled = _settled(x.t - h.entered[0])
    if kind == FREE_KIND:
        own, lost = free(h, x, span), h.missed > 0 and h.state == chain.num_steps
        if lost and chain.kinds[h.missed - 1] == ABOVE_KIND and settled < 1.0:
            other = sliding_out(h, known, chain.blocks[h.missed], x, span, pads)
            own = log_sum(own, math.log1p(-settled) + other)
        return own
    if kind == ABOVE_KIND:
        own = lifted(h, known, block, x, span, gravity, settled)
    else:
        own = supported(h, known, kind, block, x, span, pads, h.state < chain.num_steps)
    ringing = RINGING * (1.0 - settled)
    if ringing > 1e-3:
        if kind == ABOVE_KIND:
            other = supported(h, known, SLIDING_KIND, block, x, span, pads, False)
        else:
            other = lifted(h, known, block, x, span, gravity, settled)
        own = log_sum(math.log1p(-ringing) + own, math.log(ringing) + max(own, other))
    return own + held(h, known, block, x, span, pads)


@compiled
def advance(
    rows: np.ndarray, known: np.ndarray, fresh_rows: np.ndarray, fresh_known: np.ndarray, count: int,
    reading: np.ndarray, dt: float, since: float, share: float, states: np.ndarray, signs: np.ndarray,
    num_steps: int, num_blocks: int, num_rounds: int, ranges: np.ndarray, compliances: np.ndarray,
    gravity: float
) -> int:  # fmt: skip
    """Process one reading; returns the number of hypotheses afterwards.

    `rows`, `known`: the table, and a few hypotheses as workspace; `dt` [s] since the previous reading,
    `since` [s] since departures were last allowed (0: not now), `share`: weight of the reading as independent
    evidence; `states` (num_states, 3), ...: the chain; `compliances` (4,): the pads'. Log weights are
    normalised to a maximum of 0. Plain arrays make a call from Python ten times as fast as named tuples.
    """
    x, span = reading[0], ranges[0]
    table, fresh = Table(rows, known), Table(fresh_rows, fresh_known)
    chain = Chain(states[:, 0], states[:, 1], states[:, 2], signs, num_steps, num_blocks, num_rounds)
    pads = Pads(compliances[0], compliances[1], compliances[2], compliances[3])
    if dt > 0.0:
        count = _advance(table, count, fresh, x, dt, chain, span, pads)
    if since > 0.0:
        count = _depart(table, count, fresh, x.t, since, chain)
    top = -math.inf
    for i in range(count):
        rows[i].weight += share * _explained(rows[i], known[i], x, chain, span, pads, gravity)
        top = max(top, rows[i].weight)
    kept = 0
    for i in range(count):
        weight = rows[i].weight - top
        if weight > NEGLIGIBLE or math.isnan(weight):
            if kept != i:
                _copy(table, kept, table, i)
            h = rows[kept]
            h.weight = weight
            kind, block, on = chain.kinds[h.state], chain.blocks[h.state], h.state < chain.num_steps
            learn(h, known[kept], kind, block, x, pads, gravity, share, on)
            kept += 1
    for state in range(chain.kinds.size):
        kept = _thin(table, kept, state, SAME_STATE if state < chain.num_steps else SAME_DEPARTED, x.t)
    return kept


@compiled
def _state_at(h: Record, t: float, num_steps: int) -> int:
    """State of the task at an earlier time t; -1: off the task."""
    state = h.state
    if state >= num_steps:
        if h.left_at <= t:
            return -1
        state = max(h.missed - 1, 0)
    for back in range(min(h.crossed, NUM_RING)):
        if h.ring[(h.crossed - 1 - back) % NUM_RING, 0] <= t:
            break
        state = state - 1 if state != 1 or h.crossed - back == 1 else num_steps - 1
    return state


@compiled
def summarise(
    rows: np.ndarray, known: np.ndarray, count: int, num_steps: int, num_blocks: int, before: float,
    now: np.ndarray, smoothed: np.ndarray, means: np.ndarray
) -> tuple[int, int]:  # fmt: skip
    """Indices of the heaviest hypothesis on the task and off it, -1 if there is none.

    Fills `now`, `smoothed` (num_steps + 1,): probability of each subtask, and last of a departure, at the
    newest reading and at time `before`; `means` (2 num_blocks + num_moves, 3): mean, variance and probability
    of being known of weights and widths, then of rises.
    """
    now[:], smoothed[:], means[:] = 0.0, 0.0, 0.0
    total = 0.0
    on = off = -1
    for i in range(count):
        p, state = math.exp(rows[i].weight), rows[i].state
        total += p
        if state < num_steps:
            now[state] += p
            if on < 0 or rows[i].weight > rows[on].weight:
                on = i
        else:
            now[num_steps] += p
            if off < 0 or rows[i].weight > rows[off].weight:
                off = i
        smoothed[_state_at(rows[i], before, num_steps)] += p
    now /= total
    smoothed /= total
    for q in range(means.shape[0]):
        at = q if q < 2 * num_blocks else q + 2
        weighs = q < 2 * num_blocks and q % 2 == 0
        sure = mean = square = 0.0
        for i in range(count):
            precision = known[i, at, 1]
            if precision > 0.0:
                p = math.exp(rows[i].weight) / total
                value, variance = known[i, at, 0] / precision, 1.0 / precision
                if weighs:
                    variance += 1.0 / rows[i].bias[1, 1] + 1.0 / rows[i].bias[3, 1]
                gap = value - mean
                sure += p
                mean += p / sure * gap
                square += p * (variance + gap * (value - mean))
        means[q, 0], means[q, 1], means[q, 2] = mean, square / sure if sure > 0 else math.inf, sure
    return on, off


@compiled
def boundary(
    rows: np.ndarray, count: int, num_steps: int, number: int, before: float
) -> tuple[float, float, float, float]:
    """Mean and variance of crossing `number` (from 0), and the probabilities of it, and of it by `before`.

    All given that the recording follows its task, as nothing off the task is a boundary of it.
    """
    total = come = early = mean = square = 0.0
    for i in range(count):
        h = rows[i]
        if h.state >= num_steps:
            continue
        p = math.exp(h.weight)
        total += p
        if number < h.crossed <= number + NUM_RING:
            at = h.ring[number % NUM_RING]
            come += p
            early += p if at[0] <= before else 0.0
            gap = at[0] - mean
            mean += p / come * gap
            square += p * (at[1] + gap * (at[0] - mean))
    if total == 0.0:
        return 0.0, math.inf, 0.0, 0.0
    return mean, square / come if come > 0 else math.inf, come / total, early / total
