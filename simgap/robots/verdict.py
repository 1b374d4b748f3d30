"""The verdict on a robot's logs: what held-out rows bore out, judged by what it leaves where it acts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simgap.attribution.attribute import Remainder
from simgap.attribution.heldout import residual_left
from simgap.attribution.posterior import Forms, Model, fitted
from simgap.attribution.search import Detection, detected, statistic, weights
from simgap.attribution.verdict import (
    LEAST,
    MOST,
    Cell,
    Explanation,
    Shares,
    Verdict,
    acting,
    conclude,
    known,
    significant,
)
from simgap.robots.explained import Explained
from simgap.robots.scatter import scattering
from simgap.robots.stand_ins import StandIn

OPEN = 0.1  # chosen: share of what is left without a small cause that may be left with it


@dataclass(frozen=True)
class RobotVerdict(Verdict):
    """The verdict, and what it rests on: the gap's `detection`, what is left (`remainder`), `where` the gap
    is; `left`: share of it that is left, by regime."""

    detection: Detection
    remainder: Remainder
    where: tuple[Cell, ...]
    shares: Shares
    left: dict[str, float]
    shared: tuple[str, ...]  # effects that the shares are of, in their order
    model: Model  # of all that was borne out, too small to be told or not, discrepancies whitened
    chance: dict[str, float]  # of each candidate to act
    over_noise: float  # rms of what is left, in units of the noise's
    stand_ins: tuple[StandIn, ...] = ()  # what held-out logs do not tell from a cause, each at its best


def rivals(f: Forms, causes: Sequence[int]) -> list[Model]:
    """The set of causes, those with one left out or exchanged, and none."""
    every = range(len(f.gap.candidates))
    fewer = [tuple(j for j in causes if j != out) for out in causes]
    sets = {tuple(sorted(causes)), (), *fewer}
    sets |= {tuple(sorted({*kept, j})) for kept in fewer for j in every}
    return sorted((fitted(f, effects) for effects in sorted(sets)), key=lambda m: -m.score)


def verdict_on(
    f: Forms,
    sensor: Forms,
    causes: tuple[int, ...],
    twins: Sequence[float],
    rng: np.random.Generator,
    explains: Explained,
    every: Forms,
    fold: np.ndarray,
    forced: bool = False,
    large_alone: tuple[int, ...] = (),
) -> RobotVerdict:
    """The verdict. `f`: the gap with discrepancies in its whitening, `sensor` with the sensors' noise alone;
    `causes` were borne out by held-out rows, and explain what `explains` says, in that order; `every` is the
    gap of all windows, asked or not, and has these causes among its candidates; `twins` are healthy twins'
    statistics; `fold` (n,) of each row; those of `large_alone` are no causes where they are small.

    A cause is known where it acts: in some regime (flight, rest, motion in contact) little is left of the
    channels that it moves, and the gap of these is the one that it explains. What is left in others is the
    remainder, which is told."""
    names = [c.name for c in f.gap.candidates]
    models = rivals(f, causes)
    least = open_where(explains, np.array([j not in large_alone for j in causes], bool))
    kept = causes if forced else tuple(j for j, s in zip(causes, least, strict=True) if s <= MOST)
    left = max((float(s) for j, s in zip(causes, least, strict=True) if j in kept), default=1.0)
    detection = detected(statistic(sensor, [fitted(sensor, causes), fitted(sensor, ())]), twins or None)
    sets = [
        _explanation(names, m, float(w), causes, kept, known(left, explains.gone))
        for m, w in zip(models, weights(models), strict=True)
    ]
    mine = tuple(sorted(names[j] for j in kept))
    verdict = conclude(sets, detection.p_value, forced=mine if forced else (), chosen=mine)
    rows, band, sd = every.gap.rows, every.spectrum.band, np.ones(every.gap.rows.channel.size)
    named = tuple(j for j, c in enumerate(every.gap.candidates) if c.name in verdict.causes)
    gap = verdict.verdict != "none"
    parts = explains.shares(rng)
    return RobotVerdict(
        **vars(verdict),
        detection=detection,
        remainder=Remainder(
            parts.remainder if named else float(gap),
            detected(statistic(every, [fitted(every, named)], named)).p_value,
            significant(rows, band, residual_left(every, fitted(every, named)), sd) if gap else (),
        ),
        where=significant(rows, band, residual_left(every, fitted(every, ())), sd) if gap else (),
        shares=replace(parts, each=parts.each[:, [causes.index(j) for j in kept]]),
        left=dict(zip(explains.regimes, explains.left.tolist(), strict=True)) if named else {},
        shared=tuple(names[j] for j in kept),
        model=scattering(f, fitted(f, causes), fold),
        chance=dict.fromkeys(names, 0.0) | acting(sets, detection.p_value),
        over_noise=explains.over_noise,
    )


def open_where(explains: Explained, small_too: np.ndarray) -> np.ndarray:
    """Share (J,) of its gap that is left where each cause acts, 1 where it is too small to be told;
    `small_too` (J,): which may be told though they are small.

    Where most of a gap is left, what a cause takes of it may stand in for anything: no cause rests on it. A
    small one may stand in for an error in the form of a large one, unless it takes nearly all that there is
    besides: what stands in leaves much."""
    large = (explains.part >= LEAST) | (small_too[:, None] & (explains.open_without <= OPEN))
    return np.where(large, explains.where_it_acts, 1.0).min(1) if small_too.size else np.zeros(0)


def _explanation(
    names: Sequence[str], model: Model, weight: float, borne: tuple[int, ...], kept: tuple[int, ...],
    chance: float,
) -> Explanation:  # fmt: skip
    """A set as the verdict sees it: `chance` to be the cause, `kept` of those `borne` out are told."""
    # What takes the place of an effect that is too small to be told is none of the causes either.
    holds = bool(kept) and {*kept} <= {*model.effects}
    causes = kept if holds else {*model.effects} - ({*borne} - {*kept})
    named = tuple(sorted(names[j] for j in causes))
    return Explanation(tuple(names[j] for j in model.effects), weight, named, chance if kept else 0.0)
