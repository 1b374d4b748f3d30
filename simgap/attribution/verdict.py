"""The verdict, read off a posterior over sets of effects: none, named, a set, or unknown.

One reading for every diagnosis (of blocks, of given trials, of robots): they differ in what their sets are
fitted to, and in what each set is said to leave.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.special import expit

ALARM = 0.01  # chosen: chance of a healthy recording to be called otherwise
SOFT = 0.5  # chosen: of the p-value's logarithm, logistic: so sharply an alarm turns into a gap
MOST = 0.5  # cited: share of the gap left from which on it is unknown (the interface's definition)
WIDTH = 0.25  # chosen: of that share's logarithm, logistic
# cited: share of the whole gap of held-out trials; causes that explain less leave it unknown, wherever they
# act (the interface's definition)
MINOR = 0.3
# chosen: share of the explained gap below which an effect is a cause only if its own size says so: an error
# of a tenth in the form of the largest leaves half of that
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
        """The verdict with more effects that cannot be told from its causes."""
        partners = tuple(sorted({*self.indistinguishable, *more} - {*self.causes}))
        return replace(self, verdict="set", indistinguishable=partners) if partners else self


def conclude(
    sets: Sequence[Explanation],
    p_value: float,
    matters: bool = True,
    forced: tuple[str, ...] = (),
    chosen: tuple[str, ...] | None = None,
) -> Verdict:
    """The verdict on a gap that a healthy recording shows with a probability of `p_value`.

    `sets`: all explanations that were thought of, the empty one among them; their weights sum to one.
    `matters`: whether the gap is larger than what is tolerated. `forced` names the causes beforehand;
    `chosen` those that other data chose, instead of the likeliest.
    """
    probability = probabilities(sets, p_value if matters else 1.0)
    if forced:
        return Verdict("named", tuple(sorted(forced)), (), probability)
    if p_value >= ALARM or not matters:
        return Verdict("none", (), (), probability)
    causes = leading(sets) if chosen is None else chosen
    if probability["unknown"] > 0.5 or not causes:
        return Verdict("unknown", (), (), probability)
    return Verdict("named", causes, (), probability).beside(alike(sets, causes))


def healthy(p_value: float) -> float:
    """Probability that there is no gap."""
    return float(expit(np.log(max(p_value, 1e-300) / ALARM) / SOFT))


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


def acting(sets: Sequence[Explanation], p_value: float) -> dict[str, float]:
    """Probability of every effect of some set to act."""
    gap, out = 1 - healthy(p_value), dict[str, float]()
    for one in sets:
        for name in one.effects:
            out[name] = out.get(name, 0.0) + one.weight * gap
    return {name: min(value, 1.0) for name, value in out.items()}  # a sum of many is rounded


def known(left: float, explained: float, same: Iterable[float] = ()) -> float:
    """Probability that a set's effects are the cause: they leave little, and are the same everywhere.

    `left`: share of the gap that the set leaves where it acts, `explained`: what it explains of all of it in
    trials that took no part.
    Logistic in their logarithms. `same`: log Bayes factors of each effect, one cause against as many as there
    are parts: an effect whose parameters wander is as likely an imitation as its factor says.
    """
    most = expit(np.log(MOST / max(left, 1e-6)) / WIDTH)
    enough = expit(np.log(max(explained, 1e-6) / MINOR) / WIDTH)
    return float(most * enough * min((expit(factor) for factor in same), default=1.0))


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

    What the likeliest set of these causes has beside them, too small to be a cause, is no cause in others.
    """
    holding = [one for one in sets if {*causes} <= {*one.effects}]
    best = max(holding, key=lambda one: one.weight)
    beside, found = {*best.effects} - {*causes}, set[str]()
    for one in sets:
        mine = {*one.effects} - beside
        if one.weight * RULED_OUT > best.weight and len(mine) <= len(causes):
            found |= mine - {*causes}
    return tuple(sorted(found))
