"""Three simple rivals of the diagnosis, on its own residuals and alignment, so that only the rule differs.

BIC over single effects; one fit of all effects at once, the largest by its t statistic named; the effect
whose signature has the largest cosine with the residual. Each may also say "none"; none of them can say
"unknown", name a pair or give a set.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from simgap.attribution.posterior import fitted, forms, squares_left
from simgap.attribution.problem import Candidate, Gap
from simgap.effects import catalogue
from simgap.gap.diagnose import Diagnosis

LEVEL = 0.01  # chance of a healthy recording to be called otherwise, by each rival's own white-noise theory


def rival_verdicts(found: Diagnosis, excluded: Sequence[str]) -> tuple[dict[str, str], dict[str, float]]:
    """What each rival names ("none" where it sees no gap), and every single effect's held-out gain [nats].

    Gains are those of the whole catalogue, effects taken out of it included: they tell no rival anything,
    and the scorer needs them to say which effects lie above the detection floor.
    """
    gap = found.search.gap
    known = [c for c in gap.candidates if c.name in catalogue() and c.variance is None and c.name != "actual"]
    mine = [c for c in known if c.name not in excluded]
    verdicts = {"bic": _bic(gap, mine), "all_at_once": _together(gap, mine), "cosine": _cosine(gap, mine)}
    return verdicts, _gains(gap)


def _gains(gap: Gap) -> dict[str, float]:
    """Gain of held-out log-likelihood over the healthy model, trials left out one at a time; the best form of
    each effect. A spread's gain is that of its variance, which is not held out."""
    out: dict[str, float] = {}
    trials = np.unique(gap.rows.trial)
    folds = []
    for trial in trials:
        inside = gap.rows.trial == trial
        folds.append((forms(gap.taken(~inside)), forms(gap.taken(inside))))
    for j, c in enumerate(gap.candidates):
        gain = 0.0
        for train, judge in folds:
            plain, with_it = (fitted(train, effects) for effects in ((), (j,)))
            one = np.ones(judge.count.size)
            before = squares_left(judge, (), one, plain.x)[:-1].sum()
            after = squares_left(judge, (j,), one, with_it.x)[:-1].sum()
            gain += 0.5 * float(before - after) - 0.5 * float(judge.count @ judge.shift((j,)))
        out[c.name] = max(out.get(c.name, -np.inf), gain + c.evidence * (c.variance is not None))
    return out


def _columns(c: Candidate) -> tuple[np.ndarray, np.ndarray]:
    """A candidate's constant shift (n,) at neutral, and its derivatives."""
    return c.shift - c.jacobian @ (c.at - c.neutral), c.jacobian


def _least(residual: np.ndarray, push: np.ndarray) -> float:
    """Least sum of squares with standard normal coordinates."""
    bend = push.T @ push + np.eye(push.shape[1])
    pull = push.T @ residual
    return float(residual @ residual - pull @ np.linalg.solve(bend, pull))


def _bic(gap: Gap, known: Sequence[Candidate]) -> str:
    """Least sum of squares + parameters x log(number of residuals)."""
    n, best, least = gap.residual.size, "none", _least(gap.residual, gap.nuisance)
    for c in known:
        constant, push = _columns(c)
        square = _least(gap.residual - constant, np.concatenate([gap.nuisance, push], 1))
        if square + c.at.size * np.log(n) < least:
            best, least = c.name, square + c.at.size * np.log(n)
    return best


def _together(gap: Gap, known: Sequence[Candidate]) -> str:
    """One linear fit of all effects from the healthy optimum; the largest joint t statistic."""
    smooth = [c for c in known if np.abs(_columns(c)[0]).max() < 1e-6 or not catalogue()[c.name].switched]
    j = np.concatenate([gap.nuisance, *(c.jacobian for c in smooth)], 1)
    inverse = np.linalg.inv(j.T @ j + np.eye(j.shape[1]))
    value = inverse @ (j.T @ gap.residual)
    best, least, at = "none", LEVEL / max(len(smooth), 1), gap.nuisance.shape[1]
    for c in smooth:
        mine = np.arange(at, at + c.at.size)
        at += c.at.size
        square = float(value[mine] @ np.linalg.solve(inverse[np.ix_(mine, mine)], value[mine]))
        p = chi2.sf(square, mine.size)
        if p < least or (p == least == 0.0):
            best, least = c.name, p
    return best


def _cosine(gap: Gap, known: Sequence[Candidate]) -> str:
    """The largest share of the residual's length that lies in an effect's signature, properties aside."""
    own, _ = np.linalg.qr(gap.nuisance)
    rest = gap.residual - own @ (own.T @ gap.residual)
    if chi2.sf(float(rest @ rest), rest.size - gap.nuisance.shape[1]) > LEVEL:
        return "none"
    score: dict[str, float] = {}
    for c in known:
        constant, push = _columns(c)
        basis = np.column_stack([push, constant]) if np.abs(constant).max() > 1e-9 else push
        basis = basis - own @ (own.T @ basis)
        left, size, _ = np.linalg.svd(basis, full_matrices=False)
        left = left[:, size > 1e-8 * max(float(size.max()), 1e-30)]
        share = float(np.linalg.norm(left.T @ rest) / np.linalg.norm(rest))
        score[c.name] = max(score.get(c.name, 0.0), share)
    return max(score, key=lambda k: score[k])
