"""Decoys: fitted as alternatives to the catalogue, never named; where one explains best it is unknown."""

from __future__ import annotations

import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.channels import at_rest
from simgap.channels import lowpass as passed
from simgap.effect import Parameter
from simgap.effects.base import (
    FILTER,
    HAND,
    KINEMATICS,
    MIX,
    SCALE,
    HandEffect,
    Motion,
    Performance,
    World,
    flat,
    loading,
    mixing,
    swung,
    with_force,
)
from simgap.effects.filters import lowpass
from simgap.effects.geometry import BASE, JOINTS, LINKS, apply_hand, correct_hand
from simgap.effects.loads import MIDDLE

# Force channels that remember: the reading lags its load by parts of many lengths.

TIMES = (0.1, 0.4, 1.6, 6.4)  # prior: s
LONG = 64  # numerics: samples after which a click is forgotten but for little
SHARES = tuple(f"share_{time:g}" for time in TIMES)


def _remembered(force, values, step):
    """What the readings (T, N, C) owe to loads of before, to first order: readings stand for the loads."""
    return sum(
        values[name] * (lowpass(force, time, step) - force) for name, time in zip(SHARES, TIMES, strict=True)
    )


def _correct_force_memory(world: World, values, on) -> World:
    force, step = world.force, np.median(world.t[:, 1:] - world.t[:, :-1])
    # A correction that smooths would have less noise than was recorded.
    click = np.zeros((1, LONG, 1))
    click[0, 1, 0] = 1.0
    noise = np.sqrt(np.square(click - _remembered(click, values, step)).sum())
    return world._replace(force=force - _remembered(force, values, step), loudness=world.loudness / noise)


def _apply_force_memory(p: Performance, values, rng) -> Performance:
    def late(t, force, theta):
        return sum(
            values[n] * (passed(t, force, time) - force) for n, time in zip(SHARES, TIMES, strict=True)
        )

    return with_force(p, flat(p) + np.stack([at_rest(late, p.t, f, {}) for f in flat(p).T], 1))


FORCE_MEMORY = HandEffect(
    name="force_memory",
    says="recorded F = F + shares of F smoothed over 0.1, 0.4, 1.6 and 6.4 s",
    shows="after every change of load, for long",
    mistaken_for=("force_drift", "force_lowpass", "fingertip_creep"),
    parameters={n: Parameter(0.0, 0.1, low=-0.5, high=0.5) for n in SHARES},
    stage=FILTER,
    correct=_correct_force_memory,
    apply=_apply_force_memory,
    wrist=True,
)


# Every force channel picks up a share of every other one, of the other finger's sensor too.

MIXED = tuple(f"{to}_from_{of}" for to in FORCE_CHANNELS for of in FORCE_CHANNELS)

FORCE_MIXING = mixing(
    lambda v: np.eye(4) + np.array([v[n] for n in MIXED]).reshape(4, 4),
    inverse=True,
    name="force_mixing",
    says="F = (1 + M) recorded F, M any matrix of both fingers' four channels",
    shows="every load, in every channel",
    mistaken_for=("force_crosstalk", "sensor_rotation"),
    parameters={n: Parameter(0.0, 0.06, low=-0.3, high=0.3) for n in MIXED},
    stage=MIX,
)


# A force sensor whose gain changes with its load (non-linearity, on a data sheet), or in the course of a
# trial (thermal span shift).


def _correct_force_nonlinearity(world: World, values, on) -> World:
    size, gain, curve = np.abs(world.force), 1 + values["gain"], values["curve"]
    root = np.sqrt(np.maximum(gain**2 + 4 * curve * size, 0.05))
    louder = (root[..., :2] + root[..., 2:]) / 2  # the slope of the reading is that root
    return world._replace(
        force=np.sign(world.force) * 2 * size / (gain + root),
        loudness=world.loudness * np.concatenate([louder, louder], -1),
    )


def _correct_gain_drift(world: World, values, on) -> World:
    gain = np.maximum(1 + values["gain"] + values["rate"] * world.t, 0.1)[..., None]
    return world._replace(force=world.force / gain, loudness=world.loudness * gain)


GAIN = Parameter(0.0, 0.1, low=-0.5, high=0.5)

FORCE_NONLINEARITY = HandEffect(
    name="force_nonlinearity",
    says="recorded F = (1 + gain) F + curve F |F|, common to all channels",
    shows="every load, the more the larger it is",
    mistaken_for=("force_gain", "fingertip_compliance"),
    parameters={"curve": Parameter(0.0, 0.1, "1/N", low=-0.2, high=0.5), "gain": GAIN},
    stage=SCALE,
    correct=_correct_force_nonlinearity,
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + v["gain"] + v["curve"] * abs(flat(p)))),
    wrist=True,
)

GAIN_DRIFT = HandEffect(
    name="gain_drift",
    says="recorded F = (1 + gain + rate t) F, common to all channels",
    shows="every load, the more the later",
    mistaken_for=("force_gain", "fingertip_creep"),
    parameters={"rate": Parameter(0.0, 0.01, "1/s", low=-0.05, high=0.05), "gain": GAIN},
    stage=SCALE,
    correct=_correct_gain_drift,
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + v["gain"] + v["rate"] * p.t)[:, None]),
    wrist=True,
)


HAND_GEOMETRY = HandEffect(
    name="hand_geometry",
    acts_on="kinematics",
    says="offsets of every joint, lengths of every link, and the second finger's base, all off",
    shows="positions, widths, heights, by pose",
    mistaken_for=("joint_offset", "link_length"),
    parameters={q: Parameter(0.0, 0.012, "rad") for q in JOINTS}
    | {link: Parameter(0.0, 0.02, low=-0.2, high=0.2) for link in LINKS}
    | {axis: Parameter(0.0, 1e-3, "m") for axis in BASE},
    stage=KINEMATICS,
    correct=correct_hand,
    apply=apply_hand,
)


# A force on both fingers that is any linear function of where they are and how they move.

USUAL = (0.03, 0.1, 0.5)  # prior: m, m/s, m/s^2: what they work with
MOTIONS = ("x", "y", "vx", "vy", "ax", "ay")
LINEAR = tuple(f"{axis}_of_{motion}" for axis in ("fx", "fy") for motion in MOTIONS)


def _of_motion(m: Motion, values):
    steady, matrix = (np.array([values[n] for n in s]) for s in (FORCE_CHANNELS, LINEAR))
    parts = (m.position - MIDDLE * 2, m.velocity, m.acceleration)
    parts = [part / usual for part, usual in zip(parts, USUAL, strict=True)]
    fingers = [np.concatenate([p[..., k : k + 2] for p in parts], -1) for k in (0, 2)]
    return np.concatenate([f @ matrix.reshape(2, 6).T for f in fingers], -1) + steady


MOTION_LOAD = loading(
    _of_motion,
    name="motion_load",
    acts_on="dynamics",
    says="a force on both fingers, linear in position, velocity and acceleration",
    shows="free motion too",
    mistaken_for=("cable_force", "viscous_drag", "fingertip_mass", "force_bias"),
    parameters={n: Parameter(0.0, 0.05, "N") for n in (*FORCE_CHANNELS, *LINEAR)},
    stage=HAND,
)


# Fingertips that give way sideways when they are pressed: their compliance has no axis along the grip.

GIVES = ("give1", "give2")


def _correct_skewed_pads(world: World, values, on) -> World:
    rise = np.array([values[n] for n in GIVES]) * np.abs(world.force[..., 0::2])
    along_x, along_y = swung(world)
    inner, outer = along_x[..., 0::2], along_x[..., 1::2]
    turn = rise / (inner * along_y[..., 1::2] - outer * along_y[..., 0::2])
    joints = np.stack([-outer * turn, inner * turn], -1).reshape(world.joints.shape)
    place = np.stack([np.zeros_like(rise), rise], -1).reshape(world.joints.shape)
    return world._replace(joints=world.joints - np.where(world.jointed > 0.5, joints, place))


def _apply_skewed_pads(p: Performance, values, rng) -> Performance:
    rise = np.abs(p.force[:, :, 0]) * [values[n] for n in GIVES]
    up = np.array([0.0, 1.0])
    return p._replace(
        position=p.position + rise[..., None] * up,
        velocity=p.velocity + np.gradient(rise, p.t, axis=0)[..., None] * up,
    )


SKEWED_PADS = HandEffect(
    name="skewed_pads",
    acts_on="contact",
    says="fingertips rise by give times the grip force, each by its own",
    shows="offset and y while held, in proportion to the grip",
    mistaken_for=("force_crosstalk", "fingertip_compliance"),
    parameters={n: Parameter(0.0, 1e-4, "m/N") for n in GIVES},
    stage=KINEMATICS,
    correct=_correct_skewed_pads,
    apply=_apply_skewed_pads,
)
