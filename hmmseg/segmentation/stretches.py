"""Stretches at rest of a recording: loads and what they do to pads, read with forces late or filtered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hmmseg.hand.signals import Signals
from hmmseg.segmentation.emissions import TAIL, Parameters
from hmmseg.segmentation.features import noise_sd
from hmmseg.segmentation.toe import DEPENDENT, NONE, Toe

SIGNIFICANT = 5.0  # chosen: sds of force noise for a contact to be sure
# chosen: of a block's weight on the fingers: the rest is on the ground, whatever it accelerates
SUPPORTED = 0.85
KEPT = 0.6  # numerics: least share of a recording's samples in contact that a delay may leave there


@dataclass(frozen=True)
class Stretch:
    """Samples (N,) at rest: times t [s] and loads [N] in contact; value at any time.

    `before` [N] are the loads `step` [s] earlier. `place` (M,) is the value at `clock` (M,) [s],
    `sd` [m] its noise. Loads above `sure` [N] are of contact. A contact with a `toe` is read as if straight.
    """

    t: np.ndarray
    load: np.ndarray
    before: np.ndarray
    step: np.ndarray
    clock: np.ndarray
    place: np.ndarray
    sd: float
    sure: float
    toe: Toe = NONE

    @cached_property
    def interval(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(self.step))


def stretches(
    s: Signals, start: float, end: float, weight: float, p: Parameters
) -> tuple[Stretch | None, Stretch | None]:
    """One hold on the ground, as the fingers' distance and as their height, where both fingers press.

    Its alignment says `start` and `end` [s] but for a sample or two. The block of this `weight` [N]
    rests for sure where its support carries some of it.
    """
    inside = (s.t >= start) & (s.t <= end)
    sd_force = p.scale["force"] if np.isnan(s.sd_force) else s.sd_force
    fx1, fx2 = s.fx1 - p.bias[0], s.fx2 - p.bias[2]
    fy = s.fy1 + s.fy2 - p.bias[1] - p.bias[3]
    noise = np.sqrt(2.0) * sd_force
    resting = fy < min(SUPPORTED * weight, weight - 3 * noise)
    pressing = inside & (fx1 > SIGNIFICANT * sd_force) & (-fx2 > SIGNIFICANT * sd_force)
    out = []
    for load, value, stated, within, sure in (
        (fx1 - fx2, s.distance, 2 * s.sd_x / np.sqrt(2), True, 2 * SIGNIFICANT * sd_force),
        (-fy / 2, s.y, s.sd_y / np.sqrt(2), resting, -np.inf),
    ):
        use = pressing & within & np.isfinite(load)
        there = np.isfinite(value)
        if use.sum() < 4 or there.sum() < 4:
            out.append(None)
            continue
        filled = np.interp(s.t, s.t[np.isfinite(load)], load[np.isfinite(load)])
        before, step = np.r_[filled[0], filled[:-1]], np.diff(s.t, prepend=2 * s.t[0] - s.t[1])
        known = np.isfinite(stated)
        sd = float(np.median(stated[known])) if known.any() else noise_sd(value)
        out.append(Stretch(s.t[use], load[use], before[use], step[use], s.t[there], value[there],
                           max(sd, 1e-9), sure))  # fmt: skip
    return out[0], out[1]


def steepest(s: Signals, start: float, end: float, p: Parameters) -> list[float]:
    """The steepest ratio of shear to grip force that each finger shows for sure between two times [s]."""
    inside = (s.t >= start) & (s.t <= end)
    sd = p.scale["force"] if np.isnan(s.sd_force) else s.sd_force
    out = []
    for grip, shear in ((s.fx1 - p.bias[0], s.fy1 - p.bias[1]), (-(s.fx2 - p.bias[2]), s.fy2 - p.bias[3])):
        use = inside & (grip > SIGNIFICANT * sd) & np.isfinite(shear)
        if use.any():
            out.append(max(float(np.max((np.abs(shear[use]) - sd) / (grip[use] + sd))), 0.0))
    return out


def reading(
    s: Stretch, shift: float = 0.0, constant: float = 0.0, reach: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Loads and values that belong together, for forces `shift` s late or filtered.

    Loads are interpolated to the times of the values, whose noise matters more; up to `reach` [s] beyond the
    first and the last of them they are extrapolated (negative: so much at either end is left out). A
    first-order filter of this time `constant` [s] is undone exactly for an input that is steady within each
    sample interval, whose middle the result belongs to.
    """
    t, load = s.t - shift, s.load
    if constant > 0:
        kept = np.exp(-s.step / constant)
        load = (s.load - kept * s.before) / (1 - kept)
        # A filtered force lingers after its contact.
        there = load > s.sure * np.sqrt(1 + kept**2) / (1 - kept)
        t, load = (t - s.step / 2)[there], load[there]
    if t.size < 2:
        return np.zeros(0), np.zeros(0)
    after = np.clip(np.searchsorted(t, s.clock), 1, t.size - 1)
    close = t[after] - t[after - 1] < 1.5 * s.interval
    edge = reach + 1e-9
    within = (s.clock >= t[0] - edge) & (s.clock <= t[-1] + edge) & close
    clock = s.clock[within]
    steep = (load[1] - load[0]) / (t[1] - t[0]), (load[-1] - load[-2]) / (t[-1] - t[-2])
    beyond = np.minimum(clock - t[0], 0.0) * steep[0] + np.maximum(clock - t[-1], 0.0) * steep[1]
    loads = np.interp(clock, t, load) + beyond
    return loads, s.place[within] + s.toe.give(loads)


def fitted(
    load: np.ndarray, value: np.ndarray, sd: float, rounds: int = 5
) -> tuple[float, float, np.ndarray]:
    """Slope -dvalue/dload, its information and residuals (N,); Student-t, reweighted.

    Noise of the loads would flatten the slope by its share of their variance: that much is not known.
    """
    weight, slope, scale2, spread = np.ones(load.size), 0.0, sd**2, 0.0
    residual = np.zeros(value.size)
    if load.size < 4:
        return 0.0, 0.0, residual
    for _ in range(rounds):
        total = weight.sum()
        x, y = load - weight @ load / total, value - weight @ value / total
        spread = float(weight @ x**2)
        if spread <= 0:
            return 0.0, 0.0, y
        slope = float(-(weight * x) @ y / spread)
        residual = y + slope * x
        scale2 = max(float(weight @ residual**2) / max(load.size - 2, 1), sd**2)
        weight = (TAIL + 1) / (TAIL + residual**2 / scale2)
    flattened = slope * min(scale2 / max(slope**2 * spread / weight.sum(), 1e-300), 1.0)
    return slope, 1 / (scale2 / spread + flattened**2), residual


def _median(values: np.ndarray) -> float:
    """Median of finite values; np.median takes ten times as long for a few."""
    ordered = np.sort(values)
    return float((ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]) / 2)


def evidence(
    kinds: Sequence[Sequence[Stretch]],
    priors: Sequence[tuple[float, float]],
    delays: np.ndarray,
    filtered: bool,
    inner: bool = False,
) -> np.ndarray:
    """Log-likelihoods (num_kinds, num_delays) of all stretches, each with a rest, each kind a compliance.

    Of a sample on the average, times their number, as not every delay leaves all of them in contact;
    -inf where it leaves too few. `inner`: without the ends of each contact, where a delay of less than a
    sample takes one sample out that no delay leaves in, which counts more than the delay itself. `priors`:
    mean and sd [m/N] of the compliance of each kind.
    """
    out = np.zeros((len(kinds), delays.size))
    for row, own, prior in zip(out, kinds, priors, strict=True):
        if not own:
            continue
        usual, num_samples = _median(np.array([s.sd for s in own])), sum(s.t.size for s in own)
        tried = []
        for d in delays:
            key = {"constant" if filtered else "shift": float(d)}
            read = [reading(s, **key, reach=-inner * s.interval / 2) for s in own]
            found = np.array([fitted(*r, s.sd, rounds=3)[:2] for r, s in zip(read, own, strict=True)])
            weight = np.r_[np.minimum(found[:, 1], len(own) * _median(found[:, 1])), prior[1] ** -2]
            c = max(float(weight @ np.r_[found[:, 0], prior[0]] / weight.sum()), 0.0)
            rests = [value + c * load for load, value in read if load.size]
            tried.append(np.concatenate([r - _median(r) for r in rests] or [np.zeros(0)]))
        enough = [r.size >= KEPT * num_samples for r in tried]
        scales = [1.4826 * _median(np.abs(r)) for r, e in zip(tried, enough, strict=True) if e]
        scale = max(min(scales, default=usual), usual)
        for i, residual in enumerate(tried):
            cost = (TAIL + 1) / 2 * np.log1p((residual / scale) ** 2 / TAIL)
            row[i] = -num_samples * float(cost.mean()) if enough[i] else -np.inf
    return DEPENDENT * out
