"""The attribution of a gap: which effects act, how sure, what share each explains, and what is left."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from hmmseg.errors import InputError
from simgap.attribution.heldout import (
    POSITIVE,
    RESPONSE,
    Heldout,
    HowFar,
    residual_left,
    scatter_between,
    share_of,
)
from simgap.attribution.posterior import Forms, Model, channel_of, coordinates, fitted, forms
from simgap.attribution.problem import Gap, Rows
from simgap.attribution.search import Detection, detected, leniently, sought, statistic, weights
from simgap.attribution.verdict import (
    ALARM,
    RULED_OUT,
    Cell,
    Explanation,
    Shares,
    Verdict,
    acting,
    conclude,
    known,
    probabilities,
    shares,
    significant,
)

# What an attribution finds, as frozen objects.


@dataclass(frozen=True)
class ParameterPosterior:
    """Mean, standard deviation and 90 % interval, given that the effect acts."""

    mean: float
    sd: float
    interval_90: tuple[float, float]


@dataclass(frozen=True)
class EffectPosterior:
    """One effect: `probability` to act, `share` of the gap it explains with its 90 % interval (0 where it
    does not act), parameters, and which of the gap's candidates (an effect may have several forms) they are
    of."""

    probability: float
    share: float
    share_90: tuple[float, float]
    parameters: dict[str, ParameterPosterior]
    candidate: int


@dataclass(frozen=True)
class Remainder:
    """What no named cause explains: its `share` of the gap, the chance of noise to look so, and where."""

    share: float
    p_value: float
    where: tuple[Cell, ...]


@dataclass(frozen=True)
class SmallGap:
    """A gap below the smallest that matters: `size` over that, of the `channel` and `part` with the most;
    `amount` there in sds of the noise, for the caller to turn into units."""

    size: float
    channel: str
    part: str
    amount: float


@dataclass(frozen=True)
class Attribution(Verdict):
    """The verdict, with everything else that was found; see the fields' own classes.

    `left` (n,): residual that the causes leave, `before` (n,): with nuisances alone, both as cosines of each
    cell.
    """

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


# Noise of each channel over the stated one, and gaps too small to matter.

STATED = (0.6, 1.7)  # prior: bounds of a channel's noise over the stated one, in standard deviations


def noise_of(f: Forms, model: Model) -> np.ndarray:
    """Noise (channels,) over the stated one, sd: the median of the groups that a set leaves, by their counts.

    Groups where the model is off by itself are few: a median does not see them. Each is measured by the
    median of as many squares of noise, which is less than their mean (Wilson & Hilferty, PNAS 17, 1931).
    """
    count = np.maximum(f.count, 1)
    channel, ratio = channel_of(f), model.energy / (count * (1 - 2 / (9 * count)) ** 3)
    out = np.ones(len(f.gap.rows.channels))
    for c in np.unique(channel):
        mine = np.flatnonzero((channel == c) & (f.count >= 8))
        if mine.size >= 3:
            order = mine[np.argsort(ratio[mine])]
            share = np.cumsum(f.count[order]) / f.count[order].sum()
            out[c] = np.sqrt(ratio[order[np.searchsorted(share, 0.5)]])
    return np.clip(out, *STATED)


def stated(rows: Rows) -> np.ndarray:
    """The noise (channels,) that rows are measured by, over the stated one."""
    out = np.ones(len(rows.channels))
    for c in np.unique(rows.channel) if rows.sd is not None else ():
        out[c] = np.sqrt(np.mean(rows.sd[rows.channel == c] ** 2))  # type: ignore[index]
    return out


def small_gap(f: Forms, by_group: np.ndarray, tolerance: np.ndarray) -> SmallGap:
    """The gap's size, over what matters least, where it is largest."""
    before = residual_left(f, fitted(f, ()))
    rows = f.gap.rows
    key, inverse = np.unique(rows.channel * len(rows.parts) + rows.part, return_inverse=True)
    count = np.bincount(inverse).astype(float)
    noise = by_group[f.spectrum.group]
    excess = np.maximum(np.bincount(inverse, before**2) - np.bincount(inverse, noise), 0.0) / count
    chance = np.sqrt(2 / count) * np.bincount(inverse, noise) / count
    amount = np.sqrt(np.maximum(excess - 2 * chance, 0.0))
    sd = np.sqrt(np.bincount(inverse, np.ones(inverse.size) if rows.sd is None else rows.sd**2) / count)
    amount, least = amount * sd, np.bincount(inverse, tolerance) / count
    size = amount / least
    most = int(size.argmax())
    channel, part = divmod(int(key[most]), len(rows.parts))
    return SmallGap(float(size[most]), rows.channels[channel], rows.parts[part], float(amount[most]))


DOUBT = 0.1  # chosen: chance of no cause or another one, beyond which a gap usually tolerated is left
EXAMINED = 6  # numerics: sets that are examined for being the cause


def attribute(
    gap: Gap,
    twins: Iterable[float] | Callable[[float], Iterable[float]] | None = None,
    forced: tuple[str, ...] = (),
    seed: int = 0,
    heldout: bool = True,
    models: list[Model] | None = None,
    absorbed: np.ndarray | None = None,
) -> Attribution:
    """Attribute a gap to its candidates.

    `twins`: the `statistic` of healthy twins, taken one by one, or what gives them for the gap's own; without
    them stated noise is the null. `absorbed`: by how much the first nuisances may be off without it
    mattering. `forced` names effects that act for certain, and no others. `heldout`: whether causes must
    shrink the gap of trials that took no part, where there are several. `models`: the sets that `sought`
    finds, where they are known already.
    """
    rng = np.random.default_rng(seed)
    f = forms(gap)
    models = sought(f) if models is None else models
    if forced:
        models = [_forced(f, forced), *[m for m in models if not m.effects]]
    value = statistic(f, models)
    found = detected(value, twins(value) if callable(twins) else twins)
    w = weights(models)
    noise = noise_of(f, models[0])
    by_group = (noise**2)[channel_of(f)]
    ranked, others = [m.effects for m in models if m.effects][:EXAMINED], None
    if heldout and (found.p_value < ALARM or forced):
        others = Heldout.of(f, noise**2, (j for effects in ranked for j in effects))
    examined = {effects: _examined(f, effects, models, by_group, rng, others) for effects in ranked}
    sets = [_explanation(f, m.effects, float(x), examined) for m, x in zip(models, w, strict=True)]
    small = None
    if gap.tolerance is not None and (found.p_value < ALARM or forced):
        small = _small(f, models, by_group, absorbed)
    if small is not None and gap.usual:  # a cause that is surely found can be mended
        chance = probabilities(sets, found.p_value)
        small = small if chance["none"] + chance["unknown"] > DOUBT else None
    first = next(iter(examined), ())
    named = _names(f, first) if forced else ()
    verdict = conclude(sets, found.p_value, small is None, named, unseen=found.unseen)
    causes = next((j.causes for j in examined.values() if _names(f, j.causes) == verdict.causes), ())
    causes = first if forced else causes
    model = fitted(f, causes)
    left, before = residual_left(f, model), residual_left(f, fitted(f, ()))
    sd = noise[gap.rows.channel]
    rest = significant(gap.rows, f.spectrum.band, left, sd)
    p_rest = detected(statistic(f, models, causes)).p_value
    explained = shares(f, model, by_group, rng)
    # Noise that differs from part to part can show a gap somewhere, and none in all squares together.
    shown = explained.before > explained.floor or verdict.verdict == "none"
    remains = explained.remainder if shown else 1.0
    far = None if others is None else others.how_far(causes)
    chance = acting([Explanation(_names(f, m.effects), float(x)) for m, x in zip(models, w, strict=True)],
                    found.p_value)  # fmt: skip
    somewhere = verdict.verdict != "none" or small is not None
    return Attribution(
        **vars(verdict),
        effects=_effects(f, models, chance, examined),
        detection=found,
        remainder=Remainder(remains, p_rest, rest),
        where=significant(gap.rows, f.spectrum.band, before, sd) if somewhere else (),
        how_far=far,
        small_gap=small,
        noise=dict(zip(gap.rows.channels, (noise * stated(gap.rows)).tolist(), strict=True)),
        models=tuple(models),
        shares=explained,
        before=before,
        left=left,
    )


def _names(f: Forms, effects: Iterable[int]) -> tuple[str, ...]:
    return tuple(sorted({f.gap.candidates[j].name for j in effects}))


def _explanation(
    f: Forms, effects: tuple[int, ...], weight: float, examined: dict[tuple[int, ...], _Examined]
) -> Explanation:
    one = examined.get(effects)
    if one is None:
        return Explanation(_names(f, effects), weight)
    return Explanation(_names(f, effects), weight, _names(f, one.causes), one.known)


def _small(
    f: Forms, models: list[Model], by_group: np.ndarray, absorbed: np.ndarray | None
) -> SmallGap | None:
    """The gap's size where neither residuals, nor what is likely, nor the properties it moves matter."""
    assert f.gap.tolerance is not None
    small = small_gap(f, np.minimum(by_group, 1.0), f.gap.tolerance)
    if small.size >= 1.0 and np.exp(-statistic(*leniently(f, models))) < ALARM:
        return None
    if absorbed is not None:
        moved = np.abs(models[0].x[: absorbed.size] - fitted(f, ()).x[: absorbed.size])
        if (moved > absorbed).any():
            return None
    return small


def _forced(f: Forms, names: tuple[str, ...]) -> Model:
    """The best set of these effects, one form of each; InputError for one that cannot act here."""
    possible = dict.fromkeys(c.name for c in f.gap.candidates)
    for name in names:
        if name not in possible:
            raise InputError(f"effect {name!r}", "cannot act on these recordings", ", ".join(possible))
    forms_of = [[j for j, c in enumerate(f.gap.candidates) if c.name == name] for name in names]
    sets = {tuple(sorted(each)) for each in product(*forms_of)}
    return max((fitted(f, each) for each in sets), key=lambda m: m.score)


@dataclass(frozen=True)
class _Examined:
    """A set of effects: its fit, shares, `causes` that matter, probability to be right."""

    effects: tuple[int, ...]
    model: Model
    shares: Shares
    causes: tuple[int, ...]
    known: float


def _examined(
    f: Forms,
    effects: tuple[int, ...],
    models: list[Model],
    by_group: np.ndarray,
    rng: np.random.Generator,
    others: Heldout | None = None,
) -> _Examined:
    """`others`: trials predicted by the others; a cause must predict them better than the set without it."""
    model = fitted(f, effects)
    explained = shares(f, model, by_group, rng)
    scattering = {j for j in effects if not f.gap.candidates[j].parameters}
    causes = tuple(j for j in effects if j in scattering or _needed(f, model, j))
    if others is not None:
        causes = _predicting(others, causes)
    shifting = {*causes} - scattering
    left = explained.inside if shifting else 0.0
    far = None if others is None else others.how_far(causes)
    share = 1 - explained.remainder if far is None else far.fraction
    if far is None and others is not None and shifting:
        share = 0.0  # squares in all are no more than the noise's: there is nothing that could be gone
    sure = known(left, share, detected(statistic(f, models, causes)).p_value) if causes else 0.0
    return _Examined(effects, model, explained, causes, sure)


def _predicting(others: Heldout, causes: tuple[int, ...]) -> tuple[int, ...]:
    """Causes without which held-out trials are predicted worse, the others removed one at a time.

    The trial that gains most does not count: an accident of one trial is no cause. An effect that only
    scatters must gain more than form errors of the rest may feign.
    """
    of = others.whole.gap.candidates
    while causes:
        gained = {}
        for j in causes:
            rest = [i for i in causes if i != j]
            gains = others.gains(causes, rest, rest)
            gained[j] = float(gains.sum() - gains[:-1].max())
            if rest and not of[j].parameters:
                feigned = max(of[i].form for i in rest) * others.gain(rest, ())
                gained[j] -= feigned if gains.sum() < feigned else 0.0
        least = min(gained, key=lambda j: gained[j])
        if gained[least] > POSITIVE:
            break
        causes = tuple(i for i in causes if i != least)
    return causes


def _needed(f: Forms, model: Model, effect: int) -> bool:
    """Whether the evidence of a set rules out that its other effects do without this one, by more than errors
    in their forms may feign. One alone is needed if there is a gap."""
    others = tuple(j for j in model.effects if j != effect)
    if not others:
        return True
    feigned = max(f.gap.candidates[j].form for j in others) * (model.score - fitted(f, ()).score)
    return bool(model.score - fitted(f, others).score > max(np.log(RULED_OUT), feigned))


def _effects(
    f: Forms, models: list[Model], chances: dict[str, float], examined: dict[tuple[int, ...], _Examined],
) -> dict[str, EffectPosterior]:  # fmt: skip
    """The posterior of every candidate: from the best set that holds it, or by itself."""
    out: dict[str, EffectPosterior] = {}
    forms_of: dict[str, list[int]] = {}
    for j, c in enumerate(f.gap.candidates):
        forms_of.setdefault(c.name, []).append(j)
    for name, mine in forms_of.items():
        inside = [m for m in models if {*mine} & {*m.effects}]
        found = next((one for part, one in examined.items() if {*mine} & {*part}), None)
        if found is not None:
            model = found.model
        elif inside:
            model = inside[0]
        else:
            model = max((fitted(f, (j,)) for j in mine), key=lambda m: m.score)
        j = next(iter({*mine} & {*model.effects}))
        c = f.gap.candidates[j]
        share, interval = 0.0, (0.0, 0.0)
        if found is not None:
            share, interval = found.shares.of_effect(found.effects.index(j))
        own = coordinates(f, model.effects)[j]
        sd = c.scale * np.sqrt(np.diag(model.covariance)[own])
        mean = c.neutral + c.scale * model.x[own]
        wide = np.hypot(sd, c.scale * RESPONSE * share_of(f, model, j))
        if found is not None:  # parts are compared for effects of the sets that were examined alone
            wide = np.hypot(wide, c.scale * np.sqrt(_between(f, model, j)))
        out[name] = EffectPosterior(
            chances.get(name, 0.0), share, interval,
            {n: ParameterPosterior(float(m), float(s), (float(m - 1.645 * s), float(m + 1.645 * s)))
             for n, m, s in zip(c.parameters, mean, wide, strict=True)}, j)  # fmt: skip
    return out


def _between(f: Forms, model: Model, effect: int) -> np.ndarray:
    """Variance (k,) of an effect's deviations over scale, for trials differ, or channels and subtasks."""
    rows = f.gap.rows
    _, place = np.unique(rows.channel * len(rows.parts) + rows.part, return_inverse=True)
    return np.maximum(*(scatter_between(f, model, effect, part) for part in (rows.trial, place)))
