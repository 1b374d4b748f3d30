"""The verdict on a robot's logs, read off the sets that were fitted exactly.

There is a gap if some set, or a discrepancy alone, is likelier than the sensors' noise. Causes are known if
they explain most of the whole gap, of all channels together, in logs that took no part, at values that a
robot can have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simgap.attribution.attribute import Remainder
from simgap.attribution.problem import BANDS, cosines
from simgap.attribution.problem import Rows as GapRows
from simgap.attribution.search import Detection
from simgap.attribution.verdict import (
    LEAST,
    RULED_OUT,
    Cell,
    Explanation,
    Shares,
    Verdict,
    acting,
    conclude,
    known,
    significant,
)  # fmt: skip
from simgap.robot_effects.base import RobotEffect
from simgap.robots.heldout import Shrinkage
from simgap.robots.phases import Phases
from simgap.robots.search import Search, Settled, predicts_better
from simgap.robots.whiten import ALONE, Whitener

OPEN = 0.1  # chosen: share of what is left without a small cause that may be left with it
MATTERS = 1.1  # chosen: mean squares over the noise's; a smaller gap that nothing explains is told as none
SEVERAL = 3.0  # chosen: times the noise; causes that leave more, and a part of the gap, are not known
PART = 0.1  # chosen: that part


@dataclass(frozen=True)
class RobotVerdict(Verdict):
    """The verdict, and what it rests on: the gap's `detection`, what is left (`remainder`), `where` the gap
    is.

    `shares` of the whole gap by effect of `shared`; `chance` of each candidate to act; `over_noise`: rms of
    what is left in units of the noise; `stands_in`: cause to what logs do not tell from it; `doubts`: why an
    explanation that leaves little is not believed; `explanation`: the best set, known or not.
    """

    detection: Detection
    remainder: Remainder
    where: tuple[Cell, ...]
    shares: Shares
    shared: tuple[str, ...]
    chance: dict[str, float]
    over_noise: float
    stands_in: dict[str, tuple[str, ...]]
    doubts: tuple[str, ...]
    explanation: tuple[str, ...]


def verdict_on(
    search: Search, best: Settled, far: Shrinkage | None, phases: Phases, seed: int, forced: bool
) -> RobotVerdict:
    """The verdict, from the best set and all others that a search has fitted."""
    nothing = search.known[frozenset()]
    fine, floor = best.fine, best.noise * best.fine.sum()
    before, after = float(nothing.squares[fine].sum()), float(best.squares[fine].sum())
    over_noise = float(np.sqrt(after / max(floor, 1e-9)))
    without = {out: search.known.get(frozenset({*best.names} - {out})) for out in best.names}
    lost = np.array([max(float(s.squares[fine].sum()) - after, 0.0) if s else 0.0 for s in without.values()])
    shares = Shares.of(before, min(after, before), floor, lost, np.random.default_rng(seed))
    gap = _gap(best, nothing)
    large = lost >= LEAST * max(lost.sum(), 1e-12)
    open_left = max(after - floor, 0.0) + np.sqrt(2 * floor)
    large |= open_left / (open_left + np.maximum(lost, 1e-12)) <= OPEN
    causes = best.names if forced else tuple(n for n, big in zip(best.names, large, strict=True) if big)
    left = shares.remainder if far is None else max(1.0 - far.fraction, 0.0)
    doubts = _absurd(search.composed.effects, best, causes)
    if over_noise > SEVERAL and left > PART:
        doubts = (*doubts, f"{over_noise:.3g} times the noise is left")
    right = 0.0 if doubts else known(left, 1.0 - left)
    others = _alternatives(search, best)
    # What is too small to report, and its replacements, is no cause and replaces none.
    small = {*best.names} - {*causes}
    small |= {n for s in others if {*causes} <= {*s.names} for n in {*s.names} - {*causes}}
    sets = _explanations(others, best, small - {*causes}, right)
    matters = bool(causes) or before > MATTERS * floor
    verdict = conclude(
        sets, gap.p_value, matters, tuple(sorted(causes)) if forced else (), tuple(sorted(causes))
    )
    named, stands_in = verdict.causes, dict[str, tuple[str, ...]]()
    for cause in named:
        rivals = [
            {*s.causes} for s in sets if s.causes and cause not in s.causes and len(s.causes) <= len(causes)
        ]
        stands_in[cause] = tuple(sorted(set().union(*rivals) - {*causes}))
    told = verdict.verdict != "none"
    where = _where(search, nothing, phases) if told else ()
    left_where = _where(search, best, phases) if told and best.names else where
    rest = Remainder(left if named else float(told), _alone(best), left_where)
    return RobotVerdict(
        **vars(verdict), detection=gap, remainder=rest, where=where, shares=shares, shared=best.names,
        chance=dict.fromkeys(search.wanted, 0.0) | acting(sets, gap.p_value), over_noise=over_noise,
        stands_in=stands_in, doubts=doubts, explanation=best.names,
    )  # fmt: skip


def _gap(best: Settled, nothing: Settled) -> Detection:
    """A set, or a discrepancy alone, against the sensors' noise: by Markov's inequality noise makes such odds
    with a probability of their inverse at most."""
    value = max(best.score, nothing.score) - _by_noise(nothing)
    return Detection(value, float(np.exp(-max(value, 0.0))), 0.0)


def _by_noise(one: Settled) -> float:
    """Log evidence by the sensors' noise alone."""
    if not one.discrepancy:
        return one.score
    left = np.nan_to_num(one.linear.residual)
    wide = one.covariances.off_alone(one.covariances.whitener(), left)
    plain = one.covariances.whitener(None, wide)
    value = [-0.5 * float(np.sum(w(left) ** 2)) - w.half_log_det for w in (plain, one.whiten)]
    return one.score + value[0] - value[1] + ALONE * (len(wide) - len(one.wide))


def _alone(one: Settled) -> float:
    """The chance of what is left to be noise."""
    if not one.discrepancy:
        return 1.0
    return float(np.exp(-max(one.score - _by_noise(one), 0.0)))


def _alternatives(search: Search, best: Settled) -> list[Settled]:
    """Sets that are not told from the best: not ruled out by their evidence, nor, where the model is off by
    itself so that evidence of all rows is no judge of small differences, by logs that took no part."""
    out, most = [], best.squares.sum() + PART * search.known[frozenset()].squares.sum()
    for one in search.known.values():
        if one is best or {*best.names} < {*one.names}:
            continue
        alike = one.score > best.score - np.log(RULED_OUT)
        if best.discrepancy and one.names and one.squares.sum() < most:
            alike = alike or not predicts_better(search.gains(best, one, best))
        if alike:
            out.append(one)
    return out


def _explanations(
    others: Sequence[Settled], best: Settled, small: set[str], right: float
) -> list[Explanation]:
    """The sets that are left, by weight, without what is small: none weighs more than the best, for held-out
    logs do not bear out what is likelier."""
    others_score = [np.clip(s.score, best.score - np.log(RULED_OUT), best.score) for s in others]
    score = np.array([best.score, *others_score])
    weight = np.exp(score - np.logaddexp.reduce(score))
    each = [tuple(sorted({*s.names} - small)) for s in (best, *others)]
    return [
        Explanation(mine, float(w), mine, right if mine else 0.0)
        for mine, w in zip(each, weight, strict=True)
    ]


def _absurd(effects: Mapping[str, RobotEffect], best: Settled, causes: Sequence[str]) -> tuple[str, ...]:
    """Values at a bound, which no robot has; but it may have nothing of a kind of friction, say."""
    out = []
    for name in causes:
        for short, value in best.point[name].items():
            p = effects[name].parameters[short]
            at_bound = any(
                np.isfinite(b) and b not in (p.nominal, 0.0) and abs(value - b) < 1e-3 * p.sd
                for b in (p.low, p.high)
            )
            if at_bound:
                out.append(
                    f"{name} {short} {value:.3g} {p.unit}".replace(" 1", "") + " is no value of a robot's"
                )
    return tuple(out)


def _where(search: Search, one: Settled, phases: Phases) -> tuple[Cell, ...]:
    """Cells in which what a set leaves exceeds the noise."""
    composed, rows = search.composed, one.linear.rows
    whiten: Whitener = one.covariances.whitener()
    white = whiten(np.nan_to_num(one.linear.residual))
    names = tuple(r.name for r in composed.recordings)
    mine = GapRows(
        rows.log, rows.channel, phases.of(rows), rows.time, names, rows.channels, phases.names, BANDS
    )
    left, (band,) = cosines(mine, white[:, None])
    return significant(mine, band, left[:, 0], np.ones(white.size))


def repeated(log: str, separates: Sequence[str], gain: float) -> dict[str, Any] | None:
    """The next experiment, as the document has it: a log whose motion is to be repeated, the effects that it
    separates, and what it is expected to gain [nats]; None where that is less than one."""
    known = {"do": f"repeat the motion of {log}", "log": log, "separates": list(separates)}
    return known | {"expected_gain_nats": gain} if gain > 1.0 else None


def next_log(search: Search, best: Settled, verdict: RobotVerdict) -> dict[str, Any] | None:
    """For a set: of the sets that were fitted with one of its members each, the log along which the closest
    two differ most, whitened."""
    if verdict.verdict != "set":
        return None
    logs = search.composed.recordings
    gains, smallest = np.zeros(len(logs)), np.inf
    for one in search.known.values():
        if not {*one.names} & {*verdict.indistinguishable}:
            continue
        apart = best.whiten(np.nan_to_num(best.linear.residual - one.linear.residual))
        each = 0.5 * np.bincount(best.linear.rows.log, apart**2, len(logs))
        if each.sum() < smallest:
            smallest, gains = float(each.sum()), each
    at = int(gains.argmax())
    return repeated(logs[at].name, (*verdict.causes, *verdict.indistinguishable), float(gains[at]))
