"""Scores of segmentations and property estimates against what is true."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmmseg.contact.decompose import PROPERTIES, Subtask
from hmmseg.segmentation.spans import Segmentation


def boundary_residuals(segmentation: Segmentation, truth: Sequence[float]) -> np.ndarray:
    """Boundary times minus the true ones (num_boundaries,) [s]; all NaN if spans are missing."""
    starts = [span.start for span in segmentation.spans[1:]]
    if len(starts) != len(truth):
        return np.full(len(truth), np.nan)
    return np.subtract(starts, truth)


def boundaries_covered(segmentation: Segmentation, truth: Sequence[float]) -> np.ndarray:
    """Whether each 90 % interval contains the true boundary, 1 or 0; all NaN if spans are missing."""
    intervals = [span.start_90 for span in segmentation.spans[1:]]
    if len(intervals) != len(truth):
        return np.full(len(truth), np.nan)
    return np.array([float(low <= time <= high) for (low, high), time in zip(intervals, truth, strict=True)])


def state_accuracy(
    segmentation: Segmentation, truth: Sequence[float], t: np.ndarray, steps: Sequence[Subtask]
) -> float:
    """Share of the samples at t (num_timesteps,) [s] whose contact state is the true one."""
    true = np.array([step.state for step in steps])[np.searchsorted(truth, t, side="right")]
    if not segmentation.spans:
        return 0.0
    found = np.array([span.state for span in segmentation.spans])
    starts = [span.start for span in segmentation.spans[1:]]
    return float(np.mean(found[np.searchsorted(starts, t, side="right")] == true))


def property_scores(properties: dict, blocks: dict[str, dict[str, tuple[float, float]]]) -> list[dict]:
    """Each property of a JSON `properties` against its true value.

    Per entry: object, property, relative `residual` (None where the estimate is null) and whether
    `interval_68` and `interval_95` hold the true value.
    """
    scores = []
    for name, known in blocks.items():
        for key in PROPERTIES:
            if key not in known:
                continue
            value, estimate = known[key][0], properties.get(name, {}).get(key)
            score = {"object": name, "property": key, "residual": None, "in_68": None, "in_95": None}
            if estimate is not None:
                score["residual"] = float(estimate["mean"] / value - 1)
                for percent in (68, 95):
                    low, high = estimate[f"interval_{percent}"]
                    score[f"in_{percent}"] = bool(low <= value <= high)
            scores.append(score)
    return scores


def summarise_boundaries(residuals: np.ndarray, covered: np.ndarray) -> dict:
    """Median and 95th percentile of |residual| [s] and coverage, ignoring NaN."""
    there = np.isfinite(residuals)
    if not there.any():
        return {"median": None, "percentile_95": None, "coverage_90": None}
    size = np.abs(residuals[there])
    return {
        "median": float(np.median(size)),
        "percentile_95": float(np.percentile(size, 95)),
        "coverage_90": float(np.mean(covered[there])),
    }


def summarise_properties(scores: Sequence[dict]) -> dict:
    """Per property: rms relative residual, coverage of both intervals, number scored and nulls."""
    summary = {}
    for key in PROPERTIES:
        mine = [s for s in scores if s["property"] == key]
        there = [s for s in mine if s["residual"] is not None]
        summary[key] = {"count": len(there), "null": len(mine) - len(there)}
        if there:
            summary[key]["rms"] = float(np.sqrt(np.mean([s["residual"] ** 2 for s in there])))
            for percent in (68, 95):
                summary[key][f"coverage_{percent}"] = float(np.mean([s[f"in_{percent}"] for s in there]))
    return summary
