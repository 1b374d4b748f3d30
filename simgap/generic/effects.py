"""Effects that need no contact model, applied to given simulated trials.

An effect acts in one channel, on the mean simulated course and on every simulated trial (whose powers are
then recomputed), or on durations. A channel passes through the effects of `simgap.channels` in order, from
the true value outwards; vibration and noise are added to the result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from simgap.channels import ChannelEffect, Theta, at_rest, channel_effects
from simgap.effect import Parameter
from simgap.generic.ring import LEAST, Ring
from simgap.generic.trials import Cut, Layout, bin_edges, means, powers, resampled, transformed, windowed

FINE = 2048  # numerics: points of the mean course
LINE = 1e-12  # numerics: relative change of slope per step, below which a course is a straight line
COARSE = 10.0  # prior: errors of a given simulation over those of a calibrated robot's sensors
NOISE = "noise_level"


@dataclass(frozen=True)
class EnsembleEffect(ChannelEffect):
    """An effect on given trials, with parameters for `each` channel, each event of each channel (sine and
    cosine of an oscillation), or each subtask (durations)."""

    each: str = "channel"


@cache
def effects() -> dict[str, ChannelEffect]:
    """All effects on given trials by name; those on any channel are named as in a hand's forces."""
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
    """A parameter of an effect in a channel (-1: durations), at `place`: its event or subtask, else -1."""

    effect: str
    parameter: Parameter
    channel: int
    place: int

    @property
    def label(self) -> str:
        """A unique name within the effect."""
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
    """What predictions start from: the layout, mean real boundaries `edges` (K + 1,) [s], and the mean
    simulated `course` (C, FINE) stretched to them, at times `t` (FINE,) [s].

    `floor` (C,) is the power of the simulated noise, `ring` the oscillation found in the real trials, `known`
    a cache of log powers.
    """

    layout: Layout
    edges: np.ndarray
    t: np.ndarray
    course: np.ndarray
    floor: np.ndarray
    ring: Ring | None = None
    known: dict[tuple[Any, ...], np.ndarray] = field(default_factory=dict, repr=False)

    @cached_property
    def bins(self) -> np.ndarray:
        """Edges [s] of the parts of all subtasks."""
        return bin_edges(self.layout, self.edges)

    @cached_property
    def powers(self) -> list[np.ndarray]:
        """Simulated powers (S, num_bands) of the sub-bands of every channel."""
        return [powers(self.layout, self.layout.ensembles.sim, c) for c in range(len(self.course))]

    @cached_property
    def plain(self) -> list[np.ndarray]:
        """Predicted features of every channel without effects."""
        return [predicted(self, c, {}) for c in range(len(self.course))]


def scene(layout: Layout, ring: Ring | None = None) -> Scene:
    """The scene of two ensembles. Simulated courses are stretched to the mean real durations, except for the
    time right after each event."""

    def knots(edges: np.ndarray) -> np.ndarray:  # corresponding times of all trials
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
    """Power of the simulated noise (C,): the upper quarter of the quietest subtask's spectrum."""
    out = np.zeros(len(layout.ensembles.channels))
    for c in range(out.size):
        spectra = [np.square([transformed(windowed(layout, cut, c, k)) for cut in layout.ensembles.sim])
                   for k, n in enumerate(layout.window) if n >= 4 * LEAST]  # fmt: skip
        out[c] = min((float(s[:, -(s.shape[1] // 4) :].mean()) for s in spectra), default=0.0)
    return out


def read(t: np.ndarray, values: np.ndarray, acting: Acting) -> np.ndarray:
    """Values (n,) recorded under the given effects."""
    for effect in reversed(channel_effects().values()):
        theta = acting.get(f"force_{effect.name}")
        if theta is not None:
            values = at_rest(effect.read, t, values, theta)
    return values


def _rung(given: Scene, t: np.ndarray, starts: np.ndarray, rung: np.ndarray) -> np.ndarray:
    """A vibration (n,) at times t [s], excited at subtasks' `starts` [s] with amplitudes `rung` (K, 2)."""
    out = np.zeros(t.size)
    for k in np.flatnonzero(rung.any(1)):
        assert given.ring is not None
        out += rung[k] @ given.ring.waves(t - starts[k])
    return out


def predicted(given: Scene, channel: int, acting: Acting, rung: np.ndarray | None = None) -> np.ndarray:
    """Predicted features of a channel, in the order of `Layout.of_channel`.

    `rung` (K, 2): sine and cosine amplitudes of a vibration that starts with each subtask.
    """
    rung = np.zeros((len(given.layout.window), 2)) if rung is None else rung
    x = read(given.t, given.course[channel], acting) + _rung(given, given.t, given.edges[:-1], rung)
    key = channel, tuple((n, *sorted(v.items())) for n, v in sorted(acting.items())), rung.tobytes()
    if key not in given.known:
        given.known[key] = _log_powers(given, channel, acting, rung)
    return np.concatenate([means(given.t, x, given.bins), given.known[key]])


def _log_powers(given: Scene, channel: int, acting: Acting, rung: np.ndarray) -> np.ndarray:
    """Mean log powers of the simulated trials' sub-bands in all subtasks under the given effects.

    Power at the noise floor is the sensor's own noise, which is added after the effects: it is restored.
    """
    plain, x, least = given.powers[channel], given.course[channel], given.layout.least[channel]
    # An added straight line is in no spectrum.
    straight = np.ptp(np.diff(read(given.t, x, acting) - x)) < LINE * (1 + np.abs(x).max())
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
    """A simulated trial's channel (n,) as recorded; before its start mirrored, as held values lack noise."""
    t, values = cut.trial.t, cut.trial.channels[given.layout.ensembles.channels[channel]]
    there = np.isfinite(values)
    values = values if there.all() else np.interp(t, t[there], values[there])
    m = min(t.size - 1, int(np.searchsorted(t, t[0] + 1.0)))
    every = np.concatenate([2 * t[0] - t[m:0:-1], t]) - cut.edges[0]
    values = read(every, np.concatenate([values[m:0:-1], values]), acting)[m:]
    return values + _rung(given, t, cut.edges[:-1], rung)


def _response(lay: Layout, acting: Acting) -> np.ndarray:
    """Power gain (num_bands,) of the effects for white noise, in the sub-bands of all subtasks."""
    t, click = np.arange(FINE) / lay.rate, np.zeros(FINE)
    click[FINE // 8] = 1.0
    heard = read(t, click, acting) - read(t, np.zeros(FINE), acting)
    power, at = np.square(np.abs(np.fft.rfft(heard))), np.fft.rfftfreq(FINE, 1 / lay.rate)
    bands = [(np.arange(s.start, s.stop) * lay.rate / (2 * n))
             for n, own in zip(lay.window, lay.coefficients, strict=True) for s in own]  # fmt: skip
    return np.array([np.interp(band, at, power).mean() for band in bands])
