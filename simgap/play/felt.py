"""Effects as they can be felt next to the nominal world: of the scene, or of what the sensors say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hmmseg.errors import InputError, nearest
from hmmseg.io.rig import Rig
from simgap.effects import catalogue
from simgap.effects.base import HandEffect, Performance
from simgap.world.properties import Block, Blocks
from simgap.world.virtual_model import Surroundings, finite_stiffness

OFTEN = 3.0  # look: prior standard deviations of a sensor's effect: strong enough to be seen


def felt_effects() -> dict[str, HandEffect]:
    """Effects that a played world can have."""
    return {
        name: effect for name, effect in catalogue().items()
        if effect.scene is not None
        or (effect.apply is not None and effect.acts_on == "sensing" and effect.played != {})
    }  # fmt: skip


def effect_values(name: str, given: Mapping[str, float] | None = None) -> dict[str, float]:
    """Parameters of an effect as given; without any, strong enough to be felt, in its first form.

    InputError for an unknown effect.
    """
    known = felt_effects()
    if name not in known:
        raise InputError(f"effect {name}", "cannot be felt in a played world", nearest(name, known))
    parameters, forms = known[name].parameters, known[name].forms
    nothing = {n: p.nominal if p.log or p.shape else 0.0 for n, p in parameters.items()}
    first = forms[0] if forms else tuple(nothing)  # forms overlap: a gain of a finger and that of both
    strong = {n: OFTEN * p.sd for n, p in parameters.items() if n in first and not (p.log or p.shape)}
    usual = known[name].played or nothing | ({} if given else strong)
    return dict(usual) | {key: float(value) for key, value in (given or {}).items() if np.isfinite(value)}


def scene_with(effects: Mapping[str, Mapping[str, float]], rig: Rig, blocks: Blocks
               ) -> tuple[Rig, dict[str, Block], Surroundings]:  # fmt: skip
    """Rig, blocks and surroundings with the scene effects among these."""
    around, changed, known = Surroundings(), dict(blocks), felt_effects()
    for name, values in effects.items():
        scene = known[name].scene
        for key, value in (scene(dict(values)) if scene is not None else {}).items():
            if key == "friction":
                changed = {each: replace(block, friction=max(value, 1e-3)) for each, block in changed.items()}
            elif key in ("normal_stiffness", "shear_stiffness"):
                size = float(np.clip(value, 50.0, finite_stiffness(np.inf)))
                rig = rig.model_copy(update={"fingertip": rig.fingertip.model_copy(update={key: size})})
            else:
                around = replace(around, **{key: value})
    return rig, changed, around


def sensed(effects: Mapping[str, Mapping[str, float]], t: np.ndarray, position: np.ndarray,
           velocity: np.ndarray, force: np.ndarray, rig: Rig) -> np.ndarray:  # fmt: skip
    """Forces (n, 2, 2) [N] as sensors with these effects say them, of a stretch of motion at times t (n,)."""
    known, nothing = felt_effects(), np.zeros(t.size)
    performance = Performance(t, position, velocity, force, np.zeros(0), rig, nothing, nothing + 1.0)
    for name, values in effects.items():
        apply = known[name].apply
        if apply is not None and known[name].acts_on == "sensing":
            performance = apply(performance, dict(values), np.random.default_rng(0))
    return performance.force
