"""The generic diagnosis: is there a gap, where, which effects cause it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.model import SequenceModel
from simgap.attribution.search import MOST, Detection
from simgap.attribution.verdict import ALARM, Explanation, Shares, acting, conclude, entries, known
from simgap.generic.aligned import Ensembles, align
from simgap.generic.block_trials import block_ensembles
from simgap.generic.effects import EFFECTS, Scene, scene
from simgap.generic.features import layout, resampled, rows, windowed
from simgap.generic.fit import Block, EnsembleFit, blocks, fit
from simgap.generic.judged import judge
from simgap.generic.locate import Located, locate
from simgap.generic.report import effect_entry, listed_cells
from simgap.generic.ringing import Ring, fit_ring, from_swing, screen
from simgap.generic.shrinkage import fraction, heldout, shrinkage, sizes
from simgap.progress import Progress, silent

GAIN = 5.0  # chosen: nats that a further effect must add
WORTH = 0.98  # chosen: it must leave no more than this share of the excess square
TEMPERATURE = 1.5  # chosen: least; covariances come from a few trials
PRIOR = -4.0  # prior: log prior of a candidate against none
RINGS = 0.2  # chosen: share of the square after an event that an oscillation must explain
LISTED = 8  # look: explanations that are described
SHORTEST = 16  # numerics: samples of a window in which an oscillation is looked for


@dataclass(frozen=True)
class GenericDiagnosis:
    """Everything found; `body` is the JSON document's. `real` (R, F), `sim` (S, F): features;
    `chosen`: the verdict's fit, if it names any effects; `leading`: the best explanation all the same."""

    body: dict[str, Any]
    scene: Scene
    located: Located
    real: np.ndarray
    sim: np.ndarray
    chosen: EnsembleFit | None
    leading: EnsembleFit
    ring: Ring | None
    warnings: tuple[str, ...]


def diagnose(
    real: Sequence[Trial],
    sim: Sequence[Trial],
    task: SequenceTask,
    model: SequenceModel | None = None,
    forced: Sequence[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
    boundaries: Mapping[str, np.ndarray] | None = None,
) -> GenericDiagnosis:
    """Diagnose real trials against simulated ones of the same plain ordered task.

    `boundaries` [s] by file (one fewer than subtasks, or as many with the end of what is compared) take the
    place of the HMM; `forced` names effects to be taken instead of choosing. InputError where a kind has no
    trial that shows the whole task.
    """
    tell = progress or silent
    _check(forced)
    tell("aligning trials")
    return diagnosed(align(real, sim, task, model, boundaries), forced, seed, tell)


def diagnose_blocks(
    real: Sequence[Trial],
    sim: Sequence[Trial],
    task: BlockTask,
    rig: Rig,
    forced: Sequence[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
) -> GenericDiagnosis:
    """The same of a block task, its channels the task-space ones."""
    tell = progress or silent
    _check(forced)
    tell("aligning trials")
    return diagnosed(block_ensembles(real, sim, task, rig), forced, seed, tell)


def _check(forced: Sequence[str]) -> None:
    for name in forced:
        if name not in EFFECTS:
            raise InputError(f"effect {name!r}", "needs the virtual model or is unknown",
                             nearest(name, list(EFFECTS)))  # fmt: skip


def detect(ensembles: Ensembles, seed: int = 0) -> tuple[Located, bool]:
    """Whether and where there is a gap, and nothing else."""
    lay = layout(ensembles)
    located = locate(lay, *rows(lay), seed)
    return located, located.p_value < ALARM


def diagnosed(ensembles: Ensembles, forced: Sequence[str], seed: int, tell: Progress) -> GenericDiagnosis:
    """Diagnose ensembles that are cut already."""
    lay = layout(ensembles)
    real, sim = rows(lay)
    numbers = len(real), len(sim)
    tell("locating the gap")
    located = locate(lay, real, sim, seed)
    ring = _ring(scene(lay))
    given = scene(lay) if ring is None else scene(lay, ring.frequency, ring.damping)
    parts = blocks(given, real, sim)
    difference = real.mean(0) - sim.mean(0)

    def fitted(effects: Sequence[str], base: EnsembleFit | None = None) -> EnsembleFit:
        return fit(given, parts, difference, numbers, effects, base)

    tell("fitting effects")
    names = [n for n in EFFECTS if EFFECTS[n].each != "event" or ring is not None]
    if forced:
        found = [fitted(tuple(dict.fromkeys(forced)))]
    else:
        found = [fitted((n,)) for n in names]
        found += _together(found, names, fitted, located.p_value < ALARM)
    temperature = _temperature(min(f.square for f in found), difference.size)
    found.sort(key=lambda f: -f.evidence(temperature))
    tell("held-out trials")
    return _conclude(given, parts, located, real, sim, found, ring, temperature, bool(forced), seed, fitted)


def _temperature(left: float, size: int) -> float:
    return max(TEMPERATURE, left / size)


def _together(singles: list[EnsembleFit], names: list[str], fitted, gap: bool) -> list[EnsembleFit]:
    """Effects added one by one to the best so far, as long as each is worth it."""
    out: list[EnsembleFit] = []
    size = singles[0].shift.size
    best = max(singles, key=lambda f: f.evidence(TEMPERATURE))
    while gap and len(best.effects) < MOST:
        further = [fitted((*best.effects, n), best) for n in names if n not in best.effects]
        if not further:
            break
        temperature = _temperature(min(f.square for f in (best, *further)), size)
        out += further
        new = max(further, key=lambda f: f.evidence(temperature))
        if new.evidence(temperature) < best.evidence(temperature) + GAIN:
            break
        if new.square - size > WORTH * (best.square - size):
            break
        best = new
    return out


def _ring(given: Scene) -> Ring | None:
    """The strongest oscillation after an event in the real trials, where they hold more power; after the last
    from as long as all of them go on, for what is compared may end sooner."""
    lay, best, windows = given.layout, 0.0, None
    for k in range(1, len(lay.ensembles.subtasks)):
        for c in range(len(lay.ensembles.channels)):
            recorded = np.array([windowed(lay, cut, c, k) for cut in lay.ensembles.real])
            simulated = np.array([windowed(lay, cut, c, k) for cut in lay.ensembles.sim])
            if recorded.shape[1] < SHORTEST or recorded.var(1).mean() < simulated.var(1).mean():
                continue
            rest = recorded - simulated.mean(0)  # what the simulation has is no ring
            here = from_swing(list(rest if rest.var(1).mean() < recorded.var(1).mean() else recorded))
            if k + 1 == len(lay.ensembles.subtasks) and (longer := _going_on(given, c)):
                here = from_swing(longer)
            _, _, share, square = screen(here, lay.rate)
            strength = square * here.shape[1] / lay.scale[c] ** 2
            if share > RINGS and strength > best:
                best, windows = strength, here
    found = None if windows is None else fit_ring(windows, lay.rate)
    return found if found is not None and found.resolved else None


def _going_on(given: Scene, channel: int) -> list[np.ndarray]:
    """Samples of a channel from the last event on, as long as every real trial lasts; none where what is
    compared ends as late."""
    lay, out = given.layout, []
    if any(cut.trial.t[-1] <= cut.edges[-1] for cut in lay.ensembles.real):
        return out
    name = lay.ensembles.channels[channel]
    length = min(float(cut.trial.t[-1] - cut.edges[-2]) for cut in lay.ensembles.real)
    since = (np.arange(int(length * lay.rate)) + 0.5) / lay.rate
    for cut in lay.ensembles.real:
        out.append(resampled(cut.trial.t, cut.trial.channels[name], cut.edges[-2] + since, lay.rate))
    return out


def _conclude(
    given: Scene, parts: list[Block], located: Located, real: np.ndarray, sim: np.ndarray,
    found: list[EnsembleFit], ring: Ring | None, temperature: float, forced: bool, seed: int,
    fitted: Callable[[Sequence[str]], EnsembleFit],
) -> GenericDiagnosis:  # fmt: skip
    """Verdict, probabilities, place, shrinkage and parameters from the fitted candidates."""
    lay, best = given.layout, found[0]
    counts = np.bincount(lay.cell)
    held = {f.effects: heldout(given, parts, real, sim, f) for f in found[:LISTED]}
    # Judged where there is a gap: elsewhere a small excess would drown in the floor's own scatter.
    apart = located.z > min(located.threshold, located.z.max() - 1e-9)
    before, after, _, floor = sizes(held[best.effects], counts * apart)
    left = 1 - fraction(before, after, floor)
    left = float(np.clip(left, 0, 1)) if np.isfinite(left) else 0.0
    rest = locate(lay, real - best.shift, sim, seed)
    kept, sure = best.effects, 1.0
    # What noise leaves as often as a healthy comparison shows a gap is not left by the effects.
    if rest.p_value < ALARM:
        numbers = len(real), len(sim)
        judged = judge(given, parts, best, numbers, held[best.effects], counts * apart, temperature)
        kept = tuple(n for n in best.effects if judged[n].cause)
        sure = known(max((judged[n].left for n in kept), default=1.0), 1.0)
    score = np.array([0.0, *(f.evidence(temperature) + PRIOR for f in found)])
    weights = np.exp(score - np.logaddexp.reduce(score)).tolist()
    sets = [Explanation((), weights[0])]
    for f, w in zip(found, weights[1:], strict=True):
        holds = bool(kept) and {*kept} <= {*f.effects}
        causes = kept if holds else tuple(n for n in f.effects if n not in best.effects or n in kept)
        sets.append(Explanation(f.effects, w, causes, sure if kept else 0.0))
    verdict = conclude(sets, located.p_value, forced=best.effects if forced else (), chosen=kept)
    chosen = best if verdict.causes else None
    gap, chance = located.p_value < ALARM, acting(sets, located.p_value)
    detection = Detection(float(located.z.max()), located.p_value, located.resolution)
    remains = left, rest.p_value, listed_cells(lay, rest, real - best.shift, sim) if gap else []
    warnings = [*lay.ensembles.warnings]
    if not located.exchanges:
        warnings.append("too few trials to exchange: p rests on the F distribution and Bonferroni's bound")
    if len(real) == 1:
        warnings.append("one trial: held out by subtasks, which is weaker than by trials")
    shrunk, trials = shrinkage(given, held[best.effects], seed), len(real) + len(sim)
    shares = _shares(best, fitted, seed) if gap else {}
    attribution = {n: (p, *shares.get(n, (0.0, (0.0, 0.0)))) for n, p in chance.items()}
    where = listed_cells(lay, located, real, sim) if gap else []
    body = entries(verdict, detection, remains, attribution, where) | {
        "effects": {
            "+".join(f.effects): effect_entry(given, f, ring, temperature, held[f.effects].score, trials)
            for f in found[:LISTED]
        },
        "shrinkage": None if chosen is None else shrunk,
        "best_explanation": {"effects": list(best.effects), "shrinkage": shrunk} if gap else None,
        "next_experiment": None,
    }  # fmt: skip
    return GenericDiagnosis(body, given, located, real, sim, chosen, best, ring, tuple(warnings))


def _shares(
    best: EnsembleFit, fitted: Callable[[Sequence[str]], EnsembleFit], seed: int
) -> dict[str, tuple[float, tuple[float, float]]]:
    """Each effect's share of the gap of all trials, and its 90 % interval."""
    without = [fitted([n for n in best.effects if n != out]).square for out in best.effects]
    lost = np.maximum(np.array(without) - best.square, 0.0)
    shares = Shares.of(best.before, best.square, best.shift.size, lost, np.random.default_rng(seed))
    return {n: shares.of_effect(k) for k, n in enumerate(best.effects)}
