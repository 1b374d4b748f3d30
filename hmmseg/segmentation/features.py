"""From task-space signals to the features that the emissions score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.contact.equations import pads_of
from hmmseg.hand.grouping import group_size, grouped
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.robust import white_sd
from hmmseg.segmentation.emissions import Features

MAX_RATE = 40.0  # chosen: Hz; faster recordings are read at this rate, fast enough for a hand
WINDOW = 6e-3  # chosen: s over which such a reading is averaged; a contact changes no faster


def noise_sd(values: np.ndarray) -> float:
    """Robust standard deviation of white sample noise; NaN where too few samples are there."""
    there = values[np.isfinite(values)]
    return float(white_sd(there)) if there.size > 2 else np.nan


def thin(
    signals: Signals, max_rate: float = MAX_RATE, window: float = np.inf, rate: float | None = None
) -> Signals:
    """Signals read at a rate of at most `max_rate` [Hz], each reading a mean over up to `window` s.

    White noise of a mean over m samples shrinks by sqrt(m); readings without a value stay missing.
    A short window keeps what changes within a reading apart. `rate` [Hz]: of the recording that the signals
    are a piece of; their own median otherwise.
    """
    rate = float(1.0 / np.median(np.diff(signals.t))) if rate is None else rate
    group = group_size(rate, max_rate)
    if group <= 1:
        return signals
    width = int(np.clip(min(window, 1.0) * rate, 1, group))
    thinned = {}
    for name, values in vars(signals).items():
        if not isinstance(values, np.ndarray):
            thinned[name] = values
            continue
        mean, count = grouped(values, group, width)
        thinned[name] = mean / np.sqrt(np.maximum(count, 1)) if name.startswith("sd_") else mean
    thinned["sd_force"] = signals.sd_force / np.sqrt(width)
    return Signals(**thinned)


def acceleration(t: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Mean acceleration over the neighbouring samples [m/s^2]; NaN where it cannot be had."""
    out, there = np.full_like(velocity, np.nan), np.flatnonzero(np.isfinite(velocity))
    if there.size > 2:
        out[there] = np.gradient(velocity[there], t[there])
    return out


def features(signals: Signals, rig: Rig) -> Features:
    """Features of one trial; noise the rig does not state is learned from the recording."""
    s, root2 = signals, np.sqrt(2.0)

    def stated(sd: np.ndarray, values: np.ndarray) -> np.ndarray:
        known = np.isfinite(sd)  # not where a sample is missing, whose own does not matter
        usual = np.median(sd[known]) / root2 if known.any() else max(noise_sd(values), 1e-9)
        return np.where(known, sd / root2, usual)

    force = np.stack([s.fx1, s.fy1, s.fx2, s.fy2], axis=1)
    span = {
        "vx": _range(s.vx, 1e-3),
        "vy": _range(s.vy, 1e-3),
        "y": _range(s.y, 1e-4),
        "d": _range(s.distance, 1e-4),
        "force": 1.5 * float(np.nanmax(np.abs(force))) + 1e-3,
        "press": 1.5 * float(np.max(np.abs(s.fy), initial=0.0, where=np.isfinite(s.fy))) + 1e-3,
    }
    return Features(
        t=s.t, force=force, vx=s.vx, vy=s.vy, ay=acceleration(s.t, s.vy), y=s.y,
        d=s.distance, sd_y=stated(s.sd_y, s.y), sd_d=2 * stated(s.sd_x, s.distance / 2),
        sd_vx=stated(s.sd_vx, s.vx), sd_vy=stated(s.sd_vy, s.vy),
        pads=pads_of(rig), gravity=rig.gravity, span=span, free=s.free,
    )  # fmt: skip


def without(f: Features, spans: Sequence[tuple[float, float]]) -> Features:
    """The features without what was measured in some stretches of time [s]: there they say nothing."""
    out = np.zeros(f.t.size, bool)
    for start, end in spans:
        out |= (f.t >= start) & (f.t <= end)
    if not out.any():
        return f
    force = np.where(out[:, None], np.nan, f.force)
    blank = {name: np.where(out, np.nan, getattr(f, name)) for name in ("vx", "vy", "ay", "y", "d")}
    return replace(f, force=force, **blank)


def _range(values: np.ndarray, least: float) -> float:
    there = values[np.isfinite(values)]  # none at all where some joint is always missing
    return max(float(np.ptp(there)), least) if there.size else least
