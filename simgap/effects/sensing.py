"""Effects in how forces are read: zero errors, gains, crosstalk, turned sensors, delays, filters, steps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.effects.base import (
    FILTER,
    LATE,
    MIX,
    READOUT,
    SCALE,
    SMOOTH,
    Effect,
    Parameter,
    Performance,
    World,
    flat,
    gradient,
    per_channel,
    tips,
    with_force,
    with_mode,
)
from simgap.effects.filters import of_finger
from simgap.gap.frame import CHANNELS

# A constant offset of every force channel.


def _phrase_force_bias(means, rig):
    worst = max(means, key=lambda k: abs(means[k]))
    total = sum(abs(v) for v in means.values())
    lone = total > 0 and abs(means[worst]) > 0.8 * total
    return f"a zero error of force sensor {worst}" if lone else "zero errors of the force sensors"


FORCE_BIAS = Effect(
    name="force_bias",
    acts_on="sensing",
    says="recorded F = F + b, per finger and axis",
    shows="all subtasks alike, free motion too",
    mistaken_for=("weight", "fingertip_mass"),
    called="zero errors of the force sensors",
    check="Tare the force sensors in free air, record two seconds at rest, and look at what is left.",
    phrase=_phrase_force_bias,
    parameters=tuple(Parameter(c, "N", 0.1) for c in FORCE_CHANNELS),
    stage=READOUT,
    correct=lambda w, v, on: w._replace(force=w.force - per_channel(v, FORCE_CHANNELS)),
    admitted=lambda rig: ("force_bias", dict(zip(FORCE_CHANNELS, rig.systematic.force_bias, strict=True))),
    apply=lambda p, v, rng: with_force(p, flat(p) + [v[c] for c in FORCE_CHANNELS]),
)


# Force channels that drift from the start of every trial, evenly or the slower the longer it lasts.


def _since_force_drift(t, last, bend):
    """Seconds since the start; what warms up slows down.

    The bend is nothing at the start and as the last block is left: the mean slope stays as it is.
    """
    return t * (1 + bend * (1 - t / last))


def _correct_force_drift(world: World, values, on) -> World:
    last = jnp.asarray(world.events).max(axis=1, keepdims=True) - world.t[:, :1]
    since = _since_force_drift(world.t - world.t[:, :1], jnp.maximum(last, 1e-3), values["bend"])
    return world._replace(force=world.force - since[..., None] * per_channel(values, FORCE_CHANNELS))


def _apply_force_drift(performance: Performance, values, rng) -> Performance:
    t, last = performance.t - performance.t[0], float(performance.events.max() - performance.t[0])
    since = _since_force_drift(t, max(last, 1e-3), values.get("bend", 0.0))
    return with_force(performance, flat(performance) + since[:, None] * [values[c] for c in FORCE_CHANNELS])


FORCE_DRIFT = Effect(
    name="force_drift",
    acts_on="sensing",
    says="recorded F = F + c t, per finger and axis",
    shows="a ramp over the trial, free motion too",
    mistaken_for=("fingertip_creep", "force_bias"),
    called="force sensors whose zero drifts",
    check=(
        "Record a minute in free air after switching on; let amplifiers and gauges warm up before a session."
    ),
    parameters=(
        *(Parameter(c, "N/s", 0.015) for c in FORCE_CHANNELS),
        Parameter("bend", "1", 0.15, low=-0.6, high=0.6, hidden=True, shape=True),
    ),
    stage=READOUT,
    correct=_correct_force_drift,
    apply=_apply_force_drift,
    played={},  # of a recording as a whole
)


# Force channels that read too much or too little, in proportion: all alike, a finger's, or each its own.

FINGERS = ("finger1", "finger2")
EVERY = ("gain", *FINGERS, *FORCE_CHANNELS)
OWN = {c: ("gain", f"finger{c[-1]}", c) for c in FORCE_CHANNELS}  # what gains make up that of a channel


def _gains(values, xp):
    return xp.stack([sum((values.get(n, 0.0) for n in OWN[c]), xp.zeros(())) for c in FORCE_CHANNELS])


def _correct_force_gain(world: World, values, on) -> World:
    factor = 1 + _gains(values, jnp)
    # Recorded noise over that of corrected forces, of a sum (or difference) of both fingers' channels.
    one, two = factor[:2], factor[2:]
    loud = jnp.sqrt(2 / (one**-2 + two**-2))
    return world._replace(
        force=world.force / factor[None, None, :],
        loudness=world.loudness * jnp.concatenate([loud, loud])[None, None, :],
    )


def _phrase_force_gain(means, rig):
    which = {k: v for k, v in means.items() if k != "gain"}
    if which:
        worst = max(which, key=lambda k: abs(which[k]))
        where = f"finger {worst[-1]}" if worst.startswith("finger") else worst
        return f"a force sensor that reads too {'high' if which[worst] > 0 else 'low'} ({where})"
    return f"force sensors that read too {'high' if means.get('gain', 0.0) > 0 else 'low'}"


FORCE_GAIN = Effect(
    name="force_gain",
    acts_on="sensing",
    says="recorded F = (1 + gain) F, common to all channels, of a finger, or of each channel",
    shows="every load, in proportion",
    mistaken_for=("weight", "fingertip_compliance"),
    called="force sensors that read too high or too low",
    check="Hang a known weight from each fingertip and compare; check the calibration factors in the driver.",
    phrase=_phrase_force_gain,
    parameters=tuple(Parameter(n, "1", 0.1, low=-0.5, high=0.5) for n in EVERY),
    forms=(("gain",), FINGERS, FORCE_CHANNELS),
    admitted=lambda rig: ("force_gain/2", dict(zip(FORCE_CHANNELS, rig.systematic.force_gain, strict=True))),
    stage=SCALE,
    correct=_correct_force_gain,
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + _gains(v, np))),
    wrist=True,
)


# Each force axis picks up a share of the other one.


def mixed(force, matrix, xp):
    """Forces (..., 4) with both fingers' (x, y) pairs multiplied by a 2 x 2 matrix of scalars."""
    (a, b), (c, d) = matrix
    fx1, fy1, fx2, fy2 = (force[..., k] for k in range(4))
    return xp.stack([a * fx1 + b * fy1, c * fx1 + d * fy1, a * fx2 + b * fy2, c * fx2 + d * fy2], -1)


def _correct_force_crosstalk(world: World, values, on) -> World:
    e, h = values["fy_from_fx"], values["fx_from_fy"]
    scale = 1 / (1 - e * h)
    force = mixed(world.force, ((scale, -h * scale), (-e * scale, scale)), jnp)
    # Of net fx, net fy, grip and shear: each has the noise of both axes.
    quiet = jnp.stack([1 / jnp.sqrt(1 + h**2), 1 / jnp.sqrt(1 + e**2)] * 2) / scale
    return world._replace(force=force, loudness=world.loudness * quiet[None, None, :])


def _apply_force_crosstalk(performance: Performance, values, rng) -> Performance:
    matrix = ((1.0, values["fx_from_fy"]), (values["fy_from_fx"], 1.0))
    return with_force(performance, mixed(flat(performance), matrix, np))


FORCE_CROSSTALK = Effect(
    name="force_crosstalk",
    acts_on="sensing",
    says="recorded fy = fy + e fx and fx = fx + h fy",
    shows="shear and net force follow the grip",
    mistaken_for=("sensor_rotation",),
    called="cross-talk between the axes of a force sensor",
    check=(
        "Press straight against a wall with one finger and see whether the other axis moves; redo the "
        "calibration matrix."
    ),
    parameters=(
        Parameter("fy_from_fx", "1", 0.06, low=-0.2, high=0.2),
        Parameter("fx_from_fy", "1", 0.06, low=-0.2, high=0.2),
    ),
    stage=MIX,
    correct=_correct_force_crosstalk,
    apply=_apply_force_crosstalk,
)


# Force sensors mounted with a turn.


def _turned(force, angles, xp):
    out = []
    for finger, angle in enumerate(angles):
        fx, fy = force[..., 2 * finger], force[..., 2 * finger + 1]
        out += [xp.cos(angle) * fx - xp.sin(angle) * fy, xp.sin(angle) * fx + xp.cos(angle) * fy]
    return xp.stack(out, -1)


def _correct_sensor_rotation(world: World, values, on) -> World:
    return world._replace(force=_turned(world.force, (-values["angle1"], -values["angle2"]), jnp))


def _apply_sensor_rotation(performance: Performance, values, rng) -> Performance:
    return with_force(performance, _turned(flat(performance), (values["angle1"], values["angle2"]), np))


SENSOR_ROTATION = Effect(
    name="sensor_rotation",
    acts_on="sensing",
    says="recorded F = R(angle) F, per finger",
    shows="both axes, antisymmetric",
    mistaken_for=("force_crosstalk", "table_tilt"),
    called="a force sensor mounted at an angle",
    check="Check the mounting screws and the stated sensor frame: pull along one axis and read the other.",
    parameters=tuple(Parameter(n, "rad", 0.06, low=-0.6, high=0.6) for n in ("angle1", "angle2")),
    stage=MIX,
    correct=_correct_sensor_rotation,
    apply=_apply_sensor_rotation,
)


# Forces that arrive late by a constant delay: of all channels, or of one finger's sensor.

FORCE_LAG_STARTS = (0.015, 0.04, 0.07, 0.1, 0.14, 0.19, 0.25, 0.32)  # numerics: s; where searches start


def _delays(values, xp):
    one, two = (xp.asarray(values.get("delay", 0.0) + values.get(n, 0.0)) for n in ("finger1", "finger2"))
    return xp.stack([one, one, two, two])


def _apply_force_lag(performance: Performance, values, rng) -> Performance:
    t, late = performance.t, _delays(values, np)
    force = flat(performance).T
    return with_force(
        performance, np.stack([np.interp(t - d, t, f) for d, f in zip(late, force, strict=True)], 1)
    )


FORCE_LAG = Effect(
    name="force_lag",
    acts_on="sensing",
    says="recorded F(t) = F(t - delay)",
    shows="every contact change, late",
    mistaken_for=("force_lowpass",),
    called="force readings that come late",
    check=(
        "Tap a fingertip sharply and compare the time stamps of force and motion; look for a buffer in "
        "the force channel."
    ),
    phrase=of_finger("force readings that come late"),
    parameters=(
        Parameter("delay", "s", 0.1, starts=FORCE_LAG_STARTS, low=0.0, high=0.4),
        Parameter("finger1", "s", 0.1, starts=FORCE_LAG_STARTS, low=0.0, high=0.4),
        Parameter("finger2", "s", 0.1, starts=FORCE_LAG_STARTS, low=0.0, high=0.4),
    ),
    stage=FILTER,
    correct=lambda w, v, on: with_mode(w, LATE, on)._replace(delay=w.delay + _delays(v, jnp)),
    forms=(("delay",), ("finger1",), ("finger2",)),
    apply=_apply_force_lag,
    wrist=True,
    played={"delay": 0.15},
)


# Forces that pass a first-order low-pass.

FORCE_LOWPASS_STARTS = (0.02, 0.06, 0.12, 0.2)  # numerics: s; where searches start


def _times_force_lowpass(values, xp):
    common = values.get("time_constant", 0.0)
    one, two = (xp.asarray(common + values.get(n, 0.0)) for n in ("finger1", "finger2"))
    return xp.stack([one, one, two, two])


def _apply_force_lowpass(performance: Performance, values, rng) -> Performance:
    from scipy.signal import lfilter  # slow to import

    step = float(np.median(np.diff(performance.t)))
    out = flat(performance).copy()
    for c, time in enumerate(_times_force_lowpass(values, np)):
        keep = np.exp(-step / max(time, 1e-6))
        out[:, c] = lfilter([1 - keep], [1, -keep], out[:, c])
    return with_force(performance, out)


FORCE_LOWPASS = Effect(
    name="force_lowpass",
    acts_on="sensing",
    says="time_constant dF_rec/dt + F_rec = F",
    shows="rounded contact changes",
    mistaken_for=("force_lag",),
    called="a slow filter in the force channel",
    check=(
        "Look up the filter setting of the force amplifier or driver; tap a fingertip and see how fast "
        "the reading rises."
    ),
    phrase=of_finger("a slow filter in the force channel"),
    parameters=(
        Parameter("time_constant", "s", 0.08, starts=FORCE_LOWPASS_STARTS, low=0.0, high=0.5),
        Parameter("finger1", "s", 0.08, starts=FORCE_LOWPASS_STARTS, low=0.0, high=0.5),
        Parameter("finger2", "s", 0.08, starts=FORCE_LOWPASS_STARTS, low=0.0, high=0.5),
    ),
    forms=(("time_constant",), ("finger1",), ("finger2",)),
    stage=FILTER,
    correct=lambda w, v, on: with_mode(w, SMOOTH, on)._replace(
        smoothing=w.smoothing + _times_force_lowpass(v, jnp)
    ),
    apply=_apply_force_lowpass,
    wrist=True,
    played={"time_constant": 0.15},
)


# Forces rounded to a step.

REPEATED = 0.5  # chosen: share of repeated values that only a lattice has
WRITTEN = 1e-5  # prior: N; how finely forces are written that were not rounded before


def _scatter_quantisation(given, residual: np.ndarray):
    """Whether forces repeat the same values: levels of a lattice through zero.

    Written to 1e-5 N, as files are, one sample in ten repeats another's value by chance; on a lattice
    most do. The step is the usual gap between neighbouring levels, refined on all samples. Values that
    were not rounded would all fall on levels so far apart with a chance of WRITTEN / step each.
    """
    from simgap.gap.assemble import Scatter, rounded_variance

    read = np.concatenate([force.ravel() for force in given.frame.forces])
    values = read[np.isfinite(read)]
    levels = np.unique(np.round(np.abs(values), 6))
    if 1 - levels.size / values.size < REPEATED or levels.size < 4:
        return None
    step = float(np.median(np.diff(levels)))
    for reach in (4, 16, 64, 256):  # farther levels tell the step ever more closely
        count = np.round(values / step)
        near = (np.abs(count) <= reach) & (count != 0)
        if near.any():
            step = float(values[near] @ count[near] / (count[near] @ count[near]))
    off = np.abs(values / step - np.round(values / step))
    if np.mean(off < 0.1) < 0.9:
        return None
    known = float(4 * sum(given.frame.lengths) * np.log(step / WRITTEN))
    return Scatter("quantisation", step, 1e-3, rounded_variance(given, step), known)


QUANTISATION = Effect(
    name="quantisation",
    acts_on="sensing",
    says="recorded F = step * round(F / step)",
    shows="plateaus; repeated values",
    mistaken_for=("noise",),
    called="coarse steps in the force readings",
    check="Check the range and resolution of the converter: list the distinct values in a quiet stretch.",
    parameters=(Parameter("step", "N", 1.0, neutral=0.05, log=True, low=1e-3, high=0.5),),
    stage=READOUT,
    scatter=_scatter_quantisation,
    finish=lambda force, v: v["step"] * np.round(force / v["step"]),
    wrist=True,
)


# Samples taken at irregular times.

JITTERS = np.geomspace(5e-4, 0.03, 40)  # prior: s


def _scatter_clock_jitter(given, residual: np.ndarray):
    from simgap.gap.assemble import on_grid, rows_of

    rows, rate = rows_of(given), _rates_clock_jitter(given)[given.whitening.weight > 0]
    size = np.bincount(rows.cell, rate**2) / np.maximum(np.bincount(rows.cell), 1)
    part = rows.trial * len(rows.parts) + rows.part
    return on_grid("clock_jitter", residual**2, size[rows.cell], JITTERS, part)


def _rates_clock_jitter(given) -> np.ndarray:
    """Whitened change per second of clock error (T, N, C): only where motion is fast."""
    w = given.frame.world
    world = jax.tree.map(jnp.asarray, w)
    _, velocity = tips(world)
    step = np.median(np.diff(w.t, axis=1))
    mean_v = np.asarray((velocity[..., :2] + velocity[..., 2:]) / 2)
    out = np.zeros_like(given.whitening.weight)
    # Central differences of positions read at wrong times: v times the times' difference over 2 steps; and
    # the mean (1, 4, 1) / 6 of speeds that were read at them.
    rate = np.asarray(gradient(world.t, jnp.asarray(mean_v)))
    for k, c in enumerate(("vx", "vy")):
        out[..., CHANNELS.index(c)] = np.hypot(mean_v[..., k] / step, rate[..., k]) / np.sqrt(2)
    return out * given.whitening.weight


CLOCK_JITTER = Effect(
    name="clock_jitter",
    acts_on="sensing",
    says="true sample times = t + normal(0, sd)",
    shows="noise in proportion to the rate of change",
    mistaken_for=("noise",),
    called="samples that are not taken when their time stamps say",
    check="Log the acquisition clock beside the time stamps; look for samples stamped on arrival.",
    parameters=(Parameter("sd", "s", 1.0, neutral=0.004, log=True, low=1e-4, high=0.05),),
    stage=READOUT,
    sampled=lambda t, v, rng: t + rng.normal(0, v["sd"], t.size),
    scatter=_scatter_clock_jitter,
    wrist=True,
)
