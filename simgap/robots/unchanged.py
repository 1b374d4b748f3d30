"""What is known of a robot that did not change, from logs of it run freely.

See `simgap.robots.changes` for the model. A sample that jumps away from both neighbours and back is no
reading and left out. Rows are recorded less simulated values in units of their channel's scale, less what the
uncertain start of their log makes of them. What a model leaves has long tails (a command that comes late, an
arm that sticks), so rows are Student-t (Lange, Little & Taylor, Journal of the American Statistical
Association 84, 1989). They are far from independent: what is sure is judged between motions, never by the
number of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.errors import InputError
from hmmseg.robust import robust_sd
from simgap.robots.calibrate import Calibration
from simgap.robots.linear import base_at, linearise, vary
from simgap.robots.model import Composed, Point
from simgap.robots.rows import resolution
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

BROKEN = 10.0  # chosen: of what 5 % of samples leave the mean of their neighbours by, a sample that is broken
TAILS = 4.0  # cited: degrees of freedom of what a model leaves, as Lange et al. fix them
ALIKE = 0.1  # chosen: of a command's usual size; logs whose commands are closer than this are of one motion
UNITS = 4  # numerics: motions, below which each is cut into stretches
POSITIVE = 0.3  # numerics: of its sd, above which a parameter that cannot be negative is varied by factors
STEP = 0.02  # numerics: of a finite difference
STEPS, FAR = 10, 1.0  # numerics: of a fit, and how far each goes at most, in coordinates
GAINED = 1e-3  # numerics: of a fit's cost, what a step must gain for it to go on
WIDER = (8.0, 4.0, 2.0, 1.0)  # numerics: scales of tails, first wider than they are


@dataclass(frozen=True)
class Broken:
    """A sample that no robot can have made: `value` of a channel of a log at `time` [s], left out."""

    log: str
    channel: str
    time: float
    value: float


def without_broken(
    simulator: Simulator, recordings: Sequence[Recording]
) -> tuple[list[Recording], list[Broken]]:
    """The recordings with samples left out that jump away from both neighbours and back at once."""
    out, found = [], []
    for log in recordings:
        columns = {}
        for name, channel in simulator.channels.items():
            if channel.kind == "command":
                continue
            values = log[name]
            seen = np.flatnonzero(np.isfinite(values))
            if seen.size < 5:
                continue
            v = values[seen]
            before, after = np.append(v[0], v[:-1]), np.append(v[1:], v[-1])  # an end has one neighbour only
            off = v - (before + after) / 2
            out_of = (np.sign(v - before) == np.sign(v - after)) & (v != before) & (v != after)
            size = np.abs(off)
            usual = max(float(robust_sd(off)), float(np.quantile(size, 0.95)), resolution(values), 1e-300)
            beside = np.maximum(np.append(size[1:], 0.0), np.append(0.0, size[:-1]))  # of a wild one: half
            wrong = seen[out_of & (size > BROKEN * usual) & (size > 1.5 * beside)]
            if wrong.size:
                columns[name] = np.where(np.isin(np.arange(values.size), wrong), np.nan, values)
                found += [Broken(log.name, name, float(log.t[k]), float(values[k])) for k in wrong]
        out.append(log.with_columns(columns) if columns else log)
    return out, found


@dataclass(frozen=True)
class Coordinates:
    """How parameters of effects are varied: `names` (effect, short), `at` (k,) their values at 0, `scale`
    (k,), `log` (k,) whether by factors, bounds."""

    names: tuple[tuple[str, str], ...]
    at: np.ndarray
    scale: np.ndarray
    log: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, composed: Composed, point: Point, effects: Sequence[str]) -> Coordinates:
        """Of all parameters of some effects about a point."""
        names = tuple((e, p) for e in effects for p in composed.effects[e].parameters)
        known = [composed.effects[e].parameters[p] for e, p in names]
        at = np.array([point.get(e, {}).get(p, q.nominal) for (e, p), q in zip(names, known, strict=True)])
        sd, low = np.array([q.sd for q in known]), np.array([q.low for q in known])
        log = (low >= 0) & (at > POSITIVE * np.minimum(sd, np.maximum(at, 1e-300) * 1e3)) & (at > 0)
        return cls(names, at, np.where(log, 1.0, sd), log, low, np.array([q.high for q in known]))

    def values(self, x: np.ndarray) -> np.ndarray:
        """Values (k,) at coordinates, within bounds."""
        moved = np.where(self.log, self.at * np.exp(np.clip(x, -7, 7)), self.at + self.scale * x)
        return np.clip(moved, self.low, self.high)

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Derivatives (k,) of values by coordinates."""
        return np.where(self.log, self.values(x), self.scale)

    def point(self, base: Point, x: np.ndarray) -> Point:
        """A point with these coordinates."""
        out = {e: dict(v) for e, v in base.items()}
        for (effect, short), value in zip(self.names, self.values(x), strict=True):
            out.setdefault(effect, {})[short] = float(value)
        return out


Motion = list[tuple[np.ndarray, np.ndarray, float]]  # by command times [s], values, and their usual size


def motions_of(composed: Composed) -> list[Motion]:
    """What every log's commands are."""
    logs, known = composed.recordings, composed.simulator.channels
    out: list[Motion] = [[] for _ in logs]
    for name in (n for n, c in known.items() if c.kind == "command"):
        every = np.concatenate([log[name] for log in logs])
        size = float(np.std(every) + abs(np.mean(every)))
        for mine, log in zip(out, logs, strict=True):
            mine.append((log.t - log.t[0], log[name], max(size, 1e-300)))
    return out


def of_one_motion(one: Motion, other: Motion) -> bool:
    """Whether commands are alike: logs of one motion share what a model gets wrong."""
    far = []
    for (t, a, size), (u, b, _) in zip(one, other, strict=True):
        both = t <= min(t[-1], u[-1])
        far.append(float(np.sqrt(np.mean((a[both] - np.interp(t[both], u, b)) ** 2))) / size)
    return bool(far) and max(far) < ALIKE


class Runs:
    """Logs run freely about a model: standardised rows, their derivatives, and how units of logs tell of
    parameters.

    `unit` (N,): the motion that a row's log makes, or a stretch of it; units with the same number make the
    same motion in other logs too.
    """

    def __init__(
        self, composed: Composed, point: Point, unit: np.ndarray, scale: np.ndarray | None = None
    ) -> None:
        self.composed, self.unit, self.log = composed, unit, composed.rows.log
        self.linear = linearise(composed, point, [])
        if not np.isfinite(self.linear.residual).all():
            raise InputError("simulator", "does not follow a whole log", "a model that stays finite")
        self.units = np.unique(unit)
        self.scaled(self._scales() if scale is None else scale)

    def scaled(self, scale: np.ndarray) -> None:
        """Use these scales by channel (C,); starts are taken out in their units."""
        rows, starts = self.composed.rows, self.linear.starts
        self.scale, self.parts = scale, []
        for window, mine in zip(self.composed.windows, rows.of, strict=True):
            doubt = [starts[state][mine] * sd for state, sd in window.doubt.items()]
            if doubt:
                away = np.array(doubt).T / scale[rows.channel[mine], None]
                left, value, _ = np.linalg.svd(away, full_matrices=False)
                self.parts.append((mine, left, value**2 / (1 + value**2)))

    def _scales(self, values: np.ndarray | None = None) -> np.ndarray:
        """Student's scale of every channel (C,), by expectation and maximisation."""
        rows = self.composed.rows
        left = self.linear.residual if values is None else values
        out = np.ones(len(rows.channels))
        for c in range(out.size):
            mine = left[rows.channel == c]
            floor = np.sqrt(rows.variance[rows.channel == c].mean())
            s2 = float(np.median(mine**2)) + floor**2
            for _ in range(30):
                s2 = max(float(np.mean((TAILS + 1) / (TAILS + mine**2 / s2) * mine**2)), floor**2)
            out[c] = np.sqrt(s2)
        return out

    def rescaled(self, point: Point, wider: float = 1.0) -> None:
        """Learn scales from what the model leaves at a point, and take so many times as wide ones."""
        left = self.rows(point)
        self.scaled(wider * self._scales(left * self.scale[self.composed.rows.channel]))

    def standard(self, values: np.ndarray) -> np.ndarray:
        """Rows (N,) or columns (N, c) in units of their scale, starts taken out."""
        size = self.scale[self.composed.rows.channel]
        out = values / (size if values.ndim == 1 else size[:, None])
        for rows, left, less in self.parts:
            out[rows] -= left @ ((left.T @ out[rows]).T * less).T
        return out

    def rows(self, point: Point) -> np.ndarray:
        """Recorded less simulated, standardised (N,); not finite where a run diverged."""
        return self.standard(self.composed.rows.observed - base_at(self.composed, point).rows)

    def slopes(
        self, point: Point, of: Coordinates, x: np.ndarray, only: Collection[str] | None = None
    ) -> np.ndarray:
        """Derivatives (N, k) of what is simulated, standardised, at a point that has coordinates x; 0 for all
        but some effects, where these are named."""
        base, out = base_at(self.composed, point), np.zeros((self.log.size, len(of.names)))
        sizes = of.slopes(x)
        for effect in dict.fromkeys(e for e, _ in of.names if only is None or e in only):
            mine = np.array([e == effect for e, _ in of.names])
            sd = np.array([p.sd for p in self.composed.effects[effect].parameters.values()])
            step = STEP * np.maximum(sizes[mine], 1e-6 * sd) / sd
            one = vary(self.composed, base, self.linear.starts, effect, step=step, shifted=False)
            if one is not None:
                out[:, mine] = np.nan_to_num(one.jacobian) * sizes[mine]
        return self.standard(out)

    def told(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By unit the information (M, q, q) of columns' coordinates and the pull (M, q) on them."""
        heavy = weights(rows)
        each = [self.unit == u for u in self.units]
        return (
            np.array([columns[m].T @ (heavy[m, None] * columns[m]) for m in each]),
            np.array([columns[m].T @ (heavy[m] * rows[m]) for m in each]),
        )

    def losses(self, point: Point, number: int) -> tuple[float, float]:
        """The summed loss of all rows but a unit's, and the mean of that unit's, at a point [nats]; those of
        a model that diverges are large."""
        each = loss(np.nan_to_num(self.rows(point), nan=1e6, posinf=1e6, neginf=-1e6))
        mine = self.unit == self.units[number] if number >= 0 else np.zeros(each.size, bool)
        return float(each[~mine].sum()), float(each[mine].mean()) if mine.any() else np.nan


def weights(rows: np.ndarray) -> np.ndarray:
    """Of standardised rows in a step of least squares."""
    return (TAILS + 1) / (TAILS + rows**2)


def loss(rows: np.ndarray) -> np.ndarray:
    """Minus the log likelihood of standardised rows, but for a constant."""
    return (TAILS + 1) / 2 * np.log1p(rows**2 / TAILS)


Local = tuple[np.ndarray, np.ndarray]  # information (q, q) and pull (q,)


def descended(
    cost: Callable[[np.ndarray], float], local: Callable[[np.ndarray], Local], x: np.ndarray
) -> np.ndarray:
    """Where a cost is least, from x, by Levenberg's and Marquardt's steps."""
    now, damping = cost(x), 0.0
    for _ in range(STEPS if x.size else 0):
        if not np.isfinite(now):
            break
        bend, pull = local(x)
        for _ in range(6):
            move = np.linalg.solve(bend + np.diag(damping * np.diag(bend) + 1e-9), pull)
            there = cost(x + np.clip(move, -FAR, FAR))
            if there < now:
                break
            damping = max(10 * damping, 0.01)
        else:
            break
        x, gained, now = x + np.clip(move, -FAR, FAR), now - there, there
        damping /= 10
        if gained < GAINED * now:
            break
    return x


def halved(cost: Callable[[np.ndarray], float], x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Where a step leads that straight lines took too far: it is halved until it costs least."""
    tried = [x + part * np.clip(step, -FAR, FAR) for part in (1.0, 0.5, 0.25, 0.125)]
    return min(tried, key=cost)


@dataclass(frozen=True)
class Old:
    """What is known of a robot that did not change: its `point`, coordinates `theta` (p) about it of what is
    fitted, by unit the information (M, p, p) and pull (M, p) on them, their `prior` (p, p), `dependence`: as
    how many rows that depend on each other one counts (units' pulls scatter so much more than those of
    independent rows would, and the prior has so much more weight), how logs of a unit that took no part are
    `missed` (M,) [nats a row], and the channels' `scale` (C,)."""

    point: Point
    theta: Coordinates
    units: np.ndarray
    information: np.ndarray
    pull: np.ndarray
    prior: np.ndarray
    dependence: float
    missed: np.ndarray
    scale: np.ndarray


def _objective(
    runs: Runs, theta: Coordinates, point: Point, nominal: np.ndarray, sd: np.ndarray, dependence: float
) -> tuple[Callable[[np.ndarray], float], Callable[[np.ndarray], Local]]:
    """What OLD's fit makes least, of coordinates z (p,), and its curvature and pull there; the prior counts
    `dependence` times, as rows do not count singly."""

    def cost(z: np.ndarray) -> float:
        off, rows = (theta.values(z) - nominal) / sd, runs.rows(theta.point(point, z))
        whole = float(loss(rows).sum() + 0.5 * dependence * off @ off)
        return whole if np.isfinite(rows).all() else np.inf

    def local(z: np.ndarray) -> Local:
        there, slope = theta.point(point, z), theta.slopes(z) / sd
        bend, pull = runs.told(runs.rows(there), runs.slopes(there, theta, z))
        push = dependence * slope * (theta.values(z) - nominal) / sd
        return bend.sum(0) + dependence * np.diag(slope**2), pull.sum(0) - push

    return cost, local


def learned(composed: Composed, calibration: Calibration | None, unit: np.ndarray) -> Old:
    """What OLD logs tell of a robot that does not change, from the point of its calibration."""
    point: Point = {} if calibration is None else {n: dict(v) for n, v in calibration.point.items()}
    fitted = [e for e in point if not composed.numeric(e)]
    runs = Runs(composed, point, unit)
    known = [composed.effects[e].parameters[s] for e in fitted for s in composed.effects[e].parameters]
    nominal, sd = np.array([q.nominal for q in known]), np.array([q.sd for q in known])
    p, m, dependence = len(known), len(runs.units), 1.0
    for wider in WIDER if p else (1.0,):  # so that a log that is far off is not taken for a tail of others
        runs.rescaled(point, wider)
        theta = Coordinates.of(composed, point, fitted)

        found = descended(*_objective(runs, theta, point, nominal, sd, dependence), np.zeros(p))
        point = theta.point(point, found)
        runs.rescaled(point)
        theta, z = Coordinates.of(composed, point, fitted), np.zeros(p)
        information, pull = runs.told(runs.rows(point), runs.slopes(point, theta, z))
        slope = theta.slopes(z) / sd
        if p and m > 1:  # as if every row were so many
            spread = np.linalg.solve(information.sum(0) + dependence * np.diag(slope**2), pull.T @ pull)
            dependence = max(1.0, float(np.trace(spread)) * m / (m - 1) / p)
    prior = dependence * np.diag(slope**2) + 1e-9 * np.eye(p)
    total, missed = information.sum(0) + prior, np.zeros(m)
    rest = pull.sum(0) - dependence * slope * (theta.values(np.zeros(p)) - nominal) / sd
    for u in range(m):

        def without(z: np.ndarray, u=u) -> tuple[float, float]:
            kept, out = runs.losses(theta.point(point, z), u)
            return kept + 0.5 * dependence * float(np.sum(((theta.values(z) - nominal) / sd) ** 2)), out

        step = np.linalg.lstsq(total - information[u], rest - pull[u], rcond=None)[0]
        missed[u] = without(halved(lambda z, f=without: f(z)[0], np.zeros(p), step))[1]
    every = information, pull, prior, dependence, missed, runs.scale
    return Old(point, theta, runs.units, *every)


def units_of(old: Composed, new: Composed) -> tuple[np.ndarray, np.ndarray]:
    """The unit of every row of OLD and of NEW: the motion, or where NEW makes few, which OLD makes too, a
    stretch of it; what a model gets wrong all along a motion that OLD never made says the same in each."""
    first: list[Motion] = []
    number: list[list[int]] = [[], []]
    for mine, motions in zip(number, (motions_of(old), motions_of(new)), strict=True):
        for motion in motions:
            same = next((k for k, one in enumerate(first) if of_one_motion(motion, one)), len(first))
            first += [motion] if same == len(first) else []
            mine.append(same)
    few = len(set(number[1]))
    pieces = -(-UNITS // few) if set(number[1]) <= set(number[0]) else 1
    out = []
    for composed, mine in zip((old, new), number, strict=True):
        log, time = composed.rows.log, composed.rows.time
        unit = np.zeros(log.size, int)
        for i in np.unique(log):
            its = log == i
            order = np.argsort(np.argsort(time[its], kind="stable"), kind="stable")
            unit[its] = mine[i] * pieces + order * pieces // its.sum()
        out.append(unit)
    return out[0], out[1]
