"""Pads that are stiffer or softer than nominal."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import CONTACT, Effect, Parameter, World

FINGERS = ("give_normal1", "give_normal2", "give_shear1", "give_shear2")


def _correct(world: World, values, on) -> World:
    normal, shear = jnp.asarray(values["give_normal"], float), jnp.asarray(values["give_shear"], float)
    each = jnp.stack([jnp.asarray(values[n], float) for n in FINGERS])
    return world._replace(
        give_normal=world.give_normal + normal[None] + each[:2],
        give_shear=world.give_shear + shear[None] + each[2:],
    )


def _report(draws, rig):
    """True stiffnesses [N/m] from the additional compliances; a pad is never stiffer than 1e6 N/m."""
    tip, out = rig.fingertip, {}
    for name, give in draws.items():
        kind, finger = name[5:].rstrip("12"), name[-1] if name[-1] in "12" else ""
        nominal = getattr(tip, f"{kind}_stiffness")
        out[f"{kind}_stiffness{finger}"] = 1 / np.maximum(1 / nominal + give, 1e-6), "N/m"
    return out


def _admitted(rig):
    """Deviations of pads' stiffness [1], as those of their compliances [m/N]."""
    tip, sds = rig.fingertip, rig.systematic.pad_stiffness
    give = {"normal": 1 / tip.normal_stiffness, "shear": 1 / tip.shear_stiffness}
    return "fingertip_compliance/1", {f"give_{k}{i + 1}": give[k] * sds[i] for k in give for i in (0, 1)}


def _phrase(means, rig):
    nominal, found = rig.get("normal_stiffness"), means.get("normal_stiffness")
    if nominal is None or found is None:
        return "other fingertips than the model's"
    if nominal == float("inf"):
        return "fingertips that yield, where the model has rigid ones"
    return "softer fingertips" if found < nominal else "stiffer fingertips"


def _patched(document, found):
    """The pads' own numbers, each with what it was and what rig.toml says of it."""
    from simgap.patch.write import interval_comment, number, table

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


EFFECT = Effect(
    name="fingertip_compliance",
    acts_on="contact",
    says="pad stiffness differs from nominal (or is finite at all)",
    shows="distance follows grip force",
    mistaken_for=("width", "joint_offset", "force_gain"),
    called="other fingertips than the model's",
    check=(
        "Press a fingertip against a scale with feeler gauges behind it and plot force over travel; look "
        "for worn or replaced pads."
    ),
    phrase=_phrase,
    parameters=(
        Parameter("give_normal", "m/N", 4e-4, low=-2.4e-4),
        Parameter("give_shear", "m/N", 4e-4, low=-3.8e-4),
        *(Parameter(n, "m/N", 4e-4, low=-2.4e-4 if "normal" in n else -3.8e-4) for n in FINGERS),
    ),
    forms=(("give_normal", "give_shear"), FINGERS),
    stage=CONTACT,
    correct=_correct,
    report=_report,
    admitted=_admitted,
    patched=_patched,
    scene=lambda v: {"normal_stiffness": v["normal_stiffness"], "shear_stiffness": v["shear_stiffness"]},
    played={"normal_stiffness": 800.0, "shear_stiffness": 500.0},
)
