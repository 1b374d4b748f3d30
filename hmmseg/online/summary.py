"""What all hypotheses say together: probabilities, smoothed states, properties, one boundary."""

from __future__ import annotations

import math

from hmmseg.online.compiled import compiled
from hmmseg.online.layout import (
    BIAS,
    CROSSED,
    LEFT_AT,
    MISSED,
    NUM_RING,
    OBJECTS,
    RING,
    ROUND,
    STATE,
    WEIGHT,
)


@compiled
def _state_at(h, t, num_steps):
    """State of the task at an earlier t, and how many boundaries had been crossed; -1: off the task."""
    state = int(h[STATE])
    if state >= num_steps:
        if h[LEFT_AT] <= t:
            return -1
        state = max(int(h[MISSED]) - 1, 0)
    crossed = int(h[CROSSED])
    for back in range(min(crossed, NUM_RING)):
        if h[RING + 2 * ((crossed - 1 - back) % NUM_RING)] <= t:
            break
        state = state - 1 if state != 1 or crossed - back == 1 else num_steps - 1
    return state


@compiled
def summarise(table, count, num_steps, before, num_objects, num_moves, rises, now, smoothed, means, best):
    """Fill `now`, `smoothed` (num_steps + 1,): probability of each subtask, and last of none of them, at the
    newest reading and at the time `before`; `means` (2 num_objects + num_moves, 3): mean, variance
    and probability that it is known of weights and widths, then rises; `best` (5,): of the heaviest
    hypothesis on the task its round and crossings, of that off it the missed subtask, time and state.
    """
    now[:], smoothed[:], means[:] = 0.0, 0.0, 0.0
    total = 0.0
    on = off = -1
    for i in range(count):
        p = math.exp(table[i, WEIGHT])
        total += p
        state = int(table[i, STATE])
        if state < num_steps:
            now[state] += p
            if on < 0 or table[i, WEIGHT] > table[on, WEIGHT]:
                on = i
        else:
            now[num_steps] += p
            if off < 0 or table[i, WEIGHT] > table[off, WEIGHT]:
                off = i
        smoothed[_state_at(table[i], before, num_steps)] += p
    now /= total
    smoothed /= total
    if on >= 0:
        best[0], best[1] = table[on, ROUND], table[on, CROSSED]
    if off >= 0:
        best[2], best[3], best[4] = table[off, MISSED], table[off, LEFT_AT], table[off, STATE]
    for q in range(2 * num_objects + num_moves):
        at = OBJECTS + 2 * q if q < 2 * num_objects else rises + 2 * (q - 2 * num_objects)
        weight = q < 2 * num_objects and q % 2 == 0
        known = mean = square = 0.0
        for i in range(count):
            precision = table[i, at + 1]
            if precision > 0.0:
                p = math.exp(table[i, WEIGHT]) / total
                value, variance = table[i, at] / precision, 1.0 / precision
                if weight:
                    variance += 1.0 / table[i, BIAS + 3] + 1.0 / table[i, BIAS + 7]
                gap = value - mean
                known += p
                mean += p / known * gap
                square += p * (variance + gap * (value - mean))
        means[q, 0], means[q, 1], means[q, 2] = mean, square / known if known > 0 else math.inf, known


@compiled
def boundary(table, count, num_steps, number, before):
    """Mean, variance of crossing `number` (from 0), the probability that it has come, and by `before`.

    Off the task nothing is a boundary of it: all of them given that the recording follows its task.
    """
    total = come = early = mean = square = 0.0
    for i in range(count):
        if table[i, STATE] >= num_steps:
            continue
        p = math.exp(table[i, WEIGHT])
        total += p
        crossed = int(table[i, CROSSED])
        if number < crossed <= number + NUM_RING:
            at = RING + 2 * (number % NUM_RING)
            come += p
            early += p if table[i, at] <= before else 0.0
            gap = table[i, at] - mean
            mean += p / come * gap
            square += p * (table[i, at + 1] + gap * (table[i, at] - mean))
    if total == 0.0:
        return 0.0, math.inf, 0.0, 0.0
    return mean, square / come if come > 0 else math.inf, come / total, early / total
