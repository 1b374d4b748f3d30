"""The verdict on a robot's logs, from the sets of effects that were fitted exactly.

There is a gap if some set, or a discrepancy alone, is likelier than the sensors' noise. Causes are known if
they explain most of the gap of all channels together, on held-out logs, at values that a robot can have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simgap.attribution.attribute import Remainder
from simgap.attribution.heldout import fraction_gone
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
    significant,
)  # fmt: skip
from simgap.robot_effects.base import RobotEffect
from simgap.robots.fit import fit_effects
from simgap.robots.linear import linearise
from simgap.robots.model import Composed, Point
from simgap.robots.rows import Phases
from simgap.robots.search import FittedSet, Search
from simgap.robots.whiten import covariances

MOST = 0.5  # cited: share of the gap left above which it is unknown (the interface's definition)
OPEN = 0.1  # chosen: a small cause is kept if it leaves at most this share of what is left without it
RECORD = (
    0.92  # learned: 24 of 26 named were right (`experiments.robots_check` and `.given`), all nearly certain
)
MATTERS = 1.1  # chosen: mean square over the noise's; a smaller unexplained gap is reported as none
PART = 0.1  # chosen: share of the gap by which what an alternative leaves may exceed what the best set leaves


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks on held-out stretches of the logs.

    `before`, `after`, `noise_floor`: mean squares of whitened residuals, and those of noise alone;
    `fraction`, `interval_90`: the share of the gap that is gone, and its 90 % interval by fold; `rms`: root
    mean squares before and after by channel, in its unit; `plain`, `residual`: residuals (N,) before and
    after, along windows run from the starts that the logs show; NaN where unknown; `squares`: their whitened
    squares (2, N); NaN where one is unknown.
    """

    before: float
    after: float
    noise_floor: float
    fraction: float
    interval_90: tuple[float, float]
    rms: dict[str, tuple[float, float]]
    plain: np.ndarray
    residual: np.ndarray
    squares: np.ndarray


def shrinkage(best: FittedSet, nothing: FittedSet, composed: Composed, fold: np.ndarray) -> Shrinkage | None:
    """Predict every fold (`fold` (N,) of each row) by a set that is fitted exactly to the others.

    Parameters that each log has of its own are fitted to the held-out log itself: no other log tells them.
    None where there is no gap to shrink.
    """
    rows = composed.rows
    before, after = np.full(rows.log.size, np.nan), np.full(rows.log.size, np.nan)
    for number in np.unique(fold):
        inside = fold == number
        windows = [np.unique(rows.window[m]).tolist() for m in (~inside, inside)]
        for one, residual in ((nothing, before), (best, after)):
            train, test = (one.composed.among(w) for w in windows)
            point = _fitted(train, one, one.point)
            own = [n for n in point if composed.effects[n].by_log]
            point = _fitted(test, one, point, own) if own else point
            starts = {n: slope[inside] for n, slope in one.linear.starts.items()}
            residual[inside] = linearise(test, point, [], starts).residual
    usable = np.isfinite(after) & np.isfinite(before) & ~np.isin(rows.window, list(best.wide))
    both = (nothing, before), (best, after)
    white = [one.covariances.whitener()(np.where(usable, r, 0.0)) ** 2 for one, r in both]
    each = [usable & (fold == n) for n in np.unique(fold)]
    square = np.array([[*(w[m].sum() for w in white), best.noise * np.sum(m)] for m in each])
    gone, there = square[:, 0] - square[:, 1], square[:, 0] - square[:, 2]
    if there.sum() <= 0:
        return None
    plain, residual = (one.covariances.without_starts(one.whiten, r) for one, r in both)
    was, now = rows.rms(plain, usable), rows.rms(residual, usable)
    rms = {name: (was[name], now[name]) for name in was}
    mean = square.sum(0) / usable.sum()
    fraction, interval = fraction_gone(gone, there)
    return Shrinkage(float(mean[0]), float(mean[1]), float(mean[2]), fraction, interval, rms, plain, residual,
                     np.where(usable, white, np.nan))  # fmt: skip


def _fitted(part: Composed, one: FittedSet, point: Point, only: Sequence[str] | None = None) -> Point:
    """The point fitted to some of the windows, with the discrepancy that all of them leave."""
    if not point:
        return point
    linear = linearise(part, point, [])
    return fit_effects(part, linear, covariances(part, linear).whitener(one.discrepancy), point, only)


@dataclass(frozen=True)
class RobotVerdict(Verdict):
    """The verdict and what it rests on.

    `detection`: of the gap; `remainder`: what the causes leave; `where`: where the gap is; `shares`: shares
    of the whole gap by effect of `shared`; `chance`: probability of each candidate to act; `over_noise`: root
    mean square of what is left, over the noise's; `stands_in`: to each cause the effects that the logs do not
    tell from it; `doubts`: why an explanation that leaves little is not believed; `explanation`: the best
    set, known or not.
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
    search: Search, best: FittedSet, far: Shrinkage | None, phases: Phases, seed: int, forced: bool
) -> RobotVerdict:
    """The verdict, from the best set and all others that a search has fitted.

    Args:
        search: The finished search.
        best: Its best set.
        far: How far the gap shrinks on held-out logs; None where that is unknown.
        phases: Stretches of the logs by which the gap is located.
        seed: Of the draws behind the shares' intervals.
        forced: Whether the causes were given instead of chosen.
    """
    nothing = search.fitted[frozenset()]
    fine, floor = best.fine, best.noise * best.fine.sum()
    before, after = float(nothing.squares[fine].sum()), float(best.squares[fine].sum())
    over_noise = float(np.sqrt(after / max(floor, 1e-9)))
    less = [search.fitted.get(frozenset({*best.names} - {out})) for out in best.names]
    lost = np.array([max(float(s.squares[fine].sum()) - after, 0.0) if s else 0.0 for s in less])
    shares = Shares.of(before, min(after, before), floor, lost, np.random.default_rng(seed))
    gap = _gap(best, nothing)
    large = lost >= LEAST * max(lost.sum(), 1e-12)
    open_left = max(after - floor, 0.0) + np.sqrt(2 * floor)
    large |= open_left / (open_left + np.maximum(lost, 1e-12)) <= OPEN
    causes = best.names if forced else tuple(n for n, big in zip(best.names, large, strict=True) if big)
    left = shares.remainder if far is None else max(1.0 - far.fraction, 0.0)
    doubts = _absurd(search.composed.effects, best, causes)
    if left > MOST:
        doubts = (*doubts, f"it leaves {100 * left:.0f} % of the gap")
    right = float(not doubts)
    others = _alternatives(search, best)
    # What is too small to report, and what could replace it, is no cause and replaces none.
    small = {n for s in (best, *others) if {*causes} <= {*s.names} for n in {*s.names} - {*causes}}
    sets = _explanations(others, best, causes, small, right)
    matters = (bool(causes) and not doubts) or before > MATTERS * floor
    ordered = tuple(sorted(causes))
    verdict = conclude(sets, gap.p_value, matters, ordered if forced else (), ordered, record=RECORD)
    stands_in = {}
    for cause in verdict.causes:
        rivals = [s.causes for s in sets if cause not in s.causes and len(s.causes) <= len(causes)]
        stands_in[cause] = tuple(sorted(set().union(*rivals) - {*causes}))
    seen = verdict.verdict != "none"
    where = _where(search, nothing, phases) if seen else ()
    left_where = _where(search, best, phases) if seen and best.names else where
    rest = Remainder(left if verdict.causes else float(seen), _chance_of_noise(best), left_where)
    return RobotVerdict(
        **vars(verdict), detection=gap, remainder=rest, where=where, shares=shares, shared=best.names,
        chance=dict.fromkeys(search.wanted, 0.0) | acting(sets, gap.p_value, RECORD),
        over_noise=over_noise,
        stands_in=stands_in, doubts=doubts, explanation=best.names,
    )  # fmt: skip


def _gap(best: FittedSet, nothing: FittedSet) -> Detection:
    """A set, or a discrepancy alone, against the sensors' noise: by Markov's inequality noise makes such odds
    with at most the probability of their inverse."""
    value = max(best.score, nothing.score) - _score_of_noise(nothing)
    return Detection(value, float(np.exp(-max(value, 0.0))), 0.0)


def _score_of_noise(one: FittedSet) -> float:
    """A set's log evidence with the sensors' noise alone, no discrepancy, in the same windows: were any free
    to be off by itself, noise would explain whatever shows in all of them."""
    if not one.discrepancy:
        return one.score
    left, plain = np.nan_to_num(one.linear.residual), one.covariances.whitener(None, one.wide)
    value = [-0.5 * float(np.sum(w(left) ** 2)) - w.half_log_det for w in (plain, one.whiten)]
    return one.score + value[0] - value[1]


def _chance_of_noise(one: FittedSet) -> float:
    """The p-value of what a set leaves being noise."""
    if not one.discrepancy:
        return 1.0
    return float(np.exp(-max(one.score - _score_of_noise(one), 0.0)))


def _alternatives(search: Search, best: FittedSet) -> list[FittedSet]:
    """Sets that are not distinguished from the best.

    Their evidence does not rule them out; or there is a discrepancy, so that the evidence of all rows is no
    judge of small differences, and held-out logs do not rule them out.
    """
    out, most = [], best.squares.sum() + PART * search.fitted[frozenset()].squares.sum()
    for one in search.fitted.values():
        if one is best or {*best.names} < {*one.names}:
            continue
        alike = one.score > best.score - np.log(RULED_OUT)
        if best.discrepancy and one.names and one.squares.sum() < most:
            alike = alike or not search.predicts_better(best, one, best)
        if alike:
            out.append(one)
    return out


def _explanations(
    others: Sequence[FittedSet], best: FittedSet, causes: Sequence[str], small: set[str], right: float
) -> list[Explanation]:
    """The remaining sets by weight, without `small` effects, unless only these can replace a cause there.
    None outweighs the best: where another is likelier, held-out logs do not bear that out."""
    others_score = [np.clip(s.score, best.score - np.log(RULED_OUT), best.score) for s in others]
    score = np.array([best.score, *others_score])
    weight = np.exp(score - np.logaddexp.reduce(score))
    each = [{*s.names} - small for s in (best, *others)]
    for k, one in enumerate(others, 1):
        if each[k] < {*causes}:
            each[k] = {*one.names} - ({*best.names} - {*causes})
    each = [tuple(sorted(names)) for names in each]
    return [Explanation(n, float(w), n, right if n else 0.0) for n, w in zip(each, weight, strict=True)]


def _absurd(effects: Mapping[str, RobotEffect], best: FittedSet, causes: Sequence[str]) -> tuple[str, ...]:
    """Causes at a bound that no robot reaches; zero and the nominal value are possible (no friction, say)."""
    out = []
    for name in causes:
        for short, value in best.point[name].items():
            p = effects[name].parameters[short]
            bounds = [b for b in (p.low, p.high) if np.isfinite(b) and b not in (p.nominal, 0.0)]
            if any(abs(value - b) < 1e-3 * p.sd for b in bounds):
                unit = "" if p.unit == "1" else f" {p.unit}"
                out.append(f"{name} {short} {value:.3g}{unit} is no value of a robot's")
    return tuple(out)


def _where(search: Search, one: FittedSet, phases: Phases) -> tuple[Cell, ...]:
    """Cells in which what a set leaves exceeds the noise."""
    composed, rows = search.composed, one.linear.rows
    white = one.covariances.whitener()(np.nan_to_num(one.linear.residual))
    names = tuple(r.name for r in composed.recordings)
    mine = GapRows(
        rows.log, rows.channel, phases.of(rows), rows.time, names, rows.channels, phases.names, BANDS
    )
    left, (band,) = cosines(mine, white[:, None])
    return significant(mine, band, left[:, 0], np.ones(white.size))


def repeated(log: str, separates: Sequence[str], gain: float) -> dict[str, Any] | None:
    """The document's next experiment: repeat the motion of a log; None where it gains less than a nat.

    Args:
        log: Name of the log.
        separates: The effects to be told apart.
        gain: Expected gain of log evidence [nats].
    """
    entry = {"do": f"repeat the motion of {log}", "log": log, "separates": list(separates)}
    return entry | {"expected_gain_nats": gain} if gain > 1.0 else None


def next_log(search: Search, best: FittedSet, verdict: RobotVerdict) -> dict[str, Any] | None:
    """The next experiment for the verdict `set`, None for others.

    Of the fitted sets that hold an indistinguishable effect the one closest to the best counts, and the log
    along which the two differ most, whitened.
    """
    if verdict.verdict != "set":
        return None
    logs = search.composed.recordings
    gains, smallest = np.zeros(len(logs)), np.inf
    for one in search.fitted.values():
        if not {*one.names} & {*verdict.indistinguishable}:
            continue
        apart = best.whiten(np.nan_to_num(best.linear.residual - one.linear.residual))
        each = 0.5 * np.bincount(best.linear.rows.log, apart**2, len(logs))
        if each.sum() < smallest:
            smallest, gains = float(each.sum()), each
    at = int(gains.argmax())
    return repeated(logs[at].name, (*verdict.causes, *verdict.indistinguishable), float(gains[at]))
