"""Every path through a chain, straight from the definition: the oracle of all alignment tests."""

import itertools

import numpy as np


def random_problem(num_timesteps, num_subtasks, seed=0, num_skips=0):
    rng = np.random.default_rng(seed)
    ll = rng.normal(size=(num_timesteps, num_subtasks)) * 2
    bands = tuple(rng.normal(size=(num_timesteps - 1, max(num_subtasks - d, 0))) - d
                  for d in range(2 + num_skips))  # fmt: skip
    return ll, bands


def enumerate_paths(ll, bands, initial=None, final=None):
    """All paths with any weight and their log weights."""
    num_timesteps, num_subtasks = ll.shape
    initial = {0: 0.0} if initial is None else dict(enumerate(initial))
    final = {num_subtasks - 1: 0.0} if final is None else dict(enumerate(final))
    paths, weights = [], []
    for path in itertools.product(range(num_subtasks), repeat=num_timesteps):
        jumps = np.diff(path)
        if path[0] not in initial or path[-1] not in final or any(j < 0 or j >= len(bands) for j in jumps):
            continue
        weight = initial[path[0]] + final[path[-1]] + sum(ll[t, k] for t, k in enumerate(path))
        weight += sum(bands[j][t, path[t]] for t, j in enumerate(jumps))
        paths.append(path)
        weights.append(weight)
    return np.array(paths), np.array(weights)


def brute(ll, bands, **ends):
    """Paths, their log weights, log evidence, smoothed probabilities and moves (by how far)."""
    paths, weights = enumerate_paths(ll, bands, **ends)
    log_evidence = np.logaddexp.reduce(weights)
    p = np.exp(weights - log_evidence)
    smoothed = np.array([[p[paths[:, t] == k].sum() for k in range(ll.shape[1])] for t in range(len(ll))])
    moves = [
        np.array([[p[(paths[:, t] == k) & (paths[:, t + 1] == k + d)].sum() for k in range(ll.shape[1] - d)]
                  for t in range(len(ll) - 1)]).reshape(len(ll) - 1, max(ll.shape[1] - d, 0))
        for d in range(1, len(bands))]  # fmt: skip
    return paths, weights, log_evidence, smoothed, moves
