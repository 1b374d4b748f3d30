"""Effects of what moves or pulls: fingertips' mass, drag, a cable, a structure that vibrates."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.effects.base import (
    HAND,
    READOUT,
    RINGING,
    Effect,
    Parameter,
    Performance,
    World,
    flat,
    gradient,
    tips,
    with_force,
    with_load,
    with_mode,
)

# Mass of a fingertip outboard of its force sensor.


def _correct_fingertip_mass(world: World, values, on) -> World:
    _, velocity = tips(world)
    up = jnp.stack([0.0 * world.gravity, world.gravity] * 2)[None, None, :]
    return with_load(world, values["mass"] * (gradient(world.t, velocity) + up))


def _apply_fingertip_mass(performance: Performance, values, rng) -> Performance:
    a = np.gradient(performance.velocity, performance.t, axis=0).reshape(-1, 4)
    return with_force(
        performance, flat(performance) + values["mass"] * (a + [0, performance.rig.gravity] * 2)
    )


FINGERTIP_MASS = Effect(
    name="fingertip_mass",
    acts_on="dynamics",
    says="recorded F = F + mass (a + g up), outboard of the sensor",
    shows="constant and inertial, free motion too",
    mistaken_for=("force_bias",),
    called="mass beyond the force sensor that the model lacks",
    check=(
        "Weigh what is mounted in front of the sensor, or hold the finger still at two heights and in two"
        " directions."
    ),
    parameters=(Parameter("mass", "kg", 0.012, low=0.0, high=0.1),),
    stage=HAND,
    correct=_correct_fingertip_mass,
    apply=_apply_fingertip_mass,
)


# A drag on the fingers in proportion to their velocity.


def _correct_viscous_drag(world: World, values, on) -> World:
    _, velocity = tips(world)
    return with_load(world, values["coefficient"] * velocity)


def _apply_viscous_drag(performance: Performance, values, rng) -> Performance:
    return with_force(
        performance, flat(performance) + values["coefficient"] * performance.velocity.reshape(-1, 4)
    )


VISCOUS_DRAG = Effect(
    name="viscous_drag",
    acts_on="dynamics",
    says="recorded F = F + coefficient v on each finger",
    shows="free motion too, by velocity",
    mistaken_for=("force_lag",),
    called="drag on the fingers as they move",
    check=(
        "Move the open hand back and forth at two speeds and watch the forces; look at bearings and sleeves."
    ),
    parameters=(Parameter("coefficient", "N s/m", 0.6),),
    stage=HAND,
    correct=_correct_viscous_drag,
    apply=_apply_viscous_drag,
)


# A cable that pulls on the fingers like a spring anchored somewhere.

MIDDLE = (0.13, 0.02)  # prior: m; about where the fingers work


def _anchor(values, xp):
    """Anchor (4,) for x1, y1, x2, y2; the force at MIDDLE is what is fitted."""
    return xp.stack([xp.asarray(values["at_x"], float), xp.asarray(values["at_y"], float)] * 2)


def _correct_cable_force(world: World, values, on) -> World:
    position, _ = tips(world)
    offset = position - jnp.asarray(MIDDLE * 2)[None, None, :]
    return with_load(world, values["stiffness"] * offset + _anchor(values, jnp)[None, None, :])


def _apply_cable_force(performance: Performance, values, rng) -> Performance:
    position = performance.position.reshape(-1, 4)
    pull = values["stiffness"] * (position - np.array([values["x0"], values["y0"]] * 2))
    return with_force(performance, flat(performance) + pull)


def _report_cable_force(draws, rig):
    k = draws["stiffness"]
    k = np.where(np.abs(k) < 1e-3, 1e-3, k)
    return {
        "stiffness": (draws["stiffness"], "N/m"),
        "x0": (MIDDLE[0] - draws["at_x"] / k, "m"),
        "y0": (MIDDLE[1] - draws["at_y"] / k, "m"),
    }


CABLE_FORCE = Effect(
    name="cable_force",
    acts_on="dynamics",
    says="recorded F = F + stiffness (p - p0) on each finger",
    shows="free motion too, by position",
    mistaken_for=("force_bias",),
    called="a cable that pulls at the fingers",
    check="Move the open hand slowly through the workspace and watch the forces; tie the cables elsewhere.",
    parameters=(
        Parameter("stiffness", "N/m", 2.0),
        Parameter("at_x", "N", 0.06),
        Parameter("at_y", "N", 0.06),
    ),
    stage=HAND,
    correct=_correct_cable_force,
    apply=_apply_cable_force,
    report=_report_cable_force,
    wrist=True,
)


# A lightly damped mode of the hand's structure, rung by every contact change and by every change of load.

GROUPS = (("grip", (0, 3)), ("support", (1, 2)))  # events of a move that ring alike
AMPLITUDES = tuple(
    f"{part}_{group}_{c}" for group, _ in GROUPS for part in ("sin", "cos") for c in FORCE_CHANNELS
)


def _ringing(world: World, values) -> jnp.ndarray:
    omega = 2 * np.pi * values["frequency"]
    moves = world.events.shape[1] // 4
    total = jnp.zeros_like(world.force)
    for group, kinds in GROUPS:
        since = jnp.stack([world.t - world.events[:, 4 * m + k, None] for m in range(moves) for k in kinds])
        started = (since >= 0) & (since < 3.0)
        since = jnp.where(started, since, 0.0)
        decay = jnp.where(started, jnp.exp(-values["damping"] * omega * since), 0.0)
        for part, wave in (("sin", jnp.sin), ("cos", jnp.cos)):
            shape = (decay * wave(omega * since)).sum(0)
            total += (
                shape[..., None]
                * jnp.stack([values[f"{part}_{group}_{c}"] for c in FORCE_CHANNELS])[None, None, :]
            )
    return total


def _correct_structural_vibration(world: World, values, on) -> World:
    # What loads ring is put into what they should read, not taken out: recorded noise stays as it is.
    ring = jnp.stack([jnp.asarray(values[n], float) for n in ("frequency", "damping", "drive")])
    return with_mode(world, RINGING, on)._replace(force=world.force - _ringing(world, values), ring=ring)


def _apply_structural_vibration(performance: Performance, values, rng) -> Performance:
    omega, zeta = 2 * np.pi * values["frequency"], values["damping"]
    since = performance.t[:, None] - performance.events[None, :]
    ring = np.where(since >= 0, np.exp(-zeta * omega * since.clip(0)) * np.sin(omega * since), 0.0).sum(1)
    return with_force(
        performance, flat(performance) + values["gain"] * ring[:, None] * np.array([0, 1.0, 0, 1.0])
    )


def _report_structural_vibration(draws, rig):
    size = np.sqrt(sum(np.asarray(draws[name]) ** 2 for name in AMPLITUDES) / 4)
    units = {"frequency": "Hz", "damping": "1", "drive": "1"}
    return {name: (draws[name], unit) for name, unit in units.items()} | {"gain": (size, "N")}


STRUCTURAL_VIBRATION = Effect(
    name="structural_vibration",
    acts_on="dynamics",
    says="a mode rung by contact changes, gain exp(-damping w t) sin(w t), and by changes of load",
    shows="decaying oscillation after contact changes",
    mistaken_for=("noise", "contact_impact"),
    called="a part of the structure that rings",
    check="Tap the finger and record at a high rate; tighten what rings, or damp it.",
    parameters=(
        Parameter(
            "frequency",
            "Hz",
            0.7,
            neutral=5.0,
            starts=tuple(0.75 + 0.5 * k for k in range(19)),
            low=0.7,
            high=10.0,
            log=True,
        ),
        Parameter("damping", "1", 1.0, neutral=0.05, starts=(0.05,), low=0.003, high=0.15, log=True),
        Parameter("drive", "1", 0.2, low=-0.8, high=0.8, hidden=True),
        *(Parameter(name, "N", 0.1, hidden=True) for name in AMPLITUDES),
    ),
    stage=READOUT,
    correct=_correct_structural_vibration,
    apply=_apply_structural_vibration,
    report=_report_structural_vibration,
)
