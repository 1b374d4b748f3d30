"""The search for an explanation: single effects, boundaries taken anew, odd samples left out, pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.rig import Rig
from hmmseg.segmentation import AlignedTrials, align_trials
from hmmseg.signals import task_space
from hmmseg.task import BlockTask
from hmmseg.trial import Trial
from simgap.effects import catalogue, decoys
from simgap.gap import judge
from simgap.gap.bank import Bank
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.fit import (
    LARGE,
    Fitted,
    Problem,
    Start,
    fit,
    neutral,
    problem,
    residual_at,
    slots,
    without,
)
from simgap.gap.frame import build
from simgap.gap.locate import cells, largest, subtask_name, tamed
from simgap.gap.realign import moved, realigned
from simgap.gap.spread import SPREADS, Spread, spreads

ALARM = 0.01  # chance that a healthy recording is called otherwise
SHIFT = 0.008  # s; boundaries that move farther are taken anew
BEAM, PARTNERS = 2, 5  # singles that pairs start from, partners refined for each
REALIGNED, LEADING = 3, 6  # times at most; without the first of so many candidates that then fits better
UNEASY = 1.3  # times the healthy mean square: what a leading candidate leaves for others to be tried
REFINED = 6  # candidates fitted again after boundaries moved
WORTH = 0.7  # a pair must leave no more than this share of what its better half leaves
MORE = 0.0003  # and must gain this share of its evidence over that half,
COARSE = 0.005  # more if that is coarse
FITTING = 0.01  # and still more if nothing but noise seems left,
LEAST = 10.0  # and so many nats
STUCK = 2.0  # nats at T = 1 by which a half of a pair, taken alone, may do better than as a single so far
ALONE = 0.2  # share of its gain that an effect must keep without the place that it gains most in
EVERY = 0.1  # share of the mean trial's gain in one subtask that it must have in every trial to recur
LITTLE = 3e-3  # share of the gap that is lost in the noise's own scatter: what leaves less is not compared
WILD, LOUD = 5.0, 3.0  # sd; an event reaches the first and goes on while samples exceed the second
BESIDE = 0.015  # share of residuals beside contact changes that may be left out of the fits
EVENTS = 0.03  # share of residuals that may be left out as events
RECURS = 3  # trials at least, to tell an event from an effect
WORTHY = 50.0  # nats at T = 1 by which the leading candidate must win for boundaries to be taken anew
# What shifts or smooths samples in time.
SHAPING = frozenset({"clock_jitter", "force_lag", "force_lowpass", "structural_vibration"})
STRANGE = 3.0  # nats (tempered) by which a decoy must do better than an effect of the catalogue
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

    `statistics`: the largest scores of the residual without any effect, events left out;
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
    singles = [(n,) for n in (*deterministic(names), *decoys())]
    fits = best_fits(given, wanted if forced else singles, healthy)

    # Late, slow or soft contacts displace boundaries: align again without the best explanation.
    for _ in range(REALIGNED):
        leading = [f for f in sorted(fits, key=lambda f: f.cost) if healthy.cost - f.cost >= WORTHY]
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
            if min(f.cost for f in found[1]) - floor * other.size < leading[0].cost - floor * given.size:
                aligned, given, (healthy, fits) = again, other, found
                break
        else:
            break
    beside, event = _wild(given, fits, healthy)
    if beside is not None:
        given = without(given, beside)
    if event is not None:
        warnings += _told(given, event)
        given = without(given, event)
    if beside is not None or event is not None:
        healthy, fits = _refitted(given, healthy, fits, bool(forced))
        statistics = largest(cells(given, residual_at(given, (), healthy.u)))
    if forced:
        found, temperature = _forced(given, fits, healthy, forced, bank)
        return Search(given, healthy, (found,), statistics, temperature, tuple(warnings))
    spread = [s for s in spreads(given, healthy) if s.effect in names]
    temperature = _temperature(given, fits, spread, healthy, bank)
    found = [_single(given, f, healthy, temperature) for f in fits]
    found += [Candidate(s.effect, s.evidence / temperature, healthy, s) for s in spread]
    found.sort(key=lambda c: -c.evidence)
    tell("trying pairs")
    if found[0].evidence > PAIRED:
        pairs = _tried(given, found, healthy, names, temperature, bank)
        better = _unstuck(given, found, pairs, healthy, temperature)
        if better is not found:  # a single was in a worse optimum: what goes with it may have been, too
            found = better
            pairs = _tried(given, found, healthy, names, temperature, bank)
        found = sorted([*found, *_worthwhile(given, found, pairs, healthy, bank)], key=lambda c: -c.evidence)
    return Search(given, healthy, tuple(found), statistics, temperature, tuple(warnings))


def _candidate(given: Problem, f: Fitted, healthy: Fitted, temperature: float) -> Candidate:
    return Candidate(judge.joined(f.effects), judge.log_evidence(given, f, healthy, temperature), f)


def _single(given: Problem, f: Fitted, healthy: Fitted, temperature: float) -> Candidate:
    """A single effect; decoys hold what others are and more, so they are thought less likely."""
    found = _candidate(given, f, healthy, temperature)
    if found.name in decoys():
        return replace(found, evidence=found.evidence - STRANGE)
    return _recurring(given, found, healthy, temperature)


def _recurring(given: Problem, found: Candidate, without: Fitted, temperature: float) -> Candidate:
    """A candidate less what it gains over a fit `without` in one place, if that is most of it: effects recur.

    How far pads slide is free in every grip: what may slide explains any one jump, in one subtask of one
    trial. Whatever else a hand has, it has with every block or in every trial: what shows in one subtask of
    some trials alone was an accident of theirs.
    """
    f = found.fitted
    added = set(f.effects) - set(without.effects)
    if given.frame.num_trials < RECURS:
        return found
    gain = (without.square - f.square) / 2
    slides = any(catalogue()[name].switched for name in added)
    most, total = float((gain if slides else gain.sum(0)).max()), float(gain.sum())
    enough = ALONE * total if slides else min(ALONE * total, LEAST)
    by_trial = gain[: given.frame.num_trials, gain.sum(0).argmax()]
    every = not slides and by_trial.min() > EVERY * by_trial.mean()
    excess = most if total - most < enough and not every else 0.0
    return replace(found, evidence=found.evidence - excess / temperature)


def _tried(
    given: Problem,
    singles: Sequence[Candidate],
    healthy: Fitted,
    names: list[str],
    temperature: float,
    bank: Bank,
) -> list[Candidate]:
    """Pairs of the leading singles with whatever gains most beside them."""
    enough = singles[0].spread is None and left(given, singles[0], healthy, bank)[1] > ALARM
    beam = [c for c in singles if c.spread is None and c.name not in decoys()][: 1 if enough else BEAM]
    return _pairs(given, beam, healthy, names, temperature)


def _unstuck(
    given: Problem,
    singles: list[Candidate],
    pairs: Sequence[Candidate],
    healthy: Fitted,
    temperature: float,
) -> list[Candidate]:
    """The singles, best first, fitted again from the values that they have in the best pair."""
    if not pairs:
        return singles
    best = max(pairs, key=lambda c: c.evidence)
    stuck = [c for c in singles if c.name in best.fitted.effects]
    if best.spread is not None or best.evidence < max(c.evidence for c in stuck) + LEAST:
        return singles
    again = {f.effects: f for f in fit(given, [Start(c.effects, best.fitted.u) for c in stuck])}
    freed = {
        c.name: _single(given, again[c.effects], healthy, temperature)
        for c in stuck
        if again[c.effects].cost < c.fitted.cost - STUCK
    }
    return sorted((freed.get(c.name, c) for c in singles), key=lambda c: -c.evidence) if freed else singles


def _worthwhile(
    given: Problem, singles: Sequence[Candidate], pairs: Sequence[Candidate], healthy: Fitted, bank: Bank
) -> list[Candidate]:
    """The pairs that say enough more than the better one of their halves."""
    out = []
    for pair in pairs:
        better = max((c for c in singles if c.name in pair.effects), key=lambda c: c.evidence)
        rest, p_rest = left(given, better, healthy, bank)
        share = MORE
        if any(catalogue()[name].coarse for name in better.effects):
            share = FITTING if p_rest > ALARM else COARSE
        if pair.evidence - better.evidence < max(share * pair.evidence, LEAST):
            continue
        if left(given, pair, healthy, bank)[0] < max(WORTH * rest, LITTLE):
            out.append(pair)
    return out


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


def _wild(
    given: Problem, fits: Sequence[Fitted], healthy: Fitted
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """What no candidate explains and is no gap: single residuals beside contact changes, and events.

    Both (T, N, C), None where there are none. An effect recurs: what is wild in one of several trials and
    in none of the others (a finger that brushes a block) is an event. More than a few are a gap to be
    explained.
    """
    leading = [healthy, *sorted(fits, key=lambda f: f.cost)[:3]]
    least = np.min([np.abs(residual_at(given, f.effects, f.u)) for f in leading], axis=0)
    there, edge = given.whitening.weight > 0, (given.frame.arrays.kind % 2 == 1)[..., None]
    beside = there & edge & (least > WILD)
    moments = _moments(given, np.where(edge, np.minimum(least, WILD), least).max(2))
    event = there & moments[..., None]
    return tuple(
        found if 0 < found.sum() <= most * given.size else None
        for found, most in ((beside, BESIDE), (event, EVENTS))
    )  # type: ignore[return-value]


def _moments(given: Problem, least: np.ndarray) -> np.ndarray:
    """Samples (T, N) of events, from the largest residual of each sample that the best candidates leave."""
    subtask = given.frame.arrays.subtask
    if given.frame.num_trials < RECURS:
        return np.zeros(subtask.shape, bool)
    hit = np.stack([((least > WILD) & (subtask == s)).any(1) for s in range(len(given.frame.steps))], 1)
    alone = np.take_along_axis(hit & (hit.sum(0) == 1), subtask, axis=1)
    moments, loud = alone & (least > WILD), alone & (least > LOUD)
    while True:
        near = moments.copy()
        near[:, 1:] |= moments[:, :-1]
        near[:, :-1] |= moments[:, 1:]
        if not (near & loud & ~moments).any():
            return near
        moments |= near & loud


def _told(given: Problem, event: np.ndarray) -> list[str]:
    """A warning for every trial and subtask with an event."""
    frame, out = given.frame, []
    for r in range(frame.num_trials):
        when = event[r].any(1)
        for s in np.unique(frame.arrays.subtask[r, when]):
            t = frame.world.t[r, when & (frame.arrays.subtask[r] == s)]
            out.append(
                f"{frame.files[r]}: {subtask_name(frame.steps[s])}, {t[0]:.2f} to {t[-1]:.2f} s: an event of "
                "this trial alone, left out"
            )
    return out


def left(given: Problem, candidate: Candidate, healthy: Fitted, bank: Bank) -> tuple[float, float]:
    """Share of the excess square that a candidate leaves, and the chance of noise to look like that."""
    floor = bank.calibration.floor * given.size
    before = max(float((tamed(given, residual_at(given, (), healthy.u)) ** 2).sum()) - floor, 1.0)
    z = remainder(given, candidate)
    rest = float((tamed(given, z) ** 2).sum()) - floor
    p = min(bank.detection.p_values(largest(cells(given, z))).values())
    return float(np.clip(rest / before, 0.0, 1.0)), p


def _pairs(
    given: Problem, best: Sequence[Candidate], healthy: Fitted, names: list[str], temperature: float
) -> list[Candidate]:
    """Pairs of the best singles, none of them a spread, with whatever gains most beside them.

    Two effects that both reshape signals in time (SHAPING) make up for each other's form: no
    sampled recording tells such a pair from one of them.
    """
    out: dict[str, Candidate] = {}
    width = {s.effect.name: len(s.effect.parameters) for s in slots(given.num_properties)[0]}
    for single in best:
        partners = [
            n
            for n in deterministic(names)
            if n != single.name and width[n] + width[single.name] <= LARGE and not {n, single.name} <= SHAPING
        ]
        wanted = [tuple(sorted((single.name, n))) for n in partners]
        fits = best_fits(given, wanted, healthy, [single.fitted] * len(wanted), steps=3)
        fits = sorted(fits, key=lambda f: f.cost)[:PARTNERS]
        for f in fit(given, [Start(f.effects, f.u) for f in fits]):
            name = judge.joined(f.effects)
            candidate = _recurring(
                given, _candidate(given, f, healthy, temperature), single.fitted, temperature
            )
            if name not in out or candidate.evidence > out[name].evidence:
                out[name] = candidate
        for s in spreads(given, single.fitted):
            if {s.effect, single.name} <= SHAPING:
                continue
            name = judge.joined((single.name, s.effect))
            out[name] = Candidate(name, single.evidence + s.evidence / temperature, single.fitted, s)
    return list(out.values())
