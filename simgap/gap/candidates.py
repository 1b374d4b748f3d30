"""Where to start a search: every candidate's grid of start values, screened before it is refined."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from simgap.effects import fitted
from simgap.gap.fit import STEPS, Fitted, Problem, Start, fit, limits, neutral, slots

SCREEN = 2  # steps before the best start of an effect is chosen
LEADERS = 4  # starts screened, of those whose amplitudes are found first


def starts(
    given: Problem, effects: tuple[str, ...], base: np.ndarray | None = None, keep: tuple[str, ...] = ()
) -> list[Start]:
    """Starts of a candidate; effects in `keep` stay where `base` (all columns) has them."""
    base = neutral(given) if base is None else base
    places = {s.effect.name: s for s in slots(given.num_properties)[0]}
    grids = []
    for name in effects:
        if name in keep:
            continue
        slot = places[name]
        for j, p in enumerate(slot.effect.parameters):
            if p.gridded:
                grids.append([(slot.start + j, p.coordinate(value)) for value in p.starts])
    out = []
    for chosen in itertools.product(*grids):
        u = base.copy()
        for column, value in chosen:
            u[column] = value
        out.append(Start(effects, u))
    return out


def deterministic(names: Sequence[str]) -> list[str]:
    """Those of the named effects that shift signals (the others only spread them)."""
    return [n for n in names if fitted()[n].correct is not None]


def best_fits(
    given: Problem,
    wanted: Sequence[tuple[str, ...]],
    healthy: Fitted,
    bases: Sequence[Fitted] | None = None,
    steps: int = STEPS,
) -> list[Fitted]:
    """The best fit of every candidate: all starts for a few steps, then the better ones to the end.

    `bases[k]` is a fit of fewer effects that candidate k extends.
    """
    jobs: list[tuple[int, Start]] = []
    for k, effects in enumerate(wanted):
        base = bases[k] if bases is not None else healthy
        kept = base.effects if bases is not None else ()
        found = starts(given, effects, base.u, kept)
        jobs += [(k, s) for s in _with_amplitudes(given, found, kept)]
    many = {k for k, _ in jobs if sum(j == k for j, _ in jobs) > 1}
    screened = fit(given, [s for k, s in jobs if k in many], SCREEN) if many else []
    best: dict[int, Start] = dict(reversed(jobs))  # the first start of each, until a better one is known
    cost: dict[int, float] = {}
    for (k, _), found in zip([job for job in jobs if job[0] in many], screened, strict=True):
        if found.cost < cost.get(k, np.inf):
            cost[k], best[k] = found.cost, Start(found.effects, found.u)
    return fit(given, [best[k] for k in range(len(wanted))], steps)


def _with_amplitudes(given: Problem, found: list[Start], kept: tuple[str, ...]) -> list[Start]:
    """The leading starts with the best amplitudes of their start values: those that are nothing without.

    A frequency cannot be sought while what swings with it has no size.
    """
    fixed = [
        slot.start + j
        for slot in slots(given.num_properties)[0]
        if slot.effect.name in found[0].effects and slot.effect.name not in kept
        if any(p.amplitude and not p.gridded for p in slot.effect.parameters)
        for j, p in enumerate(slot.effect.parameters)
        if p.gridded
    ]
    if not fixed or len(found) <= LEADERS:
        return found
    low, high = limits(given)
    seen = []
    for one in fit(given, found, 0):
        free = ~np.isin(one.columns, fixed)
        columns = one.columns[free]
        slope = (one.gradient.sum((0, 1)) + one.u[one.columns])[free]
        bend = (one.hessian.sum((0, 1)) + np.eye(free.size))[np.ix_(free, free)]
        step = -np.linalg.solve(bend, slope)
        u = one.u.copy()
        u[columns] = np.clip(u[columns] + step, low[columns], high[columns])
        seen.append((one.cost + 0.5 * float(slope @ step), Start(one.effects, u)))
    return [start for _, start in sorted(seen, key=lambda row: row[0])[:LEADERS]]
