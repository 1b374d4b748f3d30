"""Did a fingertip slip on its block? Evidence from where the pads' anchors lie while it rests.

While a block rests on its support, the place at which a pad holds it is at rest too: a fingertip's
height less its pad's shear deflection is constant unless the pad slips, and by Coulomb's law it
slips only where the ratio of shear to normal force has reached the friction coefficient, towards
the shear. Two Gaussian models of the anchors are compared for given coefficients:

- no slip: a constant, the sensors' noise, an error of the pad's stiffness, a slow random drift,
  and now and then a stretch that moves as it likes;
- slip: the same and a random motion in the direction of the shear, but only at ratios that reach
  the coefficient.

Drift is common to all grips, so that what creeps or yields everywhere is no slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from hmmseg.robust import robust_sd

PRIOR = 0.05  # prior: probability of slip before the anchors are seen
SURE = 0.99  # chosen: probability from which slip is said to be seen
STRAY = 0.1  # prior: share of stretches that move for reasons of their own: one alone proves nothing
STRAY_DRIFT = 2e-3  # prior: m per root second
SPEEDS = (5e-4, 1.5e-3, 5e-3)  # prior: m/s of a slipping pad
STUCK = 0.5  # prior: probability that a pad near its limit holds all the same
PERSISTENCE = 0.01  # prior: s over which the speed of a slipping pad varies
DRIFTS = (0.0, 3e-5, 1e-4, 3e-4)  # prior: m per root second
DRIFT_PRIOR = (0.5, 0.3, 0.15, 0.05)  # prior: of these: most pads hold still
ANYWHERE = 0.01  # prior: m; prior sd of an anchor's height
NEAR = 2.5  # chosen: noise sds below the coefficient at which a sample may slip


@dataclass(frozen=True)
class Stretch:
    """One finger on one resting block, arrays (num_samples,).

    `t` [s], `anchor` [m] (height less nominal shear deflection) and its noise `sd` [m], `shear`
    [N], `ratio` of shear to normal force (signed) and its noise `ratio_sd`; `compliance` [m/N] is
    the standard deviation of the pad's error.
    """

    t: np.ndarray
    anchor: np.ndarray
    sd: np.ndarray
    shear: np.ndarray
    ratio: np.ndarray
    ratio_sd: np.ndarray
    compliance: float


@dataclass(frozen=True)
class SlipEvidence:
    """Posterior probability of slip, the log Bayes factor behind it, and whether slip was seen."""

    probability: float
    log_bayes_factor: float
    seen: bool


@dataclass(frozen=True)
class _Batch:
    """Stretches of one length after padding, arrays (num_stretches, longest)."""

    t: np.ndarray
    anchor: np.ndarray
    variance: np.ndarray
    shift: np.ndarray
    there: np.ndarray


def slip_evidence(
    stretches: Sequence[Stretch], others: Sequence[Stretch], bound_draws: np.ndarray
) -> SlipEvidence:
    """Slip of one block's grips, its coefficient being its bound: draws (num_draws,).

    `others`: stretches with other blocks, which tell how much anchors drift without slip.
    """
    stretches = [s for s in stretches if s.t.size > 2]
    every = _rescaled([*stretches, *(s for s in others if s.t.size > 2)])
    if not stretches:
        return SlipEvidence(PRIOR, 0.0, False)
    count, batch = len(stretches), _padded(every)
    stray = _log_likelihood(batch, STRAY_DRIFT) + np.log(STRAY)
    still = np.stack([_log_likelihood(batch, drift) for drift in DRIFTS]) + np.log(1 - STRAY)
    still = np.logaddexp(still, stray)
    log_drift = np.log(np.asarray(DRIFT_PRIOR))[:, None]
    moved = []
    for coefficient in np.quantile(bound_draws, (0.1, 0.5, 0.9)):
        own = still.copy()
        own[:, :count] = _may_slip(batch, still, *_slip_path(every[:count], float(coefficient), batch))
        moved.append(own)
    joint = log_drift.T + np.sum(moved, axis=2)
    factor = float(logsumexp(joint) - np.log(len(moved)) - logsumexp(log_drift[:, 0] + still.sum(axis=1)))
    odds = factor + np.log(PRIOR / (1 - PRIOR))
    probability = float(1 / (1 + np.exp(-np.clip(odds, -700, 700))))
    return SlipEvidence(probability, factor, probability > SURE)


def _rescaled(stretches: list[Stretch]) -> list[Stretch]:
    """Anchor noise raised to what second differences show, where the stated noise is too small."""
    bends = [np.diff(s.anchor, 2) / s.sd[1:-1] for s in stretches if s.t.size > 3]
    if not bends:
        return stretches
    shown = robust_sd(np.concatenate(bends)) / np.sqrt(6.0)
    return [replace(s, sd=s.sd * max(shown, 1.0)) for s in stretches]


def _padded(stretches: list[Stretch]) -> _Batch:
    shape = (len(stretches), max(s.t.size for s in stretches))
    out = _Batch(np.zeros(shape), np.zeros(shape), np.ones(shape), np.zeros(shape), np.zeros(shape, bool))
    for i, s in enumerate(stretches):
        n = s.t.size
        out.t[i, :n], out.variance[i, :n], out.there[i, :n] = s.t - s.t[0], s.sd**2, True
        out.anchor[i, :n] = s.anchor - np.median(s.anchor)
        out.shift[i, :n] = s.compliance * (s.shear - s.shear.mean())
    return out


def _slip_path(stretches: list[Stretch], coefficient: float, batch: _Batch) -> tuple[np.ndarray, np.ndarray]:
    """Time [s] during which each pad may have slipped until each sample, and the same signed by shear.

    Arrays (len(stretches), longest stretch).
    """
    time, signed = np.zeros((2, len(stretches), batch.t.shape[1]))
    for i, s in enumerate(stretches):
        near = np.sign(s.ratio) * (np.abs(s.ratio) >= coefficient - NEAR * s.ratio_sd)
        sign = np.where(near[1:] != 0, near[1:], near[:-1])
        steps = np.diff(s.t)
        time[i, 1 : s.t.size] = np.cumsum(steps * np.abs(sign))
        signed[i, 1 : s.t.size] = np.cumsum(steps * sign)
    return time, signed


def _may_slip(batch: _Batch, still: np.ndarray, time: np.ndarray, signed: np.ndarray) -> np.ndarray:
    """Log density (num_drifts, num_stretches) where each pad slips at some speed or is stuck."""
    out = still[:, : len(time)].copy()
    near = np.flatnonzero(time.any(axis=1))
    if near.size == 0:
        return out
    chosen = _Batch(*(values[near] for values in vars(batch).values()))
    for i, drift in enumerate(DRIFTS):
        moving = [_log_likelihood(chosen, drift, v, time[near], signed[near]) for v in SPEEDS]
        slips = logsumexp(moving, axis=0) + np.log((1 - STUCK) / len(SPEEDS))
        out[i, near] = np.logaddexp(slips, out[i, near] + np.log(STUCK))
    return out


def _log_likelihood(
    batch: _Batch, drift: float, speed: float = 0.0,
    time: np.ndarray | None = None, signed: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Log density (num_stretches,) of the anchors under one drift and one speed of slip."""
    there = batch.there[:, :, None] & batch.there[:, None, :]
    covariance = ANYWHERE**2 + batch.shift[:, :, None] * batch.shift[:, None, :]
    covariance += drift**2 * np.minimum(batch.t[:, :, None], batch.t[:, None, :])
    residual = batch.anchor
    if time is not None and signed is not None:
        covariance += speed**2 * PERSISTENCE * np.minimum(time[:, :, None], time[:, None, :])
        residual = residual - speed * signed
    covariance = np.where(there, covariance, 0.0) + batch.variance[:, :, None] * np.eye(there.shape[1])
    # Padding has unit variance and no residual, so it adds nothing to either term.
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, residual[:, :, None])[:, :, 0]
    diagonal = np.diagonal(factor, axis1=1, axis2=2)
    size = batch.there.sum(axis=1)
    return -0.5 * (white**2).sum(axis=1) - np.log(diagonal).sum(axis=1) - 0.5 * size * np.log(2 * np.pi)
