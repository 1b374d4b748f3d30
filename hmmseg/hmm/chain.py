"""A chain of states in a known order: what it may do from one sample to the next, checked once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike


class InfeasibleAlignment(ValueError):
    """No path through the subtasks has any probability.

    `subtask` (0-based) is the one that starves: the first that no path reaches, or the last one
    where it is reached but cannot be held to the end.
    """

    def __init__(self, subtask: int, reason: str) -> None:
        super().__init__(f"no alignment: subtask {subtask} starves ({reason})")
        self.subtask = subtask
        self.reason = reason


class Chain:
    """Log weights of a left-to-right chain of `num_states` states; need not be normalised.

    `log_stay` (num_states,): to stay in a state from one sample to the next; `log_advance`
    (num_states - 1,): to go from k to k + 1; `log_skip`: from k to k + 2 (num_states - 2,), or a
    sequence of arrays for k + 2, k + 3, ... Where these change in time they have one row a
    transition, (num_samples - 1, ...), row t between the samples t and t + 1; some may and others not.
    `log_initial`, `log_final` (num_states,): weights of the first and of the last sample's state;
    None: the first state, the last state, for sure. -inf forbids. Raises ValueError on wrong
    shapes, NaN and +inf.
    """

    __slots__ = ("addresses", "bands", "log_final", "log_initial", "num_samples", "num_states")

    def __init__(
        self,
        log_stay: ArrayLike,
        log_advance: ArrayLike,
        log_skip: ArrayLike | Sequence[ArrayLike] | None = None,
        *,
        log_initial: ArrayLike | None = None,
        log_final: ArrayLike | None = None,
    ) -> None:
        skips: tuple = ()
        if log_skip is not None:
            skips = (log_skip,) if isinstance(log_skip, np.ndarray) else tuple(log_skip)  # type: ignore[arg-type]
        bands = [np.ascontiguousarray(b, dtype=np.float64) for b in (log_stay, log_advance, *skips)]
        if bands[0].ndim not in (1, 2) or not bands[0].shape[-1]:
            raise ValueError(
                f"log_stay: shape {bands[0].shape}, expected (num_states,) or one such row a step"
            )
        self.num_states: int = bands[0].shape[-1]
        rows = [len(b) for b in bands if b.ndim == 2]
        self.num_samples: int | None = rows[0] + 1 if rows else None
        self.bands: tuple[np.ndarray, ...] = tuple(self._checked(d, b) for d, b in enumerate(bands))
        self.log_initial: np.ndarray = self._end("log_initial", log_initial, 0)
        self.log_final: np.ndarray = self._end("log_final", log_final, -1)
        # Of stay and advance, whether these vary, of initial and final, as kernels take them.
        tables = [each.ctypes.data for each in (*self.bands[:2], self.log_initial, self.log_final)]
        self.addresses = (tables[0], tables[1], self.varying, tables[2], tables[3])

    def __reduce__(self) -> tuple:  # addresses do not outlive the process
        return _rebuilt, (*self.bands[:2], self.bands[2:] or None, self.log_initial, self.log_final)

    def _checked(self, d: int, band: np.ndarray) -> np.ndarray:
        width = max(self.num_states - d, 0)
        steps = None if self.num_samples is None else self.num_samples - 1
        name = ("log_stay", "log_advance")[d] if d < 2 else f"log_skip[{d - 2}]"
        if band.shape != (width,) and band.shape != (steps, width):
            expected = f"{(width,)}" if steps is None else f"{(steps, width)} or {(width,)}"
            raise ValueError(f"{name}: shape {band.shape}, expected {expected}")
        if band.size and not band.max() < np.inf:
            raise ValueError(f"{name}: {_first_bad(band)}, expected numbers or -inf")
        if steps is not None and band.ndim == 1:
            band = np.ascontiguousarray(np.broadcast_to(band, (steps, width)))
        return band

    def _end(self, name: str, end: ArrayLike | None, index: int) -> np.ndarray:
        if end is None:
            out = np.full(self.num_states, -np.inf)
            out[index] = 0.0
            return out
        out = np.ascontiguousarray(end, dtype=np.float64)
        if out.shape != (self.num_states,):
            raise ValueError(f"{name}: shape {out.shape}, expected {(self.num_states,)}")
        if not out.max() < np.inf:
            raise ValueError(f"{name}: {_first_bad(out)}, expected numbers or -inf")
        return out

    @property
    def varying(self) -> bool:
        """Whether any weight changes in time."""
        return self.num_samples is not None

    def band(self, d: int, num_samples: int) -> np.ndarray:
        """Weights (num_samples - 1, num_states - d) of going from k to k + d."""
        return np.broadcast_to(self.bands[d], (num_samples - 1, max(self.num_states - d, 0)))

    def stacked(self) -> np.ndarray:
        """All bands in one table (rows, num_bands, num_states), -inf where one is shorter."""
        rows = 1 if self.num_samples is None else self.num_samples - 1
        out = np.full((rows, len(self.bands), self.num_states), -np.inf)
        for d, band in enumerate(self.bands):
            out[:, d, : max(self.num_states - d, 0)] = band
        return out


def _rebuilt(stay, advance, skips, log_initial, log_final) -> Chain:
    return Chain(stay, advance, skips, log_initial=log_initial, log_final=log_final)


def left_to_right(mean_samples: ArrayLike, presence: ArrayLike | None = None) -> Chain:
    """Chain of memoryless (geometric) durations with these means [samples], at least 1.

    `presence`: probability that each state occurs at all; below 1, the state is optional and may be
    passed over. All weights are probabilities; the last state lasts to the end.
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
    """Log probabilities of what comes next where states occur with these probabilities.

    From k to k + d (num_states - d,) for d = 1, 2, ... as far as any states can be passed over; of the first
    state that occurs, and of the last (num_states,). ValueError outside of (0, 1].
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


def why_infeasible(log_likelihoods: np.ndarray, chain: Chain) -> ValueError:
    """What to raise where no path has any weight: ValueError for +inf, else InfeasibleAlignment."""
    ll = np.asarray(log_likelihoods)
    if np.isposinf(ll).any():
        return ValueError(f"log_likelihoods: {_first_bad(ll)}, expected numbers or -inf")
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


def not_numbers(log_likelihoods: np.ndarray, row: int) -> ValueError:
    """What to raise for a row with NaN beside numbers."""
    column = int(np.flatnonzero(np.isnan(np.asarray(log_likelihoods[row], dtype=float)))[0])
    where = f"log_likelihoods: NaN or +inf at {[row, column]}"
    return ValueError(f"{where}, expected numbers or -inf (a missing sample is NaN throughout)")


def _first_bad(table: np.ndarray) -> str:
    where = np.argwhere(np.isnan(table) | np.isposinf(table))[0].tolist()
    return f"NaN or +inf at {where}"
