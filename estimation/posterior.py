"""The posterior, all that enters linearly integrated out: a density of six scales.

Given the noise scale s_c and the share k_c of model error that differs from grip to grip, of each
channel c, all else is jointly Gaussian: properties, deviations of the hand z and the share e_c of
model error that all grips have alike,

    mean = A q + J z + unit (e_c + own) + N(0, s_c^2 variance),        own ~ N(0, k_c^2),
    slope = J z + e_c + own + f_c + other + N(0, s_c^2 variance),        other ~ N(0, k_c^2),
    z ~ N(0, 1) and as free motion has it,
    e_c ~ N(0, COMMON_c^2 + k_c^2),        f_c ~ N(0, slope_sd_c^2 + k_c^2).

(What all grips have alike no repeat can show. It is at least what the prior says and at least as
large as what differs between them. A slope shows the same shares as its grip's mean, but a grip that
does not follow its equation is no reliable witness of it.) An unknown q belongs to one channel, so it is
eliminated there: what remains of a channel is a small quadratic form in (z, e_c, f_c) that depends on
r_c = (k_c / s_c)^2 alone, once 1 / s_c^2 is taken out. It is tabulated over r_c, and log_prob takes the
same time whatever the number of blocks, grips and trials. Unknowns have a flat prior in here; their own
is put in when they are drawn (`estimation.sampler`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from estimation import priors
from estimation.design import Design
from estimation.observations import CHANNELS

NUM_CHANNELS = len(CHANNELS)
STEP = 0.25  # numerics: of the table, in log r: cubic interpolation is then exact to some 1e-5
FARTHEST = 9.0  # limit: of any scale from its prior median, all logarithms
REACH = (-18.0, 26.0)  # numerics: of the table about the prior median of log r; priors leave nothing beyond


@dataclass(frozen=True)
class Posterior:
    """Posterior of a design; scales theta are log s_c (3) and log(k_c / its prior median) (3).

    `reference` (Q,): least squares, about which all else is written to keep its digits. `rows` is the
    design with independent observations, `levers` (K, 2) what e and f move them by (`independent`).
    """

    design: Design
    reference: np.ndarray
    rows: Design
    levers: np.ndarray

    @cached_property
    def scale_sd(self) -> np.ndarray:
        """Prior sd (3,) of log s: the variance was learned from so many samples."""
        return 1 / np.sqrt(2 * np.maximum(self.design.scale_count, 1.0))

    @cached_property
    def hand_precision(self) -> np.ndarray:
        """Precision (N, N) of the deviations: their prior, and free motion."""
        d, num = self.design, len(self.design.nuisances)
        free = d.free_shifts.reshape(d.free_variance.size, num)
        return np.eye(num) + (free.T / d.free_variance.ravel()) @ free

    @cached_property
    def hand_gradient(self) -> np.ndarray:
        """Precision times mean (N,) of the deviations as free motion has them."""
        d = self.design
        free = d.free_shifts.reshape(d.free_variance.size, len(d.nuisances))
        return free.T @ (d.free_mean / d.free_variance).ravel()

    @cached_property
    def _tables(self) -> list[_Table]:
        return [_tabulate(self, c) for c in range(NUM_CHANNELS)]

    def channel_rows(self, c: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of one channel: rows A (n, Q_c), rows [J, levers] (n, N + 2), residuals (n,), which Q_c."""
        d, mine = self.rows, self.rows.channel == c
        which = np.array([i for i, u in enumerate(d.unknowns) if priors.CHANNEL[u.prop] == c], int)
        shared = np.concatenate([d.shifts[mine], self.levers[mine]], axis=1)
        rows = d.coefficients[mine][:, which]
        return rows, shared, d.mean[mine] - rows @ self.reference[which], which

    def shares(self, theta: np.ndarray) -> np.ndarray:
        """Share (..., 3) of model error that differs from grip to grip."""
        return priors.SCATTER_MEDIAN * np.exp(theta[..., NUM_CHANNELS:])

    def common(self, theta: np.ndarray) -> np.ndarray:
        """Prior variances (..., 6) of the shares e and f that all grips have alike."""
        own = self.shares(theta) ** 2
        return np.concatenate([priors.COMMON**2 + own, self.design.slope_sd**2 + own], axis=-1)

    def log_prior(self, theta: np.ndarray) -> np.ndarray:
        """Log prior (W,) of scales (W, 6), up to a constant."""
        out = -0.5 * ((theta[:, :NUM_CHANNELS] / self.scale_sd) ** 2).sum(axis=1)
        return out - 0.5 * ((theta[:, NUM_CHANNELS:] / priors.SCATTER_LOG_SD) ** 2).sum(axis=1)

    def log_prob(self, theta: np.ndarray) -> np.ndarray:
        """Log posterior density (W,) of scales (W, 6), all else integrated out, up to a constant.

        -inf beyond FARTHEST, where priors leave nothing and digits would run out.
        """
        near = (np.abs(theta) <= FARTHEST).all(axis=1)
        theta = np.clip(theta, -FARTHEST, FARTHEST)
        num = len(self.design.nuisances)
        size, log_s = num + 2 * NUM_CHANNELS, theta[:, :NUM_CHANNELS]
        common = self.common(theta)
        precision, gradient = np.zeros((len(theta), size, size)), np.zeros((len(theta), size))
        precision[:, :num, :num], gradient[:, :num] = self.hand_precision, self.hand_gradient
        out = self.log_prior(theta) - 0.5 * np.log(common).sum(axis=1)
        for c, table in enumerate(self._tables):
            for k in (c, NUM_CHANNELS + c):
                precision[:, num + k, num + k] += 1 / common[:, k]
            if not table.count:
                continue
            log_r = 2 * (theta[:, NUM_CHANNELS + c] - log_s[:, c])
            weight = np.exp(-2 * log_s[:, c])
            squares, log_det, quadratic, linear = table.at(log_r)
            mine = [*range(num), num + c, num + NUM_CHANNELS + c]
            precision[:, np.ix_(mine, mine)[0], np.ix_(mine, mine)[1]] += weight[:, None, None] * quadratic
            gradient[:, mine] += weight[:, None] * linear
            out -= 0.5 * (2 * table.count * log_s[:, c] + log_det + weight * squares)
        chol = np.linalg.cholesky(precision)
        white = np.linalg.solve(chol, gradient[..., None])[..., 0]
        out += 0.5 * (white**2).sum(axis=1) - np.log(np.diagonal(chol, axis1=1, axis2=2)).sum(axis=1)
        return np.where(near, out, -np.inf)

    def given(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (W, Q + N + 6) and Cholesky factor of the precision of (q, z, e, f) given scales (W, 6).

        q relative to `reference`. Worked out from all observations, without the table.
        """
        d = self.design
        num_q, num = len(d.unknowns), len(d.nuisances)
        size = num_q + num + 2 * NUM_CHANNELS
        hand = slice(num_q, num_q + num)
        precision, gradient = np.zeros((len(theta), size, size)), np.zeros((len(theta), size))
        precision[:, hand, hand], gradient[:, hand] = self.hand_precision, self.hand_gradient
        d, shares, common = self.rows, self.shares(theta), self.common(theta)
        for c in range(NUM_CHANNELS):
            rows, shared, residual, which = self.channel_rows(c)
            mine = [*which, *range(num_q, num_q + num), num_q + num + c, num_q + num + NUM_CHANNELS + c]
            every = np.concatenate([rows, shared], axis=1)
            own = d.channel == c
            variance = np.exp(2 * theta[:, [c]]) * d.variance[own] + (shares[:, [c]] * d.unit[own]) ** 2
            outer = (every[:, :, None] * every[:, None, :]).reshape(len(every), len(mine) ** 2)
            block = (1 / variance @ outer).reshape(len(theta), len(mine), len(mine))
            precision[:, np.array(mine)[:, None], np.array(mine)] += block
            gradient[:, mine] += (residual / variance) @ every
            for k, place in ((c, mine[-2]), (NUM_CHANNELS + c, mine[-1])):
                precision[:, place, place] += 1 / common[:, k]
        chol = np.linalg.cholesky(precision)
        mean = np.linalg.solve(np.swapaxes(chol, 1, 2), np.linalg.solve(chol, gradient[..., None]))
        return mean[..., 0], chol


def posterior(design: Design) -> Posterior:
    """The posterior of a design that determines at least one unknown."""
    sd = np.sqrt(design.variance)
    found, *_ = np.linalg.lstsq(design.coefficients / sd[:, None], design.mean / sd, rcond=None)
    return Posterior(design, found, *independent(design))


def independent(design: Design) -> tuple[Design, np.ndarray]:
    """The design with each grip's mean and slopes turned into as many independent rows; levers (K, 2).

    Their covariance is s^2 D + k^2 B, D diagonal, B = a a' + the slopes' own, a = unit of the mean, 1 of
    slopes: the eigenvectors of D^-1/2 B D^-1/2 make both diagonal whatever s and k. New rows have the
    variance of a grip's first row.
    """
    d = design
    lever = np.where(d.slope, 1.0, d.unit)
    levers = np.stack([lever, np.where(d.slope, 1.0, 0.0)], axis=1)
    out = {name: getattr(d, name).copy() for name in ("mean", "coefficients", "shifts", "variance", "unit")}
    keys = np.stack([d.trial, d.move, d.channel], axis=1)
    _, grip, sizes = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    by_grip = np.argsort(grip.ravel(), kind="stable")
    starts = np.cumsum(sizes) - sizes
    for size in np.unique(sizes):
        rows = by_grip[starts[sizes == size][:, None] + np.arange(size)]  # (grips, size)
        sd = np.sqrt(d.variance[rows[:, :1]] / d.variance[rows])  # of the first row, in units of each
        a = lever[rows] * sd
        own = a[:, :, None] * a[:, None, :] + np.eye(size) * (d.slope[rows] * sd**2)[:, None, :]
        values, vectors = np.linalg.eigh(own)
        for name in ("mean", "coefficients", "shifts"):
            given = getattr(d, name)[rows].reshape(*rows.shape, -1) * sd[..., None]
            turned = np.swapaxes(vectors, 1, 2) @ given
            out[name][rows] = turned.reshape(out[name][rows].shape)
        levers[rows] = np.swapaxes(vectors, 1, 2) @ (levers[rows] * sd[..., None])
        out["variance"][rows] = d.variance[rows[:, :1]]
        out["unit"][rows] = np.sqrt(np.maximum(values, 0.0))
    return replace(d, **out), levers


@dataclass(frozen=True)
class _Table:
    """One channel's unknowns eliminated, on a grid of log r: rows (G, 2 + (N + 2)^2 + (N + 2)).

    `count`: observations less unknowns. Columns: sum of squares, log determinants, quadratic form
    and linear term in (z, e, f), all for s = 1.
    """

    count: int
    values: np.ndarray

    def at(self, log_r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The columns at log r (W,), relative to the prior median, by Catmull and Rom's cubic."""
        place = np.clip((log_r - REACH[0]) / STEP, 1.0, len(self.values) - 3.001)
        index = place.astype(int)
        t = place - index
        weights = 0.5 * np.stack([
            t * (t * (2 - t) - 1), t**2 * (3 * t - 5) + 2, t * (t * (4 - 3 * t) + 1), t**2 * (t - 1)
        ])  # fmt: skip
        found = np.einsum("kw,kwf->wf", weights, self.values[index + np.arange(-1, 3)[:, None]])
        size = int(np.sqrt(found.shape[1] - 1.75) - 0.5)
        return found[:, 0], found[:, 1], found[:, 2:-size].reshape(-1, size, size), found[:, -size:]


def _tabulate(post: Posterior, c: int) -> _Table:
    rows, shared, residual, _ = post.channel_rows(c)
    if not len(rows):
        return _Table(0, np.zeros((0, 0)))
    mine = post.rows.channel == c
    unit2 = (priors.SCATTER_MEDIAN[c] * post.rows.unit[mine]) ** 2
    grid = np.exp(np.arange(REACH[0], REACH[1] + STEP, STEP))
    variance = post.rows.variance[mine] + grid[:, None] * unit2  # G, n
    every = np.concatenate([rows, shared, residual[:, None]], axis=1)
    size = every.shape[1]
    outer = (every[:, :, None] * every[:, None, :]).reshape(len(every), size**2)
    normal = (1 / variance @ outer).reshape(len(grid), size, size)
    num_q = rows.shape[1]
    chol = np.linalg.cholesky(normal[:, :num_q, :num_q])
    cross = np.linalg.solve(chol, normal[:, :num_q, num_q:])
    rest = normal[:, num_q:, num_q:] - np.swapaxes(cross, 1, 2) @ cross
    log_det = np.log(variance).sum(axis=1) + 2 * np.log(np.diagonal(chol, axis1=1, axis2=2)).sum(axis=1)
    quadratic = rest[:, :-1, :-1].reshape(len(grid), -1)
    values = np.concatenate([rest[:, -1:, -1], log_det[:, None], quadratic, rest[:, :-1, -1]], axis=1)
    return _Table(len(rows) - num_q, values)
