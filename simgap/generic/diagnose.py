"""Diagnosis of real trials against given simulated trials, judged like the diagnosis of blocks.

A row of the gap is a feature of a real trial minus the mean of the simulated trials. Features of a channel
are correlated within a trial: one that starts with an offset keeps it. Their covariance between trials is
therefore a mixed model (Laird & Ware, Biometrics 38, 1982) fitted by moments: a part along the few ways in
which whole trials differ (offset, slope, size, time) plus an autocorrelated rest. Rows are whitened by the
symmetric root of its inverse, which keeps each row closest to its own feature (Kessy, Lewin & Strimmer, Am.
Stat. 72, 2018). All R real trials (covariance A) share the error of the mean of S simulated ones (covariance
B): whitening by A + B R / S gives the mean over rows its correct precision, and rows a mean square below one
(`Whitening.expected`).

The null distribution is found by exchanging the labels real and simulated (Besag & Clifford, Biometrika 78,
1991): relabelled trials are healthy twins.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from hmmseg.errors import InputError, nearest
from simgap.attribution.attribute import Attribution, ParameterPosterior, attribute
from simgap.attribution.posterior import forms
from simgap.attribution.problem import Candidate, Gap, Rows
from simgap.attribution.search import sought, statistic
from simgap.attribution.verdict import entries, log_odds, rows
from simgap.channels import delayed
from simgap.generic.effects import Scene, Slot, effects, predicted, scene, slots
from simgap.generic.ring import find_ring
from simgap.generic.trials import FAST, SLOW, Ensembles, Layout, bin_edges, both, layout, means
from simgap.progress import Progress, silent

MODERATION = 4.0  # prior: degrees of freedom given to the mean variance of a cell
LATE = 0.02  # numerics: s; a small delay
PACE = 0.02  # chosen: smallest relative sd of a duration: clocks repeat exactly, and less does not matter
SMALLEST = 1e-6  # numerics: smallest sd, as a share of a channel's scale
EXCHANGES = 20  # numerics: most exchanges of labels
STEP = 1e-3  # numerics: step of finite differences, in prior standard deviations
STEPS = 20  # numerics: most function evaluations of a fit
CLOSE = 1e-4  # numerics: relative tolerance of a fit's cost
APART = 1e4  # numerics: s; separates powers, which have no order in time
DURATIONS = "duration"
POWER = ", power"


@dataclass(frozen=True)
class GenericDiagnosis:
    """The JSON document `body` and what its figures need.

    `real` (R, F) and `sim` (S, F) are the features, `variance` (F,) that of their difference between two
    trials. `shift` (F,) is what the `leading` effects, the best explanation, add to simulated features.
    """

    body: dict[str, Any]
    scene: Scene
    real: np.ndarray
    sim: np.ndarray
    variance: np.ndarray
    shift: np.ndarray
    leading: tuple[str, ...]
    warnings: tuple[str, ...]


def check_forced(names: Sequence[str]) -> None:
    """InputError for an effect that given trials cannot show."""
    for name in names:
        if name not in effects():
            raise InputError(f"effect {name!r}", "needs the virtual model or is unknown",
                             nearest(name, list(effects())))  # fmt: skip


def diagnose(
    ensembles: Ensembles, forced: Sequence[str] = (), seed: int = 0, tell: Progress = silent
) -> GenericDiagnosis:
    """Diagnose real trials against simulated ones of the same task.

    Args:
        ensembles: Real and simulated trials, cut into subtasks (`simgap.generic.trials`).
        forced: Effects that are imposed instead of chosen.
        seed: Seed of the exchanged labels.
        tell: Called with a description of each stage.

    Returns:
        The document, and what its figures are drawn from.

    Raises:
        InputError: A forced effect is unknown, or needs the virtual model.
    """
    check_forced(forced)
    lay = layout(ensembles)
    real, sim = both(lay)
    given = scene(lay, find_ring(lay))
    tell("fitting effects")
    white, gap = fitted_gap(given, real, sim)
    searched = None
    if not forced:
        f = forms(gap)
        searched = f, sought(f)
        leading = tuple(gap.candidates[j].name for j in searched[1][0].effects)
        if len(leading) > 1:
            together = _joint(given, white, fit(given, white, real, sim, leading), len(real))
            gap, searched = replace(gap, candidates=(*gap.candidates, *together)), None
    tell("attributing the gap")

    exchanged = _exchanged(given, real, sim, seed)
    verdict = attribute(gap, exchanged, tuple(dict.fromkeys(forced)), seed, searched=searched)
    return _document(given, gap, white, verdict, real, sim)


def fitted_gap(given: Scene, real: np.ndarray, sim: np.ndarray) -> tuple[Whitening, Gap]:
    """The whitening, and the gap with each effect fitted separately as its candidates."""
    white = whitening(given, real, sim)
    found = (_candidates(white, fit(given, white, real, sim, (n,)), len(real)) for n in effects())
    return white, gap_of(given.layout, white, real, sim, [c for forms in found for c in forms])


def _exchanged(given: Scene, real: np.ndarray, sim: np.ndarray, seed: int) -> Iterator[float]:
    """Statistics under exchanged labels; effects still act on the original simulated courses."""
    every, count = np.concatenate([real, sim]), len(real)
    rng, total = np.random.default_rng(seed), comb(len(every), count)
    if total <= 10 * EXCHANGES:
        chosen = [np.array(c) for c in combinations(range(len(every)), count)][1:]
        chosen = [chosen[k] for k in rng.permutation(len(chosen))]
    else:
        chosen = [rng.permutation(len(every))[:count] for _ in range(EXCHANGES)]
    for labelled in chosen[:EXCHANGES]:
        as_real = np.isin(np.arange(len(every)), labelled)
        f = forms(fitted_gap(given, every[as_real], every[~as_real])[1])
        yield statistic(f, sought(f))


@dataclass(frozen=True)
class Whitening:
    """The matrix `root` (F, F) that whitens a row of the gap channel by channel, the row's variances (F,),
    and the mean squares (F,) `expected` of the whitened row."""

    root: np.ndarray
    variance: np.ndarray
    expected: np.ndarray


def whitening(given: Scene, real: np.ndarray, sim: np.ndarray) -> Whitening:
    """The whitening for features of real (R, F) and simulated trials (S, F)."""
    lay, kinds = given.layout, [v for v in (real, sim) if len(v) > 1]
    root, (variance, expected) = np.zeros((lay.kind.size, lay.kind.size)), np.zeros((2, lay.kind.size))
    for c in lay.every:
        index = lay.of_channel(c)
        basis = _common(given, c) if c >= 0 else np.zeros((index.size, 0))
        each = [_covariance(lay, v[:, index], basis, index) for v in kinds]
        a, b = each[0], each[-1]  # a kind with a single trial borrows the other's covariance
        of_row = a + b * len(real) / len(sim)
        values, vectors = np.linalg.eigh(of_row)
        own = (vectors / np.sqrt(np.maximum(values, 1e-9 * values.max()))) @ vectors.T
        root[np.ix_(index, index)], variance[index] = own, np.diag(of_row)
        expected[index] = np.einsum("ij,jk,ik->i", own, a + b / len(sim), own)
    return Whitening(root, variance, expected)


def variances(lay: Layout, deviations: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Variances between trials (n,) from deviations (T, n), shrunk towards the mean of their cell."""
    dof = len(deviations) - 1
    raw = (deviations**2).sum(0) / dof
    cell = np.unique(lay.subtask[index] * 3 + lay.kind[index], return_inverse=True)[1]
    pooled = (np.bincount(cell, raw) / np.bincount(cell))[cell]
    scale = np.where(lay.channel[index] >= 0, lay.scale[lay.channel[index]], 1.0)
    # The log of a mean of m squares of white noise has the variance 2 / m; half of it is the floor.
    floor = np.where(lay.kind[index] == SLOW, (SMALLEST * scale) ** 2,
                     np.where(lay.kind[index] == FAST, 1 / lay.width[index], PACE**2))  # fmt: skip
    return np.maximum((dof * raw + MODERATION * pooled) / (dof + MODERATION), floor)


def _common(given: Scene, channel: int) -> np.ndarray:
    """Orthonormal ways (n, q) in which trials differ: offset, slope, size, time, loudness, by subtask."""
    lay, t, x = given.layout, given.t, given.course[channel]
    slow = (lay.kind[lay.of_channel(channel)] == SLOW).astype(float)
    moved = [t, x, delayed(t, x, LATE) - x]  # a drift, a gain, a lag
    columns = [np.concatenate([means(t, m, given.bins), np.zeros(int((slow == 0).sum()))]) for m in moved]
    subtask = lay.subtask[lay.of_channel(channel)]
    columns += [slow * (subtask == k) for k in range(len(lay.window))] + [1 - slow]
    ways = np.stack([c / max(np.linalg.norm(c), 1e-12) for c in columns], 1)
    left, size, _ = np.linalg.svd(ways, full_matrices=False)
    return left[:, size > 1e-6]


def _covariance(lay: Layout, values: np.ndarray, basis: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Covariance (n, n) between trials: empirical along the common ways, autocorrelated elsewhere.

    The covariance along the q common ways is shrunk to its diagonal with q + 1 degrees of freedom. The rest
    has the features' own variances and an AR(1) correlation between neighbours in the slow course.
    """
    kind, deviations = lay.kind[index], values - values.mean(0)
    dof, q = len(values) - 1, basis.shape[1]
    if not q:
        return np.diag(variances(lay, deviations, index))
    along = deviations @ basis
    common = along.T @ along / dof
    common = (dof * common + (q + 1) * np.diag(np.diag(common))) / (dof + q + 1)
    rest = deviations - along @ basis.T
    own = variances(lay, rest, index)
    z = rest / np.sqrt(own)
    slow = kind == SLOW
    near = slow[1:] & slow[:-1]
    rho = float((z[:, 1:] * z[:, :-1])[:, near].sum() / max((z[:, :-1] ** 2)[:, near].sum(), 1e-12))
    apart = np.abs(np.subtract.outer(np.arange(kind.size), np.arange(kind.size)))
    alike = np.where(np.logical_and.outer(slow, slow), np.clip(rho, 0.0, 0.95) ** apart, np.eye(kind.size))
    return basis @ common @ basis.T + alike * np.sqrt(np.outer(own, own))


def gap_of(
    lay: Layout, white: Whitening, real: np.ndarray, sim: np.ndarray, candidates: Sequence[Candidate]
) -> Gap:
    """The gap of all real trials; it has no nuisances, as the covariance holds them."""
    count, c = len(real), len(lay.ensembles.channels)
    channel = np.where(lay.channel < 0, 2 * c, lay.channel + c * (lay.kind == FAST))
    time = np.where(lay.kind == FAST, APART, 0.0) * np.arange(lay.kind.size)
    ends = bin_edges(lay, np.mean([cut.edges for cut in lay.ensembles.real], 0))
    for own in range(c):
        time[lay.of_channel(own)[: ends.size - 1]] = (ends[1:] + ends[:-1]) / 2
    names = lay.ensembles.channels
    parts = Rows(
        np.repeat(np.arange(count), lay.kind.size), np.tile(channel, count), np.tile(lay.subtask, count),
        np.tile(time, count), tuple(cut.trial.file for cut in lay.ensembles.real[:count]),
        (*names, *(n + POWER for n in names), DURATIONS), lay.ensembles.subtasks,
    )  # fmt: skip
    residual = ((real - sim.mean(0)) @ white.root.T).ravel()
    return Gap(parts, residual, np.zeros((residual.size, 0)), tuple(candidates),
               mean_square=np.tile(white.expected, count))  # fmt: skip


@dataclass(frozen=True)
class Part:
    """Effects fitted in one channel, or to one duration: coordinates `u` (k,) of their slots, the `shift`
    (F,) of all features, and its derivatives `slopes` (F, k) with respect to the coordinates."""

    slots: tuple[Slot, ...]
    u: np.ndarray
    shift: np.ndarray
    slopes: np.ndarray


def shift_at(given: Scene, mine: Sequence[Slot], u: np.ndarray) -> np.ndarray:
    """Change (n,) of a channel's features, or of durations, by effects at coordinates u (k,)."""
    values = [s.parameter.value(float(v)) for s, v in zip(mine, u, strict=True)]
    count = len(given.layout.window)
    if mine[0].channel < 0:
        return np.bincount([s.place for s in mine], values, count)
    acting, rung = dict[str, dict[str, float]](), np.zeros((count, 2))
    for s, value in zip(mine, values, strict=True):
        if s.place >= 0:
            rung[s.place, int(s.parameter.name == "cos")] = value
        else:
            acting.setdefault(s.effect, {})[s.parameter.name] = value
    return predicted(given, mine[0].channel, acting, rung) - given.plain[mine[0].channel]


def fit(
    given: Scene, white: Whitening, real: np.ndarray, sim: np.ndarray, names: Sequence[str]
) -> list[Part]:
    """Fit effects jointly to the mean difference of features, channel by channel."""
    out, difference = [], real.mean(0) - sim.mean(0)
    for channel in given.layout.every:
        index = given.layout.of_channel(channel)
        root = white.root[np.ix_(index, index)] * np.sqrt(len(real))
        mine = [s for name in names for s in slots(given, name, channel)]
        if not mine:
            continue
        u, slopes = _fitted(given, root, difference[index], mine)
        every = list(range(len(mine)))
        # Durations are judged one by one.
        for part in [every] if channel >= 0 else [[k] for k in every]:
            own, whole = tuple(mine[k] for k in part), np.zeros((difference.size, 1 + len(part)))
            whole[index, 0], whole[index, 1:] = shift_at(given, own, u[part]), slopes[:, part]
            out.append(Part(own, u[part], whole[:, 0], whole[:, 1:]))
    return out


def _fitted(
    given: Scene, root: np.ndarray, target: np.ndarray, mine: Sequence[Slot]
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (k,) and derivatives (n, k) of the best bounded fit from all starts, with normal priors."""
    priors, ends = np.eye(len(mine)), np.array([s.parameter.limits for s in mine]).T
    at = partial(shift_at, given, mine)

    def derivatives(u: np.ndarray) -> np.ndarray:
        return (np.stack([at(u + step) for step in STEP * priors], 1) - at(u)[:, None]) / STEP

    def residual(u: np.ndarray) -> np.ndarray:
        return np.concatenate([root @ (target - at(u)), u])

    def jacobian(u: np.ndarray) -> np.ndarray:
        return np.concatenate([-root @ derivatives(u), priors])

    starts = [[s.parameter.coordinate(v) for v in s.parameter.starts or (0.0,)] for s in mine]
    every = [np.array([s[j % len(s)] for s in starts]) for j in range(max(map(len, starts)))]
    options: dict[str, Any] = {"jac": jacobian, "bounds": ends, "ftol": CLOSE, "max_nfev": STEPS}
    descents = [least_squares(residual, np.clip(u, *ends), **options) for u in every]
    u = min(descents, key=lambda d: d.cost).x
    return u, derivatives(u)


def _candidates(white: Whitening, found: Sequence[Part], count: int) -> list[Candidate]:
    """One effect acting in all channels (durations: subtasks), and only in the one it explains most of."""
    if not found:
        return []
    gains = [float(np.square(white.root @ p.shift).sum()) for p in found]
    forms = [list(found)] + [[found[int(np.argmax(gains))]]] * (len(found) > 1)
    return [_candidate(white, parts, np.sum([p.shift for p in parts], 0), count) for parts in forms]


def _joint(given: Scene, white: Whitening, found: Sequence[Part], count: int) -> list[Candidate]:
    """The effects of a joint fit as candidates: the shift of each is what vanishes without it, plus an equal
    part of what they do only together."""
    names = list(dict.fromkeys(s.effect for p in found for s in p.slots))
    lay, whole, alone, own = given.layout, np.sum([p.shift for p in found], 0), {}, {}
    for name in names:
        alone[name], own[name] = np.zeros_like(whole), list[Part]()
        for p in found:
            mine, index = np.array([s.effect == name for s in p.slots]), lay.of_channel(p.slots[0].channel)
            if mine.any():
                rest = shift_at(given, p.slots, np.where(mine, 0.0, p.u))
                alone[name][index] += p.shift[index] - rest
                kept = tuple(s for s in p.slots if s.effect == name)
                own[name].append(Part(kept, p.u[mine], p.shift, p.slopes[:, mine]))
    more = (whole - np.sum(list(alone.values()), 0)) / len(names)
    return [_candidate(white, own[name], alone[name] + more, count) for name in names]


def _candidate(white: Whitening, parts: Sequence[Part], shift: np.ndarray, count: int) -> Candidate:
    """Fitted parts of one effect, with their `shift` (F,), as a candidate on the rows of `count` trials."""
    mine, u = [s for p in parts for s in p.slots], np.concatenate([p.u for p in parts])
    slopes = np.concatenate([p.slopes for p in parts], 1)
    low, high = np.array([s.parameter.limits for s in mine]).T
    moved, jacobian = np.tile(white.root @ shift, count), np.tile(white.root @ slopes, (count, 1))
    return Candidate(mine[0].effect, tuple(s.label for s in mine), u, np.zeros(u.size), np.ones(u.size),
                     moved, jacobian, low, high)  # fmt: skip


def _document(
    given: Scene, gap: Gap, white: Whitening, verdict: Attribution, real: np.ndarray, sim: np.ndarray
) -> GenericDiagnosis:
    """The JSON document, and what figures need."""
    lay, far, rest = given.layout, verdict.how_far, verdict.remainder
    best = next((m for m in verdict.models if m.effects), verdict.models[0])
    leading = verdict.causes or tuple(gap.candidates[j].name for j in best.effects)
    described = {n: _described(given, verdict, [n]) for n in verdict.effects}
    if len(verdict.causes) > 1:
        described["+".join(verdict.causes)] = _described(given, verdict, verdict.causes)
    attribution = {n: (e.probability, e.share, e.share_90) for n, e in verdict.effects.items()}
    body = entries(verdict, verdict.detection, (rest.share, rest.p_value, _cells(lay, rest.where)),
                   attribution, _cells(lay, verdict.where))  # fmt: skip
    shrinkage = None if far is None else far.to_json()
    body |= {"effects": described, "shrinkage": shrinkage, "next_experiment": None}
    warnings = [*lay.ensembles.warnings]
    if len(real) == 1:
        warnings.append("one real trial: nothing is held out, and an accident of it looks like an effect")
    moved = np.zeros(lay.kind.size)
    for n in leading:
        e = verdict.effects[n]
        c = gap.candidates[e.candidate]
        x = np.array([p.mean for p in e.parameters.values()])
        moved += (c.shift + c.jacobian @ (x - c.at))[: lay.kind.size]
    shift = np.linalg.solve(white.root, moved)
    return GenericDiagnosis(body, given, real, sim, white.variance, shift, leading, tuple(warnings))


def _cells(lay: Layout, found: Sequence[Any]) -> list[dict[str, Any]]:
    """Cells as the document lists them; the band of a power is that of its window."""
    out = rows(found)
    for row in out:
        if row["channel"].endswith(POWER):
            k = lay.ensembles.subtasks.index(row["subtask"])
            first, n = lay.coefficients[k][0].start, lay.window[k]
            row["channel"] = row["channel"].removesuffix(POWER)
            row["band"] = [float(first * lay.rate / (2 * n)), lay.rate / 2]
    return out


def _described(given: Scene, verdict: Attribution, names: Sequence[str]) -> dict[str, Any]:
    """Parameters and evidence of effects that act together."""
    out = dict[str, Any]()
    for name in names:
        prefix = f"{name}." if len(names) > 1 else ""
        out |= {prefix + k: v for k, v in _parameters(given, name, verdict.effects[name].parameters).items()}
    odds = log_odds(verdict.effects[n].probability for n in names)
    score = None if len(names) < 2 or verdict.how_far is None else verdict.how_far.score
    return {"parameters": out, "log_evidence": odds, "property_shift": {}, "heldout_score": score}


def _parameters(given: Scene, name: str, found: Mapping[str, ParameterPosterior]) -> dict[str, Any]:
    """An effect's parameters in units, by channel or subtask; frequency, damping and size of a vibration."""
    lay, out = given.layout, dict[str, Any]()
    rung = dict[tuple[int, int], list[tuple[float, float]]]()
    of = {s.label: s for c in lay.every for s in slots(given, name, c)}
    for label, value in found.items():
        slot, p = of[label], of[label].parameter
        mean, sd, ends = p.value(value.mean), p.sd * value.sd, [p.value(v) for v in value.interval_90]
        if slot.channel < 0:
            ratio = float(np.exp(mean))
            out[lay.ensembles.subtasks[slot.place]] = _entry(ratio, ratio * sd, np.exp(ends), "1")
        elif slot.place >= 0:
            rung.setdefault((slot.channel, slot.place), []).append((mean, sd))
        else:
            channel = lay.ensembles.channels[slot.channel]
            key = channel if len(effects()[name].parameters) == 1 else f"{channel}.{p.name}"
            out[key] = _entry(mean, sd, ends, p.unit)
    if rung and (ring := given.ring) is not None:
        size, sd, c = max((*map(float, np.hypot(*np.reshape(v, (-1, 2)))), c) for (c, _), v in rung.items())
        ends, unit = (max(size - 1.645 * sd, 0.0), size + 1.645 * sd), lay.ensembles.channels[int(c)]
        out |= {"frequency": _entry(ring.frequency, ring.frequency_sd, ring.frequency_90, "Hz"),
                "damping": _entry(ring.damping, ring.damping_sd, ring.damping_90, "1"),
                "gain": _entry(size, sd, ends, f"unit of {unit}")}  # fmt: skip
    return out


def _entry(mean: float, sd: float, interval: Iterable[float], unit: str) -> dict[str, Any]:
    return {"mean": mean, "sd": sd, "interval_90": [float(v) for v in interval], "unit": unit}
