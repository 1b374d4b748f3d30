"""What rows that took no part say of a cause: whether they bear it out, whether they tell it from another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import t as student

from simgap.attribution.posterior import Forms, fitted, forms, quadratic_forms
from simgap.attribution.problem import Gap
from simgap.robots.linear import Linear

FOLDS = 6  # numerics: parts that are held out in turn; each fit keeps five sixths
BORNE_OUT = 0.05  # chosen: chance of held-out gains as good without any
EVEN = 0.5  # chosen: the same of a bet: held-out rows are sooner for it than against it


def folds_of(linear: Linear, num_logs: int, groups: Sequence[int] | None = None) -> np.ndarray:
    """The fold (N,) of each row: logs, dealt out in turn; windows of one or two logs in stretches. With
    `groups` (num_logs,), logs of one number are held out together."""
    if groups is not None:
        return np.unique(np.asarray(groups)[linear.rows.log], return_inverse=True)[1]
    if num_logs >= 3:
        return linear.rows.log % min(num_logs, FOLDS)
    stretches = max(2, FOLDS // num_logs)
    out = np.zeros(linear.rows.log.size, int)
    for log in range(num_logs):
        mine = linear.rows.log == log
        window = linear.rows.window[mine]
        first, count = int(window.min()), int(np.ptp(window)) + 1
        out[mine] = log * stretches + (window - first) * stretches // count
    return np.unique(out, return_inverse=True)[1]


def held_out_scores(gap: Gap, sets: Sequence[tuple[int, ...]], fold: np.ndarray) -> np.ndarray:
    """Log likelihood (folds, sets) of each fold's rows, every set fitted to the others."""
    numbers = np.unique(fold)
    out = np.zeros((numbers.size, len(sets)))
    for k, number in enumerate(numbers):
        inside = fold == number
        train, test = forms(gap.taken(~inside)), forms(gap.taken(inside))
        for i, effects in enumerate(sets):
            out[k, i] = _log_likelihood(test, effects, fitted(train, effects).x)
    return out


def _log_likelihood(f: Forms, effects: tuple[int, ...], x: np.ndarray) -> float:
    """Of rows at parameters x, the background averaged over; what each log has of its own is fitted to them,
    as no other log tells it."""
    taken = quadratic_forms(f, effects)
    own = list(f.gap.own)
    if own:
        x, count = x.copy(), 1.0 + np.maximum(taken.energy(x) / f.count - 1.0, 0.0)
        bend, pull = taken.weighed(1 / count)
        x[own] = 0.0
        x[own] = np.linalg.solve(bend[np.ix_(own, own)] + np.eye(len(own)), (pull - bend @ x)[own])
    return float(f.background.marginal(taken.energy(x), f.count, taken.shift)[0].sum())


def _chances(gain: np.ndarray) -> np.ndarray:
    """Chance (sets,) of gains (folds, sets) [nats] as good without any: one-sided t test over folds.

    Gains beyond a nat count by their logarithm: one log in which a cause shows a hundred times as much as in
    the others must not make the others' agreement look like scatter.
    """
    gains = np.arcsinh(gain)
    sd = np.maximum(gains.std(0, ddof=1), 1e-9) / np.sqrt(len(gains))
    return student.sf(gains.mean(0) / sd, len(gains) - 1)


def chance_of(gain: np.ndarray) -> float:
    """Chance that a set gains as much over another on held-out rows (folds,) without being any better; of one
    fold, which tells nothing, none."""
    return 0.0 if gain.size < 2 else float(_chances(gain[:, None])[0])


def weakest(gap: Gap, effects: Sequence[int], fold: np.ndarray, most: float = BORNE_OUT) -> int | None:
    """Of a set's effects that held-out rows do not bear out beside the others the one that gains least; None
    where all are, by a chance of less than `most`."""
    kept = tuple(sorted(effects))
    if not kept or np.unique(fold).size < 2:
        return None
    whole = tuple(range(len(kept)))
    sets = [whole, *(tuple(j for j in whole if j != out) for out in whole)]
    score = held_out_scores(gap.only(kept), sets, fold)
    gain = score[:, :1] - score[:, 1:]
    failing = _chances(gain) >= most
    least = np.where(failing, np.arcsinh(gain).mean(0), np.inf)
    return kept[int(least.argmin())] if failing.any() else None


def borne_out(gap: Gap, effects: Sequence[int], fold: np.ndarray, most: float = BORNE_OUT) -> tuple[int, ...]:
    """Of a set's effects those that held-out rows bear out beside the others, as in `weakest`, which goes
    first."""
    kept = tuple(sorted(effects))
    while (out := weakest(gap, kept, fold, most)) is not None:
        kept = tuple(j for j in kept if j != out)
    return kept
