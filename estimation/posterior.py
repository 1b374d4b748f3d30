"""Log posterior of properties, noise scales and systematic deviations, in JAX.

Parameters, one vector: log properties (P), log noise scales (3), log tau ratios (3), common
shifts (3, in prior sd) and deviations of the hand (N, in prior sd). Alignments are marginalised:
they were drawn from their posterior at the mode, so that by importance sampling

    log p(data | x) = sum over trials of log mean_s exp(l_s(x) - l_s(mode)) + constant.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimation import priors
from estimation.design import Design
from hmmseg import jaxconfig  # noqa: F401

NUM_CHANNELS = 3


class Data(NamedTuple):
    """The design as arrays of one compiled program; trials padded to a few sizes."""

    mean: Float[Array, "T S O"]
    variance: Float[Array, "T S O"]
    there: Float[Array, "T S O"]
    coefficients: Float[Array, "T S O P"]
    shifts: Float[Array, "T S O N"]
    channel: Float[Array, "O 3"]
    free_mean: Float[Array, "T 4"]
    free_precision: Float[Array, "T 4"]
    free_shifts: Float[Array, "T 4 N"]
    tau: Float[Array, " 3"]
    common: Float[Array, " 3"]
    scale_sd: Float[Array, " 3"]
    prior_mean: Float[Array, " P"]
    prior_sd: Float[Array, " P"]
    reference: Float[Array, "T S"]


def pack(design: Design) -> Data:
    """Arrays of the design, trials padded to a power of two with trials that say nothing."""
    num = design.mean.shape[0]
    extra = (1 << (num - 1).bit_length()) - num

    def padded(values: np.ndarray, fill: float = 0.0) -> jax.Array:
        pad = [(0, extra)] + [(0, 0)] * (values.ndim - 1)
        return jnp.asarray(np.pad(values.astype(float), pad, constant_values=fill))

    prior_mean, prior_sd = priors.property_priors(design.names)
    mean = padded(design.mean)
    return Data(
        mean=mean, variance=padded(design.variance, 1.0), there=padded(design.there),
        coefficients=padded(design.coefficients), shifts=padded(design.shifts),
        channel=jnp.eye(NUM_CHANNELS)[design.channel],
        free_mean=padded(design.free_mean), free_precision=padded(1 / design.free_variance),
        free_shifts=padded(design.free_shifts), tau=jnp.asarray(design.tau),
        common=jnp.asarray(design.common), scale_sd=jnp.asarray(1 / np.sqrt(2 * design.scale_count)),
        prior_mean=jnp.asarray(prior_mean), prior_sd=jnp.asarray(prior_sd),
        reference=jnp.zeros(mean.shape[:2]),
    )  # fmt: skip


Vector = Float[Array, "..."] | Float[np.ndarray, "..."]


def split(x: Vector, num_properties: int) -> tuple[Vector, Vector, Vector, Vector, Vector]:
    """Log properties, log scales, log tau ratios, common shifts and deviations, on the last axis."""
    p = num_properties
    return x[..., :p], x[..., p : p + 3], x[..., p + 3 : p + 6], x[..., p + 6 : p + 9], x[..., p + 9 :]


def log_likelihoods(x: Float[Array, " D"], data: Data) -> Float[Array, "T S"]:
    """Log likelihood of each trial's observations under each of its alignments."""
    log_properties, log_scale, log_tau, common, deviations = split(x, data.prior_mean.shape[0])
    predicted = data.coefficients @ jnp.exp(log_properties) + data.shifts @ deviations
    predicted = predicted + (data.channel @ (data.common * common))[None, None, :]
    scale2 = data.channel @ jnp.exp(2 * log_scale)
    tau2 = data.channel @ (data.tau * jnp.exp(log_tau)) ** 2
    variance = data.variance * scale2[None, None, :] + tau2[None, None, :]
    residual = data.mean - predicted
    terms = -0.5 * (residual**2 / variance + jnp.log(2 * jnp.pi * variance))
    return (terms * data.there).sum(axis=-1)


def log_prior(x: Float[Array, " D"], data: Data) -> Float[Array, ""]:
    """Log prior, free motion's word on the deviations included (no alignment changes it)."""
    log_properties, log_scale, log_tau, common, deviations = split(x, data.prior_mean.shape[0])
    out = -0.5 * (((log_properties - data.prior_mean) / data.prior_sd) ** 2).sum()
    out += -0.5 * ((log_scale / data.scale_sd) ** 2).sum()
    out += -0.5 * ((log_tau / priors.TAU_LOG_SD) ** 2).sum()
    out += -0.5 * (common**2).sum() - 0.5 * (deviations**2).sum()
    if deviations.size == 0:
        return out
    free = data.free_mean - data.free_shifts @ deviations
    return out - 0.5 * (free**2 * data.free_precision).sum()


def log_prob(x: Float[Array, " D"], data: Data) -> Float[Array, ""]:
    """Log posterior density of x up to a constant, alignments marginalised."""
    relative = log_likelihoods(x, data) - data.reference
    marginal = jax.nn.logsumexp(relative, axis=1) - jnp.log(relative.shape[1])
    return marginal.sum() + log_prior(x, data)


def mean_log_prob(x: Float[Array, " D"], data: Data) -> Float[Array, ""]:
    """As `log_prob`, the log likelihood averaged over alignments: what the mode is sought on."""
    return log_likelihoods(x, data).mean(axis=1).sum() + log_prior(x, data)


log_prob_batch = jax.jit(jax.vmap(log_prob, in_axes=(0, None)))
