"""The fitting problem: a frame, the noise of its residuals, priors, and the columns of all parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from estimation.priors import PROPERTY_LOG_SD, PROPERTY_MEDIAN
from estimation.report import Actual
from hmmseg.contact.decompose import PROPERTIES
from simgap.bounded import least
from simgap.effect import Parameter
from simgap.effects import catalogue, free_parameters, name_of
from simgap.effects.base import World, turning_compliance
from simgap.gap.frame import CHANNELS, Frame
from simgap.gap.residuals import STANCES, contact, residuals

# Linear unknowns with a normal prior, integrated out of a least-squares problem.


@dataclass(frozen=True)
class Nuisances:
    """Derivatives (n, Z) of whitened residuals by nuisances, in units of their prior standard deviations."""

    columns: np.ndarray

    @cached_property
    def _basis(self) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal directions (n, R), and the share (R,) of a square along each that nuisances explain."""
        curvature = self.columns.T @ self.columns
        square, turn = np.linalg.eigh(curvature)
        kept = square > 1e-9 * max(float(square.max(initial=0.0)), 1e-9)
        return self.columns @ (turn[:, kept] / np.sqrt(square[kept])), square[kept] / (1 + square[kept])

    def product(self, a: np.ndarray, b: np.ndarray) -> Any:
        """a' (1 + columns columns')^-1 b of (n, ...) each: directions that nuisances explain count less."""
        basis, taken = self._basis
        mine, other = basis.T @ a, basis.T @ b
        return a.T @ b - (mine.T * taken) @ other

    def left(self, residual: np.ndarray) -> np.ndarray:
        """The residual (n,) minus the likeliest nuisances."""
        basis, taken = self._basis
        return residual - basis @ (taken * (basis.T @ residual))


# prior: error of measured weight (relative), width and height [m] in addition to the stated sd
MEASURED = (2e-3, 3e-5, 4e-5)


@lru_cache
def slots(num_common: int) -> tuple[dict[str, int], np.ndarray]:
    """First column of each deterministic effect, in order of correction, and the limits (2, U) of all."""
    known = sorted((e.stage, e.name) for e in catalogue().values() if e.correct is not None)
    starts, ends = dict[str, int](), [(-np.inf, np.inf)] * (num_common - len(STANCES))
    ends += [(0.0, np.inf)] * len(STANCES)  # blocks turn towards a moment
    for _, name in known:
        starts[name] = len(ends)
        ends += [p.limits for p in catalogue()[name].parameters.values()]
    return starts, np.array(ends).T


@dataclass(frozen=True)
class Problem:
    """A frame and what its residuals are fitted with, for O blocks.

    Attributes:
        frame: Aligned trials.
        weight: 1 / noise (T, N, C) of every residual; 0 where there is none.
        centre, sd: Normal prior (O, 3) of weight [N], width and height [m].
        measured: Which of these (O, 3) were measured apart from the trials.
        nuisances: Columns that every fit leaves free.
    """

    frame: Frame
    weight: np.ndarray
    centre: np.ndarray
    sd: np.ndarray
    measured: np.ndarray
    nuisances: Nuisances

    def properties(self, u: np.ndarray) -> np.ndarray:
        """Weight, width and height (O, 3) of the blocks at coordinates (all columns)."""
        return self.centre + self.sd * u[: self.centre.size].reshape(self.centre.shape)

    def turning(self, u: np.ndarray) -> np.ndarray:
        """How easily a block turns in the grip [rad/(N m)], by share of its width on which it stands."""
        pad = self.frame.rig.fingertip
        return turning_compliance(pad.normal_stiffness) * u[self.centre.size : self.num_common]

    @cached_property
    def there(self) -> np.ndarray:
        """Mask (T, N, C) of the n residuals that exist; vectors of residuals (n,) are in its order."""
        return self.weight > 0

    @cached_property
    def noise(self) -> np.ndarray:
        """Standard deviation (T, N, C) of every residual, 1 where there is none."""
        return 1 / np.where(self.there, self.weight, 1.0)

    @property
    def num_common(self) -> int:
        """Number of columns that every fit has: properties, and how easily blocks turn in the grip."""
        return self.centre.size + len(STANCES)

    @property
    def size(self) -> int:
        """Number of residuals."""
        return int(self.there.sum())


def problem(
    frame: Frame, actual: Actual | None = None, identified: Mapping[tuple[str, str], float] | None = None
) -> Problem:
    """Set up the problem of a frame, without nuisances.

    The prior is that of identification (log-normal, `estimation.priors`), linearised about the identified
    values, else about its median; departures from these are fitted.

    Args:
        frame: Aligned trials.
        actual: Measured properties as read by `estimation.report`; they narrow the prior.
        identified: Property values by block and property [N, m].
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
                centre[o, k], sd[o, k] = value, np.sqrt(own**2 + usual**2)
                measured[o, k] = True
    weight = np.where(frame.arrays.there > 0, 1 / frame.arrays.sd, 0.0)
    none = Nuisances(np.zeros((int((weight > 0).sum()), 0)))
    return Problem(frame, weight, centre, sd, measured, none)


def free_of(key: str) -> list[Parameter]:
    """Free parameters of an effect's form, in the order of its columns."""
    return [p for p in catalogue()[name_of(key)].parameters.values() if p.name in free_parameters(key)]


def neutral(given: Problem) -> np.ndarray:
    """Coordinates of no effect, with properties at the centre of their prior."""
    return np.zeros(slots(given.num_common)[1].shape[1])


def columns_of(given: Problem, effects: Sequence[str]) -> np.ndarray:
    """Columns of the properties and of the free parameters of effects' forms."""
    starts, out = slots(given.num_common)[0], [*range(given.num_common)]
    for key in effects:
        every, free = enumerate(catalogue()[name_of(key)].parameters), free_parameters(key)
        out += [starts[name_of(key)] + j for j, name in every if name in free]
    return np.array(out, int)


# The smallest gap that matters: [tolerance] of rig.toml, or what its sensors could not show.

SAMPLES = 0.5  # chosen: sds of one sample: a smaller shift is invisible in any single sample
# cited: share of a block's width or weight: the better half of the paper's own errors (its Table 4)
SHARE = 0.005


def properties_tolerated(given: Problem) -> np.ndarray | None:
    """Largest errors of properties (3 O,) that do not matter, if the rig states them.

    In standard deviations of their prior.
    """
    share = given.frame.rig.tolerance.property
    return None if share is None else (share * np.abs(given.centre) / given.sd).ravel()


def tolerated(given: Problem) -> np.ndarray:
    """Smallest shift (n,) of each residual that matters, in standard deviations of its noise.

    Positions and forces as stated in [tolerance]; by default one sample's noise or SHARE of the smallest
    block's width and weight, whichever is larger. Velocities matter from one sample's noise on.
    """
    frame = given.frame
    stated = frame.rig.tolerance
    width, weight = (float(np.abs(given.centre[:, k]).min()) for k in (1, 0))
    noise = frame.arrays.sample
    out = np.empty_like(given.weight)
    for c, name in enumerate(CHANNELS):
        least = SAMPLES * noise[..., c]
        if name in ("x", "y", "distance", "offset"):
            least = stated.position or np.maximum(least, SHARE * width)
        elif name in ("fx", "fy", "grip", "shear"):
            least = stated.force or np.maximum(least, SHARE * weight)
        out[..., c] = least * given.weight[..., c]
    return out[given.there]


# Residuals of a candidate: those of the contact equations after its effects are corrected, with derivatives.

STEP = 1e-5  # numerics: step of finite differences, in prior standard deviations


def _without_effects(given: Problem, effects: Sequence[str], u: np.ndarray) -> World:
    """The recorded world corrected for effects at coordinates u (all columns)."""
    world, names = given.frame.world, {name_of(key) for key in effects}
    for name, start in slots(given.num_common)[0].items():
        if name in names:
            effect = catalogue()[name]
            values = {n: p.value(u[start + j]) for j, (n, p) in enumerate(effect.parameters.items())}
            world = effect.correct(world, values, 1.0)  # type: ignore[misc]
    return world


def whitened(given: Problem, world: World, u: np.ndarray) -> tuple[np.ndarray, float]:
    """Whitened residuals (T, N, C) of a corrected world, and the cost of doubts [nats].

    A residual in doubt has a larger variance; half the log of this factor is its cost.

    Args:
        given: The problem.
        world: The world, corrected for effects.
        u: Coordinates, of which those that every fit has count.
    """
    raw, factor, unseen = _residuals(given, world, u)
    cost = unseen + 0.5 * float(np.log(factor[given.there]).sum())
    return raw / np.sqrt(factor) * given.weight, cost


def residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Whitened residuals (T, N, C) of a candidate at coordinates u."""
    return whitened(given, _without_effects(given, effects, u), u)[0]


def residual_of(given: Problem, world: World) -> np.ndarray:
    """Whitened residuals (n,) of a corrected world, with properties at the centre of their prior."""
    return whitened(given, world, neutral(given))[0][given.there]


def world_without(given: Problem, effects: Sequence[str], u: np.ndarray) -> World:
    """The recorded world corrected for effects at coordinates u, with late forces back in time."""
    world = _without_effects(given, effects, u)
    return world._replace(force=contact(world), load=np.zeros_like(world.load))


def raw_residual_at(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Residuals (T, N, C) of a candidate in units of their channels."""
    return _residuals(given, _without_effects(given, effects, u), u)[0]


def _residuals(given: Problem, world: World, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Residuals (`simgap.gap.residuals`) of a corrected world."""
    return residuals(world, given.frame.arrays, given.properties(u), given.turning(u), given.noise)


@dataclass(frozen=True)
class Fitted:
    """A candidate, evaluated at coordinates that are usually those of its best fit.

    Attributes:
        effects: Keys of its effects' forms.
        u: Coordinates of all parameters.
        columns: Those of them (K,) that are free.
        residual: Whitened residuals (n,).
        jacobian: Their derivatives (n, K) with respect to the free coordinates.
        doubts: Cost of residuals in doubt [nats].
        doubt_slope: Its derivatives (K,).
        cost: Doubts, half the squared residuals with nuisances integrated out, and the prior [nats].
    """

    effects: tuple[str, ...]
    u: np.ndarray
    columns: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    doubts: float
    doubt_slope: np.ndarray
    cost: float


def cost_at(
    given: Problem, effects: tuple[str, ...], u: np.ndarray, mine: np.ndarray,
    blocks: Sequence[np.ndarray] = (),
) -> tuple[np.ndarray, float, float]:  # fmt: skip
    """Whitened residuals (n,) of a candidate at coordinates u, the cost of doubts, and the total cost [nats].

    Properties at the columns `mine` have normal priors, each of the `blocks` of them a Cauchy distribution.
    """
    left, doubts = whitened(given, _without_effects(given, effects, u), u)
    left, own = left[given.there], u[mine[: given.num_common]]
    cost = 0.5 * float(given.nuisances.product(left, left)) + doubts + 0.5 * float(own @ own)
    for block in blocks:
        x = u[mine[block]]
        cost += 0.5 * (1 + block.size) * float(np.log1p(x @ x))
    return left, doubts, cost


def evaluated(
    given: Problem,
    effects: tuple[str, ...],
    u: np.ndarray,
    mine: np.ndarray,
    usual: np.ndarray | None = None,
    at: tuple[np.ndarray, float, float] | None = None,
) -> Fitted:
    """Evaluate a candidate and its derivatives by forward differences.

    Args:
        given: The problem.
        effects: Keys of the candidate's effects.
        u: Coordinates of all parameters.
        mine: Columns (K,) to differentiate with respect to, all properties first.
        usual: Known derivatives (n, P) with respect to what all fits have, which an effect hardly changes.
        at: Result of `cost_at`, if known.
    """
    at = cost_at(given, effects, u, mine) if at is None else at
    k, step, each = given.num_common, u.copy(), []
    if usual is None:  # what all fits have needs no further correction
        world = _without_effects(given, effects, u)
        each += [whitened(given, world, row) for row in u + STEP * np.eye(k, u.size)]
    for column in mine[k:]:
        step[column] += STEP
        each.append(whitened(given, _without_effects(given, effects, step), u))
        step[column] = u[column]
    z = np.array([residual[given.there] for residual, _ in each]).reshape(len(each), given.size)
    jacobian, doubt_slope = (z - at[0]).T / STEP, (np.array([doubt for _, doubt in each]) - at[1]) / STEP
    if usual is not None:
        jacobian = np.concatenate([usual, jacobian], 1)
        doubt_slope = np.concatenate([np.zeros(k), doubt_slope])
    return Fitted(effects, u, mine, at[0], jacobian, at[1], doubt_slope, at[2])


# Joint fits of properties and effects.

STEPS = 12  # numerics: most iterations
CLOSE = 0.02  # numerics: nats


def fit(
    given: Problem,
    effects: tuple[str, ...],
    u: np.ndarray,
    steps: int = STEPS,
    usual: np.ndarray | None = None,
) -> Fitted:
    """Fit properties and effects by Levenberg-Marquardt steps within the limits of each coordinate.

    Properties have normal priors, the parameters of an effect a joint Cauchy distribution.

    Args:
        given: The problem.
        effects: Keys of the effects to be fitted.
        u: Coordinates of all parameters to start from.
        steps: Most steps; with 0 the start is only evaluated.
        usual: Known derivatives (n, P) with respect to the properties (`evaluated`).
    """
    mine = columns_of(given, effects)
    low, high = slots(given.num_common)[1][:, mine]
    u = u.copy()
    u[mine] = np.clip(u[mine], low, high)
    blocks, at = [], given.num_common
    for key in effects:
        blocks.append(np.arange(at, at + len(free_parameters(key))))
        at += blocks[-1].size
    here = cost_at(given, effects, u, mine, blocks)
    now, damping = evaluated(given, effects, u, mine, usual, here), 1e-3
    for _ in range(steps):
        prior = np.ones(mine.size)
        for block in blocks:
            x = u[mine[block]]
            prior[block] = (1 + block.size) / (1 + x @ x)
        slope = given.nuisances.product(now.jacobian, now.residual) + now.doubt_slope + prior * u[mine]
        curvature = given.nuisances.product(now.jacobian, now.jacobian) + np.diag(prior)
        damped = curvature + damping * np.diag(np.diag(curvature))
        try:
            step, _ = least(damped, -slope, low - u[mine], high - u[mine])
        except np.linalg.LinAlgError:  # where an effect grows without end rounding leaves no minimum
            break
        if -(slope + 0.5 * curvature @ step) @ step < CLOSE:
            break
        trial = u.copy()
        trial[mine] = np.clip(u[mine] + step, low, high)
        here = cost_at(given, effects, trial, mine, blocks)
        if np.isfinite(here[2]) and here[2] < now.cost:
            new = evaluated(given, effects, trial, mine, usual, here)
            gained, u, now, damping = now.cost - new.cost, trial, new, damping / 5
            if gained < CLOSE:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return now
