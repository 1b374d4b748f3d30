"""A small linear-Gaussian design for tests of the posterior, its mode and its sampler."""

import numpy as np

from estimation.design import Design
from estimation.nuisance import Nuisance

NAMES = (("block", "weight"), ("block", "width"), ("block", "height"))
TRUE = np.array([0.4, 0.02, 0.015])
SD = np.array([4e-3, 5e-6, 1e-5])  # of one trial's means, by channel


def _unread(trial, rig, size):
    raise AssertionError("designs made here are complete")


def make_design(num_trials=4, num_alignments=4, seed=0, deviations=0, spread=0.0, tau=None, true=TRUE,
                count=40.0):  # fmt: skip
    """Design of one block, one grip a trial, means drawn from the model it stands for.

    Tests keep to the default shape where they can: every other one is compiled anew.

    `spread`: how far alignments move the means, in units of SD. `deviations` (at most 2): a bias of
    the force that free motion sees, and a shift of the width that nothing else sees.
    """
    rng = np.random.default_rng(seed)
    shape = (num_trials, num_alignments, 3)
    factor = 1 + 0.02 * rng.normal(size=num_trials)
    coefficients = np.zeros((*shape, 3))
    coefficients[:, :, 0, 0] = factor[:, None]
    coefficients[:, :, 1, 1] = 1.0
    coefficients[:, :, 2, 2] = 1.0
    size = rng.normal(size=deviations)
    shifts = np.zeros((*shape, deviations))
    free_shifts = np.zeros((num_trials, 4, deviations))
    free_sd = 2e-3
    if deviations > 0:
        shifts[:, :, 0, 0], free_shifts[:, 1, 0] = 0.02, 0.02
    if deviations > 1:
        shifts[:, :, 1, 1] = 3e-5
    noise = SD * rng.normal(size=(num_trials, 1, 3)) + spread * SD * rng.normal(size=shape)
    tau = 0.3 * SD if tau is None else tau
    noise = noise + tau * rng.normal(size=(num_trials, 1, 3))
    mean = coefficients @ true + shifts @ size + noise
    variance = np.broadcast_to(SD**2, shape).copy()
    nuisances = tuple(Nuisance(f"deviation.{i}", 1.0, 1.0, _unread) for i in range(deviations))
    return Design(
        names=NAMES, nuisances=nuisances,
        mean=mean, variance=variance, there=np.ones(shape, bool), coefficients=coefficients, shifts=shifts,
        channel=np.arange(3), free_mean=free_shifts @ size + free_sd * rng.normal(size=(num_trials, 4)),
        free_variance=np.full((num_trials, 4), free_sd**2), free_shifts=free_shifts, tau=tau,
        common=0.2 * SD, scale_count=np.full(3, count),
    )  # fmt: skip


def start_of(design, offset=0.0):
    """Start of the mode search at the true properties times e^offset, nothing else known."""
    return np.concatenate([np.log(TRUE) + offset, np.zeros(9 + len(design.nuisances))])
