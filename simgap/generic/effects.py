"""What effects that need no contact model do to simulated trials, and a ring found in recorded ones.

Each acts in one channel on the mean simulated course and on the simulated trials, whose spectra are then
recomputed, or on durations. A channel has the effects of `simgap.channels`, from the true value outwards;
vibration and noise are added to what they give.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize
from scipy.special import stdtrit

from simgap.channels import ChannelEffect, Theta, at_rest, channel_effects
from simgap.effect import Parameter
from simgap.generic.trials import Layout, bin_edges, log_power, means, resampled, transformed, windowed

FINE = 2048  # numerics: points of the mean course
SMOOTH = 9  # numerics: coefficients over which a spectrum is smoothed
LINE = 1e-12  # numerics: of a channel: a straight line bends less from step to step
LEAST = 4  # numerics: coefficients that a mean power is taken of
COARSE = 10.0  # prior: what a given simulation is off by, of what a calibrated robot's sensors are
NOISE, LATE = "noise_level", "force_lag"


@dataclass(frozen=True)
class EnsembleEffect(ChannelEffect):
    """An effect on given trials. `each`: one in each channel, one a channel and event (an oscillation's sine
    and cosine), or one a subtask (durations)."""

    each: str = "channel"


@cache
def effects() -> dict[str, ChannelEffect]:
    """All effects on given trials, those of any channel by the names that they have in a hand's forces."""
    own = (
        EnsembleEffect(
            "structural_vibration", "a damped mode rung at the start of a subtask",
            {"sin": Parameter(0.0, 0.02, "", starts=(0.06, 0.0, -0.06, 0.0)),
             "cos": Parameter(0.0, 0.02, "", starts=(0.0, 0.06, 0.0, -0.06))},
            "power about one frequency", each="event",
        ),
        EnsembleEffect(
            NOISE, "white noise added (less, if negative)",
            {"sd": Parameter(0.0, 0.005, "", starts=(0.0025, 0.025, -0.0025))},
            "power at all frequencies alike",
        ),
        EnsembleEffect(
            "timing", "durations of subtasks multiplied", {"log_ratio": Parameter(0.0, 0.05)},
            "durations alone", each="subtask",
        ),
    )  # fmt: skip
    of_any = (replace(e, name=f"force_{e.name}") for e in channel_effects().values())
    return {e.name: e for e in (*of_any, *own)}


@dataclass(frozen=True)
class Slot:
    """A parameter of an effect in a channel (-1: durations); `place`: its event or subtask, else -1."""

    effect: str
    parameter: Parameter
    channel: int
    place: int

    @property
    def label(self) -> str:
        """A name of its own."""
        return f"{self.channel}/{self.place}/{self.parameter.name}"


def slots(given: Scene, effect: str, channel: int) -> list[Slot]:
    """Parameters of an effect in a channel (-1: durations); none where it does not act there."""
    acting, lay = effects()[effect], given.layout
    each = getattr(acting, "each", "channel")
    if (each == "subtask") != (channel < 0) or (each == "event" and given.ring is None):
        return []
    size, unit = (
        (1.0, "") if channel < 0 else (lay.scale[channel], f"unit of {lay.ensembles.channels[channel]}")
    )
    sized = acting.sized(float(size), unit, float(given.edges[-1]), COARSE)
    count = len(lay.ensembles.subtasks)
    places = {"channel": [-1], "event": range(1, count), "subtask": range(count)}[each]
    return [Slot(effect, p, channel, k) for k in places for p in sized.values()]


Acting = Mapping[str, Theta]  # values by effect


@dataclass(frozen=True)
class Scene:
    """What predictions start from: the layout, mean real boundaries and the mean simulated course on them.

    `t` (FINE,) [s] and `course` (C, FINE); `floor` (C,): power of the simulated noise; `ring`: the
    oscillation looked for. `plain_waves`: spectra as simulated by channel; `cache`: powers computed so far.
    """

    layout: Layout
    edges: np.ndarray
    t: np.ndarray
    course: np.ndarray
    floor: np.ndarray
    ring: Ring | None = None
    plain_waves: dict[int, list[np.ndarray]] = field(default_factory=dict, repr=False)
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
        return [predicted(self, c, {}) for c in range(len(self.course))]


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


def predicted(given: Scene, channel: int, acting: Acting, rung: np.ndarray | None = None) -> np.ndarray:
    """Predicted features of a channel in the order of `Layout.of_channel`.

    `rung` (K, 2): sine and cosine amplitudes of a vibration from each subtask's start on.
    """
    x, rate = read(given.t, given.course[channel], acting), given.layout.rate
    rung = np.zeros((len(given.layout.window), 2)) if rung is None else rung
    for k in np.flatnonzero(rung.any(1)):
        x = x + rung[k] @ given.waves[k]
    whole, part = divmod(acting.get(LATE, {}).get("delay", 0.0) * rate, 1.0)
    fast = 0.0
    # Between samples noise would be smoothed: a lag by parts of one has a share of both neighbours' powers.
    for shift, share in ((whole, 1 - part), (whole + 1, part)):
        if share > 1e-9:
            late = {LATE: {"delay": shift / rate}} if LATE in acting else {}
            fast = fast + share * _log_powers(given, channel, {**acting, **late}, rung)
    return np.concatenate([means(given.t, x, given.bins), np.atleast_1d(fast)])


def _log_powers(given: Scene, channel: int, acting: Acting, rung: np.ndarray) -> np.ndarray:
    """Mean log powers of the simulated trials' sub-bands in all subtasks, as they are read."""
    key = channel, tuple((n, *sorted(v.items())) for n, v in sorted(acting.items())), rung.tobytes()
    if key in given.cache:
        return given.cache[key]
    layout, out, more = given.layout, [np.zeros(0)], acting.get(NOISE, {}).get("sd", 0.0)
    added = max(more * abs(more), -given.floor[channel])  # no more noise can be missing than there is
    for k, wave in enumerate(_waves(given, channel, acting)):
        if layout.coefficients[k]:
            if rung[k].any():
                t = (np.arange(wave.shape[1]) + 0.5) / layout.rate
                wave = wave + transformed(rung[k] @ ring_waves(given, t))
            out.append(log_power(layout, np.maximum(wave**2 + added, 0.0), channel, k).mean(0))
    given.cache[key] = np.concatenate(out)
    return given.cache[key]


def read(t: np.ndarray, values: np.ndarray, acting: Acting) -> np.ndarray:
    """Values (n,) as they are read where these effects act."""
    for effect in reversed(channel_effects().values()):
        theta = acting.get(f"force_{effect.name}")
        if theta is not None:
            values = at_rest(effect.read, t, values, theta)
    return values


def _waves(given: Scene, channel: int, acting: Acting) -> list[np.ndarray]:
    """DCT coefficients (S, window) of the simulated trials in each subtask, as they are read.

    What lies at the noise floor is the sensor's own noise, which is added behind what it is read through: its
    power there is put back to what it was.
    """
    lay, name = given.layout, given.layout.ensembles.channels[channel]
    noise, x = given.floor[channel], given.course[channel]
    straight = np.ptp(np.diff(read(given.t, x, acting) - x)) < LINE * (1 + np.abs(x).max())  # in no spectrum
    if straight and channel in given.plain_waves:
        return given.plain_waves[channel]
    rows: list[list[np.ndarray]] = [[] for _ in lay.window]
    for cut in lay.ensembles.sim:
        t, values = cut.trial.t, cut.trial.channels[name]
        there = np.isfinite(values)
        values = values if there.all() else np.interp(t, t[there], values[there])
        if not straight:  # a second before the start as the first one, mirrored: what is held has no noise
            m = min(t.size - 1, int(cut.trial.rate))
            before, early = 2 * t[0] - t[m:0:-1], values[m:0:-1]
            every = np.concatenate([before, t]) - cut.edges[0]
            values = read(every, np.concatenate([early, values]), acting)[m:]
        for k, mine in enumerate(rows):
            mine.append(windowed(lay, cut, channel, k, values))
    out = [transformed(np.array(mine)) for mine in rows]
    if straight:
        given.plain_waves[channel] = out
        return out
    for k, plain in enumerate(_waves(given, channel, {})):
        now, floor = _smooth(out[k]), np.minimum(noise, _smooth(plain))
        lost = 1 - _response(lay.rate, plain.shape[1], acting)
        out[k] = out[k] * np.sqrt(np.maximum(now + floor * lost, 0.0) / now)
    return out


def _response(rate: float, window: int, acting: Acting) -> np.ndarray:
    """By how much the power of white noise is multiplied at the frequencies (window,) of a DCT."""
    t, click = np.arange(FINE) / rate, np.zeros(FINE)
    click[FINE // 8] = 1.0
    heard = read(t, click, acting) - read(t, np.zeros(FINE), acting)
    power = np.square(np.abs(np.fft.rfft(heard)))
    return np.interp(np.arange(window) * rate / (2 * window), np.fft.rfftfreq(FINE, 1 / rate), power)


def _smooth(waves: np.ndarray) -> np.ndarray:
    """Power (window,) of coefficients (..., window), smoothed."""
    power = np.square(np.atleast_2d(waves)).mean(0)
    return np.maximum(uniform_filter1d(power, SMOOTH, mode="nearest"), 1e-300)


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
LIGHTEST, HEAVIEST = 1e-3, 0.25  # chosen: damping below or beyond which it is no ring
FREQUENCIES = 80  # numerics: where searches start
SWING = 1 / 3  # chosen: of a window within which the largest swing is looked for
SHORTEST = 12  # numerics: samples of a window in which an oscillation is looked for
PERIODS = 1.5  # chosen: of the slowest oscillation looked for that a window holds
HIGHEST = 0.4  # chosen: of the sampling rate
RINGS = 0.2  # chosen: share of the square after an event that an oscillation must explain


@dataclass(frozen=True)
class Ring:
    """`frequency` [Hz] and `damping` (ratio to critical) with standard errors and 90 % intervals."""

    frequency: float
    damping: float
    frequency_sd: float
    damping_sd: float
    frequency_90: tuple[float, float]
    damping_90: tuple[float, float]


def find_ring(given: Scene) -> Ring | None:
    """The strongest oscillation after an event in the real trials, where they hold more power than the
    simulated ones; after the last event from as long as all of them go on, for what is compared may end
    sooner."""
    lay, best, found = given.layout, 0.0, None
    last = len(lay.ensembles.subtasks) - 1
    longest = min(c.trial.t[-1] - c.edges[-2] for c in lay.ensembles.real)
    for k in range(1, last + 1):
        for c, name in enumerate(lay.ensembles.channels):
            real, sim = (np.array([windowed(lay, cut, c, k) for cut in kind])
                         for kind in (lay.ensembles.real, lay.ensembles.sim))  # fmt: skip
            if real.shape[1] < 4 * LEAST or real.var(1).mean() < sim.var(1).mean():
                continue
            rest = real - sim.mean(0)  # what the simulation has is no ring
            windows = list(rest if rest.var(1).mean() < real.var(1).mean() else real)
            if k == last and longest > given.edges[-1] - given.edges[-2] + 0.5 / lay.rate:
                since = np.arange(0.0, longest, 1 / lay.rate)
                windows = [resampled(cut.trial.t, cut.trial.channels[name], cut.edges[-2] + since, lay.rate)
                           for cut in lay.ensembles.real]  # fmt: skip
            swings = from_swing(windows)
            share = 1 - _screened(swings, lay.rate)[2]
            strength = share * np.square(_detrended(swings)).sum() / (len(swings) * lay.scale[c] ** 2)
            if share > RINGS and strength > best:
                best, found = strength, swings
    return None if found is None else fit_ring(found, lay.rate)


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


def fit_ring(windows: np.ndarray, rate: float) -> Ring | None:
    """The ring common to several windows.

    Args:
        windows: Samples (trials, n), from a swing on.
        rate: Of the samples [Hz].

    Returns:
        The ring; None where windows are too short, or the best frequency lies at an end of the range that
        they resolve, or the best damping is none of a ring.
    """
    low, high = PERIODS * rate / max(windows.shape[1], 1), HIGHEST * rate
    ends = np.log([(low, high), (LIGHTEST, HEAVIEST)])

    def refined(windows: np.ndarray, start: Sequence[float] | np.ndarray) -> np.ndarray:
        return minimize(
            lambda u: np.log(_left(windows, rate, *np.exp(u))), np.log(start), method="Nelder-Mead",
            bounds=[*map(tuple, ends)], options={"xatol": 1e-4, "fatol": 1e-7, "maxiter": 150},
        ).x  # fmt: skip

    *start, left = _screened(windows, rate)
    if left == 1.0:
        return None
    best, n = refined(windows, start), len(windows)
    if (np.abs(best[:, None] - ends) < 0.01).any():
        return None
    sd, reach = np.full(2, np.nan), np.nan
    if n > 1:
        each = np.array([refined(np.delete(windows, i, 0), np.exp(best)) for i in range(n)])
        sd = np.sqrt((n - 1) / n * ((each - each.mean(0)) ** 2).sum(0))
        reach = -float(stdtrit(n - 1, 0.05))
    (f, z), (f_sd, z_sd) = map(float, np.exp(best)), map(float, np.exp(best) * sd)
    f_90, z_90 = ((float(a), float(b)) for a, b in np.exp(best + np.outer([-reach, reach], sd)).T)
    return Ring(f, z, f_sd, z_sd, f_90, z_90)


def _screened(windows: np.ndarray, rate: float) -> tuple[float, float, float]:
    """Best frequency [Hz] and damping on a grid, and the share of the square about each window's parabola
    that they leave: 1 where windows are too short."""
    low, high = PERIODS * rate / max(windows.shape[1], 1), HIGHEST * rate
    if windows.shape[1] < SHORTEST or low >= high:
        return np.nan, np.nan, 1.0
    grid = [(f, z) for f in np.geomspace(low, high, FREQUENCIES) for z in DAMPINGS]
    left, place = min((_left(windows, rate, *g), g) for g in grid)
    return *place, left


def _left(windows: np.ndarray, rate: float, frequency: float, damping: float) -> float:
    """Share of the square about each window's parabola that a ring leaves, mean over trials."""
    angle = 2 * np.pi * frequency * np.arange(windows.shape[1]) / rate
    waves = np.exp(-damping * angle) * np.array([np.sin(angle), np.cos(angle)])
    basis, rest = np.linalg.qr(_detrended(waves).T)[0], _detrended(windows)
    size = np.maximum(np.square(rest).sum(1), 1e-300)  # each trial counts alike
    return max(1 - float((np.square(rest @ basis).sum(1) / size).mean()), 1e-300)


def _detrended(windows: np.ndarray) -> np.ndarray:
    """Windows (trials, n) without the parabola that fits each best."""
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, windows.shape[1]), 3))[0]
    return windows - windows @ basis @ basis.T
