"""The noise model of healthy residuals: scale, autocorrelation and what a whole cell shares.

Learned on healthy simulated trials (`simgap.gap.bank`), in units of the sensors' own noise, so that
it serves another rig. Whitening is linear: an AR(1) filter within each subtask, then the mean of a
subtask (a cell) is weighed by its own scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from simgap.gap.frame import CHANNELS, PHASES, Frame

LEAST = 0.6  # no scale is trusted below this
LONG = 6  # samples; a cell must have more for its mean to be told from the rest


@dataclass(frozen=True)
class NoiseModel:
    """`scale` (2 * phases, channels), `rho` and `cell` (phases, channels); see `whitening`."""

    scale: np.ndarray
    rho: np.ndarray
    cell: np.ndarray

    @classmethod
    def plain(cls) -> NoiseModel:
        """The sensors' noise and nothing else."""
        n, c = len(PHASES), len(CHANNELS)
        return cls(np.ones((2 * n, c)), np.zeros((n, c)), np.ones((n, c)))

    def to_json(self) -> dict:
        """Rounded lists."""
        return {k: np.round(getattr(self, k), 4).tolist() for k in ("scale", "rho", "cell")}

    @classmethod
    def from_json(cls, table: dict) -> NoiseModel:
        """From `to_json`."""
        return cls(*(np.array(table[k]) for k in ("scale", "rho", "cell")))


class Whitening(NamedTuple):
    """Arrays of the linear whitening: T trials, N samples, C channels, S subtasks.

    `weight` (T, N, C): 1 / standard deviation, 0 where there is nothing; `carryover` (T, N, C): AR
    coefficient on the sample before; `share` (T, S, C): what of a cell's mean is taken away;
    `member` (T, N, S) one-hot.
    """

    weight: np.ndarray
    carryover: np.ndarray
    share: np.ndarray
    member: np.ndarray


def whitening(frame: Frame, model: NoiseModel) -> Whitening:
    """The whitening of a frame's residuals."""
    a = frame.arrays
    there = a.there > 0
    weight = np.where(there, 1 / (a.sd * model.scale[a.kind]), 0.0)
    phase = a.kind // 2
    same = np.zeros_like(there)
    same[:, 1:] = there[:, 1:] & there[:, :-1] & (a.subtask[:, 1:] == a.subtask[:, :-1])[..., None]
    carryover = np.where(same, model.rho[phase], 0.0)
    count = len(frame.steps)
    member = np.eye(count)[a.subtask]
    phases = np.zeros(count, int)
    phases[a.subtask.ravel()] = phase.ravel()
    number = np.einsum("tns,tnc->tsc", member, there.astype(float))
    share = np.where(number > LONG, 1 - 1 / model.cell[phases][None], 0.0)
    return Whitening(weight, carryover, share, member)


def whiten(residual: jax.Array, w: Whitening) -> jax.Array:
    """Whitened residuals (T, N, C), standard normal for a healthy recording."""
    z = residual * w.weight
    before = jnp.concatenate([jnp.zeros_like(z[:, :1]), z[:, :-1]], 1)
    z = (z - w.carryover * before) / jnp.sqrt(1 - w.carryover**2)
    there = (w.weight > 0).astype(z.dtype)
    number = jnp.einsum("tns,tnc->tsc", w.member, there)
    mean = jnp.einsum("tns,tnc->tsc", w.member, z) / jnp.maximum(number, 1)
    return z - jnp.einsum("tns,tsc->tnc", w.member, mean * w.share) * there


def learn(samples: list[tuple[Frame, np.ndarray]]) -> NoiseModel:
    """Noise model from healthy frames and their residuals (T, N, C), properties fitted."""
    n, c = len(PHASES), len(CHANNELS)
    plain = NoiseModel.plain()
    scale, rho, cell = plain.scale.copy(), plain.rho.copy(), plain.cell.copy()
    square, count = np.zeros((2 * n, c)), np.zeros((2 * n, c))
    for frame, r in samples:
        z = np.where(frame.arrays.there > 0, r / frame.arrays.sd, 0.0)
        np.add.at(square, frame.arrays.kind, np.minimum(z**2, 36.0 * 4))
        np.add.at(count, frame.arrays.kind, frame.arrays.there)
    known = count > 20
    scale[known] = np.maximum(np.sqrt(square[known] / count[known]), LEAST)
    scale[8:] = np.where(count[8:] > 20, scale[8:], scale[2:4])  # slides as pickups where none were seen
    product, power = np.zeros((n, c)), np.zeros((n, c))
    for frame, r in samples:
        a, w = frame.arrays, whitening(frame, NoiseModel(scale, np.full((n, c), 0.5), plain.cell))
        z = r * w.weight
        both = w.carryover[:, 1:] > 0
        np.add.at(product, a.kind[:, 1:] // 2, np.where(both, z[:, 1:] * z[:, :-1], 0.0))
        np.add.at(power, a.kind[:, 1:] // 2, np.where(both, (z[:, 1:] ** 2 + z[:, :-1] ** 2) / 2, 0.0))
    rho = np.where(power > 20, np.clip(product / np.maximum(power, 1), -0.8, 0.95), 0.0)
    means, numbers = np.zeros((n, c)), np.zeros((n, c))
    for frame, r in samples:
        a, w = frame.arrays, whitening(frame, NoiseModel(scale, rho, plain.cell))
        z = np.asarray(whiten(jnp.asarray(r), w))
        number = np.einsum("tns,tnc->tsc", w.member, (w.weight > 0).astype(float))
        mean = np.einsum("tns,tnc->tsc", w.member, z) / np.sqrt(np.maximum(number, 1))
        phases = np.zeros(len(frame.steps), int)
        phases[a.subtask.ravel()] = (a.kind // 2).ravel()
        long = number > LONG
        for s, p in enumerate(phases):
            means[p] += np.where(long[:, s], mean[:, s] ** 2, 0.0).sum(0)
            numbers[p] += long[:, s].sum(0)
    cell = np.where(numbers > 10, np.sqrt(means / np.maximum(numbers, 1)), 1.0)
    return NoiseModel(scale, rho, np.maximum(cell, LEAST))
