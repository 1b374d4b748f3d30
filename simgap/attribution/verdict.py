"""The verdict, read off a posterior over sets of effects: none, named, a set, or unknown.

One reading for every diagnosis (of blocks, of given trials, of robots): they differ in what their sets are
fitted to, and in what each set is said to leave.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy.special import expit
from scipy.stats import chi2, false_discovery_control, norm

from simgap.attribution.posterior import Forms, Model, squares_left
from simgap.attribution.problem import Rows
from simgap.attribution.search import Detection

ALARM = 0.01  # chosen: chance of a healthy recording to be called otherwise
# learned: share of named sets that were right over their mean probability (`experiments.gap_drawn`, 53 named
# of seeds 271171 and 271211): what the catalogue lacks passes for what it has, with no sign of it
RECORD = 0.71
MOST = 0.5  # cited: share of the gap left from which on it is unknown (the interface's definition)
WIDTH = 0.25  # chosen: of that share's logarithm, logistic
# chosen: share of the gap that is nothing next to the rest: an error of a tenth in a form leaves half of that
LEAST = 0.02
RULED_OUT = 20.0  # chosen: odds against a set from which on it is no alternative
LISTED = 1e-4  # look: probability below which a set is one of the others

V = TypeVar("V", bound="Verdict")


@dataclass(frozen=True)
class Explanation:
    """One set of `effects`, by name: `weight`, its posterior probability; `causes`, those of them that
    matter; `known`, the probability that these are the cause, should the set be right."""

    effects: tuple[str, ...]
    weight: float
    causes: tuple[str, ...] = ()
    known: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """`verdict`: none, named, set or unknown; its `causes`, and effects `indistinguishable` from them;
    `probabilities` of none, unknown and every set of causes, which sum to one."""

    verdict: str
    causes: tuple[str, ...]
    indistinguishable: tuple[str, ...]
    probabilities: dict[str, float]

    def beside(self: V, more: Iterable[str]) -> V:
        """The verdict with more effects that cannot be distinguished from its causes."""
        partners = tuple(sorted({*self.indistinguishable, *more} - {*self.causes}))
        return replace(self, verdict="set", indistinguishable=partners) if partners else self


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
    return Verdict("named", causes, (), probability).beside(alike(sets, causes))


def calibrated(within: Mapping[str, float], unseen: float, record: float) -> dict[str, float]:
    """Probabilities as often right as they say, from those within the catalogue.

    A set that explains a gap is right as often as the method's record says, and a recording without an alarm
    may hide a gap with a probability of `unseen`; both leave their rest to `unknown`.
    """
    out = {name: p * (1 - unseen if name == "none" else record) for name, p in within.items()}
    out["unknown"] = 0.0
    out["unknown"] = max(1 - sum(out.values()), 0.0)
    return out


def healthy(p_value: float) -> float:
    """Probability that there is no gap: as likely as one where the alarm is raised."""
    return float(expit(np.log(max(p_value, 1e-300) / ALARM)))


def probabilities(sets: Sequence[Explanation], p_value: float) -> dict[str, float]:
    """Of none, unknown and every set of causes, joined by +; they sum to one. What a set is not known to
    explain, and what the empty set has, is unknown."""
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
    """Log posterior odds [nats] of several effects to act, by the least of their probabilities."""
    chance = float(np.clip(min(chances, default=0.0), 1e-12, 1 - 1e-12))
    return float(np.log(chance / (1 - chance)))


def acting(sets: Sequence[Explanation], p_value: float) -> dict[str, float]:
    """Probability of every effect of some set to act."""
    gap, out = 1 - healthy(p_value), dict[str, float]()
    for one in sets:
        for name in one.effects:
            out[name] = out.get(name, 0.0) + one.weight * gap
    return {name: min(value, 1.0) for name, value in out.items()}  # a sum of many is rounded


def known(left: float, explained: float, p_rest: float = 0.0) -> float:
    """Probability that a set's effects are the cause: they leave little.

    `left`: share of the gap that the set leaves where it acts, `explained`: what it explains of all of it in
    trials that took no part. Logistic in the logarithm of the larger share that is left, as far as anything
    is: `p_rest` is the chance of noise to look like what is left, for of a small gap no share is certain.
    """
    most = expit(np.log(MOST / max(left, 1 - explained, 1e-6)) / WIDTH)
    return float(1 - (1 - healthy(p_rest)) * (1 - most))


def leading(sets: Sequence[Explanation]) -> tuple[str, ...]:
    """The causes that are likeliest by all sets that have just these; fewer of them where doing without the
    others is not ruled out."""
    chance: dict[tuple[str, ...], float] = {}
    for one in sets:
        if one.causes:
            chance[one.causes] = chance.get(one.causes, 0.0) + one.known * one.weight
    best = max(chance, key=lambda causes: chance[causes], default=())
    enough = [c for c, value in chance.items() if {*c} <= {*best} and value * RULED_OUT > chance[best]]
    return min(enough, key=lambda c: (len(c), -chance[c]), default=())


def alike(sets: Sequence[Explanation], causes: tuple[str, ...]) -> tuple[str, ...]:
    """Effects that take a cause's place in sets no larger that are not ruled out.

    Effects of the likeliest set that are too small to be causes are no causes in others either.
    """
    holding = [one for one in sets if {*causes} <= {*one.effects}]
    best = max(holding, key=lambda one: one.weight)
    beside, found = {*best.effects} - {*causes}, set[str]()
    for one in sets:
        mine = {*one.effects} - beside
        if one.weight * RULED_OUT > best.weight and len(mine) <= len(causes):
            found |= mine - {*causes}
    return tuple(sorted(found))


# What share of the gap each effect of a set explains, and what is left: squares, the noise's taken off.

DRAWS = 200  # numerics: of the posterior, for intervals


@dataclass(frozen=True)
class Shares:
    """`before`: squares of the residual with nuisances alone fitted, `after`: with the set, `floor`: the
    noise's own. `each`: draws (D, J of the set) of the share that each effect explains by itself. `inside`:
    share that is left where the set itself shifts anything."""

    before: float
    after: float
    floor: float
    each: np.ndarray
    inside: float

    @classmethod
    def of(
        cls, before: float, after: float, floor: float, lost: np.ndarray, rng: np.random.Generator,
        inside: float = 1.0,
    ) -> Shares:  # fmt: skip
        """Each effect has what is `lost` (J,) by leaving it out, in proportion: they and the remainder sum to
        one. Noise around what is left, and around what there was, makes the interval."""
        part = lost / max(float(lost.sum()), 1e-12)
        scatter = np.sqrt(2 * floor + 4 * max(after - floor, 0.0))
        drawn = after + scatter * rng.standard_normal(DRAWS)
        explained = np.clip((before - drawn) / max(before - floor, 1e-9), 0.0, 1.0)
        return cls(before, after, floor, explained[:, None] * part, inside)

    @property
    def remainder(self) -> float:
        """Share of the gap that the set leaves."""
        return float(np.clip((self.after - self.floor) / max(self.before - self.floor, 1e-9), 0.0, 1.0))

    def of_effect(self, k: int) -> tuple[float, tuple[float, float]]:
        """The share of the k-th effect, and its 90 % interval."""
        low, high = np.percentile(self.each[:, k], (5, 95))
        return float(self.each[:, k].mean()), (float(low), float(high))


def shares(f: Forms, model: Model, noise: np.ndarray, rng: np.random.Generator) -> Shares:
    """Shares of a set's effects; `noise` (G,): variance of each group's noise."""
    weight, count = 1 / noise, np.append(f.count, f.spectrum.num_nuisances)
    floor, by_group = float(count.sum()), squares_left(f, (), weight)
    before = float(by_group.sum())
    if not model.effects:
        return Shares(before, before, floor, np.zeros((DRAWS, 0)), 1.0)
    at_mode = squares_left(f, model.effects, weight, model.x)
    at_best = squares_left(f, model.effects, weight)
    rest = min(at_mode, at_best, key=lambda squares: float(squares.sum()))
    after = min(float(rest.sum()), before)
    lost = np.array([
        max(float(squares_left(f, tuple(j for j in model.effects if j != out), weight).sum()) - after, 0.0)
        for out in model.effects
    ])  # fmt: skip
    gone = np.maximum(by_group - at_mode, 0.0)
    left = np.clip((at_mode - count) / np.maximum(by_group - count, np.sqrt(2 * count + 1)), 0.0, 1.0)
    inside = float(gone @ left / gone.sum()) if gone.sum() > 0 else 1.0
    return Shares.of(before, after, floor, lost, rng, inside)


# Where the gap lies: excess of squares by trial, channel, part and band, false discoveries controlled.

RATE = 0.05  # chosen: share of false discoveries among the cells that are listed


@dataclass(frozen=True)
class Cell:
    """One cell that shows a gap: its `share` of the excess square, and its excess as a normal score `z`."""

    trial: str
    channel: str
    part: str
    band: tuple[float, float]
    share: float
    z: float


def tallied(
    rows: Rows, band: np.ndarray, left: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers (c,), squares in units of the noise (c,) and counts (c,) of the cells with each a band.

    `left` (n,): cosine coefficients of a residual; `noise` (n,): their standard deviation.
    """
    key, inverse = np.unique(rows.cell * len(rows.bands) + band, return_inverse=True)
    square = (left / noise) ** 2
    return key, np.bincount(inverse, square), np.bincount(inverse).astype(float)


def _step(rows: Rows) -> float:
    """Usual time [s] from row to row of a cell; infinite where no cell has two."""
    order = np.argsort(rows.cell, kind="stable")
    step = np.diff(rows.time[order])[np.diff(rows.cell[order]) == 0]
    return float(np.median(step)) if step.size else np.inf


def significant(rows: Rows, band: np.ndarray, left: np.ndarray, noise: np.ndarray) -> tuple[Cell, ...]:
    """Cells whose squares exceed the noise's, largest share first (Benjamini & Hochberg, JRSS B 57, 1995)."""
    key, energy, count = tallied(rows, band, left, noise)
    chance = chi2.sf(energy, count)
    listed = np.flatnonzero(false_discovery_control(np.clip(chance, 0, 1), method="bh") < RATE)
    excess = np.maximum(energy - count, 0.0)
    total = max(float(excess[listed].sum()), 1e-12)
    edges = (*rows.bands, 0.5 / _step(rows))
    out = []
    for at in listed:
        cell, b = divmod(int(key[at]), len(rows.bands))
        cell, part = divmod(cell, len(rows.parts))
        trial, channel = divmod(cell, len(rows.channels))
        # log sf keeps what is far beyond the smallest number
        z = float(norm.isf(chance[at])) if chance[at] > 1e-300 else float(np.sqrt(2 * excess[at] / 2 + 37**2))
        out.append(Cell(rows.trials[trial], rows.channels[channel], rows.parts[part],
                        (edges[b], edges[b + 1]), float(excess[at]) / total, z))  # fmt: skip
    return tuple(sorted(out, key=lambda c: -c.share))


# What every diagnosis says of a gap, as entries of the JSON document.

Entries = list[dict[str, Any]]


def entries(
    verdict: Verdict,
    detection: Detection,
    remainder: tuple[float, float | None, Entries],
    attribution: Mapping[str, tuple[float, float, tuple[float, float]]],
    where: Entries,
) -> dict[str, Any]:
    """Verdict, detection, remainder (share, p-value, where), every effect's probability, share of the
    gap and its 90 % interval, and where. A gap that is none, or does not matter, lies nowhere."""
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
    """Cells as the document lists them."""
    return [
        {"trial": c.trial, "channel": c.channel, "subtask": c.part,
         "band": list(c.band), "share": c.share, "z": c.z}
        for c in cells
    ]  # fmt: skip
