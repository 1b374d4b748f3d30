"""Forces rounded to a step: by how much every residual that they enter is in doubt.

A rounded reading is off by up to half a step, with a variance of step^2 / 12. While it stays on one level it
is off by the same, or, as a force passes slowly through the level, by what changes evenly from one half to
the other: errors within a plateau are alike or as good as independent (Widrow & Kollar, Quantization Noise,
2008, ch. 1 on slow signals). One is as likely here as the other. Through the pads that give, forces' errors
are those of distances as well.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dct

from simgap.gap.assemble import rows_of
from simgap.gap.problem import Problem
from simgap.gap.trial_arrays import CHANNELS

ALIKE = 0.5  # prior: share of a plateau's errors that are alike throughout it


def rounded_variance(given: Problem, step: float) -> np.ndarray:
    """Variance (n,) of the cosine coefficients of each cell, in the noise's, of forces rounded to `step` [N].

    Coefficients are in the order of `assemble.rows_of`.
    """
    frame, there = given.frame, given.whitening.weight > 0
    rows, sample, scale = rows_of(given), np.nonzero(there)[1], given.whitening.weight[there]
    shares, out = _shares(given), np.zeros(scale.size)
    levels = [_plateaus(force) for force in frame.forces]
    order = np.argsort(rows.cell, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(rows.cell[order])) + 1):
        trial, of_channel = rows.trial[mine[0]], shares[:, rows.channel[mine[0]]]
        group = frame.groups[trial]
        for k in np.flatnonzero(of_channel):
            weight = of_channel[k] * scale[mine]
            on = weight[:, None] * _on_plateaus(levels[trial][:, k], sample[mine], group)
            alike = np.square(np.asarray(dct(on, axis=0, norm="ortho"))).sum(1)
            out[mine] += ALIKE * alike + (1 - ALIKE) * np.mean(weight**2) / group
    return step**2 / 12 * out


def _shares(given: Problem) -> np.ndarray:
    """How much (4, C) of each force's error every channel has: net forces, and what pads give."""
    world, out = given.frame.world, np.zeros((4, len(CHANNELS)))
    for axis, give, place, apart, net, half in (
        (0, world.give_normal, "x", "distance", "fx", "grip"),
        (1, world.give_shear, "y", "offset", "fy", "shear"),
    ):
        for finger in (0, 1):
            for channel, share in (
                (place, give[finger] / 2), (apart, give[finger]), (net, 1.0), (half, 0.5)
            ):  # fmt: skip
                out[2 * finger + axis, CHANNELS.index(channel)] = share
    return out


def _plateaus(force: np.ndarray) -> np.ndarray:
    """The number (N, 4) of the plateau that each reading is on."""
    return np.cumsum(np.diff(force, axis=0, prepend=force[:1]) != 0, axis=0)


def _on_plateaus(level: np.ndarray, sample: np.ndarray, group: int) -> np.ndarray:
    """Share (m, R) of the readings behind each of m samples that is on each of R plateaus."""
    mine = level[sample[:, None] * group + np.arange(group)]
    number = mine - mine.min()
    out = np.zeros((sample.size, int(number.max()) + 1))
    np.add.at(out, (np.arange(sample.size)[:, None], number), 1 / group)
    return out[:, out.any(0)]
