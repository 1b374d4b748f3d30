"""Residuals and sensitivities of all windows, in the channels' units: how effects and starts move the rows.

Effects that kink at their neutral value (friction, dead bands) are linearised where they act: the shift from
neutral to there is a rollout of its own, the derivative a forward difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError
from simgap.progress import say
from simgap.robots.model import Composed, Point
from simgap.robots.rows import Rows
from simgap.robots.windows import JUMPS, REGIMES, STRIKES, earlier
from simgap.simulators.protocol import Channels

STEP = 0.05  # numerics: of a parameter's sd: the usual finite difference
HUGE = 1e100  # numerics: units; beyond it a simulation counts as diverged, for squares must add up
START_STEP = 0.3  # numerics: of a start's sd: the finite difference


@dataclass(frozen=True)
class Moved:
    """How an effect moves the rows: their `shift` (N,) from neutral to the values `at` (k,), and the
    derivatives there (N, k)."""

    at: np.ndarray
    shift: np.ndarray
    jacobian: np.ndarray


@dataclass(frozen=True)
class Linear:
    """The gap linearised about a point.

    `point`: the point; `rows`: the rows that are compared; `target`: recorded values (N,), along straight
    lines as if every window were run from its start; `residual`: these less simulated values (N,); NaN where
    a rollout diverged; `starts`: derivatives (N,) of the rows by each state of their window's start; `moved`:
    how effects move the rows; `diverged`: effects whose rollouts diverged; `dropped`: number of windows whose
    rollout diverged; `rates`: rates (N,) of the simulated channels.
    """

    point: Point
    rows: Rows
    target: np.ndarray
    residual: np.ndarray
    starts: Mapping[str, np.ndarray]
    moved: Mapping[str, Moved]
    diverged: tuple[str, ...]
    dropped: int  # windows whose rollout was not finite
    rates: np.ndarray  # (N,) the simulated channel's rate

    def with_moved(self, more: Mapping[str, Moved]) -> Linear:
        """The same with columns of effects added or replaced."""
        return replace(self, moved={**self.moved, **more})


@dataclass(frozen=True)
class Base:
    """Rollouts at a point, from which effects are varied: starts, channels before (`true`) and after (`read`)
    read-out effects, and rows (N,)."""

    point: Point
    begun: list[Mapping[str, float] | None]
    true: list[Channels | None]
    read: list[Channels | None]
    rows: np.ndarray


def base_at(composed: Composed, point: Point) -> Base:
    """Roll out all windows at a point."""
    begun = composed.starts(point)
    true = composed.rolled(point, begun)
    read = composed.read(true, point)
    return Base(point, begun, true, read, composed.rows.averaged(read))


def linearise(
    composed: Composed, point: Point, effects: Sequence[str], starts: Mapping[str, np.ndarray] | None = None
) -> Linear:
    """Residuals and sensitivities at a point.

    Args:
        composed: The model along its windows.
        point: The point.
        effects: Names of the effects by whose parameters derivatives are taken.
        starts: Derivatives by the starts, if already known.

    Raises:
        InputError: The simulator diverges in every window.
    """
    base = base_at(composed, point)
    if all(channels is None for channels in base.read):
        raise InputError("simulator", "gives values that are not finite in every window", "finite channels")
    starts = _by_start(composed, base) if starts is None else starts
    target = composed.rows.observed + _brought_back(composed, starts)
    dropped, every = sum(channels is None for channels in base.read), {}
    for number, name in enumerate(effects):
        say(f"{number + 1} of {len(effects)}, {name}")
        every[name] = vary(composed, base, name)
    moved = {n: one for n, one in every.items() if one is not None}
    diverged = tuple(n for n in every if n not in moved)
    return Linear(
        point, composed.rows, target, target - base.rows, starts, moved, diverged, dropped,
        _rates(composed, base),
    )  # fmt: skip


def _brought_back(composed: Composed, starts: Mapping[str, np.ndarray]) -> np.ndarray:
    """How rows (N,) move as windows are run aside of their starts, along straight lines."""
    out = np.zeros(composed.rows.log.size)
    for window, mine in zip(composed.windows, composed.rows.of, strict=True):
        for state, by in window.aside.items():
            out[mine] += by * starts[state][mine]
    return out


def _rates(composed: Composed, base: Base) -> np.ndarray:
    """Rates (N,) of the rows' channels; 0 where a rollout diverged."""
    slopes: list[Channels | None] = []
    for window, channels in zip(composed.windows, base.read, strict=True):
        t = composed.recordings[window.log].t[window.begin : window.end]
        slopes.append(None if channels is None else {n: np.gradient(v, t) for n, v in channels.items()})
    found = composed.rows.averaged(slopes)
    return np.where(np.isfinite(found), found, 0.0)


def vary(
    composed: Composed,
    base: Base,
    name: str,
    at: Mapping[str, float] | None = None,
    step: np.ndarray | None = None,
    shifted: bool = True,
) -> Moved | None:
    """How an effect moves the rows, by rollouts.

    Args:
        composed: The model along its windows.
        base: Rollouts without a change.
        name: The effect.
        at: Where it is linearised, reached from neutral, if the base's point does not have it act; the point
            itself by default.
        step: Finite differences (k,) of its parameters, in usual sizes.
        shifted: Whether the shift from neutral is wanted where the effect acts; what is fitted along has
            none.

    Returns:
        Shift and derivatives; None where a rollout diverged.
    """
    effect = composed.effects[name]
    neutral = effect.neutral()
    now = {**neutral, **base.point.get(name, {})}
    here, rows, shift = now, base.rows, np.zeros(base.rows.size)
    if at is not None and name not in base.point:
        here = {**neutral, **at}
        rows = rows_at(composed, base, name, here)
        shift = rows - base.rows
    names, log, columns = [*effect.parameters], composed.rows.log, []
    sizes = np.full(len(names), STEP) if step is None else step
    # Logs do not act on each other: a parameter that each has of its own is varied in all of them at once.
    # Such parameters are ordered by log, then by kind.
    kinds = len(names) // len(composed.recordings) if effect.by_log else len(names)
    for kind in range(kinds):
        mine = names[kind::kinds]
        move = step_of(composed, name, mine[0], here[mine[0]], sizes[kind::kinds].min())
        there = rows_at(composed, base, name, {**here, **{n: here[n] + move for n in mine}})
        columns.append((there - rows) / move)
    if effect.by_log:
        columns = [np.where(log == i // kinds, columns[i % kinds], 0.0) for i in range(len(names))]
    jacobian = np.stack(columns, 1)
    fine = np.isfinite(base.rows)
    if not (_bounded(jacobian[fine]) and _bounded(shift[fine])):
        return None
    point = np.array([here[n] for n in effect.parameters])
    if name in base.point and shifted and not effect.fitted:
        shift = base.rows - rows_at(composed, base, name, neutral)
        if not _bounded(shift[fine]):  # the straight line back, where neutral itself diverges
            shift = jacobian @ (point - np.array([neutral[n] for n in effect.parameters]))
    return Moved(point, shift, jacobian)


def _bounded(values: np.ndarray) -> bool:
    """Whether values are finite and their squares can be summed."""
    return bool((np.abs(values) < HUGE).all())


def with_wobble(composed: Composed, linear: Linear) -> Composed:
    """The model with the wobble of contacts by all effects that were linearised (see `Composed`)."""
    strikes = linear.rows.regime == REGIMES.index(STRIKES)
    if not (linear.starts and strikes.any() and linear.moved):
        return composed
    size = {n: np.array([p.sd for p in composed.effects[n].parameters.values()]) for n in linear.moved}
    columns = np.concatenate([m.jacobian * size[n] for n, m in linear.moved.items()], 1)
    return replace(composed, wobble=np.where(strikes[:, None] & np.isfinite(columns), columns, 0.0))


def rows_at(composed: Composed, base: Base, name: str, values: Mapping[str, float]) -> np.ndarray:
    """Rows (N,) with one effect at other values. Starts are read through read-out effects, so that a large
    one moves them farther than along straight lines."""
    effect = composed.effects[name]
    moved = {**base.point, name: dict(values)}
    if effect.numeric:
        run, now = list(base.true), {**effect.neutral(), **base.point.get(name, {})}
        for short, value in values.items():
            run = composed.stepped(run, name, short, value - now[short])
    elif effect.alter is not None and effect.restore is None:
        run = base.true
    else:
        run = composed.rolled(moved, base.begun if effect.restore is None else composed.starts(moved))
    return composed.rows.averaged(composed.read(run, moved))


def step_of(composed: Composed, effect: str, name: str, value: float, size: float = STEP) -> float:
    """A finite difference of `size` usual sizes that stays within the parameter's bounds."""
    parameter = composed.effects[effect].parameters[name]
    step = size * parameter.sd
    return step if value + step <= parameter.high else -step


def _by_start(composed: Composed, base: Base) -> dict[str, np.ndarray]:
    """Derivatives (N,) of the rows by each state of their window's start."""
    out = {}
    for state in dict.fromkeys(n for w in composed.windows for n in w.doubt):
        steps = [START_STEP * w.doubt.get(state, 0.0) for w in composed.windows]
        begun = [
            s if s is None or state not in s else {**s, state: s[state] + h}
            for s, h in zip(base.begun, steps, strict=True)
        ]
        moved = composed
        if state == JUMPS:
            logs = tuple(earlier(composed.simulator, r, max(steps)) for r in composed.recordings)
            moved = replace(composed, recordings=logs)
        run = moved.rolled(base.point, begun)
        there = composed.rows.averaged(composed.read(run, base.point))
        by_row = np.array(steps)[composed.rows.window]
        change = np.where(by_row > 0, (there - base.rows) / np.where(by_row > 0, by_row, 1.0), 0.0)
        out[state] = np.where(np.isfinite(change), change, 0.0)
    return out
