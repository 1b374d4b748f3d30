"""A lightly damped mode of the hand's structure, rung by every contact change and by every change of load."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.effects.base import (
    READOUT,
    RINGING,
    Effect,
    Parameter,
    Performance,
    World,
    flat,
    with_force,
    with_mode,
)

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


def _correct(world: World, values, on) -> World:
    # What loads ring is put into what they should read, not taken out: recorded noise stays as it is.
    ring = jnp.stack([jnp.asarray(values[n], float) for n in ("frequency", "damping", "drive")])
    return with_mode(world, RINGING, on)._replace(force=world.force - _ringing(world, values), ring=ring)


def _apply(performance: Performance, values, rng) -> Performance:
    omega, zeta = 2 * np.pi * values["frequency"], values["damping"]
    since = performance.t[:, None] - performance.events[None, :]
    ring = np.where(since >= 0, np.exp(-zeta * omega * since.clip(0)) * np.sin(omega * since), 0.0).sum(1)
    return with_force(
        performance, flat(performance) + values["gain"] * ring[:, None] * np.array([0, 1.0, 0, 1.0])
    )


def _report(draws, rig):
    size = np.sqrt(sum(np.asarray(draws[name]) ** 2 for name in AMPLITUDES) / 4)
    units = {"frequency": "Hz", "damping": "1", "drive": "1"}
    return {name: (draws[name], unit) for name, unit in units.items()} | {"gain": (size, "N")}


EFFECT = Effect(
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
    correct=_correct,
    apply=_apply,
    report=_report,
)
