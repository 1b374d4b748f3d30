"""One explanation of a gap: its evidence, and what it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simgap.effects import decoys, fitted
from simgap.gap import judge
from simgap.gap.bank import Bank
from simgap.gap.events import RECURS
from simgap.gap.fit import Fitted, Problem, residual_at, slots
from simgap.gap.locate import cells, largest, tamed
from simgap.gap.spread import Spread

ALONE = 0.2  # share of its gain that an effect must keep without the place that it gains most in
EVERY = 0.1  # share of the mean trial's gain in one subtask that it must have in every trial to recur,
BUT_ONE = 4  # or in all but one of so many: noise hides what is small
LEAST = 10.0  # nats
KEPT = 0.6  # share of its evidence that a candidate must gain on held-out trials
STRANGE = 3.0  # nats (tempered) by which a decoy must do better than an effect of the catalogue,
PATTERN = 3.0  # and parts that err alike better than parts that each err by themselves


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
        return tuple(self.name.removesuffix(judge.ALIKE).split("+"))


def temperature_of(
    given: Problem, fits: Sequence[Fitted], spread: Sequence[Spread], healthy: Fitted, bank: Bank
) -> float:
    """How far the best candidate misses the healthy floor, in mean square; a floor learned on the bank."""
    z = residual_at(given, (), healthy.u)
    least = min(
        [healthy.square.sum(), *(f.square.sum() for f in fits), *(((z / s.scale) ** 2).sum() for s in spread)]
    )
    return max(bank.calibration.temperature, float(least) / (given.size * bank.calibration.floor))


def scored(given: Problem, f: Fitted, healthy: Fitted, temperature: float) -> Candidate:
    """A fitted candidate with its evidence, which counts for no more than other trials bear out.

    A fit to all trials may owe its evidence to one of them. Right explanations gain about as much on trials
    that they were not fitted to, and by agreeing with properties that were measured apart.
    """
    evidence = judge.log_evidence(given, f, healthy, temperature)
    n = given.frame.num_trials
    if n >= RECURS:
        labels = judge.folds(f, n, np.zeros(0))
        kept = judge.heldout_gain(given, f, healthy, labels)
        kept += believed(given, f) - believed(given, healthy)
        if kept < KEPT * evidence:
            evidence = min(evidence, max(kept, 0.0) / temperature)
    if not all(_resolved(given, name, f) for name in f.effects):
        evidence = min(evidence, 0.0)
    return Candidate(judge.joined(f.effects), evidence, f)


def _resolved(given: Problem, name: str, f: Fitted) -> bool:
    """Whether the rig's sensors can show an effect as small as it was fitted."""
    effect, slot = fitted()[name], next(s for s in slots(given.num_properties)[0] if s.effect.name == name)
    if effect.resolved is None:
        return True
    values = {p.name: float(p.value(f.u[slot.start + j])) for j, p in enumerate(effect.parameters)}
    return effect.resolved(values, given.frame.rig)


def believed(given: Problem, f: Fitted) -> float:
    """Log prior density [nats], less a constant, of the properties that a candidate asks for."""
    return -0.5 * float((f.u[: given.num_properties] ** 2).sum())


def single(given: Problem, f: Fitted, healthy: Fitted, temperature: float) -> Candidate:
    """A single effect; decoys hold what others are and more, so they are thought less likely."""
    found = recurring(given, scored(given, f, healthy, temperature), healthy, temperature)
    return replace(found, evidence=found.evidence - STRANGE) if found.name in decoys() else found


def recurring(given: Problem, found: Candidate, without: Fitted, temperature: float) -> Candidate:
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
    slides = any(fitted()[name].switched for name in added)
    most, total = float((gain if slides else gain.sum(0)).max()), float(gain.sum())
    enough = ALONE * total if slides else min(ALONE * total, LEAST)
    by_trial = np.sort(gain[: given.frame.num_trials, gain.sum(0).argmax()])
    least = by_trial[1 if by_trial.size >= BUT_ONE else 0]
    every = not slides and least > EVERY * by_trial.mean()
    excess = most if total - most < enough and not every else 0.0
    return replace(found, evidence=found.evidence - excess / temperature)


def alike(given: Problem, found: Candidate, temperature: float) -> Candidate | None:
    """The candidate as one whose parts err alike, a decoy; None where it has no such parts."""
    factor = judge.coincidence(given, found.fitted, temperature)
    if not np.isfinite(factor):
        return None
    return replace(found, name=found.name + judge.ALIKE, evidence=found.evidence + factor - PATTERN)


def remainder(given: Problem, candidate: Candidate) -> np.ndarray:
    """Whitened residuals (T, N, C) that a candidate leaves."""
    z = residual_at(given, candidate.fitted.effects, candidate.fitted.u)
    return z if candidate.spread is None else z / candidate.spread.scale


def left(given: Problem, candidate: Candidate, healthy: Fitted, bank: Bank) -> tuple[float, float]:
    """Share of the excess square that a candidate leaves, and the chance of noise to look like that."""
    floor = bank.calibration.floor * given.size
    before = max(float((tamed(given, residual_at(given, (), healthy.u)) ** 2).sum()) - floor, 1.0)
    z = remainder(given, candidate)
    rest = float((tamed(given, z) ** 2).sum()) - floor
    p = min(bank.detection.p_values(largest(cells(given, z))).values())
    return float(np.clip(rest / before, 0.0, 1.0)), p
