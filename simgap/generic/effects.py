"""What effects that need no contact model do to simulated trials.

Each acts in one channel on the mean simulated course and on the simulated trials, whose powers are then
recomputed, or on durations. A channel has the effects of `simgap.channels`, from the true value outwards;
vibration and noise are added to what they give.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np

from simgap.channels import ChannelEffect, Theta, at_rest, channel_effects
from simgap.effect import Parameter
from simgap.generic.ring import LEAST, Ring
from simgap.generic.trials import Cut, Layout, bin_edges, means, powers, resampled, transformed, windowed

FINE = 2048  # numerics: points of the mean course
LINE = 1e-12  # numerics: of a channel: a straight line bends less from step to step
COARSE = 10.0  # prior: what a given simulation is off by, of what a calibrated robot's sensors are
NOISE = "noise_level"


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
    each = acting.each if isinstance(acting, EnsembleEffect) else "channel"
    if (each == "subtask") != (channel < 0) or (each == "event" and given.ring is None):
        return []
    size, unit = 1.0, ""
    if channel >= 0:
        size, unit = float(lay.scale[channel]), f"unit of {lay.ensembles.channels[channel]}"
    sized = acting.sized(size, unit, float(given.edges[-1]), COARSE)
    count = len(lay.ensembles.subtasks)
    places = {"channel": [-1], "event": range(1, count), "subtask": range(count)}[each]
    return [Slot(effect, p, channel, k) for k in places for p in sized.values()]


Acting = Mapping[str, Theta]  # values by effect


@dataclass(frozen=True)
class Scene:
    """What predictions start from: the layout, mean real boundaries and the mean simulated course on them.

    `t` (FINE,) [s] and `course` (C, FINE); `floor` (C,): power of the simulated noise; `ring`: the
    oscillation looked for. `known`: log powers computed so far.
    """

    layout: Layout
    edges: np.ndarray
    t: np.ndarray
    course: np.ndarray
    floor: np.ndarray
    ring: Ring | None = None
    known: dict[tuple, np.ndarray] = field(default_factory=dict, repr=False)

    @cached_property
    def bins(self) -> np.ndarray:
        """Edges [s] of the parts of all subtasks."""
        return bin_edges(self.layout, self.edges)

    @cached_property
    def powers(self) -> list[np.ndarray]:
        """Powers of the sub-bands (S, num_bands) of every channel, as simulated."""
        return [powers(self.layout, self.layout.ensembles.sim, c) for c in range(len(self.course))]

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


def read(t: np.ndarray, values: np.ndarray, acting: Acting) -> np.ndarray:
    """Values (n,) as they are read where these effects act."""
    for effect in reversed(channel_effects().values()):
        theta = acting.get(f"force_{effect.name}")
        if theta is not None:
            values = at_rest(effect.read, t, values, theta)
    return values


def _rung(given: Scene, t: np.ndarray, starts: np.ndarray, rung: np.ndarray) -> np.ndarray:
    """A vibration (n,) at times [s] that is rung at the subtasks' starts with amplitudes (K, 2)."""
    out = np.zeros(t.size)
    for k in np.flatnonzero(rung.any(1)):
        assert given.ring is not None
        out += rung[k] @ given.ring.waves(t - starts[k])
    return out


def predicted(given: Scene, channel: int, acting: Acting, rung: np.ndarray | None = None) -> np.ndarray:
    """Predicted features of a channel in the order of `Layout.of_channel`.

    `rung` (K, 2): sine and cosine amplitudes of a vibration from each subtask's start on.
    """
    rung = np.zeros((len(given.layout.window), 2)) if rung is None else rung
    x = read(given.t, given.course[channel], acting) + _rung(given, given.t, given.edges[:-1], rung)
    key = channel, tuple((n, *sorted(v.items())) for n, v in sorted(acting.items())), rung.tobytes()
    if key not in given.known:
        given.known[key] = _log_powers(given, channel, acting, rung)
    return np.concatenate([means(given.t, x, given.bins), given.known[key]])


def _log_powers(given: Scene, channel: int, acting: Acting, rung: np.ndarray) -> np.ndarray:
    """Mean log powers of the simulated trials' sub-bands in all subtasks, as they are read.

    What lies at the noise floor is the sensor's own noise, which is added behind what it is read through: its
    power there is put back to what it was.
    """
    plain, x, least = given.powers[channel], given.course[channel], given.layout.least[channel]
    straight = np.ptp(np.diff(read(given.t, x, acting) - x)) < LINE * (1 + np.abs(x).max())  # in no spectrum
    found = plain
    if not straight or rung.any():
        cuts = given.layout.ensembles.sim
        found = powers(given.layout, cuts, channel, [_as_read(given, c, channel, acting, rung) for c in cuts])
    sd = acting.get(NOISE, {}).get("sd", 0.0)
    noise = np.minimum(given.floor[channel], plain.mean(0))
    now, more = found.mean(0) + least, max(sd * abs(sd), -given.floor[channel])  # none below no noise
    if not straight:
        more = more + noise * (1 - _response(given.layout, acting))
    return np.log(found + least).mean(0) + np.log(np.maximum(now + more, least) / now)


def _as_read(given: Scene, cut: Cut, channel: int, acting: Acting, rung: np.ndarray) -> np.ndarray:
    """A simulated trial's channel (n,) as it is read. A second before its start was as the first one,
    mirrored: what is held has no noise."""
    t, values = cut.trial.t, cut.trial.channels[given.layout.ensembles.channels[channel]]
    there = np.isfinite(values)
    values = values if there.all() else np.interp(t, t[there], values[there])
    m = min(t.size - 1, int(np.searchsorted(t, t[0] + 1.0)))
    every = np.concatenate([2 * t[0] - t[m:0:-1], t]) - cut.edges[0]
    values = read(every, np.concatenate([values[m:0:-1], values]), acting)[m:]
    return values + _rung(given, t, cut.edges[:-1], rung)


def _response(lay: Layout, acting: Acting) -> np.ndarray:
    """By how much the power of white noise is multiplied in the sub-bands (num_bands,) of all subtasks."""
    t, click = np.arange(FINE) / lay.rate, np.zeros(FINE)
    click[FINE // 8] = 1.0
    heard = read(t, click, acting) - read(t, np.zeros(FINE), acting)
    power, at = np.square(np.abs(np.fft.rfft(heard))), np.fft.rfftfreq(FINE, 1 / lay.rate)
    bands = [(np.arange(s.start, s.stop) * lay.rate / (2 * n))
             for n, own in zip(lay.window, lay.coefficients, strict=True) for s in own]  # fmt: skip
    return np.array([np.interp(band, at, power).mean() for band in bands])
