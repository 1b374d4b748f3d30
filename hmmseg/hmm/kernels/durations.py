"""States that last by tables of durations: sums and maxima over where each state began, in logs.

`enter` [t, k]: weight of all that comes before a state k that begins with sample t; `leave` [t, k]: of all up
to the end of a state k whose last sample is t - 1 (num_samples + 1 rows). `pmf` [k, n - 1]: log probability
of lasting n samples, of which `longest` [k] are possible; `survival` alike: of lasting n or more, for the
state that the recording cuts off. jumps [d - 1, k]: from k to k + d. x (num_samples, num_states) holds no
NaN. Time is O(num_samples sum(longest)); no state is split.

Recursions: Yu, Artificial Intelligence 174(2), 2010, for states in a known order.
"""

from __future__ import annotations

import math

import numpy as np

from hmmseg.hmm.kernels.compile import compiled, part

NOTHING = -45.0  # numerics: nats below the largest summand; together they are below rounding


@part
def summed(values, count):
    """Log of the summed exponentials of the first `count` values."""
    top = -np.inf
    for i in range(count):
        top = max(top, values[i])
    if math.isinf(top):
        return top
    total = 0.0
    for i in range(count):
        if values[i] - top > NOTHING:
            total += math.exp(values[i] - top)
    return top + math.log(total)


@part
def ways_in(x, pmf, longest, enter, t, k, values):
    """Log weights of a state k that ends right before t, by its duration, into `values`; how many."""
    emitted, count = 0.0, min(longest[k], t)
    for n in range(count):
        emitted += x[t - 1 - n, k]
        if math.isinf(emitted):
            return n
        values[n] = enter[t - 1 - n, k] + pmf[k, n] + emitted
    return count


@part
def ways_on(x, pmf, survival, longest, leave, t, k, final, values):
    """Log weights of a state k that begins at t, by its duration, from what follows it; how many."""
    num_rows, emitted = x.shape[0], 0.0
    count = min(longest[k], num_rows - t)
    for n in range(count):
        emitted += x[t + n, k]
        if math.isinf(emitted):
            return n
        last = t + n + 1 == num_rows
        values[n] = emitted + (survival[k, n] + final[k] if last else pmf[k, n] + leave[t + n + 1, k])
    return count


@compiled
def forward_durations(x, pmf, survival, longest, jumps, initial, final, enter, leave):
    """Fill `enter` and `leave`; the log weight of all paths."""
    num_rows, num_states = x.shape
    values = np.empty(num_rows + num_states)
    enter[0], leave[0] = initial, -np.inf
    for t in range(1, num_rows + 1):
        for k in range(num_states):
            table = survival if t == num_rows else pmf
            leave[t, k] = summed(values, ways_in(x, table, longest, enter, t, k, values))
        if t < num_rows:
            for k in range(num_states):
                count = min(jumps.shape[0], k)
                for d in range(count):
                    values[d] = leave[t, k - d - 1] + jumps[d, k - d - 1]
                enter[t, k] = summed(values, count)
    for k in range(num_states):
        values[k] = leave[num_rows, k] + final[k]
    return summed(values, num_states)


@compiled
def smooth_durations(x, pmf, survival, longest, jumps, initial, final, smoothed, moves):
    """Fill probabilities of states and moves (num_samples - 1, num_bands, num_states); the log evidence."""
    num_rows, num_states = x.shape
    enter, leave = np.empty((num_rows, num_states)), np.empty((num_rows + 1, num_states))
    log_evidence = forward_durations(x, pmf, survival, longest, jumps, initial, final, enter, leave)
    if not math.isfinite(log_evidence):
        return log_evidence
    values = np.empty(num_rows + num_states)
    after, rest = np.empty((num_rows, num_states)), np.full((num_rows, num_states), -np.inf)
    for t in range(num_rows - 1, -1, -1):
        for k in range(num_states):
            count = ways_on(x, pmf, survival, longest, rest, t, k, final, values)
            after[t, k] = summed(values, count)
        if t > 0:
            for k in range(num_states):
                count = min(jumps.shape[0], num_states - 1 - k)
                for d in range(count):
                    values[d] = jumps[d, k] + after[t, k + d + 1]
                    moves[t - 1, d, k] = math.exp(leave[t, k] + values[d] - log_evidence)
                rest[t, k] = summed(values, count)
    for k in range(num_states):
        there = 0.0
        for t in range(num_rows):
            if t > 0:
                there -= math.exp(leave[t, k] + rest[t, k] - log_evidence)
            there += math.exp(enter[t, k] + after[t, k] - log_evidence)
            smoothed[t, k] = min(max(there, 0.0), 1.0)
    return log_evidence


@compiled
def draw_durations(x, pmf, survival, longest, jumps, final, enter, leave, rng, starts):
    """Alignments drawn given `enter` and `leave`, into `starts` (num_draws, num_states)."""
    num_rows, num_states = x.shape
    values = np.empty(num_rows + num_states)
    for i in range(starts.shape[0]):
        for k in range(num_states):
            values[k] = leave[num_rows, k] + final[k]
        k, t = _drawn(values, num_states, rng), num_rows
        starts[i, k + 1 :] = num_rows
        while True:
            table = survival if t == num_rows else pmf
            t -= _drawn(values, ways_in(x, table, longest, enter, t, k, values), rng) + 1
            starts[i, k] = t
            if t == 0:
                break
            count = min(jumps.shape[0], k)
            for d in range(count):
                values[d] = leave[t, k - d - 1] + jumps[d, k - d - 1]
            jump = _drawn(values, count, rng) + 1
            starts[i, k - jump + 1 : k] = t
            k -= jump
        starts[i, :k] = 0


@part
def _drawn(values, count, rng):
    """Index drawn by log weights."""
    total = summed(values, count)
    u, last = rng.random(), 0
    for i in range(count):
        p = math.exp(values[i] - total)
        if p > 0.0:
            last = i
            u -= p
            if u < 0.0:
                return i
    return last


@compiled
def best_durations(x, pmf, survival, longest, jumps, initial, final, starts, log_prob):
    """The k = len(log_prob) best paths, best first, into `starts` (k, num_states); -inf where fewer are.

    Every end of a state keeps its k best histories, each by how long the state lasted, from where it was
    entered and the rank of that history. A tie goes to the shorter stay.
    """
    num_rows, num_states = x.shape
    count, num_jumps = log_prob.size, jumps.shape[0]
    enter = np.full((num_rows, num_states, count), -np.inf)
    enter[0, :, 0] = initial
    entered = np.zeros((num_rows, num_states, count, 2), np.uint16)  # jump, rank
    lasted = np.zeros((num_rows + 1, num_states, count), np.uint32)
    ranks = np.zeros((num_rows + 1, num_states, count), np.uint16)
    leave = np.empty((num_states, count))
    values, taken = np.empty(num_rows + num_states), np.empty(num_rows + num_states, np.int64)
    for t in range(1, num_rows + 1):
        table = survival if t == num_rows else pmf
        for k in range(num_states):
            possible = ways_in(x, table, longest, enter[:, :, 0], t, k, values)
            taken[:possible] = 0
            for n in range(count):
                best, at = -np.inf, -1
                for i in range(possible):
                    if values[i] > best:
                        best, at = values[i], i
                leave[k, n] = best
                if at < 0:
                    continue
                lasted[t, k, n], ranks[t, k, n] = at + 1, taken[at]
                taken[at] += 1
                began, last = t - 1 - at, taken[at] == count
                # The same stay after the next best history before it.
                values[at] = (
                    -np.inf if last else (best - enter[began, k, taken[at] - 1] + enter[began, k, taken[at]])
                )
        if t == num_rows:
            break
        for k in range(num_states):
            taken[:num_jumps] = 0
            for n in range(count):
                best, jump = -np.inf, -1
                for d in range(min(num_jumps, k)):
                    if taken[d] < count and leave[k - d - 1, taken[d]] + jumps[d, k - d - 1] > best:
                        best, jump = leave[k - d - 1, taken[d]] + jumps[d, k - d - 1], d
                enter[t, k, n] = best
                if jump >= 0:
                    entered[t, k, n, 0], entered[t, k, n, 1] = jump + 1, taken[jump]
                    taken[jump] += 1
    taken[:num_states] = 0
    for n in range(count):
        best, k = -np.inf, -1
        for j in range(num_states):
            if taken[j] < count and leave[j, taken[j]] + final[j] > best:
                best, k = leave[j, taken[j]] + final[j], j
        log_prob[n] = best
        if k < 0:
            continue
        rank, t = taken[k], num_rows
        taken[k] += 1
        starts[n, k + 1 :] = num_rows
        while True:
            stay = np.int64(lasted[t, k, rank])
            rank = np.int64(ranks[t, k, rank])
            t -= stay
            starts[n, k] = t
            if t == 0:
                break
            jump = np.int64(entered[t, k, rank, 0])
            rank = np.int64(entered[t, k, rank, 1])
            starts[n, k - jump + 1 : k] = t
            k -= jump
        starts[n, :k] = 0
