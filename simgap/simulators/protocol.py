"""What the diagnosis needs of a simulator: its parameters, its channels, and runs.

A simulator is any object with `parameters`, `channels` and `simulate`; it inherits from nothing here, and
`parameters` and `channels` may hold plain dicts (`simgap.simulators.user` reads them).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from simgap.effect import Parameter
from simgap.simulators.recording import Recording

KINDS = ("position", "velocity", "force", "torque", "command")
RATE = "_rate"  # suffix of a position channel's rate in `start`

Values = Mapping[str, float]  # parameter or state name -> value
Channels = Mapping[str, np.ndarray]  # channel name -> (num_timesteps,)


@dataclass(frozen=True)
class Channel:
    """One column of the logs: `unit`, standard deviation `noise` of one sample (NaN: estimated from the
    recording), `kind` (one of KINDS). A command is given to the simulator and not compared."""

    unit: str
    kind: str
    noise: float = math.nan

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind {self.kind!r}: expected one of {', '.join(KINDS)}")
        if self.noise <= 0:
            raise ValueError(f"noise {self.noise}: expected above 0")


@dataclass(frozen=True)
class Job:
    """One run along a `recording` (a window of it) with all `parameters`, from `start` or, if None, as the
    simulator sees fit."""

    parameters: Values
    recording: Recording
    start: Values | None


@runtime_checkable
class Simulator(Protocol):
    """A model of a robot that can be run along a recording.

    `simulate` returns every channel but commands at the times `recording.t`. `start` maps each position
    channel to its value at `recording.t[0]`, and its name followed by `_rate` to its rate; None starts as the
    simulator sees fit. A simulator that takes no `start` is compared open loop.

    Optional: `state_at(recording, t)` returns state name -> (value, standard deviation) where position
    channels do not determine the state; `contacts(recording)` returns times [s] at which windows begin;
    `simulate_many(jobs)` runs several jobs at once, None for one that diverged; `numerics` names parameters
    of the solver rather than the robot; `window` [s] is how long it is run from one start, longer where
    errors of a start die out."""

    @property
    def parameters(self) -> Mapping[str, Parameter]: ...  # noqa: D102

    @property
    def channels(self) -> Mapping[str, Channel]: ...  # noqa: D102

    def simulate(self, parameters: Values, recording: Recording, start: Values | None = None) -> Channels:
        """Simulate one recording.

        Args:
            parameters: By name, in their units.
            recording: Its commands and times `t` (num_samples,) [s].
            start: By position channel its first value, and under its name with `_rate` its first rate.

        Returns:
            By name every channel but commands (num_samples,), at the recording's times.
        """
        ...


def run_all(simulator: Simulator, jobs: Sequence[Job]) -> list[Channels | None]:
    """Run all jobs; None where the simulator diverged (a value that is not finite)."""
    many = getattr(simulator, "simulate_many", None)
    if many is not None:
        return list(many(jobs))
    run = simulator.simulate
    return [
        finite(run(j.parameters, j.recording) if j.start is None else run(j.parameters, j.recording, j.start))
        for j in jobs
    ]


def finite(channels: Channels) -> Channels | None:
    """The channels, or None where any value is not finite."""
    return channels if all(np.isfinite(v).all() for v in channels.values()) else None
