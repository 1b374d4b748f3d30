"""The verdict from a posterior over sets of effects: none, named, a set, or unknown.

All diagnoses (of blocks, of given trials, of robots) share these rules; they differ in the data their sets
are fitted to.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import expit
from scipy.stats import chi2, false_discovery_control, norm

from simgap.attribution.posterior import Forms, Model, squares_left
from simgap.attribution.problem import MODELLED, Rows
from simgap.attribution.search import Detection

ALARM = 0.01  # chosen: probability that a healthy recording raises an alarm
# learned: share of named sets that were right, and of their causes that act, over their mean probability
# (`experiments.gap_drawn`, seeds 271801 to 271911: 52 of 64 sets, 71 of 124 effects): what the catalogue
# lacks passes for what it has, with no sign of it
RECORD = 0.82
# chosen: negligible share of the gap; an error of a tenth in a form leaves half of it
LEAST = 0.02
RULED_OUT = 20.0  # chosen: odds against a set at which it is no alternative
LISTED = 1e-4  # look: sets below this probability are summed up as others


@dataclass(frozen=True)
class Explanation:
    """A set of effects as an explanation of the gap.

    Attributes:
        effects: Names of all its effects.
        weight: Posterior probability of the set.
        causes: Those effects that matter.
        known: Probability that they are the cause if the set is right.
    """

    effects: tuple[str, ...]
    weight: float
    causes: tuple[str, ...] = ()
    known: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """The verdict on a gap.

    Attributes:
        verdict: none, named, set or unknown.
        causes: The named effects.
        indistinguishable: Effects that may act in place of a cause.
        probabilities: Of none, unknown and every set of causes; they sum to one.
    """

    verdict: str
    causes: tuple[str, ...]
    indistinguishable: tuple[str, ...]
    probabilities: dict[str, float]


def conclude(
    sets: Sequence[Explanation],
    p_value: float,
    matters: bool = True,
    forced: tuple[str, ...] = (),
    chosen: tuple[str, ...] | None = None,
    unseen: float = 0.0,
    record: float = RECORD,
) -> Verdict:
    """Read the verdict on a gap off a posterior over sets of effects.

    Args:
        sets: all explanations considered, the empty one included; their weights sum to one.
        p_value: probability of a healthy recording to show such a gap.
        matters: whether the gap is larger than what is tolerated.
        forced: causes given beforehand.
        chosen: causes that other data chose, in place of the likeliest.
        unseen: probability of a gap where there is no alarm.
        record: how often a set that explains a gap is right, over its probability.

    Returns:
        The verdict; its probabilities are calibrated.
    """
    within = probabilities(sets, p_value if matters else 1.0)
    probability = calibrated(within, unseen, record)
    if forced:
        return Verdict("named", tuple(sorted(forced)), (), probability)
    if p_value >= ALARM or not matters:
        return Verdict("none", (), (), probability)
    causes = leading(sets) if chosen is None else chosen
    if within["unknown"] > 0.5 or not causes:
        return Verdict("unknown", (), (), probability)
    partners = alike(sets, causes)
    return Verdict("set" if partners else "named", causes, partners, probability)


def calibrated(within: Mapping[str, float], unseen: float, record: float) -> dict[str, float]:
    """Calibrate probabilities that assume the catalogue to be complete.

    An explanation is right as often as the method's record says, and a recording without an alarm hides a gap
    with probability `unseen`; the rest is `unknown`.
    """
    out = {name: p * (1 - unseen if name == "none" else record) for name, p in within.items()}
    out["unknown"] = 0.0
    out["unknown"] = max(1 - sum(out.values()), 0.0)
    return out


def healthy(p_value: float) -> float:
    """Probability that there is no gap; one half at the p-value that raises the alarm."""
    return float(expit(np.log(max(p_value, 1e-300) / ALARM)))


def probabilities(sets: Sequence[Explanation], p_value: float) -> dict[str, float]:
    """Probabilities of none, unknown, and every set of causes (names joined by +); they sum to one.

    Sets whose causes are not the cause, and the empty set, count as unknown.
    """
    none = healthy(p_value)
    out = {"none": none, "unknown": 0.0}
    for one in sets:
        right = one.known if one.causes else 0.0
        out["unknown"] += one.weight * (1 - right) * (1 - none)
        if right > 0:
            name = "+".join(one.causes)
            out[name] = out.get(name, 0.0) + one.weight * right * (1 - none)
    kept = {n: v for n, v in out.items() if v >= LISTED or n in ("none", "unknown")}
    kept["other"] = sum(v for n, v in out.items() if n not in kept)
    total = sum(kept.values())
    return {name: value / total for name, value in kept.items()}


def log_odds(chances: Iterable[float]) -> float:
    """Posterior log odds [nats] that several effects act, from the least of their probabilities."""
    chance = float(np.clip(min(chances, default=0.0), 1e-12, 1 - 1e-12))
    return float(np.log(chance / (1 - chance)))


def acting(sets: Sequence[Explanation], p_value: float, record: float = RECORD) -> dict[str, float]:
    """Calibrated probability that each effect acts: that of the explanations of which it is a cause.

    Args:
        sets: All explanations considered; their weights sum to one.
        p_value: Probability of a healthy recording to show such a gap.
        record: How often a set that explains a gap is right, over its probability.
    """
    gap, out = record * (1 - healthy(p_value)), dict[str, float]()
    for one in sets:
        for name in one.causes:
            out[name] = out.get(name, 0.0) + one.weight * one.known * gap
    return {name: min(value, 1.0) for name, value in out.items()}  # rounding of the sum


def known(explained: float, p_rest: float = 0.0, form: float = MODELLED) -> float:
    """Probability that a set's effects are the cause, from the share of the gap that they leave.

    If they are, what is left is as large as their forms are wrong: its amplitude over the gap's has a
    half-Cauchy distribution of scale `form`. What the catalogue lacks and they imitate leaves any share
    alike.

    Args:
        explained: Share of the gap that the set explains, also on held-out trials.
        p_rest: Probability that what is left is noise.
        form: Usual relative error of the effects' forms.
    """
    left = np.sqrt(max(1 - explained, 0.0))
    right = RECORD * 2 / (np.pi * form * (1 + (left / form) ** 2))
    imitated = (1 - RECORD) * 2 * left
    return float(1 - (1 - healthy(p_rest)) * imitated / (right + imitated))


def leading(sets: Sequence[Explanation]) -> tuple[str, ...]:
    """The likeliest causes, summed over all sets that have just these.

    A subset of them is preferred if it is not ruled out.
    """
    chance: dict[tuple[str, ...], float] = {}
    for one in sets:
        if one.causes:
            chance[one.causes] = chance.get(one.causes, 0.0) + one.known * one.weight
    best = max(chance, key=lambda causes: chance[causes], default=())
    enough = [c for c, value in chance.items() if {*c} <= {*best} and value * RULED_OUT > chance[best]]
    return min(enough, key=lambda c: (len(c), -chance[c]), default=())


def alike(sets: Sequence[Explanation], causes: tuple[str, ...]) -> tuple[str, ...]:
    """Effects that replace a cause in sets that are no larger and not ruled out.

    Effects of the likeliest set that are too small to be causes are no causes in other sets either.
    """
    holding = [one for one in sets if {*causes} <= {*one.effects}]
    best = max(holding, key=lambda one: one.weight)
    small, partners = {*best.effects} - {*causes}, set[str]()
    for one in sets:
        large = {*one.effects} - small
        if one.weight * RULED_OUT > best.weight and len(large) <= len(causes):
            partners |= large - {*causes}
    return tuple(sorted(partners))


# What share of the gap each effect of a set explains, and what is left: squares in excess of the noise.

DRAWS = 200  # numerics: draws of the posterior, for intervals


@dataclass(frozen=True)
class Shares:
    """Shares of the gap by effect.

    Attributes:
        before, after: Squares of the residual with nuisances alone, and with the set.
        floor: Squares of the noise.
        each: Draws (D, J) of the share that each of the set's effects explains.
    """

    before: float
    after: float
    floor: float
    each: np.ndarray

    @classmethod
    def of(
        cls, before: float, after: float, floor: float, lost: np.ndarray, rng: np.random.Generator
    ) -> Shares:
        """Divide the explained share in proportion to the squares `lost` (J,) by leaving each effect out.

        Shares and remainder sum to one. The noise of the squares gives the intervals.
        """
        part = lost / max(float(lost.sum()), 1e-12)
        scatter = np.sqrt(2 * floor + 4 * max(after - floor, 0.0))
        drawn = after + scatter * rng.standard_normal(DRAWS)
        explained = np.clip((before - drawn) / max(before - floor, 1e-9), 0.0, 1.0)
        return cls(before, after, floor, explained[:, None] * part)

    @property
    def remainder(self) -> float:
        """Share of the gap that the set leaves."""
        return float(np.clip((self.after - self.floor) / max(self.before - self.floor, 1e-9), 0.0, 1.0))

    def of_effect(self, k: int) -> tuple[float, tuple[float, float]]:
        """Share of the k-th effect, and its 90 % interval."""
        low, high = np.percentile(self.each[:, k], (5, 95))
        return float(self.each[:, k].mean()), (float(low), float(high))


def shares(f: Forms, model: Model, noise: np.ndarray, rng: np.random.Generator) -> Shares:
    """Compute the shares of a set's effects; `noise` (G,) is the variance of each group's noise."""
    weight, floor = 1 / noise, float(f.count.sum()) + f.spectrum.num_nuisances

    def left(effects: tuple[int, ...], x: np.ndarray | None = None) -> float:
        return float(squares_left(f, effects, weight, x).sum())

    before = left(())
    after = min(left(model.effects, model.x), before)
    lost = [max(left(tuple(j for j in model.effects if j != out)) - after, 0.0) for out in model.effects]
    return Shares.of(before, after, floor, np.array(lost), rng)


# Where the gap lies: excess squares by trial, channel, part and band, with control of false discoveries.

RATE = 0.05  # chosen: share of false discoveries among the listed cells


@dataclass(frozen=True)
class Cell:
    """A cell that shows a gap: its `share` of the excess squares, and the excess as a normal score `z`."""

    trial: str
    channel: str
    part: str
    band: tuple[float, float]
    share: float
    z: float


def tallied(
    rows: Rows, band: np.ndarray, left: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum the squares of each cell and band.

    Args:
        rows: What each row is.
        band: Band (n,) of each coefficient.
        left: Cosine coefficients (n,) of a residual.
        noise: Their standard deviation (n,).

    Returns:
        Numbers of the cells (c,), squares in units of the noise (c,), and counts (c,).
    """
    key, inverse = np.unique(rows.cell * len(rows.bands) + band, return_inverse=True)
    square = (left / noise) ** 2
    return key, np.bincount(inverse, square), np.bincount(inverse).astype(float)


def _step(rows: Rows) -> float:
    """Median time step [s] between rows of a cell; infinite if no cell has two."""
    steps = np.concatenate([np.diff(rows.time[mine]) for mine in rows.by_cell()])
    return float(np.median(steps)) if steps.size else np.inf


def significant(rows: Rows, band: np.ndarray, left: np.ndarray, noise: np.ndarray) -> tuple[Cell, ...]:
    """Cells whose squares exceed the noise (Benjamini & Hochberg, JRSS B 57, 1995), largest share first.

    A long cell shows a gap that is a fraction of a sample's noise; such cells are listed only if no cell's
    gap is as large as the noise, in mean square over its samples.
    """
    key, energy, count = tallied(rows, band, left, noise)
    chance = np.asarray(chi2.sf(energy, count))
    shown = false_discovery_control(np.clip(chance, 0, 1), method="bh") < RATE
    excess = np.where(shown, energy - count, 0.0)
    _, cell = np.unique(key // len(rows.bands), return_inverse=True)
    large = shown & (np.bincount(cell, excess) >= np.bincount(cell, count))[cell]
    listed = np.flatnonzero(large if large.any() else shown)
    total = max(float(excess[listed].sum()), 1e-12)
    edges = (*rows.bands, 0.5 / _step(rows))
    out = []
    for at in listed:
        cell, b = divmod(int(key[at]), len(rows.bands))
        cell, part = divmod(cell, len(rows.parts))
        trial, channel = divmod(cell, len(rows.channels))
        # beyond the smallest representable probability
        z = float(norm.isf(chance[at]) if chance[at] > 1e-300 else np.sqrt(2 * excess[at] / 2 + 37**2))
        out.append(Cell(rows.trials[trial], rows.channels[channel], rows.parts[part],
                        (edges[b], edges[b + 1]), float(excess[at]) / total, z))  # fmt: skip
    return tuple(sorted(out, key=lambda c: -c.share))


# The entries of the JSON document that all diagnoses share.

Entries = list[dict[str, Any]]


def entries(
    verdict: Verdict,
    detection: Detection,
    remainder: tuple[float, float | None, Entries],
    attribution: Mapping[str, tuple[float, float, tuple[float, float]]],
    where: Entries,
) -> dict[str, Any]:
    """Assemble verdict, detection, remainder, attribution and cells of the document.

    Args:
        verdict: The verdict.
        detection: The test for a gap.
        remainder: Share, p-value and cells of what is unexplained.
        attribution: Probability, share of the gap and its 90 % interval for each effect.
        where: Cells of the gap; left out if there is none that matters.
    """
    gap = verdict.verdict != "none"
    share, p_value, places = remainder
    return {
        "verdict": verdict.verdict,
        "causes": list(verdict.causes),
        "indistinguishable": list(verdict.indistinguishable),
        "probabilities": verdict.probabilities,
        "detection": {
            "p_value": detection.p_value,
            "statistic": detection.statistic,
            "resolution": detection.resolution,
        },
        "remainder": {"share": share, "p_value": p_value, "where": places if gap else []},
        "attribution": {
            name: {"probability": chance, "share": share, "interval_90": list(interval)}
            for name, (chance, share, interval) in sorted(attribution.items(), key=lambda item: -item[1][0])
        },
        "where": where if gap else [],
    }  # fmt: skip


def rows(cells: Iterable[Cell]) -> Entries:
    """Cells as entries of the document."""
    return [
        {"trial": c.trial, "channel": c.channel, "subtask": c.part,
         "band": list(c.band), "share": c.share, "z": c.z}
        for c in cells
    ]  # fmt: skip
