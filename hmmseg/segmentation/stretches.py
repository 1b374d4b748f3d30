"""Stretches at rest of a recording: loads, and the displacement of the pads under them.

A rounded or soft tip meets its block with a small patch that grows under pressure, so the first tenth of a
newton moves it further than the last (Hertz 1882; fingertips of flesh and of rubber alike: Pawluk and Howe
1999). Its give is a straight line after a toe,

    give(load) = compliance x load + depth (1 - exp(-load / soft)).

A straight line alone would end such a contact while it is still pressed: by 25 ms with a robot arm's stock
pads. A separate straight line is removed from each stretch at rest, so that differences between contacts do
not pass for curvature; the depth is common to all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.hand.signals import Signals
from hmmseg.levels import MOVED, SETTLING, SHOWN, SURE, TAIL, decisive
from hmmseg.robust import robust_sd
from hmmseg.segmentation.emissions import Parameters, channel_sd


def lagging(values: np.ndarray, kept: np.ndarray, place: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Output of first-order filters fed with evenly spaced signals (..., num_steps), at N times (..., N, C).

    `kept` (C,): share of the past that each filter keeps in a step; the input is constant before the first
    step. `place` (N,), non-decreasing: the step before each time; `share` (N,): its fraction of the way to
    the next.
    """
    steps = np.empty((*values.shape, kept.size))
    steps[..., 0, :] = values[..., :1]
    for s in range(1, values.shape[-1]):  # y = (1 - kept) x + kept y
        steps[..., s, :] = (1 - kept) * values[..., s, None] + kept * steps[..., s - 1, :]
    share = share[:, None]
    return (1 - share) * steps[..., place, :] + share * steps[..., place + 1, :]


SOFTS = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)  # numerics: N; scale of a toe's load, a factor of two apart
DEPENDENT = 0.5  # prior: share of the samples of a stretch that are independent evidence
DEPTH = 5e-4  # prior: m; sd of the depth of a toe
ROUNDED = 0.5  # prior: share of contacts whose tips are rounded or soft enough for a toe
ROUNDS = 6  # numerics: of reweighting
LEVEL = 1e-28  # numerics: relative variance that rounding leaves of equal loads
Reading = tuple[np.ndarray, np.ndarray, float]  # loads [N], values [m] and their noise [m] of one stretch


@dataclass(frozen=True)
class Toe:
    """Give of a contact beyond its straight line: `depth` [m], and scale `soft` [N] of the measured load."""

    depth: float = 0.0
    soft: float = 1.0

    def give(self, load: np.ndarray) -> np.ndarray:
        """Give [m] at each load [N]; none below 0."""
        return self.depth * -np.expm1(-np.maximum(load, 0.0) / self.soft)

    @property
    def slope(self) -> float:
        """Additional compliance [m/N] at zero load."""
        return self.depth / self.soft


NONE = Toe()


def find_toe(readings: Sequence[Reading]) -> Toe:
    """The toe common to all stretches, or NONE.

    Loads are those of the contact itself, 0 where it ends.
    """
    readings = [r for r in readings if r[0].size > 3]
    if not readings:
        return NONE
    usual = float(np.median([sd for *_, sd in readings]))
    # Loads and values (num_stretches, N) of all stretches, zero-padded, and a mask of samples.
    sizes = np.array([load.size for load, *_ in readings])
    there = np.arange(sizes.max()) < sizes[:, None]
    load, value = np.zeros(there.shape), np.zeros(there.shape)
    load[there], value[there] = (np.concatenate([r[i] for r in readings]) for i in range(2))
    straight = _depths(load, value, np.zeros((1, *load.shape)), there, usual)[1]
    scale = max(usual, robust_sd(straight[0][there]))
    toes = np.stack([Toe(1.0, soft).give(load) for soft in SOFTS])
    depth, residual, precision = _depths(load, value, toes, there, scale)
    gain = _evidence(residual, there, scale) - _evidence(straight, there, scale) - (depth / DEPTH) ** 2 / 2
    gain -= np.log(DEPTH**2 * precision) / 2  # depth integrated out (Laplace)
    best = int(gain.argmax())
    sure = np.logaddexp.reduce(gain) - np.log(len(SOFTS)) > decisive(ROUNDED) and depth[best] > 0
    return Toe(float(depth[best]), SOFTS[best]) if sure else NONE


def _evidence(residual: np.ndarray, there: np.ndarray, scale: float) -> np.ndarray:
    """Log-likelihoods (K,) of residuals (K, num_stretches, N)."""
    cost = np.log1p((residual / scale) ** 2 / TAIL) * there
    return -DEPENDENT * (TAIL + 1) / 2 * cost.sum(axis=(1, 2))


def _depths(
    load: np.ndarray, value: np.ndarray, toes: np.ndarray, there: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Common depth [m] (K,) of toes of K shapes, residuals, and the precision [1/m^2] (K,) of the depth.

    `load`, `value` (num_stretches, N), each stretch with its own straight line; `toes` (K, num_stretches, N)
    of unit depth; `there`: mask of samples. Student-t, reweighted.
    """
    weight = np.broadcast_to(there, toes.shape).astype(float)
    depth = residual = curved = np.zeros(0)
    for _ in range(ROUNDS):
        total = weight.sum(axis=-1, keepdims=True)
        x, bent, left = (v - (weight * v).sum(axis=-1, keepdims=True) / total for v in (load, toes, value))
        wx = weight * x
        spread = (wx * x).sum(axis=-1, keepdims=True)
        steep = spread > LEVEL * (weight * load**2).sum(axis=-1, keepdims=True)
        slope = wx / np.where(steep, spread, np.inf)
        bent = bent - (slope * bent).sum(axis=-1, keepdims=True) * x
        left = left - (slope * left).sum(axis=-1, keepdims=True) * x
        curved = (weight * bent**2).sum(axis=(1, 2)) + (scale / DEPTH) ** 2
        depth = -(weight * bent * left).sum(axis=(1, 2)) / curved
        residual = left + depth[:, None, None] * bent
        weight = there * ((TAIL + 1) / (TAIL + (residual / scale) ** 2))
    return depth, residual, DEPENDENT * curved / scale**2 + (1 - DEPENDENT) / DEPTH**2


SUPPORTED = 0.85  # chosen: share of a block's weight on the fingers below which it surely rests
FARTHEST = 0.5  # numerics: s; values further from a contact than any candidate delay are dropped


@dataclass(frozen=True)
class Stretch:
    """Samples (N,) in contact at rest, with times t [s] and loads [N], and values around them.

    `interval` [s]: median time between samples. `place` (M,): values at `clock` (M,) [s], `sd` [m] their
    noise, `pace` (M,) [m/s] how fast they change. A `toe` is removed when the contact is read.
    """

    t: np.ndarray
    load: np.ndarray
    interval: float
    clock: np.ndarray
    place: np.ndarray
    sd: float
    pace: np.ndarray
    toe: Toe = NONE


def stretches(
    s: Signals, start: float, end: float, weight: float, p: Parameters
) -> tuple[Stretch | None, Stretch | None]:
    """One hold on the ground as stretches of the fingers' distance and height, while both fingers press.

    `start` and `end` [s] are those of its alignment, to a sample or two. A block of this `weight` [N] surely
    rests while its support carries part of it.
    """
    inside = (s.t >= start) & (s.t <= end)
    sd_force = p.force_sd(s)
    fx1, fx2 = s.fx1 - p.bias[0], s.fx2 - p.bias[2]
    fy = s.fy1 + s.fy2 - p.bias[1] - p.bias[3]
    noise = np.sqrt(2.0) * sd_force
    resting = fy < min(SUPPORTED * weight, weight - SHOWN * noise)
    pressing = inside & (fx1 > SURE * sd_force) & (-fx2 > SURE * sd_force)
    out = list[Stretch | None]()
    for load, value, rate, stated, within in (
        (fx1 - fx2, s.distance, s.vx2 - s.vx1, 2 * s.sd_x / np.sqrt(2), True),
        (-fy / 2, s.y, s.vy, s.sd_y / np.sqrt(2), resting),
    ):
        use = pressing & within & np.isfinite(load)
        there = np.isfinite(value)
        if use.sum() < 4 or there.sum() < 4:
            out.append(None)
            continue
        interval = float(np.median(np.diff(s.t, prepend=2 * s.t[0] - s.t[1])[use]))
        sd, t = channel_sd(stated, value), s.t[use]
        there &= (s.t >= t[0] - FARTHEST) & (s.t <= t[-1] + FARTHEST)
        pace = np.abs(np.nan_to_num(rate[there]))
        out.append(Stretch(t, load[use], interval, s.t[there], value[there], max(sd, 1e-9), pace))
    return out[0], out[1]


def steepest(s: Signals, start: float, end: float, p: Parameters) -> list[float]:
    """Largest ratio of shear to grip force that each finger surely reaches between two times [s]."""
    inside = (s.t >= start) & (s.t <= end)
    sd, out = p.force_sd(s), []
    for grip, shear in ((s.fx1 - p.bias[0], s.fy1 - p.bias[1]), (-(s.fx2 - p.bias[2]), s.fy2 - p.bias[3])):
        use = inside & (grip > SURE * sd) & np.isfinite(shear)
        if use.any():
            out.append(max(float(np.max((np.abs(shear[use]) - sd) / (grip[use] + sd))), 0.0))
    return out


def ringing(s: Signals, start: float, end: float, p: Parameters) -> list[tuple[float, float, float]]:
    """Residual loads [N] after the fingers have left a hold, if any: ringing, or late forces.

    Looks at the samples after its end, while it settles and the fingers are farther apart than any pad gives,
    so that there is no contact. Returns the largest load along the grip and in shear, and the swing along the
    grip to either side, which a mere delay does not produce.
    """
    held = (s.t >= start) & (s.t <= end) & np.isfinite(s.distance)
    if not held.any():
        return []
    after = (s.t > end) & (s.t <= end + SETTLING)
    left = after & (s.distance - np.median(s.distance[held]) > MOVED)
    force = (np.stack([s.fx1, s.fy1, s.fx2, s.fy2]) - np.asarray(p.bias)[:, None])[:, left]
    force = force[:, np.isfinite(force).all(axis=0)]
    if not force.size:
        return []
    most, least = force.max(axis=1), -force.min(axis=1)
    x1, y1, x2, y2 = np.maximum(most, least)
    swing1, _, swing2, _ = np.maximum(np.minimum(most, least), 0.0)
    return [(float(np.hypot(x1, x2)), float(np.hypot(y1, y2)) / 2, float(np.hypot(swing1, swing2)))]


def reading(s: Stretch, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corresponding loads and values (M,), and paces, for forces that are `shift` s late.

    Loads are interpolated to the times of the values, whose noise matters more; up to the shift beyond the
    first and the last, which are the most informative, they are extrapolated. A toe is removed from the
    values.
    """
    t, late = s.t, s.clock + shift
    if t.size < 2:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    after = np.clip(np.searchsorted(t, late), 1, t.size - 1)
    step, edge = np.diff(t)[after - 1], abs(shift) + 1e-9
    # Linear between two loads, and beyond the first and the last.
    load = s.load[after - 1] + (s.load[after] - s.load[after - 1]) * ((late - t[after - 1]) / step)
    within = (late >= t[0] - edge) & (late <= t[-1] + edge) & (step < 1.5 * s.interval)
    return load[within], s.place[within] + s.toe.give(load[within]), s.pace[within]


def fit_slope(load: np.ndarray, value: np.ndarray, sd: np.ndarray | float) -> tuple[float, float]:
    """Slope -dvalue/dload of samples (N,) and its information; Student-t, reweighted.

    `sd`: noise of the values. Noise of the loads, bounded by the residual of the values, would flatten the
    slope by its share of their variance, which counts as uncertainty. Both are 0 for fewer than four samples,
    or equal loads.
    """
    own = trust(sd, load.size)
    weight, slope, information = own, 0.0, 0.0
    for _ in range(ROUNDS - 1 if load.size > 3 else 0):
        x, y = (v - np.average(v, weights=weight) for v in (load, value))
        square = float(weight @ x**2)
        if square <= 0:
            return 0.0, 0.0
        slope = -float((weight * x) @ y) / square
        left = (y + slope * x) ** 2
        scale2 = max(float(weight @ left) / (load.size - 2), float(np.min(sd)) ** 2)
        weight = own * (TAIL + 1) / (TAIL + own * left / scale2)
        flattened = slope * min(scale2 * float(weight.sum()) / max(slope**2 * square, 1e-300), 1.0)
        information = 1 / (scale2 / square + flattened**2)
    return slope, information


def trust(sd: np.ndarray | float, size: int) -> np.ndarray:
    """Weights (size,) of samples with this noise, 1 for the best."""
    return (np.min(sd, initial=np.inf) / sd) ** 2 * np.ones(size)
