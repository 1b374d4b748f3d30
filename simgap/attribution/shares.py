"""What share of the gap each effect of a set explains, and what is left: squares, the noise's taken off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simgap.attribution.posterior import Forms, Model, squares_left

DRAWS = 200  # numerics: of the posterior, for intervals


@dataclass(frozen=True)
class Shares:
    """`before`: squares of the residual with nuisances alone fitted, `after`: with the set, `floor`: the
    noise's own. `each`: draws (D, J of the set) of the share that each effect explains by itself. `inside`:
    share that is left where the set itself shifts anything."""

    before: float
    after: float
    floor: float
    each: np.ndarray
    inside: float

    @classmethod
    def of(
        cls, before: float, after: float, floor: float, lost: np.ndarray, rng: np.random.Generator,
        inside: float = 1.0,
    ) -> Shares:  # fmt: skip
        """Each effect has what is `lost` (J,) by leaving it out, in proportion: they and the remainder sum to
        one. Noise around what is left, and around what there was, makes the interval."""
        part = lost / max(float(lost.sum()), 1e-12)
        scatter = np.sqrt(2 * floor + 4 * max(after - floor, 0.0))
        drawn = after + scatter * rng.standard_normal(DRAWS)
        explained = np.clip((before - drawn) / max(before - floor, 1e-9), 0.0, 1.0)
        return cls(before, after, floor, explained[:, None] * part, inside)

    @property
    def remainder(self) -> float:
        """Share of the gap that the set leaves."""
        return float(np.clip((self.after - self.floor) / max(self.before - self.floor, 1e-9), 0.0, 1.0))

    def of_effect(self, k: int) -> tuple[float, tuple[float, float]]:
        """The share of the k-th effect, and its 90 % interval."""
        low, high = np.percentile(self.each[:, k], (5, 95))
        return float(self.each[:, k].mean()), (float(low), float(high))


def shares(f: Forms, model: Model, noise: np.ndarray, rng: np.random.Generator) -> Shares:
    """Shares of a set's effects; `noise` (G,): variance of each group's noise."""
    weight, count = 1 / noise, np.append(f.count, f.spectrum.num_nuisances)
    floor, by_group = float(count.sum()), squares_left(f, (), weight)
    before = float(by_group.sum())
    if not model.effects:
        return Shares(before, before, floor, np.zeros((DRAWS, 0)), 1.0)
    at_mode = squares_left(f, model.effects, weight, model.x)
    at_best = squares_left(f, model.effects, weight)
    rest = min(at_mode, at_best, key=lambda squares: float(squares.sum()))
    after = min(float(rest.sum()), before)
    lost = np.array([
        max(float(squares_left(f, tuple(j for j in model.effects if j != out), weight).sum()) - after, 0.0)
        for out in model.effects
    ])  # fmt: skip
    gone = np.maximum(by_group - at_mode, 0.0)
    left = np.clip((at_mode - count) / np.maximum(by_group - count, np.sqrt(2 * count + 1)), 0.0, 1.0)
    inside = float(gone @ left / gone.sum()) if gone.sum() > 0 else 1.0
    return Shares.of(before, after, floor, lost, rng, inside)
