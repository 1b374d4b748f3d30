"""Synthetic ensembles of a plain ordered task with known effects, for tests of the generic diagnosis.

Two channels, three subtasks; contacts change within a tenth of a second at whatever pace. Trials scatter
in pace, size and offset. Effects are put into channel `fa` in the time domain, not through the
diagnosis's own predictions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from simgap.channels import at_rest
from simgap.channels.sensors import LOWPASS
from simgap.generic.trials import Ensembles, align

TASK = SequenceTask(("approach", "press", "hold"))
DURATIONS = (1.5, 2.0, 1.2)  # prior: s
PACE = 0.05  # prior: sd of a log duration
TRIALS = 6  # of each kind in a case
Values = Mapping[str, Mapping[str, float]]  # effect -> parameter -> value


@dataclass(frozen=True)
class Scatter:
    """How trials differ: relative size, offset and white noise (standard deviations); rate [Hz]."""

    size: float = 0.05
    offset: float = 0.05
    noise: float = 0.02
    rate: float = 100.0


PLANTED: dict[str, dict[str, float]] = {
    "force_bias": {"value": 0.3},
    "force_gain": {"value": 0.4},
    "force_drift": {"value": 0.1},
    "force_lag": {"value": 0.08},
    "force_lowpass": {"value": 0.1},
    "structural_vibration": {"frequency": 7.5, "damping": 0.05, "gain": 0.3},
    "noise_level": {"value": 0.05},
    "timing": {"value": 1.3},
}  # prior


def ensemble(
    rng: np.random.Generator, count: int, effects: Values | None = None, scatter: Scatter | None = None,
    name: str = "real",
) -> tuple[list[Trial], dict[str, np.ndarray]]:  # fmt: skip
    """Trials and their true boundaries [s] by file. `timing` stretches the second subtask."""
    effects, trials, boundaries = effects or {}, [], {}
    for k in range(count):
        trial, edges = _trial(rng, effects, scatter or Scatter(), f"{name}_{k:02d}.csv")
        trials.append(trial)
        boundaries[trial.file] = edges[1:-1]
    return trials, boundaries


def made(seed: int, effects: Values | None, aligned: bool) -> Ensembles:
    """A case of TRIALS real and as many simulated trials, cut into subtasks: at boundaries that the HMM finds
    where `aligned`, else at the true ones.
    """
    rng = np.random.default_rng(seed)
    real, first = ensemble(rng, TRIALS, effects)
    sim, second = ensemble(rng, TRIALS, None, name="sim")
    return align(real, sim, TASK, None, None if aligned else first | second)


def _trial(rng, effects: Values, s: Scatter, file: str) -> tuple[Trial, np.ndarray]:
    duration = np.array(DURATIONS) * np.exp(PACE * rng.standard_normal(len(DURATIONS)))
    duration[1] *= effects.get("timing", {}).get("value", 1.0)
    edges = np.concatenate([[0.0], np.cumsum(duration)])
    t = np.arange(0, edges[-1], 1 / s.rate)
    size, offset = 1 + s.size * rng.standard_normal(2), s.offset * rng.standard_normal(2)
    _, a, b, end = edges

    def course(t: np.ndarray) -> np.ndarray:
        fa = np.interp(t, [0, a, a + 0.1, b, b + 0.1, end], [0.0, 0.0, 2.0, 1.5, -1.0, -0.5])
        fb = np.interp(t, [0, a, a + 0.3, b, b + 0.2, end], [0.2, 0.5, -0.5, -0.5, 1.0, 1.0])
        return np.array([fa, fb]) * size[:, None] + offset[:, None]

    def given(effect: str, key: str = "value") -> float:
        return effects.get(effect, {}).get(key, 0.0)

    fa, fb = course(t)
    fa = course(t - given("force_lag"))[0]
    if "force_lowpass" in effects:
        fa = at_rest(LOWPASS.read, t, fa, {"time_constant": given("force_lowpass")})
    fa = (1 + given("force_gain")) * fa + given("force_bias") + given("force_drift") * t
    omega = 2 * np.pi * given("structural_vibration", "frequency")
    for event in (a, b):
        since = np.maximum(t - event, 0.0)
        decay = np.exp(-given("structural_vibration", "damping") * omega * since)
        fa = fa + given("structural_vibration", "gain") * decay * np.sin(omega * since)
    noise = rng.standard_normal((3, t.size))
    fa = fa + s.noise * noise[0] + given("noise_level") * noise[1]
    return Trial(file, t, {"fa": fa, "fb": fb + s.noise * noise[2]}), edges
