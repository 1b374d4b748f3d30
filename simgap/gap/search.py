"""The search for an explanation: single effects, boundaries taken anew, odd samples left out, pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from hmmseg.errors import InputError
from hmmseg.rig import Rig
from hmmseg.segmentation import AlignedTrials, align_trials
from hmmseg.signals import task_space
from hmmseg.task import BlockTask
from hmmseg.trial import Trial
from simgap.effects import catalogue
from simgap.gap import judge
from simgap.gap.bank import Bank
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.fit import Fitted, Problem, Start, fit, neutral, problem, residual_at, slots, without
from simgap.gap.frame import build
from simgap.gap.locate import cells, largest
from simgap.gap.realign import moved, realigned
from simgap.gap.spread import SPREADS, Spread, spreads

ALARM = 0.01  # chance that a healthy recording is called otherwise
SHIFT = 0.008  # s; boundaries that move farther are taken anew
BEAM, PARTNERS = 2, 5  # singles that pairs start from, partners refined for each
REALIGNED = 2  # times at most
REFINED = 6  # candidates fitted again after boundaries moved
WORTH = 0.6  # a pair must leave no more than this share of what its better half leaves
MORE = 0.07  # and must gain this share of its evidence over that half, more than a model's form is off by
ENOUGH = 0.03  # a single that leaves less of the gap needs no partner: no model is exact to the last per cent
WILD, BUMPS = 5.0, 0.015  # sd; share of samples that may be wilder and be left out
WORTHY = 50.0  # nats at T = 1 by which the leading candidate must win for boundaries to be taken anew
PAIRED = 20.0  # nats that a single must have gained for pairs to be tried
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Candidate:
    """One explanation: its effects, tempered log evidence over none, and its fit or spread."""

    name: str
    evidence: float
    fitted: Fitted
    spread: Spread | None = None

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its effects."""
        return tuple(self.name.split("+"))


@dataclass(frozen=True)
class Search:
    """All candidates, best first, fitted to one `problem`; `healthy` is the fit without any effect.

    `statistics`: the largest scores of the residual at the first fit, before anything was left out;
    `temperature` that of the evidence.
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
    aligned = align_trials([t.file for t in trials], [task_space(t, rig) for t in trials], task, rig)
    trials, aligned, warnings = _complete(trials, aligned)
    given = problem(build(trials, aligned, rig), bank.noise, actual)
    healthy = fit(given, [Start((), neutral(given))])[0]
    statistics = largest(cells(given, residual_at(given, (), healthy.u)))
    names = _names(rig, excluded)
    tell("fitting single effects")
    wanted = [w for w in [tuple(sorted(set(forced) - set(SPREADS)))] if w]
    fits = best_fits(given, wanted if forced else [(n,) for n in deterministic(names)], healthy)

    # Late, slow or soft contacts displace boundaries: align again without the best explanation.
    for _ in range(REALIGNED):
        leading = min(fits, key=lambda f: f.cost, default=None)
        if leading is None or healthy.cost - leading.cost < WORTHY:
            break
        tell("aligning again without the best explanation")
        again = realigned(trials, given, leading)
        if not SHIFT < moved(aligned, again) < np.inf:
            break
        aligned = again
        given = problem(build(trials, aligned, rig), bank.noise, actual)
        healthy, fits = _refitted(given, healthy, fits, bool(forced))
    wild = _bumps(given, fits, healthy)
    if wild is not None:
        warnings.append(f"{int(wild.sum())} samples that no candidate explains are left out of the fits")
        given = without(given, wild)
        healthy, fits = _refitted(given, healthy, fits, bool(forced))
    if forced:
        found, temperature = _forced(given, fits, healthy, forced, bank)
        return Search(given, healthy, (found,), statistics, temperature, tuple(warnings))
    spread = [s for s in spreads(given, healthy) if s.effect in names]
    temperature = _temperature(given, fits, spread, healthy, bank)
    found = [_candidate(given, f, healthy, temperature) for f in fits]
    found += [Candidate(s.effect, s.evidence / temperature, healthy, s) for s in spread]
    found.sort(key=lambda c: -c.evidence)
    tell("trying pairs")
    if found[0].evidence > PAIRED:
        single, rest = left(given, found[0], healthy, bank)
        flexible = any(catalogue()[name].local for name in found[0].effects)  # free amounts fit others' gaps
        if rest > 0.5 and (single > ENOUGH or flexible):
            singles = tuple(found)
            alone = {c.name: left(given, c, healthy, bank)[0] for c in singles}
            for pair in _pairs(given, found, healthy, names, temperature):
                better_half = min(alone.get(name, 1.0) for name in pair.effects)
                more = pair.evidence - max(c.evidence for c in singles if c.name in pair.effects)
                if left(given, pair, healthy, bank)[0] < WORTH * better_half and more > MORE * pair.evidence:
                    found.append(pair)
            found.sort(key=lambda c: -c.evidence)
    return Search(given, healthy, tuple(found), statistics, temperature, tuple(warnings))


def _candidate(given: Problem, f: Fitted, healthy: Fitted, temperature: float) -> Candidate:
    return Candidate(judge.joined(f.effects), judge.log_evidence(given, f, healthy, temperature), f)


def _forced(
    given: Problem, fits: Sequence[Fitted], healthy: Fitted, forced: Sequence[str], bank: Bank
) -> tuple[Candidate, float]:
    """The candidate of all forced effects, and its temperature; of several spreads the last one counts."""
    fitted = fits[0] if fits else healthy
    chosen = [s for s in spreads(given, fitted) if s.effect in forced]
    temperature = _temperature(given, [fitted], chosen, healthy, bank)
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
    """The healthy fit and the leading candidates once more, on a changed problem."""
    again = fit(given, [Start((), healthy.u)])[0]
    fits = fits if every else sorted(fits, key=lambda f: f.cost)[:REFINED]
    return again, fit(given, [Start(f.effects, f.u) for f in fits])


def _complete(
    trials: Sequence[Trial], aligned: AlignedTrials
) -> tuple[list[Trial], AlignedTrials, list[str]]:
    """The trials that fit their task, and warnings of the others."""
    keep = [k for k, a in enumerate(aligned.trials) if a.segmentation.complete]
    out = [f"{t.name}: does not fit its task and is left out" for k, t in enumerate(trials) if k not in keep]
    if not keep:
        raise InputError(trials[0].file, "does not fit its task", "a recording that shows every subtask")
    chosen = AlignedTrials(
        aligned.task, aligned.subtasks, aligned.fit, tuple(aligned.trials[k] for k in keep)
    )
    return [trials[k] for k in keep], chosen, out


def _temperature(
    given: Problem, fits: Sequence[Fitted], spread: Sequence[Spread], healthy: Fitted, bank: Bank
) -> float:
    """How far the best candidate misses the healthy floor, in mean square; a floor learned on the bank."""
    z = residual_at(given, (), healthy.u)
    least = min(
        [healthy.square.sum(), *(f.square.sum() for f in fits), *(((z / s.scale) ** 2).sum() for s in spread)]
    )
    return max(bank.calibration.temperature, float(least) / (given.size * bank.calibration.floor))


def remainder(given: Problem, candidate: Candidate) -> np.ndarray:
    """Whitened residuals (T, N, C) that a candidate leaves."""
    z = residual_at(given, candidate.fitted.effects, candidate.fitted.u)
    return z if candidate.spread is None else z / candidate.spread.scale


def _bumps(given: Problem, fits: Sequence[Fitted], healthy: Fitted) -> np.ndarray | None:
    """A few wild samples (T, N, C) that no candidate explains, and their neighbours; None where none are.

    A block that brushes another is an event and no effect. More than a few are a gap to be explained.
    """
    leading = [healthy, *sorted(fits, key=lambda f: f.cost)[:3]]
    least = np.min([np.abs(residual_at(given, f.effects, f.u)) for f in leading], axis=0)
    wild = least > WILD
    near = wild.copy()
    near[:, 1:] |= wild[:, :-1]
    near[:, :-1] |= wild[:, 1:]
    near &= given.whitening.weight > 0
    return near if 0 < near.sum() <= BUMPS * given.size else None


def left(given: Problem, candidate: Candidate, healthy: Fitted, bank: Bank) -> tuple[float, float]:
    """Share of the excess square that a candidate leaves, and how surely (0 to 1) that is no noise."""
    floor = bank.calibration.floor * given.size
    before = max(healthy.square.sum() - floor, 1.0)
    z = remainder(given, candidate)
    rest = float((z**2).sum()) - floor
    scores = largest(cells(given, z))
    p = min(bank.detection.p_values(scores).values())
    share = float(np.clip(rest / before, 0.0, 1.0))
    return share, float(expit(2 * (np.log10(ALARM) - np.log10(max(p, 1e-30)))))


def _pairs(
    given: Problem, found: list[Candidate], healthy: Fitted, names: list[str], temperature: float
) -> list[Candidate]:
    """Pairs of the best singles with whatever gains most beside them."""
    out: dict[str, Candidate] = {}
    width = {s.effect.name: len(s.effect.parameters) for s in slots(given.num_properties)[0]}
    for single in [c for c in found if c.spread is None][:BEAM]:
        partners = [
            n for n in deterministic(names) if n != single.name and width[n] + width[single.name] <= 26
        ]
        wanted = [tuple(sorted((single.name, n))) for n in partners]
        fits = best_fits(given, wanted, healthy, [single.fitted] * len(wanted), steps=3)
        fits = sorted(fits, key=lambda f: f.cost)[:PARTNERS]
        for f in fit(given, [Start(f.effects, f.u) for f in fits]):
            name = judge.joined(f.effects)
            candidate = Candidate(name, judge.log_evidence(given, f, healthy, temperature), f)
            if name not in out or candidate.evidence > out[name].evidence:
                out[name] = candidate
        for s in spreads(given, single.fitted):
            name = judge.joined((single.name, s.effect))
            out[name] = Candidate(name, single.evidence + s.evidence / temperature, single.fitted, s)
    return list(out.values())
