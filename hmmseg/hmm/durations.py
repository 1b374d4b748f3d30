"""Chains whose states have duration tables of any shape (semi-Markov), without splitting states.

`enter` [t, k]: weight of everything before a state k that begins with sample t; `leave` [t, k]: of everything
up to the end of a state k whose last sample is t - 1. A window holds, for each state and elapsed duration,
the weight of having begun that long ago, and shifts by one duration per sample: time is O(num_samples
num_states longest), memory besides the tables O(num_states longest), and samples forbidden to a state need no
special case. The recursions run row by row on every device.

Yu, Artificial Intelligence 174(2), 2010, for states in a known order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from hmmseg.hmm.chain import InfeasibleAlignment, Leaves, end_weights, jumps_between
from hmmseg.hmm.recursions import NEVER, backwards, forwards, known, log_add, log_sum, numbers, pick, row

RARE = 1e-12  # numerics: probability of the longest durations, which are left out


class DurationChain(Leaves):
    """Left-to-right chain with a distribution of durations for each state; a pytree.

    Args:
        log_durations: one array per state; entry n - 1 is the log probability (or weight) of lasting n
            samples; longer durations are impossible.
        presence: (num_states,), probability that each state occurs; 1 by default.
        open_end: the recording may truncate the last state, which has then lasted at least that long.
        log_initial, log_final: (num_states,), weights of the first and of the last state; by default, those
            that occur first and last.

    Raises:
        ValueError: wrong shapes, NaN, +inf, or a state without a possible duration.
    """

    num_samples = None  # as of a Chain whose weights do not change in time
    leaves = ("pmf", "survival", "jumps", "log_initial", "log_final")
    pmf: np.ndarray  # (num_states, longest): log probability of lasting n samples in column n - 1
    survival: np.ndarray  # the same for a state that the recording's end cuts off
    jumps: np.ndarray  # (num_bands, num_states): jumps[d - 1, k] from k to k + d
    log_initial: np.ndarray
    log_final: np.ndarray

    def __init__(self, log_durations: Sequence[ArrayLike], presence: ArrayLike | None = None, *,
                 open_end: bool = False, log_initial: ArrayLike | None = None,
                 log_final: ArrayLike | None = None) -> None:  # fmt: skip
        tables = [np.asarray(table, dtype=np.float64) for table in log_durations]
        if not tables:
            raise ValueError("log_durations: none, expected one array a state")
        for k, table in enumerate(tables):
            if table.ndim != 1 or not table.size:
                raise ValueError(f"log_durations: shape {table.shape} of state {k}, expected (longest,)")
            if not table.max() < np.inf or not np.isfinite(table.max()):
                raise ValueError(f"log_durations: state {k}, expected numbers or -inf, at least one number")
        longest = max(np.flatnonzero(np.isfinite(table)).max() + 1 for table in tables)
        self.pmf = np.full((len(tables), int(longest)), -np.inf)
        for entries, table in zip(self.pmf, tables, strict=True):
            entries[: table[:longest].size] = table[:longest]
        self.survival = self.pmf
        if open_end:
            self.survival = np.logaddexp.accumulate(self.pmf[:, ::-1], axis=1)[:, ::-1].copy()
        jumps, initial, final = jumps_between(np.ones(self.num_states) if presence is None else presence)
        if len(initial) != self.num_states:
            raise ValueError(f"presence: shape {initial.shape}, expected {(self.num_states,)}")
        self.jumps = np.full((len(jumps), self.num_states), -np.inf)
        for weights, jump in zip(self.jumps, jumps, strict=True):
            weights[: jump.size] = jump
        self.log_initial = end_weights("log_initial", log_initial, initial)
        self.log_final = end_weights("log_final", log_final, final)

    @property
    def num_states(self) -> int:
        """Number of states."""
        return self.pmf.shape[0]


def lasting(mean_samples: ArrayLike, sd_samples: ArrayLike, presence: ArrayLike | None = None, *,
            open_end: bool = False) -> DurationChain:  # fmt: skip
    """Chain of gamma-distributed durations with these means and sds [samples], read in whole samples.

    Raises ValueError unless all are above 0 and the shapes agree.
    """
    from scipy.stats import gamma

    means, sds = np.asarray(mean_samples, dtype=float), np.asarray(sd_samples, dtype=float)
    means, sds = np.broadcast_arrays(means, sds)
    if means.ndim != 1 or not ((means > 0) & (sds > 0)).all():
        raise ValueError("lasting: expected one mean and one standard deviation above 0 for each state")
    tables = []
    for mean, sd in zip(means, sds, strict=True):
        lasting_for = gamma((mean / sd) ** 2, scale=sd**2 / mean)
        edges = np.arange(1, max(int(np.ceil(lasting_for.isf(RARE))), 1) + 1) + 0.5
        below = np.append(0.0, lasting_for.cdf(edges))
        with np.errstate(divide="ignore"):
            tables.append(np.log(np.diff(below) / below[-1]))
    return DurationChain(tables, presence, open_end=open_end)


def _arrays(chain: DurationChain) -> DurationChain:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf).astype(jnp.float64), chain)


def _forward(x: Array, chain: DurationChain, n: Array) -> tuple[Array, Array, Array]:
    """Log evidence, `enter` (num_samples, num_states) and `leave` (num_samples + 1, num_states)."""

    def step(t: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        enter, leave, window = carry  # window: begun 1, 2, ... samples before sample t - 1
        window = forwards(window, 1).at[:, 0].set(row(enter, t - 1)) + known(row(x, t - 1))[:, None]
        left = log_sum(window + jnp.where(t == n, chain.survival, chain.pmf), 1)
        leave = lax.dynamic_update_index_in_dim(leave, left, t, 0)
        entering = reduce(log_add, [forwards(left + j, d) for d, j in enumerate(jnp.asarray(chain.jumps), 1)])
        enter = lax.dynamic_update_index_in_dim(enter, entering, t, 0)
        return enter, leave, window

    nothing = jnp.full((len(x) + 1, x.shape[1]), NEVER)
    start = (nothing.at[0].set(chain.log_initial), nothing, jnp.full(chain.pmf.shape, NEVER))
    enter, leave, _ = lax.fori_loop(jnp.int32(1), n + 1, step, start)
    return log_sum(row(leave, n) + chain.log_final, 0), enter[:-1], leave


def evidence(x: Array, chain: DurationChain, n: Array) -> Array:
    """Log of the summed weight of all paths."""
    return _forward(x, _arrays(chain), n)[0]


def posterior(x: Array, chain: DurationChain, n: Array) -> tuple[Array, Array, Array]:
    """Log evidence, and probabilities of states and moves, as recursions.posterior returns them.

    Moves that stay are omitted (zeros).
    """
    chain = _arrays(chain)
    total, enter, leave = _forward(x, chain, n)
    longest = chain.pmf.shape[1]
    ages = numbers(longest) + 1

    def step(i: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        after, rest, window = carry  # window: ends 1, 2, ... samples from t on
        t = n - 1 - i
        ends = jnp.where(t == n - 1, chain.log_final, row(rest, jnp.minimum(t + 1, len(x) - 1)))
        window = forwards(window, 1).at[:, 0].set(ends) + known(row(x, t))[:, None]
        begun = log_sum(window + jnp.where(ages == n - t, chain.survival, chain.pmf), 1)
        after = lax.dynamic_update_index_in_dim(after, begun, t, 0)
        moved = [backwards(begun, d) + jump for d, jump in enumerate(chain.jumps, 1)]
        return after, lax.dynamic_update_index_in_dim(rest, reduce(log_add, moved), t, 0), window

    nothing = jnp.full(x.shape, NEVER)  # rest [t, k]: all that follows a state k that ended before t
    start = (nothing, nothing, jnp.full(chain.pmf.shape, NEVER))
    after, rest, _ = lax.fori_loop(jnp.int32(0), n, step, start)
    none = jnp.where(jnp.isfinite(total), total, 0.0)
    begun, ended = jnp.exp(enter + after - none), jnp.exp(leave[:-1] + rest - none)
    states = jnp.clip(jnp.cumsum(begun - ended, axis=0), 0.0, 1.0)
    states = jnp.where((numbers(len(x)) < n)[:, None], states, 0.0)
    to = [jnp.exp(forwards(leave[1:-1] + jump[None], d) + after[1:] - none)
          for d, jump in enumerate(chain.jumps, 1)]  # fmt: skip
    return total, states, jnp.stack([jnp.zeros_like(to[0]), *to], 1)


def draw(x: Array, chain: DurationChain, n: Array, key: Array, num_draws: int) -> tuple[Array, Array]:
    """Log evidence, and starts (num_draws, num_states) drawn from the posterior."""
    chain = _arrays(chain)
    total, enter, leave = _forward(x, chain, n)
    states, (num_states, longest) = numbers(x.shape[1]), chain.pmf.shape
    front = ((longest, 0), (0, 0))  # rows before the first, where no state may begin
    enter, padded = jnp.pad(enter, front, constant_values=NEVER), jnp.pad(known(x), front)

    def one(key: Array) -> Array:
        def segment(i: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            t, k, starts = carry  # state k ends right before sample t
            last, into = jax.random.split(jax.random.fold_in(key, i))
            emitted = jnp.cumsum(lax.dynamic_slice_in_dim(padded, t, longest)[::-1, k])
            began = lax.dynamic_slice_in_dim(enter, t, longest)[::-1, k]
            table = jnp.where(t == n, chain.survival, chain.pmf)[k]
            age = pick(last, began + emitted + table) + 1
            t = jnp.where(t > 0, t - age, 0)
            sources = jnp.maximum(k - 1 - numbers(len(chain.jumps)), 0)
            ways = row(leave, t)[sources] + chain.jumps[numbers(len(chain.jumps)), sources]
            ways = jnp.where(numbers(len(chain.jumps)) < k, ways, NEVER)
            jump = pick(into, ways) + 1
            before = jnp.where(t > 0, k - jump, -1)
            starts = jnp.where((states > before) & (states <= k), t, starts)
            return t, jnp.where(t > 0, before, k), starts

        k = pick(key, row(leave, n) + chain.log_final)
        start = (n, k, jnp.where(states > k, n, 0))
        return lax.fori_loop(jnp.int32(0), jnp.int32(num_states), segment, start)[2]

    return total, jax.vmap(one)(jax.random.split(key, num_draws))


def best_path(x: Array, chain: DurationChain, n: Array) -> tuple[Array, Array]:
    """Starts (num_states,) and log weight of the most probable path."""
    starts, log_prob = rank(x, chain, n, 1)
    return starts[0], log_prob[0]


def rank(x: Array, chain: DurationChain, n: Array, count: int) -> tuple[Array, Array]:
    """Starts (count, num_states) and log weights (count,) of the best paths; -inf if there are fewer.

    Every end of a state keeps its `count` best histories, each by the duration of the state and the rank of
    its predecessor, every start those by the jump that led to it. A tie goes to the shorter stay.
    """
    chain = _arrays(chain)
    (num_states, longest), states = chain.pmf.shape, numbers(x.shape[1])
    entered = jnp.full((num_states, count), NEVER).at[:, 0].set(chain.log_initial)

    def step(t: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        entered, window, lasted, came, _ = carry
        window = (
            jnp.concatenate([entered[:, None], window[:, :-1]], axis=1) + known(row(x, t - 1))[:, None, None]
        )
        table = jnp.where(t == n, chain.survival, chain.pmf)
        left, age = lax.top_k((window + table[:, :, None]).reshape(num_states, -1), count)
        ways = [forwards((left + jump[:, None]).T, d).T for d, jump in enumerate(chain.jumps, 1)]
        entered, way = lax.top_k(jnp.concatenate(ways, axis=1), count)
        lasted = lax.dynamic_update_index_in_dim(lasted, age.astype(jnp.int32), t, 0)
        came = lax.dynamic_update_index_in_dim(came, way.astype(jnp.int32), t, 0)
        return entered, window, lasted, came, left

    pointers = jnp.zeros((len(x) + 1, num_states, count), jnp.int32)
    start = (entered, jnp.full((num_states, longest, count), NEVER), pointers, pointers, entered)
    *_, lasted, came, left = lax.fori_loop(jnp.int32(1), n + 1, step, start)
    log_prob, ends = lax.top_k((left + chain.log_final[:, None]).ravel(), count)

    def back(end: Array) -> Array:
        def segment(_: Array, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            t, k, place, starts = carry
            age = row(lasted, t)[k, place]
            t = jnp.where(t > 0, jnp.maximum(t - age // count - 1, 0), 0)
            way = row(came, t)[k, age % count]
            before = jnp.where(t > 0, k - way // count - 1, -1)
            starts = jnp.where((states > before) & (states <= k), t, starts)
            return t, jnp.where(t > 0, jnp.maximum(before, 0), k), way % count, starts

        k = (end // count).astype(jnp.int32)
        start = (n, k, (end % count).astype(jnp.int32), jnp.where(states > k, n, 0))
        return lax.fori_loop(jnp.int32(0), jnp.int32(num_states), segment, start)[3]

    return jax.vmap(back)(ends), log_prob


def why_infeasible(x: np.ndarray, chain: DurationChain) -> InfeasibleAlignment:
    """The exception that names the state at fault where no path has any weight."""
    with jax.enable_x64(True):
        enter = np.asarray(_forward(jnp.asarray(x), _arrays(chain), jnp.int32(len(x)))[1])
    deepest = int(np.flatnonzero(np.isfinite(enter).any(axis=0)).max(initial=0))
    return InfeasibleAlignment(deepest, "none of its durations leads to what has to follow")
