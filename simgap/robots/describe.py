"""A robot's diagnosis as the JSON document has it."""

from __future__ import annotations

from typing import Any

import numpy as np

from simgap.attribution.posterior import Forms, Model, coordinates, fitted
from simgap.attribution.verdict import entries, rows
from simgap.robots.diagnose import RobotDiagnosis
from simgap.robots.explained import SEEN


def body(found: RobotDiagnosis) -> dict[str, Any]:
    """The document: verdict, causes, probabilities, where, effects, shrinkage, and what cannot be told."""
    v = found.verdict
    shares = {n: v.shares.of_effect(k) for k, n in enumerate(v.shared)}
    attribution = {n: (p, *shares.get(n, (0.0, (0.0, 0.0)))) for n, p in v.chance.items()}
    rest = v.remainder
    p_value = None if v.verdict == "none" else rest.p_value
    out = entries(v, v.detection, (rest.share, p_value, rows(rest.where)), attribution, rows(v.where))
    out["remainder"]["regimes"] = dict(v.left)
    out["remainder"]["rms_over_noise"] = v.over_noise
    return out | {
        "numerics": _fitted(found, numeric=True),
        "stands_in": {c: [o.name for o in v.stand_ins if o.place == c] for c in v.causes},
        "effects": _effects(found),
        "fitted": _fitted(found),
        "discrepancy": dict(found.discrepancy),
        "identifiability": found.identifiable.body(),
        "shrinkage": _shrinkage(found),
        "next_experiment": None
        if found.next_log is None
        else {
            "do": f"repeat the motion of {found.next_log.log}",
            "separates": list(found.next_log.separates),
            "expected_gain_nats": found.next_log.gain,
        },
    }


def parameters(
    found: RobotDiagnosis, f: Forms, model: Model, effects: tuple[str, ...]
) -> dict[str, dict[str, Any]]:
    """Of a set's effects: short name, or effect and short name where there are several, to its posterior."""
    out: dict[str, dict[str, Any]] = {}
    variance = np.maximum(np.diag(model.covariance), 0.0)
    for j, mine in coordinates(f, model.effects).items():
        c = f.gap.candidates[j]
        if c.name not in effects:
            continue
        mean, sd = c.neutral + c.scale * model.x[mine], c.scale * np.sqrt(variance[mine])
        for k, short in enumerate(c.parameters):
            key = short if len(effects) == 1 else f"{c.name}.{short}"
            own = found.composed.effects[c.name].parameters[short]
            m, s = float(mean[k]), float(sd[k])
            low, high = max(m - 1.645 * s, float(c.low[k])), min(m + 1.645 * s, float(c.high[k]))
            out[key] = {"mean": m, "sd": s, "interval_90": [low, high], "unit": own.unit}
            out[key]["nominal"] = own.nominal
    return out


def _effects(found: RobotDiagnosis) -> dict[str, Any]:
    """The set of causes together, each of them, and those that could take a cause's place."""
    v, f = found.verdict, found.forms
    names = [c.name for c in f.gap.candidates]
    plain = fitted(f, ())
    out: dict[str, Any] = {}

    def entry(effects: tuple[str, ...], model: Model, f: Forms = f) -> dict[str, Any]:
        gain = found.shrinkage
        return {
            "parameters": parameters(found, f, model, effects),
            "log_evidence": model.score - plain.score,
            "heldout_score": 0.0
            if gain is None or effects != v.causes
            else 0.5 * (gain.before - gain.after) * found.linear.residual.size,
            "property_shift": {},
        }

    if v.causes:
        out["+".join(v.causes)] = entry(v.causes, v.model)
        for name in v.causes if len(v.causes) > 1 else ():
            out[name] = entry((name,), v.model)
    for one in v.stand_ins:
        out[one.name] = entry((one.name,), one.model, one.forms)
    for name in v.indistinguishable:
        if name in names and name not in out:
            out[name] = entry((name,), fitted(f, (names.index(name),)))
    return out


def _fitted(found: RobotDiagnosis, numeric: bool = False) -> dict[str, Any]:
    """What was fitted along: before (nothing else acts) and with the causes; the simulation's own numbers
    apart."""
    out = {}
    for name, before in found.plain.point.items():
        if found.composed.numeric(name) is not numeric:
            continue
        for short, value in before.items():
            parameter = found.composed.effects[name].parameters[short]
            out[name if len(before) == 1 else f"{name}.{short}"] = {
                "before": value,
                "after": found.linear.point[name][short],
                "unit": parameter.unit,
            }
    return out


def _shrinkage(found: RobotDiagnosis) -> dict[str, Any] | None:
    far = found.shrinkage
    if far is None:
        return None
    units = {n: c.unit for n, c in found.composed.simulator.channels.items()}
    return {
        "evaluated_on": "held-out logs" if len(found.composed.recordings) > 2 else "held-out stretches",
        "before": far.before,
        "after": far.after,
        "noise_floor": far.noise_floor,
        "fraction": far.fraction,
        "interval_90": list(far.interval_90),
        "flexible_ceiling": None,
        "rms": {n: {"before": a, "after": b, "unit": units[n]} for n, (a, b) in far.rms.items()},
        "by_phase": _by_phase(found, units),
    }


def _by_phase(found: RobotDiagnosis, units: dict[str, str]) -> dict[str, Any]:
    """Of each phase the share of its gap that is gone on held-out logs (None where there is none to speak
    of), and by channel the root mean square that is left."""
    far, rows = found.shrinkage, found.composed.rows
    if far is None:
        return {}
    known, phase = np.isfinite(far.squares).all(0), found.phases.of(rows)
    out: dict[str, Any] = {}
    for number, name in enumerate(found.phases.names):
        mine = known & (phase == number)
        if not mine.any():
            continue
        before, after = far.squares[:, mine].sum(1)
        gap = before - mine.sum()
        seen = gap > SEEN * np.sqrt(2 * mine.sum())
        left = {}
        for c, channel in enumerate(rows.channels):
            here = mine & (rows.channel == c)
            if here.any():
                was, now = (float(np.sqrt(np.mean(r[here] ** 2))) for r in (far.plain, far.residual))
                left[channel] = {"before": was, "after": now, "unit": units[channel]}
        out[name] = {"fraction": float((before - after) / gap) if seen else None, "rms": left}
    return out
