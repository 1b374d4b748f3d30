"""What changed of a robot between two sets of logs: OLD, which the model is calibrated on, and NEW.

A log is modelled as y = f(theta, its commands) + model error, f being the simulator run freely along the
whole log and theta its parameters, with the map's prior. NEW has theta + delta, where delta is nothing or in
one or two effects. theta and delta are fitted together, OLD's part as a quadratic in theta about its own fit.
Model error has long tails and is alike all along a motion (`simgap.robots.unchanged`), so certainty cannot be
counted in rows. It is learned between motions:

* *How large*: delta's variance is that of leaving out OLD's and NEW's motions one by one (the delete-one
  jackknife in two strata: Efron and Stein, Annals of Statistics 9, 1981), Student's t with Welch's degrees of
  freedom. This includes whatever makes motions disagree: model error, repeats, noise, and how little they say
  of theta. What is wrong alike in all motions makes none disagree, so three terms are added: how delta moves
  when the prior's mean moves by its sd; how it moves when all else that was fitted to OLD differs by DRIFT in
  NEW, as laws of friction hold about the load and speed they were fitted at and no robot is the same on two
  days; and RESPONSE of delta itself, by which the model may answer a change too much or too little.
* *Which*: an explanation's energy is minus its log evidence (Laplace's, delta's prior a Cauchy in its
  coordinates) from the fit to all motions together. Rows count less by their dependence on each other, which
  OLD's motions show by how far each pulls theta. One motion says little of delta alone: a free swing tells
  mass from length only because slower motions determine the friction. An explanation is ruled out where the
  best is RULED_OUT times as likely, where odds below what a second small change of anything gains beyond the
  best count for nothing: so much is model error.
* *Whether*: a change is likelier than nothing by more than the number of candidates, and takes a share that
  matters of the energy and of what held-out motions of NEW are missed by. Model error in motions that OLD
  never made is unknown: then the gain must also hold from motion to motion, or delta be that far from
  nothing, by Student's t. A second change is sought only where the first fits NEW's logs worse than OLD's
  motions are predicted.
* *Whether unknown*: NEW's motions are predicted worse than OLD's were by OLD's others, from motion to motion,
  and most of that is left.

A change of a positive quantity is one of its logarithm (a gain doubled: log 2), of all others in usual sizes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import t as student

from hmmseg.errors import InputError
from simgap.attribution.verdict import ALARM, RULED_OUT
from simgap.progress import Progress, silent
from simgap.robot_effects.base import RobotEffect
from simgap.robots.calibrate import LONGEST, Calibration, calibrate
from simgap.robots.fit import Local, minimise
from simgap.robots.linear import base_at
from simgap.robots.model import Composed, Point
from simgap.robots.rows import noises
from simgap.robots.search import by_chance
from simgap.robots.unchanged import (
    FAR,
    Broken,
    Coordinates,
    Old,
    Runs,
    best_of_halves,
    fit_old,
    loss,
    units_of,
    without_broken,
)
from simgap.robots.verdict import repeated
from simgap.robots.windows import LENGTH
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

STAGES = 8  # look: stages that a progress bar counts
LADDER = (-1.2, -0.6, -0.25, 0.25, 0.6, 1.2)  # numerics: changes to rank candidates by
WIDER = 8.0  # numerics: factor of the scales in a first search: far from a change all of a log is a tail
RUNGS = np.linspace(-2.1, 2.1, 43)  # numerics: where fits begin; a free swing has narrow valleys
TRIED, PAIRED, SECOND = 5, 2, 4  # numerics: changes fitted, those of them paired, and their partners
CHANGED = 0.03  # chosen: share of unchanged robots that may be called changed
MATTERS = 0.1  # chosen: share of NEW's loss that a change must take; less may differ from day to day
DRIFT = 0.1  # prior: share of a parameter, or of its usual size, by which a fitted one differs in NEW
RESPONSE = 0.03  # prior: share of a change by which a model answers it wrongly in all motions alike


@dataclass(frozen=True)
class Change:
    """One explanation.

    `effects`: what changed; `x`: by how much (k,), in coordinates; `sd`, `freedom`: standard deviations (k,)
    and their degrees of freedom; `energy`: minus the log evidence [nats]; `left`: loss (M,) of NEW's motions
    that took no part [nats a row]; `theta`: OLD's coordinates (p,) as NEW's logs have moved them.
    """

    effects: tuple[str, ...]
    x: np.ndarray
    sd: np.ndarray
    freedom: np.ndarray
    energy: float
    left: np.ndarray
    theta: np.ndarray

    @property
    def by_chance(self) -> float:
        """The p-value of its surest coordinate, were nothing changed."""
        each = 2 * student.sf(np.abs(self.x) / np.maximum(self.sd, 1e-12), self.freedom)
        return min(1.0, self.x.size * float(np.min(each)))


@dataclass(frozen=True)
class Hypothesis:
    """What some `effects` may have changed. Its coordinates z are OLD's theta (p,), then changes (k,).

    `of`: coordinates of all that is fitted and of the effects; `mine`: which of them are the effects' (k,).
    """

    runs: Runs
    old: Old
    effects: tuple[str, ...]
    of: Coordinates
    mine: np.ndarray

    @classmethod
    def about(cls, runs: Runs, old: Old, effects: tuple[str, ...]) -> Hypothesis:
        """Of these effects."""
        fitted = [*dict.fromkeys(e for e, _ in old.theta.names)]
        of = Coordinates.of(runs.composed, old.point, [*dict.fromkeys((*fitted, *effects))])
        mine = [of.names.index(n) for e in effects for n in of.names if n[0] == e]
        return cls(runs, old, effects, of, np.array(mine, int))

    def full(self, z: np.ndarray) -> np.ndarray:
        """NEW's coordinates."""
        p, full = len(self.old.theta.names), np.zeros(len(self.of.names))
        full[:p] = z[:p]
        full[self.mine] += z[p:]
        return full

    def point(self, z: np.ndarray) -> Point:
        """NEW's parameters."""
        return self.of.point(self.old.point, self.full(z))

    def cost(self, z: np.ndarray, without: int = -1) -> float:
        """Minus the log likelihood of NEW, `without` one of its units, and of OLD as a quadratic."""
        theta = z[: len(self.old.theta.names)]
        kept = self.runs.losses(self.point(z), without)[0]
        return kept + float(0.5 * theta @ self.old.bend @ theta)

    def columns(self, z: np.ndarray, only: Sequence[str] | None = None) -> np.ndarray:
        """Derivatives (N, p + k) of NEW's rows; with `only` some effects, 0 of all else."""
        slopes = self.runs.slopes(self.point(z), self.of, self.full(z), only)
        theta = slopes[:, : len(self.old.theta.names)]
        return np.hstack([theta if only is None else np.zeros_like(theta), slopes[:, self.mine]])


class Comparison:
    """NEW logs against what is known of OLD: exact fits of changes.

    Args:
        composed: The model along NEW.
        old: What is known of OLD.
        candidates: What may have changed.
        unit: Unit (N,) of each row of NEW.
    """

    def __init__(self, composed: Composed, old: Old, candidates: Sequence[str], unit: np.ndarray) -> None:
        self.composed, self.old, self.candidates = composed, old, candidates
        self.runs = Runs(composed, old.point, unit, old.scale)

    def fit(self, effects: tuple[str, ...], starts: Sequence[np.ndarray]) -> Change:
        """Fit an explanation, from the best of some starts of its coordinates."""
        old, runs, of = self.old, self.runs, Hypothesis.about(self.runs, self.old, effects)
        p, k = len(old.theta.names), of.mine.size
        bend = 1e-6 * np.eye(p + k)
        bend[:p, :p] = old.bend
        begun = [np.concatenate([np.zeros(p), x]) for x in starts]
        for wider in (WIDER, 1.0):
            runs.set_scales(wider * old.scale)
            z = min(begun, key=of.cost)
            theta = of.columns(z)
            theta[:, p:] = 0.0

            # Theta moves little, and its columns less.
            def local(z: np.ndarray, theta: np.ndarray = theta) -> Local:
                information, pull = runs.information(runs.rows(of.point(z)), theta + of.columns(z, effects))
                return information.sum(0) + bend, pull.sum(0) - bend @ z

            z = minimise(of.cost, local, z, far=FAR)
            begun = [z]
        information, pull = runs.information(runs.rows(of.point(z)), of.columns(z))
        total, rest = information.sum(0) + bend, pull.sum(0) - bend @ z
        left = np.zeros(len(runs.units))
        moved = [np.zeros((n, k)) for n in map(len, (runs.units, old.units))]
        for u in range(left.size):
            step = np.linalg.lstsq(total - information[u], rest - pull[u], rcond=None)[0]
            there = best_of_halves(partial(of.cost, without=u), z, step)
            left[u], moved[0][u] = runs.losses(of.point(there), u)[1], (there - z)[p:]
        for u in range(len(old.units)):
            less, push = total.copy(), rest.copy()
            less[:p, :p] -= old.information[u]
            push[:p] -= old.pull[u] - old.information[u] @ z[:p]
            moved[1][u] = np.clip(np.linalg.lstsq(less, push, rcond=None)[0][p:], -FAR, FAR)
        pushed = np.sqrt(old.dependence * np.diag(old.prior))  # by a prior's mean one sd away
        by_prior = np.linalg.solve(total, np.eye(p + k, p) * pushed)
        own = {of.of.names[m] for m in of.mine}
        drift = np.array([0.0 if n in own else DRIFT**2 for n in old.theta.names])
        by_drift = added_by_drift(total, bend[:p, :p], drift / old.dependence) * old.dependence
        x = z[p:]
        known = (np.sum(by_prior**2, 1) + by_drift)[p:] + (RESPONSE * x) ** 2
        sd, freedom = jackknife(moved, known)
        schur = total[p:, p:] - total[p:, :p] @ np.linalg.solve(total[:p, :p], total[:p, p:])
        occam = float(np.sum(np.log(np.pi * (1 + x**2)))) - 0.5 * k * np.log(2 * np.pi)
        occam += 0.5 * float(np.linalg.slogdet(schur / old.dependence + np.eye(k))[1]) if k else 0.0
        return Change(effects, x, sd, freedom, of.cost(z) / old.dependence + occam, left, z[:p])

    def scanned(self, about: Change | None = None) -> dict[str, tuple[float, np.ndarray]]:
        """The least cost by candidate over a ladder of changes, theta held, and the change that gives it."""
        out, known, first = {}, () if about is None else about.effects, np.zeros(len(self.old.theta.names))
        if about is not None:
            first = np.concatenate([about.theta, about.x])
        self.runs.set_scales(WIDER * self.old.scale)
        for name in (n for n in self.candidates if n not in known):
            of = Hypothesis.about(self.runs, self.old, (*known, name))
            k = len(self.old.theta.names) + of.mine.size - first.size
            steps = [np.zeros(k), *(s * one for one in np.eye(k) for s in LADDER)]
            costs = [of.cost(np.concatenate([first, x])) for x in steps]
            out[name] = (min(costs), steps[int(np.argmin(costs))])
        return out

    @staticmethod
    def _rungs(x: np.ndarray) -> list[np.ndarray]:
        """Changes to begin a fit from; many of a single coordinate."""
        return [np.zeros(x.size)] if x.size > 1 else [np.array([r]) for r in RUNGS]

    @property
    def missed(self) -> np.ndarray:
        """The loss (M,) expected of each motion of NEW: OLD's own, if OLD made them all, else OLD's mean."""
        old = self.old.missed
        mine = np.searchsorted(self.old.units, self.runs.units)
        return old[mine] if self.paired else np.full(mine.size, old.mean())

    def excess(self, change: Change) -> np.ndarray:
        """The loss (M,) of each motion of NEW beyond that."""
        return change.left - self.missed

    def leaves(self, change: Change) -> bool:
        """Whether NEW's logs are fitted worse than OLD's motions are predicted."""
        count = np.bincount(np.searchsorted(self.runs.units, self.runs.unit))
        return bool(change.energy > float(count @ self.missed) / self.old.dependence)

    @property
    def paired(self) -> bool:
        """Whether OLD made all motions of NEW."""
        return bool(np.isin(self.runs.units, self.old.units).all())

    def chance(self, change: Change, beyond: Change) -> float:
        """The p-value of a gain over a simpler explanation, with all candidates tried."""
        return min(1.0, len(self.candidates) * float(np.exp(min(change.energy - beyond.energy, 0.0))))

    def needed(self, change: Change, beyond: Change) -> bool:
        """Whether an explanation is needed beyond a simpler one (*Whether*, above)."""
        shares = 1 - change.left / np.maximum(beyond.left, 1e-12)
        taken = min(float(shares.mean()), 1 - change.energy / beyond.energy)
        if self.chance(change, beyond) >= CHANGED or taken < MATTERS:
            return False
        return self.paired or max(by_chance(shares), len(self.candidates) * change.by_chance) < CHANGED

    def searched(self) -> list[Change]:
        """Fit nothing, the most promising single changes, and pairs about the best of them."""
        nothing = self.fit((), [np.zeros(0)])
        scan = self.scanned()
        names = sorted(scan, key=lambda n: scan[n][0])[:TRIED]
        singles = [self.fit((n,), [scan[n][1], *self._rungs(scan[n][1])]) for n in names]
        fit = sorted(singles, key=lambda c: c.energy)
        best = [c for c in fit if self.needed(c, nothing)][:PAIRED]
        if not best:
            return [nothing, *singles]
        scan = self.scanned(best[0])
        pairs = {}
        for name in sorted(scan, key=lambda n: scan[n][0])[:SECOND]:
            pairs[frozenset((best[0].effects[0], name))] = (best[0], name, scan[name][1])
        for one, two in itertools.combinations(best, 2):
            pairs.setdefault(frozenset((*one.effects, *two.effects)), (one, two.effects[0], two.x))
        more = self.leaves(best[0])  # else no second change is sought, only what it would do
        both = [
            self.fit(
                (*one.effects, name),
                [np.concatenate([one.x, r]) for r in (x, *(self._rungs(x) if more else ()))],
            )
            for one, name, x in pairs.values()
        ]
        return [nothing, *singles, *both]


def added_by_drift(total: np.ndarray, before: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """What drift adds to the variances of q coordinates.

    Args:
        total: Their information (q, q).
        before: OLD's part of it, on the first p (p, p).
        drift: Variances (p,) by which these differ, independently, in NEW.
    """
    loose, p = total.copy(), drift.size
    if p:
        loose[:p, :p] += np.linalg.inv(np.linalg.inv(before) + np.diag(drift)) - before
    return np.diag(np.linalg.inv(loose) - np.linalg.inv(total))


def jackknife(strata: Sequence[np.ndarray], known: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (k,) and Welch's degrees of freedom (k,) from leaving out one unit at a time.

    Args:
        strata: Estimates (M, k) without each unit, by stratum; a stratum of one unit leaves them unknown.
        known: Further variance (k,).
    """
    k = strata[0].shape[1]
    parts, freedom = [], []
    for left in strata:
        m = left.shape[0]
        parts.append(np.full(k, np.inf) if m < 2 else (m - 1) / m * np.sum((left - left.mean(0)) ** 2, 0))
        freedom.append(max(m - 1, 1))
    each = np.maximum(np.array(parts), 1e-300)
    total = each.sum(0) + known
    share = np.divide(each, total, out=np.ones_like(each), where=np.isfinite(total))
    freed = np.sum(share**2 / np.array(freedom)[:, None], 0)
    return np.sqrt(total), 1 / np.maximum(freed, 1e-300)  # what is known has no end of them


@dataclass(frozen=True)
class Changes:
    """What was found.

    `verdict`: none, named, set or unknown; `best`, `others`: the best explanation, and those that NEW's logs
    do not rule out; `nothing`, `tried`: no change, and all explanations that were fitted; `probabilities`: of
    none, unknown, and explanations; `worse`: the p-value of what the best explanation leaves, were the robot
    unchanged; `p_value`: the p-value of the change; `old`, `runs`, `composed`: what is known of OLD, and the
    model along NEW; `broken`: samples that were left out; `calibration`: on OLD.
    """

    verdict: str
    best: Change
    others: tuple[Change, ...]
    nothing: Change
    tried: tuple[Change, ...]
    probabilities: Mapping[str, float]
    worse: float
    p_value: float
    old: Old
    runs: Runs
    composed: Composed
    broken: tuple[Broken, ...]
    calibration: Calibration | None

    def body(self) -> dict[str, Any]:
        """The document, with the keys of every diagnosis; `changes` has a line for each cause."""
        best, nothing, names = self.best, self.nothing, sorted(self.best.effects)
        others = sorted({n for c in self.others for n in c.effects} - {*names})
        before, after, floor = (float(v.mean()) for v in (nothing.left, best.left, self.old.missed))
        gone = float(np.clip((before - after) / max(before - floor, 1e-9), 0, 1))
        fraction = gone if names else None
        explanations = {"+".join(sorted(c.effects)): c for c in (best, *self.others) if c.effects}
        parts = [(n, c, sorted(c.effects)) for n, c in explanations.items()]
        parts += [(n, best, [n]) for n in (names if len(names) > 1 else ()) if n not in explanations]
        effects = {
            name: {
                "parameters": self._parameters(c, of), "property_shift": {},
                "log_evidence": float(np.sum(nothing.left - c.left)),
                "heldout_score": float(np.mean(nothing.left - c.left)),
            } for name, c, of in parts
        }  # fmt: skip
        chances = self.probabilities
        calibrated = {} if self.calibration is None else self.calibration.body()
        acting = {n: sum(p for e, p in chances.items() if n in e.split("+")) for n in (*names, *others)}
        p_none = self.p_value
        return {
            "verdict": self.verdict, "causes": names if self.verdict in ("named", "set") else [],
            "indistinguishable": others if self.verdict == "set" else [],
            "probabilities": dict(chances),
            "detection": {"p_value": p_none, "statistic": max(0.0, before - after), "resolution": 0.0},
            "remainder": {"share": None if fraction is None else 1 - fraction, "p_value": self.worse,
                          "where": [], "rms_over_noise": self.over},
            "attribution": {n: {"probability": p, "share": fraction if names == [n] else None,
                                "interval_90": None} for n, p in acting.items()},
            "where": self.where() if self.verdict != "none" else [], "effects": effects,
            "changes": self.lines(),
            "broken": [{"trial": b.log, "channel": b.channel, "time": b.time, "value": b.value}
                       for b in self.broken],
            "shrinkage": None if fraction is None else {
                "evaluated_on": "held-out new motions", "before": before, "after": after,
                "noise_floor": floor, "fraction": fraction, "interval_90": None, "flexible_ceiling": None},
            "stands_in": {n: others for n in names} if self.verdict == "set" else {},
            "calibrated": calibrated or None,
            "numerics": {n: {"before": v["nominal"], "after": v["mean"], "unit": v["unit"]}
                         for n, v in calibrated.get("numerics", {}).items()},
            "next_experiment": self._next_experiment([*names, *others]),
        }  # fmt: skip

    def _parameters(self, change: Change, effects: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Sizes by short name, or by effect and short name where there are several effects."""
        known, out = self.sizes(change), {}
        for name in effects:
            shorts = self.composed.effects[name].parameters
            for short in shorts:
                size = known[self.composed.effects[name].label(short)]
                out[short if len(effects) == 1 else f"{name}.{short}"] = size | {"nominal": size["old"]}
        return out

    def _next_experiment(self, separates: Sequence[str]) -> dict[str, Any] | None:
        """Repeat the motion by whose losses the best explanation and its closest rival differ most."""
        if self.verdict != "set":
            return None
        count = np.bincount(np.searchsorted(self.runs.units, self.runs.unit)) / self.old.dependence
        apart = min((np.abs(c.left - self.best.left) * count for c in self.others), key=np.sum)
        unit = self.runs.units[int(apart.argmax())]
        log = self.composed.recordings[int(self.runs.log[self.runs.unit == unit][0])].name
        return repeated(log, separates, float(apart.max()))

    @property
    def over(self) -> float:
        """By how much NEW's motions are missed worse than OLD's, about as a factor on root mean squares."""
        return float(np.exp((self.best.left.mean() - self.old.missed.mean()) / 2))

    def where(self) -> list[dict[str, Any]]:
        """Logs that an unchanged robot would miss by more than OLD's motions are missed."""
        rows = self.runs.rows(self.old.point)
        size = np.array([float(np.mean(loss(rows[self.runs.log == i]))) for i in np.unique(self.runs.log)])
        spread = max(float(np.std(self.old.missed, ddof=1)) if self.old.missed.size > 1 else 0.0, 1e-3)
        z = (size - self.old.missed.mean()) / spread
        excess = np.where(z > 2, size - self.old.missed.mean(), 0.0)
        share = excess / max(excess.sum(), 1e-300)
        logs, channel = self.composed.recordings, ", ".join(self.composed.rows.channels)
        return [
            {
                "trial": logs[i].name, "channel": channel, "subtask": "all",
                "band": [0.0, 0.5 / float(np.median(np.diff(logs[i].t)))],
                "share": float(share[i]), "z": float(z[i]),
            }
            for i in np.argsort(-share) if excess[i] > 0
        ]  # fmt: skip

    def lines(self) -> list[str]:
        """A line for every change of the best explanation: by how much, from what to what."""
        out = []
        for name, v in self.sizes().items():
            low, high = v["interval_90"]
            unit = "" if v["unit"] == "1" else f" {v['unit']}"
            size = f"{v['old']:.4g} -> {v['mean']:.4g}{unit} (90 % interval {low:.4g} to {high:.4g})"
            part = "" if v["ratio"] is None else f" {100 * (v['ratio'] - 1):+.0f} %"
            out.append(f"{name}{part}: {size}")
        return out

    def point(self) -> Point:
        """NEW's parameters by the best explanation, all else unchanged."""
        at = Coordinates.of(self.composed, self.old.point, self.best.effects)
        return at.point(self.old.point, self.best.x)

    def sizes(self, of: Change | None = None) -> dict[str, dict[str, Any]]:
        """Each parameter of an explanation (by default the best), before and now, with 90 % intervals, and as
        a ratio where it changed by a factor."""
        change = self.best if of is None else of
        at = Coordinates.of(self.composed, self.old.point, change.effects)
        reach = student.ppf(0.95, change.freedom) * np.minimum(change.sd, 1e6) if change.x.size else change.x
        low, now, high = (at.values(change.x + r) for r in (-reach, 0 * reach, reach))
        out = {}
        for k, (effect, short) in enumerate(at.names):
            known, ratio = self.composed.effects[effect], at.log[k]
            out[known.label(short)] = {
                "old": float(at.at[k]), "mean": float(now[k]),
                "sd": float(min(change.sd[k], 1e6) * at.slopes(change.x)[k]),
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
    known: Old | None = None,
) -> Changes:
    """Find what changed between OLD logs of a robot and NEW ones.

    Args:
        simulator: A model of the robot as it was.
        old: Logs of the robot as it was, two or more; the more motions the better.
        new: Logs of the robot as it is.
        effects: What may have changed, by name; those that are `fitted` are calibrated on OLD.
        tell: Called with a description of each stage.
        calibration: On the same old logs, where that is known.
        known: What was learned of the same old logs before, where NEW makes the same motions as then.

    Raises:
        InputError: There are too few logs, or the simulator does not follow them.
    """
    if len(old) < 2:
        raise InputError("--healthy", f"has {len(old)} log", "two at least, to see how far logs differ")
    effects = {n: e for n, e in effects.items() if not e.by_log}
    old, broken = without_broken(simulator, old)
    new, more = without_broken(simulator, new)
    if calibration is None and any(e.fitted for e in effects.values()):
        tell("calibrating on the old logs")
        calibration = calibrate(simulator, old, effects)
    noise = noises(simulator, old)
    point: Point = {} if calibration is None else calibration.point
    candidates = [n for n, e in effects.items() if not e.numeric]

    def along(logs: Sequence[Recording]) -> Composed:
        made = Composed.of(simulator, logs, effects, noise, LONGEST)
        if not np.isfinite(base_at(made, point).rows).all():
            made = Composed.of(simulator, logs, effects, noise, LENGTH)
        return made.moved(point)

    before, composed = along(old), along(new)
    units = units_of(before, composed)
    if known is None or not np.array_equal(known.units, np.unique(units[0])):
        tell("how far the old logs differ")
        known = fit_old(before, calibration, units[0])
    tell("changes in the new logs")
    found = Comparison(composed, known, candidates, units[1])
    return _concluded(found.searched(), found, (*broken, *more), calibration)


def _concluded(
    tried: Sequence[Change], found: Comparison, broken: Sequence[Broken], calibration: Calibration | None
) -> Changes:
    """The verdict: the simplest explanation that is needed, and those that are as likely."""
    nothing, old = tried[0], found.old
    every = sorted(tried[1:], key=lambda c: c.energy)
    singles, pairs = ([c for c in every if len(c.effects) == n] for n in (1, 2))
    best = next((c for c in singles if found.needed(c, nothing)), nothing)
    left = pairs if best.effects and found.leaves(best) else ()
    more = next((c for c in left if found.needed(c, best)), best)
    slack = max((best.energy - c.energy for c in pairs if {*best.effects} < {*c.effects}), default=0.0)
    best, slack = more, max(slack, 0.0) if more is best else 0.0
    least = best.energy + slack
    alike = [c for c in (singles, pairs)[len(best.effects) == 2] if c is not best and best.effects]
    weight = {"+".join(sorted(c.effects)): float(np.exp(min(least - c.energy, 0.0))) for c in alike}
    others = [c for c in alike if weight["+".join(sorted(c.effects))] > 1 / RULED_OUT]
    excess = found.excess(best)
    p_value = found.chance(best, nothing) if best.effects else 1.0
    worse = by_chance(excess) if found.paired else _unlike(best.left, old.missed)
    verdict = "none" if not best.effects else "set" if others else "named"
    if worse < ALARM and excess.mean() > (nothing.left - best.left).mean():
        verdict = "unknown"
    chances = _chances(best, weight, p_value, worse)
    return Changes(
        verdict, best, tuple(others), nothing, tuple(tried), chances, worse, p_value, old, found.runs,
        found.composed, tuple(broken), calibration,
    )  # fmt: skip


def _unlike(new: np.ndarray, old: np.ndarray) -> float:
    """The p-value of NEW's losses (n,) exceeding OLD's (m,) as those of other motions would, by Student's t
    of their logarithms, as some motions are missed by far more than others."""
    if old.size < 2:
        return 0.5
    a, b = np.log(np.maximum(new, 1e-12)), np.log(np.maximum(old, 1e-12))
    sd = max(float(b.std(ddof=1)), 1e-12) * np.sqrt(1 / b.size + 1 / a.size)
    return float(student.sf((a.mean() - b.mean()) / sd, b.size - 1))


def _chances(best: Change, weight: Mapping[str, float], p_value: float, worse: float) -> dict[str, float]:
    """Probabilities of none, of unknown, and by weight of the explanations as simple as the best.

    A p-value leaves odds of nothing of at least -e p log p (Sellke, Bayarri & Berger, American Statistician
    55, 2001). Prior odds of unknown are such that it is as likely as not where the verdict turns to it.
    """

    def odds(p: float) -> float:
        p = max(p, 1e-12)
        return 1.0 if p >= math.exp(-1) else -math.e * p * math.log(p)

    none, unknown = odds(p_value) if best.effects else 1.0, odds(ALARM) / (odds(ALARM) + odds(worse))
    every = {**weight, **({"+".join(sorted(best.effects)): 1.0} if best.effects else {})}
    total = max(sum(every.values()), 1e-300)
    seen = 1 - none / (1 + none) if best.effects else 0.0
    out = {"none": (1 - seen) * (1 - unknown), "unknown": unknown}
    return out | {n: seen * (1 - unknown) * w / total for n, w in every.items()}
