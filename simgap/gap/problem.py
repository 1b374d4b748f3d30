"""The problem of fitting: a frame, its whitening, the properties' prior, and a column for every unknown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from estimation.priors import PROPERTY_LOG_SD, PROPERTY_MEDIAN
from hmmseg.contact.decompose import PROPERTIES
from simgap.attribution.problem import Rows, cosines
from simgap.bounded import least
from simgap.effect import Parameter
from simgap.effects import catalogue, free_parameters, name_of
from simgap.effects.base import HandEffect, World
from simgap.gap.frame import CHANNELS, Frame
from simgap.gap.residuals import contact, residuals

# Residuals in units of their sensors' noise.


class Whitening(NamedTuple):
    """`weight` (T, N, C) of trials, samples, channels: 1 / standard deviation, 0 where there is nothing."""

    weight: np.ndarray


def whitening(frame: Frame) -> Whitening:
    """The whitening of a frame's residuals."""
    a = frame.arrays
    return Whitening(np.where(a.there > 0, 1 / a.sd, 0.0))


# Linear unknowns with a normal prior, integrated out of a least-squares problem.


@dataclass(frozen=True)
class Nuisances:
    """Columns (n, Z) of whitened residuals, each per its standard deviation beforehand."""

    columns: np.ndarray

    @cached_property
    def _basis(self) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal directions (n, R), and what share (R,) of a square along each they take away."""
        bend = self.columns.T @ self.columns
        square, turn = np.linalg.eigh(bend)
        kept = square > 1e-9 * max(float(square.max(initial=0.0)), 1e-9)
        return self.columns @ (turn[:, kept] / np.sqrt(square[kept])), square[kept] / (1 + square[kept])

    def product(self, a: np.ndarray, b: np.ndarray) -> Any:
        """a' (1 + columns columns')^-1 b of (n, ...) each: what nuisances may have made counts less."""
        basis, taken = self._basis
        mine, other = basis.T @ a, basis.T @ b
        return a.T @ b - (mine.T * taken) @ other

    def left(self, residual: np.ndarray) -> np.ndarray:
        """What they leave of a residual (n,), each at its likeliest value."""
        basis, taken = self._basis
        return residual - basis @ (taken * (basis.T @ residual))

    def kept(self, rows: Rows, variance: np.ndarray) -> np.ndarray:
        """What they leave of independent cosine coefficients with these variances (n,)."""
        mine, (basis, taken) = np.flatnonzero(variance > 0), self._basis
        few = cosines(rows, basis)[0][mine]
        out = np.zeros(variance.size)
        out[mine] = np.square(np.eye(mine.size) - (few * taken) @ few.T) @ variance[mine]
        return out


# prior: what measured weight (share), width, height [m] may be off in addition to their own sd
MEASURED = (2e-3, 3e-5, 4e-5)


@dataclass(frozen=True)
class Slot:
    """One effect's place among the columns of all parameters."""

    effect: HandEffect
    start: int

    @property
    def stop(self) -> int:
        """One past its last column."""
        return self.start + len(self.effect.parameters)


@lru_cache
def slots(num_properties: int) -> tuple[tuple[Slot, ...], int]:
    """Slots of all deterministic effects in order of correction, and the number of columns."""
    out, at = [], num_properties
    known = [e for e in catalogue().values() if e.correct is not None]
    for effect in sorted(known, key=lambda e: (e.stage, e.name)):
        out.append(Slot(effect, at))
        at += len(effect.parameters)
    return tuple(out), at


@dataclass(frozen=True)
class Problem:
    """A frame with its whitening and the properties' prior: `centre`, `sd` (O, 3); which of weight, width
    and height were `measured` (O, 3) apart; `nuisances` that every fit leaves free."""

    frame: Frame
    whitening: Whitening
    centre: np.ndarray
    sd: np.ndarray
    measured: np.ndarray
    nuisances: Nuisances

    def product(self, a: np.ndarray, b: np.ndarray) -> Any:
        """Products of residuals, or of their derivatives, (n, ...), nuisances integrated out."""
        return self.nuisances.product(a, b) if self.nuisances.columns.size else a.T @ b

    def properties(self, u: np.ndarray) -> np.ndarray:
        """Weight, width and height (..., O, 3) of the blocks at coordinates (..., all columns)."""
        own = u[..., : self.num_properties]
        return self.centre + self.sd * own.reshape(*own.shape[:-1], *self.centre.shape)

    @cached_property
    def noise(self) -> np.ndarray:
        """Standard deviation (T, N, C) of every residual, 1 where there is none."""
        return 1 / np.where(self.whitening.weight > 0, self.whitening.weight, 1.0)

    @cached_property
    def existing(self) -> np.ndarray:
        """Places (n,) of the residuals among all (T, N, C), in one row."""
        return np.flatnonzero(self.whitening.weight > 0)

    @property
    def num_properties(self) -> int:
        """Number of property columns."""
        return self.centre.size

    @property
    def size(self) -> int:
        """Number of residuals."""
        return self.existing.size


def problem(
    frame: Frame, actual: dict | None = None, identified: Mapping[tuple[str, str], float] | None = None
) -> Problem:
    """The problem of a frame; `actual` as `estimation.report` reads it narrows the prior.

    The prior is identification's (log-normal, `estimation.priors`), linearised about what was `identified`
    (block, property) [N, m], else about its median: in here properties are departures from those.
    """
    objects = frame.task.objects
    centre, sd = np.zeros((len(objects), 3)), np.zeros((len(objects), 3))
    measured = np.zeros((len(objects), 3), bool)
    for o, name in enumerate(objects):
        given = (actual or {}).get(name, {})
        for k, prop in enumerate(PROPERTIES):
            centre[o, k] = (identified or {}).get((name, prop), PROPERTY_MEDIAN[prop])
            sd[o, k] = centre[o, k] * PROPERTY_LOG_SD[prop]
            if prop in given:
                value, own = given[prop]
                usual = MEASURED[k] * (value if prop == "weight" else 1.0)
                centre[o, k], sd[o, k] = value, np.hypot(own, usual)
                measured[o, k] = True
    return _bare(frame, centre, sd, measured)


def rebased(frame: Frame, given: Problem) -> Problem:
    """The problem of the same blocks in another frame, without nuisances."""
    return _bare(frame, given.centre, given.sd, given.measured)


def _bare(frame: Frame, centre: np.ndarray, sd: np.ndarray, measured: np.ndarray) -> Problem:
    white = whitening(frame)
    none = Nuisances(np.zeros((int((white.weight > 0).sum()), 0)))
    return Problem(frame, white, centre, sd, measured, none)


def free_of(key: str) -> list[Parameter]:
    """The free parameters of an effect's form, in the order of its columns."""
    return [p for p in catalogue()[name_of(key)].parameters.values() if p.name in free_parameters(key)]


def neutral(given: Problem) -> np.ndarray:
    """Coordinates of no effect at all: properties at the centre of their prior."""
    places, total = slots(given.num_properties)
    u = np.zeros(total)
    for slot in places:
        for j, p in enumerate(slot.effect.parameters.values()):
            if not p.log:
                u[slot.start + j] = p.coordinate(p.nominal)
    return u


def columns_of(given: Problem, effects: Sequence[str]) -> np.ndarray:
    """Columns of the properties and of the parameters that effects' forms have free."""
    out = [np.arange(given.num_properties)]
    places = {s.effect.name: s for s in slots(given.num_properties)[0]}
    for key in effects:
        slot, names = places[name_of(key)], free_parameters(key)
        out.append(np.array([slot.start + j for j, n in enumerate(slot.effect.parameters) if n in names]))
    return np.concatenate(out).astype(int)


def limits(given: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of all coordinates."""
    places, total = slots(given.num_properties)
    low, high = np.full(total, -np.inf), np.full(total, np.inf)
    for slot in places:
        for j, p in enumerate(slot.effect.parameters.values()):
            low[slot.start + j], high[slot.start + j] = p.limits
    return low, high


# The smallest gap that matters: what rig.toml says under [tolerance], or what its sensors could not show.

SAMPLES = 0.5  # chosen: sds of one sample: a shift below that is not seen in any single one
PROPERTY = 0.01  # chosen: the same, of a property
SHARE = 0.005  # cited: of a block's width or weight: the better half of the paper's own errors (its Table 4)


def properties_tolerated(given: Problem) -> np.ndarray:
    """By how much properties (3 O,) may be off before it matters, in sds of their prior."""
    share = given.frame.rig.tolerance.property or PROPERTY
    return (share * np.abs(given.centre) / given.sd).ravel()


def tolerated(given: Problem) -> np.ndarray:
    """The smallest shift (n,) of each residual that matters, in sds of its noise.

    Positions and forces as [tolerance] has them; by default one sample's noise or SHARE of the smallest
    block's width and weight, whichever is more. Velocities matter as much as a sample's noise.
    """
    frame, there = given.frame, given.whitening.weight > 0
    stated = frame.rig.tolerance
    width, weight = (float(np.abs(given.centre[:, k]).min()) for k in (1, 0))
    noise = frame.arrays.sample
    out = np.empty_like(given.whitening.weight)
    for c, name in enumerate(CHANNELS):
        least = SAMPLES * noise[..., c]
        if name in ("x", "y", "distance", "offset"):
            least = stated.position or np.maximum(least, SHARE * width)
        elif name in ("fx", "fy", "grip", "shear"):
            least = stated.force or np.maximum(least, SHARE * weight)
        out[..., c] = least * given.whitening.weight[..., c]
    return out[there]


# What a candidate leaves: the contact equations' residuals with its effects taken out, and derivatives.

STEP = 1e-5  # numerics: of a usual deviation, for differences


def corrected(world: World, u: np.ndarray, effects: Sequence[str], num_properties: int) -> World:
    """The world with these effects, at coordinates u (all columns), taken out."""
    names = {name_of(key) for key in effects}
    for slot in slots(num_properties)[0]:
        if slot.effect.name in names:
            each = enumerate(slot.effect.parameters.values())
            values = {p.name: p.value(u[slot.start + j]) for j, p in each}
            world = slot.effect.correct(world, values, 1.0)  # type: ignore[misc]
    return world


def whitened(given: Problem, world: World, properties: np.ndarray) -> tuple[np.ndarray, float]:
    """Whitened residuals (T, N, C) of a world that effects were taken out of, and the cost of doubts [nats].

    A residual in doubt counts for less; half the log of its variance's factor is what that costs.
    `properties` (O, 3): weight, width, height.
    """
    weight = given.whitening.weight
    raw, factor, unseen = residuals(world, given.frame.arrays, properties, given.noise)
    cost = unseen + 0.5 * float(np.log(factor[weight > 0]).sum())
    return raw / np.sqrt(factor) * weight, cost


def residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Whitened residuals (T, N, C) of a candidate at coordinates u."""
    return whitened(given, _without_effects(given, effects, u), given.properties(u))[0]


def residual_of(given: Problem, world: World) -> np.ndarray:
    """Whitened residuals (n,) of a world that effects were taken out of, properties as expected."""
    return whitened(given, world, given.properties(neutral(given)))[0].ravel()[given.existing]


def world_without(given: Problem, effects: Sequence[str], u: np.ndarray) -> World:
    """The recorded world with the effects at coordinates u taken out of it, late forces in time again."""
    world = _without_effects(given, effects, u)
    return world._replace(force=contact(world), load=np.zeros_like(world.load))


def raw_residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Residuals (T, N, C) in units of their channels."""
    world = _without_effects(given, effects, u)
    return residuals(world, given.frame.arrays, given.properties(u), given.noise)[0]


def _without_effects(given: Problem, effects: Sequence[str], u: np.ndarray) -> World:
    return corrected(given.frame.world, u, effects, given.num_properties)


class Evaluated(NamedTuple):
    """A candidate at some coordinates: its residual (n,), the cost of doubts [nats], both one's derivatives
    `push` (n, K) and `lift` (K,), and the cost."""

    residual: np.ndarray
    doubts: float
    push: np.ndarray
    lift: np.ndarray
    cost: float


def cost_at(
    given: Problem, effects: tuple[str, ...], u: np.ndarray, mine: np.ndarray, blocks: list[np.ndarray]
) -> tuple[np.ndarray, float, float]:
    """What a candidate leaves (n,) at coordinates u, the cost of doubts [nats], and the cost in all."""
    left, doubts = whitened(given, _without_effects(given, effects, u), given.properties(u))
    left, own = left.ravel()[given.existing], u[mine[: given.num_properties]]
    cost = 0.5 * float(given.product(left, left)) + doubts + 0.5 * float(own @ own)
    for block in blocks:
        x = u[mine[block]]
        cost += 0.5 * (1 + block.size) * float(np.log1p(x @ x))
    return left, doubts, cost


def evaluated(
    given: Problem,
    effects: tuple[str, ...],
    u: np.ndarray,
    mine: np.ndarray,
    at: tuple[np.ndarray, float, float],
    usual: np.ndarray | None = None,
) -> Evaluated:
    """What a candidate leaves at coordinates u, as `cost_at` has it, and its derivatives by columns `mine`.

    They are differences over a small step: in double precision good to STEP of a usual deviation. `usual`
    (n, P): those by the properties, which an effect hardly changes, where they are known already.
    """
    k, step, properties, each = given.num_properties, u.copy(), given.properties(u), []
    if usual is None:  # a property alone needs no effect taken out once more
        world = _without_effects(given, effects, u)
        each += [whitened(given, world, row) for row in given.properties(u + STEP * np.eye(k, u.size))]
    for column in mine[k:]:
        step[column] += STEP
        each.append(whitened(given, _without_effects(given, effects, step), properties))
        step[column] = u[column]
    z = np.array([residual.ravel()[given.existing] for residual, _ in each]).reshape(len(each), given.size)
    push, lift = (z - at[0]).T / STEP, (np.array([doubt for _, doubt in each]) - at[1]) / STEP
    if usual is not None:
        push = np.concatenate([usual, push], 1)
        lift = np.concatenate([np.zeros(k), lift])
    return Evaluated(*at[:2], push, lift, at[2])


def derivatives(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Derivatives (n, K) of a candidate's n whitened residuals by its free columns, at coordinates u.

    Residuals are those that exist, in the order of the mask `whitening.weight > 0`.
    """
    effects, mine = tuple(effects), columns_of(given, effects)
    return evaluated(given, effects, u, mine, cost_at(given, effects, u, mine, [])).push


# Properties and effects fitted together, by Levenberg-Marquardt steps within the limits of each.

STEPS = 12  # numerics: of an iteration, at most
CLOSE = 0.02  # numerics: nats


@dataclass(frozen=True)
class Start:
    """A candidate's start: its effects and the coordinates (all columns) to start from."""

    effects: tuple[str, ...]
    u: np.ndarray


@dataclass(frozen=True)
class Fitted:
    """A fitted candidate: coordinates `u` (all columns), of which `columns` (K,) were free.

    `residual` (n,): what it leaves, whitened, in the order of the mask `whitening.weight > 0`; `push` (n, K)
    its derivatives; `doubts` [nats]: the cost of residuals in doubt; `cost`: these, half the squares with
    nuisances integrated out, and the prior.
    """

    effects: tuple[str, ...]
    u: np.ndarray
    columns: np.ndarray
    residual: np.ndarray
    push: np.ndarray
    doubts: float
    cost: float


def fit(given: Problem, start: Start, steps: int = STEPS, usual: np.ndarray | None = None) -> Fitted:
    """A start fitted by Levenberg-Marquardt; coordinates stay within their limits.

    Properties have normal priors, an effect's parameters together a Cauchy distribution. `usual`: derivatives
    by the properties, if `evaluated` need not recompute them.
    """
    mine, z = columns_of(given, start.effects), given.num_properties
    low, high = (edge[mine] for edge in limits(given))
    u = start.u.copy()
    u[mine] = np.clip(u[mine], low, high)
    blocks, at = [], z
    for key in start.effects:
        blocks.append(np.arange(at, at + len(free_parameters(key))))
        at += blocks[-1].size
    here = cost_at(given, start.effects, u, mine, blocks)
    now, damping = evaluated(given, start.effects, u, mine, here, usual), 1e-3
    for _ in range(steps):
        prior = np.ones(mine.size)
        for block in blocks:
            x = u[mine[block]]
            prior[block] = (1 + block.size) / (1 + x @ x)
        slope = given.product(now.push, now.residual) + now.lift + prior * u[mine]
        bend = given.product(now.push, now.push) + np.diag(prior)
        step, _ = least(bend + damping * np.diag(np.diag(bend)), -slope, low - u[mine], high - u[mine])
        trial = u.copy()
        trial[mine] = np.clip(u[mine] + step, low, high)
        here = cost_at(given, start.effects, trial, mine, blocks)
        if np.isfinite(here[2]) and here[2] < now.cost:
            new = evaluated(given, start.effects, trial, mine, here, usual)
            gained, u, now, damping = now.cost - new.cost, trial, new, damping / 5
            if gained < CLOSE:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return Fitted(start.effects, u, mine, now.residual, now.push, now.doubts, now.cost)
