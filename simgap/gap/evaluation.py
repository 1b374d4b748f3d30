"""What a candidate leaves: the contact equations' residuals with its effects taken out, and derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects import name_of
from simgap.effects.base import World
from simgap.gap.frame import Arrays
from simgap.gap.problem import Problem, columns_of, slots
from simgap.gap.residuals import contact, residuals
from simgap.gap.whitening import Whitening

ROWS = 8  # numerics: coordinates that are evaluated at once, in one compiled program
STEP = 1e-5  # numerics: of a usual deviation, for differences


def corrected(world: World, u: jax.Array, on: jax.Array, num_properties: int) -> World:
    """The world with every effect of coordinates u (all columns) taken out; `on` (num_slots,)."""
    world = jax.tree.map(lambda z: jnp.asarray(z, float), world)
    for k, slot in enumerate(slots(num_properties)[0]):
        values = {p.name: p.value(u[slot.start + j]) for j, p in enumerate(slot.effect.parameters)}

        def taken_out(values=values, effect=slot.effect, k=k, world=world) -> World:
            changed = effect.correct(world, values, on[k])  # type: ignore[misc]
            return jax.tree.map(lambda new, old: jnp.broadcast_to(new, old.shape), changed, world)

        world = jax.lax.cond(on[k] > 0, taken_out, lambda world=world: world)
    return world


def whitened(
    world: World,
    arrays: Arrays,
    w: Whitening,
    centre: jax.Array,
    spread: jax.Array,
    u: jax.Array,
    on: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Whitened residuals (T, N, C) at coordinates u, and by trial and subtask (T, S) the cost of doubts.

    A residual in doubt counts for less; half the log of its variance's factor is what that costs [nats].
    """
    properties = centre + spread * u[: centre.size].reshape(centre.shape)
    noise = 1 / jnp.where(w.weight > 0, w.weight, 1.0)
    raw, factor = residuals(corrected(world, u, on, centre.size), arrays, properties, noise)
    cost = jnp.einsum("tns,tnc->ts", w.member, jnp.where(w.weight > 0, 0.5 * jnp.log(factor), 0.0))
    return raw / jnp.sqrt(factor) * w.weight, cost


@jax.jit
def _evaluated_at(world, arrays, w, centre, spread, u, on):
    """Whitened residuals (B, T, N, C) at B rows of coordinates, and the cost of doubts (B,)."""
    z, doubts = jax.vmap(lambda row: whitened(world, arrays, w, centre, spread, row, on))(u)
    return z, doubts.sum((1, 2))


def residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Whitened residuals (T, N, C) of a candidate at coordinates u."""
    rows = jnp.tile(jnp.asarray(u), (ROWS, 1))
    return np.asarray(_evaluated_at(*_constants(given), rows, jnp.asarray(_on(given, effects)))[0][0])


@partial(jax.jit, static_argnames="num_properties")
def _without(world, u, on, num_properties):
    world = corrected(world, u, on, num_properties)
    return world._replace(force=contact(world), load=jnp.zeros_like(world.load))


@jax.jit
def _raw(world, arrays, w, centre, spread, u, on):
    noise = 1 / jnp.where(w.weight > 0, w.weight, 1.0)
    properties = centre + spread * u[: centre.size].reshape(centre.shape)
    return residuals(corrected(world, u, on, centre.size), arrays, properties, noise)[0]


def world_without(given: Problem, effects: Sequence[str], u: np.ndarray) -> World:
    """The recorded world with the effects at coordinates u taken out of it, late forces in time again."""
    world, on = _constants(given)[0], jnp.asarray(_on(given, effects))
    return _without(world, jnp.asarray(u), on, given.num_properties)


def raw_residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Residuals (T, N, C) in units of their channels."""
    return np.asarray(_raw(*_constants(given), jnp.asarray(u), jnp.asarray(_on(given, effects))))


def _constants(given: Problem):
    tree = (given.frame.world, given.frame.arrays, given.whitening, given.centre, given.spread)
    return jax.tree.map(jnp.asarray, tree)


def _on(given: Problem, effects: Sequence[str]) -> np.ndarray:
    names = {name_of(e) for e in effects}
    return np.array([float(s.effect.name in names) for s in slots(given.num_properties)[0]])


class Evaluated(NamedTuple):
    """A candidate at some coordinates: its residual (n,), the cost of doubts [nats], both one's derivatives
    `push` (n, K) and `lift` (K,), and the cost."""

    residual: np.ndarray
    doubts: float
    push: np.ndarray
    lift: np.ndarray
    cost: float


def evaluated(
    given: Problem, effects: tuple[str, ...], u: np.ndarray, mine: np.ndarray, blocks: list[np.ndarray]
) -> Evaluated:
    """What a candidate leaves at coordinates u, and its derivatives by the columns `mine`.

    They are differences over a small step: in double precision good to STEP of a usual deviation, and cheaper
    to compile than derivatives.
    """
    there, constants, on = given.whitening.weight > 0, _constants(given), jnp.asarray(_on(given, effects))
    rows = np.concatenate([u[None], u + STEP * np.eye(u.size)[mine]])
    z, doubts = [], []
    for at in range(0, len(rows), ROWS):
        some = rows[at : at + ROWS]
        some = np.concatenate([some, np.repeat(some[-1:], ROWS - len(some), 0)])
        residual, doubt = _evaluated_at(*constants, jnp.asarray(some), on)
        z.append(np.asarray(residual)[:, there])
        doubts.append(np.asarray(doubt))
    z, doubts = np.concatenate(z)[: len(rows)], np.concatenate(doubts)[: len(rows)]
    push, lift = (z[1:] - z[0]).T / STEP, (doubts[1:] - doubts[0]) / STEP
    own = u[mine[: given.num_properties]]
    cost = 0.5 * float(given.product(z[0], z[0])) + float(doubts[0]) + 0.5 * float(own @ own)
    for block in blocks:
        x = u[mine[block]]
        cost += 0.5 * (1 + block.size) * float(np.log1p(x @ x))
    return Evaluated(z[0], float(doubts[0]), push, lift, cost)


def derivatives(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Derivatives (n, K) of a candidate's n whitened residuals by its free columns, at coordinates u.

    Residuals are those that exist, in the order of the mask `whitening.weight > 0`.
    """
    return evaluated(given, tuple(effects), u, columns_of(given, effects), []).push
