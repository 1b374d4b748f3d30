"""An attribution in the words of the interface."""

from __future__ import annotations

from typing import Any

import numpy as np

from hmmseg.contact.decompose import PROPERTIES, UNITS
from simgap.attribution.document import entries
from simgap.attribution.findings import Attribution, EffectPosterior
from simgap.effects import catalogue
from simgap.gap.fit import Fitted
from simgap.gap.located import where
from simgap.gap.search import Search
from simgap.gap.trial_arrays import CHANNELS

DRAWS = 2000  # numerics: of the posterior, for intervals
LISTED = 8  # look: effects that are described


def body(
    found: Search, verdict: Attribution, causes: Fitted | None, following: dict | None, seed: int
) -> dict[str, Any]:
    """The JSON document of a diagnosis; `causes`: the joint fit of the named effects that shift signals."""
    given, posterior = found.problem, verdict.effects
    named = {n: e for n, e in posterior.items() if n in catalogue()}
    ranked = sorted(named, key=lambda n: -named[n].probability)
    shown = [
        n for k, n in enumerate(ranked) if k < LISTED or n in verdict.causes or n in verdict.indistinguishable
    ]
    effects = {n: _described(found, verdict, n, seed) for n in shown}
    if len(verdict.causes) > 1:
        effects["+".join(verdict.causes)] = {
            "parameters": {
                f"{n}.{k}": p for n in verdict.causes for k, p in effects[n]["parameters"].items()
            },
            "log_evidence": _evidence(verdict, verdict.causes),
            "heldout_score": None if verdict.how_far is None else verdict.how_far.score,
            "property_shift": _shifts(found, causes),
        }
    elif verdict.causes and causes is not None:
        effects[verdict.causes[0]]["property_shift"] = _shifts(found, causes)
    rest, far = verdict.remainder, verdict.how_far
    attribution = {n: (e.probability, e.share, e.share_90) for n, e in named.items()}
    out = entries(verdict, verdict.detection, (rest.share, rest.p_value, where(given, rest.where, None)),
                  attribution, where(given, verdict.where, causes))  # fmt: skip
    out |= {"effects": effects, "noise": verdict.noise, "shrinkage": None, "next_experiment": following}
    if far is not None:
        ends = [x if np.isfinite(x) else None for x in far.interval_90]
        out["shrinkage"] = {
            "evaluated_on": "held-out trials", "before": far.before, "after": far.after,
            "noise_floor": far.noise_floor, "fraction": far.fraction, "interval_90": ends,
            "flexible_ceiling": None,
        }  # fmt: skip
    if verdict.small_gap is not None:
        small = verdict.small_gap
        metres = small.channel in ("x", "y", "distance", "offset")
        unit = "m" if metres else "m/s" if small.channel in ("vx", "vy") else "N"
        out["small_gap"] = {
            "size": small.amount * _unit_of_noise(found, small.channel), "unit": unit,
            "where": where(given, verdict.where, None),
        }  # fmt: skip
    return out


def _unit_of_noise(found: Search, channel: str) -> float:
    """A residual's usual noise in the channel's unit."""
    arrays, c = found.problem.frame.arrays, CHANNELS.index(channel)
    return float(np.median(arrays.sd[..., c][arrays.there[..., c] > 0]))


def _described(found: Search, verdict: Attribution, name: str, seed: int) -> dict[str, Any]:
    """Parameters and evidence of one effect."""
    return {
        "parameters": parameters(found, verdict.effects[name], name, seed),
        "log_evidence": _evidence(verdict, (name,)),
        "heldout_score": None,
        "property_shift": {},
    }


def parameters(found: Search, posterior: EffectPosterior, name: str, seed: int) -> dict[str, Any]:
    """An effect's parameters as the interface names them."""
    every = drawn(found, posterior, name, seed)
    return {key: _summary(values, unit) for key, (values, unit) in every.items()}


def drawn(
    found: Search, posterior: EffectPosterior, name: str, seed: int
) -> dict[str, tuple[np.ndarray, str]]:
    """Draws (DRAWS,) of an effect's parameters given that it acts, and their units, as the interface names
    them."""
    effect, rng = catalogue()[name], np.random.default_rng(seed)
    of = {p.name: p for p in effect.parameters}
    scatter = next((s for s in found.scatters if s.effect == name), None)
    if scatter is not None:
        p = effect.parameters[0]
        return {p.name: (scatter.value * np.exp(scatter.log_sd * rng.standard_normal(DRAWS)), p.unit)}
    draws = {}
    for key, p in posterior.parameters.items():
        u = p.mean + p.sd * rng.standard_normal(DRAWS)
        if key not in of:  # by how much a property that was measured apart is off
            obj, kind = key.rsplit(".", 1)
            one = found.problem.sd[found.problem.frame.task.objects.index(obj), PROPERTIES.index(kind)]
            return {key: (u * float(one), UNITS[kind])}
        draws[key] = np.asarray(of[key].value(np.clip(u, *of[key].limits)))
    if effect.report is not None:
        return effect.report(draws, found.problem.frame.rig)
    return {p.name: (draws[p.name], p.unit) for p in effect.parameters if p.name in draws and not p.hidden}


def _summary(values: np.ndarray, unit: str) -> dict[str, Any]:
    low, high = np.percentile(values, (5, 95))
    return {"mean": float(np.median(values)), "sd": float(np.std(values)),
            "interval_90": [float(low), float(high)], "unit": unit}  # fmt: skip


def _evidence(verdict: Attribution, names: tuple[str, ...]) -> float:
    """Log posterior odds of an effect, or of several, to act [nats]."""
    chance = min((verdict.effects[n].probability for n in names), default=0.0)
    chance = float(np.clip(chance, 1e-12, 1 - 1e-12))
    return float(np.log(chance / (1 - chance)))


def _shifts(found: Search, causes: Fitted | None) -> dict[str, dict]:
    """Properties with rig.toml at its word and with the causes, of those that were identified or measured.

    Both are of one model, pads included, so that either can be simulated; what `identify` says is of a rig
    that may be wrong by what it doubts (`estimation.sampler`), and stands between them.
    """
    if causes is None:
        return {}
    given, (_, known) = found.problem, found.blocks
    before, after = given.properties(found.healthy.u), given.properties(causes.u)
    return {
        f"{name}.{kind}": {"before": float(before[o, j]), "after": float(after[o, j]), "unit": UNITS[kind]}
        for o, name in enumerate(given.frame.task.objects)
        for j, kind in enumerate(PROPERTIES)
        if known[o, j]
    }
