"""Expectation maximisation of a task's hidden Markov model, trials of any lengths pooled.

One driver for every kind of recording. What the states look like is an `Emission`, how long they last a
`Durations`; both hold the trials' data, so that the driver sees nothing but log-likelihoods (num_timesteps,
num_states) and posterior state probabilities of the same shape. A network's emissions need no driver: their
gradient is that of `hmmseg.hmm.log_evidence` (docs/hmm.md).

Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1977; Rabiner, Proc. IEEE 77(2), 1989.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from hmmseg.hmm.chain import Chain
from hmmseg.hmm.inference import align
from hmmseg.hmm.results import AlignmentPosterior

S = TypeVar("S")
LEAST_ITERATIONS = 6  # numerics: before the evidence may have settled


@runtime_checkable
class Emission(Protocol):
    """What each state looks like; frozen, an update is a new object."""

    def log_likelihoods(self, trial: int) -> np.ndarray:
        """Log-likelihoods (num_timesteps, num_states) of one trial, -inf where a state cannot be."""
        ...

    def updated(self: S, responsibilities: Sequence[np.ndarray]) -> S:
        """The M-step, given posterior state probabilities (num_timesteps, num_states) a trial."""
        ...


@runtime_checkable
class Durations(Protocol):
    """How states follow each other; frozen, an update is a new object."""

    def chain(self, trial: int) -> Chain:
        """The chain of one trial."""
        ...

    def updated(self: S, responsibilities: Sequence[np.ndarray]) -> S:
        """The M-step, as of an emission."""
        ...


E = TypeVar("E", bound=Emission)
D = TypeVar("D", bound=Durations)


@dataclass(frozen=True)
class Learned(Generic[E, D]):
    """A fitted model; every trial's most probable path and posterior are those under it."""

    emission: E
    durations: D
    alignments: tuple[AlignmentPosterior, ...]
    num_iterations: int
    converged: bool

    @property
    def log_evidence(self) -> float:
        """Log evidence of all trials [nats]."""
        return sum(each.log_evidence for each in self.alignments)

    @property
    def responsibilities(self) -> list[np.ndarray]:
        """Posterior state probabilities (num_timesteps, num_states) of every trial."""
        return [each.smoothed for each in self.alignments]


def expectation(emission: Emission, durations: Durations, num_trials: int) -> tuple[AlignmentPosterior, ...]:
    """Paths and posteriors of all trials; raises InfeasibleAlignment where a trial has no path."""
    tables = [emission.log_likelihoods(i) for i in range(num_trials)]
    return tuple(align(tables, [durations.chain(i) for i in range(num_trials)]))


def em(emission: E, durations: D, num_trials: int, max_iterations: int = 40,
       tolerance: float = 1e-3) -> Learned[E, D]:  # fmt: skip
    """Expectation and maximisation in turn, until the log evidence changes by less than `tolerance` nats.

    The last step is an expectation.

    Args:
        emission, durations: where it starts.
        num_trials: of the data that these hold.
        max_iterations: after which it ends unconverged.
        tolerance: nats.

    Raises:
        InfeasibleAlignment: a trial is too short for its states.
        ValueError: NaN.
    """
    before = -np.inf
    for iteration in range(1, max_iterations + 1):
        fit = Learned(emission, durations, expectation(emission, durations, num_trials), iteration, False)
        if iteration > LEAST_ITERATIONS and abs(fit.log_evidence - before) < tolerance:
            return Learned(emission, durations, fit.alignments, iteration, True)
        if iteration < max_iterations:
            before, responsibilities = fit.log_evidence, fit.responsibilities
            emission, durations = emission.updated(responsibilities), durations.updated(responsibilities)
    return fit
