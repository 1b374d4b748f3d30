"""Expectation maximisation of a task's hidden Markov model, trials of any lengths pooled.

What the states look like and how long they last is the caller's: the driver sees nothing but log-likelihoods
(num_timesteps, num_states), chains, and posterior state probabilities of the same shape. A network's
emissions need no driver: their gradient is that of `hmmseg.hmm.log_evidence` (docs/hmm.md).

Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1977; Rabiner, Proc. IEEE 77(2), 1989.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from hmmseg.hmm.chain import Chain
from hmmseg.hmm.inference import align
from hmmseg.hmm.results import AlignmentPosterior

M = TypeVar("M")
LEAST_ITERATIONS = 6  # numerics: before the evidence may have settled


@dataclass(frozen=True)
class Learned(Generic[M]):
    """A fitted model; every trial's most probable path and posterior are those under it."""

    model: M
    alignments: tuple[AlignmentPosterior, ...]
    num_iterations: int
    converged: bool

    @property
    def log_evidence(self) -> float:
        """Log evidence of all trials [nats]."""
        return sum(each.log_evidence for each in self.alignments)


def em(model: M, tables: Callable[[M], tuple[Sequence[np.ndarray], Sequence[Chain]]],
       updated: Callable[[M, Sequence[np.ndarray]], M], max_iterations: int = 40,
       tolerance: float = 1e-3) -> Learned[M]:  # fmt: skip
    """Expectation and maximisation in turn, until the log evidence changes by less than `tolerance` nats.

    The last step is an expectation.

    Args:
        model: where it starts.
        tables: of a model, each trial's log-likelihoods (num_timesteps, num_states), -inf where a state
            cannot be, and its chain.
        updated: the M-step: a model anew, given each trial's posterior state probabilities.
        max_iterations: after which it ends unconverged.
        tolerance: nats.

    Returns:
        The model at the end.

    Raises:
        InfeasibleAlignment: a trial is too short for its states.
        ValueError: NaN.
    """
    before = -np.inf
    for iteration in range(1, max_iterations + 1):
        fit = Learned(model, tuple(align(*tables(model))), iteration, False)
        if iteration > LEAST_ITERATIONS and abs(fit.log_evidence - before) < tolerance:
            return Learned(model, fit.alignments, iteration, True)
        if iteration < max_iterations:
            before = fit.log_evidence
            model = updated(model, [each.smoothed for each in fit.alignments])
    return fit
