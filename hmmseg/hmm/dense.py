"""Hidden Markov model with any transition matrix: the alternative to a forced order.

A recording that does not follow its task is explained better by free switching among the same
states; comparing log evidences needs this general model. Same conventions and recursions as
hmmseg.hmm.inference (Rabiner, Proc. IEEE 77(2), 1989); the cost is that of the transitions that are possible.
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


def _checked(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> tuple:
    arrays = [np.asarray(a, dtype=np.float64) for a in (log_likelihoods, log_initial, log_transition)]
    num_states = arrays[0].shape[-1]
    expected = (arrays[0].shape, (num_states,), (num_states, num_states))
    names = ("log_likelihoods", "log_initial", "log_transition")
    for name, array, shape in zip(names, arrays, expected, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
        if np.isnan(array).any():
            raise ValueError(f"{name}: NaN at {np.argwhere(np.isnan(array))[0].tolist()}")
    ll, initial, transition = arrays
    target, source = np.nonzero(~np.isneginf(transition.T))
    first = np.searchsorted(target, np.arange(num_states + 1))
    return np.ascontiguousarray(ll), initial, first, source, np.ascontiguousarray(transition[source, target])


def log_evidence(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> float:
    """Log of the summed weight of all state paths.

    `log_likelihoods` (num_samples, num_states), `log_initial` (num_states,), `log_transition` [i, j] from
    i to j. -inf where no path exists (a state model has no task to starve). ValueError on NaN.
    """
    from hmmseg.hmm.kernels.dense import dense_evidence

    return float(dense_evidence(*_checked(log_likelihoods, log_initial, log_transition)))


def viterbi(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> Path:
    """Most probable state path; ValueError where none is possible, or on NaN."""
    from hmmseg.hmm.kernels.dense import dense_path

    checked = _checked(log_likelihoods, log_initial, log_transition)
    path = np.empty(len(checked[0]), dtype=np.int64)
    log_prob = float(dense_path(*checked, path))
    if not np.isfinite(log_prob):
        raise ValueError("no state path has any probability")
    return Path(path, log_prob)
