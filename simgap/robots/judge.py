"""The verdict on a robot's logs: none, named, a set, or unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from simgap.attribution.attribute import ALARM
from simgap.attribution.cells import Cell, significant
from simgap.attribution.detection import Detection, statistic
from simgap.attribution.posterior import Forms, Model, fitted
from simgap.attribution.shares import Shares
from simgap.attribution.verdict import LEAST, MOST, WIDTH
from simgap.robots.borne_out import BORNE_OUT, chance_of_gain
from simgap.robots.explained import Explained

RIVALS = 8  # numerics: sets that are compared on held-out rows
TWENTY = 20.0  # chosen: to one: odds from which on a rival is ruled out


@dataclass(frozen=True)
class Verdict:
    """What was found; `models` and `weights` are the sets compared, `noise` 1 as whitened by sensors."""

    verdict: str
    causes: tuple[str, ...]
    indistinguishable: tuple[str, ...]
    probabilities: dict[str, float]
    detection: Detection
    remainder: float
    where: tuple[Cell, ...]
    remainder_where: tuple[Cell, ...]
    shares: Shares
    left: dict[str, float]  # share of the gap that is left, by regime
    shared: tuple[str, ...]  # effects that the shares are of, in their order
    model: Model  # of all that was borne out, too small to be told or not, discrepancies whitened
    chance: dict[str, float]  # of each candidate to act


def rivals(f: Forms, causes: Sequence[int]) -> list[Model]:
    """The set of causes, those with one left out or exchanged, and none."""
    every = range(len(f.gap.candidates))
    fewer = [tuple(j for j in causes if j != out) for out in causes]
    sets = {tuple(sorted(causes)), (), *fewer}
    sets |= {tuple(sorted({*kept, j})) for kept in fewer for j in every}
    return sorted((fitted(f, effects) for effects in sorted(sets)), key=lambda m: -m.score)


def judge(
    f: Forms,
    sensor: Forms,
    causes: tuple[int, ...],
    twins: Sequence[float],
    rng: np.random.Generator,
    told_by: Explained,
    every: Forms,
    forced: bool = False,
    fold: np.ndarray | None = None,
) -> Verdict:
    """The verdict. `f`: the gap with discrepancies in its whitening, `sensor` with the sensors' noise alone;
    `causes` were borne out by held-out rows, and explain what `told_by` says, in that order; `every` is the
    gap of all windows, asked or not, and has these causes among its candidates; `twins` are healthy twins'
    statistics.

    A cause is known where it acts: in some regime (flight, rest, motion in contact) little is left of the
    channels that it moves. What is left in others is the remainder, which is told."""
    gap = f.gap
    models = rivals(f, causes)
    score = np.array([m.score for m in models])
    weight = np.exp(score - np.logaddexp.reduce(score))
    value = statistic(sensor, [fitted(sensor, causes), fitted(sensor, ())])
    p = float(np.exp(min(0.0, -value)))
    exceed = sum(t >= value for t in twins)
    p = max(p, exceed / len(twins)) if twins else p
    detection = Detection(value, p, 1 / (len(twins) + 1) if twins else 0.0)
    # Where most of a gap is left, what a cause takes of it may stand in for anything: no cause rests on it.
    least = np.where(told_by.part >= LEAST, told_by.where_it_acts, 1.0).min(1) if causes else np.zeros(0)
    kept = causes if forced else tuple(j for j, s in zip(causes, least, strict=True) if s <= MOST)
    parts = told_by.shares([causes.index(j) for j in kept], rng)
    left = max((float(s) for j, s in zip(causes, least, strict=True) if j in kept), default=1.0)
    none = float(expit((np.log(max(p, 1e-300)) - np.log(ALARM)) / 0.5))
    known = float(expit(np.log(MOST / max(left, 1e-6)) / WIDTH)) if kept else 0.0
    name = lambda effects: tuple(sorted(gap.candidates[j].name for j in effects))  # noqa: E731
    small = set(causes) - set(kept)
    likely: dict[str, float] = {}
    nothing = 0.0
    for m, w in zip(models, weight, strict=True):
        # What takes the place of an effect that is too small to be told is none of the causes either.
        mine = kept if kept and set(kept) <= set(m.effects) else tuple(set(m.effects) - small)
        if mine:
            key = "+".join(name(mine))
            likely[key] = likely.get(key, 0.0) + float(w)
        else:
            nothing += float(w)
    probabilities = {"none": none, "unknown": (1 - none) * (nothing + (1 - nothing) * (1 - known))}
    probabilities |= {k: (1 - none) * known * v for k, v in likely.items() if (1 - none) * known * v > 1e-4}
    probabilities["other"] = max(0.0, 1.0 - sum(probabilities.values()))
    verdict, partners = "none", ()
    if forced:
        verdict = "named"
    elif p < ALARM:
        verdict = "unknown"
        if kept:
            partners = _partners(models, causes, kept)
            if fold is not None:
                partners = tuple(sorted({*partners, *_not_told_apart(f, models, causes, kept, fold)}))
            verdict = "set" if partners else "named"
    told = kept if verdict in ("named", "set") else ()
    noise, rows, band = np.ones(len(gap.rows.channels)), every.gap.rows, every.spectrum.band
    before = _left(every, ())
    number = {c.name: j for j, c in enumerate(every.gap.candidates)}
    after = _left(every, tuple(sorted(number[gap.candidates[j].name] for j in told)))
    chance = {
        c.name: float(sum(w for m, w in zip(models, weight, strict=True) if j in m.effects)) * (1 - none)
        for j, c in enumerate(gap.candidates)
    }
    return Verdict(
        verdict,
        name(told),
        name(partners),
        probabilities,
        detection,
        parts.remainder if told else 1.0,
        significant(rows, band, before, noise[rows.channel]) if verdict != "none" else (),
        significant(rows, band, after, noise[rows.channel]) if verdict != "none" else (),
        parts,
        dict(zip(told_by.regimes, told_by.left.tolist(), strict=True)) if told else {},
        tuple(gap.candidates[j].name for j in kept),
        fitted(f, causes),
        chance,
    )


def _partners(models: Sequence[Model], causes: tuple[int, ...], told: tuple[int, ...]) -> tuple[int, ...]:
    """Effects that take the place of a cause that is told in sets one in twenty as likely or more."""
    best = next(m.score for m in models if m.effects == causes)
    found: set[int] = set()
    for m in models:
        gone = set(causes) - set(m.effects)
        if gone and gone <= set(told) and m.score > best - np.log(TWENTY):
            found |= set(m.effects) - set(causes)
    return tuple(sorted(found))


def _not_told_apart(
    f: Forms, models: Sequence[Model], causes: tuple[int, ...], told: tuple[int, ...], fold: np.ndarray
) -> set[int]:
    """Effects that take a told cause's place and that held-out rows do not tell from it, though all rows
    together seem to: where the model is off by itself, its likelihood is no judge of small differences."""
    best = next(m for m in models if m.effects == causes)
    found: set[int] = set()
    rivals_of = [
        m for m in models if len(set(causes) - set(m.effects)) == 1 and len(m.effects) == len(causes)
    ]
    for m in [m for m in rivals_of if set(causes) - set(m.effects) <= set(told)][:RIVALS]:
        apart = log_prior(f, m) - log_prior(f, best)
        if apart > -np.log(TWENTY) and chance_of_gain(f.gap, causes, m.effects, fold) > BORNE_OUT:
            found |= set(m.effects) - set(causes)
    return found


def log_prior(f: Forms, model: Model) -> float:
    """Log prior of a set's parameters at its mode, constants left out (Cauchy; see `Candidate`)."""
    at, out = f.gap.nuisance.shape[1], 0.0
    for j in model.effects:
        k = f.gap.candidates[j].at.size
        x = model.x[at : at + k]
        out -= 0.5 * (1 + k) * float(np.log1p(x @ x))
        at += k
    return out


def _left(f: Forms, effects: tuple[int, ...]) -> np.ndarray:
    """Residual cosines (n,) that a set leaves."""
    from simgap.attribution.invariance import residual_left

    return residual_left(f, fitted(f, effects))
