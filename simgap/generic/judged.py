"""Which effects of the best set are causes: they leave little where they act, and are the same everywhere.

Simulated forces differ from real ones in their whole course, and the best set has an effect for every way in
which they do. A bias of the sensor is the same bias in every subtask; what takes another value in each is an
imitation (random effects by subtask, as in `simgap.attribution.heldout`). And a cause takes most of the
gap where it acts, whatever is left elsewhere, which is told as the remainder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.attribution.heldout import OTHER, WANDER
from simgap.attribution.verdict import MOST
from simgap.generic.effects import EFFECTS, Scene
from simgap.generic.features import SLOW
from simgap.generic.fit import Block, EnsembleFit, at
from simgap.generic.locate import cell_means
from simgap.generic.shrinkage import Heldout


@dataclass(frozen=True)
class Judged:
    """`left`: share of the gap that is left where an effect acts; `same`: log Bayes factor [nats] of one
    cause against another in every subtask, by the slow course (0 where that does not tell)."""

    left: float
    same: float

    @property
    def cause(self) -> bool:
        """Whether it is a cause."""
        return self.left <= MOST and self.same >= 0.0


def judge(
    given: Scene, parts: Sequence[Block], found: EnsembleFit, numbers: tuple[int, int], held: Heldout,
    weight: np.ndarray, temperature: float,
) -> dict[str, Judged]:  # fmt: skip
    """Every effect of a set. `held`: what it leaves of held-out trials, `weight` (cells,) of what is asked.

    Where an effect acts is what its own shift takes of the mean difference, all others as they are: refitted
    without it, they would go wrong elsewhere in its stead."""
    after, before = held.after.mean(0), held.before.mean(0)
    floor = np.minimum(held.floor.mean(0), after)
    left = np.minimum((after - floor) / np.maximum(before - floor, 1e-12), 1.0)
    rest, out = found.difference - found.shift, {}
    variance = np.ones(rest.size)
    for block in parts:
        variance[block.index] = np.diag(block.covariance(*numbers))
    for name in found.effects:
        lacking = rest + _own_shift(given, parts, found, name)
        lost = np.maximum(cell_means(given.layout, (lacking**2 - rest**2) / variance), 0.0) * weight
        where = float(lost @ left / lost.sum()) if lost.sum() > 0 else 1.0
        out[name] = Judged(where, _same(given, parts, found, numbers, name, temperature))
    return out


def _own_shift(given: Scene, parts: Sequence[Block], found: EnsembleFit, name: str) -> np.ndarray:
    """What an effect of a set adds to the prediction (F,) of the others."""
    out = np.zeros(found.shift.size)
    for block, mine, u in zip(parts, found.slots, found.u, strict=True):
        own = np.array([s.effect == name for s in mine], bool)
        if own.any():
            others = np.where(own, 0.0, u)
            out[block.index] = at(given, block, mine, u) - at(given, block, mine, others)
    return out


def _same(
    given: Scene, parts: Sequence[Block], found: EnsembleFit, numbers: tuple[int, int], name: str,
    temperature: float,
) -> float:  # fmt: skip
    """Log Bayes factor of one cause against another in every subtask, all else of the set as it is."""
    if EFFECTS[name].each != "channel":
        return 0.0
    score = np.zeros(WANDER.size)
    pairs = [p for mine, u in zip(found.slots, found.u, strict=True) for p in zip(mine, u, strict=True)]
    every = [value for slot, value in pairs if slot.effect == name]
    least = 0.01 * float(np.mean(np.square(every)))  # as in attribution: a channel that hardly shows it
    for block, mine, u, raw in zip(parts, found.slots, found.u, found.raw, strict=True):
        own = np.array([s.effect == name for s in mine], bool)
        if not own.any() or not u[own].any():
            continue
        slow = given.layout.kind[block.index] == SLOW  # how power changes is told roughly
        subtask = given.layout.subtask[block.index]
        inverse = np.linalg.inv(block.covariance(*numbers)[np.ix_(slow, slow)]) / temperature
        split = np.concatenate([raw[:, own] * (subtask == k)[:, None] for k in np.unique(subtask)], 1)
        split = split[slow]
        bend = split.T @ inverse @ split
        pull = split.T @ inverse @ (found.difference - found.shift)[block.index][slow]
        usual = np.diag(np.tile(u[own] ** 2 + least, np.unique(subtask).size))
        for i, wander in enumerate(WANDER):
            prior = wander**2 * usual
            inner = np.eye(pull.size) + prior @ bend
            score[i] += 0.5 * pull @ np.linalg.solve(inner, prior @ pull) - 0.5 * np.linalg.slogdet(inner)[1]
    one, several = (
        np.logaddexp.reduce(score[k]) - np.log(k.sum()) for k in (WANDER < OTHER, WANDER >= OTHER)
    )
    return float(one - several)
