"""Effects on force readings: bias, drift, gain, cross-talk, rotated sensors, delay, filter, quantisation,
jitter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.channels.sensors import BIAS, DRIFT, LAG, LOWPASS
from simgap.effect import Array, Parameter
from simgap.effects.base import (
    LATE,
    MIX,
    READOUT,
    SCALE,
    SMOOTH,
    HandEffect,
    Spread,
    Values,
    gradient,
    middle,
    mixing,
    of_forces,
    own,
    reading,
    tips,
    unread,
    with_mode,
)
from simgap.gap.frame import CHANNELS

# A constant offset of each force channel.


def _phrase_force_bias(means: Mapping[str, float], rig: Mapping[str, Any]) -> str:
    worst = max(means, key=lambda k: abs(means[k]))
    total = sum(abs(v) for v in means.values())
    lone = total > 0 and abs(means[worst]) > 0.8 * total
    return f"a zero error of force sensor {worst}" if lone else "zero errors of the force sensors"


FORCE_BIAS = of_forces(
    BIAS,
    exact=True,
    says="recorded F = F + b, per finger and axis",
    shows="all subtasks alike, free motion too",
    mistaken_for=("weight", "fingertip_mass"),
    called="zero errors of the force sensors",
    check="Tare the force sensors in free air, record two seconds at rest, and look at what is left.",
    phrase=_phrase_force_bias,
    parameters={c: Parameter(0.0, 0.1, "N") for c in FORCE_CHANNELS},
    admitted=lambda rig: ("force_bias", dict(zip(FORCE_CHANNELS, rig.systematic.force_bias, strict=True))),
)


# Force channels that drift from the start of each trial, at a constant or a decreasing rate.


def _since(t: Array, last: Array, values: Mapping[str, Array]) -> Array:
    """Effective seconds since the start, for a warm-up that slows down.

    The bend vanishes at the start and when the last block is left, so the mean slope is kept.
    """
    return t * (1 + values.get("bend", 0.0) * (1 - t / np.maximum(last, 1e-3)))


FORCE_DRIFT = of_forces(
    DRIFT,
    says="recorded F = F + c t, per finger and axis",
    shows="a ramp over the trial, free motion too",
    mistaken_for=("fingertip_creep", "force_bias"),
    called="force sensors whose zero drifts",
    check="Record a minute in free air after switching on; let amplifiers and gauges warm up first.",
    parameters={c: Parameter(0.0, 0.015, "N/s") for c in FORCE_CHANNELS}
    | {"bend": Parameter(0.0, 0.15, low=-0.6, high=0.6, hidden=True, shape=True)},
    correct=unread(DRIFT, own(DRIFT), _since),
    apply=reading(DRIFT, own(DRIFT), _since),
    played={},  # it acts on whole recordings
)


# Force channels that read too much or too little in proportion: all alike, those of a finger, or each.

FINGERS = ("finger1", "finger2")


def of_channels(values: Mapping[str, float], common: str) -> np.ndarray:
    """A parameter of each force channel (4,): the sum of the common one, its finger's and its own."""
    return np.array([sum(values.get(n, 0.0) for n in (common, f"finger{c[-1]}", c)) for c in FORCE_CHANNELS])


def _phrase_force_gain(means: Mapping[str, float], rig: Mapping[str, Any]) -> str:
    which = {k: v for k, v in means.items() if k != "gain"}
    if which:
        worst = max(which, key=lambda k: abs(which[k]))
        where = f"finger {worst[-1]}" if worst.startswith("finger") else worst
        return f"a force sensor that reads too {'high' if which[worst] > 0 else 'low'} ({where})"
    return f"force sensors that read too {'high' if means.get('gain', 0.0) > 0 else 'low'}"


FORCE_GAIN = mixing(
    lambda v: np.diag(1 + of_channels(v, "gain")),
    name="force_gain",
    says="recorded F = (1 + gain) F, common to all channels, of a finger, or of each channel",
    shows="every load, in proportion",
    mistaken_for=("weight", "fingertip_compliance"),
    called="force sensors that read too high or too low",
    check="Hang a known weight from each fingertip and compare; check the calibration factors in the driver.",
    phrase=_phrase_force_gain,
    parameters={n: Parameter(0.0, 0.1, low=-0.5, high=0.5) for n in ("gain", *FINGERS, *FORCE_CHANNELS)},
    forms=(("gain",), FINGERS, FORCE_CHANNELS),
    admitted=lambda rig: ("force_gain/2", dict(zip(FORCE_CHANNELS, rig.systematic.force_gain, strict=True))),
    stage=SCALE,
    wrist=True,
)


# Cross-talk between the axes of a force sensor, and sensors mounted with a rotation.


def _crosstalk(values: Values) -> np.ndarray:
    pair = np.array([[1.0, values["fx_from_fy"]], [values["fy_from_fx"], 1.0]])
    return np.asarray(block_diag(pair, pair))


def _turned(values: Values) -> np.ndarray:
    c, s = ([f(values[n]) for n in ("angle1", "angle2")] for f in (np.cos, np.sin))
    return np.asarray(block_diag(*(np.array([[c[k], -s[k]], [s[k], c[k]]]) for k in (0, 1))))


FORCE_CROSSTALK = mixing(
    _crosstalk,
    name="force_crosstalk",
    says="recorded fy = fy + e fx and fx = fx + h fy",
    shows="shear and net force follow the grip",
    mistaken_for=("sensor_rotation",),
    called="cross-talk between the axes of a force sensor",
    check="Press straight on a wall with one finger: if the other axis moves, redo the calibration matrix.",
    parameters={n: Parameter(0.0, 0.06, low=-0.2, high=0.2) for n in ("fy_from_fx", "fx_from_fy")},
    stage=MIX,
)

SENSOR_ROTATION = mixing(
    _turned,
    name="sensor_rotation",
    says="recorded F = R(angle) F, per finger",
    shows="both axes, antisymmetric",
    mistaken_for=("force_crosstalk", "table_tilt"),
    called="a force sensor mounted at an angle",
    check="Check the mounting screws and the stated sensor frame: pull along one axis and read the other.",
    parameters={n: Parameter(0.0, 0.06, "rad", low=-0.6, high=0.6) for n in ("angle1", "angle2")},
    stage=MIX,
)


# Forces delayed, or filtered by a first-order low-pass, in all channels or one finger's. The prediction is
# delayed or filtered; inverting the recording would amplify its noise.


def _of_fingers(words: str) -> Callable[[Mapping[str, float], Mapping[str, Any]], str]:
    """A phrase of these words, naming the finger if only one is affected."""

    def phrase(means: Mapping[str, float], rig: Mapping[str, Any]) -> str:
        acting = [k for k, v in means.items() if v > 0]
        return f"{words} of finger {acting[0][-1]}" if [k[:6] for k in acting] == ["finger"] else words

    return phrase


def _spread(name: str) -> Spread:
    return lambda values: [{name: v} for v in of_channels(values, name)]


FORCE_LAG = of_forces(
    LAG,
    exact=True,
    says="recorded F(t) = F(t - delay)",
    shows="every contact change, late",
    mistaken_for=("force_lowpass",),
    called="force readings that come late",
    check="Tap a fingertip and compare the time stamps of force and motion; look for a buffer of the forces.",
    phrase=_of_fingers("force readings that come late"),
    parameters={
        n: Parameter(
            0.0, 0.1, "s", starts=(0.015, 0.04, 0.07, 0.1, 0.14, 0.19, 0.25, 0.32), low=0.0, high=0.4
        )
        for n in ("delay", *FINGERS)
    },
    correct=lambda w, v, on: with_mode(w, LATE, on)._replace(delay=w.delay + of_channels(v, "delay")),
    forms=(("delay",), ("finger1",), ("finger2",)),
    apply=reading(LAG, _spread("delay")),
    wrist=True,
    played={"delay": 0.15},
)

FORCE_LOWPASS = of_forces(
    LOWPASS,
    exact=True,
    says="time_constant dF_rec/dt + F_rec = F",
    shows="rounded contact changes",
    mistaken_for=("force_lag",),
    called="a slow filter in the force channel",
    check="Look up the filter of the amplifier or driver; tap a fingertip and see how fast readings rise.",
    phrase=_of_fingers("a slow filter in the force channel"),
    parameters={
        n: Parameter(0.0, 0.08, "s", starts=(0.02, 0.06, 0.12, 0.2), low=0.0, high=0.5)
        for n in ("time_constant", *FINGERS)
    },
    forms=(("time_constant",), ("finger1",), ("finger2",)),
    correct=lambda w, v, on: with_mode(w, SMOOTH, on)._replace(
        smoothing=w.smoothing + of_channels(v, "time_constant")
    ),
    apply=reading(LOWPASS, _spread("time_constant")),
    wrist=True,
    played={"time_constant": 0.15},
)


# Forces rounded to a step.

WRITTEN = 1e-5  # prior: N; resolution to which files state forces that were not rounded before


def _scatter_quantisation(given: Any, residual: np.ndarray) -> Any:
    """Variance from rounding, if forces lie on a lattice.

    Values that were not rounded would all fall on its levels with a chance of WRITTEN / step each.
    """
    from simgap.gap.assemble import Scatter, rounded_variance

    step = given.frame.step
    if step == 0:
        return None
    known = float(4 * sum(given.frame.lengths) * np.log(step / WRITTEN))
    return Scatter("quantisation", step, 1e-3, rounded_variance(given, step), known)


QUANTISATION = HandEffect(
    name="quantisation",
    says="recorded F = step * round(F / step)",
    shows="plateaus; repeated values",
    mistaken_for=("noise",),
    called="coarse steps in the force readings",
    check="Check the range and resolution of the converter: list the distinct values in a quiet stretch.",
    parameters={"step": Parameter(0.05, 1.0, "N", log=True, low=1e-3, high=0.5)},
    stage=READOUT,
    scatter=_scatter_quantisation,
    finish=lambda force, v: v["step"] * np.round(force / v["step"]),
    wrist=True,
)


# Samples taken at irregular times.

JITTERS = np.geomspace(5e-4, 0.03, 40)  # prior: s
# physics: residuals for each wrong time: it enters vx and vy, and each as the difference of two times, whose
# square is correlated by a quarter with those of two others
ALIKE = 3.0


def _scatter_clock_jitter(given: Any, residual: np.ndarray) -> Any:
    from simgap.gap.assemble import on_grid, rows_of

    rows, rate = rows_of(given), _clock_rates(given)[given.there]
    unit = (np.bincount(rows.cell, rate**2) / np.maximum(np.bincount(rows.cell), 1))[rows.cell]
    mine, square = unit > 0, np.square(given.nuisances.left(residual))
    variance = 1 + np.square(JITTERS)[:, None] * unit[mine]
    each = (square[mine] * (1 - 1 / variance) - np.log(variance)) / (2 * ALIKE)
    _, part = np.unique((rows.trial * len(rows.parts) + rows.part)[mine], return_inverse=True)
    nats = np.stack([np.bincount(part, one) for one in each])
    return on_grid("clock_jitter", nats, unit, JITTERS)


def _clock_rates(given: Any) -> np.ndarray:
    """Whitened change per second of clock error (T, N, C), whose mean over grouped samples counts."""
    world = given.frame.world
    step = np.median(np.diff(world.t, axis=1))
    speed = middle(tips(world)[1])
    rate = gradient(world.t, speed)
    out = np.zeros_like(given.weight)
    for k, c in enumerate((CHANNELS.index("vx"), CHANNELS.index("vy"))):
        # By the errors of the clock at three samples: the mean (1, 4, 1) / 6 of speeds read at wrong times
        # minus the central difference of positions read at them.
        of_speed, of_place = rate[..., k] / 6, speed[..., k] / (2 * step)
        before, after = (of_speed + of_place)[:, :-2], (of_speed - of_place)[:, 2:]
        out[:, 1:-1, c] = np.sqrt(before**2 + np.square(4 * of_speed[:, 1:-1]) + after**2)
    return out * given.weight / np.sqrt(np.array(given.frame.groups))[:, None, None]


CLOCK_JITTER = HandEffect(
    name="clock_jitter",
    says="true sample times = t + normal(0, sd)",
    shows="noise in proportion to the rate of change",
    mistaken_for=("noise",),
    called="samples that are not taken when their time stamps say",
    check="Log the acquisition clock together with the time stamps; look for samples stamped on arrival.",
    parameters={"sd": Parameter(0.004, 1.0, "s", log=True, low=1e-4, high=0.05)},
    stage=READOUT,
    sampled=lambda t, v, rng: t + rng.normal(0, v["sd"], t.size),
    scatter=_scatter_clock_jitter,
    wrist=True,
)
