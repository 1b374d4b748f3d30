"""What effects that need no contact model do to simulated trials, and a ring found in recorded ones.

Each acts in one channel on the mean simulated course, on the spectra of the simulated trials, or on
durations. Recorded = what is simulated + effect, in this order: shifted in time, smoothed, scaled,
then offset and drift, then vibration and noise added. Names are the catalogue's where it has the effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize
from scipy.special import stdtrit

from simgap.generic.trials import Layout, bin_edges, log_power, means, resampled, transformed, windowed

FINE = 2048  # numerics: points of the mean course
SMALLEST = 1e-6  # numerics: s; a shorter time constant is none
SMOOTH = 9  # numerics: coefficients over which a spectrum is smoothed
LEAST = 4  # numerics: coefficients that a mean power is taken of


@dataclass(frozen=True)
class Change:
    """An effect on given trials: `keys` of its parameters in a channel, each with its usual size (times the
    channel's scale, or that over the task's duration, as `per` says), bounds and starts in usual sizes.

    `each`: one of each a channel, one a channel and event (an oscillation's sine and cosine), or one a
    subtask (durations).
    """

    name: str
    says: str
    shows: str
    keys: tuple[str, ...]
    usual: float
    per: str = ""  # "", "scale" or "rate"
    unit: str = ""  # of the channel's unit: "", "/s"; or one of its own
    starts: tuple[tuple[float, ...], ...] = ((0.0,),)
    low: float = -8.0
    high: float = 8.0
    each: str = "channel"


EFFECTS = {
    c.name: c
    for c in (
        Change("force_bias", "recorded = simulated + b", "the slow course of every subtask alike", ("bias",),
               0.5, "scale"),
        Change("force_gain", "recorded = (1 + g) simulated", "course and fluctuation, in proportion",
               ("gain",), 0.3, unit="1", low=-1.6, high=3.3),
        Change("force_drift", "recorded = simulated + c t", "a ramp over the whole task", ("slope",), 0.5,
               "rate", "/s"),
        Change("force_lag", "recorded = simulated(t - delay)", "every change of the course, late", ("delay",),
               0.1, unit="s", starts=((0.3,), (1.0,), (3.0,)), low=0.0, high=5.0),
        Change("force_lowpass", "tau recorded' + recorded = simulated", "rounded changes, fast power gone",
               ("time_constant",), 0.1, unit="s", starts=((0.1,), (0.5,), (2.0,)), low=0.0, high=5.0),
        Change("structural_vibration", "a damped mode rung at the start of a subtask",
               "power about one frequency", ("sin", "cos"), 0.2, "scale", each="event",
               starts=((0.3, 0.0), (0.0, 0.3), (-0.3, 0.0), (0.0, -0.3))),
        Change("noise_level", "white noise added (less, if negative)", "power at all frequencies alike",
               ("sd",), 0.05, "scale", starts=((0.05,), (0.5,), (-0.05,))),
        Change("timing", "durations of subtasks multiplied", "durations alone", ("log_ratio",), 0.5, unit="1",
               each="subtask"),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect in a channel (-1: durations); `place`: its event or subtask, else -1."""

    effect: str
    key: str
    channel: int
    place: int
    usual: float


def parameters(given: Scene, effect: str, channel: int) -> list[Parameter]:
    """The parameters that an effect has in a channel, or of durations (-1)."""
    change, count = EFFECTS[effect], len(given.layout.ensembles.subtasks)
    if (change.each == "subtask") != (channel < 0):
        return []
    usual = change.usual * (float(given.layout.scale[channel]) if change.per else 1.0)
    usual /= float(given.edges[-1]) if change.per == "rate" else 1.0
    places = {"channel": [-1], "event": range(1, count), "subtask": range(count)}[change.each]
    return [Parameter(effect, key, channel, k, usual) for k in places for key in change.keys]


@dataclass(frozen=True)
class Scene:
    """What predictions start from: the layout, mean real boundaries and the mean simulated course on them.

    `t` (FINE,) [s] and `course` (C, FINE); `floor` (C,): power of the simulated noise; `ring`: the
    oscillation looked for. `cache`: spectra computed so far.
    """

    layout: Layout
    edges: np.ndarray
    t: np.ndarray
    course: np.ndarray
    floor: np.ndarray
    ring: Ring | None = None
    cache: dict[tuple, np.ndarray] = field(default_factory=dict, repr=False)

    @cached_property
    def bins(self) -> np.ndarray:
        """Edges [s] of the parts of all subtasks."""
        pairs = zip(self.edges, self.edges[1:], strict=False)
        each = [bin_edges(self.layout, a, b, k) for k, (a, b) in enumerate(pairs)]
        return np.concatenate([*(e[:-1] for e in each), self.edges[-1:]])

    @cached_property
    def waves(self) -> list[np.ndarray]:
        """The vibration from every subtask's start on, on the mean course."""
        return [ring_waves(self, self.t - start) for start in self.edges[:-1]]

    @cached_property
    def plain(self) -> list[np.ndarray]:
        """Features of every channel without any effect."""
        none = np.zeros((len(self.layout.window), 2))
        return [predicted(self, c, {}, none) for c in range(len(self.course))]


def scene(layout: Layout, ring: Ring | None = None) -> Scene:
    """The scene of two ensembles; simulated courses are stretched to the mean real durations, but for what
    follows an event."""

    def knots(edges: np.ndarray) -> np.ndarray:  # times that correspond between trials
        return np.sort(np.concatenate([edges, edges[:-1] + layout.event]))

    edges = np.mean([c.edges - c.edges[0] for c in layout.ensembles.real], 0)
    t = (np.arange(FINE) + 0.5) * edges[-1] / FINE
    course = np.zeros((len(layout.ensembles.channels), FINE))
    for cut in layout.ensembles.sim:
        times = np.interp(t, knots(edges), knots(cut.edges))
        for c, name in enumerate(layout.ensembles.channels):
            course[c] += resampled(cut.trial.t, cut.trial.channels[name], times, layout.rate)
    return Scene(layout, edges, t, course / len(layout.ensembles.sim), _floor(layout), ring)


def _floor(layout: Layout) -> np.ndarray:
    """Power of the simulated noise (C,): the quietest subtask's upper quarter of the spectrum."""
    out = np.zeros(len(layout.ensembles.channels))
    for c in range(out.size):
        spectra = [np.square([transformed(windowed(layout, cut, c, k)) for cut in layout.ensembles.sim])
                   for k, n in enumerate(layout.window) if n >= 4 * LEAST]  # fmt: skip
        out[c] = min((float(s[:, -(s.shape[1] // 4) :].mean()) for s in spectra), default=0.0)
    return out


def predicted(given: Scene, channel: int, values: Mapping[str, float], rung: np.ndarray) -> np.ndarray:
    """Predicted features of a channel in the order of `Layout.of_channel`.

    `rung` (K, 2): sine and cosine amplitudes of a vibration from each subtask's start on.
    """
    x, layout = given.course[channel], given.layout
    delay, tau = values.get("delay", 0.0), values.get("time_constant", 0.0)
    if delay:
        x = np.interp(given.t - delay, given.t, x)
    if tau > SMALLEST:
        x = smoothed(x, tau / (given.t[1] - given.t[0]))
    x = (1 + values.get("gain", 0.0)) * x + values.get("bias", 0.0) + values.get("slope", 0.0) * given.t
    for k in np.flatnonzero(rung.any(1)):
        x = x + rung[k] @ given.waves[k]
    out = [means(given.t, x, given.bins)]
    whole, part = divmod(delay * layout.rate, 1.0)
    louder = tuple(values.get(key, 0.0) for key in ("gain", "time_constant", "sd"))
    for k in range(len(layout.window)):
        if layout.coefficients[k]:
            now = _log_power(given, channel, k, int(whole), louder, tuple(rung[k]))
            if part > 1e-9:  # between two neighbouring samples' shifts
                later = _log_power(given, channel, k, int(whole) + 1, louder, tuple(rung[k]))
                now = (1 - part) * now + part * later
            out.append(now)
    return np.concatenate(out)


def _log_power(
    given: Scene, channel: int, subtask: int, shift: int, louder: tuple[float, ...], rung: tuple[float, ...]
) -> np.ndarray:
    """Mean log powers (B,) of the simulated trials, `shift` samples late, with a gain, low-pass and noise
    (`louder`) and a ring."""
    key = channel, subtask, shift, louder, rung
    if key not in given.cache:
        given.cache[key] = _computed_power(given, *key)
    return given.cache[key]


def _computed_power(given, channel, subtask, shift, louder, rung) -> np.ndarray:
    layout, n = given.layout, int(given.layout.window[subtask])
    gain, tau, sd = louder
    wave = _simulated(given, channel, subtask, shift, tau)
    quiet, noise = _simulated(given, channel, subtask, shift, 0.0), given.floor[channel]
    kept = 1 / (1 + (2 * np.pi * np.arange(n) * layout.rate / (2 * n) * tau) ** 2)
    # What lies at the noise floor is the sensor's own noise: neither filter nor gain changes it.
    near = np.maximum(uniform_filter1d((quiet**2).mean(0), SMOOTH, mode="nearest"), 1e-300)
    share = np.clip(noise / near, 0.0, 1.0)
    wave = np.sqrt(share + (1 - share) * (1 + gain) ** 2) * wave
    if any(rung):
        wave = wave + transformed(np.array(rung) @ ring_waves(given, (np.arange(n) + 0.5) / layout.rate))
    added = max(sd * abs(sd), -noise)  # no more noise can be missing than there is
    spectra = np.maximum(wave**2 + noise * (1 - kept) + added, 0.0)
    return log_power(layout, spectra, channel, subtask).mean(0)


def _simulated(given: Scene, channel: int, subtask: int, shift: int, tau: float) -> np.ndarray:
    """DCT coefficients (S, window) of the simulated trials, smoothed with time constant `tau` [s]."""
    key = channel, subtask, shift, 0.0 if tau <= SMALLEST else tau
    if key not in given.cache:
        name, windows = given.layout.ensembles.channels[channel], []
        for cut in given.layout.ensembles.sim:
            values = cut.trial.channels[name]
            if tau > SMALLEST:
                known = np.isfinite(values)
                filled = np.interp(cut.trial.t, cut.trial.t[known], values[known])
                values = smoothed(filled, tau * cut.trial.rate)
            windows.append(windowed(given.layout, cut, channel, subtask, shift, values))
        given.cache[key] = transformed(np.array(windows))
    return given.cache[key]


def smoothed(x: np.ndarray, tau: float) -> np.ndarray:
    """A first-order low pass with its time constant in samples, settled at the start."""
    from scipy.signal import lfilter  # slow to import

    keep = np.exp(-1 / tau)
    return np.asarray(lfilter([1 - keep], [1, -keep], x, zi=[keep * x[0]])[0])


def ring_waves(given: Scene, t: np.ndarray) -> np.ndarray:
    """The vibration's sine and cosine (2, n) at times [s] since its event; 0 before."""
    assert given.ring is not None
    omega, since = 2 * np.pi * given.ring.frequency, np.maximum(t, 0.0)
    decay = np.where(t >= 0, np.exp(-given.ring.damping * omega * since), 0.0)
    return decay * np.array([np.sin(omega * since), np.cos(omega * since)])


# Damped oscillations after an event, from the recorded samples themselves:
# y(t) = parabola + exp(-damping w t) (A sin w t + B cos w t) from the largest swing on, w = 2 pi f; A, B and
# the parabola of every trial its own, f and damping common. For given f and damping that is linear least
# squares (variable projection: Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973); the two are searched on a
# grid and refined. Intervals from the scatter between trials (jackknife), which needs no noise model.

DAMPINGS = (0.003, 0.01, 0.03, 0.1, 0.2)  # numerics: where searches start
LIGHTEST, HEAVIEST = (
    1e-3,
    0.25,
)  # chosen: damping below which it is no ring, and beyond which a course is none
FREQUENCIES = 80  # numerics: where searches start
SWING = 1 / 3  # chosen: of a window within which the largest swing is looked for
SHORTEST = 12  # numerics: samples of a window in which an oscillation is looked for
PERIODS = 1.5  # chosen: of the slowest oscillation looked for that a window holds
HIGHEST = 0.4  # chosen: of the sampling rate
RINGS = 0.2  # chosen: share of the square after an event that an oscillation must explain


@dataclass(frozen=True)
class Ring:
    """`frequency` [Hz], `damping` (ratio to critical) with standard errors and 90 % intervals;
    `amplitude` (n,) of each trial at the start; `share` of the square about the parabola explained;
    `resolved`: whether the best frequency lies inside the range looked at and the damping is light."""

    frequency: float
    damping: float
    frequency_sd: float
    damping_sd: float
    frequency_90: tuple[float, float]
    damping_90: tuple[float, float]
    amplitude: np.ndarray
    share: float
    resolved: bool = True


def find_ring(given: Scene) -> Ring | None:
    """The strongest oscillation after an event in the real trials, where they hold more power; after the last
    from as long as all of them go on, for what is compared may end sooner."""
    lay, best, windows = given.layout, 0.0, None
    last = len(lay.ensembles.subtasks) - 1
    for k in range(1, last + 1):
        for c, name in enumerate(lay.ensembles.channels):
            real, sim = (np.array([windowed(lay, cut, c, k) for cut in kind])
                         for kind in (lay.ensembles.real, lay.ensembles.sim))  # fmt: skip
            if real.shape[1] < 4 * LEAST or real.var(1).mean() < sim.var(1).mean():
                continue
            rest = real - sim.mean(0)  # what the simulation has is no ring
            here = from_swing(list(rest if rest.var(1).mean() < real.var(1).mean() else real))
            longest = min(c.trial.t[-1] - c.edges[-2] for c in lay.ensembles.real)
            if k == last and longest > given.edges[-1] - given.edges[-2] + 0.5 / lay.rate:
                here = from_swing([
                    resampled(c.trial.t, c.trial.channels[name],
                              np.arange(c.edges[-2], c.edges[-2] + longest, 1 / lay.rate), lay.rate)
                    for c in lay.ensembles.real
                ])  # fmt: skip
            _, _, share, square = screen(here, lay.rate)
            strength = square * here.shape[1] / lay.scale[c] ** 2
            if share > RINGS and strength > best:
                best, windows = strength, here
    found = None if windows is None else fit_ring(windows, lay.rate)
    return found if found is not None and found.resolved else None


def from_swing(windows: Sequence[np.ndarray]) -> np.ndarray:
    """Windows (trials, n) from the largest departure from each one's median on, cut to equal length.

    The largest swing is looked for in the first third.
    """
    cut = []
    for values in windows:
        early = values[: max(int(values.size * SWING), 1)]
        cut.append(values[int(np.abs(early - np.median(values)).argmax()) :])
    n = min(v.size for v in cut)
    return np.array([v[:n] for v in cut])


def _range(length: int, rate: float, at_least: float) -> tuple[float, float] | None:
    """Lowest and highest frequency [Hz] that windows of so many samples tell; None where none."""
    low, high = max(PERIODS * rate / max(length, 1), at_least), HIGHEST * rate
    return (low, high) if length >= SHORTEST and low < high else None


def screen(windows: np.ndarray, rate: float, at_least: float = 0.0) -> tuple[float, float, float, float]:
    """Best frequency [Hz] and damping on a grid, the share of the square about the parabola explained and
    its mean square; zeros where windows are too short."""
    edges = _range(windows.shape[1], rate, at_least)
    if edges is None:
        return np.nan, np.nan, 0.0, 0.0
    grid = [(f, z) for f in np.geomspace(*edges, FREQUENCIES) for z in DAMPINGS]
    shares = [1 - _left(windows, rate, *g)[0] for g in grid]
    best = int(np.argmax(shares))
    t = np.linspace(-1, 1, windows.shape[1])
    plain = windows.T - _fitted(np.stack([np.ones_like(t), t, t**2], 1), windows.T)
    return *grid[best], float(shares[best]), float(shares[best] * (plain**2).mean())


def fit_ring(windows: np.ndarray, rate: float, at_least: float = 0.0) -> Ring | None:
    """A ring common to windows (trials, n) of samples at `rate` [Hz]; None where they are too short."""
    edges, start = _range(windows.shape[1], rate, at_least), screen(windows, rate, at_least)
    if edges is None:
        return None

    def refined(windows: np.ndarray, start: tuple[float, float]) -> tuple[float, float]:
        found = minimize(
            lambda u: np.log(_left(windows, rate, *np.exp(u))[0]), np.log(start), method="Nelder-Mead",
            bounds=[tuple(np.log(edges)), (np.log(LIGHTEST), np.log(HEAVIEST))],
            options={"xatol": 1e-4, "fatol": 1e-7, "maxiter": 150},
        )  # fmt: skip
        return float(np.exp(found.x[0])), float(np.exp(found.x[1]))

    best = refined(windows, start[:2])
    left, amplitude = _left(windows, rate, *best)
    inside = edges[0] * 1.01 < best[0] < edges[1] * 0.99 and 1.01 * LIGHTEST < best[1] < 0.99 * HEAVIEST
    n, sd, reach = len(windows), np.full(2, np.nan), np.nan
    if n > 1:
        logs = np.log([refined(np.delete(windows, i, 0), best) for i in range(n)])  # both are positive
        sd = np.sqrt((n - 1) / n * ((logs - logs.mean(0)) ** 2).sum(0))
        reach = -float(stdtrit(n - 1, 0.05))
    low, high = best * np.exp(-reach * sd), best * np.exp(reach * sd)
    return Ring(*best, float(best[0] * sd[0]), float(best[1] * sd[1]), (float(low[0]), float(high[0])),
                (float(low[1]), float(high[1])), amplitude, 1 - left, inside)  # fmt: skip


def _left(windows: np.ndarray, rate: float, frequency: float, damping: float) -> tuple[float, np.ndarray]:
    """Share of the squares about each window's parabola that a ring leaves; amplitudes (trials,)."""
    t = np.arange(windows.shape[1]) / rate
    s = 2 * t / t[-1] - 1
    parabola = np.stack([np.ones_like(s), s, s**2], 1)
    plain = windows.T - _fitted(parabola, windows.T)
    omega = 2 * np.pi * frequency
    decay = np.exp(-damping * omega * t)
    wave = np.stack([decay * np.sin(omega * t), decay * np.cos(omega * t)], 1)
    basis = np.concatenate([parabola, wave], 1)
    found = np.linalg.lstsq(basis, windows.T, rcond=None)[0]
    size = np.maximum((plain**2).sum(0), 1e-300)  # each trial counts alike
    return float((((windows.T - basis @ found) ** 2).sum(0) / size).mean()) + 1e-300, np.hypot(*found[3:])


def _fitted(basis: np.ndarray, values: np.ndarray) -> np.ndarray:
    return basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
