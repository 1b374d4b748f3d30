"""What may happen to one channel of a table with times: to what is read of it, or to what is commanded.

A `ChannelEffect` in a module of this package is found by itself. It is then a candidate in a hand's forces
(`hmmseg effects`, `play`, the virtual model), in every read-out or command of a robot, and in every
channel of given simulated trials.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from simgap.effect import Array, Effect, Parameter

Theta = Mapping[str, float]  # an effect's parameters by name
Act = Callable[[Array, Array, Theta], Array]  # (times since the start [s], values there, theta)
SHORTEST = 1e-9  # numerics: s: below this nothing is smoothed
SETTLED = 5  # numerics: samples before a start that tell `onset` of rest


@dataclass(frozen=True)
class ChannelEffect(Effect):
    """An effect on one channel: `read` gives what is recorded of true values, or what acts of commanded ones.

    `read` and `undo` map values (num_timesteps,) at times (num_timesteps,), there and back; NumPy and JAX
    arrays alike, unless it `remembers` other times than a sample's own. A parameter's unit may be "" for the
    channel's own, or "/s" for that in a second; its numbers are then shares of what is usual in the channel.
    `of`: of what it is a candidate: "reading", "effort" (a command of torque, force or current), "duty" (one
    without a unit), "place" (of a position).
    """

    read: Act = lambda t, values, theta: values
    undo: Act | None = None
    of: tuple[str, ...] = ("reading",)
    remembers: bool = False

    def sized(self, size: float, unit: str, duration: float, factor: float = 1.0) -> dict[str, Parameter]:
        """Parameters in a channel's unit: `size` is its usual one, `duration` [s] that of its log; priors
        wider by `factor`."""
        out = dict[str, Parameter]()
        for name, p in self.parameters.items():
            own = {"": size, "/s": size / duration}.get(p.unit)
            p = p if own is None else p.scaled(own, unit + p.unit)
            out[name] = replace(p, sd=factor * p.sd)
        return out


@cache
def channel_effects(*of: str) -> dict[str, ChannelEffect]:
    """Effects on readings (or what else is named) by name, in the order in which they are defined."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    found = [v for m in modules for v in vars(m).values() if isinstance(v, ChannelEffect)]
    return {e.name: e for e in found if {*e.of} & {*(of or ("reading",))}}


def at_rest(read: Act, t: np.ndarray, values: np.ndarray, theta: Theta) -> np.ndarray:
    """What is read of values (n,) that had rested before the first of the times."""
    if len(t) < 2:
        return read(t, values, theta)
    early = t[0] - (t[1] - t[0]) * np.arange(SETTLED, 0, -1)
    held = np.full(SETTLED, values[0])
    return read(np.concatenate([early, t]), np.concatenate([held, values]), theta)[SETTLED:]


def delayed(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Values (num_timesteps,) `delay` [s] later, at these times; before their start they were a parabola."""
    if len(values) < 3:
        return values
    late = t - delay
    slope, bend = onset(t, values)
    ahead = np.minimum(late - t[0], 0.0)
    before = values[0] + slope * ahead + 0.5 * bend * ahead**2
    return np.where(late < t[0], before, np.interp(late, t, values))


def onset(t: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """First and second derivative at the start, of the parabola through three early samples."""
    few = min(2, (len(values) - 1) // 2)
    a, b = t[few] - t[0], t[2 * few] - t[0]
    first, second = (values[few] - values[0]) / a, (values[2 * few] - values[0]) / b
    bend = 2 * (second - first) / (b - a)
    return float(first - 0.5 * bend * a), float(bend)


def lowpass(t: np.ndarray, values: np.ndarray, time_constant: float) -> np.ndarray:
    """tau y' + y = u for values u (num_timesteps,) linear between samples, exactly.

    Before the start u was a parabola, which y had settled to follow: y = u - tau u' + tau^2 u''.
    """
    if time_constant < SHORTEST or len(values) < 3:
        return values
    from simgap.recursions import smoothed

    slope, bend = onset(t, values)
    start = values[0] - time_constant * slope + time_constant**2 * bend
    return smoothed(np.asarray(t, float), np.asarray(values, float), float(time_constant), float(start))


def play(values: np.ndarray, width: float) -> np.ndarray:
    """The play operator: the output (n,) follows the input only where that pushes a side of the gap."""
    from simgap.recursions import play

    return play(values, width)
