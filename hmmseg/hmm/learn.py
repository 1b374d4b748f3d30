"""Expectation maximisation of a task's hidden Markov model, pooling trials of any lengths.

Emissions and durations are up to the caller: the driver handles only log-likelihoods (num_timesteps,
num_states), chains, and posterior state probabilities of the same shape. Emissions by a network need no
driver, as the gradient of `hmmseg.hmm.log_evidence` is available (docs/hmm.md).

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
    """A fitted model, with every trial's most probable path and posterior under it."""

    model: M
    alignments: tuple[AlignmentPosterior, ...]
    converged: bool = False

    @property
    def log_evidence(self) -> float:
        """Log evidence of all trials [nats]."""
        return sum(each.log_evidence for each in self.alignments)


def em(model: M, tables: Callable[[M], tuple[Sequence[np.ndarray], Sequence[Chain]]],
       updated: Callable[[M, Sequence[np.ndarray]], M], max_iterations: int = 40,
       tolerance: float = 1e-3) -> Learned[M]:  # fmt: skip
    """Alternate expectation and maximisation until the log evidence changes by less than `tolerance` nats.

    The last step is an expectation.

    Args:
        model: initial model.
        tables: maps a model to each trial's log-likelihoods (num_timesteps, num_states), -inf for impossible
            states, and its chain.
        updated: the M-step: a new model, given each trial's posterior state probabilities.
        max_iterations: limit, after which the result is unconverged.
        tolerance: nats.

    Returns:
        The final model.

    Raises:
        InfeasibleAlignment: a trial is too short for its states.
        ValueError: NaN.
    """
    before = -np.inf
    for iteration in range(1, max_iterations + 1):
        fit = Learned(model, tuple(align(*tables(model))))
        if iteration > LEAST_ITERATIONS and abs(fit.log_evidence - before) < tolerance:
            return Learned(model, fit.alignments, converged=True)
        if iteration < max_iterations:
            before = fit.log_evidence
            model = updated(model, [each.smoothed for each in fit.alignments])
    return fit
