"""Small gaps of effects that are linear in their parameters, planted with known sizes."""

import numpy as np

from simgap.attribution.problem import Candidate, Gap, Rows


def rows_of(trials: int = 4, channels: int = 3, parts: int = 2, samples: int = 12) -> Rows:
    """Rows of a small recording at 20 Hz, every cell with as many samples."""
    trial, channel, part, k = (z.ravel() for z in np.indices((trials, channels, parts, samples)))
    time = (part * samples + k) / 20.0
    return Rows(trial, channel, part, time, tuple(f"t{i}" for i in range(trials)),
                tuple(f"c{i}" for i in range(channels)), tuple(f"p{i}" for i in range(parts)))  # fmt: skip


def linear(name: str, jacobian: np.ndarray, scale: float = 1.0, named: bool = True) -> Candidate:
    """An effect that is linear in its parameters."""
    k = jacobian.shape[1]
    nothing, far = np.zeros(k), np.full(k, np.inf)
    return Candidate(name, tuple(f"{name}{i}" for i in range(k)), nothing, nothing, np.full(k, scale),
                     np.zeros(len(jacobian)), jacobian, -far, far, named=named)  # fmt: skip


def gap_of(theta: dict[int, float], seed: int = 0, more: np.ndarray | float = 0.0, same: bool = False) -> Gap:
    """A gap of four one-parameter effects, of which `theta` act; `same`: two of them are one."""
    rng, rows = np.random.default_rng(seed), rows_of()
    n = rows.time.size
    push = rng.standard_normal((4, n)) * np.isin(rows.channel, (0, 1)) / 4
    if same:
        push[1] = push[0]
    residual = rng.standard_normal(n) + sum(v * push[j] for j, v in theta.items()) + more
    nuisance = (rows.channel == 2)[:, None] * np.ones((1, 1))
    return Gap(rows, residual, nuisance, tuple(linear("abcd"[j], push[j][:, None]) for j in range(4)))
