"""Candidates that need no contact model: what each does to the simulated features.

Each acts in one channel on the mean simulated course, on the spectra of the simulated trials, or on
durations. Recorded = what is simulated + effect, in this order: shifted in time, smoothed, scaled,
then offset and drift, then vibration and noise added. Names are the catalogue's where it has the effect.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import uniform_filter1d

from simgap.generic.features import (
    DURATION,
    FAST,
    SLOW,
    Layout,
    bin_edges,
    log_power,
    means,
    resampled,
    transformed,
    windowed,
)

FINE = 2048  # numerics: points of the mean course
SMALLEST = 1e-6  # numerics: s; a shorter time constant is none
KEPT = 4000  # numerics: spectra kept
SMOOTH = 9  # numerics: coefficients over which a spectrum is smoothed
LEAST = 4  # numerics: coefficients that a mean power is taken of


@dataclass(frozen=True)
class Kind:
    """One number of an effect: prior normal about 0 with `sd` times what `scaled` says, bounded by
    `low` and `high`, starting from `starts` (all in standard deviations).

    `scaled`: 1, "scale" (the channel's), "rate" (scale over the task's duration).
    """

    name: str
    unit: str
    sd: float
    scaled: str = "1"
    starts: tuple[float, ...] = (0.0,)
    low: float = -np.inf
    high: float = np.inf


@dataclass(frozen=True)
class Change:
    """An effect on given trials: `kinds` of its parameters, one of each a channel (`each` = "channel"), one a
    channel and event ("event": an oscillation's sine and cosine), or one a subtask ("subtask": durations)."""

    name: str
    says: str
    shows: str
    kinds: tuple[Kind, ...]
    each: str = "channel"


EFFECTS = {
    c.name: c
    for c in (
        Change("force_bias", "recorded = simulated + b", "the slow course of every subtask alike",
                  (Kind("bias", "", 0.5, "scale"),)),
        Change("force_gain", "recorded = (1 + g) simulated", "course and fluctuation, in proportion",
                  (Kind("gain", "1", 0.3, low=-0.5 / 0.3, high=1 / 0.3),)),
        Change("force_drift", "recorded = simulated + c t", "a ramp over the whole task",
                  (Kind("slope", "/s", 0.5, "rate"),)),
        Change("force_lag", "recorded = simulated(t - delay)", "every change of the course, late",
                  (Kind("delay", "s", 0.1, starts=(0.3, 1.0, 3.0), low=0.0, high=5.0),)),
        Change("force_lowpass", "tau recorded' + recorded = simulated", "rounded changes, fast power gone",
                  (Kind("time_constant", "s", 0.1, starts=(0.1, 0.5, 2.0), low=0.0, high=5.0),)),
        Change("structural_vibration", "a damped mode rung at the start of a subtask",
                  "power about one frequency", (Kind("sin", "", 0.2, "scale", (0.3, 0.0, -0.3, 0.0)),
                   Kind("cos", "", 0.2, "scale", (0.0, 0.3, 0.0, -0.3))), "event"),
        Change("noise_level", "white noise added (less, if negative)", "power at all frequencies alike",
                  (Kind("sd", "", 0.05, "scale", (0.05, 0.5, -0.05)),)),
        Change("timing", "durations of subtasks multiplied", "durations alone",
                  (Kind("log_ratio", "1", 0.5),), "subtask"),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """What predictions start from: the layout, mean real boundaries and the mean simulated course on them.

    `t` (FINE,) [s] and `course` (C, FINE); `floor` (C,): power of the simulated noise; `frequency` [Hz]
    and `damping` of the vibration looked for (NaN where none was found). `kept`: what was computed once.
    """

    layout: Layout
    edges: np.ndarray
    t: np.ndarray
    course: np.ndarray
    floor: np.ndarray
    frequency: float
    damping: float
    kept: dict[tuple[int, int, int, float], np.ndarray] = field(default_factory=dict, repr=False)


def scene(layout: Layout, frequency: float = np.nan, damping: float = np.nan) -> Scene:
    """The scene of two ensembles; simulated courses are stretched to the mean real durations, but for what
    follows an event."""
    edges = np.mean([c.edges - c.edges[0] for c in layout.ensembles.real], 0)
    t = (np.arange(FINE) + 0.5) * edges[-1] / FINE
    course = np.zeros((len(layout.ensembles.channels), FINE))
    for cut in layout.ensembles.sim:
        times = np.interp(t, _knots(layout, edges), _knots(layout, cut.edges))
        for c, name in enumerate(layout.ensembles.channels):
            course[c] += resampled(cut.trial.t, cut.trial.channels[name], times, layout.rate)
    count = len(layout.ensembles.sim)
    return Scene(layout, edges, t, course / count, _floor(layout), frequency, damping)


def _knots(layout: Layout, edges: np.ndarray) -> np.ndarray:
    """Times [s] that correspond between trials: edges, and where what follows an event is over."""
    return np.sort(np.concatenate([edges, edges[:-1] + np.where(layout.event > 0, layout.event, 0.0)]))


def _floor(layout: Layout) -> np.ndarray:
    """Power of the simulated noise (C,): the quietest subtask's upper quarter of the spectrum."""
    out = np.zeros(len(layout.ensembles.channels))
    for c in range(out.size):
        quiet = [
            np.mean(
                [
                    (transformed(windowed(layout, cut, c, k))[-(n // 4) :] ** 2).mean()
                    for cut in layout.ensembles.sim
                ]
            )
            for k, n in enumerate(layout.window)
            if n >= 4 * LEAST
        ]
        out[c] = np.min(quiet) if quiet else 0.0
    return out


def slow(given: Scene, channel: int, values: dict[str, float], ring: np.ndarray) -> np.ndarray:
    """Predicted slow features of a channel, subtask after subtask."""
    x = given.course[channel]
    if values.get("delay", 0.0):
        x = np.interp(given.t - values["delay"], given.t, x)
    if values.get("time_constant", 0.0) > SMALLEST:
        x = smoothed(x, values["time_constant"] / (given.t[1] - given.t[0]))
    x = (1 + values.get("gain", 0.0)) * x + values.get("bias", 0.0) + values.get("slope", 0.0) * given.t
    for k in np.flatnonzero(ring.any(1)):
        x = x + ring[k] @ ring_waves(given, given.t - given.edges[k])
    ends = given.edges
    edges = [bin_edges(given.layout, ends[k], ends[k + 1], k) for k in range(ends.size - 1)]
    return np.concatenate([means(given.t, x, each) for each in edges])


def fast(given: Scene, channel: int, values: dict[str, float], ring: np.ndarray) -> np.ndarray:
    """Predicted log powers of a channel, subtask after subtask."""
    layout, out = given.layout, []
    shift = values.get("delay", 0.0) * layout.rate
    whole = int(np.floor(shift))
    part = shift - whole if shift - whole > 1e-9 else 0.0
    for k in range(len(layout.window)):
        if not layout.coefficients[k]:
            continue
        now = _log_power(given, channel, k, whole, values, ring[k])
        if part:  # between two neighbouring samples' shifts
            now = (1 - part) * now + part * _log_power(given, channel, k, whole + 1, values, ring[k])
        out.append(now)
    return np.concatenate(out) if out else np.zeros(0)


def _log_power(
    given: Scene, channel: int, subtask: int, shift: int, values: dict[str, float], ring: np.ndarray
) -> np.ndarray:
    """Mean log powers (B,) of the simulated trials with the effects in, `shift` samples late."""
    layout, n = given.layout, int(given.layout.window[subtask])
    wave = _simulated(given, channel, subtask, shift, values.get("time_constant", 0.0))
    quiet, noise = _simulated(given, channel, subtask, shift, 0.0), given.floor[channel]
    f = np.arange(n) * layout.rate / (2 * n)
    kept = 1 / (1 + (2 * np.pi * f * values.get("time_constant", 0.0)) ** 2)
    # What lies at the noise floor is the sensor's own noise: neither filter nor gain changes it.
    near = np.maximum(uniform_filter1d((quiet**2).mean(0), SMOOTH, mode="nearest"), 1e-300)
    share = np.clip(noise / near, 0.0, 1.0)
    gain = 1 + values.get("gain", 0.0)
    wave = np.sqrt(share + (1 - share) * gain**2) * wave
    if np.any(ring):
        wave = wave + transformed(ring @ ring_waves(given, (np.arange(n) + 0.5) / layout.rate))
    sd = values.get("sd", 0.0)
    added = max(sd * abs(sd), -noise)  # no more noise can be missing than there is
    spectra = np.maximum(wave**2 + noise * (1 - kept) + added, 0.0)
    return log_power(layout, spectra, channel, subtask).mean(0)


def _simulated(given: Scene, channel: int, subtask: int, shift: int, tau: float) -> np.ndarray:
    """DCT coefficients (S, window) of the simulated trials, smoothed with time constant `tau` [s]."""
    tau = 0.0 if tau <= SMALLEST else tau
    key = channel, subtask, shift, tau
    if key not in given.kept:
        if len(given.kept) > KEPT:
            given.kept.clear()
        name, windows = given.layout.ensembles.channels[channel], []
        for cut in given.layout.ensembles.sim:
            values = cut.trial.channels[name]
            if tau:
                known = np.isfinite(values)
                values = smoothed(
                    np.interp(cut.trial.t, cut.trial.t[known], values[known]), tau * cut.trial.rate
                )
            windows.append(windowed(given.layout, cut, channel, subtask, shift, values))
        given.kept[key] = transformed(np.array(windows))
    return given.kept[key]


def smoothed(x: np.ndarray, tau: float) -> np.ndarray:
    """A first-order low pass with its time constant in samples, settled at the start."""
    from scipy.signal import lfilter  # slow to import

    keep = np.exp(-1 / tau)
    return np.asarray(lfilter([1 - keep], [1, -keep], x, zi=[keep * x[0]])[0])


def ring_waves(given: Scene, t: np.ndarray) -> np.ndarray:
    """The vibration's sine and cosine (2, n) at times [s] since its event; 0 before."""
    omega, since = 2 * np.pi * given.frequency, np.maximum(t, 0.0)
    decay = np.where(t >= 0, np.exp(-given.damping * omega * since), 0.0)
    return decay * np.array([np.sin(omega * since), np.cos(omega * since)])


def predicted(given: Scene, channel: int, values: dict[str, float], ring: np.ndarray) -> np.ndarray:
    """Predicted features of a channel in the layout's order of `channel_features`.

    `ring` (K, 2): sine and cosine amplitudes of a vibration from each subtask's start on.
    """
    return np.concatenate([slow(given, channel, values, ring), fast(given, channel, values, ring)])


def channel_features(layout: Layout, channel: int) -> np.ndarray:
    """Indices of a channel's features: slow ones of all subtasks, then fast ones."""
    count = range(len(layout.ensembles.subtasks))
    return np.concatenate([layout.where(kind, channel, k) for kind in (SLOW, FAST) for k in count])


def duration_features(layout: Layout) -> np.ndarray:
    """Indices of the log durations."""
    return np.flatnonzero(layout.kind == DURATION)
