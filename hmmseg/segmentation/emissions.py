"""Emissions of the contact states of a two-finger grip, from the physics of each state.

The features of a sample are the four fingertip forces, the mean velocity (vx, vy) and height y of the
fingers, and their distance d. With the grip force g = (fx1 - fx2) / 2 and the net vertical force fy:

- free motion: all forces equal their sensor bias, except while a single finger touches (the grip begins when
  the second finger touches and ends when the first lets go); motion is free.
- hold on ground: the grip is positive and the support carries the rest, so fy <= weight; the block rests, so
  vx = vy = 0 and y - fy / (2 k_s), the height without the pads' shear deflection, is constant.
- sliding on ground: the same with vx free.
- hold above ground: the grip is positive and fy = weight (1 + a_y / gravity); motion is free.
- in every grip the fingers are the block's width apart, less the give of the pads:
  d = width - (fx1 - fx2) / k_n.

Free quantities have broad densities over the range of the recording, so that all states score the same
features and their log-likelihoods compare. Residuals are Student-t, for transients. Derivation and sources:
docs/segmentation.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, SLIDING, Subtask
from hmmseg.contact.equations import Pads, block_width, block_y, carried_force, pads_of
from hmmseg.densities import EDGE, log_between, log_student
from hmmseg.hand.signals import Signals, central_differences, group_size, grouped
from hmmseg.io.rig import Rig
from hmmseg.levels import MOVED
from hmmseg.robust import coarse_step, extent, filled, median_of_known, runs, white_sd
from hmmseg.tables import Brief

STRAY = 0.02  # prior: share of resting samples that move briefly (a grip settling, a bounce)
TOUCHING = 1e-4  # prior: share of gripped samples whose distance is not the block's width (foam giving late)
STILL = 0.1  # prior: share of samples in the air at which the hand stands still
ONE_FINGER = 0.02  # prior: share of free samples at which only one finger touches
RUNG = 0.01  # prior: share of free samples at which forces still ring from a contact


@dataclass(frozen=True, repr=False)
class Features(Brief):
    """Features scored by the emissions, arrays (num_timesteps,), NaN where missing.

    `force` (num_timesteps, 4): fx1, fy1, fx2, fy2 [N]; vx, vy, ay: mean velocity and vertical acceleration of
    the fingers; y: mean height [m]; d: distance of the fingers [m]; `sd_*`: noise of one sample; `pads`:
    nominal compliances [m/N]. `span`: ranges of the broad densities (vx, vy [m/s], y, d [m], force of one
    finger and downward press of both [N]). `free`: 1 where a gripper's opening shows that nothing is held;
    None if only forces are known.
    """

    t: np.ndarray
    force: np.ndarray
    vx: np.ndarray
    vy: np.ndarray
    ay: np.ndarray
    y: np.ndarray
    d: np.ndarray
    sd_y: np.ndarray
    sd_d: np.ndarray
    sd_vx: np.ndarray
    sd_vy: np.ndarray
    pads: Pads
    gravity: float
    span: dict[str, float]
    free: np.ndarray | None = None

    @property
    def grip(self) -> np.ndarray:
        """Mean grip force (fx1 - fx2) / 2 [N]."""
        return (self.force[:, 0] - self.force[:, 2]) / 2

    def block_width(self, bias: np.ndarray) -> np.ndarray:
        """Width of the held block (num_timesteps,) [m]; forces are bridged where both are missing."""
        return block_width(self.d, *_pair(self.force - bias, 0, 2, -1.0), self.pads)

    def block_y(self, bias: np.ndarray) -> np.ndarray:
        """Height of the held block (num_timesteps,) [m]; forces are bridged where both are missing."""
        return block_y(self.y, *_pair(self.force - bias, 1, 3, 1.0), self.pads)

    @cached_property
    def usual(self) -> dict[str, float]:
        """Median noise of `d` and `y` [m]."""
        return {"d": float(np.median(self.sd_d)), "y": float(np.median(self.sd_y))}

    @cached_property
    def carrying(self) -> np.ndarray:
        """Net vertical force on a lifted block, in units of its weight (num_timesteps,)."""
        return carried_force(1.0, np.nan_to_num(self.ay), self.gravity)


def _pair(force: np.ndarray, first: int, second: int, sign: float) -> tuple[np.ndarray, np.ndarray]:
    """Forces of both fingers (num_timesteps,): one missing is the other times `sign`, both are bridged."""
    pair = force[:, first], force[:, second]
    a, b = (np.where(np.isnan(own), sign * other, own) for own, other in (pair, pair[::-1]))
    return filled(a), filled(b)


def _unseen(force: np.ndarray, first: int, second: int, sign: float) -> np.ndarray:
    """Error (num_timesteps,) [N] of forces bridged where both are missing: half of the change meanwhile."""
    one, other = force[:, first], sign * force[:, second]
    shown, out = np.where(np.isnan(one), other, one), np.zeros(one.size)
    for start, stop in runs(np.isnan(shown)):
        out[start:stop] = np.ptp(shown[[max(start - 1, 0), min(stop, shown.size - 1)]]) / 2
    return np.nan_to_num(out)


@dataclass(frozen=True)
class Parameters:
    """Parameters of the emissions, learned from the recording.

    `bias` (4,) [N]; `weight` [N] and `width` [m] per object (absent while unknown). `scale`: scales of the
    Student-t residuals: "force" in free motion, "carry" (net vertical force while carried), "net_x" and
    "shear" while held [N], "velocity" [m/s] and "level" [m] while held on the ground, "width" [m]. `levels`
    [m]: resting heights per trial and subtask.
    """

    bias: np.ndarray
    weight: dict[str, float]
    scale: dict[str, float]
    width: dict[str, float] = field(default_factory=dict)
    levels: tuple[dict[int, float], ...] = ()

    def force_sd(self, s: Signals) -> float:
        """Noise of one force of a trial [N]: stated, or as learned in free motion."""
        return self.scale["force"] if np.isnan(s.sd_force) else s.sd_force


def _log_resting(aside: np.ndarray | None, upward: np.ndarray, broad_aside: np.ndarray,
                 broad_up: np.ndarray, stray: float) -> np.ndarray:  # fmt: skip
    """Log density of the motion of a supported block: at rest, pushed aside, or straying altogether.

    `aside`, `upward`: log densities at rest of vx (None: sliding), and of vy with the height; `broad_*`: of
    strays. Height and velocity stray together: if they strayed separately, a block held still in the air
    would pay for its height once, yet gain the narrow velocity density at every sample.
    """
    astray = np.log(stray) + broad_aside + broad_up
    if aside is None:
        return np.logaddexp(np.log1p(-stray) + broad_aside + upward, astray)
    pushed = np.log(stray) + broad_aside + upward
    return np.logaddexp.reduce([np.log1p(-2 * stray) + aside + upward, pushed, astray])


def _log_halting(f: Features, p: Parameters) -> np.ndarray:
    """Log density ratio of velocities and height of a hand that stands still in the air to one that moves.

    Without it, a halt would pass for a rest on something, which predicts the motion much better: of a block
    held up, or of one just as wide as an open hand that waits. What halts stays where it was at the previous
    sample; its height counts if those of resting blocks do.
    """
    out = np.zeros(f.t.size)
    for name, v, sd in (("vx", f.vx, f.sd_vx), ("vy", f.vy, f.sd_vy)):
        out += log_student(v, np.hypot(sd, p.scale["velocity"])) + np.log(f.span[name]) * np.isfinite(v)
    if p.levels:
        there = np.isfinite(f.y)
        last = np.maximum.accumulate(np.where(there, np.arange(f.y.size), -1))
        before = np.r_[-1, last[:-1]]
        risen = np.where(there & (before >= 0), f.y - f.y[before], np.nan)
        spread = np.sqrt(2 * f.sd_y**2 + p.scale["level"] ** 2)
        out += log_student(risen, spread) + np.log(f.span["y"]) * np.isfinite(risen)
    return out


def _log_ungripped(force: np.ndarray, scale: float, span: float, rung: float) -> np.ndarray:
    """Log density of forces (num_timesteps, 4) without a grip: no contact, one finger touching, or ringing.

    The amplitude of ringing is unknown: log-uniform from `scale` to `span`.
    """
    silent = log_student(force, scale)
    fingers = silent[:, :2].sum(axis=1), silent[:, 2:].sum(axis=1)
    touching = [
        log_between(sign * force[:, c], 0.0, span, scale) + log_between(force[:, c + 1], -span, span, scale)
        for sign, c in ((1.0, 0), (-1.0, 2))
    ]
    loud = np.log(2 * np.log1p(span / scale)) + np.log(np.abs(force) + scale)
    return np.logaddexp.reduce([
        *([np.log(rung) - np.nansum(loud, axis=1)] if rung else []),
        np.log1p(-ONE_FINGER - rung) + fingers[0] + fingers[1],
        np.log(ONE_FINGER / 2) + touching[0] + fingers[1],
        np.log(ONE_FINGER / 2) + fingers[0] + touching[1],
    ])  # fmt: skip


def log_likelihoods(
    features: Features,
    subtasks: tuple[Subtask, ...],
    parameters: Parameters,
    trial: int,
    stray: float = STRAY,
    rung: float = RUNG,
) -> np.ndarray:
    """Emission log-likelihoods (num_timesteps, num_subtasks) of one trial.

    Args:
        features: of the trial.
        subtasks: in order; those with the same contact state, object and level are computed once.
        parameters: of the emissions; without `levels`, resting heights are unknown.
        trial: its index in `parameters.levels`.
        stray: share of resting samples that move.
        rung: share of free samples whose forces still ring.
    """
    scale, span = parameters.scale, features.span
    force = features.force - parameters.bias
    free = _log_ungripped(force, scale["force"], span["force"], rung)
    free = free + _broad(features, "vx", "vy") + _broad(features, "y") + _broad(features, "d")
    free = free + np.logaddexp(np.log1p(-STILL), np.log(STILL) + _log_halting(features, parameters))
    # All forces of a grip but the net vertical one.
    held = log_between((force[:, 0] - force[:, 2]) / 2, 0.0, span["force"], scale["force"])
    if features.free is not None:
        held += EDGE * (features.free == 1)
    net_x, shear = force[:, 0] + force[:, 2], (force[:, 1] - force[:, 3]) / 2
    held = held + (log_student(net_x, scale["net_x"]) + log_student(shear, scale["shear"]))
    names = dict.fromkeys(str(s.object) for s in subtasks if s.state != FREE)
    grips = {name: held + _log_width(features, parameters, name) for name in names}
    # The emission of a subtask depends on its contact state, object and resting level [m].
    keys: list[tuple[str, str, float | None]] = []
    for s in subtasks:
        rests = s.state not in (FREE, ABOVE_GROUND) and bool(parameters.levels)
        level = parameters.levels[trial].get(s.index) if rests else None
        keys.append((s.state, "" if s.state == FREE else str(s.object), level))
    columns = {
        key: free if key[0] == FREE
        else _log_gripped(features, parameters, grips[key[1]], force, *key, stray=stray)
        for key in dict.fromkeys(keys)
    }  # fmt: skip
    return np.stack([columns[key] for key in keys], axis=1)


def _broad(f: Features, *names: str) -> np.ndarray:
    """Log density (num_timesteps,) of unconstrained quantities; 0 where missing."""
    return np.sum([-np.log(f.span[name]) * np.isfinite(getattr(f, name)) for name in names], axis=0)


def _log_width(f: Features, p: Parameters, name: str) -> np.ndarray:
    """Log density of the fingers' distance with an object between them."""
    width = p.width.get(name)
    if width is None:  # widths and resting levels are unknown in the first pass
        return _broad(f, "d")
    residual = f.block_width(p.bias) - width
    close = np.log1p(-TOUCHING) + log_student(residual, np.hypot(f.sd_d, p.scale["width"]))
    either = np.logaddexp(close, np.log(TOUCHING) - np.log(f.span["d"]))
    return np.where(np.isfinite(residual), either, 0.0)


def _log_gripped(
    f: Features, p: Parameters, grip: np.ndarray, force: np.ndarray,
    state: str, name: str, level: float | None, stray: float,
) -> np.ndarray:  # fmt: skip
    """Log-likelihoods (num_timesteps,) of one held object in one contact state, resting at `level` [m].

    `grip`: log density of the gripping forces; `force`: without biases.
    """
    fy, weight, scale = force[:, 1] + force[:, 3], p.weight[name], p.scale
    if state == ABOVE_GROUND:
        carried = log_student(fy - weight * f.carrying, scale["carry"])
        out = grip + (carried + _broad(f, "vx", "vy") + _broad(f, "y"))
        return out + np.logaddexp(np.log1p(-STILL), np.log(STILL) + _log_halting(f, p))
    out = grip + log_between(fy, -f.span["press"], weight, scale["carry"])
    aside = None if state == SLIDING else log_student(f.vx, np.hypot(f.sd_vx, scale["velocity"]))
    upward, broad_up = log_student(f.vy, np.hypot(f.sd_vy, scale["velocity"])), _broad(f, "vy")
    if level is None:
        out += _broad(f, "y")
    else:
        risen = f.block_y(p.bias) - level
        upward += log_student(risen, np.hypot(f.sd_y, scale["level"]))
        broad_up = broad_up + log_student(risen, MOVED)  # a block that bounces or slips stays near
    return out + _log_resting(aside, upward, _broad(f, "vx"), broad_up, stray)


MAX_RATE = 40.0  # chosen: Hz; faster recordings are thinned to this rate, fast enough for a hand
WINDOW = 6e-3  # chosen: s over which a reading is averaged; contacts change no faster


LEAST_SCALE = 0.3  # chosen: least scale of residuals over a sample's noise, which may be stated too large


def noise_sd(values: np.ndarray) -> float:
    """Robust standard deviation of white sample noise, and of rounding; NaN for fewer than three samples."""
    finite = values[np.isfinite(values)]
    return max(float(white_sd(finite)), coarse_step(finite) / np.sqrt(12)) if finite.size > 2 else np.nan


def channel_sd(stated: np.ndarray, values: np.ndarray) -> float:
    """Noise of a channel: the median of the `stated` sds, or else estimated from its values."""
    sd = median_of_known(stated)
    return noise_sd(values) if np.isnan(sd) else sd


def thin(
    signals: Signals, max_rate: float = MAX_RATE, window: float = np.inf, rate: float | None = None
) -> Signals:
    """Thin signals to at most `max_rate` [Hz], each reading a mean over up to `window` s.

    White noise of a mean over m samples shrinks by sqrt(m); readings without a value stay missing. A short
    window resolves changes within a reading. `rate` [Hz]: of the recording if `signals` are a part of it,
    otherwise their own median rate.
    """
    rate = float(1.0 / np.median(np.diff(signals.t))) if rate is None else rate
    group = group_size(rate, max_rate)
    if group <= 1:
        return signals
    width = int(np.clip(min(window, 1.0) * rate, 1, group))
    thinned = dict[str, Any]()
    for name, values in vars(signals).items():
        if isinstance(values, np.ndarray):
            mean, count = grouped(values, group, width)
            thinned[name] = mean / np.sqrt(np.maximum(count, 1)) if name.startswith("sd_") else mean
    return replace(signals, **thinned, sd_force=signals.sd_force / np.sqrt(width))


def acceleration(t: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Mean acceleration over neighbouring samples [m/s^2]; NaN where undefined."""
    found = central_differences(t, velocity)[0]
    return found if np.isfinite(velocity).sum() > 2 else np.full_like(velocity, np.nan)


def features(signals: Signals, rig: Rig) -> Features:
    """Features of one trial; noise that the rig does not state is estimated from the recording."""
    s, root2 = signals, np.sqrt(2.0)

    def stated(sd: np.ndarray, values: np.ndarray) -> np.ndarray:
        given = np.isfinite(sd)  # NaN at missing samples, whose noise does not matter
        usual = np.median(sd[given]) / root2 if given.any() else max(noise_sd(values), 1e-9)
        return np.where(given, sd / root2, usual)

    force = np.stack([s.fx1, s.fy1, s.fx2, s.fy2], axis=1)
    span = {
        "vx": max(extent(s.vx), 1e-3),
        "vy": max(extent(s.vy), 1e-3),
        "y": max(extent(s.y), 1e-4),
        "d": max(extent(s.distance), 1e-4),
        "force": 1.5 * float(np.nanmax(np.abs(force))) + 1e-3,
        "press": 1.5 * float(np.max(np.abs(s.fy), initial=0.0, where=np.isfinite(s.fy))) + 1e-3,
    }
    pads = pads_of(rig)
    sd_d = np.hypot(2 * stated(s.sd_x, s.distance / 2), _unseen(force, 0, 2, -1.0) * 2 * pads.normal1)
    return Features(
        t=s.t, force=force, vx=s.vx, vy=s.vy, ay=acceleration(s.t, s.vy), y=s.y, d=s.distance,
        sd_y=np.hypot(stated(s.sd_y, s.y), _unseen(force, 1, 3, 1.0) * pads.shear1), sd_d=sd_d,
        sd_vx=stated(s.sd_vx, s.vx), sd_vy=stated(s.sd_vy, s.vy),
        pads=pads, gravity=rig.gravity, span=span, free=s.free,
    )  # fmt: skip


def without(f: Features, spans: Sequence[tuple[float, float]]) -> Features:
    """Features with the given time spans [s] blanked, so that they carry no information."""
    blanked = np.zeros(f.t.size, bool)
    for start, end in spans:
        blanked |= (f.t >= start) & (f.t <= end)
    if not blanked.any():
        return f
    channels: dict[str, Any] = {
        name: np.where(blanked, np.nan, getattr(f, name)) for name in ("vx", "vy", "ay", "y", "d")
    }
    return replace(f, force=np.where(blanked[:, None], np.nan, f.force), **channels)
