"""Calibration: what nobody measured of a robot's model, all of it fitted together to its logs, run freely.

Restarted windows lead near from wherever a data sheet starts; logs run from first to last state, as people
judge a model, settle it. Least squares within bounds, each channel in units of its own residual. What a model
states is fitted first; where that leaves a gap, so is what it lacks: friction by load, drives that fade.
Which parameters the logs determine, alone or jointly, is read off the sensitivities there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from simgap.progress import Progress, silent
from simgap.robot_effects import LACKING
from simgap.robot_effects.base import NORMAL_90, RobotEffect, entry
from simgap.robots.fit import FINEST, Whiten, fit_effects
from simgap.robots.linear import STEP, Linear, base_at, linearise, vary
from simgap.robots.model import Composed, Point
from simgap.robots.rows import folds_of, noises
from simgap.robots.whiten import covariances
from simgap.robots.windows import LENGTH
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

STAGES = 4  # look: stages that a progress bar counts
LONGEST = 20.0  # numerics: s that a log is run freely at most
STEPS, AGAIN = 30, 4  # numerics: steps of a fit, and of one that begins where another ended
ROUNDS = 2  # numerics: fits, each in units of the residual of the last one
LEAVES = 4.0  # numerics: squares over the noise's, from which what a model lacks is fitted, and told
UNTOLD = 0.5  # chosen: share of the prior's sd; a parameter with more left is not determined by the logs
NOTHING = 0.05  # numerics: a correlation up to which there is none
COUPLED = 0.05  # numerics: weight in an undetermined direction from which a parameter belongs to it


@dataclass(frozen=True)
class Calibration:
    """The best fit of p parameters.

    `composed`: the model along whole logs; `point`: the best fit; `names`: effect and parameter, in the order
    of what follows; `sd`: the priors' standard deviations (p,); `covariance`: of the fit (p, p);
    `information`: of the logs (p, p), in units of `sd`; `before`, `after`: root mean squares by channel of
    free runs along held-out logs, nominal and fitted; `left`: of the fit's residuals over their noise.
    """

    composed: Composed
    point: Point
    names: tuple[tuple[str, str], ...]
    sd: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    before: Mapping[str, float]
    after: Mapping[str, float]
    left: Mapping[str, float]

    @property
    def determined(self) -> np.ndarray:
        """Whether the logs determine each parameter by itself (p,)."""
        return np.sqrt(np.diag(self._posterior)) <= UNTOLD

    @property
    def _posterior(self) -> np.ndarray:
        """The covariance (p, p) from the logs' information and the priors, in units of `sd`."""
        return np.linalg.inv(self.information + np.eye(self.sd.size))

    def body(self) -> dict[str, Any]:
        """The JSON document: parameters, jointly determined combinations, the simulation's own numbers,
        held-out logs."""
        every = range(len(self.names))
        own = [k for k in every if not self.composed.effects[self.names[k][0]].numeric]
        untold = [k for k in own if not self.determined[k]]
        return {
            "parameters": {self.label(k): self.entry(k) | (_UNKNOWN if k in untold else {}) for k in own},
            "reasons": {self.label(k): self._reason(k) for k in untold},
            "combinations": self.combinations(),
            "numerics": {self.label(k): self.entry(k) for k in every if k not in own},
            "heldout": {"before": dict(self.before), "after": dict(self.after)},
        }

    def label(self, k: int) -> str:
        """A parameter's name in the document."""
        effect, short = self.names[k]
        return self.composed.effects[effect].label(short)

    def value(self, k: int) -> float:
        """A parameter at the best fit."""
        effect, short = self.names[k]
        return float(self.point[effect][short])

    def entry(self, k: int) -> dict[str, Any]:
        """A parameter's entry in the document."""
        effect, short = self.names[k]
        known = self.composed.effects[effect].parameters[short]
        return entry(known, self.value(k), float(np.sqrt(self.covariance[k, k])))

    def _reason(self, k: int) -> str:
        others = [self.label(i) for i in self._group(k) if i != k]
        if self.information[k, k] < 1 or not others:
            return "these logs add little to what was known beforehand"
        return f"told only together with {', '.join(others)}"

    def _group(self, k: int) -> list[int]:
        """Parameters that share an undetermined direction with a parameter, itself included."""
        value, vector = np.linalg.eigh(self._posterior)
        vague = vector[:, np.sqrt(value) > UNTOLD]
        seen = (np.diag(self.information) >= 1) & (np.sum(vague**2, 1) > COUPLED)
        tied = np.abs(vague @ vague.T) > COUPLED
        found, new = {k}, [k]
        while new:
            at = new.pop()
            more = [int(i) for i in np.flatnonzero(tied[at] & seen) if int(i) not in found]
            found |= {*more}
            new += more
        return sorted(found)

    def combinations(self) -> list[dict[str, Any]]:
        """Weighted sums that the logs determine of jointly determined parameters, each with a pivot of its
        own."""
        left, out = [int(k) for k in np.flatnonzero(~self.determined & (np.diag(self.information) >= 1))], []
        while left:
            group = np.array(self._group(left[0]))
            left = [k for k in left if k not in group]
            value, vector = np.linalg.eigh(self._posterior[np.ix_(group, group)])
            rows = vector[:, np.sqrt(value) <= UNTOLD].T / self.sd[group]
            for row in _echelon(rows, self.sd[group]):
                whole = np.zeros(len(self.names))
                whole[group] = row
                mean = sum(c * self.value(k) for k, c in enumerate(whole) if c)
                sd = float(np.sqrt(whole @ self.covariance @ whole))
                of = {self.label(k): float(c) for k, c in enumerate(whole) if c}
                pivot = self.names[int(group[np.flatnonzero(row == 1.0)[0]])]
                unit = self.composed.effects[pivot[0]].parameters[pivot[1]].unit
                out.append({"of": of, "unit": unit, "mean": mean, "sd": sd,
                            "interval_90": [mean - NORMAL_90 * sd, mean + NORMAL_90 * sd]})  # fmt: skip
        return out


_UNKNOWN = {"mean": None, "sd": None, "interval_90": None}


def _echelon(rows: np.ndarray, size: np.ndarray) -> list[np.ndarray]:
    """Rows (k, g) in reduced echelon form: each has a pivot 1 in a column where the others have 0.

    Entries that matter little at the parameters' sizes (g,) become 0.
    """
    out, free = rows.copy(), list(range(rows.shape[1]))
    for k in range(len(out)):
        pivot = free[int(np.argmax(np.abs(out[k, free]) * size[free]))]
        free.remove(pivot)
        out[k] /= out[k, pivot]
        for i in range(len(out)):
            if i != k:
                out[i] -= out[i, pivot] * out[k]
    weight = np.abs(out) * size
    return list(np.where(weight < COUPLED * weight.max(1, initial=0.0, keepdims=True), 0.0, out))


def calibrate(
    simulator: Simulator,
    recordings: Sequence[Recording],
    effects: Mapping[str, RobotEffect],
    *,
    length: float | None = None,
    begin: Point | None = None,
    tell: Progress = silent,
    judged: bool = True,
) -> Calibration:
    """Fit all effects that are `fitted` to logs of a robot.

    Args:
        simulator: The robot's model.
        recordings: Its logs; the halves of a single one are held out.
        effects: By name; those that are not fitted along are left out.
        length: Length of the windows that lead near [s].
        begin: Where to begin, if that is near already; effects in it that are not fitted along stay there.
        tell: Called with a description of each stage.
        judged: Whether the fit is repeated without each log in turn, to tell how far it is from that log.

    Raises:
        InputError: Nothing is uncertain, or the simulator diverges.
    """
    mine = {n: e for n, e in effects.items() if e.fitted or n in (begin or {})}
    fitted = [n for n, e in mine.items() if e.fitted]
    if all(mine[n].numeric for n in fitted):
        raise InputError("calibrate", "nothing of the model is uncertain", "uncertain = [..] in the map")
    noise = noises(simulator, recordings)
    point: Point = {n: (begin or {}).get(n, e.neutral()) for n, e in mine.items()}
    stated = [n for n in fitted if not any(fnmatchcase(n, p) for p in LACKING)]
    tell("windows")
    windows = Composed.of(simulator, recordings, mine, noise, LENGTH if length is None else length)
    near, steps = point, AGAIN
    if begin is None:
        linear = linearise(windows, point, [])
        whiten = covariances(windows, linear).whitener()
        near, steps = fit_effects(windows, linear, whiten, point, stated, STEPS), STEPS
    tell("whole logs")
    whole = Composed.of(simulator, _stretches(recordings), mine, noise, LONGEST)
    start = min((near, point), key=lambda p: _cost(whole, p))
    if not np.isfinite(_cost(whole, start)):  # no free run follows a whole log: only windows are left
        whole, start = windows, near
    found, linear, whiten = _least_squares(whole.moved(start), start, steps, stated)
    if _over_noise(linear) > LEAVES and len(stated) < len(fitted):
        found, linear, whiten = _least_squares(whole.moved(found), found, STEPS, fitted)
        stated = fitted
    tell("what the logs determine")
    names, sd, information, covariance = _sensitivities(whole.moved(found), found, linear, whiten, stated)
    tell("held-out logs")
    before, after = _held_out(whole.moved(found), found, stated) if judged else ({}, {})
    noiseless = without_starts(whole, linear, np.sqrt(linear.rows.variance))
    left = linear.rows.rms(noiseless(np.nan_to_num(linear.residual)))
    return Calibration(whole.moved(found), found, names, sd, covariance, information, before, after, left)


def _stretches(recordings: Sequence[Recording]) -> list[Recording]:
    """The logs, or the halves of a single one, so that one can be held out."""
    if len(recordings) > 1:
        return list(recordings)
    (log,) = recordings
    return [log.window(0, len(log) // 2), log.window(len(log) // 2, len(log))]


def _scales(composed: Composed, residual: np.ndarray) -> np.ndarray:
    """Scale (N,) of each row: its channel's root mean square, at least the noise's, times the root of the
    number of neighbouring rows that repeat each other."""
    rows = composed.rows
    out = np.zeros(rows.log.size)
    for c in range(len(rows.channels)):
        mine = rows.channel == c
        parts = [residual[mine & (rows.window == w)] for w in np.unique(rows.window[mine])]
        seen = [np.nan_to_num(part) for part in parts if part.size]
        out[mine] = np.sqrt(np.mean(np.concatenate(seen) ** 2) * _repeats(seen)) if seen else 0.0
    return np.maximum(out, np.sqrt(rows.variance))


def _repeats(parts: Sequence[np.ndarray]) -> float:
    """How many neighbouring rows repeat each other: 1 + 2 (rho_1 + rho_2 + ..), up to the first
    autocorrelation that is none (Geyer, Statistical Science 7, 1992)."""
    total, out = sum(float(p @ p) for p in parts), 1.0
    for lag in range(1, max(p.size for p in parts)):
        rho = sum(float(p[lag:] @ p[:-lag]) for p in parts) / max(total, 1e-300)
        if rho <= NOTHING:
            break
        out += 2 * rho
    return out


def _over_noise(linear: Linear) -> float:
    """Mean square of the residual, over the noise's."""
    return float(np.mean(np.nan_to_num(linear.residual) ** 2 / linear.rows.variance))


def _cost(composed: Composed, point: Point) -> float:
    """Mean square of free runs' residuals in units of the channels' spread; infinite where a run diverges or
    leaves that spread."""
    left = composed.rows.observed - base_at(composed, point).rows
    if not np.isfinite(left).all():
        return np.inf
    cost = float(np.mean((left / _spread(composed)) ** 2))
    return cost if cost < len(composed.rows.channels) else np.inf


def _spread(composed: Composed) -> np.ndarray:
    """Standard deviation (N,) of each row's channel over all logs."""
    channel, seen = composed.rows.channel, composed.rows.observed
    count = np.maximum(np.bincount(channel), 1)
    away = seen - (np.bincount(channel, seen) / count)[channel]
    return np.sqrt(np.maximum((np.bincount(channel, away**2) / count)[channel], composed.rows.variance))


def without_starts(composed: Composed, linear: Linear, scale: np.ndarray) -> Whiten:
    """A whitener that divides rows by a scale (N,) and removes what their log's uncertain start explains: (1
    + U U')^(-1/2), by the singular values of U."""
    parts = []
    for window, rows in zip(composed.windows, linear.rows.of, strict=True):
        doubt = [linear.starts[n][rows] * d for n, d in window.doubt.items()]
        if doubt:
            left, value, _ = np.linalg.svd(np.array(doubt).T / scale[rows, None], full_matrices=False)
            parts.append((rows, left, 1 - 1 / np.sqrt(1 + value**2)))

    def whiten(values: np.ndarray) -> np.ndarray:
        out = values / (scale if values.ndim == 1 else scale[:, None])
        for rows, left, less in parts:
            inner = (left.T @ out[rows]).T * less
            out[rows] = out[rows] - (left @ inner.T)
        return out

    return whiten


def _whitener(composed: Composed, linear: Linear) -> Whiten:
    """A whitener by the rows' scales and starts."""
    return without_starts(composed, linear, _scales(composed, linear.residual))


def _least_squares(
    composed: Composed, point: Point, steps: int, free: Sequence[str]
) -> tuple[Point, Linear, Whiten]:
    """Fit the `free` effects from a point.

    Returns:
        The point, the gap linearised there, and how its rows are whitened.
    """
    linear = linearise(composed, point, [])
    for _ in range(ROUNDS if steps == STEPS else 1):
        point = fit_effects(composed, linear, _whitener(composed, linear), point, free, steps)
        linear = linearise(composed, point, [], linear.starts)
    return point, linear, _whitener(composed, linear)


def _sensitivities(
    composed: Composed, point: Point, linear: Linear, whiten: Whiten, free: Sequence[str]
) -> tuple[tuple[tuple[str, str], ...], np.ndarray, np.ndarray, np.ndarray]:
    """What the logs tell of the free effects' parameters.

    Returns:
        Their names, the priors' sd (p,), the logs' information (p, p) in these units, and the covariance (p,
            p).
    """
    names = tuple((e, p) for e in free for p in composed.effects[e].parameters)
    sd = np.array([composed.effects[e].parameters[p].sd for e, p in names])
    base, columns = base_at(composed, point), np.zeros((linear.residual.size, len(names)))
    for effect in free:
        mine, step = np.array([e == effect for e, _ in names]), None
        for _ in range(2):  # by a usual step, then one as fine as the parameter is determined
            one = vary(composed, base, effect, step=step, shifted=False)
            if one is None:
                break
            columns[:, mine] = whiten(np.nan_to_num(one.jacobian)) * sd[mine]
            step = np.clip(1 / np.sqrt(1 + np.sum(columns[:, mine] ** 2, 0)), FINEST, STEP)
    information = columns.T @ columns
    return names, sd, information, np.linalg.inv(information + np.eye(sd.size)) * np.outer(sd, sd)


def _held_out(
    composed: Composed, found: Point, free: Sequence[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Root mean squares by channel of free runs along held-out logs, nominal and fitted to the others."""
    rows, nominal = composed.rows, {n: composed.effects[n].neutral() for n in found}
    before = rows.observed - base_at(composed, nominal).rows
    every = range(len(composed.recordings))
    after, fold = np.full(rows.log.size, np.nan), folds_of(rows, len(every), every)
    for number in np.unique(fold):
        mine = fold == number
        train, test = (composed.among(np.unique(rows.window[m]).tolist()) for m in (~mine, mine))
        point, _, _ = _least_squares(train, found, AGAIN, free)
        after[mine] = rows.observed[mine] - base_at(test, point).rows
    return rows.rms(before), rows.rms(after)
