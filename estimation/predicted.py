"""Signals that the fitted model predicts for one trial, as bands for a new sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from estimation.identification import Identification
from estimation.observations import channel_values, gravity_factor
from hmmseg.contact.decompose import ABOVE_GROUND, FREE


@dataclass(frozen=True)
class PredictedSignal:
    """A recorded signal (num_timesteps,) and the central 90 % band of a new sample.

    `low`, `median`, `high` are NaN where the model predicts nothing of the signal. SI units.
    """

    name: str
    observed: np.ndarray
    low: np.ndarray
    median: np.ndarray
    high: np.ndarray


def predicted_signals(found: Identification, trial: int) -> tuple[np.ndarray, list[PredictedSignal]]:
    """Times (num_timesteps,) [s] and, of one trial, the net vertical force and finger distance."""
    weighed = found.weighed[trial]
    signals, masks = weighed.signals, weighed.masks.mean(axis=0) > 0.5
    factor = gravity_factor(signals, found.rig)
    given = signals.distance - channel_values(signals, found.rig)["distance"]
    force, distance = (np.full((2, signals.t.size), np.nan) for _ in range(2))
    for step in found.aligned.subtasks:
        inside = masks[step.index]
        obj = str(step.object)
        if step.state == ABOVE_GROUND and (obj, "weight") in found.names:
            weight = found.of(obj, "weight")
            force[0, inside] = weight.mean() * factor[inside]
            force[1, inside] = np.hypot(np.sqrt(found.noise.variance["force"]), weight.std())
        if step.state != FREE and (obj, "width") in found.names:
            width = found.of(obj, "width")
            distance[0, inside] = width.mean() + given[inside]
            distance[1, inside] = np.hypot(np.sqrt(found.noise.variance["distance"]), width.std())
    half = float(ndtri(0.95))
    return signals.t, [
        PredictedSignal(name, observed, mean - half * sd, mean, mean + half * sd)
        for name, observed, (mean, sd) in (
            ("net vertical force", signals.fy, force), ("finger distance", signals.distance, distance),
        )
    ]  # fmt: skip
