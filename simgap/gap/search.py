"""Every candidate fitted to aligned trials; boundaries taken anew without what displaced them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.identification import identify_aligned
from hmmseg.contact.decompose import PROPERTIES
from hmmseg.errors import InputError
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.attribution.problem import Gap
from simgap.effects import decoys, name_of
from simgap.gap.assemble import gap_of
from simgap.gap.candidates import best_fit, candidate_names, shifting
from simgap.gap.fit import Fitted, Start, fit
from simgap.gap.frame import build
from simgap.gap.nuisances import with_nuisances
from simgap.gap.problem import Problem, neutral, problem, rebased
from simgap.gap.realign import moved, realigned
from simgap.gap.redrawn_noise import noise_gained, redrawn
from simgap.gap.scatter import Scatter, scatters
from simgap.gap.wrist_gap import not_compared, of_wrist, shown, shown_forms
from simgap.progress import Progress, silent

SHIFT = 0.008  # chosen: s; boundaries that move farther are taken anew
ROUNDS = 2  # numerics: times at most
ATTEMPTS = 3  # numerics: leading candidates that are taken out in turn where no trial fits its task
HOPELESS = 1e4  # chosen: times the noise's square, in the mean: no effect of a hand, but another task
WORTH = 50.0  # chosen: nats that a candidate must gain for boundaries to be taken anew without it
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

        What is measured is as the recordings leave it, what nothing tells as the prior does.
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
) -> Search:
    """Fit the catalogue, and what is `forced`, to aligned trials; InputError where none fits its task.

    `identified`: what `identify` made of the same trials, where that is known already.
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
    aligned, warnings = _complete(aligned)
    if identified is None:
        tell("identifying properties")
        identified = identify_aligned(aligned).means
    tell("fitting single effects")
    given = with_nuisances(problem(build(aligned), actual, identified))
    healthy = fit(given, Start((), neutral(given)))
    fits = [best_fit(given, key, healthy) for key in keys]
    others = redrawn(given)
    for _ in range(ROUNDS):
        again = _anew(aligned, given, healthy, fits, others)
        if again is None:
            break
        tell("aligning again without the best explanation")
        aligned, given, healthy, fits = again
        others = redrawn(given)
    scattering = scatters(given, given.nuisances.left(healthy.residual), names)
    gap = gap_of(given, healthy, fits, scattering, others)
    if of_wrist(trials):
        warnings = [not_compared(trials), *warnings]
    return Search(aligned, given, healthy, tuple(fits), tuple(scattering), gap, others,
                  identified, (*misled, *warnings))  # fmt: skip


def _anew(
    aligned: AlignedTrials,
    given: Problem,
    healthy: Fitted,
    fits: Sequence[Fitted],
    others: Sequence[Problem],
):
    """Everything once more with boundaries from forces without the best explanation, if that fits better.

    Late, slow or soft contacts displace boundaries.
    """
    best = _known(fits)[0]
    gained = healthy.cost - best.cost
    if gained < WORTH or gained - noise_gained(others, healthy, best) < WORTH:
        return None
    again = realigned(aligned, given, best)
    if not SHIFT < moved(aligned, again) < np.inf:
        return None
    other = with_nuisances(rebased(build(again), given))
    if fit(other, Start(best.effects, best.u)).cost / other.size > best.cost / given.size:
        return None
    plain = fit(other, Start((), healthy.u))
    return again, other, plain, [fit(other, Start(f.effects, f.u)) for f in fits]


def _known(fits: Sequence[Fitted]) -> list[Fitted]:
    """The candidates of the catalogue, best first; decoys fit anything and move no boundary."""
    return sorted((f for f in fits if name_of(f.effects[0]) not in decoys()), key=lambda f: f.cost)


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
        found = _known([best_fit(given, key, healthy) for key in keys])
        for f in found[:ATTEMPTS]:
            again = realigned(aligned, given, f)
            if 2 * sum(t.segmentation.complete for t in again.trials) > len(again.trials):
                why = failed.trials[0].segmentation.failed
                return again, [f"{why}; without {name_of(f.effects[0])} it fits"]
        aligned = realigned(aligned, given, found[0], all_fit=True)
    return failed, []


def _complete(aligned: AlignedTrials) -> tuple[AlignedTrials, list[str]]:
    """The trials that fit their task, and warnings of the others."""
    failed = [(one.trial, one.segmentation.failed) for one in aligned.trials if one.segmentation.failed]
    keep = tuple(one for one in aligned.trials if one.segmentation.failed is None)
    if not keep:
        raise InputError(failed[0][0].file, str(failed[0][1]), "a recording that shows every subtask")
    return replace(aligned, trials=keep), [f"{t.name}: {why}; left out" for t, why in failed]
