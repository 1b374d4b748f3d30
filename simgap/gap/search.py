"""Fit every candidate to aligned trials, and realign trials none of which seems to fit its task."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.identification import identify_aligned
from estimation.report import Actual
from hmmseg.contact.decompose import PROPERTIES
from hmmseg.errors import InputError
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Rig
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.attribution.problem import Gap
from simgap.bounded import least
from simgap.effect import Parameter
from simgap.effects import catalogue, forms_of, name_of
from simgap.effects.base import tips
from simgap.gap.assemble import Scatter, gap_of, redrawn, scatters
from simgap.gap.frame import NOT_COMPARED, absent, build, of_wrist, shown, shown_forms, thinned
from simgap.gap.nuisances import with_nuisances
from simgap.gap.problem import (
    Fitted,
    Problem,
    columns_of,
    cost_at,
    evaluated,
    fit,
    free_of,
    neutral,
    problem,
    slots,
    world_without,
)
from simgap.gap.residuals import SURE
from simgap.progress import Progress, silent

# Each candidate effect fitted separately: all starts of its gridded parameters are screened, the best
# refined.

SCREEN = 2  # numerics: steps before the best start of a form is chosen
LEADERS = 3  # numerics: starts that take these steps
PROMISING = 2.0  # numerics: nats that a linear step must gain for a form to be fitted
HALVINGS = 5  # numerics: of a linear step that leads up


def candidate_names(rig: Rig, excluded: Sequence[str] = (), forced: Sequence[str] = ()) -> list[str]:
    """Effects to choose from, and those that are `forced`; a Cartesian hand has no joints."""
    chosen = {n: e for n, e in catalogue().items() if e.chosen or n in forced}
    return [n for n, e in chosen.items() if n not in excluded and (rig.jointed or e.acts_on != "kinematics")]


def shifting(names: Sequence[str]) -> list[str]:
    """Keys of all forms of the named effects that shift signals rather than scatter them."""
    return [key for n in names if catalogue()[n].correct is not None for key in forms_of(n)]


def _gridded(given: Problem, key: str) -> list[tuple[int, Parameter]]:
    """Columns and parameters of an effect's form that are started from every point of a grid."""
    own = columns_of(given, (key,))[given.num_common :]
    return [(int(c), p) for c, p in zip(own, free_of(key), strict=True) if p.starts]


def starts(given: Problem, key: str, base: np.ndarray) -> list[np.ndarray]:
    """Coordinates from which one form of an effect is fitted; all but its gridded ones as in `base`."""
    grids = [[(column, p.coordinate(value)) for value in p.starts] for column, p in _gridded(given, key)]
    out = []
    for chosen in itertools.product(*grids):
        u = base.copy()
        for column, value in chosen:
            u[column] = value
        out.append(u)
    return out


def best_fit(given: Problem, key: str, base: Fitted) -> Fitted:
    """Fit one form of an effect with the properties and with the effects of `base`, usually none.

    Starts are ranked by the cost after a linear step in their amplitudes: a frequency cannot be found while
    its oscillation has no size. Properties start at their measured values, as without the effect they may
    have been pulled far off, and also at those of `base`, since displaced fingers may seem to touch blocks.

    Args:
        given: The problem.
        key: The form.
        base: The fit without it, to start from.
    """
    effects, nominal, usual = (*base.effects, key), base.u.copy(), base.jacobian[:, : given.num_common]
    nominal[: given.measured.size][given.measured.ravel()] = 0.0
    drawn = np.abs(base.u - nominal).max() > SURE  # more than the uncertainty of a touch
    every = [start for u in (nominal, base.u)[: 1 + drawn] for start in starts(given, key, u)]
    ranked = sorted(((*_linear_step(given, effects, u, usual), u) for u in every), key=lambda r: r[0])
    if base.cost - ranked[0][0] < PROMISING:
        there = fit(given, effects, ranked[0][-1], 0, usual)
        if there.cost < base.cost + PROMISING:  # else the step led too far to linearise there
            return there
    leading = [_bring_back(given, effects, u, start, most) for _, u, most, start in ranked[:LEADERS]]
    if len(leading) > 1:
        leading = [min((fit(given, effects, u, SCREEN, usual) for u in leading), key=lambda f: f.cost).u]
    # An effect on moments may change most of how easily blocks turn in the grip.
    return fit(given, effects, fit(given, effects, leading[0], usual=usual).u)


def _bring_back(
    given: Problem, effects: tuple[str, ...], there: np.ndarray, start: np.ndarray, most: float
) -> np.ndarray:
    """Coordinates to which a linear step leads, halved back towards its start, which costs `most`, while
    they cost more.

    Some filters turn recordings into oscillations that grow without end, from where no way leads back.
    """
    mine = columns_of(given, effects)
    for _ in range(HALVINGS):
        if cost_at(given, effects, there, mine)[2] <= most:
            return there
        there = (there + start) / 2
    return start


def _linear_step(
    given: Problem, effects: tuple[str, ...], start: np.ndarray, usual: np.ndarray
) -> tuple[float, np.ndarray, float]:
    """Cost after one linear step of all but the last effect's gridded parameters, the coordinates there,
    and the cost at the start."""
    fixed = [column for column, _ in _gridded(given, effects[-1])]
    low, high = slots(given.num_common)[1]
    columns = np.array([c for c in columns_of(given, effects) if c not in fixed])
    u = start.copy()
    u[columns] = np.clip(u[columns], low[columns], high[columns])
    now = evaluated(given, effects, u, columns, usual)
    curvature = given.nuisances.product(now.jacobian, now.jacobian) + np.eye(columns.size)
    pull = -given.nuisances.product(now.jacobian, now.residual) - u[columns]
    step, _ = least(curvature, pull, low[columns] - u[columns], high[columns] - u[columns])
    there = u.copy()
    there[columns] = np.clip(u[columns] + step, low[columns], high[columns])
    left = now.residual + now.jacobian @ (there[columns] - u[columns])
    own = there[: given.num_common]
    cost = 0.5 * float(given.nuisances.product(left, left)) + now.doubts + 0.5 * float(own @ own)
    return cost, there, now.cost


# Realignment after correction for an effect: forces displaced by a fault may look like another task.


def realigned(aligned: AlignedTrials, given: Problem, found: Fitted, all_fit: bool = False) -> AlignedTrials:
    """Align the trials of a frame from signals corrected for a candidate."""
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
    give = {"normal": float(np.mean(world.give_normal)), "shear": float(np.mean(world.give_shear))}
    pads = {f"{k}_stiffness": 1 / v for k, v in give.items() if v > 1e-7}  # that the candidate gives the rig
    hand = rig.model_copy(update={"fingertip": rig.fingertip.model_copy(update=pads)})
    return replace(align(trials, frame.task, hand, all_fit, rows), rig=rig)


ROUNDS = 2  # numerics: most realignments
ATTEMPTS = 3  # numerics: leading candidates tried in turn if no trial fits its task
HOPELESS = 1e4  # chosen: mean square over the noise's; more is another task and no effect of a hand
Identified = Mapping[tuple[str, str], float]


@dataclass(frozen=True)
class Search:
    """Every candidate fitted to aligned trials.

    Attributes:
        aligned: The trials that fit their task.
        problem: Their fitting problem.
        healthy: Its fit without effects.
        fits: The fit of each form of an effect that shifts signals.
        scatters: The effects that scatter residuals.
        gap: The gap with all of these as candidates, first those of `fits`.
        redrawn: The problem with additional noise on the recordings.
        identified: Identified properties [N, m].
        warnings: One line each.
    """

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
    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Weight, width and height (O, 3) of the blocks, and which are known: measured apart or identified.

        Measured values are those of the fit; what nothing determines is at its prior.
        """
        values, known = self.problem.properties(self.healthy.u), self.problem.measured.copy()
        for (name, kind), value in self.identified.items():
            at = self.problem.frame.task.objects.index(name), PROPERTIES.index(kind)
            if not known[at]:
                values[at], known[at] = value, True
        return values, known


def search(
    aligned: AlignedTrials,
    actual: Actual | None = None,
    excluded: Sequence[str] = (),
    forced: Sequence[str] = (),
    tell: Progress = silent,
    identified: Identified | None = None,
) -> Search:
    """Fit the catalogue, and effects that are `forced`, to aligned trials.

    Args:
        aligned: The trials.
        actual: Measured properties.
        excluded: Effects that are not considered.
        forced: Effects considered in any case.
        tell: Called with a description of each stage.
        identified: Properties identified from the same trials, if known.

    Raises:
        InputError: No trial fits its task.
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
    every, fitting = aligned.trials, tuple(one for one in aligned.trials if one.segmentation.failed is None)
    if not fitting:
        reason = str(every[0].segmentation.failed)
        raise InputError(every[0].trial.file, reason, "a recording that shows every subtask")
    aligned = replace(aligned, trials=fitting)
    known = [(actual or {}).get(name, {}) for name in aligned.task.objects]
    if identified is None and not all(kind in own for own in known for kind in PROPERTIES):
        tell("identifying properties")
        identified = identify_aligned(aligned).centres
    identified = identified or {}
    tell("fitting single effects")
    given = with_nuisances(problem(build(aligned), actual, identified))
    healthy = fit(given, (), neutral(given))
    fits = [best_fit(given, key, healthy) for key in keys]
    others = redrawn(given)
    scattering = scatters(given, healthy.residual, names)
    gap = gap_of(given, healthy, fits, scattering, others)
    missing = dict.fromkeys(name for trial in trials for name in absent(trial))
    warnings = [NOT_COMPARED.format(absent=", ".join(missing))] if missing else []
    failures = [(one.trial.name, one.segmentation.failed) for one in every]
    warnings += [f"{name}: {why}; left out" for name, why in failures if why is not None]
    return Search(aligned, given, healthy, tuple(fits), tuple(scattering), gap, others,
                  identified, (*misled, *warnings))  # fmt: skip


def _aligned_all(
    failed: AlignedTrials, actual: Actual | None, keys: Sequence[str]
) -> tuple[AlignedTrials, list[str]]:
    """Realign trials that all failed, if most fit their task after correction for one of the candidates.

    Returns:
        The trials, as they were if no candidate helps, and a warning that names the one that does.
    """
    every = [one.trial for one in failed.trials]
    shown = [t for t in every if all(np.isfinite(v).any() for v in t.channels.values())]
    if not shown:
        return failed, []
    aligned = align(shown, failed.task, failed.rig, all_fit=True)
    for _ in range(ROUNDS):
        given = problem(build(aligned), actual)
        healthy = fit(given, (), neutral(given))
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
