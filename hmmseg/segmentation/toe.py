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

from hmmseg.segmentation.emissions import TAIL

SOFTS = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)  # numerics: N; loads at which the toe may end, a factor of two apart
DEPENDENT = 0.5  # prior: share of the samples of a stretch that are evidence of their own
DEPTH = 5e-4  # prior: m; sd of how deep a toe is
DECISIVE = 7.0  # chosen: nats for a toe against none: odds of a thousand to one
ROUNDS = 6  # numerics: of reweighting
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
    straight = _depth(readings, None, usual)[1]
    scale = max(usual, 1.4826 * float(np.median(np.abs(straight))))
    none = _evidence(straight, scale)
    found = []
    for soft in SOFTS:
        depth, residual = _depth(readings, soft, scale)
        gain = _evidence(residual, scale) - none - (depth / DEPTH) ** 2 / 2
        found.append((gain, Toe(depth, soft)))
    gain, toe = max(found, key=lambda pair: pair[0])
    return toe if gain > DECISIVE and toe.depth > 0 else NONE


def _evidence(residual: np.ndarray, scale: float) -> float:
    return -DEPENDENT * (TAIL + 1) / 2 * float(np.log1p((residual / scale) ** 2 / TAIL).sum())


def _depth(readings: Sequence[Reading], soft: float | None, scale: float) -> tuple[float, np.ndarray]:
    """Common depth [m] of a toe that ends at `soft` [N] (None: no toe), and residuals of all samples.

    Student-t, reweighted.
    """
    weights = [np.ones(load.size) for load, *_ in readings]
    toes = [np.zeros(r[0].size) if soft is None else Toe(1.0, soft).give(r[0]) for r in readings]
    depth, residuals = 0.0, []
    for _ in range(ROUNDS):
        bent, left = [], []
        for (load, value, _), toe, weight in zip(readings, toes, weights, strict=True):
            line = np.stack([np.ones(load.size), load], axis=1)
            solve = np.linalg.pinv(line * weight[:, None] ** 0.5) * weight**0.5
            bent.append(toe - line @ (solve @ toe))
            left.append(value - line @ (solve @ value))
        curved = sum(float(w @ b**2) for w, b in zip(weights, bent, strict=True)) + (scale / DEPTH) ** 2
        depth = -sum(float((w * b) @ v) for w, b, v in zip(weights, bent, left, strict=True)) / curved
        residuals = [v + depth * b for v, b in zip(left, bent, strict=True)]
        weights = [(TAIL + 1) / (TAIL + (r / scale) ** 2) for r in residuals]
    return depth, np.concatenate(residuals)
