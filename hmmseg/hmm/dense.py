"""Hidden Markov model with any transition matrix: the alternative to a forced order.

A recording that does not follow its task is explained better by free switching among the same states;
comparing log evidences needs this general model. Same conventions as hmmseg.hmm.inference (Rabiner,
Proc. IEEE 77(2), 1989). In NumPy: a step is one small matrix, and no program has to be compiled for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Path:
    """Most probable states `path` (num_samples,) and their log weight."""

    path: np.ndarray
    log_prob: float


def log_evidence(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> float:
    """Log of the summed weight of all state paths.

    Args:
        log_likelihoods: (num_samples, num_states).
        log_initial: (num_states,).
        log_transition: (num_states, num_states), [i, j] from i to j.

    Returns:
        nats; -inf where no path exists, as a model without an order has no state to starve. What is by more
        than 700 nats less likely than the best at one sample counts as impossible from there on.

    Raises:
        ValueError: NaN, wrong shapes.
    """
    ll, initial, transition = _checked(log_likelihoods, log_initial, log_transition)
    weights, probability = initial + ll[0], np.exp(transition)
    with np.errstate(divide="ignore"):
        for row in ll[1:]:
            top = weights.max()
            if top == -np.inf:
                return float(top)
            weights = np.log(np.exp(weights - top) @ probability) + row + top
    return float(np.logaddexp.reduce(weights))


def viterbi(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> Path:
    """Most probable state path; arguments as of `log_evidence`. ValueError where none is possible, too."""
    ll, initial, transition = _checked(log_likelihoods, log_initial, log_transition)
    weights, into, every = initial + ll[0], transition.T.copy(), np.arange(len(initial))
    sources = np.empty((len(ll) - 1, len(initial)), np.uint8 if len(initial) <= 256 else np.int32)
    for row, source in zip(ll[1:], sources, strict=True):
        ways = into + weights
        source[:] = best = ways.argmax(axis=1)
        weights = ways[every, best] + row
    if weights.max() == -np.inf:
        raise ValueError("no state path has any probability")
    path = np.full(len(ll), weights.argmax())
    for t in range(len(sources) - 1, -1, -1):
        path[t] = sources[t, path[t + 1]]
    return Path(path, float(weights.max()))


def _checked(*arrays: ArrayLike) -> list[np.ndarray]:
    out = [np.asarray(a, dtype=np.float64) for a in arrays]
    ll, num_states = out[0], out[0].shape[-1]
    expected = ((len(ll), num_states), (num_states,), (num_states, num_states))
    names = ("log_likelihoods", "log_initial", "log_transition")
    for name, array, shape in zip(names, out, expected, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
        if np.isnan(array).any():
            raise ValueError(f"{name}: NaN at {np.argwhere(np.isnan(array))[0].tolist()}")
    return out
