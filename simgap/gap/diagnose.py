"""The diagnosis: is there a gap, where, which effects cause it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

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
from simgap.gap.bank import Bank, load_bank
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.experiments import next_experiment
from simgap.gap.fit import Fitted, Problem, Start, fit, neutral, problem, residual_at, slots
from simgap.gap.frame import build
from simgap.gap.freeform import heldout_square
from simgap.gap.locate import Cell, cells, largest, normal_score
from simgap.gap.realign import moved, realigned
from simgap.gap.spread import SPREADS, Spread, spreads

PROPERTIES = ("weight", "width", "height")
UNITS = {"weight": "N", "width": "m", "height": "m"}
CELL = 4.5  # score of a cell that is listed once a gap is established: the largest of most healthy trials
ALARM = 0.01  # chance that a healthy recording is called otherwise
SHIFT = 0.008  # s; boundaries that move farther are taken anew
BEAM, PARTNERS = 2, 5  # singles that pairs start from, partners refined for each
REFINED = 6  # candidates fitted again after boundaries moved
WORTH = 0.6  # a pair must leave no more than this share of what its better half leaves
WILD, BUMPS = 5.0, 0.015  # sd; share of samples that may be wilder and be left out
TIE = 3.0  # nats (tempered): candidates this near the best cannot be told from it
DRAWS = 400
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
class Diagnosis:
    """Everything found; `body` is the JSON document's. Arrays are for figures and tests.

    `before`, `after` (T, N, C): whitened residuals without and with the verdict's effects;
    `statistics` the largest scores before.
    """

    body: dict[str, Any]
    problem: Problem
    healthy: Fitted
    candidates: tuple[Candidate, ...]
    before: np.ndarray
    after: np.ndarray
    cells: tuple[Cell, ...]
    threshold: float
    warnings: tuple[str, ...] = field(default=())


def diagnose(
    trials: Sequence[Trial],
    task: BlockTask,
    rig: Rig,
    actual: dict | None = None,
    forced: Sequence[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
    bank: Bank | None = None,
) -> Diagnosis:
    """Diagnose recordings of one block task against the nominal model.

    `actual` as `estimation.actual.read_actual` gives it; `forced` names effects to be taken instead of
    choosing. InputError where no trial fits its task.
    """
    tell = progress or (lambda text: None)
    bank = bank or load_bank()
    tell("aligning trials")
    aligned = align_trials([t.file for t in trials], [task_space(t, rig) for t in trials], task, rig)
    trials, aligned, warnings = _complete(trials, aligned)
    given = problem(build(trials, aligned, rig), bank.noise, actual)
    healthy = fit(given, [Start((), neutral(given))])[0]
    first = residual_at(given, (), healthy.u)
    statistics = largest(cells(given, first))

    names = [n for n, e in catalogue().items() if e.chosen and (rig.jointed or e.acts_on != "kinematics")]
    tell("fitting single effects")
    if forced:
        wanted = [tuple(sorted(set(forced) - set(SPREADS)))]
        wanted = [w for w in wanted if w]
    else:
        wanted = [(n,) for n in deterministic(names)]
    fits = best_fits(given, wanted, healthy)
    spread = spreads(given, healthy)

    # Late, slow or soft contacts displace boundaries: align again without the best explanation.
    leading = min(fits, key=lambda f: f.cost, default=None)
    if leading is not None and healthy.cost - leading.cost > 50:
        tell("aligning again without the best explanation")
        again = realigned(trials, given, leading)
        if SHIFT < moved(aligned, again) < np.inf:
            aligned = again
            given = problem(build(trials, aligned, rig), bank.noise, actual)
            healthy = fit(given, [Start((), healthy.u)])[0]
            fits = sorted(fits, key=lambda f: f.cost)[:REFINED] if not forced else fits
            fits = fit(given, [Start(f.effects, f.u) for f in fits])
            spread = spreads(given, healthy)
    wild = _bumps(given, fits, healthy)
    if wild is not None:
        warnings = [
            *warnings,
            f"{int(wild.sum())} samples that no candidate explains are left out of the fits",
        ]
        weight = np.where(wild, 0.0, given.whitening.weight)
        given = replace(given, whitening=given.whitening._replace(weight=weight))
        healthy = fit(given, [Start((), healthy.u)])[0]
        fits = fits if forced else sorted(fits, key=lambda f: f.cost)[:REFINED]
        fits = fit(given, [Start(f.effects, f.u) for f in fits])
        spread = spreads(given, healthy)
    temperature = _temperature(given, fits, spread, healthy, bank)
    found = [
        Candidate(judge.joined(f.effects), judge.log_evidence(given, f, healthy, temperature), f)
        for f in fits
    ]
    if not forced:
        found += [Candidate(s.effect, s.evidence / temperature, healthy, s) for s in spread]
    found.sort(key=lambda c: -c.evidence)
    tell("trying pairs")
    if not forced and found[0].evidence > 20 and _left(given, found[0], healthy, bank)[1] > 0.5:
        single = _left(given, found[0], healthy, bank)[0]
        pairs = _pairs(given, found, healthy, names, temperature)
        found += [c for c in pairs if _left(given, c, healthy, bank)[0] < WORTH * single]
        found.sort(key=lambda c: -c.evidence)
    return _conclude(given, healthy, found, statistics, bank, aligned, seed, warnings, bool(forced), tell)


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


def _size(given: Problem) -> int:
    return int((given.whitening.weight > 0).sum())


def _temperature(
    given: Problem, fits: Sequence[Fitted], spread: Sequence[Spread], healthy: Fitted, bank: Bank
) -> float:
    """How far the best candidate misses the healthy floor, in mean square; a floor learned on the bank."""
    z = residual_at(given, (), healthy.u)
    least = min(
        [healthy.square.sum(), *(f.square.sum() for f in fits), *(((z / s.scale) ** 2).sum() for s in spread)]
    )
    return max(bank.calibration.temperature, float(least) / (_size(given) * bank.calibration.floor))


def _after(given: Problem, candidate: Candidate) -> np.ndarray:
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
    return near if 0 < near.sum() <= BUMPS * _size(given) else None


def _left(given: Problem, candidate: Candidate, healthy: Fitted, bank: Bank) -> tuple[float, float]:
    """Share of the excess square that a candidate leaves, and how surely (0 to 1) that is no noise."""
    floor = bank.calibration.floor * _size(given)
    before = max(healthy.square.sum() - floor, 1.0)
    z = _after(given, candidate)
    after = float((z**2).sum()) - floor
    scores = largest(cells(given, z))
    p = min(bank.detection.p_values(scores).values())
    share = float(np.clip(after / before, 0.0, 1.0))
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


def _conclude(given, healthy, found, statistics, bank, aligned, seed, warnings, forced, tell) -> Diagnosis:
    """Verdict, probabilities, place, shrinkage and parameters from the fitted candidates."""
    tell("held-out trials")
    c = bank.calibration
    best = found[0]
    temperature = max(c.temperature, 2 * best.fitted.cost / _size(given))
    p = bank.detection.p_values(statistics | {"gain": best.evidence})
    p_value = min(1.0, 3 * min(p.values()))
    share, significant = _left(given, best, healthy, bank)
    probability = judge.probabilities({k.name: k.evidence for k in found}, share, significant, c)
    gap = p_value < ALARM
    if gap:  # there is one: what names no cause is unknown
        probability["unknown"] += probability["none"] - min(probability["none"], p_value)
        probability["none"] = min(probability["none"], p_value)
    else:  # what the thresholds call healthy is healthy: the rest shares what p_value leaves
        probability = _quiet(probability, p_value)
    verdict, causes, partners = _verdict(probability, found, gap, forced, temperature)
    before = residual_at(given, (), healthy.u)
    chosen = next((k for k in found if causes and k.name == judge.joined(causes)), None)
    after = before if chosen is None else _after(given, chosen)
    where, threshold = _where(given, cells(given, before), p_value < ALARM)
    effects = {k.name: _effect(given, k, healthy, seed) for k in found[:8]}
    shown = _shrinkage(given, healthy, chosen, before, bank, seed) if chosen is not None else None
    following = None
    if verdict == "set" and len(causes) == 1:
        tell("the next experiment")
        values = {
            n: _means(effects.get(n) or _effect(given, k, healthy, seed))
            for k in found
            for n in [k.name]
            if n in (*causes, *partners)
        }
        following = next_experiment(given, causes[0], values, property_values(given, best.fitted), bank, seed)
    if given.frame.num_trials == 1:
        warnings = [*warnings, "one trial: held out by moves, which is weaker than by trials"]
    body = {
        "verdict": verdict,
        "causes": causes,
        "indistinguishable": partners,
        "probabilities": _listed(probability),
        "detection": {"p_value": p_value, "statistic": statistics["cell"]},
        "where": where,
        "effects": effects,
        "shrinkage": shown,
        "next_experiment": following,
    }
    return Diagnosis(
        body,
        given,
        healthy,
        tuple(found),
        before,
        after,
        tuple(cells(given, before)),
        threshold,
        tuple(warnings),
    )


def _quiet(probability: dict[str, float], p_value: float) -> dict[str, float]:
    """Probabilities where nothing was detected: none holds all but a little."""
    none = 1 - 0.1 * (1 - p_value) ** 4
    rest = sum(v for k, v in probability.items() if k != "none")
    scaled = {k: v * (1 - none) / max(rest, 1e-12) for k, v in probability.items() if k != "none"}
    return {"none": none if rest > 1e-12 else 1.0, **scaled}


def _verdict(
    probability: dict[str, float], found: list[Candidate], gap: bool, forced: bool, temperature: float
):
    """Verdict, causes and partners that cannot be told from them."""
    if forced:
        return "named", list(found[0].effects), []
    if not gap:
        return "none", [], []
    if probability["unknown"] > 0.5 or probability["none"] > 0.5:
        return "unknown", [], []
    best = found[0]
    alike = [k for k in found if len(k.effects) == len(best.effects) and k.name != best.name]
    near = [k.name for k in alike if best.evidence - k.evidence < TIE or _as_good(best, k, temperature)]
    partners = sorted({e for n in near for e in n.split("+")} - set(best.effects))
    return ("set" if partners else "named"), sorted(best.effects), partners


def _as_good(best: Candidate, other: Candidate, temperature: float) -> bool:
    """Whether another candidate of about as many parameters fits as well: a matter of priors alone."""
    if best.spread is not None or other.spread is not None:
        return False
    if any(catalogue()[name].local for name in other.effects):  # free amounts fit anything a little
        return False
    more = other.fitted.columns.size - best.fitted.columns.size
    return more <= 2 and (other.fitted.cost - best.fitted.cost) / temperature < TIE


def _listed(probability: dict[str, float]) -> dict[str, float]:
    """Those that matter, and `other` for the rest; they sum to 1."""
    out = {k: v for k, v in probability.items() if k in ("none", "unknown") or v > 1e-3}
    out["other"] = max(0.0, 1.0 - sum(out.values()))
    return out


def _where(given: Problem, found: list[Cell], gap: bool) -> tuple[list[dict], float]:
    """Significant cells, largest share of the excess first."""
    threshold = CELL
    chosen = [k for k in found if k.z > threshold] if gap else []
    total = sum(k.energy - k.count for k in chosen)
    steps, files = given.frame.steps, given.frame.files
    rows = [
        {
            "trial": files[k.trial],
            "channel": k.channel,
            "subtask": _name(steps[k.subtask]),
            "band": list(k.band),
            "share": (k.energy - k.count) / total,
            "z": k.z,
        }
        for k in sorted(chosen, key=lambda k: -(k.energy - k.count))
    ]
    return rows, threshold


def _name(step) -> str:
    return step.name if step.object is None else f"{step.name} {step.object}"


def _draws(given: Problem, candidate: Candidate, seed: int) -> np.ndarray:
    """Draws (DRAWS, columns) of the fitted coordinates, tempered as the fit is imperfect."""
    f = candidate.fitted
    temperature = max(1.0, 2 * f.cost / _size(given))
    covariance = np.linalg.inv(f.hessian.sum((0, 1)) / temperature + np.eye(f.columns.size))
    rng = np.random.default_rng(seed)
    return f.u[f.columns] + rng.multivariate_normal(
        np.zeros(f.columns.size), covariance, DRAWS, method="cholesky"
    )


def _effect(given: Problem, candidate: Candidate, healthy: Fitted, seed: int) -> dict[str, Any]:
    """Parameters, evidence, held-out score and property shifts of one candidate."""
    f = candidate.fitted
    draws = _draws(given, candidate, seed)
    column = {int(c): k for k, c in enumerate(f.columns)}
    parameters: dict[str, Any] = {}
    for slot in slots(given.num_properties)[0]:
        if slot.effect.name not in f.effects:
            continue
        own = {
            p.name: np.asarray(p.value(draws[:, column[slot.start + j]]))
            for j, p in enumerate(slot.effect.parameters)
        }
        named = {p.name: (own[p.name], p.unit) for p in slot.effect.parameters if not p.hidden}
        if slot.effect.report is not None:
            named = slot.effect.report(own, given.frame.rig)
        prefix = "" if len(candidate.effects) == 1 else f"{slot.effect.name}."
        for name, (values, unit) in named.items():
            parameters[prefix + name] = _parameter(values, unit)
    if candidate.spread is not None:
        s = candidate.spread
        p = catalogue()[s.effect].parameters[0]
        rng = np.random.default_rng(seed)
        prefix = "" if len(candidate.effects) == 1 else f"{s.effect}."
        parameters[prefix + p.name] = _parameter(
            s.value * np.exp(s.log_sd * rng.standard_normal(DRAWS)), p.unit
        )
    labels = judge.folds(f, given.frame.num_trials, _moves(given))
    n = given.frame.num_trials
    score = 0.5 * (judge.heldout(healthy, labels, n) - judge.heldout(f, labels, n)).sum()
    return {
        "parameters": parameters,
        "log_evidence": candidate.evidence,
        "heldout_score": float(score),
        "property_shift": _shifts(given, healthy, f),
    }


def _means(effect: dict[str, Any]) -> dict[str, float]:
    return {name: p["mean"] for name, p in effect["parameters"].items()}


def _parameter(values: np.ndarray, unit: str) -> dict[str, Any]:
    low, high = np.percentile(values, (5, 95))
    return {
        "mean": float(np.mean(values)),
        "sd": float(np.std(values)),
        "interval_90": [float(low), float(high)],
        "unit": unit,
    }


def property_values(given: Problem, found: Fitted) -> np.ndarray:
    """Fitted properties (objects, 3): weight [N], width, height [m]."""
    return given.centre + given.spread * found.u[: given.num_properties].reshape(-1, 3)


def _shifts(given: Problem, healthy: Fitted, f: Fitted) -> dict[str, dict]:
    before, after = property_values(given, healthy), property_values(given, f)
    told = np.abs(f.hessian.sum((0, 1)).diagonal()[: given.num_properties]).reshape(-1, 3) > 1.0
    return {
        f"{name}.{prop}": {"before": float(before[o, k]), "after": float(after[o, k]), "unit": UNITS[prop]}
        for o, name in enumerate(given.frame.task.objects)
        for k, prop in enumerate(PROPERTIES)
        if told[o, k]
    }


def _moves(given: Problem) -> np.ndarray:
    """The move (S,) that each subtask is held out with."""
    own = [s.move for s in given.frame.steps]
    return np.array([m if m is not None else 0 for m in own])


def _shrinkage(
    given: Problem, healthy: Fitted, chosen: Candidate, before_z: np.ndarray, bank: Bank, seed: int
) -> dict:
    """Mean squared whitened residual on held-out blocks before and after, and the free-form ceiling."""
    n, f = given.frame.num_trials, chosen.fitted
    labels = judge.folds(f, n, _moves(given))
    there = (given.whitening.weight > 0)[:n]
    member = given.whitening.member[:n]
    count = np.einsum("tns,tnc->ts", member, there.astype(float))
    before, after = judge.heldout(healthy, labels, n), judge.heldout(f, labels, n)
    if chosen.spread is not None:  # a spread explains the scatter it predicts, no more
        z2 = (residual_at(given, f.effects, f.u)[:n] ** 2, (_after(given, chosen)[:n]) ** 2)
        after = after - np.einsum("tns,tnc->ts", member, z2[0] - z2[1])
    free = heldout_square(given, before_z, labels)
    # What ends below the floor has nothing left of the gap: healthy rigs differ by a few per cent.
    floor = min(bank.calibration.floor, float(after.sum() / count.sum()))

    def fraction(left: np.ndarray, rows: np.ndarray) -> float:
        base = before.ravel()[rows].sum() - floor * count.ravel()[rows].sum()
        rest = left.ravel()[rows].sum() - floor * count.ravel()[rows].sum()
        return float(1 - rest / base) if base > 0 else float("nan")

    rng, every = np.random.default_rng(seed), np.arange(before.size)
    resampled = [fraction(after, rng.integers(0, before.size, before.size)) for _ in range(300)]
    low, high = np.nanpercentile(resampled, (5, 95))
    total = count.sum()
    by_channel = _by_subtask(given, before, after, count, floor)
    return {
        "evaluated_on": "held-out trials" if n > 1 else "held-out moves of one trial",
        "before": float(before.sum() / total),
        "after": float(after.sum() / total),
        "noise_floor": floor,
        "fraction": fraction(after, every),
        "interval_90": [float(low), float(high)],
        "flexible_ceiling": fraction(free, every),
        "by_subtask": by_channel,
    }


def _by_subtask(
    given: Problem, before: np.ndarray, after: np.ndarray, count: np.ndarray, floor: float
) -> dict:
    """Fractions by subtask where there is a gap to shrink."""
    out = {}
    for s, step in enumerate(given.frame.steps):
        b, a, n = before[:, s].sum(), after[:, s].sum(), count[:, s].sum()
        if normal_score(b, n) > 3:
            out[f"{s + 1} {_name(step)}"] = float(1 - (a - floor * n) / max(b - floor * n, 1e-9))
    return out
