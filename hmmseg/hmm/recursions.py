"""The recursions over a chain's states and time, as pure JAX functions in double precision.

Conventions of this file: `x` (num_timesteps, num_states) log-likelihoods, a row of NaN for a missing sample;
`w` (num_timesteps - 1 or 1, num_bands, num_states) log weights by target, w[t, d, k] of going from k - d to k
between samples t and t + 1, -inf for k < d, a single row if constant; `n` int32, number of rows that are no
padding. A recursion's table has a row for every timestep; rows beyond n - 1 are meaningless.

A chain is triangular: no path returns to a state it has left. It can therefore be solved in two ways. Row by
row takes least work and is fastest on a CPU. State by state, each state is a scalar linear recurrence in
time, driven by the states before it, v[t] = (v[t - 1] + a[t]) + b[t] in the semiring, and linear recurrences
are solved in logarithmic time by an associative scan (Blelloch, CMU-CS-90-190, 1990). This is the parallel
inference of Hassan, Särkkä and García-Fernández, IEEE Trans. Signal Process. 69, 2021, with pairs of numbers
instead of num_states x num_states matrices as elements.

Rabiner, Proc. IEEE 77(2), 1989; sampling: Scott, J. Am. Stat. Assoc. 97, 2002.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, reduce, wraps
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from hmmseg.jaxconfig import keep_programs

keep_programs()

NEVER = -jnp.inf  # physics: the logarithm of no weight
BLOCK = 256  # numerics: rows that a CPU searches at once for where a path entered its state

Operation = Callable[[Array, Array], Array]


def log_add(a: Array, b: Array) -> Array:
    """log(exp(a) + exp(b)), also if both are -inf."""
    top = jnp.maximum(a, b)
    gap = jnp.where(top == NEVER, 0.0, jnp.minimum(a, b) - top)
    return top + jnp.log1p(jnp.exp(gap))


def finite(top: Array) -> Array:
    """The largest log weight `top`, to be subtracted from all; 0 if it is -inf."""
    return jnp.where(jnp.isfinite(top), top, 0.0)


def log_sum(values: Array, axis: int) -> Array:
    """Log of the sum of exponentials along an axis, also if all are -inf."""
    top = finite(values.max(axis, keepdims=True))
    return jnp.log(jnp.exp(values - top).sum(axis)) + top.squeeze(axis)


def numbers(count: int) -> Array:
    """0, 1, ... as int32, like every index here."""
    return jnp.arange(count, dtype=jnp.int32)


def argmax(values: Array, axis: int = 0) -> Array:
    """First place of the largest value, int32.

    Composed of operations that lower correctly even if JAX has been reset to 32 bits by then, unlike
    lax.argmax.
    """
    places = lax.broadcasted_iota(jnp.int32, values.shape, axis)
    return jnp.where(values == values.max(axis, keepdims=True), places, values.shape[axis] - 1).min(axis)


def pick(key: Array, logits: Array, axis: int = 0) -> Array:
    """A place along an axis drawn by log weights (Gumbel, 1954)."""
    uniform = (jax.random.bits(key, logits.shape, jnp.uint32).astype(jnp.float64) + 0.5) * 2.0**-32
    return argmax(logits - jnp.log(-jnp.log(uniform)), axis)


def row(table: Array, t: Array) -> Array:
    """table[t], or the only row of a constant table."""
    return table[0] if len(table) == 1 else lax.dynamic_index_in_dim(table, t, keepdims=False)


def known(x: Array) -> Array:
    """Log-likelihoods (..., num_states) in double precision, zeros (no evidence) for a missing sample."""
    x = x.astype(jnp.float64)
    return jnp.where(jnp.isnan(x).all(-1, keepdims=True), 0.0, x)


def forwards(values: Array, d: int) -> Array:
    """Shift by d states: for each state the value d states before it, -inf if there is none."""
    pads = [(0, 0, 0)] * (values.ndim - 1) + [(d, -d, 0)]
    return lax.pad(values, jnp.array(NEVER, values.dtype), pads)


def backwards(values: Array, d: int, nothing: float = NEVER) -> Array:
    """Shift by -d states: for each state the value d states after it, `nothing` if there is none."""
    pads = [(0, 0, 0)] * (values.ndim - 1) + [(-d, d, 0)]
    return lax.pad(values, jnp.array(nothing, values.dtype), pads)


def by_device(parallel: bool | None, by_row: Callable[..., Any], by_state: Callable[..., Any],
              *args: Array) -> Any:  # fmt: skip
    """Run row by row on a CPU, state by state elsewhere, unless `parallel` decides."""
    if parallel is None:
        return lax.platform_dependent(*args, cpu=by_row, default=by_state)
    return (by_state if parallel else by_row)(*args)


def forward(x: Array, w: Array, initial: Array, n: Array, plus: Operation,
            parallel: bool | None) -> tuple[Array, Array]:  # fmt: skip
    """Weights [t, k] of all paths (the best path, for `plus` a maximum) in state k at sample t.

    For sums, each row is known up to a constant, and that of row n - 1 is returned second: sums grow with the
    recording, and their rounding would show in the probabilities.
    """

    def by_row(x: Array, w: Array, initial: Array, n: Array) -> tuple[Array, Array]:
        table = jnp.full(x.shape, NEVER).at[0].set(initial + known(x[0]))

        def step(t: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
            table, *taken = carry
            before, weight = row(table, t - 1), row(w, t - 1)
            each = [forwards(before, d) + weight[d] for d in range(w.shape[1])]
            now = reduce(plus, each) + known(row(x, t))
            if taken:
                top = finite(now.max())
                now, taken = now - top, [taken[0] + top]
            return lax.dynamic_update_index_in_dim(table, now, t, 0), *taken

        start = (table, jnp.zeros(())) if plus is log_add else (table,)
        found = lax.fori_loop(jnp.int32(1), n, step, start) if len(x) > 1 else start
        return found[0], (found[-1] if plus is log_add else jnp.zeros(()))

    def by_state(x: Array, w: Array, initial: Array, n: Array) -> tuple[Array, Array]:
        x = known(x)
        first = (initial + x[0])[:, None]
        keep = jnp.pad((x[1:] + w[:, 0]).T, ((0, 0), (1, 0)), constant_values=NEVER)
        num = w.shape[1] - 1  # columns before this one

        def state(before: Array, k: Array) -> tuple[Array, Array]:
            enter = [before[d - 1, :-1] + w[:, d, k] for d in range(1, num + 1)]
            enter = [jnp.broadcast_to(jnp.array(NEVER), (len(x) - 1,)), *enter]
            column = solve(keep[k], jnp.append(first[k], reduce(plus, enter) + x[1:, k]), jnp.add, plus)
            return jnp.concatenate([column[None], before[: max(num - 1, 0)]])[: max(num, 1)], column

        start = jnp.full((max(num, 1), len(x)), NEVER)
        return lax.scan(state, start, numbers(x.shape[1]))[1].T, jnp.zeros(())

    return by_device(parallel, by_row, by_state, x, w, initial, n)


def shares(before: Array, w: Array) -> Array:
    """Conditional probability (..., num_bands, num_states) of having come to state k from k - d.

    `before` (..., num_states): weights of all paths one sample earlier; `w` (..., num_bands, num_states).
    """
    ways = jnp.stack([forwards(before, d) + w[..., d, :] for d in range(w.shape[-2])], -2)
    return probabilities(ways, -2)


def smooth(before: Array, w: Array, final: Array, n: Array, parallel: bool | None) -> tuple[Array, Array]:
    """Probabilities of states (num_timesteps, num_states) and moves, from the forward pass alone.

    Given state k at sample t, its predecessor k - d does not depend on the samples after t, so
    p[t - 1, j] = sum_d share[t, d, j + d] p[t, j + d] leads back from the last sample.
    """
    num_timesteps, num_states = before.shape
    num_bands = w.shape[1]
    last = probabilities(row(before, n - 1) + final, 0)

    def by_row(before: Array, w: Array, last: Array, n: Array) -> tuple[Array, Array]:
        states = lax.dynamic_update_index_in_dim(jnp.zeros_like(before), last, n - 1, 0)
        moves = jnp.zeros((num_timesteps - 1, num_bands, num_states))

        # The current row is carried too: reading it back from its table would make XLA copy the table.
        def step(i: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            t, (states, moves, now) = n - 1 - i, carry
            moved = now[None] * shares(row(before, t - 1), row(w, t - 1))
            now = reduce(jnp.add, [backwards(moved[d], d, 0.0) for d in range(num_bands)])
            states = lax.dynamic_update_index_in_dim(states, now, t - 1, 0)
            return states, lax.dynamic_update_index_in_dim(moves, moved, t - 1, 0), now

        return lax.fori_loop(jnp.int32(0), n - 1, step, (states, moves, last))[:2]

    def by_state(before: Array, w: Array, last: Array, n: Array) -> tuple[Array, Array]:
        inside = (numbers(num_timesteps - 1) < n - 1)[:, None, None]
        share = jnp.where(inside, shares(before[:-1], w), 0.0)
        goes = [backwards(share[:, d], d, 0.0) for d in range(num_bands)]  # [t, k] of k + d at t + 1
        num = max(num_bands - 1, 1)  # columns after this one

        def state(after: Array, k: Array) -> tuple[Array, Array]:
            leave = sum(after[d - 1, 1:] * goes[d][:, k] for d in range(1, num_bands))
            leave = jnp.zeros(num_timesteps - 1) + leave
            enter = jnp.append(leave, 0.0) + jnp.where(numbers(num_timesteps) == n - 1, last[k], 0.0)
            column = solve(jnp.append(goes[0][:, k], 0.0), enter, jnp.multiply, jnp.add, reverse=True)
            return jnp.concatenate([column[None], after])[:num], column

        start = jnp.zeros((num, num_timesteps))
        states = lax.scan(state, start, numbers(num_states), reverse=True)[1].T
        return states, states[1:, None] * share

    if num_timesteps == 1:
        return last[None], jnp.zeros((0, num_bands, num_states))
    return by_device(parallel, by_row, by_state, before, w, last, n)


def solve(a: Array, b: Array, times: Operation, plus: Operation, reverse: bool = False) -> Array:
    """v (num_timesteps,) of v[t] = plus(times(v[t - 1], a[t]), b[t]), starting from nothing."""

    def join(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
        return times(first[0], second[0]), plus(times(first[1], second[0]), second[1])

    return lax.associative_scan(join, (a, b), reverse=reverse)[1]


def trace_back(table: Array, w: Array, k: Array, n: Array, block: int) -> Array:
    """Starts (num_states,) of the best path that ends in state k, from its table; ties go to staying.

    Searches blocks of rows for the last entry into each state, instead of walking from row to row.
    """
    num_timesteps, num_states = table.shape
    states, size = numbers(num_states), min(block, num_timesteps - 1)
    starts = jnp.where(states > k, n, 0)
    if size == 0:
        return starts
    shifts = numbers(w.shape[1])

    def look(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        end, k, starts = carry  # the path is in state k at sample `end`
        base = jnp.clip(end - size, 0, num_timesteps - 1 - size)
        before = lax.dynamic_slice_in_dim(table, base, size)[:, jnp.maximum(k - shifts, 0)]
        weight = w[:, :, k] if len(w) == 1 else lax.dynamic_slice_in_dim(w, base, size)[:, :, k]
        jump = argmax(before + weight, 1)
        at = base + 1 + numbers(size)
        last = jnp.max(jnp.where((jump > 0) & (at <= end), at, 0))
        jump = jnp.where(last > 0, jump[jnp.maximum(last - base - 1, 0)], 0)
        starts = jnp.where((states > k - jump) & (states <= k), last, starts)
        return jnp.where(last > 0, last - 1, base), k - jump, starts

    start = (n - 1, k, starts)
    return lax.while_loop(lambda carry: (carry[0] > 0) & (carry[1] > 0), look, start)[2]


def one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function so that vmap runs recordings in turn on a CPU, which keeps each in its cache.

    The rule may be applied after tracing, outside the double-precision setting under which that was done.
    """

    @wraps(function)
    def batchable(*args: Array, parallel: bool | None) -> Any:
        core = partial(function, parallel=parallel)
        run = jax.custom_batching.custom_vmap(core)

        @run.def_vmap
        def rule(axis_size: int, in_batched: Sequence[bool], *args: Array) -> Any:
            def in_turn(*args: Array) -> Any:
                moving = [a for a, moves in zip(args, in_batched, strict=True) if moves]

                def each(moving: Sequence[Array]) -> Any:
                    rest = iter(moving)
                    return run(*(next(rest) if m else a for a, m in zip(args, in_batched, strict=True)))

                return lax.map(each, moving)

            together = jax.vmap(core, in_axes=[0 if moves else None for moves in in_batched])
            with jax.enable_x64(True):
                results = by_device(parallel, in_turn, together, *args)
            return results, jax.tree.map(lambda _: True, results)

        return run(*args)

    return batchable


@one_by_one
def best_path(
    x: Array, w: Array, initial: Array, final: Array, n: Array, parallel: bool | None
) -> tuple[Array, Array]:
    """Starts (num_states,) and log weight of the most probable path."""
    table, _ = forward(x, w, initial, n, jnp.maximum, parallel)
    last = row(table, n - 1) + final
    k = argmax(last)
    in_blocks, at_once = (partial(trace_back, block=size) for size in (BLOCK, len(x)))
    return by_device(parallel, in_blocks, at_once, table, w, k, n), last[k]


@one_by_one
def posterior(
    x: Array, w: Array, initial: Array, final: Array, n: Array, parallel: bool | None
) -> tuple[Array, Array, Array]:
    """Log evidence, and probabilities of states (num_timesteps, num_states) and of moves.

    Moves (num_timesteps - 1, num_bands, num_states) are indexed as `w`, staying included.
    """
    before, taken = forward(x, w, initial, n, log_add, parallel)
    states, moves = smooth(before, w, final, n, parallel)
    return log_sum(row(before, n - 1) + final, 0) + taken, states, moves


def probabilities(log_weights: Array, axis: int | tuple[int, ...]) -> Array:
    """Normalise weights along axes; zeros if all weights are zero."""
    weights = jnp.exp(log_weights - finite(log_weights.max(axis, keepdims=True)))
    total = weights.sum(axis, keepdims=True)
    return weights / jnp.maximum(total, 1.0)  # the largest weight is one, or all are zeros


@one_by_one
def evidence(x: Array, w: Array, initial: Array, final: Array, n: Array, parallel: bool | None) -> Array:
    """Log of the summed weight of all paths."""
    table, taken = forward(x, w, initial, n, log_add, parallel)
    return log_sum(row(table, n - 1) + final, 0) + taken


def draw(x: Array, w: Array, initial: Array, final: Array, n: Array, key: Array,
         num_draws: int, parallel: bool | None) -> tuple[Array, Array]:  # fmt: skip
    """Log evidence, and starts (num_draws, num_states) of paths drawn from the posterior.

    Forward filtering, backward sampling.
    """
    table, taken = forward(x, w, initial, n, log_add, parallel)
    states, shifts = numbers(x.shape[1])[None], numbers(w.shape[1])[None]
    ends = row(table, n - 1) + final
    last = pick(key, jnp.broadcast_to(ends, (num_draws, len(ends))), 1)

    def step(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        t, (k, starts) = n - 1 - i, carry
        source = row(table, t - 1)[jnp.maximum(k[:, None] - shifts, 0)]
        logits = source + row(w, t - 1).T[k]
        jump = pick(jax.random.fold_in(key, t), logits, 1)
        entered = (states > (k - jump)[:, None]) & (states <= k[:, None])
        return k - jump, jnp.where(entered, t, starts)

    starts = jnp.where(states > last[:, None], n, 0)
    return log_sum(ends, 0) + taken, lax.fori_loop(jnp.int32(0), n - 1, step, (last, starts))[1]


def rank(x: Array, w: Array, initial: Array, final: Array, n: Array, count: int) -> tuple[Array, Array]:
    """Starts (count, num_states) and log weights (count,) of the best paths; -inf if there are fewer.

    Every state keeps its `count` best histories, each by the jump that led to it and the rank of its
    predecessor.
    """
    (num_timesteps, num_states), num_bands = x.shape, w.shape[1]
    states = numbers(num_states)[None]
    first = jnp.full((num_states, count), NEVER).at[:, 0].set(initial + known(x[0]))

    def step(t: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        before, pointers = carry
        weight = row(w, t - 1)
        ways = [forwards(before.T, d).T + weight[d][:, None] for d in range(num_bands)]
        best, pointer = lax.top_k(jnp.concatenate(ways, axis=1), count)
        pointers = lax.dynamic_update_index_in_dim(pointers, pointer.astype(jnp.int32), t, 0)
        return best + known(row(x, t))[:, None], pointers

    pointers = jnp.zeros((num_timesteps, num_states, count), jnp.int32)
    best, pointers = lax.fori_loop(jnp.int32(1), n, step, (first, pointers))
    log_prob, ends = lax.top_k((best + final[:, None]).ravel(), count)
    state, place = (ends // count).astype(jnp.int32), (ends % count).astype(jnp.int32)

    def back(i: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        t, (k, place, starts) = n - 1 - i, carry
        pointer = row(pointers, t)[k, place]
        jump, place = pointer // count, pointer % count
        entered = (states > (k - jump)[:, None]) & (states <= k[:, None])
        return k - jump, place, jnp.where(entered, t, starts)

    starts = jnp.where(states > state[:, None], n, 0)
    return lax.fori_loop(jnp.int32(0), n - 1, back, (state, place, starts))[2], log_prob
