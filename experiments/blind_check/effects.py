"""The contract's effects, implemented independently: by MuJoCo's own means or in the recording chain.

Each entry draws the contract's parameters at a size (1: large) and states what it changes: the world before
the run, stages of the recording chain, or the sampling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from experiments.blind_check.hand import Rig
from experiments.blind_check.scene import World
from experiments.blind_check.signals import (
    BAND,
    ENCODER,
    FINGERS,
    FORCES,
    HAND,
    JOINTS,
    LINKS,
    MIX,
    READOUT,
    SCALE,
    Rng,
    Stage,
    Values,
    added_force,
    bumped,
    by_channel,
    channel_values,
    crossed,
    drift,
    heavy,
    late,
    offset_joints,
    played,
    pulled,
    ringing,
    smooth,
    turned,
)


@dataclass(frozen=True)
class Change:
    """What one effect changes: the `world`, `stages` of the recording chain, `sampling`, the operator's
    `style`."""

    world: Callable[[World], World] | None = None
    stages: tuple[tuple[int, Stage], ...] = ()
    sampling: dict[str, float] = field(default_factory=dict)
    style: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Made:
    """An effect of the check: `draw(rng, size)` gives the contract's parameters and hidden details."""

    name: str
    draw: Callable[[Rng, float], Values]
    change: Callable[[Values], Change]
    scored: bool = True  # whether its parameters have the contract's meaning


def fault(
    name: str,
    draw: Callable[[Rng, float], Values],
    stage: int,
    build: Callable[[Values], Stage],
    scored: bool = False,
) -> Made:
    """An effect that acts only at one `stage` of the recording chain, as `build` makes it from its values."""
    return Made(name, draw, lambda v: Change(stages=((stage, build(v)),)), scored)


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _some(rng: Rng, names: tuple[str, ...], unit: float) -> Values:
    """Values of random sign and size for channels, some of them zero, with rms `unit`."""
    while True:
        x = rng.normal(size=len(names)) * (rng.random(len(names)) < 0.7)
        if np.abs(x).max() > 0.2:
            return dict(zip(names, map(float, unit * x / np.sqrt((x**2).mean())), strict=True))


GROSS = 0.12  # share of biases from a sensor that was never tared
TARE = 1.0  # N


def _bias(rng: Rng, size: float) -> Values:
    """Zero errors of four channels, or of one sensor that was never tared."""
    if size > 0.3 and rng.random() < GROSS:
        return dict.fromkeys(FORCES, 0.0) | {str(rng.choice(FORCES)): TARE * _sign(rng) * rng.uniform(0.5, 2)}
    return _some(rng, FORCES, 0.16 * size)


def _common_or_one(rng: Rng, name: str, value: float, channels: bool = False) -> Values:
    """A value common to both fingers, as `name`, or of one finger or channel alone."""
    kind = rng.random()
    if kind < 0.6:
        return {name: value}
    names = FORCES if channels and kind > 0.85 else FINGERS
    return dict.fromkeys(names, 0.0) | {str(rng.choice(names)): value}


def _log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _pads(rng: Rng, size: float) -> Values:
    """Pads stiffer or softer by up to a factor of 3.5, in shear likewise or not at all; relative to the
    rig."""
    way = _sign(rng) if size > 0.3 else -1.0
    scale = float(np.exp(way * 1.25 * size))
    return {"normal_stiffness": scale, "shear_stiffness": float(rng.choice([1.0, scale])),
            "exponent": float(rng.choice([1.0, 1.08]))}  # fmt: skip


def fitted(name: str, values: Values, rig: Rig) -> Values:
    """Values converted from the nominal rig to another: pads to stiffnesses, jitter by the rate."""
    out = dict(values)
    if name == "fingertip_compliance":
        out["normal_stiffness"] *= rig.normal_stiffness
        out["shear_stiffness"] *= rig.shear_stiffness
    if name == "clock_jitter":
        out["sd"] *= min(1.0, 20.0 / rig.rate)
    return out


def _misjudged(rng: Rng, size: float) -> Values:
    """A property of block1 that was measured wrong, by a share of its value."""
    return {f"block1.{rng.choice(['weight', 'width', 'height'])}": 0.15 * size * _sign(rng)}


def _world(**names: str) -> Callable[[Values], Change]:
    """A change of the world's fields, given as field = parameter."""
    return lambda v: Change(world=lambda w: replace(w, **{f: v[p] for f, p in names.items()}))


MADE = (
    fault("force_bias", _bias, READOUT,
          lambda v: added_force(lambda s, r: channel_values(v, FORCES)), scored=True),
    fault("force_drift", lambda r, s: _some(r, FORCES, 0.025 * s), READOUT, drift, scored=True),
    fault("force_gain", lambda r, s: _common_or_one(r, "gain", 0.16 * s * _sign(r), channels=True), SCALE,
          lambda v: lambda s, r: replace(s, force=s.force * (1 + by_channel(v, "gain"))), scored=True),
    fault("force_crosstalk",
          lambda r, s: {"fy_from_fx": 0.09 * s * _sign(r), "fx_from_fy": 0.09 * s * r.uniform(-1, 1)},
          MIX, crossed, scored=True),
    fault("sensor_rotation",
          lambda r, s: {"angle1": 0.1 * s * _sign(r) * r.uniform(0.5, 1), "angle2": 0.1 * s * _sign(r)},
          MIX, turned, scored=True),
    fault("force_lag", lambda r, s: _common_or_one(r, "delay", 0.25 * s), BAND, late, scored=True),
    fault("force_lowpass", lambda r, s: _common_or_one(r, "time_constant", 0.2 * s), BAND, smooth,
          scored=True),
    Made("quantisation", lambda r, s: {"step": 0.2 * s}, lambda v: Change(sampling={"step": v["step"]})),
    fault("joint_offset", lambda r, s: _some(r, JOINTS, 0.02 * s), ENCODER, offset_joints, scored=True),
    fault("link_length", lambda r, s: {"scale": 0.04 * s * _sign(r)}, LINKS,
          lambda v: lambda s, r: replace(s, stretch=s.stretch + v["scale"]), scored=True),
    fault("backlash", lambda r, s: {"width": 0.012 * s}, ENCODER, played, scored=True),
    Made("clock_jitter", lambda r, s: {"sd": 0.02 * s}, lambda v: Change(sampling={"jitter": v["sd"]})),
    Made("fingertip_compliance", _pads,
         _world(normal_stiffness="normal_stiffness", shear_stiffness="shear_stiffness", exponent="exponent")),
    Made("fingertip_creep", lambda r, s: {"ratio": 1.2 * s, "time_constant": _log(r, 0.2, 2.0)},
         _world(creep_ratio="ratio", creep_time="time_constant")),
    fault("fingertip_mass", lambda r, s: {"mass": 0.03 * s}, HAND, heavy, scored=True),
    Made("grip_slip", lambda r, s: {"mu": 0.22 + 0.13 * (1 - s) * r.uniform(0.6, 1.4)},
         lambda v: Change(world=lambda w: replace(w, pad_friction=v["mu"]),
                          style={"grip": (1.3, 1.9), "press": (0.8, 1.6)})),
    # Not scored: a hand that yields under the heavier side, and a grip that then pushes askew, add to it.
    Made("offcentre_mass", lambda r, s: {"offset": 0.005 * s * _sign(r)}, _world(mass_offset="offset"),
         scored=False),
    Made("hand_roll", lambda r, s: {"amplitude": 0.02 * s},
         lambda v: Change(style={"roll": v["amplitude"]})),
    Made("actual", _misjudged, lambda v: Change()),
    Made("table_tilt", lambda r, s: {"angle": 0.04 * s * _sign(r)}, _world(tilt="angle")),
    Made("table_compliance", lambda r, s: {"stiffness": 700.0 / s}, _world(table_stiffness="stiffness")),
    Made("cable_force",
         lambda r, s: {"stiffness": 4.0 * s * _sign(r), "x0": r.uniform(0.08, 0.2), "y0": r.uniform(-0.02,
             0.1)},
         lambda v: Change(world=lambda w: replace(w, cable=(v["stiffness"], v["x0"], v["y0"])),
                          stages=((HAND, pulled(v)),))),
    Made("viscous_drag", lambda r, s: {"coefficient": 1.8 * s},
         lambda v: Change(world=lambda w: replace(w, drag=v["coefficient"]),
                          stages=((HAND, added_force(lambda s, r: v["coefficient"] * s.motion.velocity)),))),
    fault("structural_vibration",
          lambda r, s: {"frequency": r.uniform(2.5, 14.0), "damping": _log(r, 0.015, 0.12),
                        "coupling": 0.3 * s}, MIX, ringing, scored=True),
    fault("contact_impact", lambda r, s: {"impulse": 0.08 * s, "length": _log(r, 0.03, 0.08)}, HAND, bumped,
          scored=True),
)  # fmt: skip
CATALOGUE = {made.name: made for made in MADE}
