"""Whether causes hold elsewhere: in other parts of recordings, and in held-out trials."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import t as student

from simgap.attribution.posterior import Forms, Model, channel_of, coordinates, fitted, forms, quadratic_forms
from simgap.bounded import least

# Parameters that differ from part to part of a recording are less certain than noise alone would make them.
#
# In part p the parameters are theta + d_p, d_p ~ N(0, (wander theta)^2): the random-effects model of
# meta-analysis (DerSimonian & Laird, Controlled Clinical Trials 7, 1986) with its heterogeneity on a grid.

# prior: standard deviation between parts, relative to the parameters
WANDER = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5])
RESPONSE = 0.03  # prior: relative error of a parameter where the effect's form is wrong everywhere alike
SINGULAR = 1e-12  # numerics: share of the largest eigenvalue below which a direction is unknown
# cited: nats; "positive" evidence for one cause (Kass & Raftery, JASA 90, 1995)
POSITIVE = float(np.log(3.0))


def share_of(f: Forms, model: Model, effect: int) -> np.ndarray:
    """What relative errors (k,) of an effect's parameters refer to, in scaled deviations.

    The candidate's `size` where given, else the norm of all its deviations.
    """
    c, x = f.gap.candidates[effect], model.x[coordinates(f, model.effects)[effect]]
    usual = np.full(x.size, float(np.sqrt(x @ x)))
    return usual if c.size is None else np.where(np.isfinite(c.size), c.size / c.scale, usual)


def scatter_between(f: Forms, model: Model, effect: int, part: np.ndarray) -> np.ndarray:
    """Additional variance (k,) of an effect's scaled deviations because parts of a recording disagree.

    The variance of the mean of the random-effects model in excess of that without heterogeneity, averaged
    over the grid of `WANDER`. The other effects of the set are held fixed, and `hidden` parameters may differ
    in every part.

    Args:
        f: Quadratic forms of the gap.
        model: The fitted set.
        effect: The candidate.
        part: Part (n,) of each row, numbered from 0.
    """
    c, own = f.gap.candidates[effect], coordinates(f, model.effects)[effect]
    x, loose, out = model.x[own], ~model.at_bound[own], np.zeros(own.size)
    free = np.array([n in c.hidden for n in c.parameters], bool)[loose]
    left, weight = residual_left(f, model), model.precision[f.spectrum.group]
    jacobian = f.spectrum.columns[:, f.spectrum.own[effect][1:]][:, loose]
    square = x[loose] ** 2 + 0.01 * float(x[loose] @ x[loose]) / max(loose.sum(), 1) + 1e-12
    if c.size is not None:
        size = (c.size / c.scale)[loose]
        square = np.where(np.isfinite(size), size**2, square)
    masks = [part == p for p in range(int(part.max()) + 1)]
    curvature = np.stack([(jacobian[m] * weight[m, None]).T @ jacobian[m] for m in masks])
    pull = np.stack([(jacobian[m] * weight[m, None]).T @ left[m] for m in masks])
    diagonal = np.einsum("pii->pi", curvature)
    # Heterogeneity needs two parts that determine a parameter.
    several = (diagonal > SINGULAR * diagonal.max(0, initial=0.0)).sum(0) > 1
    if not several.any() or free.all():
        return out
    score, scatter, identity = np.zeros(WANDER.size), [], np.eye(square.size)
    for i, wander in enumerate(WANDER):
        prior = np.diag(np.where(free, WANDER[-1], wander) ** 2 * square)
        shrunk = np.linalg.inv(identity + curvature @ prior)
        information, pulls = (shrunk @ curvature).sum(0), np.einsum("pij,pj->pi", shrunk, pull)
        values, axes = np.linalg.eigh(information)
        regular = values > SINGULAR * values.max()
        covariance = (axes[:, regular] / values[regular]) @ axes[:, regular].T
        # The mean comes from the same parts (restricted likelihood: Patterson & Thompson, Biometrika 58).
        score[i] = np.sum(pull * (pulls @ prior)) + pulls.sum(0) @ covariance @ pulls.sum(0)
        score[i] += np.linalg.slogdet(shrunk)[1].sum() - np.log(values[regular]).sum()
        scatter.append(np.diag(covariance))
    weight = np.exp((score - score.max()) / 2)
    weight /= weight.sum()
    out[loose] = np.where(several, weight @ np.maximum(np.stack(scatter) - scatter[0], 0.0), 0.0)
    return out


def residual_left(f: Forms, model: Model) -> np.ndarray:
    """The residual (n,) of a fitted set, in the spectrum."""
    columns, z = f.spectrum.columns, f.spectrum.num_nuisances
    out = columns[:, 0] - columns[:, 1 : 1 + z] @ model.x[:z]
    at = z
    for j in model.effects:
        own = f.spectrum.own[j]
        out = out - columns[:, own[0]] - columns[:, own[1:]] @ model.x[at : at + own.size - 1]
        at += own.size - 1
    return out


# How far causes shrink the gap of held-out trials, predicted from the other trials.
#
# Causes are chosen on all trials; their sizes are then estimated without the trial that is predicted. The
# squares of that trial are those of its predictive density, in which the covariance of the noise is widened
# by the uncertainty that the other trials leave:
#
#     S = min over x of  sum_g energy_g(x) / noise_g + (x - mean)' covariance^-1 (x - mean)
#
# with mean and covariance of x (nuisances and parameters) given the other trials. If the model holds, S has
# expectation n, the number of rows. A nuisance of one trial is free again in the predicted trial, as the
# others do not determine it. Squares with and without causes are computed in the same way. What is known of
# nuisances beforehand, such as a property measured apart, counts as one more trial, which all trials predict.


@dataclass(frozen=True)
class HowFar:
    """How far the gap of held-out trials shrinks.

    Attributes:
        before, after: Mean squares without and with the causes.
        noise_floor: That of the noise, fixed beforehand.
        fraction, interval_90: The share of the gap that is gone, and its 90 % interval by trial.
        score: Gain of the log predictive density [nats].
    """

    before: float
    after: float
    noise_floor: float
    fraction: float
    interval_90: tuple[float, float]
    score: float

    def to_json(self) -> dict[str, Any]:
        """The entry `shrinkage` of the JSON document."""
        ends = [x if np.isfinite(x) else None for x in self.interval_90]
        return {
            "evaluated_on": "held-out trials", "before": self.before, "after": self.after,
            "noise_floor": self.noise_floor, "fraction": self.fraction, "interval_90": ends,
            "flexible_ceiling": None,
        }  # fmt: skip


@dataclass(frozen=True)
class Heldout:
    """Leave-one-out prediction of K trials.

    Attributes:
        noise: Variance (channels,) of each channel's noise.
        whole: Quadratic forms of all trials.
        among: Its candidates that sets are made of.
        folds: For each trial the forms of the others and its own, restricted to these candidates.
        computed: Squares (K + 1,) and log determinants (K + 1,) of sets so far.
    """

    noise: np.ndarray
    whole: Forms
    among: tuple[int, ...]
    folds: tuple[tuple[Forms, Forms], ...]
    computed: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @classmethod
    def of(cls, whole: Forms, noise: np.ndarray, among: Iterable[int]) -> Heldout | None:
        """Split a gap by trial; None with a single trial."""
        trials = np.unique(whole.gap.rows.trial)
        if trials.size < 2:
            return None
        among = tuple(sorted(set(among)))
        few, inside = whole.gap.only(among), [whole.gap.rows.trial == trial for trial in trials]
        folds = tuple((forms(few.taken(~one)), forms(few.taken(one))) for one in inside)
        return cls(noise, whole, among, folds)

    def how_far(self, effects: Sequence[int]) -> HowFar | None:
        """How far a set of effects shrinks the gap; None if held-out trials show none."""
        (before, _), (after, _) = self._squares(()), self._squares(effects)
        plain, z = fitted(self.whole, ()), self.whole.spectrum.num_nuisances
        determined = z - float(np.trace(plain.covariance))
        floor = np.array([*(test.count.sum() for _, test in self.folds), determined])
        if before.sum() <= floor.sum():
            return None
        n, gone = float(floor.sum()), fraction_gone(before - after, before - floor)
        return HowFar(float(before.sum()) / n, float(after.sum()) / n, 1.0, *gone, self.gain(effects, ()))

    def gain(self, effects: Sequence[int], without: Sequence[int]) -> float:
        """Gain of the log predictive density of all trials [nats] by `effects` over the set `without`."""
        return float(self.gains(effects, without).sum())

    def gains(self, effects: Sequence[int], without: Sequence[int]) -> np.ndarray:
        """Gain of the log predictive density [nats] by trial, and for what was measured apart.

        Args:
            effects: A set of candidates.
            without: The set it is compared with.

        Returns:
            Gains (K + 1,), evidence from other sources included.
        """
        (more, wide), (less, plain) = self._squares(effects), self._squares(without)
        of = self.whole.gap.candidates
        evidence = sum(of[j].evidence for j in effects) - sum(of[j].evidence for j in without)
        gained = 0.5 * (less + plain - more - wide)
        return gained + evidence / len(self.folds) * (np.arange(gained.size) < len(self.folds))

    def _squares(self, effects: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        key = tuple(sorted(self.among.index(j) for j in effects))
        if key not in self.computed:
            x = fitted(self.whole, tuple(sorted(effects))).x[: self.whole.spectrum.num_nuisances]
            each = [self._predicted(train, test, key) for train, test in self.folds]
            each = np.array([*each, (float(x @ x), 0.0)])
            self.computed[key] = each[:, 0], each[:, 1]
        return self.computed[key]

    def _predicted(self, train: Forms, test: Forms, effects: tuple[int, ...]) -> tuple[float, float]:
        """Squares of a held-out trial, and the log determinant of its noise over the stated one.

        `effects` are indices into `among`.
        """
        model, taken = fitted(train, effects), quadratic_forms(test, effects)
        weight = np.exp(-taken.shift) / self.noise[channel_of(test)]
        loose = ~model.at_bound  # parameters at a bound stay there, even if this trial does not show them
        precision = np.diag(np.where(loose, 0.0, 1.0))
        precision[np.ix_(loose, loose)] = np.linalg.inv(model.covariance[np.ix_(loose, loose)])
        low, high = (np.where(loose, edge, model.x) for edge in (taken.low, taken.high))
        matrix, pull = taken.weighed(weight)
        x, _ = least(matrix + precision, pull + precision @ model.x, low, high)
        squares, away = weight * taken.energy(x), x - model.x
        more = test.count * test.freed[list(effects)].sum(0)  # the squares that they free
        left = np.maximum(squares - more, np.minimum(squares, test.count))
        return float(left.sum() + away @ precision @ away), float(test.count @ taken.shift)


def fraction_gone(gone: np.ndarray, there: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Share of a gap that is gone, with its 90 % interval by the jackknife of a ratio.

    Tukey, Ann. Math. Stat. 29, 1958.

    Args:
        gone: Excess squares (K,) removed in each part.
        there: Excess squares (K,) before.
    """
    k, fraction = gone.size, min(float(gone.sum() / there.sum()), 1.0)
    rest = there.sum() - there
    others = np.where(rest > 0, (gone.sum() - gone) / np.where(rest > 0, rest, 1.0), fraction)
    sd = float(np.sqrt((k - 1) / k * ((others - others.mean()) ** 2).sum()))
    wide = float(student.ppf(0.95, k - 1)) * sd
    return fraction, (fraction - wide, min(fraction + wide, 1.0))
