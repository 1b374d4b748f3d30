"""Entries of the JSON document: significant cells and the parameters of a fitted candidate."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import stdtrit

from simgap.generic.effects import EFFECTS, Scene
from simgap.generic.features import Layout
from simgap.generic.fit import EnsembleFit
from simgap.generic.locate import Located, both_variances, cell_means
from simgap.generic.ringing import Ring

DURATIONS = "duration"


def channel_name(layout: Layout, channel: int) -> str:
    """A channel's own name; `duration` stands for a subtask's."""
    return layout.ensembles.channels[channel] if channel >= 0 else DURATIONS


def listed_cells(layout: Layout, located: Located, real: np.ndarray, sim: np.ndarray) -> list[dict[str, Any]]:
    """Cells significant over all trials, one row a trial; largest share of the excess first."""
    a, b = both_variances(layout, real, sim)
    counts = np.bincount(layout.cell)
    excess = (cell_means(layout, (real - sim.mean(0)) ** 2 / (a + b / len(sim))) - 1) * counts
    # Where trials are few or alike but for scatter, none of them need stand out alone: the pooled cells do.
    chosen = (located.z > located.threshold)[None] & (excess > 0)
    total = float(excess[chosen].sum())
    rows = []
    for trial, k in np.argwhere(chosen):
        channel, subtask, low, high = layout.cells[k]
        rows.append({
            "trial": layout.ensembles.real[trial].trial.name,
            "channel": channel_name(layout, channel),
            "subtask": layout.ensembles.subtasks[subtask],
            "band": [float(low), float(high)],
            "share": float(excess[trial, k]) / total,
            "z": float(located.trial_z[trial, k]),
        })  # fmt: skip
    return sorted(rows, key=lambda r: -r["share"])


def effect_entry(
    given: Scene, found: EnsembleFit, ring: Ring | None, temperature: float, score: float, num_trials: int
) -> dict[str, Any]:
    """Parameters with 90 % intervals (Student's t of the trials' degrees of freedom) and evidence."""
    reach = -float(stdtrit(max(num_trials - 2, 1), 0.05))
    parameters: dict[str, Any] = {}
    rings: dict[tuple[str, int], list[tuple[float, float]]] = {}
    ringing = ""
    for k, (mine, u, jacobian) in enumerate(zip(found.slots, found.u, found.jacobian, strict=True)):
        covariance = np.linalg.inv(jacobian.T @ jacobian / temperature + np.eye(u.size))
        for slot, value, sd in zip(mine, u, np.sqrt(np.diag(covariance)), strict=True):
            mean, spread = slot.sd * float(value), slot.sd * float(sd)
            prefix = f"{slot.effect}." if len(found.effects) > 1 else ""
            each = EFFECTS[slot.effect].each
            if each == "event":
                ringing = prefix
                rings.setdefault((given.layout.ensembles.channels[k], slot.place), []).append((mean, spread))
            elif each == "subtask":
                ratio = float(np.exp(mean))
                low, high = (float(np.exp(mean + s * reach * spread)) for s in (-1, 1))
                name = f"{prefix}{given.layout.ensembles.subtasks[slot.place]}"
                parameters[name] = _entry(ratio, ratio * spread, (low, high), "1")
            else:
                channel = given.layout.ensembles.channels[k]
                own = f"unit of {channel}"
                unit = {"": own, "/s": f"{own} per s"}.get(slot.kind.unit, slot.kind.unit)
                interval = (mean - reach * spread, mean + reach * spread)
                parameters[prefix + channel] = _entry(mean, spread, interval, unit)
    if rings and ring is not None:
        amplitudes = []
        for (name, _), parts in rings.items():
            means, spreads = zip(*parts, strict=True)
            amplitudes.append((float(np.linalg.norm(means)), float(np.linalg.norm(spreads)), name))
        gain, spread, channel = max(amplitudes)
        parameters[ringing + "frequency"] = _entry(ring.frequency, ring.frequency_sd, ring.frequency_90, "Hz")
        parameters[ringing + "damping"] = _entry(ring.damping, ring.damping_sd, ring.damping_90, "1")
        interval = (max(gain - reach * spread, 0.0), gain + reach * spread)
        parameters[ringing + "gain"] = _entry(gain, spread, interval, f"unit of {channel}")
    return {
        "parameters": parameters,
        "log_evidence": found.evidence(temperature),
        "heldout_score": score,
        "property_shift": {},
    }


def _entry(mean: float, sd: float, interval: tuple[float, float], unit: str) -> dict[str, Any]:
    return {"mean": mean, "sd": sd, "interval_90": list(interval), "unit": unit}
