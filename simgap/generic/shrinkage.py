"""How far the gap shrinks on real trials that took no part in the fit.

Each real trial in turn is left out, the effects are fitted to the others (one Gauss-Newton step from the
fit to all), and what they leave of the left-out trial is taken in units of the scatter between trials.
With one real trial subtasks are left out instead. The ceiling is the free-form discrepancy: the mean
difference of the other trials, feature by feature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.generic.effects import Scene
from simgap.generic.fit import Block, EnsembleFit, at
from simgap.generic.locate import both_variances, cell_means

RESAMPLES = 1000  # numerics: of a bootstrap


@dataclass(frozen=True)
class Heldout:
    """Mean squares (R, cells) in units of the scatter: without effects, with them, of the free-form
    discrepancy, and what trials without a gap would show; `score` [nats] of the effects over none."""

    before: np.ndarray
    after: np.ndarray
    free: np.ndarray
    floor: np.ndarray
    score: float


def heldout(
    given: Scene, parts: Sequence[Block], real: np.ndarray, sim: np.ndarray, found: EnsembleFit
) -> Heldout:
    """Squares of every real trial predicted from the others (from the other subtasks where it is alone)."""
    layout, count = given.layout, len(real)
    a, b = both_variances(layout, real, sim)
    variance = a + b / len(sim)
    difference = real - sim.mean(0)
    shift = np.zeros_like(difference)
    for fold in range(count if count > 1 else len(layout.ensembles.subtasks)):
        if count > 1:
            shift[fold] = _shift(given, parts, found, np.delete(difference, fold, 0).mean(0),
                                 (count - 1, len(sim)), np.ones(layout.kind.size, bool))  # fmt: skip
        else:
            kept = layout.subtask != fold
            shift[0, ~kept] = _shift(given, parts, found, difference[0], (1, len(sim)), kept)[~kept]
    if count > 1:
        others = (real.sum(0) - real) / (count - 1)
        free = (real - others) ** 2
        floor = free * (count - 1) / count + sim.var(0, ddof=min(1, len(sim) - 1)) / len(sim)
    else:
        free = difference**2
        floor = np.broadcast_to(variance, difference.shape)
    squares = (difference**2, (difference - shift) ** 2, free, floor)
    mean = [cell_means(layout, s / variance) for s in squares]
    score = 0.0
    for block in parts:
        inverse = np.linalg.inv(block.covariance(1, len(sim)))
        for d, s in zip(difference[:, block.index], shift[:, block.index], strict=True):
            score += 0.5 * float(d @ inverse @ d - (d - s) @ inverse @ (d - s))
    return Heldout(mean[0], mean[1], mean[2], mean[3], score)


def _shift(
    given: Scene, parts, found: EnsembleFit, difference: np.ndarray, numbers, kept: np.ndarray
) -> np.ndarray:
    """Predicted shift of all features (F,) from a fit to the features `kept` of another difference."""
    out = np.zeros(difference.size)
    for k, block in enumerate(parts):
        mine, u = found.slots[k], found.u[k]
        if not mine:
            continue
        zero = at(given, block, mine, np.zeros(len(mine)))
        inside = kept[block.index]
        raw = found.raw[k][inside]
        rest = (difference[block.index] - found.shift[block.index])[inside]
        inverse = np.linalg.inv(block.covariance(*numbers)[np.ix_(inside, inside)])
        step = np.linalg.solve(raw.T @ inverse @ raw + np.eye(u.size), raw.T @ inverse @ rest - u)
        low, high = np.array([[s.kind.low, s.kind.high] for s in mine]).T
        out[block.index] = at(given, block, mine, np.clip(u + step, low, high)) - zero
    return out


def sizes(found: Heldout, counts: np.ndarray) -> tuple[float, float, float, float]:
    """Mean squares before, after, of the free-form discrepancy and of the floor, features weighed alike.

    What ends below the floor has nothing left of the gap: the floor is then what is left.
    """
    before, after, free, floor = (
        float(np.average(x.mean(0), weights=counts))
        for x in (found.before, found.after, found.free, found.floor)
    )
    return before, after, free, min(floor, after)


def fraction(before: float, left: float, floor: float) -> float:
    """Share of the excess that is gone; NaN where there is none."""
    return 1 - (left - floor) / (before - floor) if before > floor else float("nan")


def shrinkage(given: Scene, found: Heldout, seed: int) -> dict:
    """The JSON entry: overall, with a 90 % interval from resampling real trials, and by cell."""
    layout, counts = given.layout, np.bincount(given.layout.cell)
    before, after, free, floor = sizes(found, counts)
    rng, n = np.random.default_rng(seed), len(found.before)
    drawn = []
    for _ in range(RESAMPLES if n > 1 else 0):
        chosen = rng.integers(0, n, n)
        one = Heldout(found.before[chosen], found.after[chosen], found.free[chosen], found.floor[chosen], 0.0)
        b, a, _, f = sizes(one, counts)
        drawn.append(fraction(b, a, f))
    interval = np.nanpercentile(drawn, (5, 95)).tolist() if drawn else [None, None]
    by_cell = {}
    for k, (c, s, low, high) in enumerate(layout.cells):
        b, a, f = (float(x[:, k].mean()) for x in (found.before, found.after, found.floor))
        if b - f > 3:
            name = layout.ensembles.channels[c] if c >= 0 else "duration"
            by_cell[f"{name}, {layout.ensembles.subtasks[s]}, {low:.3g}-{high:.3g} Hz"] = fraction(
                b, a, min(f, a)
            )
    return {
        "evaluated_on": "held-out trials" if n > 1 else "held-out subtasks of one trial",
        "before": before, "after": after, "noise_floor": floor,
        "fraction": fraction(before, after, floor), "interval_90": interval,
        "flexible_ceiling": fraction(before, free, min(floor, free)) if n > 1 else None,
        "by_cell": by_cell,
    }  # fmt: skip
