"""The EM driver against enumeration of all alignments and a grid over the one free parameter."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import norm

from hmmseg.hmm import Chain, InfeasibleAlignment, em
from hmmseg.segmentation.fit import MeanShares

STAY = 0.8


@dataclass(frozen=True)
class Levels:
    """Unit-variance levels, the first known to be 0."""

    trials: tuple[np.ndarray, ...]
    level: float

    def log_likelihoods(self, trial):
        return norm.logpdf(self.trials[trial][:, None], [0.0, self.level])

    def updated(self, responsibilities):
        weight = np.concatenate([r[:, 1] for r in responsibilities])
        return replace(self, level=float(weight @ np.concatenate(self.trials) / weight.sum()))


@dataclass(frozen=True)
class Fixed:
    def chain(self, trial):
        return Chain(np.log([STAY, 1.0]), np.log([1 - STAY]))

    def updated(self, responsibilities):
        return self


def by_enumeration(trials, level):
    """Log evidence of trials under two levels, every boundary tried."""
    total = 0.0
    for x in trials:
        terms = [
            norm.logpdf(x[:cut]).sum() + norm.logpdf(x[cut:], level).sum() + (cut - 1) * np.log(STAY)
            + np.log(1 - STAY) for cut in range(1, x.size)
        ]  # fmt: skip
        total += np.logaddexp.reduce(terms)
    return total


def recorded():
    rng = np.random.default_rng(0)
    return tuple(
        np.r_[rng.normal(size=before), rng.normal(2.0, 1.0, size=after)]
        for before, after in ((3, 6), (4, 5), (6, 3), (2, 3))
    )


def test_log_evidence_and_responsibilities_are_those_of_enumeration():
    trials = recorded()
    fit = em(Levels(trials, 1.5), Fixed(), len(trials), max_iterations=1)
    assert fit.log_evidence == pytest.approx(by_enumeration(trials, 1.5), abs=1e-9)
    assert (fit.num_iterations, fit.converged) == (1, False)
    x = trials[3]
    weights = np.array([
        np.exp(norm.logpdf(x[:c]).sum() + norm.logpdf(x[c:], 1.5).sum())
        * STAY ** (c - 1) for c in range(1, x.size)
    ])  # fmt: skip
    late = [weights[:t].sum() / weights.sum() for t in range(x.size)]
    np.testing.assert_allclose(fit.responsibilities[3][:, 1], late, atol=1e-9)


def test_em_ends_at_the_maximum_of_the_evidence():
    trials = recorded()
    fit = em(Levels(trials, 0.7), Fixed(), len(trials), max_iterations=500, tolerance=1e-10)
    assert fit.converged
    grid = np.linspace(-1, 4, 2001)
    best = grid[np.argmax([by_enumeration(trials, level) for level in grid])]
    assert fit.emission.level == pytest.approx(best, abs=3e-3)
    assert fit.log_evidence == pytest.approx(by_enumeration(trials, fit.emission.level), abs=1e-9)


def test_evidence_never_decreases():
    trials = recorded()
    evidence = [em(Levels(trials, 0.3), Fixed(), len(trials), max_iterations=n).log_evidence
                for n in range(1, 12)]  # fmt: skip
    assert np.diff(evidence).min() > -1e-9
    assert evidence[-1] > evidence[0] + 0.1


def test_what_the_order_forbids_stays_exactly_zero_while_durations_are_learned():
    trials = recorded()
    shares = MeanShares(tuple(x.size for x in trials), np.array([0.9, 0.1]))
    fit = em(Levels(trials, 0.7), shares, len(trials))
    assert abs(fit.durations.shares[0] - 0.9) > 0.1  # learned they were
    for found in fit.alignments:
        assert (found.smoothed[0, 1], found.smoothed[-1, 0]) == (0.0, 0.0)
        assert set(np.diff(found.path)) <= {0, 1}
        assert len(found.moves) == 1  # and none past a state


def test_a_trial_too_short_says_which_state_starves():
    with pytest.raises(InfeasibleAlignment) as error:
        em(Levels((np.zeros(4), np.zeros(1)), 1.0), Fixed(), 2)
    assert error.value.subtask == 1
