"""The unconstrained rival: a Gaussian hidden Markov model that switches freely among contact states.

Three states with diagonal Gaussian emissions on grip, net force and mean velocity, any state to
any other, fitted to the trial by EM (Rabiner, Proc. IEEE 77(2), 1989). Which state is which contact
is read off the fitted means; the order of the subtasks plays no part until the path is found.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND
from hmmseg.hand.signals import Signals
from hmmseg.hmm.dense import viterbi
from hmmseg.segmentation.features import noise_sd, thin
from hmmseg.segmentation.fit import otsu
from hmmseg.segmentation.thresholds import NUMBERS, StateLabels

ITERATIONS = 40
STATES = 3
START = np.log(np.array([0.98, 0.01, 0.01]))  # a recording begins with the hand free
STICKY = 20.0  # prior counts of staying, against 1 of each change

MIN_LENGTH = 256  # samples; recordings are padded to powers of two, so that few programs are compiled


def log_sum_exp(x: jax.Array, axis: int) -> jax.Array:
    """Log of a sum of exponentials that keeps values and gradients finite among -inf."""
    top = lax.stop_gradient(jnp.max(x, axis, keepdims=True))
    top = jnp.where(jnp.isneginf(top), 0.0, top)
    total = jnp.sum(jnp.exp(x - top), axis)
    positive = total > 0
    value = jnp.log(jnp.where(positive, total, 1.0)) + jnp.squeeze(top, axis)
    return jnp.where(positive, value, jnp.where(jnp.isnan(total), jnp.nan, -jnp.inf))


def _log_evidence(ll, log_initial, log_transition, num_valid):
    """hmmseg.hmm.dense.log_evidence in JAX, to be differentiated; rows from `num_valid` on are padding."""

    def step(alpha, inputs):
        ll, real = inputs
        moved = log_sum_exp(alpha[:, None] + log_transition, 0) + ll
        return jnp.where(real, moved, alpha), None

    real = jnp.arange(1, ll.shape[0]) < num_valid
    return log_sum_exp(lax.scan(step, log_initial + ll[0], (ll[1:], real))[0], 0)


# Derivatives of the log evidence are the posterior state and transition counts of EM.
_expectation = jax.jit(jax.value_and_grad(_log_evidence, argnums=(0, 2)))


def observations(signals: Signals) -> np.ndarray:
    """What the model sees (num_timesteps, 5): grip, net fy, net fx [N], vy, vx [m/s]; NaN: missing."""
    return np.stack([signals.grip, signals.fy, signals.fx, signals.vy, signals.vx], axis=1)


def label_freely(signals: Signals) -> tuple[Signals, StateLabels]:
    """Contact states of a trial's samples (thinned as for ours) by the fitted model's best path."""
    thinned = thin(signals)
    z = observations(thinned)
    floor = np.array([0.5 * noise_sd(column) for column in z.T]) + 1e-9
    responsibility = _start(z)
    transition = np.full((STATES, STATES), 0.02) + 0.94 * np.eye(STATES)
    before = -np.inf
    for _ in range(ITERATIONS):
        mean, sd = _emissions(z, responsibility, floor)
        evidence, (responsibility, counts) = _posterior(z, mean, sd, transition)
        transition = counts + 1 + (STICKY - 1) * np.eye(STATES)
        transition /= transition.sum(axis=1, keepdims=True)
        if evidence - before < 1e-3:
            break
        before = evidence
    ll = _log_likelihoods(z, mean, sd)
    path = viterbi(ll, START, np.log(transition)).path
    return thinned, StateLabels(_contact_states(mean)[path], np.zeros(len(path), dtype=bool))


def _start(z: np.ndarray) -> np.ndarray:
    """Hard responsibilities: Otsu's two groups of grip, and of net force among the gripped."""
    grip, fy = np.nan_to_num(z[:, 0]), np.nan_to_num(z[:, 1])
    held = grip > otsu(grip)
    lifted = held & (fy > otsu(fy[held]))
    return np.stack([~held, held & ~lifted, lifted], axis=1).astype(float)


def _emissions(z: np.ndarray, responsibility: np.ndarray, floor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    there, filled = np.isfinite(z), np.nan_to_num(z)
    total = responsibility.T @ there + 1e-9
    mean = responsibility.T @ filled / total
    variance = responsibility.T @ filled**2 / total - mean**2
    return mean, np.sqrt(np.maximum(variance, floor**2))


def _log_likelihoods(z: np.ndarray, mean: np.ndarray, sd: np.ndarray) -> np.ndarray:
    u = (z[:, None, :] - mean) / sd
    return np.nansum(-0.5 * u**2 - np.log(sd) * np.isfinite(u), axis=2)


def _posterior(z: np.ndarray, mean: np.ndarray, sd: np.ndarray, transition: np.ndarray):
    ll = _log_likelihoods(z, mean, sd)
    evidence, (gamma, counts) = _expectation(_padded(ll), START, np.log(transition), len(ll))
    return float(evidence), (np.asarray(gamma)[: len(ll)], np.asarray(counts))


def _padded(ll: np.ndarray) -> np.ndarray:
    length = max(MIN_LENGTH, 1 << (len(ll) - 1).bit_length())
    return np.pad(ll, ((0, length - len(ll)), (0, 0)))


def _contact_states(mean: np.ndarray) -> np.ndarray:
    """The paper's number of each fitted state: the least gripped is free, the most loaded is lifted."""
    free = int(np.argmin(mean[:, 0]))
    ground, lifted = sorted((k for k in range(STATES) if k != free), key=lambda k: mean[k, 1])
    numbers = np.empty(STATES, dtype=int)
    numbers[[free, ground, lifted]] = NUMBERS[FREE], NUMBERS[ON_GROUND], NUMBERS[ABOVE_GROUND]
    return numbers
