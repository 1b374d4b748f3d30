"""The posterior of six scales, with everything that enters linearly integrated out.

Given the noise scale s_c and the share k_c of model error that differs between grips, for each channel c,
everything else is jointly Gaussian: properties q, deviations of the hand z, and the share e_c of model error
common to all grips,

    mean = A q + J z + unit (e_c + own) + N(0, s_c^2 variance),        own ~ N(0, k_c^2),
    slope = J z + e_c + own + f_c + other + N(0, s_c^2 variance),        other ~ N(0, k_c^2),
    z ~ N(0, 1), and forces in free motion,
    e_c ~ N(0, COMMON_c^2 + k_c^2),        f_c ~ N(0, slope_sd_c^2 + k_c^2).

(Repeated grips cannot show their common share. It is at least as large as its prior, and as the share that
differs between grips. A slope shares the model error of its grip's mean, but a grip that deviates from its
equation is no reliable witness of it.) Unknowns have a flat prior here; their own is applied when they are
drawn (`estimation.sampler`). The density of the scales is written once for NumPy, which samples it, and JAX,
which finds its mode.
"""

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
FARTHEST = 9.0  # limit: of any scale from its prior median, all logarithms


class Model(NamedTuple):
    """A design as one linear model with S coefficients b = (q, z, e, f); arrays of NumPy or JAX.

    `residual` = `matrix` b + noise of variance s^2 `variance` + (k `unit`)^2, rows independent."""

    residual: Any  # (K,)
    matrix: Any  # (K, S)
    products: Any  # (K, S (S + 1) / 2) of the matrix's columns
    variance: Any  # (K,)
    unit: Any  # (K,)
    of: Any  # (3, K): 1 if a row is of a channel
    precision: Any  # (S, S) of b from the prior of deviations and free motion, whatever the scales
    gradient: Any  # (S,) likewise
    shares: Any  # (6, S): 1 if a coefficient is a share
    least: Any  # (6,) prior variances of the shares if grips do not differ
    scale_sd: Any  # (3,) prior sds of log s


def normal_equations(theta: Any, model: Model, xp: ModuleType = np) -> tuple[Any, Any, Any]:
    """Precision (W, S, S) of b at theta (W, 6), precision times mean (W, S), log density without b (W,)."""
    share = priors.SCATTER_MEDIAN[None] * xp.exp(theta[:, NUM_CHANNELS:])
    variance = xp.exp(2 * theta[:, :NUM_CHANNELS] @ model.of) * model.variance[None]
    weight = 1 / (variance + (share @ model.of * model.unit[None]) ** 2)
    common = model.least[None] + xp.concatenate([share, share], axis=1) ** 2
    prior = (1 / common) @ model.shares
    place, size = np.zeros(model.precision.shape, int), len(model.precision)
    place[np.triu_indices(size)] = np.arange(model.products.shape[1])
    precision = (weight @ model.products)[:, np.maximum(place, place.T)]
    precision = precision + model.precision[None] + prior[:, :, None] * np.eye(size)[None]
    gradient = (weight * model.residual[None]) @ model.matrix + model.gradient[None]
    rest = xp.sum(xp.log(weight) - weight * model.residual[None] ** 2, 1) - xp.sum(xp.log(common), 1)
    return precision, gradient, rest / 2


def log_density(theta: Any, model: Model, xp: ModuleType = np) -> Any:
    """Log posterior density (W,) of scales (W, 6), all else integrated out, up to a constant. `xp`: numpy, or
    jax.numpy if theta and the model are JAX's. -inf beyond FARTHEST, where the priors are negligible and
    precision would be lost."""
    near = xp.all(xp.abs(theta) <= FARTHEST, axis=1)
    theta = xp.clip(theta, -FARTHEST, FARTHEST)
    precision, gradient, rest = normal_equations(theta, model, xp)
    chol = xp.linalg.cholesky(precision)
    white = xp.linalg.solve(chol, gradient[..., None])[..., 0]
    out = log_prior(theta, model.scale_sd, xp) + rest + xp.sum(white**2, axis=1) / 2
    return xp.where(near, out - xp.sum(xp.log(xp.diagonal(chol, axis1=1, axis2=2)), axis=1), -np.inf)


def log_prior(theta: Any, scale_sd: Any, xp: ModuleType = np) -> Any:
    """Log prior (W,) of scales (W, 6), up to a constant."""
    noise, scatter = theta[:, :NUM_CHANNELS] / scale_sd[None], theta[:, NUM_CHANNELS:] / priors.SCATTER_LOG_SD
    return -0.5 * xp.sum(noise**2 + scatter**2, axis=1)


def padded(model: Model, rows: int, coefficients: int) -> Model:
    """The same density with uninformative rows and coefficients, so that their numbers are multiples."""
    k, s = -model.matrix.shape[0] % rows, -model.matrix.shape[1] % coefficients
    matrix, precision = np.pad(model.matrix, ((0, k), (0, s))), np.pad(model.precision, (0, s))
    added = np.arange(s) + len(model.precision)
    precision[added, added] = 1.0
    return model._replace(
        residual=np.pad(model.residual, (0, k)), matrix=matrix, products=_products(matrix),
        variance=np.pad(model.variance, (0, k), constant_values=1.0), unit=np.pad(model.unit, (0, k)),
        of=np.pad(model.of, ((0, 0), (0, k))), precision=precision, gradient=np.pad(model.gradient, (0, s)),
        shares=np.pad(model.shares, ((0, 0), (0, s))),
    )  # fmt: skip


def _products(matrix: np.ndarray) -> np.ndarray:
    row, column = np.triu_indices(matrix.shape[1])
    return matrix[:, row] * matrix[:, column]


BATCH = 256  # numerics: densities at once, to keep memory small


@dataclass(frozen=True)
class Posterior:
    """Posterior of a design; theta: log s_c, log(k_c / its prior median); `reference` (Q,): least squares."""

    design: Design
    reference: np.ndarray

    @property
    def scale_sd(self) -> np.ndarray:
        """Prior sd (3,) of log s, given the number of samples behind the variance."""
        return 1 / np.sqrt(2 * np.maximum(self.design.scale_count, 1.0))

    @cached_property
    def model(self) -> Model:
        """The linear model behind the density of the scales."""
        rows, levers = independent(self.design)
        of = np.eye(NUM_CHANNELS)[rows.channel]
        shared = (of[:, None, :] * levers[:, :, None]).reshape(len(of), 2 * NUM_CHANNELS)
        matrix = np.concatenate([rows.coefficients, rows.shifts, shared], axis=1)
        size, (num_q, num) = matrix.shape[1], (len(rows.unknowns), len(rows.nuisances))
        hand, free = slice(num_q, num_q + num), rows.free_shifts.reshape(rows.free_mean.size, num)
        precision, gradient = np.zeros((size, size)), np.zeros(size)
        precision[hand, hand] = np.eye(num) + (free.T / rows.free_variance.ravel()) @ free
        gradient[hand] = free.T @ (rows.free_mean / rows.free_variance).ravel()
        return Model(
            rows.mean - rows.coefficients @ self.reference, matrix, _products(matrix), rows.variance,
            rows.unit, of.T, precision, gradient, np.eye(size)[num_q + num :],
            np.concatenate([priors.COMMON**2, rows.slope_sd**2]), self.scale_sd,
        )  # fmt: skip

    def log_prob(self, theta: np.ndarray) -> np.ndarray:
        """Log posterior density (W,) of scales (W, 6), all else integrated out."""
        parts = [log_density(theta[k : k + BATCH], self.model) for k in range(0, len(theta), BATCH)]
        return np.concatenate(parts)

    def given(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (W, Q + N + 6), q relative to `reference`, and Cholesky factor of the precision."""
        precision, gradient, _ = normal_equations(theta, self.model)
        return np.linalg.solve(precision, gradient[..., None])[..., 0], np.linalg.cholesky(precision)


def posterior(design: Design) -> Posterior:
    """The posterior of a design that determines at least one unknown."""
    sd = np.sqrt(design.variance)
    q = np.linalg.lstsq(design.coefficients / sd[:, None], design.mean / sd, rcond=None)[0]
    return Posterior(design, q)


def independent(design: Design) -> tuple[Design, np.ndarray]:
    """Transform each grip's mean and slopes into as many independent rows, with levers (K, 2).

    Their covariance is s^2 D + k^2 B, D diagonal, B = a a' + the slopes' own, where a is the unit for the
    mean and 1 for slopes: the eigenvectors of D^-1/2 B D^-1/2 diagonalise both for all s and k. The new rows
    have the variance of a grip's first row."""
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


TOLERANCE, MAX_STEPS = 1e-6, 256  # numerics: relative and absolute, of scales and density
PADDING = 32, 8  # numerics: multiples for rows and coefficients, so that few programs are compiled
DIFFERENCE = 1e-3  # numerics: step in the log scales for central differences
STARTS = np.arange(-1.0, 9.0, 1.0)  # numerics: log(share / prior median); a large share is a mode of its own


@dataclass(frozen=True)
class Mode:
    """Mode (6,) of the scales, their covariance (6, 6), unknowns (Q,) there and their own (Q, Q)."""

    scales: np.ndarray
    covariance: np.ndarray
    unknowns: np.ndarray
    unknowns_covariance: np.ndarray
    converged: bool


@double_precision
def find_mode(post: Posterior) -> Mode:
    """Mode by optimistix's BFGS from the best of a few shares per channel; curvature by differences."""
    steps = DIFFERENCE * np.eye(2 * NUM_CHANNELS)

    def gradient(x: np.ndarray) -> np.ndarray:
        up, down = np.split(post.log_prob(np.concatenate([x + steps, x - steps])), 2)
        return -(up - down) / (2 * DIFFERENCE)

    mode = np.array(_climb()(start_of(post), padded(post.model, *PADDING)))
    hessian = np.array([(gradient(mode + h) - gradient(mode - h)) / (2 * DIFFERENCE) for h in steps])
    values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    covariance = (vectors / np.maximum(values, 0.1)) @ vectors.T
    mean, chol = post.given(mode[None])
    num = len(post.design.unknowns)
    factor = np.linalg.inv(chol[0])[:, :num]
    slope = float(np.abs(gradient(mode)).max())
    return Mode(mode, covariance, post.reference + mean[0, :num], factor.T @ factor, slope < 1e-2)


@lru_cache
def _climb() -> Callable[[np.ndarray, Model], Any]:
    """Map a start (6,) to the nearest maximum (6,) of the density, on the CPU; one program a padded size."""
    import jax  # these are slow to import
    import jax.numpy as jnp
    import optimistix

    solver: optimistix.BFGS[Any, Any, Any] = optimistix.BFGS(rtol=TOLERANCE, atol=TOLERANCE)

    def loss(theta: Any, model: Model) -> Any:
        return -log_density(theta[None], model, jnp)[0]

    def climb(start: Any, model: Model) -> Any:
        return optimistix.minimise(loss, solver, start, model, max_steps=MAX_STEPS, throw=False).value

    # It runs for milliseconds, less than optimising the program would take.
    quickly_compiled = {"xla_backend_optimization_level": 0}
    program, processor = jax.jit(climb, compiler_options=quickly_compiled), jax.devices("cpu")[0]

    def on_processor(start: np.ndarray, model: Model) -> Any:
        with jax.default_device(processor):
            return program(start, model)

    return on_processor


def start_of(post: Posterior) -> np.ndarray:
    """Initial scales (6,): each channel's share the best of STARTS, one after the other."""
    best = np.zeros(2 * NUM_CHANNELS)
    for c in range(NUM_CHANNELS):
        starts = np.repeat(best[None], STARTS.size, axis=0)
        starts[:, NUM_CHANNELS + c] = STARTS
        best = starts[int(np.argmax(post.log_prob(starts)))]
    return best
