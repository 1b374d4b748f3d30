"""Chains that may pass over states, draws of alignments and the k best ones: plain recursions in logs.

Tables here are arrays: x (num_samples, num_states) without NaN, bands (1 or num_samples - 1,
num_bands, num_states) with [t, d, k] the log weight of going from k to k + d.
"""

from __future__ import annotations

import math

import numpy as np

from hmmseg.hmm.kernels.compile import compiled, part


@part
def log_add(a, b):
    """Log of a sum of two exponentials."""
    if a < b:
        a, b = b, a
    if math.isinf(b):
        return a
    return a + math.log1p(math.exp(b - a))


@compiled
def best_general(x, bands, varying, initial, final, starts):
    """First sample of each state of the most probable path into `starts` (num_states,); its log weight."""
    num_rows, num_states = x.shape
    num_bands = bands.shape[1]
    jumps = np.empty((num_rows, num_states), np.uint8)
    delta, new = np.empty(num_states), np.empty(num_states)
    for k in range(num_states):
        delta[k] = initial[k] + x[0, k]
    for t in range(1, num_rows):
        row = t - 1 if varying else 0
        for k in range(num_states):
            best, jump = -np.inf, 0
            for d in range(min(num_bands, k + 1)):
                value = delta[k - d] + bands[row, d, k - d]
                if value > best:
                    best, jump = value, d
            new[k] = best + x[t, k]
            jumps[t, k] = jump
        delta, new = new, delta
    best, k = -np.inf, 0
    for j in range(num_states):
        if delta[j] + final[j] > best:
            best, k = delta[j] + final[j], j
    for j in range(k + 1, num_states):
        starts[j] = num_rows
    for t in range(num_rows - 1, 0, -1):
        for j in range(k - jumps[t, k] + 1, k + 1):
            starts[j] = t
        k -= jumps[t, k]
    for j in range(k + 1):
        starts[j] = 0
    return best


@compiled
def smooth_general(x, bands, varying, initial, final, filtered, smoothed, moves):
    """Fills the tables that have rows with logs; returns the log evidence.

    filtered, smoothed as x; moves (num_samples - 1, num_bands - 1, num_states): from k to k + d + 1.
    """
    num_rows, num_states = x.shape
    num_bands = bands.shape[1]
    alpha = np.empty((num_rows, num_states))
    for k in range(num_states):
        alpha[0, k] = initial[k] + x[0, k]
    for t in range(1, num_rows):
        row = t - 1 if varying else 0
        for k in range(num_states):
            total = -np.inf
            for d in range(min(num_bands, k + 1)):
                total = log_add(total, alpha[t - 1, k - d] + bands[row, d, k - d])
            alpha[t, k] = total + x[t, k]
    log_evidence = -np.inf
    for k in range(num_states):
        log_evidence = log_add(log_evidence, alpha[num_rows - 1, k] + final[k])
    for t in range(filtered.shape[0]):
        norm = -np.inf
        for k in range(num_states):
            norm = log_add(norm, alpha[t, k])
        for k in range(num_states):
            filtered[t, k] = alpha[t, k] - (0.0 if math.isinf(norm) else norm)
    if smoothed.shape[0] == 0 or math.isinf(log_evidence) or math.isnan(log_evidence):
        return log_evidence
    beta, new = final.copy(), np.empty(num_states)
    for t in range(num_rows - 1, -1, -1):
        if t < num_rows - 1:
            row = t if varying else 0
            for k in range(num_states):
                total = -np.inf
                for d in range(min(num_bands, num_states - k)):
                    rest = bands[row, d, k] + x[t + 1, k + d] + beta[k + d]
                    if d:
                        moves[t, d - 1, k] = alpha[t, k] + rest - log_evidence
                    total = log_add(total, rest)
                new[k] = total
            beta, new = new, beta
        for k in range(num_states):
            smoothed[t, k] = alpha[t, k] + beta[k] - log_evidence
    return log_evidence


@compiled
def draw_starts(log_filtered, bands, varying, final, uniforms, rng, starts):
    """Alignments drawn given the filtered logs, into `starts` (num_draws, num_states).

    `uniforms` (num_draws,) picks the last states; `rng` is asked only where two states are possible.
    """
    num_rows, num_states = log_filtered.shape
    num_bands = bands.shape[1]
    ends = np.empty(num_states)
    norm = -np.inf
    for k in range(num_states):
        ends[k] = log_filtered[num_rows - 1, k] + final[k]
        norm = log_add(norm, ends[k])
    weights = np.empty(num_bands)
    for i in range(starts.shape[0]):
        u, k = uniforms[i], num_states - 1
        for j in range(num_states):
            u -= math.exp(ends[j] - norm)
            if u < 0:
                k = j
                break
        while k > 0 and math.isinf(ends[k]):  # rounding left u at the very end
            k -= 1
        for j in range(k + 1, num_states):
            starts[i, j] = num_rows
        for t in range(num_rows - 1, 0, -1):
            if k == 0:
                break
            row, top = t - 1 if varying else 0, -np.inf
            reach = min(num_bands, k + 1)
            for d in range(reach):
                weights[d] = log_filtered[t - 1, k - d] + bands[row, d, k - d]
                top = max(top, weights[d])
            total = 0.0
            for d in range(reach):
                weights[d] = math.exp(weights[d] - top)
                total += weights[d]
            jump = 0
            if weights[0] < total:
                u = rng.random() * total
                while jump < reach - 1 and u >= weights[jump]:
                    u -= weights[jump]
                    jump += 1
                while weights[jump] == 0.0:
                    jump -= 1
            for j in range(k - jump + 1, k + 1):
                starts[i, j] = t
            k -= jump
        for j in range(k + 1):
            starts[i, j] = 0


@compiled
def best_k(x, bands, varying, initial, final, starts, log_prob):
    """The k = len(log_prob) best paths, best first, into `starts` (k, num_states); -inf where fewer are.

    Every state keeps its k best ways of being reached; a rank at one sample points to a rank before.
    """
    num_rows, num_states = x.shape
    num_bands, count = bands.shape[1], log_prob.size
    jumps = np.zeros((num_rows, num_states, count), np.uint8)
    ranks = np.zeros((num_rows, num_states, count), np.uint16)
    score = np.full((num_states, count), -np.inf)
    new = np.empty((num_states, count))
    taken = np.empty(max(num_bands, num_states), np.int64)
    for k in range(num_states):
        score[k, 0] = initial[k] + x[0, k]
    for t in range(1, num_rows):
        row = t - 1 if varying else 0
        for k in range(num_states):
            taken[:] = 0
            for n in range(count):
                best, jump = -np.inf, -1
                for d in range(min(num_bands, k + 1)):
                    if taken[d] < count:
                        value = score[k - d, taken[d]] + bands[row, d, k - d]
                        if value > best:
                            best, jump = value, d
                new[k, n] = -np.inf
                if jump >= 0:
                    new[k, n] = best + x[t, k]
                    jumps[t, k, n], ranks[t, k, n] = jump, taken[jump]
                    taken[jump] += 1
        score, new = new, score
    taken[:] = 0
    for n in range(count):
        best, k = -np.inf, -1
        for j in range(num_states):
            if taken[j] < count and score[j, taken[j]] + final[j] > best:
                best, k = score[j, taken[j]] + final[j], j
        log_prob[n] = best
        if k < 0:
            continue
        rank = taken[k]
        taken[k] += 1
        for j in range(k + 1, num_states):
            starts[n, j] = num_rows
        for t in range(num_rows - 1, 0, -1):
            jump, rank = int(jumps[t, k, rank]), int(ranks[t, k, rank])
            for j in range(k - jump + 1, k + 1):
                starts[n, j] = t
            k -= jump
        for j in range(k + 1):
            starts[n, j] = 0
