"""Effects on one channel of a table with times: on its readings, or on its commands.

Each `ChannelEffect` defined in a module of this package is found automatically. It is then a candidate in a
hand's forces (`hmmseg effects`, `play`, the virtual model), in every read-out or command of a robot, and in
every channel of given simulated trials.
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
SHORTEST = 1e-9  # numerics: s; a shorter time constant smooths nothing
SETTLED = 5  # numerics: samples of rest put before a start, for `onset`


@dataclass(frozen=True)
class ChannelEffect(Effect):
    """An effect on one channel: `read` maps true values to recorded ones, or commanded values to acting ones.

    `read` and its inverse `undo` map values (num_timesteps,) at times (num_timesteps,), for NumPy and JAX
    arrays unless the effect `remembers` other samples. A parameter's unit may be "" (the channel's own) or
    "/s" (that per second); its numbers are then relative to the channel's usual size. `of` lists what it is a
    candidate for: "reading", "effort" (commands of torque, force or current), "duty" (commands without a
    unit), "place" (commands of a position).
    """

    read: Act = lambda t, values, theta: values
    undo: Act | None = None
    of: tuple[str, ...] = ("reading",)
    remembers: bool = False

    def sized(self, size: float, unit: str, duration: float, factor: float = 1.0) -> dict[str, Parameter]:
        """Parameters in a channel's `unit`, given its usual `size` and the `duration` [s] of its log; prior
        standard deviations are multiplied by `factor`."""
        out = dict[str, Parameter]()
        for name, p in self.parameters.items():
            own = {"": size, "/s": size / duration}.get(p.unit)
            p = p if own is None else p.scaled(own, unit + p.unit)
            out[name] = replace(p, sd=factor * p.sd)
        return out


@cache
def channel_effects(*of: str) -> dict[str, ChannelEffect]:
    """Effects on readings (or on any of the kinds `of`) by name, in the order of their definition."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    found = [v for m in modules for v in vars(m).values() if isinstance(v, ChannelEffect)]
    return {e.name: e for e in found if {*e.of} & {*(of or ("reading",))}}


def at_rest(read: Act, t: np.ndarray, values: np.ndarray, theta: Theta) -> np.ndarray:
    """`read` of values (n,) that were constant before the first time."""
    if len(t) < 2:
        return read(t, values, theta)
    early = t[0] - (t[1] - t[0]) * np.arange(SETTLED, 0, -1)
    held = np.full(SETTLED, values[0])
    return read(np.concatenate([early, t]), np.concatenate([held, values]), theta)[SETTLED:]


def delayed(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Values (num_timesteps,) delayed by `delay` [s]; before the start they are a parabola."""
    if len(values) < 3:
        return values
    late = t - delay
    slope, bend = onset(t, values)
    ahead = np.minimum(late - t[0], 0.0)
    before = values[0] + slope * ahead + 0.5 * bend * ahead**2
    return np.where(late < t[0], before, np.interp(late, t, values))


def onset(t: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """First and second derivative at the start of the parabola through three early samples."""
    few = min(2, (len(values) - 1) // 2)
    a, b = t[few] - t[0], t[2 * few] - t[0]
    first, second = (values[few] - values[0]) / a, (values[2 * few] - values[0]) / b
    bend = 2 * (second - first) / (b - a)
    return float(first - 0.5 * bend * a), float(bend)


def lowpass(t: np.ndarray, values: np.ndarray, time_constant: float) -> np.ndarray:
    """Exact solution of tau y' + y = u for values u (num_timesteps,) that are linear between samples.

    Before the start u is a parabola that y follows in steady state: y = u - tau u' + tau^2 u''.
    """
    if time_constant < SHORTEST or len(values) < 3:
        return values
    from simgap.recursions import smoothed

    slope, bend = onset(t, values)
    start = values[0] - time_constant * slope + time_constant**2 * bend
    return smoothed(np.asarray(t, float), np.asarray(values, float), float(time_constant), float(start))


def play(values: np.ndarray, width: float) -> np.ndarray:
    """The play operator: the output (n,) follows the input only while it pushes a side of the gap."""
    from simgap.recursions import play

    return play(values, width)
