"""Most probable path and posterior of whole recordings, as EM and the segmentation take them.

On the host kernels of hmmseg.hmm: nothing is compiled when it is called.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.hmm.chain import Chain, not_numbers
from hmmseg.hmm.inference import smoothed_tables, table, viterbi
from hmmseg.hmm.results import Alignment

Bands = tuple[np.ndarray, ...]


@dataclass(frozen=True)
class AlignmentPosterior:
    """Posterior of one recording's alignment, as probabilities; fields as in hmmseg.hmm.results.Posterior.

    `path` (num_timesteps,) is the most probable one, `log_prob` its log weight.
    """

    path: np.ndarray
    log_prob: float
    log_evidence: float
    smoothed: np.ndarray  # (num_timesteps, num_subtasks)
    moves: Bands  # from k to k + 1 (num_timesteps - 1, num_subtasks - 1), to k + 2, ...


def align(log_likelihoods: np.ndarray, log_stay: np.ndarray, log_advance: np.ndarray,
          log_skip: Bands = (), *, log_initial: np.ndarray | None = None,
          log_final: np.ndarray | None = None) -> AlignmentPosterior:  # fmt: skip
    """Viterbi path and posterior of one recording, of log likelihoods (num_timesteps, num_subtasks).

    Log weights to stay (num_timesteps - 1, num_subtasks), to advance (num_timesteps - 1, num_subtasks - 1),
    to skip one, two ... subtasks; without their first axis where they do not vary in time. Entry [t, k]
    belongs to leaving subtask k between the samples t and t + 1. A path starts in subtask 0 and ends in the
    last one unless `log_initial` or `log_final` (num_subtasks,) say otherwise.
    Raises InfeasibleAlignment (which subtask starves) and ValueError (NaN, wrong shapes).
    """
    chain = Chain(log_stay, log_advance, log_skip or None, log_initial=log_initial, log_final=log_final)
    ll = table(log_likelihoods, chain)
    missing = np.isnan(ll)
    if missing.any():
        raise not_numbers(ll, int(missing.any(axis=1).argmax()))
    best = viterbi(ll, chain)
    assert isinstance(best, Alignment)  # of one recording
    return AlignmentPosterior(best.path, best.log_prob, *smoothed_tables(ll, chain))


def align_many(log_likelihoods: Sequence[np.ndarray], bands: Sequence[Bands], *,
               log_initial: np.ndarray | None = None,
               log_final: np.ndarray | None = None) -> list[AlignmentPosterior]:  # fmt: skip
    """`align` for several recordings; `bands` holds (log_stay, log_advance, further skips ...) of each."""
    return [
        align(ll, b[0], b[1], tuple(b[2:]), log_initial=log_initial, log_final=log_final)
        for ll, b in zip(log_likelihoods, bands, strict=True)
    ]
