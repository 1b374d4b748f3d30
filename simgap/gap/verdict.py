"""The verdict: probabilities of every explanation, and what these recordings cannot tell apart."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from simgap.effects import fitted
from simgap.gap import judge
from simgap.gap.candidate import Candidate
from simgap.gap.fit import Problem, slots
from simgap.gap.judge import Calibration
from simgap.gap.locate import ALARM
from simgap.gap.pairs import SHAPING
from simgap.gap.search import Search

DELAYING = frozenset({"force_lag", "force_lowpass"})
TIE = 3.0  # nats (tempered): candidates this near the best cannot be told from it
# Nor those within these shares of its evidence that differ by effects
SHAPED = 0.012  # which reshape signals in time, and by twice TIE at least,
SHORTLY, BRIEF = 0.25, 0.25  # the same where they delay by less than this many samples,
BOTH = 0.006  # by coarse effects alone,
FORM = 0.002  # by a coarse effect and another,
EXACT = 1e-4  # or by others: no form is exact to that


def likelihoods(
    evidence: Mapping[str, float], p_value: float, left: float, p_left: float, c: Calibration
) -> dict[str, float]:
    """Probabilities of none, unknown and every candidate, given whether there is a gap at all.

    With a gap, what names no cause is unknown if anything but noise is left; without one, all but a little is
    none.
    """
    out = judge.probabilities(evidence, left, p_left, c, p_value)
    if p_value < ALARM:
        none = min(out["none"], p_value)
        rest = 1 - out["none"]
        if p_left > ALARM and rest > 0:
            return {k: v * (1 - none) / rest for k, v in out.items()} | {"none": none}
        return out | {"none": none, "unknown": out["unknown"] + out["none"] - none}
    none = 1 - 0.1 * (1 - p_value) ** 4
    rest = sum(v for k, v in out.items() if k != "none")
    scaled = {k: v * (1 - none) / max(rest, 1e-12) for k, v in out.items() if k != "none"}
    return {"none": none if rest > 1e-12 else 1.0, **scaled}


def choose(
    probability: Mapping[str, float], found: Search, gap: bool, forced: bool
) -> tuple[str, list[str], list[str]]:
    """Verdict, causes and the effects that cannot be told from them."""
    best, *others = [k for k in found.candidates if not judge.nameless(k.name)]
    if forced:
        return "named", sorted(best.effects), []
    if not gap:
        return "none", [], []
    if max(probability["unknown"], probability["none"]) > 0.5:
        return "unknown", [], []
    alike = [k for k in others if len(k.effects) == len(best.effects)]
    near = [
        k
        for k in alike
        if best.evidence - k.evidence < _tie(best, k, found.problem) or _as_good(best, k, found.temperature)
    ]
    partners = sorted({e for k in near for e in k.effects} - set(best.effects))
    return ("set" if partners else "named"), sorted(best.effects), partners


def form_share(one: Iterable[str], other: Iterable[str], brief: bool = False) -> float:
    """Share of their evidence by which two sets of effects must differ to be told apart: no form is exact.

    `brief`: they delay forces by a part of a sample only.
    """
    differ = set(one) ^ set(other)
    coarse = [fitted()[name].coarse for name in differ]
    if differ <= SHAPING:
        return SHORTLY if brief else SHAPED
    return BOTH if all(coarse) else FORM if any(coarse) else EXACT


def brief(delays: Iterable[float], step: float) -> bool:
    """Whether forces are late by a part of a sample only: then contacts within one are all that tells.

    `delays` [s] of a cause, none where it has no such part; `step` [s] from sample to sample.
    """
    return max(delays, default=np.inf) < BRIEF * step


def _tie(best: Candidate, other: Candidate, given: Problem) -> float:
    """Nats (tempered) by which a candidate must be behind the best to be told from it."""
    step = float(np.median(np.diff(given.frame.world.t[0])))
    short = all(brief(_delays(k, given), step) for k in (best, other))
    least = 2 * TIE if set(best.effects) ^ set(other.effects) <= SHAPING else TIE
    return max(least, form_share(best.effects, other.effects, short) * best.evidence)


def _delays(candidate: Candidate, given: Problem) -> list[float]:
    """By how much [s] a candidate's effects delay forces."""
    return [
        float(p.value(candidate.fitted.u[slot.start + j]))
        for slot in slots(given.num_properties)[0]
        if slot.effect.name in DELAYING and slot.effect.name in candidate.effects
        for j, p in enumerate(slot.effect.parameters)
    ]


def _as_good(best: Candidate, other: Candidate, temperature: float) -> bool:
    """Whether another candidate of about as many parameters fits as well: a matter of priors alone."""
    if best.spread is not None or other.spread is not None:
        return False
    more = other.fitted.columns.size - best.fitted.columns.size
    return more <= 2 and (other.fitted.cost - best.fitted.cost) / temperature < TIE


def listed(probability: Mapping[str, float]) -> dict[str, float]:
    """Those that matter, and `other` for the rest; they sum to 1."""
    out = {k: v for k, v in probability.items() if k in ("none", "unknown") or v > 1e-3}
    out["other"] = max(0.0, 1.0 - sum(out.values()))
    return out
