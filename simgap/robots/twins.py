"""Healthy twins: the simulator itself, with noise, along the same commands, through the same windows.

What their residuals have beyond noise (starts smoothed from samples, commands between samples, resolution)
is the comparison's own doing, and counts as noise in the recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simgap.robots.linear import Linear, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.noise import resolution
from simgap.robots.phases import Phases
from simgap.robots.whiten import covariances
from simgap.robots.windows import start_of
from simgap.simulators.protocol import Job, run_all
from simgap.simulators.recording import Recording
from simgap.simulators.user import restarts

TWINS = 6  # numerics


@dataclass(frozen=True)
class Twins:
    """`factor` (N,) by which the recording's noise grows, and each twin's whitened residuals with it."""

    factor: np.ndarray
    residuals: tuple[np.ndarray, ...]


def healthy_twins(composed: Composed, plain: Linear, phases: Phases, seed: int) -> Twins:
    """Twins at the plain point; where the simulator cannot follow the whole log, noise is as stated."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(TWINS):
        recordings = twin_recordings(composed, plain.point, rng)
        if recordings is None:
            return Twins(np.ones(plain.residual.size), ())
        twin = composed.like(recordings)
        linear = linearise(twin, plain.point, [])
        found.append(
            (
                linear,
                covariances(twin, linear).whitener()(
                    np.where(np.isfinite(linear.residual), linear.residual, 0.0)
                ),
            )
        )
    group = composed.rows.channel * len(phases.names) + phases.of(composed.rows)
    square = np.mean([white**2 for _, white in found], 0)
    ratio = np.bincount(group, square) / np.maximum(np.bincount(group), 1)
    factor = np.sqrt(np.maximum(ratio, 1.0))[group]
    return Twins(factor, tuple(white / factor for _, white in found))


def twin_recordings(composed: Composed, point: Point, rng: np.random.Generator) -> list[Recording] | None:
    """The logs as the simulator itself would have given them; None where it does not follow them."""
    out = []
    commanded = composed.commanded(point)
    parameters = composed.parameters(point)
    for log, driven in zip(composed.recordings, commanded, strict=True):
        start = None
        if restarts(composed.simulator):
            found = start_of(composed.simulator, log, 0, composed.noise, True)
            start = {n: v for n, (v, _) in found.items()}
        (channels,) = run_all(composed.simulator, [Job(parameters, driven, start)])
        if channels is None:
            return None
        channels = composed.read_whole(log, channels, point)
        columns = {}
        for name, noise in composed.noise.items():
            step = resolution(log[name])
            stated = composed.simulator.channels[name].noise
            sd = noise if step == 0 else (stated if np.isfinite(stated) and stated > step else step / 10)
            values = channels[name] + sd * rng.standard_normal(len(log))
            values = np.round(values / step) * step if step > 0 else values
            columns[name] = np.where(np.isfinite(log[name]), values, np.nan)
        out.append(log.with_columns(columns))
    return out
