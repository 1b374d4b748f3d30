"""A chain of states in a known order: its weights, and why it may be infeasible."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, TypeVar

import jax
import numpy as np
from jax.core import Tracer
from jax.tree_util import register_pytree_node_class
from numpy.typing import ArrayLike


class InfeasibleAlignment(ValueError):
    """No path through the subtasks has positive probability.

    `subtask` (0-based) is at fault: the first one that no path reaches, or the last one if it is reached but
    cannot be held to the end.
    """

    def __init__(self, subtask: int, reason: str) -> None:
        super().__init__(f"no alignment: subtask {subtask} starves ({reason})")
        self.subtask = subtask
        self.reason = reason


Tree = TypeVar("Tree", bound="Leaves")


class Leaves:
    """Base of pytrees whose children are the attributes named in `leaves`."""

    leaves: ClassVar[tuple[str, ...]]

    def __init_subclass__(cls) -> None:
        register_pytree_node_class(cls)

    def tree_flatten(self) -> tuple[tuple[Any, ...], None]:
        """The leaves, for JAX."""
        return tuple(getattr(self, name) for name in self.leaves), None

    @classmethod
    def tree_unflatten(cls: type[Tree], _: None, leaves: tuple[Any, ...]) -> Tree:
        """An instance with these leaves, which may be any JAX values."""
        tree = object.__new__(cls)
        vars(tree).update(zip(cls.leaves, leaves, strict=True))
        return tree


class Chain(Leaves):
    """Log weights of a left-to-right chain of `num_states` states; they need not be normalised.

    A pytree: a chain may be an argument of functions under jit, vmap and grad, with traced weights.

    Args:
        log_stay: (num_states,), of staying in a state from one sample to the next.
        log_advance: (num_states - 1,), of going from k to k + 1.
        log_skip: of going from k to k + 2 (num_states - 2,), or a sequence of arrays for k + 2, k + 3, ...
        log_initial: (num_states,), of the first sample's state; None: always the first state.
        log_final: (num_states,), of the last sample's state; None: always the last state.
            The first three may vary in time and then have a row per transition, (num_samples - 1, ...), row t
            between samples t and t + 1. -inf forbids.

    Raises:
        ValueError: wrong shapes, NaN or +inf.
    """

    leaves = ("bands", "log_initial", "log_final")

    def __init__(
        self,
        log_stay: ArrayLike,
        log_advance: ArrayLike,
        log_skip: ArrayLike | Sequence[ArrayLike] | None = None,
        *,
        log_initial: ArrayLike | None = None,
        log_final: ArrayLike | None = None,
    ) -> None:
        skips: tuple[Any, ...] = ()
        if log_skip is not None:
            whole = isinstance(log_skip, (np.ndarray, jax.Array))
            skips = (log_skip,) if whole else tuple(log_skip)  # type: ignore[arg-type]
        bands = tuple(_weights(band) for band in (log_stay, log_advance, *skips))
        if bands[0].ndim not in (1, 2) or not bands[0].shape[-1]:
            shape = bands[0].shape
            raise ValueError(f"log_stay: shape {shape}, expected (num_states,) or one such row a step")
        self.bands: tuple[Any, ...] = bands
        for d, band in enumerate(bands):
            self._check(d, band)
        first, last = np.full((2, self.num_states), -np.inf)
        first[0] = last[-1] = 0.0
        self.log_initial = end_weights("log_initial", log_initial, first)
        self.log_final = end_weights("log_final", log_final, last)

    @property
    def num_states(self) -> int:
        """Number of states."""
        return self.bands[0].shape[-1]

    @property
    def num_samples(self) -> int | None:
        """Required length of recordings if weights vary in time, else None."""
        return next((len(band) + 1 for band in self.bands if band.ndim == 2), None)

    def _check(self, d: int, band: Any) -> None:
        width = max(self.num_states - d, 0)
        steps = None if self.num_samples is None else self.num_samples - 1
        name = ("log_stay", "log_advance")[d] if d < 2 else f"log_skip[{d - 2}]"
        if band.shape != (width,) and band.shape != (steps, width):
            expected = f"{(width,)}" if steps is None else f"{(steps, width)} or {(width,)}"
            raise ValueError(f"{name}: shape {band.shape}, expected {expected}")
        _refuse_bad(name, band)

    def band(self, d: int, num_samples: int) -> np.ndarray:
        """Weights (num_samples - 1, num_states - d) of going from k to k + d."""
        return np.broadcast_to(self.bands[d], (num_samples - 1, max(self.num_states - d, 0)))

    def by_target(self, xp: Any = np) -> Any:
        """Weights (num_samples - 1 or 1, num_bands, num_states) of coming to k from k - d, -inf for k < d.

        `xp`: NumPy, or jax.numpy for traced weights.
        """
        bands = [xp.asarray(band).astype(np.float64) for band in self.bands]
        bands = [band[None] if band.ndim == 1 else band for band in bands]
        rows = max(len(band) for band in bands) if self.num_samples != 1 else 1
        whole = []
        for d, band in enumerate(bands):
            d = min(d, self.num_states)
            padded = xp.concatenate([xp.full((len(band), d), -np.inf, band.dtype), band], axis=1)
            whole.append(xp.broadcast_to(padded, (rows, self.num_states)))
        return xp.stack(whole, axis=1)


def end_weights(name: str, given: ArrayLike | None, otherwise: np.ndarray) -> Any:
    """Log weights of the first or last state, with a default; ValueError for invalid ones."""
    out = otherwise if given is None else _weights(given)
    if out.shape != otherwise.shape:
        raise ValueError(f"{name}: shape {out.shape}, expected {otherwise.shape}")
    _refuse_bad(name, out)
    return out


def _weights(given: ArrayLike) -> Any:
    """NumPy doubles; JAX arrays unchanged."""
    return given if isinstance(given, jax.Array) else np.asarray(given, dtype=np.float64)


def _refuse_bad(name: str, weights: Any) -> None:
    if isinstance(weights, Tracer):
        return
    if weights.size and not weights.max() < np.inf:
        raise not_a_number(name, np.isnan(weights) | np.isposinf(weights))


def not_a_number(name: str, where: np.ndarray, hint: str = "") -> ValueError:
    """The exception for NaN or +inf in a table, true in `where`."""
    place = np.argwhere(where)[0].tolist()
    return ValueError(f"{name}: NaN or +inf at {place}, expected numbers or -inf{hint}")


def left_to_right(mean_samples: ArrayLike, presence: ArrayLike | None = None) -> Chain:
    """Chain of memoryless (geometric) durations with these means [samples], at least 1.

    `presence`: probability that each state occurs; below 1, the state is optional and may be skipped. All
    weights are probabilities; the last state lasts to the end.
    """
    leave = 1.0 / np.maximum(np.asarray(mean_samples, dtype=float), 1.0)
    there = np.ones(leave.size) if presence is None else np.asarray(presence, dtype=float)
    if there.shape != leave.shape or leave.ndim != 1:
        raise ValueError(f"presence: shape {there.shape}, expected {leave.shape}, one number a state")
    if not leave.size or not (leave > 0).all():
        raise ValueError("left_to_right: expected means above 0 and probabilities in (0, 1]")
    jumps, initial, final = jumps_between(there)
    with np.errstate(divide="ignore"):
        leaving, stay = np.log(leave), np.log1p(-leave)
    stay[-1] = 0.0
    jumps = [leaving[: jump.size] + jump for jump in jumps]
    return Chain(stay, jumps[0], jumps[1:] or None, log_initial=initial, log_final=final)


def jumps_between(presence: ArrayLike) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Log probabilities of the next state if states occur with these probabilities.

    Of going from k to k + d (num_states - d,) for d = 1, 2, ... as far as states can be skipped; of the first
    and of the last state that occurs (num_states,). ValueError for probabilities outside (0, 1].
    """
    there = np.asarray(presence, dtype=float)
    if there.ndim != 1 or not ((there > 0) & (there <= 1)).all():
        raise ValueError(f"presence: {there.tolist()}, expected probabilities in (0, 1]")
    with np.errstate(divide="ignore"):
        present, absent = np.log(there), np.log1p(-there)
    longest = max((len(run) for run in "".join("x" if p < 1 else " " for p in there).split()), default=0)
    n = there.size
    jumps = [
        np.array([absent[k + 1 : k + d].sum() + present[k + d] for k in range(n - d)])
        for d in range(1, longest + 2)
    ]
    initial = np.array([absent[:k].sum() + present[k] for k in range(n)])
    final = np.array([absent[k + 1 :].sum() for k in range(n)])
    return jumps, initial, final


def why_infeasible(log_likelihoods: np.ndarray, chain: Chain) -> InfeasibleAlignment:
    """The exception that names the state at fault where no path has any weight."""
    ll = np.asarray(log_likelihoods)
    possible = ~np.isneginf(ll)  # a row of NaN is no evidence
    reach = np.isfinite(chain.log_initial) & possible[0]
    reached = reach.copy()
    steps = [np.isfinite(chain.band(d, len(ll))) for d in range(len(chain.bands))]
    for t in range(1, len(ll)):
        arrive = np.zeros_like(reach)
        for d, step in enumerate(steps):
            if step.shape[1]:
                arrive[d:] |= reach[: reach.size - d] & step[t - 1]
        reach = arrive & possible[t]
        reached |= reach
    deepest, last = int(np.flatnonzero(reached).max(initial=-1)), reached.size - 1
    if deepest == last:
        return InfeasibleAlignment(last, "reached, but cannot be held to the end")
    starving = deepest + 1
    if not possible[:, starving].any():
        return InfeasibleAlignment(starving, "no sample is possible under it")
    if len(ll) <= starving:
        return InfeasibleAlignment(starving, f"{len(ll)} samples are too few")
    return InfeasibleAlignment(starving, "no path reaches it")
