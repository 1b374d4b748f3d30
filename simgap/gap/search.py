"""The search for an explanation: single effects, boundaries taken anew, odd samples left out, pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.effects import catalogue, decoys
from simgap.gap import judge
from simgap.gap.bank import Bank
from simgap.gap.candidate import Candidate, alike, single, temperature_of
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.events import odd, told
from simgap.gap.fit import Fitted, Problem, Start, fit, neutral, problem, residual_at, without
from simgap.gap.frame import build
from simgap.gap.insist import insisted
from simgap.gap.locate import raised
from simgap.gap.pairs import tried, unstuck, worthwhile
from simgap.gap.realign import moved, realigned
from simgap.gap.spread import SPREADS, spreads

SHIFT = 0.008  # s; boundaries that move farther are taken anew
REALIGNED, LEADING = 3, 6  # times at most; without the first of so many candidates that then fits better
UNEASY = 1.3  # times the healthy mean square: what a leading candidate leaves for others to be tried
REFINED = 6  # candidates fitted again after boundaries moved
WORTHY = 50.0  # nats at T = 1 by which the leading candidate must win for boundaries to be taken anew
PAIRED = 20.0  # nats that a single must have gained for pairs to be tried
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Search:
    """All candidates, best first, fitted to one `problem`; `healthy` is the fit without any effect.

    `statistics`: the largest scores of the residual without any effect, events left out, and the largest
    evidence of an effect, of all trials together; `temperature` that of the evidence.
    """

    problem: Problem
    healthy: Fitted
    candidates: tuple[Candidate, ...]
    statistics: dict[str, float]
    temperature: float
    warnings: tuple[str, ...]


def search(
    trials: Sequence[Trial],
    task: BlockTask,
    rig: Rig,
    bank: Bank,
    actual: dict | None,
    forced: Sequence[str],
    excluded: Sequence[str],
    tell: Progress,
) -> Search:
    """Fit the catalogue to recordings of one block task; InputError where no trial fits its task."""
    tell("aligning trials")
    aligned = align(trials, task, rig)
    names, misled = _names(rig, excluded), []
    if not any(t.segmentation.complete for t in aligned.trials):
        tell("aligning trials that seem not to fit")
        known = [tuple(sorted(forced))] if forced else [(n,) for n in (*deterministic(names), *decoys())]
        aligned, misled = insisted(trials, aligned, rig, bank, actual, known)
    trials, aligned, warnings = _complete(trials, aligned)
    warnings = [*misled, *warnings]
    given = problem(build(trials, aligned, rig), bank.noise, actual)
    healthy = fit(given, [Start((), neutral(given))])[0]
    statistics = raised(given, residual_at(given, (), healthy.u))
    tell("fitting single effects")
    wanted = [w for w in [tuple(sorted(set(forced) - set(SPREADS)))] if w]
    singles = [(n,) for n in (*deterministic(names), *decoys())]
    fits = best_fits(given, wanted if forced else singles, healthy)

    # Late, slow or soft contacts displace boundaries: align again without the best explanation.
    for _ in range(REALIGNED):
        leading = [f for f in _known(fits) if healthy.cost - f.cost >= WORTHY]
        if not leading:
            break
        tell("aligning again without the best explanation")
        floor = 0.5 * bank.calibration.floor
        rest = leading[0].cost > UNEASY * floor * given.size
        for best in leading[: LEADING if rest else 1]:
            again = realigned(trials, given, best)
            if not SHIFT < moved(aligned, again) < np.inf:
                continue
            other = problem(build(trials, again, rig), bank.noise, actual)
            found = _refitted(other, healthy, fits, bool(forced))
            if _known(found[1])[0].cost - floor * other.size < leading[0].cost - floor * given.size:
                aligned, given, (healthy, fits) = again, other, found
                break
        else:
            break
    beside, event = odd(given, fits, healthy)
    if beside is not None:
        given = without(given, beside)
    if event is not None:
        warnings += told(given, event)
        given = without(given, event)
    if beside is not None or event is not None:
        healthy, fits = _refitted(given, healthy, fits, bool(forced))
        statistics = raised(given, residual_at(given, (), healthy.u))
    if forced:
        found, temperature = _forced(given, fits, healthy, forced, bank)
        statistics["gain"] = found.evidence
        return Search(given, healthy, (found,), statistics, temperature, tuple(warnings))
    spread = [s for s in spreads(given, healthy) if s.effect in names]
    temperature = temperature_of(given, fits, spread, healthy, bank)
    found = [single(given, f, healthy, temperature) for f in fits]
    found += [Candidate(s.effect, s.evidence / temperature, healthy, s) for s in spread]
    found.sort(key=lambda c: -c.evidence)
    tell("trying pairs")
    if found[0].evidence > PAIRED:
        found, pairs = tried(given, found, healthy, names, temperature, bank)
        better = unstuck(given, found, pairs, healthy, temperature)
        if better is not found:  # a single was in a worse optimum: what goes with it may have been, too
            found, pairs = tried(given, better, healthy, names, temperature, bank)
        found = [*found, *worthwhile(given, found, pairs, healthy, bank)]
    found += [c for c in (alike(given, k, temperature) for k in found) if c is not None]
    found.sort(key=lambda c: -c.evidence)
    # Decoys are so free that they gain on healthy recordings as well: they raise no alarm.
    statistics["gain"] = max(c.evidence for c in found if not judge.nameless(c.name))
    return Search(given, healthy, tuple(found), statistics, temperature, tuple(warnings))


def _forced(
    given: Problem, fits: Sequence[Fitted], healthy: Fitted, forced: Sequence[str], bank: Bank
) -> tuple[Candidate, float]:
    """The candidate of all forced effects, and its temperature; of several spreads the last one counts."""
    fitted = fits[0] if fits else healthy
    chosen = [s for s in spreads(given, fitted) if s.effect in forced]
    temperature = temperature_of(given, [fitted], chosen, healthy, bank)
    evidence = judge.log_evidence(given, fitted, healthy, temperature) if fits else 0.0
    evidence += sum(s.evidence for s in chosen) / temperature
    return Candidate(judge.joined(forced), evidence, fitted, chosen[-1] if chosen else None), temperature


def _names(rig: Rig, excluded: Sequence[str]) -> list[str]:
    """The effects to choose from: a Cartesian hand has no joints."""
    return [
        name
        for name, effect in catalogue().items()
        if effect.chosen and name not in excluded and (rig.jointed or effect.acts_on != "kinematics")
    ]


def _refitted(
    given: Problem, healthy: Fitted, fits: Sequence[Fitted], every: bool
) -> tuple[Fitted, list[Fitted]]:
    """The healthy fit, the leading candidates and the decoys once more, on a changed problem."""
    again = fit(given, [Start((), healthy.u)])[0]
    if not every:
        fits = [*_known(fits)[:REFINED], *(f for f in fits if f.effects[0] in decoys())]
    return again, fit(given, [Start(f.effects, f.u) for f in fits])


def _known(fits: Sequence[Fitted]) -> list[Fitted]:
    """The candidates of the catalogue, best first; decoys fit anything and move no boundary."""
    return [f for f in sorted(fits, key=lambda f: f.cost) if not {*f.effects} <= decoys().keys()]


def _complete(
    trials: Sequence[Trial], aligned: AlignedTrials
) -> tuple[list[Trial], AlignedTrials, list[str]]:
    """The trials that fit their task, and warnings of the others."""
    failed = [a.segmentation.failed for a in aligned.trials]
    keep = [k for k, failure in enumerate(failed) if failure is None]
    if not keep:
        raise InputError(trials[0].file, str(failed[0]), "a recording that shows every subtask")
    out = [f"{t.name}: {f}; left out" for t, f in zip(trials, failed, strict=True) if f is not None]
    chosen = replace(aligned, trials=tuple(aligned.trials[k] for k in keep))
    return [trials[k] for k in keep], chosen, out
