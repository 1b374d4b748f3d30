"""The density of the scales, written once for NumPy, which samples it, and JAX, which seeks its mode.

An unknown belongs to one channel and is eliminated there. What remains of a channel is a small quadratic
form in the shares e, f of all channels and the hand's deviations z, which depends on r_c = (k_c / s_c)^2
alone once 1 / s_c^2 is taken out. It is tabulated over log r_c, so that a density takes the same time
whatever the number of blocks, grips and trials.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from estimation import priors
from estimation.observations import CHANNELS

NUM_CHANNELS = len(CHANNELS)
NUM_SHARES = 2 * NUM_CHANNELS  # numerics: a normal and a shear give of each, by their definition
STEP = 0.25  # numerics: of the table, in log r: cubic interpolation is then exact to some 1e-5
FARTHEST = 9.0  # limit: of any scale from its prior median, all logarithms
REACH = (-18.0, 26.0)  # numerics: of the table about the prior median of log r; priors leave nothing beyond


class Tables(NamedTuple):
    """What the density of the scales is worked out from; NumPy arrays or JAX's.

    Quadratic forms are matrices over (1, e, f, z), S = 1 + 6 + N: the corner holds the sum of squares,
    the first row the linear terms. `forms` (3, G, S, S) and `log_det` (3, G) of each channel on the grid of
    log r, at s = 1; `count` (3,): observations less unknowns; `hand` (S, S): the deviations' prior and free
    motion; `least` (6,): variances that e and f have whatever k is; `scale_sd` (3,): prior sds of log s.
    """

    forms: Any
    log_det: Any
    count: Any
    hand: Any
    least: Any
    scale_sd: Any


def log_density(theta: Any, tables: Tables, xp: ModuleType = np) -> Any:
    """Log posterior density (W,) of scales (W, 6), all else integrated out, up to a constant.

    `xp`: numpy, or jax.numpy where theta and tables are JAX's. -inf beyond FARTHEST, where priors leave
    nothing and digits would run out.
    """
    near = xp.all(xp.abs(theta) <= FARTHEST, axis=1)
    theta = xp.clip(theta, -FARTHEST, FARTHEST)
    log_s, log_k = theta[:, :NUM_CHANNELS], theta[:, NUM_CHANNELS:]
    own = (priors.SCATTER_MEDIAN[None] * xp.exp(log_k)) ** 2
    common = tables.least[None] + xp.concatenate([own, own], axis=1)
    place = xp.clip((2 * (log_k - log_s) - REACH[0]) / STEP, 1.0, tables.log_det.shape[1] - 3.001)
    index = xp.floor(place)
    weights = _cubic(place - index)
    rows = [(np.arange(NUM_CHANNELS)[None], index.astype(int) + k) for k in (-1, 0, 1, 2)]
    log_det = sum(w * tables.log_det[at] for w, at in zip(weights, rows, strict=True))
    precision = xp.exp(-2 * log_s)
    form = sum(
        xp.sum((precision * w)[..., None, None] * tables.forms[at], axis=1)
        for w, at in zip(weights, rows, strict=True)
    )
    form = form + tables.hand[None]
    size = tables.hand.shape[0] - 1
    prior = xp.concatenate([1 / common, xp.zeros((len(theta), size - NUM_SHARES))], axis=1)
    chol = xp.linalg.cholesky(form[:, 1:, 1:] + prior[:, :, None] * np.eye(size)[None])
    white = _solve(chol, form[:, 1:, :1], xp)[..., 0]
    of_channels = 2 * tables.count[None] * log_s + log_det
    out = log_prior(theta, tables.scale_sd, xp) - 0.5 * xp.sum(of_channels + _paired(xp.log(common)), axis=1)
    out = out - 0.5 * (form[:, 0, 0] - xp.sum(white**2, axis=1))
    out = out - xp.sum(xp.log(xp.diagonal(chol, axis1=1, axis2=2)), axis=1)
    return xp.where(near, out, -np.inf)


def log_prior(theta: Any, scale_sd: Any, xp: ModuleType = np) -> Any:
    """Log prior (W,) of scales (W, 6), up to a constant."""
    noise, scatter = theta[:, :NUM_CHANNELS] / scale_sd[None], theta[:, NUM_CHANNELS:] / priors.SCATTER_LOG_SD
    return -0.5 * xp.sum(noise**2 + scatter**2, axis=1)


def padded(tables: Tables, multiple: int) -> Tables:
    """The same density with deviations that nothing shows, so that their number is a multiple."""
    more = -(tables.hand.shape[0] - 1 - NUM_SHARES) % multiple
    hand, added = np.pad(tables.hand, (0, more)), np.arange(more) + len(tables.hand)
    hand[added, added] = 1.0
    return tables._replace(hand=hand, forms=np.pad(tables.forms, ((0, 0), (0, 0), (0, more), (0, more))))


def _paired(of_shares: Any) -> Any:
    """Sums (W, 3) of what is said of e and of f (W, 6), by channel."""
    return of_shares[:, :NUM_CHANNELS] + of_shares[:, NUM_CHANNELS:]


def _cubic(t: Any) -> tuple[Any, Any, Any, Any]:
    """Weights of the four neighbours at a share t of the way between the middle two (Catmull and Rom)."""
    return (
        0.5 * t * (t * (2 - t) - 1), 0.5 * (t**2 * (3 * t - 5) + 2),
        0.5 * t * (t * (4 - 3 * t) + 1), 0.5 * t**2 * (t - 1),
    )  # fmt: skip


def _solve(chol: Any, right: Any, xp: ModuleType) -> Any:
    """chol^-1 right, (W, S, S) and (W, S, 1)."""
    if xp is np:
        return np.linalg.solve(chol, right)
    from jax.lax.linalg import triangular_solve

    return triangular_solve(chol, right, left_side=True, lower=True)
