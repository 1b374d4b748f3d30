"""Plain sequences of many kinds, drawn at random, with their true boundaries.

They contain the difficulties of real recordings: coloured and heavy-tailed noise, drifts, transients after
events, nearly equal states, states with unnamed phases of their own, settling after the last event, trials
cropped at their start, and uninformative channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial

CELLS = (300, 900)  # chosen: samples of a trial
STATES = (2, 10)  # chosen: of a task, fewest and most
TRIALS = (1, 8)  # chosen: fewest and most
LAG = 0.01  # chosen: share of a trial; a controller's labels have a common lag to what channels show


@dataclass(frozen=True)
class World:
    """Trials of one task and the true boundaries [s] of each."""

    task: SequenceTask
    trials: list[Trial]
    boundaries: list[np.ndarray]


def draw(seed: int, alike: float | None = None) -> World:
    """One world; `alike` is the difference of neighbouring states in standard deviations of the noise."""
    rng = np.random.default_rng(seed)
    num_states = int(rng.integers(STATES[0], STATES[1] + 1))
    num_trials = int(rng.integers(TRIALS[0], TRIALS[1] + 1))
    num_channels = int(rng.integers(1, 7))
    means = rng.lognormal(0.0, rng.uniform(0.3, 1.3), num_states)  # some states take long, some are brief
    total = float(rng.integers(*CELLS))
    rate = float(rng.choice([20.0, 50.0, 100.0, 200.0]))
    means *= total / rate / means.sum()
    contrast = rng.lognormal(np.log(3.0), 0.8) if alike is None else alike
    informative = rng.random(num_channels) < 0.8
    informative[rng.integers(num_channels)] = True
    phases = [_phases(rng) for _ in range(num_states)]
    levels = [
        [informative * contrast * rng.standard_t(4, num_channels) / np.sqrt(2) for _ in shares]
        for shares in phases
    ]
    for k, shares in enumerate(phases):  # phases of one state differ less than states do
        for i in range(1, len(shares)):
            levels[k][i] = levels[k][0] + rng.uniform(0.1, 0.8) * (levels[k][i] - levels[k][0])
    if rng.random() < 0.5:  # after the last event something settles, which nobody named
        share = rng.uniform(0.2, 0.7)
        phases[-1] = np.r_[share * phases[-1], 1 - share]
        levels[-1].append(informative * contrast * rng.standard_t(4, num_channels) / np.sqrt(2))
    slopes = informative * contrast * rng.normal(0, rng.choice([0.0, 0.5, 1.0]), (num_states, num_channels))
    noise = {
        "colour": rng.choice([0.0, rng.uniform(0.3, 0.98)]), "tail": rng.choice([3.0, 30.0]),
        "state": np.exp(rng.normal(0, rng.choice([0.0, 0.5]), (num_states, num_channels))),
        "wander": rng.choice([0.0, rng.uniform(0, 1.0)]), "rounding": rng.choice([0.0, 0.1]),
    }  # fmt: skip
    settle = rng.choice([0.0, rng.uniform(0.003, 0.05)])  # of a trial: first-order response after a change
    pace, crop = rng.uniform(0.03, 0.4), rng.choice([0.0, 0.9])
    lag = rng.choice([0.0, LAG]) * means.sum() * rng.normal(size=num_states - 1)
    trials, boundaries = [], []
    for i in range(num_trials):
        durations = means * rng.lognormal(0, pace, num_states)
        t0 = crop * rng.random() * durations[0]
        ends = np.cumsum(durations)
        t = np.arange(t0, ends[-1], 1 / rate)
        values = _course(rng, t, ends, phases, levels, slopes, noise, settle * means.sum())
        trials.append(Trial(f"trial_{i}.csv", t - t0, {f"c{c}": values[:, c] for c in range(num_channels)}))
        recorded = durations - t0 * (np.arange(num_states) == 0)
        room = recorded / 3
        boundaries.append(ends[:-1] - t0 + np.clip(lag, -room[:-1], room[1:]))
    return World(SequenceTask(tuple(f"s{k}" for k in range(num_states))), trials, boundaries)


def abrupt(seed: int) -> World:
    """Levels that jump between two samples, with white noise; one state is brief."""
    rng = np.random.default_rng(seed)
    num_states, num_trials, num_channels = (int(rng.integers(*ends)) for ends in ((3, 7), (1, 5), (1, 4)))
    rate, sd = float(rng.choice([50.0, 100.0, 200.0])), rng.choice([0.02, 0.05, 0.15, 0.3])
    steps = rng.normal(size=(num_states, num_channels))
    steps *= rng.uniform(1, 3, (num_states, 1)) / np.linalg.norm(steps, axis=1, keepdims=True)
    levels, means = steps.cumsum(axis=0), rng.uniform(0.5, 3.0, num_states)
    means[rng.integers(1, num_states - 1)] = rng.uniform(0.08, 0.25)
    trials, boundaries = [], []
    for i in range(num_trials):
        ends = np.cumsum(means * rng.lognormal(0, 0.15, num_states))
        t = np.arange(0, ends[-1], 1 / rate)
        state = np.minimum(np.searchsorted(ends, t, side="right"), num_states - 1)
        values = levels[state] + sd * rng.normal(size=(t.size, num_channels))
        trials.append(Trial(f"trial_{i}.csv", t, {f"c{c}": values[:, c] for c in range(num_channels)}))
        boundaries.append(ends[:-1])
    return World(SequenceTask(tuple(f"s{k}" for k in range(num_states))), trials, boundaries)


def _phases(rng: np.random.Generator) -> np.ndarray:
    """Shares of a state's duration for its phases; mostly one."""
    return rng.dirichlet(np.full(rng.choice([1, 2, 3], p=[0.5, 0.3, 0.2]), 3.0))


def _course(rng, t, ends, phases, levels, slopes, noise, settle) -> np.ndarray:
    starts = np.r_[0.0, ends[:-1]]
    state = np.minimum(np.searchsorted(ends, t, side="right"), len(ends) - 1)
    into = (t - starts[state]) / (ends - starts)[state]
    values = np.zeros((t.size, slopes.shape[1]))
    for k, shares in enumerate(phases):
        inside = state == k
        phase = np.minimum(np.searchsorted(np.cumsum(shares), into[inside], side="right"), len(shares) - 1)
        values[inside] = np.array(levels[k])[phase] + slopes[k] * (into[inside, None] - 0.5)
    if settle > 0:
        keep = np.exp(-(t[1] - t[0]) / settle)
        values = lfilter([1 - keep], [1, -keep], values, axis=0, zi=keep * values[:1])[0]
    white = rng.standard_t(noise["tail"], values.shape) * np.sqrt(1 - 2 / noise["tail"])
    a = noise["colour"]
    coloured = lfilter([np.sqrt(1 - a * a)], [1, -a], white, axis=0)
    wander = noise["wander"] * np.cumsum(rng.normal(size=values.shape), 0) / np.sqrt(t.size)
    values = (
        values
        + coloured * noise["state"][state]
        + wander
        + 0.3 * noise["wander"] * rng.normal(size=values.shape[1])
    )
    if noise["rounding"]:
        values = np.round(values / noise["rounding"]) * noise["rounding"]
    return values
