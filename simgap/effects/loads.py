"""Effects of moving and pulling parts: mass of the fingertips, drag, a cable, shocks, vibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS, Rig
from simgap.effect import Array, Parameter
from simgap.effects.base import (
    CONTACT,
    HAND,
    READOUT,
    RINGING,
    HandEffect,
    Motion,
    Performance,
    Values,
    World,
    flat,
    loading,
    with_force,
    with_mode,
)

FINGERTIP_MASS = loading(  # outboard of its force sensor
    lambda m, v: v["mass"] * (m.acceleration + m.gravity * np.array([0.0, 1.0, 0.0, 1.0])),
    name="fingertip_mass",
    acts_on="dynamics",
    says="recorded F = F + mass (a + g up), outboard of the sensor",
    shows="constant and inertial, free motion too",
    mistaken_for=("force_bias",),
    called="mass beyond the force sensor that the model lacks",
    check="Weigh what is before the sensor, or hold the finger still at two heights and in two directions.",
    parameters={"mass": Parameter(0.0, 0.012, "kg", low=0.0, high=0.1)},
    stage=HAND,
)

VISCOUS_DRAG = loading(
    lambda m, v: v["coefficient"] * m.velocity,
    name="viscous_drag",
    acts_on="dynamics",
    says="recorded F = F + coefficient v on each finger",
    shows="free motion too, by velocity",
    mistaken_for=("force_lag",),
    called="drag on the fingers as they move",
    check="Move the open hand to and fro at two speeds and watch the forces; look at bearings and sleeves.",
    parameters={"coefficient": Parameter(0.0, 0.6, "N s/m")},
    stage=HAND,
)


# A cable that pulls on the fingers like an anchored spring. The fitted parameter is its force at MIDDLE.

MIDDLE = (0.13, 0.02)  # prior: m; about where the fingers work


def _report_cable_force(draws: dict[str, Any], rig: Rig) -> dict[str, Any]:
    k = draws["stiffness"]
    k = np.where(np.abs(k) < 1e-3, 1e-3, k)
    places = {f"{axis}0": (MIDDLE[i] - draws[f"at_{axis}"] / k, "m") for i, axis in enumerate("xy")}
    return {"stiffness": (draws["stiffness"], "N/m")} | places


CABLE_FORCE = loading(
    lambda m, v: v["stiffness"] * (m.position - MIDDLE * 2) + [v["at_x"], v["at_y"]] * 2,
    given=lambda v: v | {f"at_{a}": v["stiffness"] * (MIDDLE[i] - v[f"{a}0"]) for i, a in enumerate("xy")},
    name="cable_force",
    acts_on="dynamics",
    says="recorded F = F + stiffness (p - p0) on each finger",
    shows="free motion too, by position",
    mistaken_for=("force_bias",),
    called="a cable that pulls at the fingers",
    check="Move the open hand slowly through the workspace and watch the forces; tie the cables elsewhere.",
    parameters={
        "stiffness": Parameter(0.0, 2.0, "N/m"),
        "at_x": Parameter(0.0, 0.06, "N"),
        "at_y": Parameter(0.0, 0.06, "N"),
    },
    stage=HAND,
    report=_report_cable_force,
    wrist=True,
)


# A short pulse of vertical force when a block touches down: a raised cosine of unit area [1/s] and unknown
# length. One shorter than a sample would be known only by its impulse, so the length is bounded from below.

# prior: from hard feet to soft ones
TOUCHDOWN = Parameter(0.06, 0.5, "s", low=0.03, high=0.2, log=True, hidden=True)


def _impact(m: Motion, values: Values) -> Array:
    since, length = m.since[..., 2::4], values["length"]
    inside = (since >= 0) & (since < length)
    pulse = np.where(inside, (1 - np.cos(2 * np.pi * since / length)) / length, 0.0).sum(-1)
    return -values["impulse"] * pulse[..., None] * np.array([0.0, 0.5, 0.0, 0.5])


CONTACT_IMPACT = loading(
    _impact,
    given=lambda v: {"length": TOUCHDOWN.nominal} | v,
    name="contact_impact",
    acts_on="dynamics",
    says="a pulse of -impulse in net fy at touchdown",
    shows="place, first samples",
    mistaken_for=("structural_vibration",),
    called="shocks as blocks touch down",
    check="Set down more slowly, and see whether the gap is gone.",
    parameters={"impulse": Parameter(0.0, 0.03, "N s", low=0.0), "length": TOUCHDOWN},
    stage=CONTACT,
    wrist=True,
)


# A lightly damped mode of the hand's structure, excited by contact changes and by every change of load.

GROUPS = (("grip", (0, 3)), ("support", (1, 2)))  # events of a move that excite it alike
AMPLITUDES = tuple(
    f"{part}_{group}_{c}" for group, _ in GROUPS for part in ("sin", "cos") for c in FORCE_CHANNELS
)


def _ringing(world: World, values: Values) -> np.ndarray:
    omega = 2 * np.pi * values["frequency"]
    moves = world.events.shape[1] // 4
    total = np.zeros_like(world.force)
    for group, kinds in GROUPS:
        since = np.stack([world.t - world.events[:, 4 * m + k, None] for m in range(moves) for k in kinds])
        started = (since >= 0) & (since < 3.0)
        since = np.where(started, since, 0.0)
        decay = np.where(started, np.exp(-values["damping"] * omega * since), 0.0)
        for part, wave in (("sin", np.sin), ("cos", np.cos)):
            shape = (decay * wave(omega * since)).sum(0)
            total += shape[..., None] * [values[f"{part}_{group}_{c}"] for c in FORCE_CHANNELS]
    return total


def _correct_structural_vibration(world: World, values: Values, on: Array) -> World:
    # Ringing from loads is added to the prediction, not removed from the recording, whose noise stays the
    # same.
    ring = np.array([values[n] for n in ("frequency", "damping", "drive")])
    return with_mode(world, RINGING, on)._replace(force=world.force - _ringing(world, values), ring=ring)


def _apply_structural_vibration(
    performance: Performance, values: Values, rng: np.random.Generator
) -> Performance:
    omega, zeta = 2 * np.pi * values["frequency"], values["damping"]
    since = performance.t[:, None] - performance.events[None, :]
    ring = np.where(since >= 0, np.exp(-zeta * omega * since.clip(0)) * np.sin(omega * since), 0.0).sum(1)
    return with_force(
        performance, flat(performance) + values["gain"] * ring[:, None] * np.array([0, 1.0, 0, 1.0])
    )


def _report_structural_vibration(draws: dict[str, Any], rig: Rig) -> dict[str, Any]:
    size = np.sqrt(sum(np.asarray(draws[name]) ** 2 for name in AMPLITUDES) / 4)
    units = {"frequency": "Hz", "damping": "1", "drive": "1"}
    return {name: (draws[name], unit) for name, unit in units.items()} | {"gain": (size, "N")}


STRUCTURAL_VIBRATION = HandEffect(
    name="structural_vibration",
    acts_on="dynamics",
    says="a mode rung by contact changes, gain exp(-damping w t) sin(w t), and by changes of load",
    shows="decaying oscillation after contact changes",
    mistaken_for=("noise", "contact_impact"),
    called="a part of the structure that rings",
    check="Tap the finger and record at a high rate; tighten what rings, or damp it.",
    parameters={
        "frequency": Parameter(
            5.0, 0.7, "Hz", starts=tuple(0.75 + 0.5 * k for k in range(19)), low=0.7, high=10.0, log=True
        ),
        "damping": Parameter(0.05, 1.0, starts=(0.05,), low=0.003, high=0.15, log=True),
        "drive": Parameter(0.0, 0.2, low=-0.8, high=0.8, hidden=True),
    }
    | {name: Parameter(0.0, 0.1, "N", hidden=True) for name in AMPLITUDES},
    stage=READOUT,
    correct=_correct_structural_vibration,
    apply=_apply_structural_vibration,
    report=_report_structural_vibration,
)
