"""What the largest statistics of healthy recordings would be on this very frame: a linearised bootstrap.

Whitened residuals of a healthy recording are standard normal. Draws of them, less what the refit of the
properties absorbs, give the cells' scores; the linearised fit of every effect gives its evidence. What
the whole pipeline adds (alignment, the model's own error) is not in it, so it is only used to compare two
frames (simgap/gap/adapt.py). Parametric bootstrap: Davison & Hinkley, Bootstrap Methods, 1997, ch. 4.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dct

from simgap.effects import catalogue
from simgap.gap.fit import Fitted, Problem, derivatives
from simgap.gap.frame import CHANNELS
from simgap.gap.judge import Calibration
from simgap.gap.locate import BANDS, STATISTICS, Detection, coherent, normal_score, tamed

DRAWS = 400
NARROWEST = 0.3  # scale of a Gumbel distribution at least: a few values may lie close by chance
# The same of evidence, half a chi-square over the temperature: its tail falls by e in so much, while the
# quartiles only see what the best of all effects loses by its volume.
TAIL = 1 / Calibration().temperature


def gumbel(values: np.ndarray, least: float = NARROWEST) -> tuple[float, float]:
    """Location and scale of a Gumbel distribution by quartiles: a brushed block in one case is no rule."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    scale = max(float(high - low) / (np.log(np.log(4)) - np.log(np.log(4 / 3))), least)
    return round(float(middle + scale * np.log(np.log(2))), 3), round(float(scale), 3)


def distribution(drawn: dict[str, np.ndarray]) -> Detection:
    """Gumbel distributions of the draws of every statistic."""
    least = {name: TAIL if name == "gain" else NARROWEST for name in STATISTICS}
    learned = {name: gumbel(drawn[name], least[name]) for name in STATISTICS}
    return Detection(**learned, margin=Detection.margin)


def statistics(given: Problem, healthy: Fitted, draws: int = DRAWS, seed: int = 0) -> dict[str, np.ndarray]:
    """Draws (D,) of every one of STATISTICS of healthy recordings.

    `healthy` is the fit of properties alone, about which everything is linearised.
    """
    z = np.random.default_rng(seed).standard_normal((draws, given.size))
    own = derivatives(given, (), healthy.u)
    return {**largest_scores(given, refitted(z, own)), "gain": _largest_evidence(given, healthy, z, own)}


def refitted(z: np.ndarray, push: np.ndarray) -> np.ndarray:
    """Residuals (D, n) after a linear refit by derivatives `push` (n, K), coordinates standard normal.

    Minimises |z + push d|^2 + |d|^2: what is left is z - push (1 + push' push)^-1 push' z.
    """
    step = np.linalg.solve(push.T @ push + np.eye(push.shape[1]), (z @ push).T)
    return z - (push @ step).T


def largest_scores(given: Problem, z: np.ndarray) -> dict[str, np.ndarray]:
    """`locate.largest` and the largest `coherent` score of many draws (D, n) of the residuals that exist."""
    frame, there = given.frame, given.whitening.weight > 0
    every = np.zeros((len(z), *there.shape))
    every[:, there] = z
    again = coherent(given, every)
    every = tamed(given, every)
    single: list[np.ndarray] = []
    together: dict[tuple[int, int, int], list] = {}
    for trial in range(frame.num_trials):
        step = float(np.median(np.diff(frame.world.t[trial, : frame.lengths[trial]])))
        for subtask in range(len(frame.steps)):
            inside = frame.arrays.subtask[trial] == subtask
            for c in range(len(CHANNELS)):
                values = every[:, trial, inside & there[trial, :, c], c]
                count = values.shape[1]
                if not count:
                    continue
                power = np.asarray(dct(values, norm="ortho", axis=1)) ** 2
                band = np.searchsorted(BANDS[1:], np.arange(count) / (2 * count * step), side="right")
                for b in np.unique(band):
                    energy, number = power[:, band == b].sum(axis=1), int((band == b).sum())
                    single.append(normal_score(energy, number))
                    entry = together.setdefault((c, subtask, int(b)), [0.0, 0])
                    entry[0], entry[1] = entry[0] + energy, entry[1] + number
    pooled = [normal_score(energy, number) for energy, number in together.values()]
    return {"cell": np.max(single, axis=0), "pooled": np.max(pooled, axis=0), "coherent": again.max(-1)}


def _largest_evidence(given: Problem, healthy: Fitted, z: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Largest log evidence [nats] (D,) of a single effect over none, linearised where it is absent.

    As `judge.log_evidence`. Effects that shift nothing to first order are left out, and those that change the
    equations by being there.
    """
    best = np.full(len(z), -np.inf)
    gain, volume = _gain(z, own)
    for name, effect in catalogue().items():
        possible = given.frame.rig.jointed or effect.acts_on != "kinematics"
        if effect.correct is None or not effect.chosen or effect.switched or not possible:
            continue
        push = derivatives(given, (name,), healthy.u)
        if not np.isfinite(push).all():
            raise FloatingPointError(f"{name} has no derivative where it is absent")
        if np.any(push[:, given.num_properties :]):
            more, larger = _gain(z, push)
            best = np.maximum(best, more - gain - 0.5 * (larger - volume))
    return best


def _gain(z: np.ndarray, push: np.ndarray) -> tuple[np.ndarray, float]:
    """Tempered gain in log posterior (D,) of a linear fit, and the log determinant of its curvature."""
    temperature, one = Calibration().temperature, np.eye(push.shape[1])
    slope, bend = z @ push, push.T @ push
    gain = 0.5 * (slope * np.linalg.solve(bend + one, slope.T).T).sum(axis=1)
    return gain / temperature, float(np.linalg.slogdet(bend / temperature + one)[1])
