"""Whether causes hold elsewhere: in other parts of recordings, and in trials that took no part."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import t as student

from simgap.attribution.posterior import Forms, Model, channel_of, coordinates, fitted, forms, quadratic_forms
from simgap.bounded import least

# An effect whose parameters differ from part to part of recordings is known less well than noise alone says.
#
# In part p the parameters are theta + d_p, d_p ~ N(0, (wander theta)^2): the random-effects model of
# meta-analysis (DerSimonian & Laird, Controlled Clinical Trials 7, 1986) with its heterogeneity on a grid.

WANDER = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5])  # prior: shares of the parameters
RESPONSE = 0.03  # prior: of a parameter: by how much an effect's form answers it wrongly everywhere alike
SINGULAR = 1e-12  # numerics: share of the largest eigenvalue below which a direction is unknown
# cited: nats; "positive" evidence for one cause (Kass & Raftery, JASA 90, 1995)
POSITIVE = float(np.log(3.0))


def share_of(f: Forms, model: Model, effect: int) -> np.ndarray:
    """What a share of each of an effect's parameters (k,) is a share of, in deviations over scale: its own
    size where that is stated, else all of them together."""
    c, x = f.gap.candidates[effect], model.x[coordinates(f, model.effects)[effect]]
    usual = np.full(x.size, float(np.sqrt(x @ x)))
    return usual if c.size is None else np.where(np.isfinite(c.size), c.size / c.scale, usual)


def scatter_between(f: Forms, model: Model, effect: int, part: np.ndarray) -> np.ndarray:
    """Variance (k,) of an effect's deviations over scale that comes on top of the noise's, for what parts
    say of it differs by more: that of the mean of the random-effects model, over what it wanders by.

    `part` (n,) numbers those of the rows from 0. What the set has besides the effect stays as it is, and
    `hidden` parameters may be others in every part.
    """
    c, own = f.gap.candidates[effect], coordinates(f, model.effects)[effect]
    x, loose, out = model.x[own], ~model.at_bound[own], np.zeros(own.size)
    free = np.array([n in c.hidden for n in c.parameters], bool)[loose]
    left, weight = residual_left(f, model), model.precision[f.spectrum.group]
    push = f.spectrum.columns[:, f.spectrum.own[effect][1:]][:, loose]
    usual = x[loose] ** 2 + 0.01 * float(x[loose] @ x[loose]) / max(loose.sum(), 1) + 1e-12
    if c.size is not None:
        given = (c.size / c.scale)[loose]
        usual = np.where(np.isfinite(given), given**2, usual)
    mine = [part == p for p in range(int(part.max()) + 1)]
    bend = np.stack([(push[m] * weight[m, None]).T @ push[m] for m in mine])
    pull = np.stack([(push[m] * weight[m, None]).T @ left[m] for m in mine])
    says = np.einsum("pii->pi", bend)
    several = (says > SINGULAR * says.max(0, initial=0.0)).sum(0) > 1  # one part differs from no other
    if not several.any() or free.all():
        return out
    score, scatter, one = np.zeros(WANDER.size), [], np.eye(usual.size)
    for i, wander in enumerate(WANDER):
        prior = np.diag(np.where(free, WANDER[-1], wander) ** 2 * usual)
        inner = np.linalg.inv(one + bend @ prior)
        told, says = (inner @ bend).sum(0), np.einsum("pij,pj->pi", inner, pull)
        size, axes = np.linalg.eigh(told)
        known = size > SINGULAR * size.max()
        covariance = (axes[:, known] / size[known]) @ axes[:, known].T
        # The mean is known from the same parts (restricted likelihood: Patterson & Thompson, Biometrika 58).
        score[i] = np.sum(pull * (says @ prior)) + says.sum(0) @ covariance @ says.sum(0)
        score[i] += np.linalg.slogdet(inner)[1].sum() - np.log(size[known]).sum()
        scatter.append(np.diag(covariance))
    weight = np.exp((score - score.max()) / 2)
    weight /= weight.sum()
    out[loose] = np.where(several, weight @ np.maximum(np.stack(scatter) - scatter[0], 0.0), 0.0)
    return out


def residual_left(f: Forms, model: Model) -> np.ndarray:
    """What a set leaves of the spectrum's residual (n,)."""
    columns, z = f.spectrum.columns, f.spectrum.num_nuisances
    out = columns[:, 0] - columns[:, 1 : 1 + z] @ model.x[:z]
    at = z
    for j in model.effects:
        own = f.spectrum.own[j]
        out = out - columns[:, own[0]] - columns[:, own[1:]] @ model.x[at : at + own.size - 1]
        at += own.size - 1
    return out


def form_error(f: Forms, model: Model) -> np.ndarray:
    """Mean square (G,) of each group by which the effects of a set are off as their forms usually are, in
    units of the noise's."""
    out = np.zeros(f.count.size)
    for j, mine in coordinates(f, model.effects).items():
        own, x = f.spectrum.own[j], np.append(1.0, model.x[mine])
        out += f.gap.candidates[j].form ** 2 * np.einsum("i,gij,j->g", x, f.product[:, own[:, None], own], x)
    return np.maximum(out, 0.0) / f.count


# How far causes shrink the gap of trials that took no part: predicted by what the other trials say.
#
# Causes are chosen on all trials; how large they are is then found without the trial that is predicted. The
# squares of that trial are those of its predictive density, in which the covariance of the noise is widened
# by what the other trials leave open:
#
#     S = min over x of  sum_g energy_g(x) / noise_g + (x - mean)' covariance^-1 (x - mean)
#
# with mean and covariance of x (nuisances and parameters) given the other trials. Where the model holds, S
# has the expectation n, the number of rows. A nuisance of one trial is free again in the trial that is
# predicted: the others say nothing of it. Both squares, with causes and without, are taken in the same way.
# What is known of nuisances beforehand, as a property that was measured apart, counts as one more trial: all
# trials together predict it.


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

    def to_json(self) -> dict[str, Any]:
        """The document's entry `shrinkage`."""
        ends = [x if np.isfinite(x) else None for x in self.interval_90]
        return {
            "evaluated_on": "held-out trials", "before": self.before, "after": self.after,
            "noise_floor": self.noise_floor, "fraction": self.fraction, "interval_90": ends,
            "flexible_ceiling": None,
        }  # fmt: skip


@dataclass(frozen=True)
class Heldout:
    """Every trial predicted by the others; `noise` (channels,): variance of each channel's noise.

    `whole`: all trials together; `among`: its candidates that sets are made of; `folds`: the others and the
    trial, of these alone; `computed`: squares (K + 1,) and log determinants (K + 1,) of sets so far.
    """

    noise: np.ndarray
    whole: Forms
    among: tuple[int, ...]
    folds: tuple[tuple[Forms, Forms], ...]
    computed: dict[tuple[tuple[int, ...], ...], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @classmethod
    def of(cls, whole: Forms, noise: np.ndarray, among: Iterable[int]) -> Heldout | None:
        """None with one trial: nothing predicts it."""
        trials = np.unique(whole.gap.rows.trial)
        if trials.size < 2:
            return None
        among = tuple(sorted(set(among)))
        few, inside = whole.gap.only(among), [whole.gap.rows.trial == trial for trial in trials]
        folds = tuple((forms(few.taken(~one)), forms(few.taken(one))) for one in inside)
        return cls(noise, whole, among, folds)

    def how_far(self, effects: Sequence[int]) -> HowFar | None:
        """How far a set of effects shrinks the gap; None where these trials have no excess of squares."""
        (before, _), (after, _) = self._squares(()), self._squares(effects)
        plain, z = fitted(self.whole, ()), self.whole.spectrum.num_nuisances
        known = z - float(np.trace(plain.covariance))
        floor = np.array([*(test.count.sum() for _, test in self.folds), known])
        if float((before - floor).sum()) <= 0:
            return None
        n, gone = float(floor.sum()), fraction_gone(before - after, before - floor)
        return HowFar(float(before.sum()) / n, float(after.sum()) / n, 1.0, *gone, self.gain(effects, ()))

    def gain(self, effects: Sequence[int], without: Sequence[int]) -> float:
        """Log predictive density of all trials by a set of effects over that by another [nats]."""
        return float(self.gains(effects, without).sum())

    def gains(self, effects: Sequence[int], without: Sequence[int], off: Sequence[int] = ()) -> np.ndarray:
        """The same of every trial, and of what was measured apart (K + 1,), with what else speaks for a set;
        forms of effects that may be `off` are no better than they usually are."""
        (more, wide), (less, plain) = self._squares(effects, off), self._squares(without, off)
        of = self.whole.gap.candidates
        known = sum(of[j].evidence for j in effects) - sum(of[j].evidence for j in without)
        gained = 0.5 * (less + plain - more - wide)
        return gained + known / len(self.folds) * (np.arange(gained.size) < len(self.folds))

    def _squares(self, effects: Sequence[int], off: Sequence[int] = ()) -> tuple[np.ndarray, np.ndarray]:
        key, loose = (tuple(sorted(self.among.index(j) for j in which)) for which in (effects, off))
        if (key, loose) not in self.computed:
            x = fitted(self.whole, tuple(sorted(effects))).x[: self.whole.spectrum.num_nuisances]
            each = [self._predicted(train, test, key, loose) for train, test in self.folds]
            each = np.array([*each, (float(x @ x), 0.0)])
            self.computed[key, loose] = each[:, 0], each[:, 1]
        return self.computed[key, loose]

    def _predicted(
        self, train: Forms, test: Forms, effects: tuple[int, ...], off: tuple[int, ...]
    ) -> tuple[float, float]:
        """Squares of a trial, and log determinant of its noise over the stated one; `effects` and those whose
        forms may be `off` of `among`."""
        model, taken = fitted(train, effects), quadratic_forms(test, effects)
        weight = np.exp(-taken.shift) / (self.noise[channel_of(test)] + form_error(test, fitted(train, off)))
        loose = ~model.at_bound  # what is at a bound stays there
        precision = np.zeros_like(model.covariance)
        precision[np.ix_(loose, loose)] = np.linalg.inv(model.covariance[np.ix_(loose, loose)])
        low, high = (np.where(loose, edge, model.x) for edge in (taken.low, taken.high))
        matrix, pull = taken.weighed(weight)
        x, _ = least(matrix + precision, pull + precision @ model.x, low, high)
        squares, away = weight * taken.energy(x), x - model.x
        more = test.count * test.freed[list(effects)].sum(0)  # of the squares, so much is what they free
        left = np.maximum(squares - more, np.minimum(squares, test.count))
        return float(left.sum() + away @ precision @ away), float(test.count @ taken.shift)


def fraction_gone(gone: np.ndarray, there: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Share of the gap that is gone, of what is `gone` and what was `there` in K parts (K,), and its 90 %
    interval by the jackknife of a ratio (Tukey, Ann. Math. Stat. 29, 1958)."""
    k, fraction = gone.size, min(float(gone.sum() / there.sum()), 1.0)
    rest = there.sum() - there
    others = np.where(rest > 0, (gone.sum() - gone) / np.where(rest > 0, rest, 1.0), fraction)
    sd = float(np.sqrt((k - 1) / k * ((others - others.mean()) ** 2).sum()))
    wide = float(student.ppf(0.95, k - 1)) * sd
    return fraction, (fraction - wide, min(fraction + wide, 1.0))
