"""Noise of each channel over the stated one, and gaps too small to matter."""

from __future__ import annotations

import numpy as np

from simgap.attribution.findings import SmallGap
from simgap.attribution.invariance import residual_left
from simgap.attribution.posterior import Forms, Model, channel_of, fitted
from simgap.attribution.problem import Rows

STATED = (0.6, 1.7)  # prior: bounds of a channel's noise over the stated one, in standard deviations


def noise_of(f: Forms, model: Model) -> np.ndarray:
    """Noise (channels,) over the stated one, sd: the median of the groups that a set leaves, by their counts.

    Groups where the model is off by itself are few: a median does not see them. Each is measured by the
    median of as many squares of noise, which is less than their mean (Wilson & Hilferty, PNAS 17, 1931).
    """
    count = np.maximum(f.count, 1)
    channel, ratio = channel_of(f), model.energy / (count * (1 - 2 / (9 * count)) ** 3)
    out = np.ones(len(f.gap.rows.channels))
    for c in np.unique(channel):
        mine = np.flatnonzero((channel == c) & (f.count >= 8))
        if mine.size >= 3:
            order = mine[np.argsort(ratio[mine])]
            share = np.cumsum(f.count[order]) / f.count[order].sum()
            out[c] = np.sqrt(ratio[order[np.searchsorted(share, 0.5)]])
    return np.clip(out, *STATED)


def stated(rows: Rows) -> np.ndarray:
    """The noise (channels,) that rows are measured by, over the stated one."""
    out = np.ones(len(rows.channels))
    for c in np.unique(rows.channel) if rows.sd is not None else ():
        out[c] = np.sqrt(np.mean(rows.sd[rows.channel == c] ** 2))  # type: ignore[index]
    return out


def small_gap(f: Forms, by_group: np.ndarray, tolerance: np.ndarray) -> SmallGap:
    """The gap's size, over what matters least, where it is largest."""
    before = residual_left(f, fitted(f, ()))
    rows = f.gap.rows
    key, inverse = np.unique(rows.channel * len(rows.parts) + rows.part, return_inverse=True)
    count = np.bincount(inverse).astype(float)
    noise = by_group[f.spectrum.group]
    excess = np.maximum(np.bincount(inverse, before**2) - np.bincount(inverse, noise), 0.0) / count
    chance = np.sqrt(2 / count) * np.bincount(inverse, noise) / count
    amount = np.sqrt(np.maximum(excess - 2 * chance, 0.0))
    sd = np.sqrt(np.bincount(inverse, np.ones(inverse.size) if rows.sd is None else rows.sd**2) / count)
    amount, least = amount * sd, np.bincount(inverse, tolerance) / count
    size = amount / least
    most = int(size.argmax())
    channel, part = divmod(int(key[most]), len(rows.parts))
    return SmallGap(float(size[most]), rows.channels[channel], rows.parts[part], float(amount[most]))
