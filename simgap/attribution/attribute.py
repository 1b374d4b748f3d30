"""The attribution of a gap: which effects act, how sure, what share each explains, and what is left."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from simgap.attribution.cells import Cell, significant
from simgap.attribution.detection import Detection, detected, statistic
from simgap.attribution.heldout import HowFar, how_far
from simgap.attribution.invariance import Invariance, invariance, residual_left
from simgap.attribution.posterior import Forms, Model, fitted, forms, sought, weights
from simgap.attribution.problem import Gap
from simgap.attribution.shares import Shares, shares
from simgap.attribution.verdict import LEAST, POSITIVE, alike, known, named_part

ALARM = 0.01  # chance of a healthy recording to be called otherwise
STATED = (0.6, 1.7)  # bounds of a channel's noise over the stated one, in standard deviations


@dataclass(frozen=True)
class ParameterPosterior:
    """Mean, standard deviation and 90 % interval, given that the effect acts."""

    mean: float
    sd: float
    interval_90: tuple[float, float]


@dataclass(frozen=True)
class EffectPosterior:
    """One effect: `probability` to act, `share` of the gap it explains with its 90 % interval (0 where it
    does not act), parameters, and whether they are the same in all trials."""

    probability: float
    share: float
    share_90: tuple[float, float]
    parameters: dict[str, ParameterPosterior]
    invariance: Invariance | None


@dataclass(frozen=True)
class Remainder:
    """What no named cause explains: its `share` of the gap, the chance of noise to look so, and where."""

    share: float
    p_value: float
    where: tuple[Cell, ...]


@dataclass(frozen=True)
class SmallGap:
    """A gap below the smallest that matters: `size` over that, of the `channel` and `part` with the most."""

    size: float
    channel: str
    part: str


@dataclass(frozen=True)
class Attribution:
    """Everything found; see the fields' own classes. `left` (n,): residual that the causes leave, `before`
    (n,): with nuisances alone, both as cosines of each cell; `nuisances` (K,) and their covariance."""

    verdict: str
    causes: tuple[str, ...]
    indistinguishable: tuple[str, ...]
    probabilities: dict[str, float]
    effects: dict[str, EffectPosterior]
    detection: Detection
    remainder: Remainder
    where: tuple[Cell, ...]
    how_far: HowFar | None
    small_gap: SmallGap | None
    noise: dict[str, float]
    models: tuple[Model, ...]
    shares: Shares
    before: np.ndarray
    left: np.ndarray


def attribute(
    gap: Gap,
    twins: Iterable[float] | None = None,
    tolerance: np.ndarray | None = None,
    forced: tuple[str, ...] = (),
    seed: int = 0,
    nested: bool = True,
) -> Attribution:
    """Attribute a gap to its candidates.

    `twins`: the `statistic` of healthy twins, taken one by one; without them stated noise is the null.
    `tolerance` (n,): smallest shift of each row that matters, in sds of its noise. `forced` names effects
    that act for certain, and no others. `nested`: whether how far the gap shrinks is asked.
    """
    rng = np.random.default_rng(seed)
    f = forms(gap)
    models = sought(f)
    if forced:
        wanted = tuple(j for j, c in enumerate(gap.candidates) if c.name in forced)
        models = [fitted(f, wanted), *[m for m in models if not m.effects]]
    found = detected(statistic(f, models), twins)
    w = weights(models)
    noise = noise_of(f, models[0])
    by_group = (noise**2)[_channel_of(f)]
    # A set's probability to be the cause, decoys being what no name explains.
    parts = {m.effects: named_part(f, m) for m in models}
    likely: dict[tuple[int, ...], float] = {}
    for m, weight in zip(models, w, strict=True):
        likely[parts[m.effects]] = likely.get(parts[m.effects], 0.0) + float(weight)
    ranked = sorted((p for p in likely if p), key=lambda p: -likely[p])
    judged = {part: _judged(f, part, by_group, rng) for part in ranked[:6]}
    sure = {part: j.known for part, j in judged.items()}
    causes_of = judged[ranked[0]] if ranked else _judged(f, (), by_group, rng)
    probability = _probabilities(f, likely, sure, found.p_value)
    gone = bool(found.p_value >= ALARM) and not forced
    small = None if tolerance is None or gone else _small(f, models[0], by_group, tolerance)
    verdict, causes, partners = "none", (), ()
    if forced:
        verdict, causes = "named", causes_of.effects
    elif not gone and small is None:
        verdict = "unknown"
        if probability["unknown"] <= 0.5 and causes_of.causes:
            causes = causes_of.causes
            partners = alike(f, models, w, causes)
            verdict = "set" if partners else "named"
    name = lambda effects: tuple(sorted(gap.candidates[j].name for j in effects))  # noqa: E731
    told = fitted(f, causes)
    left, before = residual_left(f, told), residual_left(f, fitted(f, ()))
    sd = noise[gap.rows.channel]
    rest = significant(gap.rows, f.spectrum.band, left, sd)
    p_rest = detected(statistic(f, models, causes)).p_value
    explained = shares(f, told, by_group, rng)
    far = how_far(gap, noise**2) if nested and causes else None
    return Attribution(
        verdict, name(causes), name(partners), probability,
        _effects(f, models, w, judged, rng, by_group), found,
        Remainder(explained.remainder, p_rest, rest),
        significant(gap.rows, f.spectrum.band, before, sd) if verdict != "none" else (),
        far, small, dict(zip(gap.rows.channels, noise.tolist(), strict=True)), tuple(models), explained,
        before, left,
    )  # fmt: skip


@dataclass(frozen=True)
class _Judged:
    """A set of named effects: its fit, shares, invariance, `causes` that matter, probability to be right."""

    effects: tuple[int, ...]
    model: Model
    shares: Shares
    invariance: dict[int, Invariance]
    causes: tuple[int, ...]
    known: float


def _judged(f: Forms, effects: tuple[int, ...], by_group: np.ndarray, rng: np.random.Generator) -> _Judged:
    model = fitted(f, effects)
    explained = shares(f, model, by_group, rng)
    same = {j: invariance(f, model, j, f.gap.rows.trial) for j in effects}
    part = explained.each.mean(0) if effects else np.zeros(0)
    least = LEAST * float(part.sum())
    scattering = {j for j in effects if f.gap.candidates[j].variance is not None}
    causes = tuple(
        j for j, p in zip(effects, part, strict=True)
        if j in scattering or (p >= least and same[j].log_bayes_factor > POSITIVE)
    )  # fmt: skip
    shifting = [same[j] for j in causes if j not in scattering]
    sure = known(explained.inside if shifting else 0.0, shifting) if causes else 0.0
    return _Judged(effects, model, explained, same, causes, sure)


def _probabilities(
    f: Forms, likely: dict[tuple[int, ...], float], sure: dict[tuple[int, ...], float], p_value: float
) -> dict[str, float]:
    """Of none, unknown and every set of named effects; they sum to one."""
    none = float(expit((np.log(max(p_value, 1e-300)) - np.log(ALARM)) / 0.5))
    out = {"none": none, "unknown": 0.0}
    for part, weight in likely.items():
        right = sure.get(part, 0.0) * weight if part else 0.0
        out["unknown"] += (weight - right) * (1 - none)
        if part and right > 1e-4:
            out["+".join(sorted(f.gap.candidates[j].name for j in part))] = right * (1 - none)
    out["other"] = max(0.0, 1.0 - sum(out.values()))
    total = sum(out.values())
    return {name: value / total for name, value in out.items()}


def _effects(
    f: Forms, models: list[Model], w: np.ndarray, judged: dict[tuple[int, ...], _Judged],
    rng: np.random.Generator, by_group: np.ndarray,
) -> dict[str, EffectPosterior]:  # fmt: skip
    """The posterior of every candidate: from the best set that holds it, or by itself."""
    out = {}
    for j, c in enumerate(f.gap.candidates):
        inside = [(m, float(p)) for m, p in zip(models, w, strict=True) if j in m.effects]
        chance = sum(p for _, p in inside)
        found = next((one for part, one in judged.items() if j in part), None)
        model = found.model if found is not None else inside[0][0] if inside else fitted(f, (j,))
        share, low, high = 0.0, 0.0, 0.0
        if found is not None:
            each = found.shares.each[:, found.effects.index(j)]
            share, (low, high) = float(each.mean()), np.percentile(each, (5, 95))
        z = f.spectrum.num_nuisances + sum(f.gap.candidates[i].at.size for i in model.effects if i < j)
        sd = c.scale * np.sqrt(np.diag(model.covariance)[z : z + c.at.size])
        mean = c.neutral + c.scale * model.x[z : z + c.at.size]
        same = None if found is None else found.invariance[j]
        wide = np.hypot(sd, _wander(same) * np.abs(mean - c.neutral))
        out[c.name] = EffectPosterior(
            chance, share, (float(low), float(high)),
            {n: ParameterPosterior(float(m), float(s), (float(m - 1.645 * s), float(m + 1.645 * s)))
             for n, m, s in zip(c.parameters, mean, wide, strict=True)}, same)  # fmt: skip
    return out


def _wander(same: Invariance | None) -> float:
    """By which share an effect's parameters wander from part to part, 0 where nothing tells."""
    return 0.0 if same is None or np.isnan(same.wander) else same.wander


def _channel_of(f: Forms) -> np.ndarray:
    """The channel (G,) of each group."""
    out = np.zeros(f.count.size, int)
    out[f.spectrum.group] = f.gap.rows.channel
    return out


def noise_of(f: Forms, model: Model) -> np.ndarray:
    """Noise (channels,) over the stated one, sd: the median of the groups that a set leaves, by their counts.

    Groups where the model is off by itself are few: a median does not see them.
    """
    channel, ratio = _channel_of(f), model.energy / np.maximum(f.count, 1)
    out = np.ones(len(f.gap.rows.channels))
    for c in np.unique(channel):
        mine = np.flatnonzero((channel == c) & (f.count >= 8))
        if mine.size >= 3:
            order = mine[np.argsort(ratio[mine])]
            share = np.cumsum(f.count[order]) / f.count[order].sum()
            out[c] = np.sqrt(ratio[order[np.searchsorted(share, 0.5)]])
    return np.clip(out, *STATED)


def _small(f: Forms, model: Model, by_group: np.ndarray, tolerance: np.ndarray) -> SmallGap | None:
    """The gap's size where it exceeds what matters least of all, None where it matters."""
    before = residual_left(f, fitted(f, ()))
    rows = f.gap.rows
    key, inverse = np.unique(rows.channel * len(rows.parts) + rows.part, return_inverse=True)
    count = np.bincount(inverse).astype(float)
    noise = by_group[f.spectrum.group]
    excess = np.maximum(np.bincount(inverse, before**2) - np.bincount(inverse, noise), 0.0) / count
    spread = np.sqrt(2 / count) * np.bincount(inverse, noise) / count
    size = np.sqrt(np.maximum(excess - 2 * spread, 0.0)) / (np.bincount(inverse, tolerance) / count)
    most = int(size.argmax())
    if size[most] >= 1.0:
        return None
    channel, part = divmod(int(key[most]), len(rows.parts))
    return SmallGap(float(size[most]), rows.channels[channel], rows.parts[part])
