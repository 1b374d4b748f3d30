"""Decoys: fitted to be told from the catalogue, and never named; where one explains best it is unknown."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.effects.base import (
    FILTER,
    HAND,
    KINEMATICS,
    MIX,
    SCALE,
    Effect,
    Parameter,
    Performance,
    World,
    flat,
    gradient,
    per_channel,
    swung,
    tips,
    with_force,
    with_load,
)
from simgap.effects.filters import lowpass
from simgap.effects.geometry import JOINTS, moved_joints
from simgap.effects.loads import MIDDLE

# Force channels that remember: the reading lags its load by parts of many lengths.

TIMES = (0.1, 0.4, 1.6, 6.4)  # prior: s
LONG = 64  # numerics: samples after which a click is forgotten but for little
FORCE_MEMORY_NAMES = tuple(f"share_{time:g}" for time in TIMES)


def _remembered(force, values, step):
    """What the readings (T, N, C) owe to loads of before, to first order: readings stand for the loads."""
    return sum(
        values[name] * (lowpass(force, jnp.asarray(time), step) - force)
        for name, time in zip(FORCE_MEMORY_NAMES, TIMES, strict=True)
    )


def _correct_force_memory(world: World, values, on) -> World:
    force = jnp.asarray(world.force)
    step = jnp.median(world.t[:, 1:] - world.t[:, :-1])
    # A correction that smooths would have less noise than was recorded.
    click = jnp.zeros((1, LONG, 1)).at[0, 1, 0].set(1.0)
    noise = jnp.sqrt(jnp.square(click - _remembered(click, values, step)).sum())
    return world._replace(force=force - _remembered(force, values, step), loudness=world.loudness / noise)


def _apply_force_memory(performance: Performance, values, rng) -> Performance:
    from scipy.signal import lfilter  # slow to import

    force, step = flat(performance), float(np.median(np.diff(performance.t)))
    late = np.zeros_like(force)
    for name, time in zip(FORCE_MEMORY_NAMES, TIMES, strict=True):
        keep = np.exp(-step / time)
        late += values[name] * (lfilter([1 - keep], [1, -keep], force - force[0], axis=0) + force[0] - force)
    return with_force(performance, force + late)


FORCE_MEMORY = Effect(
    name="force_memory",
    acts_on="sensing",
    says="recorded F = F + shares of F smoothed over 0.1, 0.4, 1.6 and 6.4 s",
    shows="after every change of load, for long",
    mistaken_for=("force_drift", "force_lowpass", "fingertip_creep"),
    parameters=tuple(Parameter(n, "1", 0.1, low=-0.5, high=0.5) for n in FORCE_MEMORY_NAMES),
    stage=FILTER,
    correct=_correct_force_memory,
    apply=_apply_force_memory,
    wrist=True,
)


# Every force channel picks up a share of every other one, of the other finger's sensor too.

FORCE_MIXING_NAMES = tuple(f"{to}_from_{of}" for to in FORCE_CHANNELS for of in FORCE_CHANNELS)
# physics: net, grip, shear
NET = np.array([[1.0, 0, 1, 0], [0, 1, 0, 1], [0.5, 0, -0.5, 0], [0, 0.5, 0, -0.5]])


def _correct_force_mixing(world: World, values, on) -> World:
    whole = jnp.eye(4) + jnp.stack([jnp.asarray(values[n], float) for n in FORCE_MIXING_NAMES]).reshape(4, 4)
    noise = jnp.sqrt(jnp.square(NET @ whole).sum(1) / jnp.square(NET).sum(1))
    return world._replace(force=world.force @ whole.T, loudness=world.loudness / noise[None, None, :])


def _apply_force_mixing(performance: Performance, values, rng) -> Performance:
    whole = np.eye(4) + np.array([values[n] for n in FORCE_MIXING_NAMES]).reshape(4, 4)
    return with_force(performance, flat(performance) @ np.linalg.inv(whole).T)


FORCE_MIXING = Effect(
    name="force_mixing",
    acts_on="sensing",
    says="F = (1 + M) recorded F, M any matrix of both fingers' four channels",
    shows="every load, in every channel",
    mistaken_for=("force_crosstalk", "sensor_rotation"),
    parameters=tuple(Parameter(n, "1", 0.06, low=-0.3, high=0.3) for n in FORCE_MIXING_NAMES),
    stage=MIX,
    correct=_correct_force_mixing,
    apply=_apply_force_mixing,
)


# A force sensor whose gain changes with its load: what a data sheet calls non-linearity.


def _correct_force_nonlinearity(world: World, values, on) -> World:
    size, gain, curve = jnp.abs(world.force), 1 + values["gain"], values["curve"]
    root = jnp.sqrt(jnp.maximum(gain**2 + 4 * curve * size, 0.05))
    louder = (root[..., :2] + root[..., 2:]) / 2  # the slope of the reading is that root
    return world._replace(
        force=jnp.sign(world.force) * 2 * size / (gain + root),
        loudness=world.loudness * jnp.concatenate([louder, louder], -1),
    )


FORCE_NONLINEARITY = Effect(
    name="force_nonlinearity",
    acts_on="sensing",
    says="recorded F = (1 + gain) F + curve F |F|, common to all channels",
    shows="every load, the more the larger it is",
    mistaken_for=("force_gain", "fingertip_compliance"),
    parameters=(
        Parameter("curve", "1/N", 0.1, low=-0.2, high=0.5),
        Parameter("gain", "1", 0.1, low=-0.5, high=0.5),
    ),
    stage=SCALE,
    correct=_correct_force_nonlinearity,
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + v["gain"] + v["curve"] * abs(flat(p)))),
    wrist=True,
)


# Force channels whose gain changes in the course of a trial: what a data sheet calls thermal span shift.


def _correct_gain_drift(world: World, values, on) -> World:
    gain = 1 + values["gain"] + values["rate"] * world.t
    gain = jnp.maximum(gain, 0.1)[..., None]
    return world._replace(force=world.force / gain, loudness=world.loudness * gain)


GAIN_DRIFT = Effect(
    name="gain_drift",
    acts_on="sensing",
    says="recorded F = (1 + gain + rate t) F, common to all channels",
    shows="every load, the more the later",
    mistaken_for=("force_gain", "fingertip_creep"),
    parameters=(
        Parameter("rate", "1/s", 0.01, low=-0.05, high=0.05),
        Parameter("gain", "1", 0.1, low=-0.5, high=0.5),
    ),
    stage=SCALE,
    correct=_correct_gain_drift,
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + v["gain"] + v["rate"] * p.t)[:, None]),
    wrist=True,
)


# A hand that is not as its drawing says: any angles, lengths and places of its links.

LINKS = ("link11", "link12", "link21", "link22")
BASE = ("base_x", "base_y")


def _correct_hand_geometry(world: World, values, on) -> World:
    scales = jnp.stack([jnp.asarray(values[n], float) for n in LINKS])
    apart = jnp.stack([jnp.asarray(values[n], float) for n in BASE])
    return world._replace(
        joints=world.joints - per_channel(values, JOINTS) * world.jointed,
        link=world.link * (1 + scales),
        base=world.base + jnp.concatenate([jnp.zeros(2), apart]),
    )


HAND_GEOMETRY = Effect(
    name="hand_geometry",
    acts_on="kinematics",
    says="offsets of every joint, lengths of every link, and the second finger's base, all off",
    shows="positions, widths, heights, by pose",
    mistaken_for=("joint_offset", "link_length"),
    parameters=(
        *(Parameter(q, "rad", 0.012) for q in JOINTS),
        *(Parameter(link, "1", 0.02, low=-0.2, high=0.2) for link in LINKS),
        *(Parameter(axis, "m", 1e-3) for axis in BASE),
    ),
    stage=KINEMATICS,
    correct=_correct_hand_geometry,
    apply=lambda p, v, rng: moved_joints(
        p, lambda q, dq: (q + [v[n] for n in JOINTS], dq), [v[n] for n in LINKS], [v[n] for n in BASE]
    ),
)


# A force on both fingers that is any linear function of where they are and how they move.

USUAL = (0.03, 0.1, 0.5)  # prior: m, m/s, m/s^2: what they work with
MOTIONS = ("x", "y", "vx", "vy", "ax", "ay")
MOTION_LOAD_NAMES = tuple(f"{axis}_of_{motion}" for axis in ("fx", "fy") for motion in MOTIONS)


def _load_motion_load(position, velocity, acceleration, values, xp):
    """Forces (..., 4) [N] of motions (..., 4)."""
    steady = xp.stack([xp.asarray(values[n], float) for n in FORCE_CHANNELS])
    matrix = xp.stack([xp.asarray(values[n], float) for n in MOTION_LOAD_NAMES]).reshape(2, 6)
    out = []
    for finger in (0, 1):
        mine = slice(2 * finger, 2 * finger + 2)
        place = xp.stack([position[..., 2 * finger + k] - MIDDLE[k] for k in (0, 1)], -1)
        parts = (place, velocity[..., mine], acceleration[..., mine])
        motion = xp.concatenate([part / usual for part, usual in zip(parts, USUAL, strict=True)], -1)
        out.append(motion @ matrix.T)
    out = xp.concatenate(out, -1)
    return out + xp.broadcast_to(steady, out.shape)


def _correct_motion_load(world: World, values, on) -> World:
    position, velocity = tips(world)
    return with_load(world, _load_motion_load(position, velocity, gradient(world.t, velocity), values, jnp))


def _apply_motion_load(performance: Performance, values, rng) -> Performance:
    acceleration = np.gradient(performance.velocity, performance.t, axis=0)
    position, velocity = performance.position.reshape(-1, 4), performance.velocity.reshape(-1, 4)
    load = _load_motion_load(position, velocity, acceleration.reshape(-1, 4), values, np)
    return with_force(performance, flat(performance) + load)


MOTION_LOAD = Effect(
    name="motion_load",
    acts_on="dynamics",
    says="a force on both fingers, linear in position, velocity and acceleration",
    shows="free motion too",
    mistaken_for=("cable_force", "viscous_drag", "fingertip_mass", "force_bias"),
    parameters=tuple(Parameter(n, "N", 0.05) for n in (*FORCE_CHANNELS, *MOTION_LOAD_NAMES)),
    stage=HAND,
    correct=_correct_motion_load,
    apply=_apply_motion_load,
)


# Fingertips that give way sideways when they are pressed: their compliance has no axis along the grip.

GIVES = ("give1", "give2")


def _correct_skewed_pads(world: World, values, on) -> World:
    rise = per_channel(values, GIVES) * jnp.abs(world.force[..., 0::2])
    along_x, along_y = swung(world)
    inner, outer = along_x[..., 0::2], along_x[..., 1::2]
    turn = rise / (inner * along_y[..., 1::2] - outer * along_y[..., 0::2])
    joints = jnp.stack([-outer * turn, inner * turn], -1).reshape(world.joints.shape)
    place = jnp.stack([jnp.zeros_like(rise), rise], -1).reshape(world.joints.shape)
    return world._replace(joints=world.joints - jnp.where(world.jointed > 0.5, joints, place))


def _apply_skewed_pads(performance: Performance, values, rng) -> Performance:
    rise = np.abs(performance.force[:, :, 0]) * [values[n] for n in GIVES]
    rate = np.gradient(rise, performance.t, axis=0)
    position, velocity = performance.position.copy(), performance.velocity.copy()
    position[:, :, 1] += rise
    velocity[:, :, 1] += rate
    return performance._replace(position=position, velocity=velocity)


SKEWED_PADS = Effect(
    name="skewed_pads",
    acts_on="contact",
    says="fingertips rise by give times the grip force, each by its own",
    shows="offset and y while held, in proportion to the grip",
    mistaken_for=("force_crosstalk", "fingertip_compliance"),
    parameters=tuple(Parameter(n, "m/N", 1e-4) for n in GIVES),
    stage=KINEMATICS,
    correct=_correct_skewed_pads,
    apply=_apply_skewed_pads,
)
