"""What a candidate leaves: the contact equations' residuals with its effects taken out, and derivatives."""

from __future__ import annotations

from collections.abc import Sequence
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
    world: World, arrays: Arrays, w: Whitening, properties: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Whitened residuals (T, N, C) of a world that effects were taken out of, and the cost of doubts [nats].

    A residual in doubt counts for less; half the log of its variance's factor is what that costs.
    `properties` (O, 3): weight, width, height.
    """
    noise = 1 / jnp.where(w.weight > 0, w.weight, 1.0)
    raw, factor = residuals(world, arrays, properties, noise)
    cost = jnp.where(w.weight > 0, 0.5 * jnp.log(factor), 0.0).sum()
    return raw / jnp.sqrt(factor) * w.weight, cost


_corrected = jax.jit(corrected, static_argnames="num_properties")
_whitened = jax.jit(whitened)


@jax.jit
def _whitened_at_each(world, arrays, w, properties):
    """Of B rows of properties (B, O, 3): a property alone needs no effect taken out once more."""
    return jax.vmap(lambda row: whitened(world, arrays, w, row))(properties)


def residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Whitened residuals (T, N, C) of a candidate at coordinates u."""
    _, arrays, w = given.constants
    world = _without_effects(given, effects, u)
    return np.asarray(_whitened(world, arrays, w, jnp.asarray(given.properties(u)))[0])


@jax.jit
def _in_contact(world):
    return world._replace(force=contact(world), load=jnp.zeros_like(world.load))


def world_without(given: Problem, effects: Sequence[str], u: np.ndarray) -> World:
    """The recorded world with the effects at coordinates u taken out of it, late forces in time again."""
    return _in_contact(_without_effects(given, effects, u))


def raw_residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Residuals (T, N, C) in units of their channels."""
    world, (_, arrays, w) = _without_effects(given, effects, u), given.constants
    noise = 1 / jnp.where(w.weight > 0, w.weight, 1.0)
    return np.asarray(_raw(world, arrays, jnp.asarray(given.properties(u)), noise)[0])


_raw = jax.jit(residuals)


def _without_effects(given: Problem, effects: Sequence[str], u: np.ndarray) -> World:
    on = jnp.asarray(_on(given, effects))
    return _corrected(given.constants[0], jnp.asarray(u), on, given.num_properties)


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
    k, on = given.num_properties, jnp.asarray(_on(given, effects))
    recorded, arrays, w = given.constants

    def without(u: np.ndarray) -> World:
        return _corrected(recorded, jnp.asarray(u), on, k)

    steps = given.properties(u + STEP * np.eye(k + 1, u.size, -1))
    found, cost = _whitened_at_each(without(u), arrays, w, jnp.asarray(steps))
    z, doubts = [np.asarray(found)], [np.asarray(cost)]
    usual, step = jnp.asarray(steps[0]), u.copy()
    for column in mine[k:]:
        step[column] += STEP
        residual, doubt = _whitened(without(step), arrays, w, usual)
        step[column] = u[column]
        z.append(np.asarray(residual)[None])
        doubts.append(np.asarray(doubt)[None])
    z = np.concatenate([each.reshape(len(each), -1)[:, given.existing] for each in z])
    doubts = np.concatenate(doubts)
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
