"""A cause is the same cause everywhere: whether an effect's parameters agree between parts of recordings.

In part p the parameters are theta + d_p, d_p ~ N(0, (wander theta)^2). An effect of the right form has a
small wander, one that merely fits changes sign or size from part to part. This is the random-effects model
of meta-analysis (DerSimonian & Laird, Controlled Clinical Trials 7, 1986) with its heterogeneity on a grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from simgap.attribution.posterior import Forms, Model, coordinates

WANDER = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5])  # prior: shares of the parameters
OTHER = 0.5  # chosen: wander from which on it is not one cause
SINGULAR = 1e-12  # numerics: share of the largest eigenvalue below which nothing is told
# cited: nats; "positive" evidence for one cause (Kass & Raftery, JASA 90, 1995)
POSITIVE = float(np.log(3.0))


@dataclass(frozen=True)
class Invariance:
    """`log_bayes_factor` [nats]: one cause against as many as there are parts; `p_value`: chance of one
    cause, its form off as usual, to differ so; `wander`: its posterior mean; `estimates`, `sds`
    (P, k) by part."""

    log_bayes_factor: float
    p_value: float
    wander: float
    estimates: np.ndarray
    sds: np.ndarray


@dataclass(frozen=True)
class _Parts:
    """An effect's parameters in each of P parts, in deviations over scale: those that are `loose` (k,) of
    bounds; their information `bend` (P, l, l) and `pull` (P, l) by which each part wants them elsewhere;
    `usual` (l,) square that a share of them is a share of; `free` (l,): those that may be others in every
    part."""

    loose: np.ndarray
    bend: np.ndarray
    pull: np.ndarray
    usual: np.ndarray
    free: np.ndarray

    def prior(self, wander: float) -> np.ndarray:
        """Covariance (l, l) of a part's deviation from the others."""
        return np.diag(np.where(self.free, WANDER[-1], wander) ** 2 * self.usual)

    def score(self) -> np.ndarray:
        """Log density of the parts' pulls at each of WANDER, but for a constant."""
        out = np.zeros(WANDER.size)
        for h, g in zip(self.bend, self.pull, strict=True):
            for i, wander in enumerate(WANDER):
                prior = self.prior(wander)
                inner = np.eye(h.shape[0]) + prior @ h
                out[i] += 0.5 * g @ np.linalg.solve(inner, prior @ g) - 0.5 * np.linalg.slogdet(inner)[1]
        return out


def _parts(f: Forms, model: Model, effect: int, part: np.ndarray) -> _Parts:
    """What each part says of an effect; `part` (n,) numbers those of the rows from 0. What the set has
    besides it stays as it is."""
    c, own = f.gap.candidates[effect], coordinates(f, model.effects)[effect]
    x, loose = model.x[own], ~model.at_bound[own]
    left, weight = residual_left(f, model), model.precision[f.spectrum.group]
    push = f.spectrum.columns[:, f.spectrum.own[effect][1:]][:, loose]
    usual = x[loose] ** 2 + 0.01 * float(x[loose] @ x[loose]) / max(loose.sum(), 1) + 1e-12
    if c.size is not None:
        given = (c.size / c.scale)[loose]
        usual = np.where(np.isfinite(given), given**2, usual)
    mine = [part == p for p in range(int(part.max()) + 1)]
    bend = np.stack([(push[m] * weight[m, None]).T @ push[m] for m in mine])
    pull = np.stack([(push[m] * weight[m, None]).T @ left[m] for m in mine])
    free = np.array([n in c.hidden for n in c.parameters], bool)[loose]
    return _Parts(loose, bend, pull, usual, free)


def invariance(f: Forms, model: Model, effect: int, part: np.ndarray) -> Invariance:
    """How an effect of a set varies between parts; `part` (n,) numbers those of the rows from 0.

    What the set has besides it stays as it is. With one part, or no parameters, there is nothing to compare.
    """
    c, own = f.gap.candidates[effect], coordinates(f, model.effects)[effect]
    found = _parts(f, model, effect, part)
    loose = found.loose
    names = c.neutral + c.scale * np.tile(model.x[own], (len(found.bend), 1))
    if len(found.bend) < 2 or not (~found.free).any():
        return Invariance(0.0, 1.0, float("nan"), names, np.full(names.shape, np.nan))
    far, estimates, sds = 0.0, names.copy(), np.full(names.shape, np.nan)
    for p, (h, g) in enumerate(zip(found.bend, found.pull, strict=True)):
        sure = h + 1e-6 * np.eye(h.shape[0]) * max(float(np.trace(h)), 1e-12)
        covariance = np.linalg.inv(sure)
        step = covariance @ g
        far += float(step @ np.linalg.solve(covariance + found.prior(c.form), step))
        estimates[p, loose] += c.scale[loose] * step
        sds[p, loose] = c.scale[loose] * np.sqrt(np.diag(covariance))
    score = found.score()
    weight_of = np.exp(score - np.logaddexp.reduce(score))
    same, other = (c.form >= WANDER), (OTHER <= WANDER)
    one, several = (np.logaddexp.reduce(score[k]) - np.log(k.sum()) for k in (same, other))
    freedom = (len(found.bend) - 1) * int((~found.free).sum())
    return Invariance(
        float(one - several), float(chi2.sf(far, freedom)), float(weight_of @ WANDER), estimates, sds
    )


def scatter_between(f: Forms, model: Model, effect: int, part: np.ndarray) -> np.ndarray:
    """Variance (k,) of an effect's deviations over scale that comes on top of the noise's, for what parts
    say of it differs by more: that of the mean of the random-effects model, over what it wanders by."""
    found = _parts(f, model, effect, part)
    out = np.zeros(found.loose.size)
    if len(found.bend) < 2 or not (~found.free).any():
        return out
    score, scatter = found.score(), []
    for i, wander in enumerate(WANDER):
        prior, one = found.prior(wander), np.eye(found.usual.size)
        inner = np.linalg.inv(one + found.bend @ prior)
        bend, pull = (inner @ found.bend).sum(0), np.einsum("pij,pj->i", inner, found.pull)
        size, axes = np.linalg.eigh(bend)
        told = size > SINGULAR * size.max()
        covariance = (axes[:, told] / size[told]) @ axes[:, told].T
        # The mean is known from the same parts (restricted likelihood: Patterson & Thompson, Biometrika 58).
        score[i] += 0.5 * float(pull @ covariance @ pull - np.log(size[told]).sum())
        scatter.append(np.diag(covariance))
    weight = np.exp(score - np.logaddexp.reduce(score))
    out[found.loose] = weight @ np.maximum(np.stack(scatter) - scatter[0], 0.0)
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
