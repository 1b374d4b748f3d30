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
does not follow its equation is no reliable witness of it.) Unknowns have a flat prior in here; their own is
put in when they are drawn (`estimation.sampler`). The density of the scales is written once for NumPy, which
samples it, and JAX, which seeks its mode.

An unknown belongs to one channel and is eliminated there. What remains of a channel is a small quadratic
form in the shares e, f of all channels and the hand's deviations z, which depends on r_c = (k_c / s_c)^2
alone once 1 / s_c^2 is taken out. It is tabulated over log r_c, so that a density takes the same time
whatever the number of blocks, grips and trials.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from estimation import priors
from estimation.design import Design
from estimation.observations import CHANNELS
from hmmseg.jaxconfig import double_precision

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
    t = place - index  # Catmull and Rom's weights of the four neighbours
    weights = (0.5 * t * (t * (2 - t) - 1), 0.5 * (t**2 * (3 * t - 5) + 2), 0.5 * t * (t * (4 - 3 * t) + 1),
               0.5 * t**2 * (t - 1))  # fmt: skip
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
    of_shares = xp.log(common[:, :NUM_CHANNELS]) + xp.log(common[:, NUM_CHANNELS:])
    of_channels = 2 * tables.count[None] * log_s + log_det + of_shares
    out = log_prior(theta, tables.scale_sd, xp) - 0.5 * xp.sum(of_channels, axis=1)
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


def _solve(chol: Any, right: Any, xp: ModuleType) -> Any:
    """chol^-1 right, (W, S, S) and (W, S, 1)."""
    if xp is np:
        return np.linalg.solve(chol, right)
    from jax.lax.linalg import triangular_solve

    return triangular_solve(chol, right, left_side=True, lower=True)


BATCH = 256  # numerics: densities at once, to keep memory small


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
    def tables(self) -> Tables:
        """What the density of the scales is worked out from."""
        return _tabulate(self)

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

    @property
    def least_variance(self) -> np.ndarray:
        """Prior variances (6,) of the shares e and f that all grips have alike, where grips do not differ."""
        return np.concatenate([priors.COMMON**2, self.design.slope_sd**2])

    def common(self, theta: np.ndarray) -> np.ndarray:
        """Prior variances (..., 6) of the shares e and f that all grips have alike."""
        own = self.shares(theta) ** 2
        return self.least_variance + np.concatenate([own, own], axis=-1)

    def log_prob(self, theta: np.ndarray) -> np.ndarray:
        """Log posterior density (W,) of scales (W, 6), all else integrated out."""
        parts = [log_density(theta[k : k + BATCH], self.tables) for k in range(0, len(theta), BATCH)]
        return np.concatenate(parts)

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


def _tabulate(post: Posterior) -> Tables:
    num, grid = len(post.design.nuisances), np.exp(np.arange(REACH[0], REACH[1] + STEP, STEP))
    size = 1 + NUM_SHARES + num
    forms, log_det = np.zeros((NUM_CHANNELS, grid.size, size, size)), np.zeros((NUM_CHANNELS, grid.size))
    count, hand = np.zeros(NUM_CHANNELS), np.zeros((size, size))
    hand[1 + NUM_SHARES :, 1 + NUM_SHARES :] = post.hand_precision
    hand[0, 1 + NUM_SHARES :] = hand[1 + NUM_SHARES :, 0] = post.hand_gradient
    for c in range(NUM_CHANNELS):
        rows, shared, residual, which = post.channel_rows(c)
        if not len(rows):
            continue
        count[c] = len(rows) - which.size
        place = np.array([0, 1 + c, 1 + NUM_CHANNELS + c, *range(1 + NUM_SHARES, size)])
        every = np.concatenate([rows, residual[:, None], shared[:, num:], shared[:, :num]], axis=1)
        # At s = 1, with k^2 in units of its prior median's square on the grid, unknowns are eliminated.
        mine, num_q, width = post.rows.channel == c, which.size, every.shape[1]
        unit2 = (priors.SCATTER_MEDIAN[c] * post.rows.unit[mine]) ** 2
        variance = post.rows.variance[mine] + grid[:, None] * unit2  # G, n
        outer = (every[:, :, None] * every[:, None, :]).reshape(len(every), -1)
        normal = (1 / variance @ outer).reshape(len(grid), width, width)
        chol = np.linalg.cholesky(normal[:, :num_q, :num_q])
        cross = np.linalg.solve(chol, normal[:, :num_q, num_q:])
        halved = np.log(np.diagonal(chol, axis1=1, axis2=2)).sum(axis=1)
        log_det[c] = np.log(variance).sum(axis=1) + 2 * halved
        left = normal[:, num_q:, num_q:] - np.swapaxes(cross, 1, 2) @ cross
        forms[c][:, place[:, None], place] = left
    return Tables(forms, log_det, count, hand, post.least_variance, post.scale_sd)


TOLERANCE, MAX_STEPS = 1e-6, 256  # numerics: relative and absolute, of scales and density
PADDING = 8  # numerics: of deviations, rounded up to a multiple of it so that few programs are compiled
DIFFERENCE = 1e-3  # numerics: of the scales, all logarithms, for derivatives by central differences
STARTS = np.arange(-1.0, 9.0, 1.0)  # numerics: log(share / prior median); a large share is a mode of its own


@dataclass(frozen=True)
class Mode:
    """Mode (6,) of the scales and their covariance (6, 6); unknowns (Q,) there and theirs (Q, Q).

    The covariance of the unknowns holds at the scales' mode.
    """

    scales: np.ndarray
    covariance: np.ndarray
    unknowns: np.ndarray
    unknowns_covariance: np.ndarray
    converged: bool


@double_precision
def find_mode(post: Posterior) -> Mode:
    """Mode by optimistix's BFGS from the best of a few shares a channel; curvature by central differences."""
    steps = DIFFERENCE * np.eye(2 * NUM_CHANNELS)

    def gradient(x: np.ndarray) -> np.ndarray:
        up, down = np.split(post.log_prob(np.concatenate([x + steps, x - steps])), 2)
        return -(up - down) / (2 * DIFFERENCE)

    found = np.array(_climb()(start_of(post), padded(post.tables, PADDING)))
    hessian = np.array([(gradient(found + h) - gradient(found - h)) / (2 * DIFFERENCE) for h in steps])
    values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    covariance = (vectors / np.maximum(values, 0.1)) @ vectors.T
    mean, chol = post.given(found[None])
    num = len(post.design.unknowns)
    factor = np.linalg.inv(chol[0])[:, :num]
    slope = float(np.abs(gradient(found)).max())
    return Mode(found, covariance, post.reference + mean[0, :num], factor.T @ factor, slope < 1e-2)


@lru_cache
def _climb() -> Callable[[np.ndarray, Tables], Any]:
    """From a start (6,) to the density's next maximum (6,); one compiled program for each padded size.

    On the processor, whatever accelerator there is: six scales are not worth the way there.
    """
    import jax  # these are slow to import
    import jax.numpy as jnp
    import optimistix

    solver = optimistix.BFGS(rtol=TOLERANCE, atol=TOLERANCE)

    def loss(theta: Any, tables: Tables) -> Any:
        return -log_density(theta[None], tables, jnp)[0]

    def climb(start: Any, tables: Tables) -> Any:
        return optimistix.minimise(loss, solver, start, tables, max_steps=MAX_STEPS, throw=False).value

    # It runs for milliseconds: what optimising the program takes is more than what that could save.
    quickly_compiled = {"xla_backend_optimization_level": 0}
    program, processor = jax.jit(climb, compiler_options=quickly_compiled), jax.devices("cpu")[0]

    def on_processor(start: np.ndarray, tables: Tables) -> Any:
        with jax.default_device(processor):
            return program(start, tables)

    return on_processor


def start_of(post: Posterior) -> np.ndarray:
    """Scales (6,) from which to climb: each channel's share the best of STARTS, one after the other."""
    best = np.zeros(2 * NUM_CHANNELS)
    for c in range(NUM_CHANNELS):
        starts = np.repeat(best[None], STARTS.size, axis=0)
        starts[:, NUM_CHANNELS + c] = STARTS
        best = starts[int(np.argmax(post.log_prob(starts)))]
    return best
