"""How far causes shrink the gap of trials that took no part: predicted by what the other trials say.

Causes are chosen on all trials; how large they are is then found without the trial that is predicted. The
squares of that trial are those of its predictive density, in which the covariance of the noise is widened by
what the other trials leave open:

    S = min over x of  sum_g energy_g(x) / noise_g + (x - mean)' covariance^-1 (x - mean)

with mean and covariance of x (nuisances and parameters) given the other trials. Where the model holds, S has
the expectation n, the number of rows. A nuisance of one trial is free again in the trial that is predicted:
the others say nothing of it. Both squares, with causes and without, are taken in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import t as student

from simgap.attribution.posterior import Forms, channel_of, fitted, forms, quadratic_forms
from simgap.attribution.problem import Gap
from simgap.bounded import least


@dataclass(frozen=True)
class HowFar:
    """Mean squares of trials that took no part, `before` and `after`, the noise's own `noise_floor`, fixed
    beforehand; `fraction` of the gap that is gone, its 90 % interval by trial; `score` [nats]: gain of the
    log predictive density."""

    before: float
    after: float
    noise_floor: float
    fraction: float
    interval_90: tuple[float, float]
    score: float


@dataclass(frozen=True)
class Heldout:
    """Every trial predicted by the others; `noise` (channels,): variance of each channel's noise.

    `among`: the gap's candidates that sets are made of; `folds`: the others and the trial, of these alone;
    `computed`: squares (K,) and log determinants (K,) of sets so far.
    """

    noise: np.ndarray
    among: tuple[int, ...]
    folds: tuple[tuple[Forms, Forms], ...]
    computed: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @classmethod
    def of(cls, gap: Gap, noise: np.ndarray, among: Iterable[int]) -> Heldout | None:
        """None with one trial: nothing predicts it."""
        trials = np.unique(gap.rows.trial)
        if trials.size < 2:
            return None
        among = tuple(sorted(set(among)))
        gap, inside = gap.only(among), [gap.rows.trial == trial for trial in trials]
        return cls(noise, among, tuple((forms(gap.taken(~one)), forms(gap.taken(one))) for one in inside))

    def how_far(self, effects: Sequence[int]) -> HowFar | None:
        """How far a set of effects shrinks the gap; None where these trials have no excess of squares."""
        (before, _), (after, _) = self._squares(()), self._squares(effects)
        floor = np.array([test.count.sum() for _, test in self.folds])
        if float((before - floor).sum()) <= 0:
            return None
        n, gone = float(floor.sum()), fraction_gone(before - after, before - floor)
        return HowFar(float(before.sum()) / n, float(after.sum()) / n, 1.0, *gone, self.gain(effects, ()))

    def gain(self, effects: Sequence[int], without: Sequence[int]) -> float:
        """Log predictive density of all trials by a set of effects over that by another [nats]."""
        (more, wide), (less, plain) = self._squares(effects), self._squares(without)
        return 0.5 * float((less + plain - more - wide).sum())

    def _squares(self, effects: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        key = tuple(sorted(self.among.index(j) for j in effects))
        if key not in self.computed:
            each = np.array([self._predicted(train, test, key) for train, test in self.folds])
            self.computed[key] = each[:, 0], each[:, 1]
        return self.computed[key]

    def _predicted(self, train: Forms, test: Forms, effects: tuple[int, ...]) -> tuple[float, float]:
        """Squares of a trial, and log determinant of its noise over the stated one; `effects` of `among`."""
        model, taken = fitted(train, effects), quadratic_forms(test, effects)
        weight = np.exp(-taken.shift) / self.noise[channel_of(test)]
        loose = ~model.at_bound  # what is at a bound stays there
        precision = np.zeros_like(model.covariance)
        precision[np.ix_(loose, loose)] = np.linalg.inv(model.covariance[np.ix_(loose, loose)])
        low, high = (np.where(loose, edge, model.x) for edge in (taken.low, taken.high))
        matrix, pull = taken.weighed(weight)
        x, _ = least(matrix + precision, pull + precision @ model.x, low, high)
        squares, off = weight * taken.energy(x), x - model.x
        more = test.count * test.freed[list(effects)].sum(0)  # of the squares, so much is what they free
        left = np.maximum(squares - more, np.minimum(squares, test.count))
        return float(left.sum() + off @ precision @ off), float(test.count @ taken.shift)


def fraction_gone(gone: np.ndarray, there: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Share of the gap that is gone, of what is `gone` and what was `there` in K parts (K,), and its 90 %
    interval by the jackknife of a ratio (Tukey, Ann. Math. Stat. 29, 1958)."""
    k, fraction = gone.size, min(float(gone.sum() / there.sum()), 1.0)
    others = (gone.sum() - gone) / np.maximum(there.sum() - there, 1e-9)
    sd = float(np.sqrt((k - 1) / k * ((others - others.mean()) ** 2).sum()))
    wide = float(student.ppf(0.95, k - 1)) * sd
    return fraction, (fraction - wide, min(fraction + wide, 1.0))
