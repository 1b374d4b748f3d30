"""An unchanged robot: what logs of it, run freely, tell of its parameters and of what the model gets wrong.

See `simgap.robots.changes` for the model. Rows are recorded less simulated values in units of their channel's
scale, less what the uncertain start of their log explains. What a model leaves has long tails (a command that
comes late, an arm that sticks), so rows are Student-t (Lange, Little & Taylor, Journal of the American
Statistical Association 84, 1989). They are far from independent: certainty is judged between motions, never
by the number of rows. A sample that jumps away from both neighbours and back is no reading and is left out.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.errors import InputError
from hmmseg.robust import robust_sd
from simgap.robots.calibrate import Calibration, without_starts
from simgap.robots.fit import Cost, Local, minimise
from simgap.robots.linear import base_at, linearise, vary
from simgap.robots.model import Composed, Point, motions
from simgap.robots.rows import resolution
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

BROKEN = 10.0  # chosen: times the distance from the neighbours' mean that 5 % of samples exceed
TAILS = 4.0  # cited: degrees of freedom of what a model leaves (Lange et al.)
UNITS = 4  # numerics: motions; fewer are cut into stretches
POSITIVE = 0.3  # numerics: sds above which a parameter that cannot be negative is varied by factors
STEP = 0.02  # numerics: coordinates: a finite difference
FAR = 1.0  # numerics: coordinates: the longest step of a fit
ROUNDS = 2  # numerics: fits to OLD, each with the scales and dependence of the last one


@dataclass(frozen=True)
class Broken:
    """A sample that no robot can have made, left out: `value` of a log's channel at `time` [s]."""

    log: str
    channel: str
    time: float
    value: float


def without_broken(
    simulator: Simulator, recordings: Sequence[Recording]
) -> tuple[list[Recording], list[Broken]]:
    """The recordings without samples that jump away from both neighbours and back at once."""
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
    """Coordinates of effects' parameters about a point.

    `names`: effect and parameter; `at`: values (k,) at coordinates 0; `scale`: values per coordinate (k,), of
    those not varied by factors; `log`: whether a parameter is varied by factors (k,); `low`, `high`: bounds
    (k,).
    """

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


class Runs:
    """Logs run freely: standardised rows, their derivatives, and what each unit of the logs tells.

    A unit is a motion or a stretch of it: `unit` (N,) of each row. Units of equal number make the same
    motion, in other logs too.
    """

    def __init__(
        self, composed: Composed, point: Point, unit: np.ndarray, scale: np.ndarray | None = None
    ) -> None:
        self.composed, self.unit, self.log = composed, unit, composed.rows.log
        self.linear = linearise(composed, point, [])
        if not np.isfinite(self.linear.residual).all():
            raise InputError("simulator", "does not follow a whole log", "a model that stays finite")
        self.units = np.unique(unit)
        self.set_scales(self._scales() if scale is None else scale)

    def set_scales(self, scale: np.ndarray) -> None:
        """Use these scales by channel (C,)."""
        self.scale = scale
        self.standard = without_starts(self.composed, self.linear, scale[self.composed.rows.channel])

    def _scales(self, values: np.ndarray | None = None) -> np.ndarray:
        """Student's scale of every channel (C,), by expectation-maximisation."""
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

    def rescale(self, point: Point) -> None:
        """Re-estimate the scales from what the model leaves at a point."""
        self.set_scales(self._scales(self.rows(point) * self.scale[self.composed.rows.channel]))

    def rows(self, point: Point) -> np.ndarray:
        """Recorded less simulated values, standardised (N,); not finite where a run diverged."""
        return self.standard(self.composed.rows.observed - base_at(self.composed, point).rows)

    def slopes(
        self, point: Point, of: Coordinates, x: np.ndarray, only: Collection[str] | None = None
    ) -> np.ndarray:
        """Derivatives (N, k) of simulated values by coordinates, standardised.

        Args:
            point: The point.
            of: Coordinates.
            x: The point's coordinates (k,).
            only: Effects whose derivatives are wanted, the others' being 0; all by default.
        """
        base, out = base_at(self.composed, point), np.zeros((self.log.size, len(of.names)))
        sizes = of.slopes(x)
        for effect in dict.fromkeys(e for e, _ in of.names if only is None or e in only):
            mine = np.array([e == effect for e, _ in of.names])
            sd = np.array([p.sd for p in self.composed.effects[effect].parameters.values()])
            step = STEP * np.maximum(sizes[mine], 1e-6 * sd) / sd
            one = vary(self.composed, base, effect, step=step, shifted=False)
            if one is not None:
                out[:, mine] = np.nan_to_num(one.jacobian) * sizes[mine]
        return self.standard(out)

    def information(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By unit the information (M, q, q) on the columns' coordinates and minus the gradient (M, q)."""
        heavy = weights(rows)
        each = [self.unit == u for u in self.units]
        return (
            np.array([columns[m].T @ (heavy[m, None] * columns[m]) for m in each]),
            np.array([columns[m].T @ (heavy[m] * rows[m]) for m in each]),
        )

    def losses(self, point: Point, number: int) -> tuple[float, float]:
        """The loss at a point, summed over all rows but a unit's, and that unit's mean [nats]; large where a
        run diverges."""
        each = loss(np.nan_to_num(self.rows(point), nan=1e6, posinf=1e6, neginf=-1e6))
        mine = self.unit == self.units[number] if number >= 0 else np.zeros(each.size, bool)
        return float(each[~mine].sum()), float(each[mine].mean()) if mine.any() else np.nan


def weights(rows: np.ndarray) -> np.ndarray:
    """Weights (n,) of standardised rows in a step of least squares."""
    return (TAILS + 1) / (TAILS + rows**2)


def loss(rows: np.ndarray) -> np.ndarray:
    """Minus the log likelihood (n,) of standardised rows, up to a constant."""
    return (TAILS + 1) / 2 * np.log1p(rows**2 / TAILS)


def best_of_halves(cost: Cost, x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The best of a step and its halves, as straight lines may take it too far."""
    tried = [x + part * np.clip(step, -FAR, FAR) for part in (1.0, 0.5, 0.25, 0.125)]
    return min(tried, key=cost)


@dataclass(frozen=True)
class Old:
    """What is known of the unchanged robot.

    `point`: its parameters; `theta`: coordinates about it of the p fitted parameters; `units`: the M units of
    its logs; `information`, `pull`: on `theta` by unit (M, p, p), (M, p); `prior`: curvature of the prior (p,
    p), weighted like the rows; `dependence`: the number of dependent rows that count as one: units' pulls
    scatter so much more than those of independent rows would; `missed`: loss (M,) of units that took no part
    [nats a row]; `scale`: the channels' scales (C,).
    """

    point: Point
    theta: Coordinates
    units: np.ndarray
    information: np.ndarray
    pull: np.ndarray
    prior: np.ndarray
    dependence: float
    missed: np.ndarray
    scale: np.ndarray

    @property
    def bend(self) -> np.ndarray:
        """The curvature (p, p) of what OLD's logs and the prior say of `theta`."""
        return self.information.sum(0) + self.prior


def fit_old(composed: Composed, calibration: Calibration | None, unit: np.ndarray) -> Old:
    """Fit OLD logs of an unchanged robot, starting from its calibration.

    The prior is weighted by `dependence`, as rows do not count singly.

    Args:
        composed: The model along the logs.
        calibration: On the same logs; None where nothing is fitted.
        unit: Unit (N,) of each row.
    """
    point: Point = {} if calibration is None else {n: dict(v) for n, v in calibration.point.items()}
    names = () if calibration is None else calibration.names  # of laws that none lacks there are none
    fitted = [e for e in dict.fromkeys(e for e, _ in names) if not composed.effects[e].numeric]
    runs = Runs(composed, point, unit)
    known = [composed.effects[e].parameters[s] for e in fitted for s in composed.effects[e].parameters]
    nominal, sd = np.array([q.nominal for q in known]), np.array([q.sd for q in known])
    p, m, dependence = len(known), len(runs.units), 1.0

    def prior(z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Minus the log prior at coordinates, its curvature (p, p), and minus its gradient (p,)."""
        off, slope = (theta.values(z) - nominal) / sd, theta.slopes(z) / sd
        return 0.5 * dependence * float(off @ off), dependence * np.diag(slope**2), -dependence * slope * off

    def cost(z: np.ndarray) -> float:
        rows = runs.rows(theta.point(point, z))
        return float(loss(rows).sum()) + prior(z)[0] if np.isfinite(rows).all() else np.inf

    def told(z: np.ndarray) -> Local:  # by unit
        there = theta.point(point, z)
        return runs.information(runs.rows(there), runs.slopes(there, theta, z))

    def local(z: np.ndarray) -> Local:
        (information, pull), (_, bend, push) = told(z), prior(z)
        return information.sum(0) + bend, pull.sum(0) + push

    none = np.zeros(p)
    for _ in range(ROUNDS):
        runs.rescale(point)
        theta = Coordinates.of(composed, point, fitted)
        point = theta.point(point, minimise(cost, local, none, far=FAR))
        runs.rescale(point)
        theta = Coordinates.of(composed, point, fitted)
        information, pull = told(none)
        if p and m > 1:  # as if every row were so many
            spread = np.linalg.solve(information.sum(0) + prior(none)[1], pull.T @ pull)
            dependence = max(1.0, float(np.trace(spread)) * m / (m - 1) / p)
    _, bend, push = prior(none)
    bend, missed = bend + 1e-9 * np.eye(p), np.zeros(m)
    for u in range(m):

        def without(z: np.ndarray, u: int = u) -> float:
            return runs.losses(theta.point(point, z), u)[0] + prior(z)[0]

        less = information.sum(0) - information[u] + bend
        step = np.linalg.lstsq(less, pull.sum(0) - pull[u] + push, rcond=None)[0]
        missed[u] = runs.losses(theta.point(point, best_of_halves(without, none, step)), u)[1]
    return Old(point, theta, runs.units, information, pull, bend, dependence, missed, runs.scale)


def units_of(old: Composed, new: Composed) -> tuple[np.ndarray, np.ndarray]:
    """The unit of every row of OLD and of NEW.

    A unit is a motion, because a model is wrong in the same way all along it. Where NEW makes few motions,
    all of which OLD makes too, it is a stretch of one.
    """
    every = motions(old.simulator, [*old.recordings, *new.recordings])
    number = every[: len(old.recordings)], every[len(old.recordings) :]
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
