"""The diagnosis: is there a gap, where, which effects cause it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.jaxconfig import double_precision
from simgap.effects import decoys
from simgap.gap import judge
from simgap.gap.adapt import adapted
from simgap.gap.bank import Bank, load_bank
from simgap.gap.candidate import Candidate, left, remainder
from simgap.gap.describe import describe, property_values, where
from simgap.gap.experiments import next_experiment
from simgap.gap.fit import Fitted, Problem, residual_at
from simgap.gap.locate import ALARM, Cell, cells, together
from simgap.gap.search import Search, search
from simgap.gap.shrinkage import shrinkage
from simgap.gap.verdict import choose, likelihoods, listed

STAGES = 6  # that `progress` is told of, at most
LISTED = 8  # candidates that are described
CELL = 4.5  # score of a cell that is listed once a gap is established: the largest of most healthy trials
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Diagnosis:
    """Everything found; `body` is the JSON document's. Arrays are for figures and tests.

    `before`, `after` (T, N, C): whitened residuals without and with the verdict's effects;
    `scores`: what the probabilities were made of.
    """

    body: dict[str, Any]
    problem: Problem
    healthy: Fitted
    candidates: tuple[Candidate, ...]
    before: np.ndarray
    after: np.ndarray
    cells: tuple[Cell, ...]
    threshold: float
    scores: dict[str, Any]
    warnings: tuple[str, ...] = ()


@double_precision
def diagnose(
    trials: Sequence[Trial],
    task: BlockTask,
    rig: Rig,
    actual: dict | None = None,
    forced: Sequence[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
    bank: Bank | None = None,
    excluded: Sequence[str] = (),
) -> Diagnosis:
    """Diagnose recordings of one block task against the nominal model.

    `actual` as `estimation.actual.read_actual` gives it; `forced` names effects to be taken instead of
    choosing; `excluded` effects are not thought of. `bank` is the package's own by default; where it has a
    reference and that is another rig's, its thresholds are moved. InputError where no trial fits its task.
    """
    tell = progress or (lambda text: None)
    bank = bank or load_bank()
    found = search(trials, task, rig, bank, actual, forced, excluded, tell)
    bank = adapted(bank, found.problem, found.healthy, trials)
    tell("held-out trials")
    given, best = found.problem, found.candidates[0]
    p = bank.detection.p_values(found.statistics)
    p_value = together(p)
    rest, p_left = left(given, best, found.healthy, bank)
    scores = {
        "evidence": {c.name: c.evidence for c in found.candidates},
        "left": rest, "p_left": p_left, "p": p,
    }  # fmt: skip
    probability = likelihoods(scores["evidence"], p_value, rest, p_left, bank.calibration)
    verdict, causes, partners = choose(probability, found, p_value < ALARM, bool(forced))
    before = residual_at(given, (), found.healthy.u)
    chosen = next((c for c in found.candidates if causes and c.name == judge.joined(causes)), None)
    every = cells(given, before)
    among = {*causes, *partners}
    alike = [c for c in found.candidates if len(c.effects) == len(causes) and among >= set(c.effects)]
    named = [c for c in found.candidates if not judge.nameless(c.name)]
    shown = [c for k, c in enumerate(named) if k < LISTED or c in alike]
    effects = {c.name: describe(given, c, found.healthy, bank.calibration, seed) for c in shown}
    following = None
    if verdict == "set":
        tell("the next experiment")
        following = _following(found, alike, effects, bank, seed, actual)
    warnings = found.warnings
    if verdict == "set":
        warnings = (*warnings, *_inseparable(causes, partners, following))
    if verdict == "unknown":
        warnings = (*warnings, *_why_unknown(best))
    if given.frame.num_trials == 1:
        warnings = (*warnings, "one trial: held out by moves, which is weaker than by trials")
    body = {
        "verdict": verdict,
        "causes": causes,
        "indistinguishable": partners,
        "probabilities": listed(probability),
        "detection": {"p_value": p_value, "statistic": found.statistics["cell"], "bank": bank.source},
        "where": where(given, every, CELL, chosen) if p_value < ALARM else [],
        "effects": effects,
        "shrinkage": None if chosen is None else shrinkage(given, found.healthy, chosen, before, bank, seed),
        "next_experiment": following,
    }
    residual = before if chosen is None else remainder(given, chosen)
    return Diagnosis(body, given, found.healthy, found.candidates, before, residual, tuple(every), CELL,
                     scores, warnings)  # fmt: skip


def _why_unknown(best: Candidate) -> list[str]:
    """What explains the gap better than any effect of the catalogue, if something does."""
    if best.name.endswith(judge.ALIKE):
        return [
            f"{'+'.join(best.effects)} would explain the gap, but both fingers would have to err alike, "
            "which independent parts do not: the cause is one that the catalogue does not have"
        ]
    if best.name in decoys():
        says = decoys()[best.name].says
        return [f"{best.name} explains the gap better than any effect of the catalogue: {says}"]
    return []


def _inseparable(
    causes: Sequence[str], partners: Sequence[str], following: dict[str, Any] | None
) -> list[str]:
    """What no experiment is expected to tell from the causes, if there is any."""
    left = sorted(set(partners) - set([] if following is None else following["separates"]))
    return (
        [f"no experiment of the list is expected to tell {', '.join(left)} from {' + '.join(causes)}"]
        if left
        else []
    )


def _following(
    found: Search,
    alike: Sequence[Candidate],
    effects: dict[str, Any],
    bank: Bank,
    seed: int,
    actual: dict | None,
) -> dict[str, Any] | None:
    """The experiment that would best tell the first of some candidates from the others."""
    cause, *partners = alike
    values: dict[str, dict[str, float]] = {name: {} for name in cause.effects}
    for key, p in effects[cause.name]["parameters"].items():
        *prefix, name = key.split(".")  # those of a pair are written effect.parameter
        values[prefix[0] if prefix else cause.name][name] = p["mean"]
    properties = property_values(found.problem, cause.fitted)
    return next_experiment(
        found.problem,
        values,
        [c.effects for c in partners],
        [cause.evidence - c.evidence for c in partners],
        properties,
        bank,
        seed,
        actual,
        found.temperature,
    )
