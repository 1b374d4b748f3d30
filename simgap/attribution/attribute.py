"""The attribution of a gap: which effects act, how surely, what share each explains, and what is left."""

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
from simgap.attribution.search import Detection, detected, sought, statistic, weights
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

# The result.


@dataclass(frozen=True)
class ParameterPosterior:
    """Mean and standard deviation of a parameter, given that the effect acts."""

    mean: float
    sd: float

    @property
    def interval_90(self) -> tuple[float, float]:
        """The central 90 % interval of a normal distribution."""
        return self.mean - 1.645 * self.sd, self.mean + 1.645 * self.sd


@dataclass(frozen=True)
class EffectPosterior:
    """The posterior of one effect.

    Attributes:
        probability: To act.
        share, share_90: Share of the gap it explains, with its 90 % interval; 0 if it does not act.
        parameters: By name.
        candidate: Index of the candidate they belong to (an effect may have several).
    """

    probability: float
    share: float
    share_90: tuple[float, float]
    parameters: dict[str, ParameterPosterior]
    candidate: int


@dataclass(frozen=True)
class Remainder:
    """What no named cause explains: its share of the gap, its p-value as noise, and its cells."""

    share: float
    p_value: float
    where: tuple[Cell, ...]


@dataclass(frozen=True)
class SmallGap:
    """A gap too small to matter, at its largest among channels and parts of trials.

    Attributes:
        size: The gap over the smallest that matters.
        channel: The channel in which it is largest.
        amount: Its root mean square there, in standard deviations of the noise.
    """

    size: float
    channel: str
    amount: float


@dataclass(frozen=True)
class Attribution(Verdict):
    """The verdict and everything it rests on.

    Attributes:
        effects: Posterior of each effect.
        detection: The test for a gap.
        remainder: What the causes do not explain.
        where: Cells of the gap.
        how_far: How far it shrinks on held-out trials; None if not evaluated.
        small_gap: The gap if it is too small to matter.
        noise: Standard deviation of each channel's noise over the stated one.
        models: The sets of effects that were considered.
        shares: Shares of the gap by effect.
        before, left: Residuals (n,) with nuisances alone and with the causes, as cosines of each cell.
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


# Noise of each channel relative to the stated one, and gaps too small to matter.

STATED = (0.6, 1.7)  # prior: bounds of a channel's noise relative to the stated one


def noise_of(f: Forms, model: Model) -> np.ndarray:
    """Standard deviation (channels,) of the noise that a set leaves, relative to the stated one.

    The weighted median over groups: it ignores the few groups in which the model itself is off. The mean
    square of a group is divided by the median expected from as many squares of noise, which is below their
    mean (Wilson & Hilferty, PNAS 17, 1931).
    """
    count = np.maximum(f.count, 1)
    energy = model.energy * np.exp(-f.shift(model.effects))
    channel, ratio = channel_of(f), energy / (count * (1 - 2 / (9 * count)) ** 3)
    out = np.ones(len(f.gap.rows.channels))
    for c in np.unique(channel):
        mine = np.flatnonzero((channel == c) & (f.count >= 8))
        if mine.size >= 3:
            order = mine[np.argsort(ratio[mine])]
            share = np.cumsum(f.count[order]) / f.count[order].sum()
            out[c] = np.sqrt(ratio[order[np.searchsorted(share, 0.5)]])
    return np.clip(out, *STATED)


def stated(rows: Rows) -> np.ndarray:
    """Standard deviation (channels,) of the noise by which rows are whitened, over the stated one."""
    out = np.ones(len(rows.channels))
    for c in np.unique(rows.channel) if rows.sd is not None else ():
        out[c] = np.sqrt(np.mean(rows.sd[rows.channel == c] ** 2))  # type: ignore[index]
    return out


def small_gap(f: Forms, by_group: np.ndarray, tolerance: np.ndarray) -> SmallGap:
    """Size of the gap relative to the tolerance, where it is largest.

    Args:
        f: Quadratic forms of the gap.
        by_group: Variance (G,) of each group's noise.
        tolerance: Smallest shift (n,) of each row that matters.
    """
    before = residual_left(f, fitted(f, ()))
    rows = f.gap.rows
    inverse = rows.place
    count = np.bincount(inverse).astype(float)
    noise = by_group[f.spectrum.group]
    excess = np.maximum(np.bincount(inverse, before**2) - np.bincount(inverse, noise), 0.0) / count
    chance = np.sqrt(2 / count) * np.bincount(inverse, noise) / count
    amount = np.sqrt(np.maximum(excess - 2 * chance, 0.0))
    sd = np.sqrt(np.bincount(inverse, np.ones(inverse.size) if rows.sd is None else rows.sd**2) / count)
    amount, least = amount * sd, np.bincount(inverse, tolerance) / count
    size = amount / least
    most = int(size.argmax())
    channel = rows.channels[rows.channel[inverse == most][0]]
    return SmallGap(float(size[most]), channel, float(amount[most]))


# chosen: probability of no or another cause above which a gap within the default tolerance is ignored
DOUBT = 0.1
EXAMINED = 6  # numerics: sets that are examined as causes


def attribute(
    gap: Gap,
    healthy: Iterable[float] = (),
    forced: tuple[str, ...] = (),
    seed: int = 0,
    heldout: bool = True,
    searched: tuple[Forms, list[Model]] | None = None,
    absorbed: np.ndarray | None = None,
) -> Attribution:
    """Attribute a gap to its candidates.

    Args:
        gap: The gap.
        healthy: Statistics of healthy recordings, drawn one by one if there is an alarm; without any the
            stated noise is the null.
        forced: Effects that act for certain; no others do.
        seed: Of the draws behind intervals.
        heldout: Whether causes must shrink the gap of held-out trials, if there are several trials.
        searched: The gap's quadratic forms and the result of `sought`, if known.
        absorbed: Shifts of the first nuisances that do not matter; None if any may be.

    Raises:
        InputError: A forced effect is not among the candidates.
    """
    rng = np.random.default_rng(seed)
    f = forms(gap) if searched is None else searched[0]
    models = sought(f) if searched is None else searched[1]
    if forced:
        models = [_forced(f, forced), *[m for m in models if not m.effects]]
    value = statistic(f, models)
    detection = detected(value)
    noise = noise_of(f, models[0])
    by_group = (noise**2)[channel_of(f)]
    # A set that needs a parameter that no hand has is none; what it has besides may be one.
    possible = models
    if not forced:
        found = {m.effects: m for m in models}
        left = dict.fromkeys(_without_absurd(f, m) for m in models)
        possible = sorted((found.get(e) or fitted(f, e) for e in left), key=lambda m: -m.score)
    ranked, others = [m.effects for m in possible if m.effects][:EXAMINED], None
    if heldout and (detection.p_value < ALARM or forced):
        others = Heldout.of(f, noise**2, (j for effects in ranked for j in effects))
    examined = {effects: _examined(f, effects, models, by_group, rng, others) for effects in ranked}
    sets = [
        _explanation(f, m.effects, float(x), examined)
        for m, x in zip(possible, weights(possible), strict=True)
    ]
    small = None
    if gap.tolerance is not None and (detection.p_value < ALARM or forced):
        small = _small(f, models[0], by_group, absorbed)

    def ignored() -> SmallGap | None:
        chance = probabilities(sets, detection.p_value)
        certain = gap.usual and chance["none"] + chance["unknown"] <= DOUBT  # can be mended
        return None if certain else small

    if detection.p_value < ALARM and ignored() is None:
        detection = detected(value, healthy)
        small = ignored() if detection.p_value < ALARM or forced else None
    first = next(iter(examined), ())
    named = _names(f, first) if forced else ()
    verdict = conclude(sets, detection.p_value, small is None, named, unseen=detection.unseen)
    causes = next((one.causes for one in examined.values() if _names(f, one.causes) == verdict.causes), ())
    causes = first if forced else causes
    model = fitted(f, causes)
    left, before = residual_left(f, model), residual_left(f, fitted(f, ()))
    sd = noise[gap.rows.channel]
    unexplained = significant(gap.rows, f.spectrum.band, left, sd)
    p_rest = detected(statistic(f, models, causes)).p_value
    explained = shares(f, model, by_group, rng)
    # If noise differs between parts a gap may show in one place but not in the total, of which no share is
    # then known: all of it remains, or nothing.
    shown = explained.before > explained.floor or verdict.verdict == "none"
    remains = explained.remainder if shown else float(p_rest < ALARM)
    shrinkage = None if others is None else others.how_far(causes)
    chance = acting(sets, detection.p_value)
    somewhere = verdict.verdict != "none" or small is not None
    return Attribution(
        **vars(verdict),
        effects=_effects(f, models, chance, examined, model),
        detection=detection,
        remainder=Remainder(remains, p_rest, unexplained),
        where=significant(gap.rows, f.spectrum.band, before, sd) if somewhere else (),
        how_far=shrinkage,
        small_gap=small,
        noise=dict(zip(gap.rows.channels, (noise * stated(gap.rows)).tolist(), strict=True)),
        models=tuple(models),
        shares=explained,
        before=before,
        left=left,
    )


def _names(f: Forms, effects: Iterable[int]) -> tuple[str, ...]:
    """Names of candidates, sorted."""
    return tuple(sorted({f.gap.candidates[j].name for j in effects}))


def _explanation(
    f: Forms, effects: tuple[int, ...], weight: float, examined: dict[tuple[int, ...], _Examined]
) -> Explanation:
    """A set as an explanation; without causes if it was not examined."""
    one = examined.get(effects)
    if one is None:
        return Explanation(_names(f, effects), weight)
    return Explanation(_names(f, effects), weight, _names(f, one.causes), one.known)


def _small(f: Forms, best: Model, by_group: np.ndarray, absorbed: np.ndarray | None) -> SmallGap | None:
    """The gap's size if it does not matter: neither residuals nor what properties absorb of it do."""
    assert f.gap.tolerance is not None
    small = small_gap(f, np.minimum(by_group, 1.0), f.gap.tolerance)
    if small.size >= 1.0:
        return None
    if absorbed is not None:
        moved = np.abs(best.x[: absorbed.size] - fitted(f, ()).x[: absorbed.size])
        if (moved > absorbed).any():
            return None
    return small


def _forced(f: Forms, names: tuple[str, ...]) -> Model:
    """The best fit of the given effects, one form of each.

    Raises:
        InputError: An effect is not among the candidates.
    """
    possible = dict.fromkeys(c.name for c in f.gap.candidates)
    for name in names:
        if name not in possible:
            raise InputError(f"effect {name!r}", "cannot act on these recordings", ", ".join(possible))
    forms_of = [[j for j, c in enumerate(f.gap.candidates) if c.name == name] for name in names]
    sets = {tuple(sorted(each)) for each in product(*forms_of)}
    return max((fitted(f, each) for each in sets), key=lambda m: m.score)


@dataclass(frozen=True)
class _Examined:
    """A set of effects examined as the cause.

    Attributes:
        model: The fitted set.
        shares: Shares of its effects.
        causes: Those effects that matter.
        known: Probability that they are the cause.
    """

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
    """Decide which effects of a set are its causes, and how probable it is that they are the cause.

    With held-out trials (`others`) a cause must predict them better than the set without it does.
    """
    model = fitted(f, effects)
    explained = shares(f, model, by_group, rng)
    scattering = {j for j in effects if not f.gap.candidates[j].parameters}
    causes = _without_spared(effects, lambda causes, j: _certainty(f, causes, j))
    if others is not None:
        causes = _predicting(others, causes)
    share = 1 - explained.remainder
    shrinkage = None if others is None else others.how_far(causes)
    if shrinkage is not None:
        share = min(share, shrinkage.fraction)
    elif others is not None and {*causes} - scattering:
        share = 0.0  # the held-out trials show no gap to explain
    sure = 0.0
    if causes and len(_without_absurd(f, fitted(f, causes))) == len(causes):
        part = explained.each.mean(0) + 1e-9
        form = np.sqrt(part @ np.square([f.gap.candidates[j].form for j in effects]) / part.sum())
        sure = known(share, detected(statistic(f, models, causes)).p_value, form)
    return _Examined(model, explained, causes, sure)


def _without_absurd(f: Forms, model: Model) -> tuple[int, ...]:
    """Effects of a set but for those of which a parameter is at a bound that no hand reaches.

    Its neutral value is possible, and times or frequencies end where recordings tell no more of them.
    """
    absurd = set[int]()
    for j, own in coordinates(f, model.effects).items():
        c = f.gap.candidates[j]
        reached = model.at_bound[own] & ~np.isclose(c.scale * model.x[own], 0.0, atol=1e-6)
        linear = np.ones(own.size, bool) if c.size is None else np.isnan(c.size)
        if (reached & linear & ~np.isin(c.parameters, c.hidden)).any():
            absurd.add(j)
    return tuple(j for j in model.effects if j not in absurd)


def _without_spared(
    causes: tuple[int, ...], worth: Callable[[tuple[int, ...], int], float]
) -> tuple[int, ...]:
    """Drop causes whose worth to the others is not positive, one at a time: two may spare each other."""
    while causes:
        each = {j: worth(causes, j) for j in causes}
        least = min(each, key=lambda j: each[j])
        if each[least] > 0:
            break
        causes = tuple(j for j in causes if j != least)
    return causes


def _predicting(others: Heldout, causes: tuple[int, ...]) -> tuple[int, ...]:
    """Drop causes without which held-out trials are predicted no worse.

    The trial that gains most does not count: an accident of one trial is no cause.
    """

    def worth(causes: tuple[int, ...], effect: int) -> float:
        rest = [j for j in causes if j != effect]
        gains = others.gains(causes, rest)
        return float(gains.sum() - gains[:-1].max()) - POSITIVE

    return _without_spared(causes, worth)


def _certainty(f: Forms, effects: tuple[int, ...], effect: int) -> float:
    """Evidence [nats] for an effect of a set beyond that at which it is needed.

    It must exceed RULED_OUT and what errors in the forms of the other effects may imitate: a share of what
    the residuals say for the set, not of evidence from other sources, divided among them by what each of them
    adds. A single effect is needed if there is a gap.
    """
    others, model = tuple(j for j in effects if j != effect), fitted(f, effects)
    if not others:
        return np.inf
    of = [f.gap.candidates[j] for j in others]

    def added(j: int) -> float:
        return model.score - fitted(f, tuple(i for i in effects if i != j)).score

    shown = model.score - fitted(f, ()).score - sum(max(c.evidence, 0.0) for c in of)
    parts = np.maximum([added(j) for j in others], np.log(RULED_OUT))
    feigned = shown * np.average([c.form for c in of], weights=parts)
    return float(added(effect) - max(np.log(RULED_OUT), feigned))


def _effects(
    f: Forms, models: list[Model], chances: dict[str, float], examined: dict[tuple[int, ...], _Examined],
    named: Model,
) -> dict[str, EffectPosterior]:  # fmt: skip
    """Posterior of every effect, from the best set that has it, else from a fit of it alone.

    Parameters of the causes are those of the causes alone (`named`): of a set that can spare some of its
    effects they would be given that those act.
    """
    out: dict[str, EffectPosterior] = {}
    forms_of: dict[str, list[int]] = {}
    for j, c in enumerate(f.gap.candidates):
        forms_of.setdefault(c.name, []).append(j)
    for name, mine in forms_of.items():
        inside = [m for m in models if {*mine} & {*m.effects}]
        examination = next((one for part, one in examined.items() if {*mine} & {*part}), None)
        share, interval = 0.0, (0.0, 0.0)
        if examination is not None:
            model = examination.model
            part = next(k for k, j in enumerate(model.effects) if j in mine)
            share, interval = examination.shares.of_effect(part)
        elif inside:
            model = inside[0]
        else:
            model = max((fitted(f, (j,)) for j in mine), key=lambda m: m.score)
        if {*mine} & {*named.effects}:
            model = named
        j = next(iter({*mine} & {*model.effects}))
        c = f.gap.candidates[j]
        own = coordinates(f, model.effects)[j]
        sd = c.scale * np.sqrt(np.diag(model.covariance)[own])
        mean = c.neutral + c.scale * model.x[own]
        wide = np.hypot(sd, c.scale * RESPONSE * share_of(f, model, j))
        if examination is not None:  # only examined sets are compared between parts
            wide = np.hypot(wide, c.scale * np.sqrt(_between(f, model, j)))
        out[name] = EffectPosterior(
            chances.get(name, 0.0), share, interval,
            {n: ParameterPosterior(float(m), float(s))
             for n, m, s in zip(c.parameters, mean, wide, strict=True)}, j)  # fmt: skip
    return out


def _between(f: Forms, model: Model, effect: int) -> np.ndarray:
    """Additional variance (k,) of scaled deviations, between trials or between channels and subtasks."""
    rows = f.gap.rows
    return np.maximum(*(scatter_between(f, model, effect, part) for part in (rows.trial, rows.place)))
