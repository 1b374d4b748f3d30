"""Alignment of recordings of any length through few compilations: pad, run, cut. NumPy in and out.

Lengths are padded to powers of two (at least 256), so that recordings share compiled programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from hmmseg.hmm import banded as alignment

MIN_LENGTH = 256
Bands = tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Alignment:
    """Posterior of one recording's alignment, NumPy arrays; fields as in hmmseg.hmm.banded.

    `path` (num_timesteps,) is the most probable one, `log_prob` its log weight.
    """

    path: np.ndarray
    log_prob: float
    log_evidence: float
    log_smoothed: np.ndarray  # (num_timesteps, num_subtasks)
    log_advance: np.ndarray  # (num_timesteps - 1, num_subtasks - 1)
    log_skip: Bands = ()


def bucket(num_timesteps: int) -> int:
    """Length to which a recording of `num_timesteps` samples is padded."""
    return max(MIN_LENGTH, 1 << (num_timesteps - 1).bit_length())


def _pad(log_likelihoods: np.ndarray, bands: Bands, length: int) -> tuple[np.ndarray, Bands]:
    """Rows of zeros after the last sample; bands written out to one row a transition."""
    ll = np.asarray(log_likelihoods, float)
    extra = length - ll.shape[0]
    full = tuple(np.broadcast_to(np.asarray(b, float), (ll.shape[0] - 1, np.shape(b)[-1])) for b in bands)
    return np.pad(ll, ((0, extra), (0, 0))), tuple(np.pad(b, ((0, extra), (0, 0))) for b in full)


def _cut(best: alignment.Path, posterior: alignment.Posterior, n: int) -> Alignment:
    return Alignment(
        np.asarray(best.path)[:n], float(best.log_prob), float(posterior.log_evidence),
        np.asarray(posterior.log_smoothed)[:n], np.asarray(posterior.log_advance)[: n - 1],
        tuple(np.asarray(band)[: n - 1] for band in posterior.log_skip),
    )  # fmt: skip


def align(log_likelihoods: np.ndarray, log_stay: np.ndarray, log_advance: np.ndarray,
          log_skip: Bands = (), *, log_initial: np.ndarray | None = None,
          log_final: np.ndarray | None = None) -> Alignment:  # fmt: skip
    """Viterbi path and posterior of one recording, arguments as in hmmseg.hmm.banded.

    Raises InfeasibleAlignment (which subtask starves) and ValueError (NaN, wrong shapes).
    """
    n = len(log_likelihoods)
    ll, (stay, advance, *skip) = _pad(log_likelihoods, (log_stay, log_advance, *log_skip), bucket(n))
    ends = {"num_valid": n, "log_initial": log_initial, "log_final": log_final}
    best = alignment.viterbi(ll, stay, advance, tuple(skip), **ends)
    return _cut(best, alignment.forward_backward(ll, stay, advance, tuple(skip), **ends), n)


def draw_alignments(key: jax.Array, log_likelihoods: np.ndarray, log_stay: np.ndarray,
                    log_advance: np.ndarray, num_samples: int, log_skip: Bands = (), *,
                    log_initial: np.ndarray | None = None,
                    log_final: np.ndarray | None = None) -> np.ndarray:  # fmt: skip
    """Exact posterior draws of whole alignments (num_samples, num_timesteps); raises as `align`."""
    n = len(log_likelihoods)
    ll, (stay, advance, *skip) = _pad(log_likelihoods, (log_stay, log_advance, *log_skip), bucket(n))
    paths = alignment.sample_alignments(
        key, ll, stay, advance, num_samples, tuple(skip),
        num_valid=n, log_initial=log_initial, log_final=log_final,
    )  # fmt: skip
    return np.asarray(paths)[:, :n]


@jax.jit
def _batch(ll, stay, advance, skip, num_valid, log_initial, log_final):
    def one(ll, stay, advance, skip, n):
        ends = {"num_valid": n, "log_initial": log_initial, "log_final": log_final}
        return (alignment.viterbi(ll, stay, advance, skip, **ends),
                alignment.forward_backward(ll, stay, advance, skip, **ends))  # fmt: skip

    return jax.vmap(one)(ll, stay, advance, skip, num_valid)


def align_many(log_likelihoods: Sequence[np.ndarray], bands: Sequence[Bands], *,
               log_initial: np.ndarray | None = None,
               log_final: np.ndarray | None = None) -> list[Alignment]:  # fmt: skip
    """`align` for several recordings in one batch.

    `bands` holds (log_stay, log_advance, further skips ...) of each recording. Raises as `align`.
    """
    if not log_likelihoods:
        return []
    lengths = [len(ll) for ll in log_likelihoods]
    length = bucket(max(lengths))
    padded = [_pad(ll, b, length) for ll, b in zip(log_likelihoods, bands, strict=True)]
    ll = np.stack([p[0] for p in padded])
    stay, advance, *skip = (np.stack(each) for each in zip(*(p[1] for p in padded), strict=True))
    best, posterior = _batch(ll, stay, advance, tuple(skip), np.array(lengths), log_initial, log_final)
    for i, finite in enumerate(np.isfinite(best.log_prob).tolist()):
        if not finite:  # say which subtask starves, or where NaN is
            b = bands[i]
            ends = {"log_initial": log_initial, "log_final": log_final}
            alignment.viterbi(log_likelihoods[i], b[0], b[1], tuple(b[2:]), **ends)
    return [
        _cut(jax.tree.map(lambda a, i=i: a[i], best), jax.tree.map(lambda a, i=i: a[i], posterior), n)
        for i, n in enumerate(lengths)
    ]
