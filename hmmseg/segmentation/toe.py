"""Contacts that are soft at first: what the recording shows of a give that is no straight line.

A rounded or a soft tip meets its block with a small patch that grows as it is pressed, so that the
first tenth of a newton moves it further than the last (Hertz 1882; fingertips of flesh and of rubber
alike: Pawluk and Howe 1999). Its give is a straight line behind a toe,

    give(load) = compliance x load + depth (1 - exp(-load / soft)).

What a straight line makes of such a contact ends it while it is still pressed: on a robot arm's stock pads
by 25 ms. Within each stretch at rest a straight line of its own is taken out, so that what differs between
contacts is no curvature; the depth is common to all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.levels import TAIL
from hmmseg.robust import robust_sd

SOFTS = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)  # numerics: N; loads at which the toe may end, a factor of two apart
DEPENDENT = 0.5  # prior: share of the samples of a stretch that are evidence of their own
DEPTH = 5e-4  # prior: m; sd of how deep a toe is
DECISIVE = 7.0  # chosen: nats for a toe against none: odds of a thousand to one
ROUNDS = 6  # numerics: of reweighting
LEVEL = 1e-28  # numerics: of the squares of loads that do not differ, what rounding leaves about their mean
Reading = tuple[np.ndarray, np.ndarray, float]


@dataclass(frozen=True)
class Toe:
    """What a contact gives beyond its straight line: `depth` [m], `soft` [N], of the load that is read."""

    depth: float = 0.0
    soft: float = 1.0

    def give(self, load: np.ndarray) -> np.ndarray:
        """Give [m] at each load [N]; none of a load below 0."""
        return self.depth * -np.expm1(-np.maximum(load, 0.0) / self.soft)

    @property
    def slope(self) -> float:
        """Compliance [m/N] that it adds to a contact that is hardly pressed."""
        return self.depth / self.soft


NONE = Toe()


def find(readings: Sequence[Reading]) -> Toe:
    """The toe that loads [N], values [m] and their noise [m] of each stretch show together; NONE if none.

    Loads are those of the contact itself, 0 where it ends.
    """
    readings = [r for r in readings if r[0].size > 3]
    if not readings:
        return NONE
    usual = float(np.median([sd for *_, sd in readings]))
    load, value, there = _padded(readings)
    straight = _depths(load, value, np.zeros((1, *load.shape)), there, usual)[1]
    scale = max(usual, robust_sd(straight[0][there]))
    toes = np.stack([Toe(1.0, soft).give(load) for soft in SOFTS])
    depth, residual = _depths(load, value, toes, there, scale)
    gain = _evidence(residual, there, scale) - _evidence(straight, there, scale) - (depth / DEPTH) ** 2 / 2
    best = int(gain.argmax())
    return Toe(float(depth[best]), SOFTS[best]) if gain[best] > DECISIVE and depth[best] > 0 else NONE


def _padded(readings: Sequence[Reading]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loads and values (num_stretches, N) of all stretches, and which are there; the rest is 0."""
    size = max(load.size for load, *_ in readings)
    there = np.arange(size) < np.array([load.size for load, *_ in readings])[:, None]
    out = np.zeros((2, *there.shape))
    for i in range(2):
        out[i][there] = np.concatenate([r[i] for r in readings])
    return out[0], out[1], there


def _evidence(residual: np.ndarray, there: np.ndarray, scale: float) -> np.ndarray:
    """Log-likelihoods (K,) of residuals (K, num_stretches, N)."""
    cost = np.log1p((residual / scale) ** 2 / TAIL) * there
    return -DEPENDENT * (TAIL + 1) / 2 * cost.sum(axis=(1, 2))


def _depths(
    load: np.ndarray, value: np.ndarray, toes: np.ndarray, there: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Common depth [m] (K,) of a toe of each shape (K, num_stretches, N), and residuals of all samples.

    Each stretch has a line of its own. Student-t, reweighted.
    """
    weight = np.broadcast_to(there, toes.shape).astype(float)
    for _ in range(ROUNDS):
        total = weight.sum(axis=-1, keepdims=True)
        x, bent, left = (v - (weight * v).sum(axis=-1, keepdims=True) / total for v in (load, toes, value))
        wx = weight * x
        spread = (wx * x).sum(axis=-1, keepdims=True)
        steep = spread > LEVEL * (weight * load**2).sum(axis=-1, keepdims=True)
        slope = wx / np.where(steep, spread, np.inf)
        bent = bent - (slope * bent).sum(axis=-1, keepdims=True) * x
        left = left - (slope * left).sum(axis=-1, keepdims=True) * x
        curved = (weight * bent**2).sum(axis=(1, 2)) + (scale / DEPTH) ** 2
        depth = -(weight * bent * left).sum(axis=(1, 2)) / curved
        residual = left + depth[:, None, None] * bent
        weight = there * ((TAIL + 1) / (TAIL + (residual / scale) ** 2))
    return depth, residual
