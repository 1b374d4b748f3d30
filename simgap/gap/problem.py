"""The problem of fitting: a frame, its whitening, the properties' prior, and a column for every unknown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from estimation.priors import PROPERTY_LOG_SD, PROPERTY_MEDIAN
from hmmseg.contact.decompose import PROPERTIES
from simgap.effects import fitted as known_effects
from simgap.effects import free_parameters, name_of
from simgap.effects.base import Effect, Parameter
from simgap.gap.frame import Frame
from simgap.gap.marginal import Nuisances
from simgap.gap.whitening import Whitening, whitening

# prior: what measured weight (share), width, height [m] may be off beside their own sd
MEASURED = (2e-3, 3e-5, 4e-5)


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
    def constants(self) -> tuple[Any, Any, Any]:
        """World, arrays and whitening as JAX has them, to be used where this is in double precision."""
        tree = (self.frame.world, self.frame.arrays, self.whitening)
        return jax.tree.map(lambda z: jnp.asarray(z, float if z.dtype.kind == "f" else None), tree)

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
    return [p for p in known_effects()[name_of(key)].parameters if p.name in free_parameters(key)]


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
