"""Every candidate fitted to aligned trials; boundaries realigned without what displaced them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.identification import identify_aligned
from hmmseg.contact.decompose import PROPERTIES
from hmmseg.errors import InputError
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.attribution.problem import Gap
from simgap.bounded import least
from simgap.effects import catalogue, forms_of, free_parameters, name_of
from simgap.effects.base import tips
from simgap.gap.assemble import Scatter, gap_of, noise_gained, redrawn, scatters
from simgap.gap.frame import build, not_compared, of_wrist, shown, shown_forms, thinned
from simgap.gap.nuisances import with_nuisances
from simgap.gap.problem import (
    Fitted,
    Problem,
    Start,
    columns_of,
    cost_at,
    evaluated,
    fit,
    limits,
    neutral,
    problem,
    rebased,
    slots,
    world_without,
)
from simgap.gap.residuals import SURE
from simgap.progress import Progress, silent

# Every candidate effect fitted by itself: all starts of its shape parameters screened, the best refined.

SCREEN = 2  # numerics: steps before the best start of a form is chosen
LEADERS = 3  # numerics: starts screened
PROMISING = 2.0  # numerics: nats that a linear step must gain for a form to be fitted


def candidate_names(rig: Rig, excluded: Sequence[str] = (), forced: Sequence[str] = ()) -> list[str]:
    """The effects to choose from, or that are `forced`: a Cartesian hand has no joints."""
    chosen = {n: e for n, e in catalogue().items() if e.chosen or n in forced}
    return [n for n, e in chosen.items() if n not in excluded and (rig.jointed or e.acts_on != "kinematics")]


def shifting(names: Sequence[str]) -> list[str]:
    """Keys of all forms of those effects that shift signals (the others only scatter them)."""
    return [key for n in names if catalogue()[n].correct is not None for key in forms_of(n)]


def starts(given: Problem, key: str, others: tuple[str, ...], base: np.ndarray) -> list[Start]:
    """Starts of one form of an effect after `others`, from other coordinates `base` (all columns)."""
    slot = next(s for s in slots(given.num_properties)[0] if s.effect.name == name_of(key))
    grids = [
        [(slot.start + j, p.coordinate(value)) for value in p.starts]
        for j, p in enumerate(slot.effect.parameters.values())
        if p.gridded and p.name in free_parameters(key)
    ]
    out = []
    for chosen in itertools.product(*grids):
        u = base.copy()
        for column, value in chosen:
            u[column] = value
        out.append(Start((*others, key), u))
    return out


def best_fit(given: Problem, key: str, healthy: Fitted, promising: float = PROMISING) -> Fitted:
    """The best fit of one form of an effect, properties and the effects of `healthy` refitted; not refined
    where a linear step gains less than what is `promising` [nats].

    Starts are ranked by what a linear step in their amplitudes leaves: a frequency cannot be sought while
    what swings with it has no size. Properties start as they were measured, for without the effect they may
    have been drawn far off, and from where they are, for fingers that are off may seem to touch blocks.
    """
    base, usual = healthy.u.copy(), healthy.push[:, : given.num_properties]
    base[: given.num_properties][given.measured.ravel()] = 0.0
    drawn = np.abs(healthy.u - base).max() > SURE  # by more than a touch is doubted
    every = [s for u in (base, healthy.u)[: 1 + drawn] for s in starts(given, key, healthy.effects, u)]
    ranked = sorted(((*_ranked(given, start, usual), start) for start in every), key=lambda r: r[0])
    if healthy.cost - ranked[0][0] < promising:
        return fit(given, ranked[0][2], 0, usual)
    leading = [start for _, start, _ in ranked[:LEADERS]]
    if len(leading) > 1:
        screened = sorted((fit(given, s, SCREEN, usual) for s in leading), key=lambda f: f.cost)
        leading = [Start(screened[0].effects, screened[0].u)]
    return fit(given, leading[0], usual=usual)


def _ranked(given: Problem, start: Start, usual: np.ndarray) -> tuple[float, Start]:
    """A start's cost after a linear step of all but its gridded parameters, and the start there."""
    key = start.effects[-1]
    slot = next(s for s in slots(given.num_properties)[0] if s.effect.name == name_of(key))
    fixed = [
        slot.start + j
        for j, p in enumerate(slot.effect.parameters.values())
        if p.gridded and p.name in free_parameters(key)
    ]
    low, high = limits(given)
    columns = np.array([c for c in columns_of(given, start.effects) if c not in fixed])
    u = start.u.copy()
    u[columns] = np.clip(u[columns], low[columns], high[columns])
    at = cost_at(given, start.effects, u, columns, [])
    now = evaluated(given, start.effects, u, columns, at, usual)
    bend = given.product(now.push, now.push) + np.eye(columns.size)
    pull = -given.product(now.push, now.residual) - u[columns]
    step, _ = least(bend, pull, low[columns] - u[columns], high[columns] - u[columns])
    there = u.copy()
    there[columns] = np.clip(u[columns] + step, low[columns], high[columns])
    left = now.residual + now.push @ (there[columns] - u[columns])
    own = there[: given.num_properties]
    cost = 0.5 * float(given.product(left, left)) + now.doubts + 0.5 * float(own @ own)
    return cost, Start(start.effects, there)


# Align again with an effect taken out: late or softened forces displace the boundaries themselves.


def realigned(aligned: AlignedTrials, given: Problem, found: Fitted, all_fit: bool = False) -> AlignedTrials:
    """Boundaries of the trials in the frame, from signals that the candidate has been taken out of."""
    frame, rig, trials = given.frame, given.frame.rig, [a.trial for a in aligned.trials]
    world = world_without(given, found.effects, found.u)
    (position, velocity), force = tips(world), world.force
    rows = []
    for r, trial in enumerate(trials):
        n = frame.lengths[r]
        names = [f"{kind}{axis}{i}" for kind in ("", "v", "f") for i in (1, 2) for axis in "xy"]
        columns = np.concatenate([np.asarray(z[r, :n]) for z in (position, velocity, force)], 1)
        small, _ = thinned(trial, rig)
        rows.append(replace(task_space(small, rig), **dict(zip(names, columns.T, strict=True))))
    again = align(trials, frame.task, _hand(rig, world), all_fit, rows)
    return replace(again, rig=rig)


def _hand(rig: Rig, world) -> Rig:
    """The rig with the pads that the candidate gives it."""
    give = {
        "normal_stiffness": float(np.mean(world.give_normal)),
        "shear_stiffness": float(np.mean(world.give_shear)),
    }
    pads = {k: 1 / v for k, v in give.items() if v > 1e-7}
    return rig.model_copy(update={"fingertip": rig.fingertip.model_copy(update=pads)})


def moved(before: AlignedTrials, after: AlignedTrials) -> float:
    """Largest shift of a boundary [s]; infinite where a trial no longer fits its task."""
    shifts = []
    for a, b in zip(before.trials, after.trials, strict=True):
        if not b.segmentation.complete:
            return float("inf")
        shifts += [
            abs(p.quantile(0.5) - q.quantile(0.5)) for p, q in zip(a.boundaries, b.boundaries, strict=True)
        ]
    return max(shifts)


SHIFT = 0.008  # chosen: s; boundaries that move farther are realigned
ROUNDS = 2  # numerics: times at most
ATTEMPTS = 3  # numerics: leading candidates that are taken out in turn where no trial fits its task
HOPELESS = 1e4  # chosen: times the noise's square, in the mean: no effect of a hand, but another task
WORTH = 50.0  # chosen: nats that a candidate must gain for boundaries to be realigned without it
Identified = Mapping[tuple[str, str], float]


@dataclass(frozen=True)
class Search:
    """Aligned `trials`, their `problem`, the fit without any effect, and every candidate's own; `gap`: all of
    that as an attribution takes it, its first candidates those of `fits`; `redrawn`: the problem with more
    noise on the recordings; `identified`: the blocks' properties as `identify` has them [N, m]."""

    aligned: AlignedTrials
    problem: Problem
    healthy: Fitted
    fits: tuple[Fitted, ...]
    scatters: tuple[Scatter, ...]
    gap: Gap
    redrawn: tuple[Problem, ...]
    identified: Identified
    warnings: tuple[str, ...]

    @property
    def trials(self) -> list[Trial]:
        """The recordings that fit their task."""
        return [one.trial for one in self.aligned.trials]

    @property
    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Weight, width, height (O, 3) of the blocks, and which are known: measured apart or identified.

        What is measured is as the recordings leave it, what nothing determines as the prior does.
        """
        values, known = self.problem.properties(self.healthy.u), self.problem.measured.copy()
        for (name, kind), value in self.identified.items():
            at = self.problem.frame.task.objects.index(name), PROPERTIES.index(kind)
            if not known[at]:
                values[at], known[at] = value, True
        return values, known


def search(
    aligned: AlignedTrials,
    actual: dict | None = None,
    excluded: Sequence[str] = (),
    forced: Sequence[str] = (),
    tell: Progress = silent,
    identified: Identified | None = None,
    noisy: bool = True,
    promising: float = PROMISING,
) -> Search:
    """Fit the catalogue, and what is `forced`, to aligned trials; InputError where none fits its task.

    `identified`: what `identify` made of the same trials, where that is known already. `noisy`: whether to
    see what sensors' noise makes of the candidates (`simgap.gap.assemble.redrawn`), which takes half of the
    time. `promising`: see `best_fit`.
    """
    misled: list[str] = []
    names, trials = candidate_names(aligned.rig, excluded, forced), [one.trial for one in aligned.trials]
    keys = shifting(names)
    if of_wrist(trials):
        keys = [key for key in shown_forms(names) if key in keys]
        names = shown(names)
    if not any(t.segmentation.complete for t in aligned.trials):
        tell("aligning trials that seem not to fit")
        aligned, misled = _aligned_all(aligned, actual, keys)
    every, aligned = aligned, _complete(aligned)
    if identified is None and not _all_measured(aligned, actual):
        tell("identifying properties")
        identified = identify_aligned(aligned).centres
    identified = identified or {}
    tell("fitting single effects")
    given = with_nuisances(problem(build(aligned), actual, identified))
    healthy = fit(given, Start((), neutral(given)))
    fits = [best_fit(given, key, healthy, promising) for key in keys]
    others = redrawn(given) if noisy else ()
    for _ in range(ROUNDS if noisy else 0):
        again = _anew(every, aligned, given, healthy, fits, others)
        if again is None:
            break
        tell("aligning again without the best explanation")
        aligned, given, healthy, fits = again
        others = redrawn(given)
    scattering = scatters(given, given.nuisances.left(healthy.residual), names)
    gap = gap_of(given, healthy, fits, scattering, others)
    warnings = [not_compared(trials)] if of_wrist(trials) else []
    warnings += _failures(every, aligned)
    return Search(aligned, given, healthy, tuple(fits), tuple(scattering), gap, others,
                  identified, (*misled, *warnings))  # fmt: skip


def _all_measured(aligned: AlignedTrials, actual: dict | None) -> bool:
    """Whether every property was measured apart."""
    given = actual or {}
    return all(kind in given.get(name, {}) for name in aligned.task.objects for kind in PROPERTIES)


def _anew(
    every: AlignedTrials,
    aligned: AlignedTrials,
    given: Problem,
    healthy: Fitted,
    fits: Sequence[Fitted],
    others: Sequence[Problem],
):
    """Everything once more with boundaries from signals without the best explanation, if that fits better, or
    if more of `every` trial then fits its task.

    Late, slow or soft contacts displace boundaries, and what displaces fingers may look like a dropped block.
    """
    best = min(fits, key=lambda f: f.cost)
    gained = healthy.cost - best.cost
    if gained < WORTH or gained - noise_gained(others, healthy, best) < WORTH:
        return None
    recovered = _recovered(every, aligned, given, best)
    again = recovered or realigned(aligned, given, best)
    if recovered is None and not SHIFT < moved(aligned, again) < np.inf:
        return None
    other = with_nuisances(rebased(build(again), given))
    if recovered is None and (
        fit(other, Start(best.effects, best.u)).cost / other.size > best.cost / given.size
    ):
        return None
    plain = fit(other, Start((), healthy.u))
    return again, other, plain, [fit(other, Start(f.effects, f.u), usual=plain.push) for f in fits]


def _recovered(
    every: AlignedTrials, aligned: AlignedTrials, given: Problem, best: Fitted
) -> AlignedTrials | None:
    """The trials that fit their task once the best explanation has been taken out, if these are more."""
    if len(aligned.trials) == len(every.trials):
        return None
    forced = align([one.trial for one in every.trials], every.task, every.rig, all_fit=True)
    frame = build(forced)
    if not np.isfinite(frame.world.events).all():  # nowhere in these trials a block could be held
        return None
    again = realigned(forced, rebased(frame, given), best)
    fit_now = tuple(one for one in again.trials if one.segmentation.failed is None)
    return replace(again, trials=fit_now) if len(fit_now) > len(aligned.trials) else None


def _aligned_all(
    failed: AlignedTrials, actual: dict | None, keys: Sequence[str]
) -> tuple[AlignedTrials, list[str]]:
    """Another alignment of trials that all `failed`, if most fit their task without one of the candidates.

    Forces that a fault displaces may look like another task. Where no candidate helps, `failed` as it is; the
    second is a warning that says which one did.
    """
    aligned = align([one.trial for one in failed.trials], failed.task, failed.rig, all_fit=True)
    for _ in range(ROUNDS):
        given = problem(build(aligned), actual)
        healthy = fit(given, Start((), neutral(given)))
        if healthy.cost > HOPELESS * given.size:
            break
        found = sorted((best_fit(given, key, healthy) for key in keys), key=lambda f: f.cost)
        for f in found[:ATTEMPTS]:
            again = realigned(aligned, given, f)
            if 2 * sum(t.segmentation.complete for t in again.trials) > len(again.trials):
                why = failed.trials[0].segmentation.failed
                return again, [f"{why}; without {name_of(f.effects[0])} it fits"]
        aligned = realigned(aligned, given, found[0], all_fit=True)
    return failed, []


def _complete(aligned: AlignedTrials) -> AlignedTrials:
    """The trials that fit their task."""
    keep = tuple(one for one in aligned.trials if one.segmentation.failed is None)
    if not keep:
        one = aligned.trials[0]
        raise InputError(one.trial.file, str(one.segmentation.failed), "a recording that shows every subtask")
    return replace(aligned, trials=keep)


def _failures(every: AlignedTrials, aligned: AlignedTrials) -> list[str]:
    """A warning of each trial that did not fit its task at first: whether it is left out."""
    kept, out = {one.trial.name for one in aligned.trials}, []
    for one in every.trials:
        if one.segmentation.failed is not None:
            what = "left out" if one.trial.name not in kept else "without the best explanation it fits"
            out.append(f"{one.trial.name}: {one.segmentation.failed}; {what}")
    return out
