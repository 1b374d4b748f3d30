"""How far the gap shrinks on held-out trials once an effect is in the model."""

from __future__ import annotations

import numpy as np

from simgap.gap import judge
from simgap.gap.bank import Bank
from simgap.gap.candidate import Candidate, remainder
from simgap.gap.fit import Fitted, Problem, residual_at
from simgap.gap.freeform import heldout_square
from simgap.gap.locate import normal_score, subtask_name


def folds_of(given: Problem, f: Fitted) -> np.ndarray:
    """Labels (T, S) of what is held out together."""
    return judge.folds(f, given.frame.num_trials, _moves(given))


def shrinkage(
    given: Problem, healthy: Fitted, chosen: Candidate, before_z: np.ndarray, bank: Bank, seed: int
) -> dict:
    """Mean squared whitened residual on held-out blocks before and after, and the free-form ceiling."""
    n, f = given.frame.num_trials, chosen.fitted
    labels = folds_of(given, f)
    there = (given.whitening.weight > 0)[:n]
    member = given.whitening.member[:n]
    count = np.einsum("tns,tnc->ts", member, there.astype(float))
    before, after = judge.heldout(given, healthy, labels, n), judge.heldout(given, f, labels, n)
    if chosen.spread is not None:  # a spread explains the scatter it predicts, no more
        spared = residual_at(given, f.effects, f.u)[:n] ** 2 - remainder(given, chosen)[:n] ** 2
        after = after - np.einsum("tns,tnc->ts", member, spared)
    free = heldout_square(given, before_z, labels)
    # What ends below the floor has nothing left of the gap: healthy rigs differ by a few per cent.
    floor = min(bank.calibration.floor, float(after.sum() / count.sum()))

    def fraction(left: np.ndarray, rows: np.ndarray) -> float:
        base = before.ravel()[rows].sum() - floor * count.ravel()[rows].sum()
        rest = left.ravel()[rows].sum() - floor * count.ravel()[rows].sum()
        return float(1 - rest / base) if base > 0 else float("nan")

    rng, every = np.random.default_rng(seed), np.arange(before.size)
    resampled = [fraction(after, rng.integers(0, before.size, before.size)) for _ in range(300)]
    low, high = np.nanpercentile(resampled, (5, 95))
    total = count.sum()
    return {
        "evaluated_on": "held-out trials" if n > 1 else "held-out moves of one trial",
        "before": float(before.sum() / total),
        "after": float(after.sum() / total),
        "noise_floor": floor,
        "fraction": fraction(after, every),
        "interval_90": [float(low), float(high)],
        "flexible_ceiling": fraction(free, every),
        "by_subtask": _by_subtask(given, before, after, count, floor),
    }


def _by_subtask(
    given: Problem, before: np.ndarray, after: np.ndarray, count: np.ndarray, floor: float
) -> dict:
    """Fractions by subtask where there is a gap to shrink."""
    out = {}
    for s, step in enumerate(given.frame.steps):
        b, a, n = before[:, s].sum(), after[:, s].sum(), count[:, s].sum()
        if normal_score(b, n) > 3:
            out[f"{s + 1} {subtask_name(step)}"] = float(1 - (a - floor * n) / max(b - floor * n, 1e-9))
    return out


def _moves(given: Problem) -> np.ndarray:
    """The move (S,) that each subtask is held out with."""
    own = [s.move for s in given.frame.steps]
    return np.array([m if m is not None else 0 for m in own])
