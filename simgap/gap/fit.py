"""Properties and effects fitted together: batched Gauss-Newton over candidates in one program."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects import fitted as known_effects
from simgap.effects.base import Effect, World, tips
from simgap.gap.frame import Arrays, Frame
from simgap.gap.noise import NoiseModel, Whitening, whiten, whitening
from simgap.gap.residuals import contact, residuals

SMALL, LARGE = 8, 26  # columns of effects (beyond the properties), two compiled shapes
STEPS = 12
FLAT = {"weight": 0.4, "width": 0.02, "height": 0.02}  # sd of a property that nothing else tells


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
    """A frame with its whitening and the properties' prior: `centre`, `spread` (O, 3)."""

    frame: Frame
    whitening: Whitening
    centre: np.ndarray
    spread: np.ndarray

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
    """A fitted candidate: `columns` (K,) of its free parameters, coordinates `u` (all columns).

    `blocks`: quadratic forms of the whitened residual about the optimum by trial and subtask:
    H (T, S, K, K), g (T, S, K), c (T, S), so that the residual's square at u + w is
    c + 2 g w + w H w; twice the cost of doubts is among the squares. `cost` is half their sum plus prior.
    """

    effects: tuple[str, ...]
    u: np.ndarray
    columns: np.ndarray
    hessian: np.ndarray
    gradient: np.ndarray
    square: np.ndarray
    cost: float


def problem(frame: Frame, noise: NoiseModel, actual: dict | None = None) -> Problem:
    """The problem of a frame; `actual` as `estimation.actual` reads it narrows the prior."""
    a, w, objects = frame.arrays, frame.world, frame.task.objects
    valid = (a.there[..., 6] > 0) & (a.phase[..., 2] > 0)
    centre, spread = np.zeros((len(objects), 3)), np.zeros((len(objects), 3))
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
    return Problem(frame, whitening(frame, noise), centre, spread)


def without(given: Problem, samples: np.ndarray) -> Problem:
    """The problem with some residuals (T, N, C) taken to be missing."""
    arrays, weight = given.frame.arrays, given.whitening.weight
    there = np.where(samples, 0.0, arrays.there)
    frame = replace(given.frame, arrays=arrays._replace(there=there))
    return replace(
        given, frame=frame, whitening=given.whitening._replace(weight=np.where(samples, 0, weight))
    )


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
    return whiten(raw / jnp.sqrt(factor), w), cost


@jax.jit
def _linearised(world, arrays, w, centre, spread, u, on, columns):
    """Whitened residuals (T, N, C) at u, the cost of doubts (T, S), and their derivatives by the free
    columns (T, N, C, K), (T, S, K)."""

    def of(step):
        return whitened(world, arrays, w, centre, spread, u.at[columns].add(step), on)

    step = jnp.zeros(columns.shape[0])
    now, push = jax.linearize(of, step)
    return *now, *(jnp.moveaxis(d, 0, -1) for d in jax.vmap(push)(jnp.eye(step.size)))


@jax.jit
def _residual(world, arrays, w, centre, spread, u, on):
    return whitened(world, arrays, w, centre, spread, u, on)[0]


def residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Whitened residuals (T, N, C) of a candidate at coordinates u."""
    return np.asarray(
        _residual(*_constants(given), jnp.asarray(_extended(u)), jnp.asarray(_on(given, effects)))
    )


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
    return _without(world, jnp.asarray(_extended(u)), on, given.num_properties)


def raw_residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Residuals (T, N, C) in units of their channels."""
    return np.asarray(_raw(*_constants(given), jnp.asarray(_extended(u)), jnp.asarray(_on(given, effects))))


def _constants(given: Problem):
    tree = (given.frame.world, given.frame.arrays, given.whitening, given.centre, given.spread)
    return jax.tree.map(jnp.asarray, tree)


def _extended(u: np.ndarray) -> np.ndarray:
    return np.concatenate([u, [0.0]])


def _on(given: Problem, effects: Sequence[str]) -> np.ndarray:
    return np.array([float(s.effect.name in effects) for s in slots(given.num_properties)[0]])


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
    """Columns of the properties and of the named effects."""
    mine = [np.arange(s.start, s.stop) for s in slots(given.num_properties)[0] if s.effect.name in effects]
    return np.concatenate([np.arange(given.num_properties), *mine]).astype(int)


def limits(given: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of all coordinates."""
    places, total = slots(given.num_properties)
    low, high = np.full(total, -np.inf), np.full(total, np.inf)
    for slot in places:
        for j, p in enumerate(slot.effect.parameters):
            low[slot.start + j], high[slot.start + j] = p.limits
    return low, high


def fit(given: Problem, starts: Sequence[Start], steps: int = STEPS) -> list[Fitted]:
    """Every start fitted by Levenberg-Marquardt, two at a time, in programs of two widths."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda s: _fit_one(given, s, steps), starts))


def _fit_one(given: Problem, start: Start, steps: int) -> Fitted:
    """One candidate; coordinates stay within their limits."""
    mine = columns_of(given, start.effects)
    columns = _padded(given, start.effects, mine)
    low, high = (edge[mine] for edge in limits(given))
    u = _extended(start.u)
    u[mine] = np.clip(u[mine], low, high)
    constants, there = _constants(given), given.whitening.weight > 0
    on = jnp.asarray(_on(given, start.effects))

    def evaluate(at):
        z, doubt, push, lift = _linearised(*constants, jnp.asarray(at), on, jnp.asarray(columns))
        z, push = np.asarray(z)[there], np.asarray(push)[there][:, : len(mine)]
        doubt, lift = np.asarray(doubt), np.asarray(lift)[..., : len(mine)]
        cost = 0.5 * float(z @ z) + float(doubt.sum()) + 0.5 * float(at[mine] @ at[mine])
        return z, doubt, push, lift, cost

    now, damping = evaluate(u), 1e-3
    for _ in range(steps):
        z, _, push, lift, cost = now
        slope = push.T @ z + lift.sum((0, 1)) + u[mine]
        step = _bounded_step(u[mine], slope, push.T @ push + np.eye(len(mine)), damping, low, high)
        trial = u.copy()
        trial[mine] = np.clip(u[mine] + step, low, high)
        new = evaluate(trial)
        if np.isfinite(new[-1]) and new[-1] < cost:
            u, now, damping = trial, new, damping / 5
            if cost - new[-1] < 0.02:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return _fitted(given, start.effects, u[:-1], mine, *now)


def derivatives(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Derivatives (n, K) of a candidate's n whitened residuals by its free columns, at coordinates u.

    Residuals are those that exist, in the order of the mask `whitening.weight > 0`.
    """
    mine = columns_of(given, effects)
    columns = jnp.asarray(_padded(given, effects, mine))
    on = jnp.asarray(_on(given, effects))
    push = _linearised(*_constants(given), jnp.asarray(_extended(u)), on, columns)[2]
    return np.asarray(push)[given.whitening.weight > 0][:, : len(mine)]


def _padded(given: Problem, effects: Sequence[str], mine: np.ndarray) -> np.ndarray:
    """Columns `mine` of a candidate, filled up to one of two widths."""
    extra = len(mine) - given.num_properties
    if extra > LARGE:
        raise ValueError(f"{'+'.join(effects)} has {extra} parameters; {LARGE} are provided for")
    nothing = slots(given.num_properties)[1]  # the last column, which nothing reads
    columns = np.full(given.num_properties + (SMALL if extra <= SMALL else LARGE), nothing)
    columns[: len(mine)] = mine
    return columns


def _fitted(
    given: Problem,
    effects: tuple[str, ...],
    u: np.ndarray,
    columns: np.ndarray,
    z: np.ndarray,
    doubt: np.ndarray,
    push: np.ndarray,
    lift: np.ndarray,
    cost: float,
) -> Fitted:
    """Quadratic forms by trial and subtask of a linearised residual, the cost of doubts included."""
    frame, there = given.frame, given.whitening.weight > 0
    trials, steps = there.shape[0], len(frame.steps)
    cell = np.arange(trials)[:, None] * steps + frame.arrays.subtask
    cell = np.broadcast_to(cell[..., None], there.shape)[there]
    k = len(columns)
    hessian, gradient, square = (
        np.zeros((trials * steps, k, k)),
        np.zeros((trials * steps, k)),
        np.zeros(trials * steps),
    )
    for at in np.unique(cell):
        mine = cell == at
        j = push[mine]
        hessian[at], gradient[at], square[at] = j.T @ j, j.T @ z[mine], z[mine] @ z[mine]
    shape = (trials, steps)
    return Fitted(
        effects,
        u,
        columns,
        hessian.reshape(*shape, k, k),
        gradient.reshape(*shape, k) + lift,
        square.reshape(shape) + 2 * doubt,
        cost,
    )


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
