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


def invariance(f: Forms, model: Model, effect: int, part: np.ndarray) -> Invariance:
    """How an effect of a set varies between parts; `part` (n,) numbers those of the rows from 0.

    What the set has besides it stays as it is. With one part, or no parameters, there is nothing to compare.
    """
    c, own = f.gap.candidates[effect], coordinates(f, model.effects)[effect]
    x, loose = model.x[own], ~model.at_bound[own]
    shared = np.array([n not in c.hidden for n in c.parameters], bool)
    parts = range(int(part.max()) + 1)
    names = c.neutral + c.scale * np.tile(x, (len(parts), 1))
    if len(parts) < 2 or not (loose & shared).any():
        return Invariance(0.0, 1.0, float("nan"), names, np.full(names.shape, np.nan))
    left = residual_left(f, model)
    weight = model.precision[f.spectrum.group]
    push = f.spectrum.columns[:, f.spectrum.own[effect][1:]][:, loose]
    usual = x[loose] ** 2 + 0.01 * float(x[loose] @ x[loose]) / loose.sum() + 1e-12
    if c.size is not None:
        given = (c.size / c.scale)[loose]
        usual = np.where(np.isfinite(given), given**2, usual)
    free = ~shared[loose]
    score, far = np.zeros(WANDER.size), 0.0
    estimates, sds = names.copy(), np.full(names.shape, np.nan)
    for p in parts:
        mine = part == p
        h = (push[mine] * weight[mine, None]).T @ push[mine]
        g = (push[mine] * weight[mine, None]).T @ left[mine]
        for i, wander in enumerate(WANDER):
            prior = np.diag(np.where(free, WANDER[-1], wander) ** 2 * usual)
            inner = np.eye(h.shape[0]) + prior @ h
            score[i] += 0.5 * g @ np.linalg.solve(inner, prior @ g) - 0.5 * np.linalg.slogdet(inner)[1]
        sure = h + 1e-6 * np.eye(h.shape[0]) * max(float(np.trace(h)), 1e-12)
        covariance = np.linalg.inv(sure)
        step = covariance @ g
        off = np.diag(np.where(free, WANDER[-1], c.form) ** 2 * usual)
        far += float(step @ np.linalg.solve(covariance + off, step))
        estimates[p, loose] += c.scale[loose] * step
        sds[p, loose] = c.scale[loose] * np.sqrt(np.diag(covariance))
    weight_of = np.exp(score - np.logaddexp.reduce(score))
    same, other = (c.form >= WANDER), (OTHER <= WANDER)
    one, several = (np.logaddexp.reduce(score[k]) - np.log(k.sum()) for k in (same, other))
    freedom = (len(parts) - 1) * int((loose & shared).sum())
    return Invariance(
        float(one - several), float(chi2.sf(far, freedom)), float(weight_of @ WANDER), estimates, sds
    )


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
