"""Every candidate effect fitted by itself: all starts of its shape parameters screened, the best refined."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from hmmseg.io.rig import Rig
from simgap.bounded import least
from simgap.effects import catalogue, decoys, fitted, forms_of, free_parameters, name_of
from simgap.gap.evaluation import evaluated
from simgap.gap.fit import Fitted, Start, fit
from simgap.gap.problem import Problem, columns_of, limits, slots

SCREEN = 2  # numerics: steps before the best start of a form is chosen
LEADERS = 3  # numerics: starts screened
PROMISING = 2.0  # numerics: nats that a linear step must gain for a form to be fitted


def candidate_names(rig: Rig, excluded: Sequence[str] = (), forced: Sequence[str] = ()) -> list[str]:
    """The effects to choose from, decoys included, or that are `forced`: a Cartesian hand has no joints."""
    chosen = {n: e for n, e in catalogue().items() if e.chosen or n in forced} | decoys()
    return [n for n, e in chosen.items() if n not in excluded and (rig.jointed or e.acts_on != "kinematics")]


def shifting(names: Sequence[str]) -> list[str]:
    """Keys of all forms of those effects that shift signals (the others only scatter them)."""
    return [key for n in names if fitted()[n].correct is not None for key in forms_of(n)]


def starts(given: Problem, key: str, base: np.ndarray) -> list[Start]:
    """Starts of one form of an effect, from other coordinates `base` (all columns)."""
    slot = next(s for s in slots(given.num_properties)[0] if s.effect.name == name_of(key))
    grids = [
        [(slot.start + j, p.coordinate(value)) for value in p.starts]
        for j, p in enumerate(slot.effect.parameters)
        if p.gridded and p.name in free_parameters(key)
    ]
    out = []
    for chosen in itertools.product(*grids):
        u = base.copy()
        for column, value in chosen:
            u[column] = value
        out.append(Start((key,), u))
    return out


def best_fit(given: Problem, key: str, healthy: Fitted) -> Fitted:
    """The best fit of one form of an effect, properties refitted; not refined where that promises nothing.

    Starts are ranked by what a linear step in their amplitudes leaves: a frequency cannot be sought while
    what swings with it has no size.
    """
    every = starts(given, key, healthy.u)
    ranked = sorted(((*_ranked(given, start), start) for start in every), key=lambda r: r[0])
    if healthy.cost - ranked[0][0] < PROMISING:
        return fit(given, ranked[0][2], 0)
    leading = [start for _, start, _ in ranked[:LEADERS]]
    if len(leading) > 1:
        screened = sorted((fit(given, s, SCREEN) for s in leading), key=lambda f: f.cost)
        leading = [Start((key,), screened[0].u)]
    return fit(given, leading[0])


def _ranked(given: Problem, start: Start) -> tuple[float, Start]:
    """A start's cost after a linear step of all but its gridded parameters, and the start there."""
    (key,) = start.effects
    slot = next(s for s in slots(given.num_properties)[0] if s.effect.name == name_of(key))
    fixed = [
        slot.start + j
        for j, p in enumerate(slot.effect.parameters)
        if p.gridded and p.name in free_parameters(key)
    ]
    low, high = limits(given)
    columns = np.array([c for c in columns_of(given, start.effects) if c not in fixed])
    u = start.u.copy()
    u[columns] = np.clip(u[columns], low[columns], high[columns])
    now = evaluated(given, start.effects, u, columns, [])
    bend = given.product(now.push, now.push) + np.eye(columns.size)
    pull = -given.product(now.push, now.residual) - u[columns]
    step, _ = least(bend, pull, low[columns] - u[columns], high[columns] - u[columns])
    there = u.copy()
    there[columns] = np.clip(u[columns] + step, low[columns], high[columns])
    left = now.residual + now.push @ (there[columns] - u[columns])
    own = there[: given.num_properties]
    cost = 0.5 * float(given.product(left, left)) + now.doubts + 0.5 * float(own @ own)
    return cost, Start(start.effects, there)
