"""Force channels that remember: the reading lags its load by parts of many lengths."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import FILTER, Effect, Parameter, Performance, World, flat, with_force
from simgap.effects.filters import lowpass

TIMES = (0.1, 0.4, 1.6, 6.4)  # prior: s
LONG = 64  # numerics: samples after which a click is forgotten but for little
NAMES = tuple(f"share_{time:g}" for time in TIMES)


def _remembered(force, values, step):
    """What the readings (T, N, C) owe to loads of before, to first order: readings stand for the loads."""
    return sum(
        values[name] * (lowpass(force, jnp.asarray(time), step) - force)
        for name, time in zip(NAMES, TIMES, strict=True)
    )


def _correct(world: World, values, on) -> World:
    force = jnp.asarray(world.force)
    step = jnp.median(world.t[:, 1:] - world.t[:, :-1])
    # A correction that smooths would have less noise than was recorded.
    click = jnp.zeros((1, LONG, 1)).at[0, 1, 0].set(1.0)
    noise = jnp.sqrt(jnp.square(click - _remembered(click, values, step)).sum())
    return world._replace(force=force - _remembered(force, values, step), loudness=world.loudness / noise)


def _apply(performance: Performance, values, rng) -> Performance:
    from scipy.signal import lfilter  # slow to import

    force, step = flat(performance), float(np.median(np.diff(performance.t)))
    late = np.zeros_like(force)
    for name, time in zip(NAMES, TIMES, strict=True):
        keep = np.exp(-step / time)
        late += values[name] * (lfilter([1 - keep], [1, -keep], force - force[0], axis=0) + force[0] - force)
    return with_force(performance, force + late)


DECOY = Effect(
    name="force_memory",
    acts_on="sensing",
    says="recorded F = F + shares of F smoothed over 0.1, 0.4, 1.6 and 6.4 s",
    shows="after every change of load, for long",
    mistaken_for=("force_drift", "force_lowpass", "fingertip_creep"),
    parameters=tuple(Parameter(n, "1", 0.1, low=-0.5, high=0.5) for n in NAMES),
    stage=FILTER,
    correct=_correct,
    apply=_apply,
    wrist=True,
)
