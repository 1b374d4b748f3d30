"""The JSON document of a robot's diagnosis."""

from __future__ import annotations

from typing import Any

import numpy as np

from hmmseg.levels import SHOWN
from simgap.attribution.verdict import entries, rows
from simgap.robot_effects.base import entry
from simgap.robots.diagnose import RobotDiagnosis
from simgap.robots.search import FittedSet


def body(found: RobotDiagnosis) -> dict[str, Any]:
    """The document: verdict, causes, probabilities, where, effects, shrinkage, what cannot be told apart."""
    v = found.verdict
    shares = {n: v.shares.of_effect(k) for k, n in enumerate(v.shared)}
    attribution = {n: (p, *shares.get(n, (0.0, (0.0, 0.0)))) for n, p in v.chance.items()}
    rest = v.remainder
    p_value = None if v.verdict == "none" else rest.p_value
    out = entries(v, v.detection, (rest.share, p_value, rows(rest.where)), attribution, rows(v.where))
    out["remainder"]["rms_over_noise"] = v.over_noise
    return out | {
        "explanation": {"effects": list(v.explanation), "doubts": list(v.doubts)},
        "calibrated": None if found.calibrated is None else found.calibrated.body(),
        "numerics": _fitted(found, numeric=True),
        "stands_in": {c: list(others) for c, others in v.stands_in.items()},
        "effects": _effects(found),
        "fitted": _fitted(found, numeric=False),
        "discrepancy": dict(found.best.discrepancy),
        "identifiability": found.identifiable.body(),
        "shrinkage": _shrinkage(found),
        "next_experiment": found.next_log,
    }


def _effects(found: RobotDiagnosis) -> dict[str, Any]:
    """The best set, each of its effects, and those that could replace a cause, each at its best."""
    v = found.verdict
    sets = [v.causes] if v.causes else []
    sets += [(name,) for name in v.causes or v.explanation]
    out = {"+".join(names): _entry(found, found.best, names) for names in sets}
    for name in v.indistinguishable:
        having = [s for s in found.search.fitted.values() if name in s.names]
        if having:
            out[name] = _entry(found, max(having, key=lambda s: s.score), (name,))
    return out


def _entry(found: RobotDiagnosis, one: FittedSet, effects: tuple[str, ...]) -> dict[str, Any]:
    far = found.shrinkage
    if one is not found.best or effects != found.verdict.causes:
        far = None
    return {
        "parameters": parameters(found, one, effects),
        "log_evidence": one.score - found.search.fitted[frozenset()].score,
        "heldout_score": 0.0 if far is None else 0.5 * (far.before - far.after) * one.linear.residual.size,
        "property_shift": {},
    }


def parameters(found: RobotDiagnosis, one: FittedSet, effects: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Posteriors of a set's effects, by short name, or by effect and short name where there are several.

    Standard deviations are at least those of leaving out folds (the jackknife of Quenouille and Tukey), and
    include how the parameter differs in other fitted sets, by their weight.
    """
    mean, sd = _posterior(found, one)
    out: dict[str, dict[str, Any]] = {}
    for name in effects:
        for short, p in found.composed.effects[name].parameters.items():
            key = short if len(effects) == 1 else f"{name}.{short}"
            out[key] = entry(p, mean[name, short], sd[name, short])
    return out


def _posterior(
    found: RobotDiagnosis, one: FittedSet
) -> tuple[dict[tuple[str, str], float], dict[tuple[str, str], float]]:
    effects, names = found.composed.effects, one.names
    keys = [(n, short) for n in names for short in effects[n].parameters]
    fit = one.sets.fit(names, 0)
    own = np.sqrt(np.diag(fit.spread))[-len(keys) :] if keys else np.zeros(0)
    left_out = one.sets.jackknife(names, 0)[:, -len(keys) :] if keys else np.zeros((0, 0))
    if len(left_out) > 2:
        own = np.maximum(own, np.sqrt((len(left_out) - 1) * left_out.var(0)))
    usual = np.array([effects[n].parameters[s].sd for n, s in keys])
    mean = {key: float(one.point[key[0]][key[1]]) for key in keys}
    sd = dict(zip(keys, (own * usual).tolist(), strict=True))
    for key in keys:
        rivals = [s for s in found.search.fitted.values() if key[0] in s.names]
        weight = np.exp(np.minimum([s.score - one.score for s in rivals], 0.0))
        apart = np.array([s.point[key[0]][key[1]] - mean[key] for s in rivals])
        sd[key] = float(np.sqrt(sd[key] ** 2 + weight @ apart**2 / weight.sum()))
    return mean, sd


def _fitted(found: RobotDiagnosis, numeric: bool) -> dict[str, Any]:
    """What was fitted along, with nothing else acting (before) and with the best set; the simulation's own
    numbers apart."""
    out = {}
    for name, before in found.plain.point.items():
        if found.composed.effects[name].numeric is not numeric:
            continue
        effect = found.composed.effects[name]
        for short, value in before.items():
            after, unit = found.linear.point[name][short], effect.parameters[short].unit
            out[effect.label(short)] = {"before": value, "after": after, "unit": unit}
    return out


def _shrinkage(found: RobotDiagnosis) -> dict[str, Any] | None:
    far = found.shrinkage
    if far is None:
        return None
    units = {n: c.unit for n, c in found.composed.simulator.channels.items()}
    of = "held-out logs" if len(found.composed.recordings) > 2 else "held-out stretches"
    return {
        "evaluated_on": of, "before": far.before, "after": far.after, "noise_floor": far.noise_floor,
        "fraction": far.fraction, "interval_90": list(far.interval_90), "flexible_ceiling": None,
        "rms": {n: {"before": a, "after": b, "unit": units[n]} for n, (a, b) in far.rms.items()},
        "by_phase": _by_phase(found, units),
    }  # fmt: skip


def _by_phase(found: RobotDiagnosis, units: dict[str, str]) -> dict[str, Any]:
    """By phase the share of the gap that is gone on held-out logs (None where there is hardly a gap), and by
    channel the root mean square before and after."""
    far, rows = found.shrinkage, found.composed.rows
    if far is None:
        return {}
    seen, phase = np.isfinite(far.squares).all(0), found.phases.of(rows)
    out: dict[str, Any] = {}
    for number, name in enumerate(found.phases.names):
        mine = seen & (phase == number)
        if not mine.any():
            continue
        before, after = far.squares[:, mine].sum(1)
        gap = before - mine.sum()
        was, now = rows.rms(far.plain, mine), rows.rms(far.residual, mine)
        left = {n: {"before": was[n], "after": now[n], "unit": units[n]} for n in was}
        stands_out = gap > SHOWN * np.sqrt(2 * mine.sum())
        out[name] = {"fraction": float((before - after) / gap) if stands_out else None, "rms": left}
    return out
