"""Where the gap lies: excess of whitened residuals by trial, channel, subtask and frequency band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.fft import dct
from scipy.stats import gumbel_r

from hmmseg.contact.decompose import Subtask
from simgap.gap.fit import Problem
from simgap.gap.frame import CHANNELS

BANDS = (0.0, 1.0, 5.0)  # Hz; lower edges, the last band ends at half the sampling rate
ALARM = 0.01  # chance that a healthy recording is called otherwise
EVIDENCE = 1.5  # times the scale of a healthy recording's largest evidence: see docs/gap.md
# Of that chance; effects raise the evidence first.
SHARES = {"cell": 0.15, "pooled": 0.1, "coherent": 0.15, "gain": 0.6}
STATISTICS = tuple(SHARES)
RECURRING = 1.1  # margin of what recurs, as `Detection.margin` of the others
WAVES = 3  # cosines over a subtask, the mean the first, in which trials may err alike
BESIDE = 3.0  # sd; no sample beside a contact change counts for more, its contact may be the other one


@dataclass(frozen=True)
class Cell:
    """One cell: squared whitened residual over its `count` degrees of freedom, as a normal score `z`.

    `trial` and `subtask` are indices; `band` [Hz] is half-open.
    """

    trial: int
    channel: str
    subtask: int
    band: tuple[float, float]
    energy: float
    count: int
    z: float


def normal_score(energy: np.ndarray | float, count: np.ndarray | float) -> Any:
    """Chi-square of `count` degrees as a standard normal score (Wilson & Hilferty, PNAS 17, 1931)."""
    spread = 2 / (9 * np.maximum(count, 1))
    return (np.cbrt(np.asarray(energy) / np.maximum(count, 1)) - (1 - spread)) / np.sqrt(spread)


def tamed(given: Problem, z: np.ndarray) -> np.ndarray:
    """Whitened residuals z (T, N, C), those beside a contact change clipped at BESIDE.

    Such a sample may belong to the contact before or after: its residual has tails that no scale describes.
    """
    beside = (given.frame.arrays.kind % 2 == 1)[..., None]
    return np.where(beside, np.clip(z, -BESIDE, BESIDE), z)


def cells(given: Problem, z: np.ndarray) -> list[Cell]:
    """All cells of whitened residuals z (T, N, C), tamed, that hold anything."""
    frame, there = given.frame, given.whitening.weight > 0
    z = tamed(given, z)
    out = []
    for trial in range(frame.num_trials):
        step = float(np.median(np.diff(frame.world.t[trial, : frame.lengths[trial]])))
        edges = (*BANDS, 0.5 / step)
        for subtask in range(len(frame.steps)):
            inside = frame.arrays.subtask[trial] == subtask
            for c, channel in enumerate(CHANNELS):
                values = z[trial, inside & there[trial, :, c], c]
                if not values.size:
                    continue
                power = np.asarray(dct(values, norm="ortho")) ** 2
                frequency = np.arange(values.size) / (2 * values.size * step)
                band = np.searchsorted(np.array(edges[1:-1]), frequency, side="right")
                for b in np.unique(band):
                    energy, count = float(power[band == b].sum()), int((band == b).sum())
                    out.append(
                        Cell(
                            trial,
                            channel,
                            subtask,
                            (edges[b], edges[b + 1]),
                            energy,
                            count,
                            float(normal_score(energy, count)),
                        )
                    )
    return out


def pooled(found: list[Cell]) -> np.ndarray:
    """Scores of the cells with trials taken together."""
    table: dict[tuple, list[float]] = {}
    for cell in found:
        entry = table.setdefault((cell.channel, cell.subtask, cell.band[0]), [0.0, 0.0])
        entry[0] += cell.energy
        entry[1] += cell.count
    energy, count = np.array(list(table.values())).T
    return normal_score(energy, count)


def coherent(given: Problem, z: np.ndarray) -> np.ndarray:
    """Scores (..., cells) of what recurs in whitened residuals z (..., T, N, C): the trials' sum, not their
    squares'.

    A cell is a channel in a subtask, its residuals in each trial WAVES cosines over the subtask's length.
    """
    frame, there, z = given.frame, given.whitening.weight > 0, tamed(given, z)
    out = []
    for subtask in range(len(frame.steps)):
        inside = frame.arrays.subtask[: frame.num_trials] == subtask
        for c in range(len(CHANNELS)):
            rows = [z[..., r, inside[r] & there[r, :, c], c] for r in range(frame.num_trials)]
            waves = [
                np.asarray(dct(v, norm="ortho", axis=-1))[..., :WAVES] for v in rows if v.shape[-1] > WAVES
            ]
            if waves:
                out.append(normal_score((np.sum(waves, axis=0) ** 2).sum(-1) / len(waves), WAVES))
    return np.stack(out, -1)


@dataclass(frozen=True)
class Detection:
    """Gumbel distributions (location, scale) of the largest score of healthy recordings.

    `cell`: single cells; `pooled`: cells with trials taken together; `coherent`: what recurs in all of them;
    `gain`: log evidence of the best candidate over none. `margin` widens the first two, RECURRING the third
    and EVIDENCE the last: a recording is not our own simulation.
    """

    cell: tuple[float, float]
    pooled: tuple[float, float]
    coherent: tuple[float, float]
    gain: tuple[float, float]
    margin: float = 1.25

    def p_values(self, largest: dict[str, float]) -> dict[str, float]:
        """Chance of a healthy recording to exceed each of the given statistics."""
        out = {}
        for name, value in largest.items():
            location, scale, margin = self._of(name)
            out[name] = float(gumbel_r.sf(value / margin, location, scale))
        return out

    def p_value(self, largest: dict[str, float]) -> float:
        """Chance of a healthy recording to exceed any of them: Bonferroni's bound, weighted by SHARES."""
        return together(self.p_values(largest))

    def _of(self, name: str) -> tuple[float, float, float]:
        location, scale = getattr(self, name)
        if name == "gain":
            return location, scale * EVIDENCE, 1.0
        return location, scale, RECURRING if name == "coherent" else self.margin

    def threshold(self, name: str, level: float) -> float:
        """Value that a healthy recording exceeds with probability `level`."""
        location, scale, margin = self._of(name)
        return float(gumbel_r.isf(level, location, scale)) * margin


def together(p_values: dict[str, float]) -> float:
    """One chance of several: a weighted Bonferroni bound (Genovese et al., Biometrika 93, 2006)."""
    return min(1.0, sum(SHARES[n] for n in p_values) * min(p / SHARES[n] for n, p in p_values.items()))


def largest(found: list[Cell]) -> dict[str, float]:
    """The largest scores of `cells`."""
    return {"cell": max(c.z for c in found), "pooled": float(pooled(found).max())}


def raised(given: Problem, z: np.ndarray) -> dict[str, float]:
    """The largest scores of whitened residuals z (T, N, C): all STATISTICS but the evidence."""
    return {**largest(cells(given, z)), "coherent": float(coherent(given, z).max())}


def subtask_name(step: Subtask) -> str:
    """A subtask as the interface names it, as `carry block1`."""
    return step.name if step.object is None else f"{step.name} {step.object}"
