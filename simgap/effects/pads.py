"""Effects at the contact of fingertips: stiffness, creep and slip of their pads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import tomlkit
from scipy.special import expit

from hmmseg.io.rig import Rig
from simgap.channels import at_rest
from simgap.channels.sensors import LOWPASS
from simgap.effect import Array, Parameter
from simgap.effects.base import (
    CONTACT,
    CREEPING,
    SLIDING,
    HandEffect,
    Performance,
    Values,
    World,
    flat,
    interval_comment,
    number,
    table,
    with_mode,
)

# Pads that are stiffer or softer than nominal: by direction, on each finger, or, being of another rubber,
# alike in all. The last cannot be told from a common gain of the force sensors where weights are unknown.

# prior: Shore hardness is stated to within 5 points, about a fifth of the modulus (ISO 48-4; Gent 1958)
SOFTNESS = Parameter(0.0, 0.2, low=-1.0)
FINGERS = ("give_normal1", "give_normal2", "give_shear1", "give_shear2")


def _correct_fingertip_compliance(world: World, values: Values, on: Array) -> World:
    each = np.array([values[n] for n in FINGERS])
    normal = world.give_normal * (1 + values["softness"]) + values["give_normal"] + each[:2]
    shear = world.give_shear * (1 + values["softness"]) + values["give_shear"] + each[2:]
    return world._replace(give_normal=np.maximum(normal, 0.0), give_shear=np.maximum(shear, 0.0))


def _report_fingertip_compliance(draws: dict[str, Any], rig: Rig) -> dict[str, Any]:
    """True stiffnesses [N/m] from the additional compliances; a compliance is at least 1e-6 m/N."""
    tip, out = rig.fingertip, {}
    if "softness" in draws:
        nominal = {"give_normal": tip.normal_stiffness, "give_shear": tip.shear_stiffness}
        draws = {name: draws["softness"] / stiffness for name, stiffness in nominal.items()}
    for name, give in draws.items():
        kind, finger = name[5:].rstrip("12"), name[-1] if name[-1] in "12" else ""
        nominal = getattr(tip, f"{kind}_stiffness")
        out[f"{kind}_stiffness{finger}"] = 1 / np.maximum(1 / nominal + give, 1e-6), "N/m"
    return out


def _admitted_fingertip_compliance(rig: Rig) -> tuple[str, Values]:
    """Standard deviations of the pads' compliances [m/N], from those of their stiffnesses [1]."""
    tip, sds = rig.fingertip, rig.systematic.pad_stiffness
    give = {"normal": 1 / tip.normal_stiffness, "shear": 1 / tip.shear_stiffness}
    return "fingertip_compliance/1", {f"give_{k}{i + 1}": give[k] * sds[i] for k in give for i in (0, 1)}


def _phrase_fingertip_compliance(means: Mapping[str, float], rig: Mapping[str, Any]) -> str:
    nominal, found = rig.get("normal_stiffness"), means.get("normal_stiffness")
    if nominal is None or found is None:
        return "other fingertips than the model's"
    if nominal == float("inf"):
        return "fingertips that yield, where the model has rigid ones"
    return "softer fingertips" if found < nominal else "stiffer fingertips"


def _patched_fingertip_compliance(
    document: tomlkit.TOMLDocument, found: Mapping[str, Any]
) -> dict[str, str] | None:
    """Put pad stiffnesses into the rig, each with its former value and comment."""
    pads = table(document, "fingertip")
    names = [n for n in ("normal_stiffness", "shear_stiffness") if n in found]
    for name in names:
        before, said = pads.get(name, float("inf")), ""
        if name in pads:
            said = pads[name].trivia.comment.lstrip("# ")
        pads[name] = number(found[name]["mean"])
        pads[name].comment(
            f"was {float(before):g}; {interval_comment(found[name])}" + (f"; {said}" if said else "")
        )
    return {name: f"fingertip.{name}" for name in names}


FINGERTIP_COMPLIANCE = HandEffect(
    name="fingertip_compliance",
    acts_on="contact",
    says="pad stiffness differs from nominal (or is finite at all)",
    shows="distance follows grip force",
    mistaken_for=("width", "joint_offset", "force_gain"),
    called="other fingertips than the model's",
    check="Press a fingertip against a scale and plot force over travel; look for worn or replaced pads.",
    phrase=_phrase_fingertip_compliance,
    parameters={n: Parameter(0.0, 4e-4, "m/N") for n in ("give_normal", "give_shear", *FINGERS)}
    | {"softness": SOFTNESS},
    forms=(("give_normal", "give_shear"), FINGERS, ("softness",)),
    stage=CONTACT,
    correct=_correct_fingertip_compliance,
    report=_report_fingertip_compliance,
    admitted=_admitted_fingertip_compliance,
    patched=_patched_fingertip_compliance,
    scene=lambda v: {"normal_stiffness": v["normal_stiffness"], "shear_stiffness": v["shear_stiffness"]},
    played={"normal_stiffness": 800.0, "shear_stiffness": 500.0},
)


# A viscoelastic arm on the pad: foam that keeps yielding under load (standard linear solid).
#
# Its stiffness is (1 + ratio) k at once and relaxes to k: with the arm's time constant T, displacement d and
# force F obey F + T F' = k d + T (1 + ratio) k d'. Solved for d, a share ratio / (1 + ratio) of the
# deflection follows the force through a low-pass of time constant T (1 + ratio).


def _correct_fingertip_creep(world: World, values: Values, on: Array) -> World:
    ratio = values["ratio"]
    return with_mode(world, CREEPING, on)._replace(
        creep=world.creep + on * ratio / (1 + ratio), creep_time=values["time_constant"] * (1 + ratio)
    )


def _apply_fingertip_creep(performance: Performance, values: Values, rng: np.random.Generator) -> Performance:
    """Move tips at unchanged grip force as such a pad lets them."""
    pad, ratio = performance.rig.fingertip, values["ratio"]
    late = {"time_constant": values["time_constant"] * (1 + ratio)}
    force = flat(performance)
    lagged = np.stack([at_rest(LOWPASS.read, performance.t, f, late) for f in force.T], 1)
    more = ratio / (1 + ratio) * (lagged - force) * ([1 / pad.normal_stiffness, 1 / pad.shear_stiffness] * 2)
    return performance._replace(position=performance.position + more.reshape(-1, 2, 2))


FINGERTIP_CREEP = HandEffect(
    name="fingertip_creep",
    acts_on="contact",
    says="a viscoelastic arm on the pad (standard linear solid)",
    shows="distance relaxes while held; grip decays",
    mistaken_for=("force_drift", "grip_slip"),
    called="fingertips that keep yielding under load",
    check="Grip a rigid block for ten seconds at constant force and watch the distance of the fingers.",
    parameters={
        "ratio": Parameter(0.0, 0.7, starts=(0.3,), low=0.0, high=8.0),
        "time_constant": Parameter(0.6, 0.8, "s", starts=(0.25, 0.7, 1.8), low=0.05, high=8.0, log=True),
    },
    stage=CONTACT,
    correct=_correct_fingertip_creep,
    apply=_apply_fingertip_creep,
)


# Pads that slide on the block when the shear exceeds mu times the normal force.
#
# Slip shows as a shift of the fingers against the block that grows only while the shear is at its bound. Its
# extent is free in every grip (marginalised with the grip's other constants); its time is given by mu.

# chosen: N; a lighter grip is opening or closing, when healthy pads slide too
LOADED = 0.4
HANGING = 0.9  # chosen: least share of a carry in which pads stick, as the block would fall otherwise


def _correct_grip_slip(world: World, values: Values, on: Array) -> World:
    force = world.force - world.load
    push = np.stack([force[..., 0], -force[..., 2]], -1)
    ratio = np.abs(force[..., 1::2]) / np.maximum(push, 0.5 * LOADED)
    carried = (world.carry > 0) & (push.min(axis=-1) > LOADED)
    steady = np.quantile(ratio.max(axis=-1)[carried], HANGING) if carried.any() else 0.0
    mu = max(values["mu"], 1.05 * steady)
    sliding = expit((ratio / mu - 1.02) / 0.02).max(axis=-1) * expit((push.min(axis=-1) - LOADED) / 0.05)
    return with_mode(world, SLIDING, on)._replace(
        slip=world.slip + on * sliding * (world.ground + world.carry)
    )


GRIP_SLIP = HandEffect(
    name="grip_slip",
    acts_on="contact",
    says="the pad slides on the block when shear exceeds mu N",
    shows="height changes that do not come back, at impact",
    mistaken_for=("fingertip_creep",),
    called="blocks that slip in the grip",
    check="Mark the block at the pad and lift it harder than usual; clean the pads, or grip more firmly.",
    parameters={
        "mu": Parameter(0.5, 0.6, starts=(0.2, 0.28, 0.36, 0.46, 0.6, 0.8), low=0.08, high=1.5, log=True)
    },
    stage=CONTACT,
    correct=_correct_grip_slip,
    scene=lambda v: {"friction": v["mu"]},
    grip=(1.2, 1.8),  # chosen: N: so lightly that pads of a low friction slide
    played={"mu": 0.12},
)
