"""What changed of a robot between two sets of its logs: OLD, which a model is calibrated on, and NEW.

One generative model. A log i of OLD is read as

    y_i = f(theta + b_i, commands of i) + g_i + e_i,    b_i ~ N(0, diag tau^2),

f the simulator run freely along the whole log, theta its parameters (their prior is the map's), b_i what
the model's own error makes of them from log to log, g_i what of that error no parameter can take, by
channel an Ornstein-Uhlenbeck process, and e_i noise: the sensors', and what a jitter in time makes of what
moves. A log of NEW has theta + delta + c in theta's place; c ~ N(0, diag tau^2) is what the model's error
makes of all of them, and delta is nothing, or in one or two effects: spike and slab. theta, tau and the
processes are learned on OLD: the gap by leaving motions out, each log with a size of its own, tau by EM. So
other repeats and other motions of what did not change have a distribution, and a change must stand out of
that and not of the sensors' noise alone. theta enters NEW as a Gaussian about OLD's fit, which for a
quadratic log likelihood is the joint fit of OLD and NEW.

A change of what is positive is of its logarithm (a gain doubled: log 2), of all else in usual sizes; the
slab is Cauchy's. Evidence is by Laplace. A log likelihood of a model that is never quite right counts for
more than it should: that one explanation beats another has to hold on logs that took no part, from log to
log (a sign test in the spirit of Vuong, Econometrica 57, 1989), or the two stay a set.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm as normal
from scipy.stats import t as student

from hmmseg.errors import InputError
from simgap.progress import Progress, silent
from simgap.robot_effects.base import RobotEffect
from simgap.robots.calibrate import LONGEST, Calibration, calibrate
from simgap.robots.linear import base_at
from simgap.robots.model import Composed, Point
from simgap.robots.noise import noises
from simgap.robots.unchanged import (
    Broken,
    Coordinates,
    Null,
    Whitened,
    learned,
    of_one_motion,
    sums,
    without_broken,
)
from simgap.robots.windows import LENGTH
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

STAGES = 8  # look: what a progress bar counts
COMMON = 0.1  # prior: of usual sizes; what a model's error makes of all new logs, at most
LEAST = 0.2  # numerics: of a log's own size over that of OLD's logs
GROUPS, MANY = (
    10,
    12,
)  # numerics: logs or stretches held out, at least, and of those whose signs are all tried
PRIOR = (0.5, 0.3, 0.2)  # prior: that nothing changed, one thing, two
LADDER = (-1.4, -0.7, -0.35, 0.35, 0.7, 1.4)  # numerics: logarithms from which a fit may begin
SIZE = np.log(2.0)  # prior: a change that is usual, as a logarithm
TRIED, PAIRED = 8, 4  # numerics: of single changes fitted exactly, and of those joined in pairs
ODDS = np.log(20.0)  # chosen: against what is rejected
SURE = 0.95  # chosen: likewise, that it holds from log to log
CHANGED = 0.97  # chosen: the same of any change over none: 3 % of unchanged robots may be called changed
ALARM = 0.01  # chosen: of logs of what did not change, those whose misfit is called unknown
Kalman = tuple[np.ndarray, np.ndarray, np.ndarray]  # spread, gain, decay from the row before, (N,) each
STEPS = 12  # numerics: of a fit


@dataclass(frozen=True)
class Change:
    """One explanation: changed coordinates `x` (k,) of `effects` with covariance (k, k), its log posterior
    odds but for a constant, the mean squares that it leaves of each log of NEW in units of OLD's
    processes, and log likelihoods `held` of logs, or stretches of few, that took no part."""

    effects: tuple[str, ...]
    x: np.ndarray
    covariance: np.ndarray
    odds: float
    left: np.ndarray
    held: np.ndarray


class Comparison:
    """NEW logs against what is known of OLD: exact fits of changes, and their odds."""

    def __init__(
        self, composed: Composed, null: Null, candidates: Sequence[str], about: Change | None = None
    ) -> None:
        self.composed, self.null, self.candidates = composed, null, candidates
        self.logs, point, scale = len(composed.recordings), null.point, np.ones(len(composed.recordings))
        if about is not None:
            point, scale = self.coordinates(about.effects).point(null.point, about.x), np.sqrt(about.left)
        self.new = Whitened(composed, point, null.every.about(composed, point))
        self.new.by(null.processes, null.tau, np.maximum(scale, LEAST))
        p, rows = len(null.theta.names), composed.rows
        self.loose = self.new.whiten(self.new.columns)
        # NEW's logs have in common what a model's error makes of any of them, where that is known to be small
        spread = np.diag(np.minimum(null.tau, COMMON) ** 2)
        spread[:p, :p] += null.covariance
        self.prior = np.linalg.inv(spread)
        self.inside = np.linalg.inv(self.loose.T @ self.loose + self.prior)
        motion = self.new.motion
        # Few motions are held out by stretches, but what a model gets wrong all along a motion that OLD never
        # made says the same in every stretch: of such a motion there is one.
        pieces = -(-GROUPS // (motion.max() + 1)) if self.known_motions else 1
        self.group = np.zeros(rows.log.size, int)
        for i in range(self.logs):
            mine = rows.log == i
            order = np.argsort(np.argsort(rows.time[mine], kind="stable"), kind="stable")
            self.group[mine] = motion[mine] * pieces + order * pieces // mine.sum()

    @property
    def known_motions(self) -> bool:
        """Whether OLD made every motion of NEW."""
        old = self.null.motions
        return all(any(of_one_motion(one, other) for other in old) for one in self.new.motions)

    def coordinates(self, effects: Sequence[str]) -> Coordinates:
        """Of some effects about OLD's point."""
        return Coordinates.of(self.composed, self.null.point, effects)

    def projected(self, white: np.ndarray) -> np.ndarray:
        """What is left of whitened rows or columns when theta has followed, as far as OLD lets it."""
        return white - self.loose @ (self.inside @ (self.loose.T @ white))

    def cost(self, of: Coordinates, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus the log posterior of a change, constants left out, and whitened rows."""
        rows = self.new.rows(of.point(self.null.point, x))
        if not np.isfinite(rows).all():
            return np.inf, rows
        white = self.new.whiten(rows)
        return 0.5 * float(white @ self.projected(white)) + float(
            np.log1p((x / self.size(of)) ** 2).sum()
        ), white

    def size(self, of: Coordinates) -> np.ndarray:
        """Usual changes (k,)."""
        return np.where(of.log, SIZE, 1.0)

    def fit(self, effects: tuple[str, ...], starts: Sequence[np.ndarray]) -> Change:
        """The best of the fits that begin at the best two of some coordinates."""
        of = self.coordinates(effects)
        first = sorted(starts, key=lambda x: self.cost(of, x)[0])[:2]
        ends = [self._descended(of, x) for x in first]
        return min(ends, key=lambda end: end[0])[1]

    def _descended(self, of: Coordinates, x: np.ndarray) -> tuple[float, Change]:
        cost, white = self.cost(of, x)
        damping, k = 0.0, x.size
        columns = np.zeros((white.size, k))
        bend = np.eye(k)
        for _ in range(STEPS):
            if not np.isfinite(cost):
                break
            columns = self.new.whiten(self.new.slopes(of.point(self.null.point, x), of, x))
            lean = self.projected(columns)
            shape = 2 / (self.size(of) ** 2 + x**2)
            bend = columns.T @ lean
            pull = lean.T @ white - shape * x
            matrix = bend + np.diag(shape + 1e-9)
            for _ in range(6):
                move = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), pull)
                there, new = self.cost(of, x + np.clip(move, -1.5, 1.5))
                if there < cost:
                    break
                damping = max(10 * damping, 0.1)
            else:
                break
            x, gained, cost, white = x + np.clip(move, -1.5, 1.5), cost - there, there, new
            damping = damping / 10 if damping > 0.1 else 0.0
            if gained < 0.05:
                break
        return cost, self._told(of, x, cost, white, columns)

    def _told(
        self, of: Coordinates, x: np.ndarray, cost: float, white: np.ndarray, columns: np.ndarray
    ) -> Change:
        """A change with its evidence, covariance, and what every log says of it."""
        effects, k = tuple(dict.fromkeys(e for e, _ in of.names)), x.size
        count = len(self.candidates)
        log_prior = np.log(PRIOR[len(effects)]) - np.log(
            (1, count, count * max(count - 1, 1) / 2)[len(effects)]
        )
        bend = columns.T @ self.projected(columns) + np.eye(k) / (1e3 * self.size(of)) ** 2
        odds = -cost - float(np.log(np.pi * self.size(of)).sum()) + log_prior
        odds += 0.5 * (k * np.log(2 * np.pi) - np.linalg.slogdet(bend)[1]) if k else 0.0
        both, p = np.column_stack([self.loose, columns]), self.loose.shape[1]
        prior = np.zeros((p + k,) * 2)
        prior[:p, :p], prior[p:, p:] = self.prior, np.diag(1 / (1e2 * self.size(of)) ** 2)
        told, pull = sums(both, white, self.group)
        inverse = np.linalg.inv(told.sum(0) + prior)
        d = inverse @ pull.sum(0)
        d[p:] = 0.0
        left = white - both @ d
        apart = np.array([
            np.linalg.solve(told.sum(0) - told[i] + prior, pull.sum(0) - pull[i]) for i in range(len(told))
        ]).reshape(len(told), p + k)  # fmt: skip
        rest = white - np.einsum("ij,ij->i", both, apart[self.group])
        count = np.bincount(self.new.log)
        squares = np.bincount(self.new.log, left**2) / count * self.new.scale**2
        return Change(effects, x, inverse[p:, p:], odds, squares, -0.5 * np.bincount(self.group, rest**2))

    def nothing(self) -> Change:
        """No change."""
        of = self.coordinates(())
        cost, white = self.cost(of, np.zeros(0))
        return self._told(of, np.zeros(0), cost, white, np.zeros((white.size, 0)))

    def single(self, effect: str) -> Change:
        """One effect changed."""
        of = self.coordinates((effect,))
        k = len(of.names)
        columns = self.new.whiten(self.new.slopes(self.null.point, of))
        lean, white = self.projected(columns), self.new.whiten(self.new.rows(self.null.point))
        shape = np.diag(2 / self.size(of) ** 2)
        straight = np.clip(np.linalg.solve(columns.T @ lean + shape, lean.T @ white), -2, 2)
        starts = [straight, np.zeros(k)]
        if k == 1 and of.log[0]:
            starts += [np.array([s]) for s in LADDER]
        return self.fit((effect,), starts)

    def pair(self, one: Change, two: Change) -> Change:
        """Both changed, from where each ended by itself."""
        effects = (*one.effects, *two.effects)
        at, more = one.x, two.x
        starts = [np.concatenate([at, more])]
        for mine, other, order in ((at, more, 1), (more, at, -1)):
            for s in (0.0, *LADDER) if other.size == 1 else (0.0,):
                starts.append(np.concatenate([mine, np.full(other.size, s)][::order]))
        return self.fit(effects, starts)

    def promising(self, about: Change, count: int) -> list[str]:
        """The effects that promise most about a change, by straight lines."""
        of = self.coordinates(about.effects)
        point = of.point(self.null.point, about.x)
        white = self.projected(self.new.whiten(self.new.rows(point)))
        gains = {}
        for name in self.candidates:
            if name not in about.effects:
                mine = Coordinates.of(self.composed, point, (name,))
                columns = self.new.whiten(self.new.slopes(point, mine))
                lean = self.projected(columns)
                shape = np.diag(1 / self.size(mine) ** 2)
                gains[name] = float(
                    white @ columns @ np.linalg.solve(columns.T @ lean + shape, columns.T @ white)
                )
        return sorted(gains, key=lambda n: -gains[n])[:count]

    def again(self, change: Change) -> Change:
        """The same change fitted from where it ended."""
        return self.fit(change.effects, [change.x]) if change.effects else self.nothing()


@dataclass(frozen=True)
class Changes:
    """What was found: `verdict` none, named, set or unknown; the `best` explanation and `others` that NEW's
    logs do not rule out, `nothing` for comparison, all `tried` with their probabilities; `over`: how far
    NEW's logs are met worse than OLD's, as a factor on root mean squares."""

    verdict: str
    best: Change
    others: tuple[Change, ...]
    nothing: Change
    tried: tuple[Change, ...]
    probabilities: Mapping[str, float]
    over: float
    null: Null
    composed: Composed
    broken: tuple[Broken, ...]
    calibration: Calibration | None

    def body(self) -> dict[str, Any]:
        """The document, with the keys of every diagnosis; `changes` are its causes in a line each."""
        best, nothing, names = self.best, self.nothing, sorted(self.best.effects)
        others = sorted({n for c in self.others for n in c.effects} - {*names})
        before, after = (-2 * float(c.held.sum()) / self.new_rows for c in (nothing, best))
        floor = float(np.exp(self.null.left.mean()))
        fraction = None if not names else 1 - (after - floor) / max(before - floor, 1e-9)
        worse = self.null.tail(best.left)
        unknown = ALARM / (ALARM + worse)
        chances = {n: p * (1 - unknown) for n, p in self.probabilities.items()}
        explanations = {"+".join(sorted(c.effects)): c for c in (best, *self.others) if c.effects}
        where = self.where() if self.verdict != "none" else []
        effects = {
            name: {
                "parameters": {n: v | {"nominal": v["old"]} for n, v in self.sizes(c).items()},
                "log_evidence": c.odds - nothing.odds, "property_shift": {},
                "heldout_score": float((c.held - nothing.held).sum()),
            } for name, c in explanations.items()
        }  # fmt: skip
        calibrated = {} if self.calibration is None else self.calibration.body()
        acting = {n: sum(p for e, p in chances.items() if n in e.split("+")) for n in (*names, *others)}
        return {
            "verdict": self.verdict, "causes": names if self.verdict in ("named", "set") else [],
            "indistinguishable": others if self.verdict == "set" else [],
            "probabilities": {"none": 0.0} | chances | {"unknown": unknown},
            "detection": {"p_value": self.p_value(), "statistic": max(0.0, best.odds - nothing.odds),
                          "resolution": 0.0},
            "remainder": {"share": None if fraction is None else 1 - fraction, "p_value": worse, "where": [],
                          "rms_over_noise": self.over},
            "attribution": {n: {"probability": p, "share": fraction if names == [n] else None,
                                "interval_90": None} for n, p in acting.items()},
            "where": where, "effects": effects, "changes": self.lines(),
            "broken": [{"trial": b.log, "channel": b.channel, "time": b.time, "value": b.value}
                       for b in self.broken],
            "shrinkage": None if fraction is None else {
                "evaluated_on": "held-out new logs", "before": before, "after": after, "noise_floor": floor,
                "fraction": fraction, "interval_90": None, "flexible_ceiling": None},
            "stands_in": {n: others for n in names} if self.verdict == "set" else {},
            "calibrated": calibrated.get("parameters", {}), "numerics": calibrated.get("numerics", {}),
            "next_experiment": None,
        }  # fmt: skip

    @property
    def new_rows(self) -> int:
        """Rows of NEW's logs."""
        return int(self.composed.rows.log.size)

    def p_value(self) -> float:
        """Of no change, from log to log (see `by_chance`) and by Ville's bound on the odds, the larger."""
        best = max(self.tried, key=lambda c: c.odds)
        if not best.effects:
            return 1.0
        bound = float(np.exp(min(0.0, self.nothing.odds - best.odds)))
        return max(bound, by_chance(best.held - self.nothing.held))

    def where(self) -> list[dict[str, Any]]:
        """Logs whose gap stands out of what logs of an unchanged robot leave."""
        rest = np.log(self.nothing.left) - self.null.left.mean()
        z = rest / max(float(self.null.left.std(ddof=1)), 0.1)
        excess = np.where(z > 2, np.maximum(np.exp(rest) - 1, 0), 0.0)
        share = excess / max(excess.sum(), 1e-300)
        logs = self.composed.recordings
        channel = ", ".join(self.composed.rows.channels)
        found = [
            {
                "trial": logs[i].name,
                "channel": channel,
                "subtask": "all",
                "band": [0.0, 0.5 / float(np.median(np.diff(logs[i].t)))],
                "share": float(share[i]),
                "z": float(z[i]),
            }
            for i in np.argsort(-share)
            if excess[i] > 0
        ]
        return found  # fmt: skip

    def lines(self) -> list[str]:
        """Every change of the best explanation in a line: by how much, from what to what."""
        out = []
        for name, v in self.sizes().items():
            low, high = v["interval_90"]
            unit = "" if v["unit"] == "1" else f" {v['unit']}"
            size = f"{v['old']:.4g} -> {v['mean']:.4g}{unit} (90 % interval {low:.4g} to {high:.4g})"
            part = "" if v["ratio"] is None else f" {100 * (v['ratio'] - 1):+.0f} %"
            out.append(f"{name}{part}: {size}")
        return out

    def point(self) -> Point:
        """NEW's parameters by the best explanation, and all else as it was."""
        at = Coordinates.of(self.composed, self.null.point, self.best.effects)
        return at.point(self.null.point, self.best.x)

    def sizes(self, of: Change | None = None) -> dict[str, dict[str, Any]]:
        """Of an explanation (the best by default) each parameter as it was and is, with 90 % intervals, and
        as a ratio where it is changed by factors."""
        change = self.best if of is None else of
        at = Coordinates.of(self.composed, self.null.point, change.effects)
        sd = np.sqrt(np.diag(change.covariance)).reshape(-1)
        reach = student.ppf(0.95, max(self.null.left.size - 1, 1)) * sd
        low, now, high = (at.values(change.x + r) for r in (-reach, 0 * reach, reach))
        out = {}
        for k, (effect, short) in enumerate(at.names):
            known = self.composed.effects[effect]
            name = effect if len(known.parameters) == 1 else f"{effect}.{short}"
            ratio = at.log[k]
            out[name] = {
                "old": float(at.at[k]), "mean": float(now[k]), "sd": float(sd[k] * at.slopes(change.x)[k]),
                "interval_90": [float(low[k]), float(high[k])], "unit": known.parameters[short].unit,
                "ratio": float(now[k] / at.at[k]) if ratio else None,
                "ratio_90": [float(low[k] / at.at[k]), float(high[k] / at.at[k])] if ratio else None,
            }  # fmt: skip
        return out


def changes(
    simulator: Simulator,
    old: Sequence[Recording],
    new: Sequence[Recording],
    effects: Mapping[str, RobotEffect],
    *,
    tell: Progress = silent,
    calibration: Calibration | None = None,
) -> Changes:
    """What changed between OLD logs of a robot and NEW ones.

    Args:
        simulator: a model of the robot as it was.
        old: logs of the robot as it was, two at least; the more motions the better.
        new: logs of it as it is.
        effects: what may have changed, by name; those that are `fitted` are calibrated on OLD.
        tell: hears what is being done.
        calibration: of the same old logs, where that is known.

    Raises:
        InputError: there are too few logs, or the simulator does not follow them.
    """
    if len(old) < 2:
        raise InputError("--healthy", f"has {len(old)} log", "two at least, to see how far logs differ")
    effects = {n: e for n, e in effects.items() if not e.by_log}
    old, broken = without_broken(simulator, old)
    new, more = without_broken(simulator, new)
    if calibration is None and any(e.fitted for e in effects.values()):
        tell("calibrating on the old logs")
        calibration = calibrate(simulator, old, effects)
    noise = noises(simulator, [*old, *new])
    point: Point = {} if calibration is None else calibration.point
    candidates = [n for n, e in effects.items() if not _numeric(simulator, e)]

    def along(logs: Sequence[Recording]) -> Composed:
        made = Composed.of(simulator, logs, effects, noise, LONGEST)
        if not np.isfinite(base_at(made, point).rows).all():
            made = Composed.of(simulator, logs, effects, noise, LENGTH)
        return made.moved(point)

    tell("how far the old logs differ")
    null = learned(along(old), calibration, candidates)
    tell("changes in the new logs")
    composed = along(new)
    found = Comparison(composed, null, candidates)
    tried = _searched(found)
    best = max(tried, key=lambda c: c.odds)
    if best.effects:
        tell("about the best of them")
        tried = _searched(Comparison(composed, null, candidates, best), tried)
    return _concluded(tried, null, composed, (*broken, *more), calibration)


def _numeric(simulator: Simulator, effect: RobotEffect) -> bool:
    return any(p in getattr(simulator, "numerics", ()) for p in effect.model.values())


def _searched(found: Comparison, before: Sequence[Change] = ()) -> list[Change]:
    """Nothing, the most promising single changes, and pairs about the best of them; from where they ended
    `before`."""
    nothing = found.nothing()
    singles = {c.effects[0]: found.again(c) for c in before if len(c.effects) == 1}
    singles |= {n: found.single(n) for n in found.promising(nothing, TRIED) if n not in singles}
    best = sorted(singles.values(), key=lambda c: -c.odds)
    tried = [nothing, *best]
    if best and best[0].odds > nothing.odds:
        for name in found.promising(best[0], PAIRED):
            if name not in singles:
                singles[name] = found.single(name)
        more = [singles[n] for n in found.promising(best[0], PAIRED)]
        pairs = {
            frozenset((a.effects[0], b.effects[0])): (a, b)
            for a, b in itertools.combinations(best[:PAIRED], 2)
        }
        pairs |= {frozenset((best[0].effects[0], b.effects[0])): (best[0], b) for b in more}
        tried += [found.pair(a, b) for a, b in pairs.values()]
    return tried


def _concluded(
    tried: Sequence[Change],
    null: Null,
    composed: Composed,
    broken: Sequence[Broken],
    calibration: Calibration | None,
) -> Changes:
    """The verdict: the simplest explanation that no other beats, in the mean and from log to log."""
    nothing = next(c for c in tried if not c.effects)
    odds = np.array([c.odds for c in tried])
    chance = np.exp(odds - odds.max())
    chance /= chance.sum()
    best = top = tried[int(np.argmax(odds))]
    for simpler in sorted(tried, key=lambda c: -c.odds):
        if simpler.effects and len(simpler.effects) < len(best.effects) and not _beats(best, simpler):
            best = simpler
    if not _beats(top, nothing):
        best = nothing
    helps = best is nothing or float((best.held - nothing.held).sum()) > 0
    if not helps:
        best = nothing
    others = [
        c
        for c in tried
        if c is not best and len(c.effects) == len(best.effects) and c.effects and not _beats(best, c)
    ]
    verdict = "none" if not best.effects else "set" if others else "named"
    if null.tail(best.left) < ALARM:
        verdict = "unknown"
    names = {"+".join(sorted(c.effects)) or "none": float(p) for c, p in zip(tried, chance, strict=True)}
    over = float(np.exp(0.5 * (np.log(best.left).mean() - null.left.mean())))
    return Changes(
        verdict,
        best,
        tuple(others),
        nothing,
        tuple(tried),
        names,
        over,
        null,
        composed,
        tuple(broken),
        calibration,
    )


def _beats(one: Change, other: Change) -> bool:
    """Whether a change rules another out: by its odds, and in its log likelihood from log to log."""
    sure = SURE if other.effects else CHANGED
    return bool(one.odds - other.odds > ODDS) and by_chance(one.held - other.held) <= 1 - sure


def by_chance(gain: np.ndarray) -> float:
    """How often as much is gained in the mean where each of these logs might as well have lost it: of signs
    drawn anew. Of the gains, which are of squares and far larger on some logs than on others, it is the
    roots.
    """
    root = np.sqrt(np.abs(gain))
    if root.size <= MANY:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=root.size)))
        return float(np.mean(signs @ root >= np.sign(gain) @ root - 1e-9))
    return float(normal.sf((np.sign(gain) @ root) / max(np.linalg.norm(root), 1e-300)))
