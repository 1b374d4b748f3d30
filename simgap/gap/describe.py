"""A candidate in words of the interface: parameters, evidence, property shifts; and where the gap lies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from simgap.effects import catalogue
from simgap.gap import judge
from simgap.gap.affected import shifts
from simgap.gap.candidate import Candidate
from simgap.gap.fit import Fitted, Problem, slots
from simgap.gap.frame import CHANNELS
from simgap.gap.judge import Calibration
from simgap.gap.locate import BANDS, Cell, normal_score, subtask_name
from simgap.gap.shrinkage import folds_of

PROPERTIES = ("weight", "width", "height")
UNITS = {"weight": "N", "width": "m", "height": "m"}
DRAWS = 400
AFFECTED = 3.0  # sds of one sample: mean shift of a cell that is listed for it


def describe(
    given: Problem, candidate: Candidate, healthy: Fitted, calibration: Calibration, seed: int
) -> dict[str, Any]:
    """Parameters, evidence, held-out score and property shifts of one candidate."""
    f = candidate.fitted
    draws = _draws(given, candidate, seed)
    column = {int(c): k for k, c in enumerate(f.columns)}
    parameters: dict[str, Any] = {}
    for slot in slots(given.num_properties)[0]:
        if slot.effect.name not in f.effects:
            continue
        own = {
            p.name: np.asarray(p.value(draws[:, column[slot.start + j]]))
            for j, p in enumerate(slot.effect.parameters)
        }
        named = {p.name: (own[p.name], p.unit) for p in slot.effect.parameters if not p.hidden}
        if slot.effect.report is not None:
            named = slot.effect.report(own, given.frame.rig)
        prefix = "" if len(candidate.effects) == 1 else f"{slot.effect.name}."
        for name, (values, unit) in named.items():
            parameters[prefix + name] = _parameter(values, unit, slot.effect.name, calibration)
    if candidate.spread is not None:
        s = candidate.spread
        p = catalogue()[s.effect].parameters[0]
        rng = np.random.default_rng(seed)
        prefix = "" if len(candidate.effects) == 1 else f"{s.effect}."
        values = s.value * np.exp(s.log_sd * rng.standard_normal(DRAWS))
        parameters[prefix + p.name] = _parameter(values, p.unit, s.effect, calibration)
    return {
        "parameters": parameters,
        "log_evidence": candidate.evidence,
        "heldout_score": judge.heldout_gain(given, f, healthy, folds_of(given, f)),
        "property_shift": _shifts(given, healthy, f),
    }


def _parameter(values: np.ndarray, unit: str, effect: str, calibration: Calibration) -> dict[str, Any]:
    """Summary of draws, widened by how far the effect's form is usually off."""
    centre, sd = float(np.mean(values)), float(np.std(values))
    wide = calibration.inflated(effect, sd, centre)
    low, high = centre + (np.percentile(values, (5, 95)) - centre) * wide / max(sd, 1e-300)
    return {"mean": centre, "sd": wide, "interval_90": [float(low), float(high)], "unit": unit}


def _draws(given: Problem, candidate: Candidate, seed: int) -> np.ndarray:
    """Draws (DRAWS, columns) of the fitted coordinates, tempered as the fit is imperfect."""
    f = candidate.fitted
    temperature = max(1.0, 2 * f.cost / given.size)
    covariance = np.linalg.inv(f.hessian.sum((0, 1)) / temperature + np.eye(f.columns.size))
    rng = np.random.default_rng(seed)
    return f.u[f.columns] + rng.multivariate_normal(
        np.zeros(f.columns.size), covariance, DRAWS, method="cholesky"
    )


def property_values(given: Problem, found: Fitted) -> np.ndarray:
    """Fitted properties (objects, 3): weight [N], width, height [m]."""
    return given.centre + given.spread * found.u[: given.num_properties].reshape(-1, 3)


def _shifts(given: Problem, healthy: Fitted, f: Fitted) -> dict[str, dict]:
    before, after = property_values(given, healthy), property_values(given, f)
    told = np.abs(f.hessian.sum((0, 1)).diagonal()[: given.num_properties]).reshape(-1, 3) > 1.0
    return {
        f"{name}.{prop}": {"before": float(before[o, k]), "after": float(after[o, k]), "unit": UNITS[prop]}
        for o, name in enumerate(given.frame.task.objects)
        for k, prop in enumerate(PROPERTIES)
        if told[o, k]
    }


def where(
    given: Problem, found: Sequence[Cell], threshold: float, candidate: Candidate | None
) -> list[dict[str, Any]]:
    """Significant cells, largest share of the excess first.

    Where the cause is named they are the cells whose mean it shifts by AFFECTED sds of a sample; where it
    shifts none so far, those above the threshold of the channel and subtask with the largest excess. With no
    cause named they are all those above the threshold. Shares are of what the model leaves in them: a shift
    that the properties absorb has none.
    """
    rows: dict[tuple, tuple[float, float]] = {}  # trial, channel, subtask, band -> excess, z
    lowest = {(k.trial, k.channel, k.subtask): k for k in found if k.band[0] == 0.0}
    mean = np.zeros((0, 0, 0)) if candidate is None else shifts(given, candidate)
    for r, s, c in np.argwhere(mean >= AFFECTED):
        cell, shift = lowest.get((r, CHANNELS[c], s)), float(mean[r, s, c])
        count = int((given.frame.arrays.subtask[r, : given.frame.lengths[r]] == s).sum())
        band = (0.0, BANDS[1]) if cell is None else cell.band
        excess = 0.0 if cell is None else max(cell.energy - cell.count, 0.0)
        rows[int(r), CHANNELS[c], int(s), band] = excess, float(normal_score(count * (1 + shift**2), count))
    if not rows:
        loud = [k for k in found if k.z > threshold]
        most = _loudest(loud) if candidate is not None else None
        for k in loud:
            if most in (None, (k.channel, k.subtask)):
                rows[k.trial, k.channel, k.subtask, k.band] = max(k.energy - k.count, 0.0), k.z
    ranked = sorted(rows.items(), key=lambda row: (-row[1][0], -row[1][1]))
    total = max(sum(excess for excess, _ in rows.values()), 1e-12)
    return [
        {
            "trial": given.frame.files[r], "channel": channel, "subtask": subtask_name(given.frame.steps[s]),
            "band": list(band), "share": excess / total, "z": z,
        }
        for (r, channel, s, band), (excess, z) in ranked
    ]  # fmt: skip


def _loudest(found: Sequence[Cell]) -> tuple[str, int] | None:
    """Channel and subtask with the largest excess over all trials and bands; None where there is none."""
    total: dict[tuple[str, int], float] = {}
    for k in found:
        total[k.channel, k.subtask] = total.get((k.channel, k.subtask), 0.0) + k.energy - k.count
    return max(total, key=lambda at: total[at]) if total else None
