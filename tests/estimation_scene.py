"""A small linear-Gaussian design for tests of the posterior, its mode and its sampler."""

from dataclasses import replace

import numpy as np

from estimation import priors
from estimation.design import Design, Nuisance, Unknown

OBJECTS = ("left", "right")
PROPS = ("weight", "width", "height")
TRUE = np.array([0.4, 0.02, 0.015, 0.6, 0.03, 0.012])
SD = np.array([4e-3, 5e-6, 1e-5])  # of one mean, by channel
UNIT = np.array([0.5, 1.4e-3, 8e-5])  # what shares of model error are taken of


def ar1(num, length, rho, rng):
    """Series (num, length) of unit variance with autocorrelation rho^lag."""
    out = rng.normal(size=(num, length))
    for k in range(1, length):
        out[:, k] = rho * out[:, k - 1] + np.sqrt(1 - rho**2) * out[:, k]
    return out


def _unread(trial, rig, size):
    raise AssertionError("designs made here are complete")


def make_design(num_trials=4, seed=0, deviations=0, objects=OBJECTS, count=40.0):
    """A grip a trial for each object; deviations: a bias that free motion sees, a shift of widths."""
    rng = np.random.default_rng(seed)
    unknowns = tuple(Unknown(prop, {obj: 1}) for obj in objects for prop in PROPS)
    rows = [(t, m, c) for t in range(num_trials) for m in range(len(objects)) for c in range(3)]
    trial, move, channel = np.array(rows).T
    coefficients = np.zeros((len(rows), len(unknowns)))
    factor = np.where(channel == 0, 1 + 0.02 * rng.normal(size=len(rows)), 1.0)
    coefficients[np.arange(len(rows)), 3 * move + channel] = factor
    unit = UNIT[channel] * (1 + 0.1 * rng.normal(size=len(rows)))
    shifts, free_shifts = np.zeros((len(rows), deviations)), np.zeros((num_trials, 4, deviations))
    if deviations > 0:
        shifts[channel == 0, 0], free_shifts[:, 1, 0] = 0.02, 0.02
    if deviations > 1:
        shifts[channel == 1, 1] = 3e-5
    return Design(unknowns=unknowns,
                  nuisances=tuple(Nuisance(f"deviation.{i}", 1.0, 1.0, _unread) for i in range(deviations)),
                  mean=np.zeros(len(rows)), variance=SD[channel] ** 2 * rng.uniform(0.5, 2.0, size=len(rows)),
                  coefficients=coefficients, shifts=shifts, channel=channel, unit=unit, trial=trial,
                  move=move, slope=np.zeros(len(rows), bool), free_mean=np.zeros((num_trials, 4)),
                  free_variance=np.full((num_trials, 4), 2e-3**2), free_shifts=free_shifts,
                  scale_count=np.full(3, count))  # fmt: skip


def drawn(design, seed, properties=None, scales=None):
    """The design with data drawn, unknowns (Q,), scales (6,), deviations (N,), of priors if not given."""
    rng = np.random.default_rng([seed, 99])
    d, sd = design, 1 / np.sqrt(2 * design.scale_count)
    if scales is None:
        scatter = priors.SCATTER_LOG_SD * rng.normal(size=3)
        scales = np.concatenate([sd * rng.normal(size=3), scatter])
    properties = TRUE[: len(d.unknowns)] if properties is None else properties
    share = priors.SCATTER_MEDIAN * np.exp(scales[3:])
    common = np.hypot(priors.COMMON, share) * rng.normal(size=3)
    hand = rng.normal(size=len(d.nuisances))
    own = share[d.channel] * rng.normal(size=d.mean.size)
    noise = np.exp(scales[d.channel]) * np.sqrt(d.variance) * rng.normal(size=d.mean.size)
    mean = d.coefficients @ properties + d.shifts @ hand + d.unit * (common[d.channel] + own) + noise
    free = d.free_shifts @ hand + np.sqrt(d.free_variance) * rng.normal(size=d.free_mean.shape)
    return replace(d, mean=mean, free_mean=free), properties, scales, hand
