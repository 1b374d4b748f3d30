"""Properties and effects fitted together: batched Gauss-Newton over candidates in one program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects import fitted as known_effects
from simgap.effects import free_parameters, name_of
from simgap.effects.base import Effect, World, tips
from simgap.gap.frame import Arrays, Frame
from simgap.gap.residuals import contact, residuals
from simgap.gap.whitening import Whitening, whitening

ROWS = 8  # numerics: coordinates that are evaluated at once, in one compiled program
STEP = 1e-5  # numerics: of a usual deviation, for differences
STEPS = 12  # numerics: of an iteration, at most
CLOSE = 0.02  # numerics: nats
FLAT = {"weight": 0.4, "width": 0.02, "height": 0.02}  # chosen: sd of a property that nothing else tells


@dataclass(frozen=True)
class Slot:
    """One effect's place among the columns of all parameters."""

    effect: Effect
    start: int

    @property
    def stop(self) -> int:
        """One past its last column."""
        return self.start + len(self.effect.parameters)


@lru_cache
def slots(num_properties: int) -> tuple[tuple[Slot, ...], int]:
    """Slots of all deterministic effects in order of correction, and the number of columns."""
    out, at = [], num_properties
    known = [e for e in known_effects().values() if e.correct is not None]
    for effect in sorted(known, key=lambda e: (e.stage, e.name)):
        out.append(Slot(effect, at))
        at += len(effect.parameters)
    return tuple(out), at


@dataclass(frozen=True)
class Problem:
    """A frame with its whitening and the properties' prior: `centre`, `spread` (O, 3); which of weight, width
    and height were `measured` (O, 3) apart."""

    frame: Frame
    whitening: Whitening
    centre: np.ndarray
    spread: np.ndarray
    measured: np.ndarray

    @property
    def num_properties(self) -> int:
        """Number of property columns."""
        return self.centre.size

    @property
    def size(self) -> int:
        """Number of residuals."""
        return int((self.whitening.weight > 0).sum())


@dataclass(frozen=True)
class Start:
    """A candidate's start: its effects and the coordinates (all columns) to start from."""

    effects: tuple[str, ...]
    u: np.ndarray


@dataclass(frozen=True)
class Fitted:
    """A fitted candidate: coordinates `u` (all columns), of which `columns` (K,) were free.

    `residual` (n,): what it leaves, whitened, in the order of the mask `whitening.weight > 0`; `push` (n, K)
    its derivatives; `doubts` [nats]: the cost of residuals in doubt; `cost`: these, half the squares and the
    prior.
    """

    effects: tuple[str, ...]
    u: np.ndarray
    columns: np.ndarray
    residual: np.ndarray
    push: np.ndarray
    doubts: float
    cost: float


def problem(frame: Frame, actual: dict | None = None) -> Problem:
    """The problem of a frame; `actual` as `estimation.actual` reads it narrows the prior."""
    a, w, objects = frame.arrays, frame.world, frame.task.objects
    valid = (a.there[..., 6] > 0) & (a.phase[..., 2] > 0)
    centre, spread = np.zeros((len(objects), 3)), np.zeros((len(objects), 3))
    measured = np.zeros((len(objects), 3), bool)
    net = w.force[..., 1] + w.force[..., 3]
    position, _ = tips(jax.tree.map(jnp.asarray, w))
    distance = np.asarray(position[..., 2] - position[..., 0])
    distance = distance + w.force[..., 0] * w.give_normal[0] - w.force[..., 2] * w.give_normal[1]
    for o, name in enumerate(objects):
        mine = valid & (np.einsum("tnm,m->tn", a.onehot, a.objects[:, o]) > 0)
        given = (actual or {}).get(name, {})
        guess = (float(np.median(net[mine])), float(np.median(distance[mine]))) if mine.any() else (0.4, 0.02)
        for k, prop in enumerate(("weight", "width", "height")):
            start = max(guess[k], 1e-3) if k < 2 else 0.015
            centre[o, k], spread[o, k] = start, FLAT[prop]
            if prop in given:
                value, sd = given[prop]
                centre[o, k], spread[o, k] = value, np.hypot(sd, (2e-3 * value, 3e-5, 4e-5)[k])
                measured[o, k] = True
    return Problem(frame, whitening(frame), centre, spread, measured)


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


def neutral(given: Problem) -> np.ndarray:
    """Coordinates of no effect at all: properties at the centre of their prior."""
    places, total = slots(given.num_properties)
    u = np.zeros(total)
    for slot in places:
        for j, p in enumerate(slot.effect.parameters):
            if not p.log:
                u[slot.start + j] = p.coordinate(p.neutral)
    return u


def columns_of(given: Problem, effects: Sequence[str]) -> np.ndarray:
    """Columns of the properties and of the parameters that effects' forms have free."""
    out = [np.arange(given.num_properties)]
    places = {s.effect.name: s for s in slots(given.num_properties)[0]}
    for key in effects:
        slot, names = places[name_of(key)], free_parameters(key)
        out.append(
            np.array([slot.start + j for j, p in enumerate(slot.effect.parameters) if p.name in names])
        )
    return np.concatenate(out).astype(int)


def limits(given: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of all coordinates."""
    places, total = slots(given.num_properties)
    low, high = np.full(total, -np.inf), np.full(total, np.inf)
    for slot in places:
        for j, p in enumerate(slot.effect.parameters):
            low[slot.start + j], high[slot.start + j] = p.limits
    return low, high


def fit(given: Problem, start: Start, steps: int = STEPS) -> Fitted:
    """A start fitted by Levenberg-Marquardt; coordinates stay within their limits.

    Properties have normal priors, an effect's parameters together a Cauchy distribution.
    """
    mine, z = columns_of(given, start.effects), given.num_properties
    low, high = (edge[mine] for edge in limits(given))
    u = start.u.copy()
    u[mine] = np.clip(u[mine], low, high)
    blocks, at = [], z
    for key in start.effects:
        blocks.append(np.arange(at, at + len(free_parameters(key))))
        at += blocks[-1].size
    now, damping = _evaluated(given, start.effects, u, mine, blocks), 1e-3
    for _ in range(steps):
        prior = np.ones(mine.size)
        for block in blocks:
            x = u[mine[block]]
            prior[block] = (1 + block.size) / (1 + x @ x)
        slope = now.push.T @ now.residual + now.lift + prior * u[mine]
        bend = now.push.T @ now.push + np.diag(prior)
        step = _bounded_step(u[mine], slope, bend, damping, low, high)
        trial = u.copy()
        trial[mine] = np.clip(u[mine] + step, low, high)
        new = _evaluated(given, start.effects, trial, mine, blocks)
        if np.isfinite(new.cost) and new.cost < now.cost:
            gained, u, now, damping = now.cost - new.cost, trial, new, damping / 5
            if gained < CLOSE:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return Fitted(start.effects, u, mine, now.residual, now.push, now.doubts, now.cost)


class _Evaluated(NamedTuple):
    residual: np.ndarray
    doubts: float
    push: np.ndarray
    lift: np.ndarray
    cost: float


def _evaluated(
    given: Problem, effects: tuple[str, ...], u: np.ndarray, mine: np.ndarray, blocks: list[np.ndarray]
) -> _Evaluated:
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
    cost = 0.5 * float(z[0] @ z[0]) + float(doubts[0]) + 0.5 * float(own @ own)
    for block in blocks:
        x = u[mine[block]]
        cost += 0.5 * (1 + block.size) * float(np.log1p(x @ x))
    return _Evaluated(z[0], float(doubts[0]), push, lift, cost)


def derivatives(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Derivatives (n, K) of a candidate's n whitened residuals by its free columns, at coordinates u.

    Residuals are those that exist, in the order of the mask `whitening.weight > 0`.
    """
    return _evaluated(given, tuple(effects), u, columns_of(given, effects), []).push


def _bounded_step(
    at: np.ndarray, slope: np.ndarray, bend: np.ndarray, damping: float, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """A damped Newton step; coordinates that would leave their bounds are held there."""
    held = np.zeros(at.size, bool)
    step = np.zeros(at.size)
    for _ in range(3):
        free = ~held
        matrix = bend[np.ix_(free, free)]
        step[:] = 0.0
        step[free] = -np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), slope[free])
        out = free & (((step < 0) & (at <= low + 1e-9)) | ((step > 0) & (at >= high - 1e-9)))
        if not out.any():
            break
        held |= out
    return step
