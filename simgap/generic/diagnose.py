"""Real against given simulated trials: a source of the same gap that blocks have, judged as theirs is.

A row of the gap is a feature of a real trial less the mean of the simulated ones. Features of one channel are
correlated: a trial that starts off stays off. So their covariance between trials has a part along the few
ways in which whole trials differ (offset, slope, size, time) and an autocorrelated rest: a mixed model (Laird
& Ware, Biometrics 38, 1982) by moments. Rows are whitened by its symmetric root, which leaves every row
closest to its own feature (Kessy, Lewin & Strimmer, Am. Stat. 72, 2018). All real trials share the error of
the simulated mean, S trials of covariance B: for R real ones of covariance A, rows are whitened by
A + B R / S, so that their mean is known as well as it is; their mean square, less than one, is in `told`.

Whether there is a gap is judged by exchanging the labels real and simulated (Besag & Clifford, Biometrika 78,
1991): exchanged trials are healthy twins.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.model import SequenceModel
from simgap.attribution.attribute import Attribution, attribute
from simgap.attribution.posterior import forms
from simgap.attribution.problem import Candidate, Gap, Rows
from simgap.attribution.search import detected, sought, statistic
from simgap.attribution.verdict import ALARM, entries, log_odds, rows
from simgap.bounded import least
from simgap.generic.effects import (
    EFFECTS,
    Parameter,
    Ring,
    Scene,
    find_ring,
    parameters,
    predicted,
    scene,
)
from simgap.generic.trials import (
    FAST,
    SLOW,
    Ensembles,
    Layout,
    align,
    align_block_trials,
    bin_edges,
    both,
    layout,
)
from simgap.progress import Progress, silent

MODERATION = 4.0  # prior: degrees of freedom that a cell's mean variance is worth
PACE = 0.02  # chosen: of a duration: clocks repeat themselves exactly, and nobody minds less
NOTHING = 1e-6  # numerics: of a channel's scale: no sd is smaller
EXCHANGES = 20  # numerics: of labels, at most
NIL = float(-np.log(ALARM))  # nats; a smaller statistic raises no alarm
STEP = 1e-3  # numerics: of a usual size, for derivatives by differences
STEPS = 12  # numerics: of a fit, at most
CLOSE = 0.02  # numerics: nats
AT_END = 0.02  # numerics: share of a range within which a descent that stays inside has run to its end
NEUTRAL = 1e-9  # numerics: a coordinate that has not moved
APART = 1e4  # numerics: s; powers have no order in time
DURATIONS = "duration"
POWER = ", power"


@dataclass(frozen=True)
class GenericDiagnosis:
    """Everything found; `body` is the JSON document's. `real` (R, F), `sim` (S, F): features; `variance`
    (F,) of their difference between two trials; `shift` (F,): what the best explanation adds to simulated
    features, `leading` its effects."""

    body: dict[str, Any]
    scene: Scene
    attribution: Attribution
    real: np.ndarray
    sim: np.ndarray
    variance: np.ndarray
    shift: np.ndarray
    leading: tuple[str, ...]
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
    return diagnosed(align_block_trials(real, sim, task, rig), forced, seed, tell)


def _check(forced: Sequence[str]) -> None:
    for name in forced:
        if name not in EFFECTS:
            raise InputError(f"effect {name!r}", "needs the virtual model or is unknown",
                             nearest(name, list(EFFECTS)))  # fmt: skip


def diagnosed(
    ensembles: Ensembles, forced: Sequence[str] = (), seed: int = 0, tell: Progress = silent
) -> GenericDiagnosis:
    """Diagnose ensembles that are cut already."""
    lay = layout(ensembles)
    real, sim = both(lay)
    given = scene(lay)
    given = replace(given, ring=find_ring(given))
    tell("fitting effects")
    white, gap = searched(given, real, sim)
    models = None
    if not forced:
        models = sought(forms(gap))
        leading = tuple(gap.candidates[j].name for j in models[0].effects)
        if len(leading) > 1:
            joint = fit(given, white, real.mean(0) - sim.mean(0), leading)
            more = _joint(given, white, joint, len(real))
            gap, models = replace(gap, candidates=(*gap.candidates, *more)), None
    tell("attributing the gap")

    def twins(value: float) -> Iterable[float]:
        return _exchanged(given, real, sim, seed) if value > NIL else ()

    verdict = attribute(gap, twins, tuple(dict.fromkeys(forced)), seed, models=models)
    return _document(given, gap, white, verdict, real, sim)


def searched(given: Scene, real: np.ndarray, sim: np.ndarray) -> tuple[tuple[Block, ...], Gap]:
    """The gap with every effect fitted by itself, and what whitens it."""
    white = whitening(given, real, sim)
    names = [n for n in EFFECTS if EFFECTS[n].each != "event" or given.ring is not None]
    found = [fit(given, white, real.mean(0) - sim.mean(0), (n,)) for n in names]
    return white, gap_of(
        given.layout, white, real, sim, [c for f in found for c in _candidates(white, f, len(real))]
    )


def detect(ensembles: Ensembles, seed: int = 0) -> float:
    """The p-value of any gap between ensembles that are cut already, and nothing else."""
    lay = layout(ensembles)
    given, (real, sim) = scene(lay), both(lay)
    given = replace(given, ring=find_ring(given))
    value = statistic(forms(searched(given, real, sim)[1]))
    return detected(value, _exchanged(given, real, sim, seed) if value > NIL else ()).p_value


def _exchanged(given: Scene, real: np.ndarray, sim: np.ndarray, seed: int) -> Iterator[float]:
    """The statistic where other trials are called real; the courses that effects act on stay as they are."""
    every, count = np.concatenate([real, sim]), len(real)
    rng, total = np.random.default_rng(seed), comb(len(every), count)
    if total <= 10 * EXCHANGES:
        chosen = [np.array(c) for c in combinations(range(len(every)), count)][1:]
        chosen = [chosen[k] for k in rng.permutation(len(chosen))]
    else:
        chosen = [rng.permutation(len(every))[:count] for _ in range(EXCHANGES)]
    for mine in chosen[:EXCHANGES]:
        there = np.isin(np.arange(len(every)), mine)
        f = forms(searched(given, every[there], every[~there])[1])
        yield statistic(f, sought(f, 1))


@dataclass(frozen=True)
class Block:
    """Features of one channel (-1: durations): their indices (n,), `root` (n, n) that whitens rows of the
    gap, covariance (n, n) of the mean difference, and mean square (n,) of a whitened row."""

    channel: int
    index: np.ndarray
    root: np.ndarray
    covariance: np.ndarray
    told: np.ndarray


def whitening(given: Scene, real: np.ndarray, sim: np.ndarray) -> tuple[Block, ...]:
    """A block for every channel and one for durations."""
    lay, kinds = given.layout, [v for v in (real, sim) if len(v) > 1]
    out = []
    for c in (*range(len(lay.ensembles.channels)), -1):
        index = lay.of_channel(c)
        basis = _common(given, c) if c >= 0 else np.zeros((index.size, 0))
        each = [_covariance(lay, v[:, index], basis, index) for v in kinds]
        a, b = each[0], each[-1]  # a single trial borrows the other kind's
        mean = a / len(real) + b / len(sim)
        values, vectors = np.linalg.eigh(mean * len(real))
        root = (vectors / np.sqrt(np.maximum(values, 1e-9 * values.max()))) @ vectors.T
        told = np.einsum("ij,jk,ik->i", root, a + b / len(sim), root)
        out.append(Block(c, index, root, mean, told))
    return tuple(out)


def variances(lay: Layout, deviations: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Variances between trials (n,) by deviations (T, n), drawn towards the mean of their cell."""
    dof = len(deviations) - 1
    raw = (deviations**2).sum(0) / dof
    cell = np.unique(lay.subtask[index] * 3 + lay.kind[index], return_inverse=True)[1]
    pooled = (np.bincount(cell, raw) / np.bincount(cell))[cell]
    scale = np.where(lay.channel[index] >= 0, lay.scale[lay.channel[index]], 1.0)
    # The log of a mean of m squares of noise has a variance of 2 / m, of which half is the least.
    floor = np.where(lay.kind[index] == SLOW, (NOTHING * scale) ** 2,
                     np.where(lay.kind[index] == FAST, 1 / lay.width[index], PACE**2))  # fmt: skip
    return np.maximum((dof * raw + MODERATION * pooled) / (dof + MODERATION), floor)


def _common(given: Scene, channel: int) -> np.ndarray:
    """Orthonormal ways (n, q) in which whole trials differ: offset, slope, size and time of the course,
    an offset of each subtask, loudness."""
    lay, none = given.layout, np.zeros((len(given.layout.window), 2))
    index = lay.of_channel(channel)
    slowly = (lay.kind[index] == SLOW).astype(float)
    base = predicted(given, channel, {}, none)
    columns = [slowly * (predicted(given, channel, {k: v}, none) - base)
               for k, v in (("slope", 1.0), ("gain", 0.1), ("delay", 0.02))]  # fmt: skip
    columns += [slowly * (lay.subtask[index] == k) for k in range(len(none))] + [1 - slowly]
    ways = np.stack([c / max(np.linalg.norm(c), 1e-12) for c in columns], 1)
    left, size, _ = np.linalg.svd(ways, full_matrices=False)
    return left[:, size > 1e-6]


def _covariance(lay: Layout, values: np.ndarray, basis: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Covariance (n, n) between trials: along the common ways as seen, elsewhere autocorrelated.

    The covariance along the common ways is drawn to its diagonal by as many degrees of freedom as it has
    rows. What remains has the features' variances and an AR(1) correlation of neighbours in the slow course.
    """
    kind, deviations = lay.kind[index], values - values.mean(0)
    dof, q = len(values) - 1, basis.shape[1]
    if not q:
        return np.diag(variances(lay, deviations, index))
    along = deviations @ basis
    seen = along.T @ along / dof
    seen = (dof * seen + (q + 1) * np.diag(np.diag(seen))) / (dof + q + 1)
    rest = deviations - along @ basis.T
    own = variances(lay, rest, index)
    z = rest / np.sqrt(own)
    slow = kind == SLOW
    near = slow[1:] & slow[:-1]
    rho = float((z[:, 1:] * z[:, :-1])[:, near].sum() / max((z[:, :-1] ** 2)[:, near].sum(), 1e-12))
    apart = np.abs(np.subtract.outer(np.arange(kind.size), np.arange(kind.size)))
    alike = np.where(np.logical_and.outer(slow, slow), np.clip(rho, 0.0, 0.95) ** apart, np.eye(kind.size))
    return basis @ seen @ basis.T + alike * np.sqrt(np.outer(own, own))


def gap_of(
    lay: Layout, white: Sequence[Block], real: np.ndarray, sim: np.ndarray, candidates: Sequence[Candidate]
) -> Gap:
    """The gap of all real trials; it has no nuisances, as the covariance holds them."""
    count, c = len(real), len(lay.ensembles.channels)
    channel = np.where(lay.channel < 0, 2 * c, lay.channel + c * (lay.kind == FAST))
    time = np.where(lay.kind == FAST, APART, 0.0) * np.arange(lay.kind.size)
    edges = np.mean([cut.edges for cut in lay.ensembles.real], 0)
    for k in range(len(lay.window)):
        ends = bin_edges(lay, edges[k], edges[k + 1], k)
        for own in range(c):
            time[lay.where(SLOW, own, k)] = (ends[1:] + ends[:-1]) / 2
    names = lay.ensembles.channels
    parts = Rows(
        np.repeat(np.arange(count), lay.kind.size), np.tile(channel, count), np.tile(lay.subtask, count),
        np.tile(time, count), tuple(cut.trial.file for cut in lay.ensembles.real[:count]),
        (*names, *(n + POWER for n in names), DURATIONS), lay.ensembles.subtasks,
    )  # fmt: skip
    told = np.zeros(lay.kind.size)
    for block in white:
        told[block.index] = block.told
    residual = np.concatenate([_whitened(white, row) for row in real - sim.mean(0)])
    return Gap(parts, residual, np.zeros((residual.size, 0)), tuple(candidates),
               told=np.tile(told, count), parts_alike=True)  # fmt: skip


def _whitened(white: Sequence[Block], values: np.ndarray) -> np.ndarray:
    """Rows of one trial from features (F, ...)."""
    out = np.zeros_like(values, float)
    for block in white:
        out[block.index] = block.root @ values[block.index]
    return out


@dataclass(frozen=True)
class Fit:
    """Effects fitted to the mean difference: their parameters, coordinates `u` (k,) in usual sizes, `shift`
    (F,) of features, its derivatives (F, k) by usual sizes."""

    parameters: tuple[Parameter, ...]
    u: np.ndarray
    shift: np.ndarray
    slopes: np.ndarray


def shift_at(given: Scene, block: Block, mine: Sequence[Parameter], u: np.ndarray) -> np.ndarray:
    """Features (n,) of a block with effects at coordinates u, less those without."""
    if block.channel < 0:
        out = np.zeros(block.index.size)
        for p, value in zip(mine, u, strict=True):
            out[p.place] += p.usual * value
        return out
    values, rung = dict[str, float](), np.zeros((len(given.layout.window), 2))
    for p, value in zip(mine, u, strict=True):
        if EFFECTS[p.effect].each == "event":
            rung[p.place, int(p.key == "cos")] = p.usual * value
        else:
            values[p.key] = p.usual * float(value)
    return predicted(given, block.channel, values, rung) - given.plain[block.channel]


def fit(given: Scene, white: Sequence[Block], difference: np.ndarray, effects: Sequence[str]) -> Fit:
    """Effects together fitted to the mean difference (F,), channel by channel, from every start."""
    found, shift, slopes = [], np.zeros(difference.size), []
    for block in white:
        mine = [p for name in effects for p in parameters(given, name, block.channel)]
        there, starts = np.linalg.inv(block.covariance), range(max(len(EFFECTS[n].starts) for n in effects))
        while mine:
            target = difference[block.index]
            descents = [_descended(given, block, there, target, mine, _start(mine, j)) for j in starts]
            _, u, moved, push = min(descents, key=lambda d: d[0])
            inside = [not _ended(p, v) for p, v in zip(mine, u, strict=True)]
            if all(inside):
                break
            mine = [p for p, kept in zip(mine, inside, strict=True) if kept]
        if not mine:
            continue
        shift[block.index] = moved
        wide = np.zeros((difference.size, len(mine)))
        wide[block.index] = push
        slopes.append(wide)
        found.append((mine, u))
    every = tuple(p for mine, _ in found for p in mine)
    u = np.concatenate([np.zeros(0), *(u for _, u in found)])
    return Fit(every, u, shift, np.concatenate([np.zeros((difference.size, 0)), *slopes], 1))


def _ended(p: Parameter, value: float) -> bool:
    """Whether a coordinate ran to the end of its range: a filter of half a second stands for a course that
    differs in another way, and is none of this channel's."""
    change = EFFECTS[p.effect]
    end = change.low if value < 0 else change.high
    return bool(abs(value) > NEUTRAL and abs(value - end) < AT_END * abs(end))


def _start(mine: Sequence[Parameter], which: int) -> np.ndarray:
    starts = [EFFECTS[p.effect].starts for p in mine]
    return np.array([
        s[which % len(s)][EFFECTS[p.effect].keys.index(p.key)] for p, s in zip(mine, starts, strict=True)
    ])  # fmt: skip


def _descended(given, block, there, target, mine, u):
    """Levenberg-Marquardt within bounds, priors normal: cost, coordinates, shift and derivatives."""
    low, high = (np.array([getattr(EFFECTS[p.effect], end) for p in mine]) for end in ("low", "high"))
    u, damping, now = np.clip(u, low, high), 1e-3, None
    for _ in range(STEPS):
        if now is None:
            moved = shift_at(given, block, mine, u)
            left = target - moved
            now = 0.5 * float(left @ there @ left + u @ u)
            push = np.stack([(shift_at(given, block, mine, u + step) - moved) / STEP
                             for step in STEP * np.eye(u.size)], 1)  # fmt: skip
        bend = push.T @ there @ push + np.eye(u.size)
        pull = push.T @ there @ left - u
        step, _ = least(bend + damping * np.diag(np.diag(bend)), pull, low - u, high - u)
        other = np.clip(u + step, low, high)
        rest = target - shift_at(given, block, mine, other)
        cost = 0.5 * float(rest @ there @ rest + other @ other)
        if cost < now:
            gain, u, damping, now = now - cost, other, damping / 5, None
            if gain < CLOSE:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    moved = shift_at(given, block, mine, u)
    push = np.stack([(shift_at(given, block, mine, u + step) - moved) / STEP
                     for step in STEP * np.eye(u.size)], 1)  # fmt: skip
    left = target - moved
    return 0.5 * float(left @ there @ left + u @ u), u, moved, push


def _candidates(white: Sequence[Block], found: Fit, count: int) -> list[Candidate]:
    """One effect in all channels (or subtasks, of durations), and in that alone in which it explains most."""
    if not found.parameters:
        return []
    every = np.ones(found.u.size, bool)
    parts = [np.array([(p.channel, p.place * (p.channel < 0)) == one for p in found.parameters])
             for one in {(p.channel, p.place * (p.channel < 0)) for p in found.parameters}]  # fmt: skip
    own = [_own(white, found, part) for part in parts]
    gains = [sum(float(s[b.index] @ np.linalg.solve(b.covariance, s[b.index])) for b in white) for s in own]
    best = int(np.argmax(gains))
    forms = [(every, found.shift)] + [(parts[best], own[best])] * (len(parts) > 1)
    return [
        _candidate(white, [p for p, there in zip(found.parameters, part, strict=True) if there],
                   found.u[part], shift, found.slopes[:, part], count)
        for part, shift in forms
    ]  # fmt: skip


def _own(white: Sequence[Block], found: Fit, part: np.ndarray) -> np.ndarray:
    """The shift (F,) by some of an effect's parameters (k,): those of a channel, or of a duration."""
    where = found.slopes[:, part].any(1)
    if found.parameters[int(np.argmax(part))].channel >= 0:
        (c,) = {p.channel for p, there in zip(found.parameters, part, strict=True) if there}
        where = np.isin(np.arange(where.size), next(b.index for b in white if b.channel == c))
    return np.where(where, found.shift, 0.0)


def _joint(given: Scene, white: Sequence[Block], found: Fit, count: int) -> list[Candidate]:
    """The effects of a joint fit as candidates where they are together; what they do only together is parted
    evenly."""
    names = list(dict.fromkeys(p.effect for p in found.parameters))
    alone = {}
    for name in names:
        rest = np.array(
            [0.0 if p.effect == name else v for p, v in zip(found.parameters, found.u, strict=True)]
        )
        alone[name] = found.shift.copy()
        for block in white:
            at = [k for k, p in enumerate(found.parameters) if p.channel == block.channel]
            if at:
                mine = [found.parameters[k] for k in at]
                alone[name][block.index] -= shift_at(given, block, mine, rest[at])
    left = (found.shift - sum(alone.values())) / len(names)
    out = []
    for name in names:
        own = np.array([p.effect == name for p in found.parameters])
        mine = [p for p in found.parameters if p.effect == name]
        out.append(_candidate(white, mine, found.u[own], alone[name] + left, found.slopes[:, own], count))
    return out


def _candidate(
    white: Sequence[Block], mine: Sequence[Parameter], u: np.ndarray, shift: np.ndarray, slopes: np.ndarray,
    count: int,
) -> Candidate:  # fmt: skip
    change = EFFECTS[mine[0].effect]
    low, high = (np.full(u.size, end) for end in (change.low, change.high))
    labels = tuple(f"{p.channel}/{p.place}/{p.key}" for p in mine)
    return Candidate(change.name, labels, u, np.zeros(u.size), np.ones(u.size),
                     np.tile(_whitened(white, shift), count), np.tile(_whitened(white, slopes), (count, 1)),
                     low, high)  # fmt: skip


def _document(
    given: Scene, gap: Gap, white: Sequence[Block], verdict: Attribution, real: np.ndarray, sim: np.ndarray
) -> GenericDiagnosis:
    """The JSON document, and what figures need."""
    lay, far, rest = given.layout, verdict.how_far, verdict.remainder
    best = next((m for m in verdict.models if m.effects), verdict.models[0])
    leading = verdict.causes or tuple(gap.candidates[j].name for j in best.effects)
    effects = {n: _described(given, verdict, [n]) for n in verdict.effects}
    if len(verdict.causes) > 1:
        effects["+".join(verdict.causes)] = _described(given, verdict, verdict.causes)
    attribution = {n: (e.probability, e.share, e.share_90) for n, e in verdict.effects.items()}
    body = entries(verdict, verdict.detection, (rest.share, rest.p_value, _cells(lay, rest.where)),
                   attribution, _cells(lay, verdict.where))  # fmt: skip
    shrinkage = None if far is None else far.to_json()
    body |= {"effects": effects, "shrinkage": shrinkage, "next_experiment": None}
    warnings = [*lay.ensembles.warnings]
    if len(real) == 1:
        warnings.append("one real trial: nothing is held out, and an accident of it looks like an effect")
    shift, variance = np.zeros(lay.kind.size), np.zeros(lay.kind.size)
    for n in leading:
        e = verdict.effects[n]
        c = gap.candidates[e.candidate]
        x = np.array([p.mean for p in e.parameters.values()])
        moved = (c.shift + c.jacobian @ (x - c.at))[: lay.kind.size]
        for block in white:
            shift[block.index] += np.linalg.solve(block.root, moved[block.index])
    for block in white:
        variance[block.index] = np.diag(block.covariance) * len(real)
    return GenericDiagnosis(body, given, verdict, real, sim, variance, shift, leading, tuple(warnings))


def _cells(lay: Layout, found: Sequence[Any]) -> list[dict[str, Any]]:
    """Rows of the document; a power's band is that of its window."""
    out = rows(found)
    for row in out:
        if row["channel"].endswith(POWER):
            k = lay.ensembles.subtasks.index(row["subtask"])
            first, n = lay.coefficients[k][0].start, lay.window[k]
            row["channel"] = row["channel"].removesuffix(POWER)
            row["band"] = [float(first * lay.rate / (2 * n)), lay.rate / 2]
    return out


def _described(given: Scene, verdict: Attribution, names: Sequence[str]) -> dict[str, Any]:
    """Parameters and evidence of some effects."""
    out = dict[str, Any]()
    for name in names:
        prefix = f"{name}." if len(names) > 1 else ""
        out |= {prefix + k: v for k, v in _parameters(given, name, verdict.effects[name].parameters).items()}
    odds = log_odds(verdict.effects[n].probability for n in names)
    return {"parameters": out, "log_evidence": odds, "property_shift": {},
            "heldout_score": None if len(names) < 2 or verdict.how_far is None else verdict.how_far.score,
            }  # fmt: skip


def _parameters(given: Scene, name: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """An effect's parameters in units, by channel or subtask; of a vibration frequency, damping and size."""
    change, lay, out = EFFECTS[name], given.layout, dict[str, Any]()
    rung = dict[tuple[int, str], list[tuple[float, float]]]()
    of = {f"{p.channel}/{p.place}/{p.key}": p
          for c in (*range(len(lay.ensembles.channels)), -1) for p in parameters(given, name, c)}  # fmt: skip
    for label, value in found.items():
        p = of[label]
        mean, sd = p.usual * value.mean, p.usual * value.sd
        low, high = (p.usual * v for v in value.interval_90)
        if change.each == "event":
            rung.setdefault((p.channel, str(p.place)), []).append((mean, sd))
        elif change.each == "subtask":
            ratio = float(np.exp(mean))
            out[lay.ensembles.subtasks[p.place]] = _entry(ratio, ratio * sd, np.exp([low, high]), "1")
        else:
            channel = lay.ensembles.channels[p.channel]
            unit = change.unit if change.unit in ("1", "s") else f"unit of {channel}"
            out[channel] = _entry(mean, sd, (low, high), unit + (" per s" if change.unit == "/s" else ""))
    if rung:
        assert given.ring is not None
        size, sd, c = max((float(np.hypot(*np.array(v)[:, 0])), float(np.hypot(*np.array(v)[:, 1])), c)
                          for (c, _), v in rung.items())  # fmt: skip
        ring: Ring = given.ring
        out |= {
            "frequency": _entry(ring.frequency, ring.frequency_sd, ring.frequency_90, "Hz"),
            "damping": _entry(ring.damping, ring.damping_sd, ring.damping_90, "1"),
            "gain": _entry(size, sd, (max(size - 1.645 * sd, 0.0), size + 1.645 * sd),
                           f"unit of {lay.ensembles.channels[c]}"),
        }  # fmt: skip
    return out


def _entry(mean: float, sd: float, interval: Any, unit: str) -> dict[str, Any]:
    return {"mean": mean, "sd": sd, "interval_90": [float(v) for v in interval], "unit": unit}
