"""How far the gap shrinks, nested: every trial is judged by a search that never saw it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from simgap.attribution.posterior import Forms, fitted, forms, squares_left
from simgap.attribution.problem import Gap
from simgap.attribution.search import sought


@dataclass(frozen=True)
class HowFar:
    """Mean squares of trials that took no part, `before` and `after`, the noise's own `noise_floor`, fixed
    beforehand; `fraction` of the gap that is gone, its 90 % interval by trial."""

    before: float
    after: float
    noise_floor: float
    fraction: float
    interval_90: tuple[float, float]


def how_far(gap: Gap, noise: np.ndarray) -> HowFar | None:
    """The nested shrinkage; `noise` (channels,): variance of each channel's noise. None with one trial."""
    trials = np.unique(gap.rows.trial)
    if trials.size < 2:
        return None
    before, after, floor = (np.zeros(trials.size) for _ in range(3))
    for k, trial in enumerate(trials):
        inside = gap.rows.trial == trial
        train, test = forms(gap.taken(~inside)), forms(gap.taken(inside))
        best = next((m for m in sought(train, 1) if any(gap.candidates[j].named for j in m.effects)), None)
        kept = () if best is None else tuple(j for j in best.effects if gap.candidates[j].named)
        model, empty = fitted(train, kept), fitted(train, ())
        weight = 1 / noise[_channels(test, gap, inside)]
        after[k] = _square(test, kept, weight, model.x)
        before[k] = _square(test, (), weight, _plain(train, gap, ~inside, noise))
        before[k] = min(before[k], _square(test, (), weight, empty.x))
        floor[k] = test.count.sum()
    gone, there = before - after, before - floor
    if float(there.sum()) <= 0:
        return None
    n = float(floor.sum())
    return HowFar(float(before.sum()) / n, float(after.sum()) / n, 1.0, *fraction_gone(gone, there))


def fraction_gone(gone: np.ndarray, there: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Share of the gap that is gone, of what is `gone` and what was `there` in K parts (K,), and its 90 %
    interval by the jackknife of a ratio (Tukey, Ann. Math. Stat. 29, 1958)."""
    k, fraction = gone.size, min(float(gone.sum() / there.sum()), 1.0)
    others = (gone.sum() - gone) / np.maximum(there.sum() - there, 1e-9)
    sd = float(np.sqrt((k - 1) / k * ((others - others.mean()) ** 2).sum()))
    wide = float(student.ppf(0.95, k - 1)) * sd
    return fraction, (fraction - wide, min(fraction + wide, 1.0))


def _square(f: Forms, effects: tuple[int, ...], weight: np.ndarray, x: np.ndarray) -> float:
    """Squares of the rows that a set leaves at x."""
    return float(squares_left(f, effects, weight, x)[:-1].sum())


def _channels(f: Forms, gap: Gap, inside: np.ndarray) -> np.ndarray:
    """The channel (G,) of each group of the rows inside."""
    out = np.zeros(f.count.size, int)
    out[f.spectrum.group] = gap.rows.channel[inside]
    return out


def _plain(f: Forms, gap: Gap, inside: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Nuisances (K,) that least squares find, without any effect."""
    weight = 1 / noise[_channels(f, gap, inside)]
    z = f.spectrum.num_nuisances
    bend = np.tensordot(weight, f.product[:, 1 : 1 + z, 1 : 1 + z], 1) + np.eye(z)
    return np.linalg.solve(bend, weight @ f.product[:, 0, 1 : 1 + z])
