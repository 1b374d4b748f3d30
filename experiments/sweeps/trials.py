"""Trials of a cell: performed by the virtual model's operator, then recorded as the cell has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.sweeps.cells import Cell
from hmmseg.io.rig import Noise, Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.io.trial import Trial
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Block, random_properties
from simgap.world.simulate import simulate_trials

HERE = Path(__file__).parent
FORCES = ("fx1", "fy1", "fx2", "fy2")
RINGING = (15.0, 35.0)  # Hz, a fingertip on its arm; drawn once a trial
DAMPING = 0.05  # ratio to critical
GRASP_SPREAD = 0.0005  # m; the operator's own scatter about the cell's grip height


@dataclass(frozen=True)
class Recorded:
    """One trial of a cell with its truth: boundaries [s] and blocks by name."""

    number: int
    trial: Trial
    boundaries: np.ndarray
    blocks: dict[str, Block]


def scene() -> tuple[Rig, BlockTask]:
    """The usual hand and task: two stacked blocks are reversed, as in the paper."""
    task = read_task(HERE / "task.toml")
    assert isinstance(task, BlockTask)
    return read_rig(HERE / "rig.toml"), task


def recording_rig(cell: Cell, rig: Rig) -> Rig:
    """The hand that records: the cell's rate and true noise."""
    scaled = {name: sd * cell.noise for name, sd in rig.noise.model_dump(exclude_none=True).items()}
    return rig.model_copy(update={"rate": cell.rate, "noise": Noise(**scaled)})


def stated_rig(cell: Cell, rig: Rig) -> Rig:
    """What the estimators are told: as it records, or without a word on noise."""
    recording = recording_rig(cell, rig)
    return recording if cell.stated else recording.model_copy(update={"noise": Noise()})


def record_cell(cell: Cell, numbers: Sequence[int], rig: Rig, task: BlockTask) -> list[Recorded]:
    """Trials of a cell by their numbers; a number gives the same trial in any order and company."""
    grasp = (cell.grasp - GRASP_SPREAD, cell.grasp + GRASP_SPREAD)
    operator = OperatorSettings(pace=(cell.pace, cell.pace), grasp=grasp)
    blocks = [random_properties(task, number) for number in numbers]
    simulated = simulate_trials(task, recording_rig(cell, rig), blocks, list(numbers), operator)
    return [
        Recorded(number, disturbed(s.trial, s.boundaries, cell, number), s.boundaries, b)
        for s, number, b in zip(simulated, numbers, blocks, strict=True)
    ]


def disturbed(trial: Trial, boundaries: np.ndarray, cell: Cell, number: int) -> Trial:
    """The trial with ringing contacts and lost values, as its cell has them."""
    channels = dict(trial.channels)
    if cell.vibration > 0:
        rng = np.random.default_rng([number, 3])
        frequency = rng.uniform(*RINGING)
        for name in FORCES:
            signs = rng.choice([-1.0, 1.0], boundaries.size)
            channels[name] = channels[name] + cell.vibration * ringing(trial.t, boundaries, frequency, signs)
    if cell.missing > 0:
        rng = np.random.default_rng([number, 4])
        for name, values in channels.items():
            channels[name] = np.where(rng.random(values.size) < cell.missing, np.nan, values)
    return replace(trial, channels=channels)


def ringing(t: np.ndarray, at: np.ndarray, frequency: float, signs: np.ndarray) -> np.ndarray:
    """Sum of unit impulse responses exp(-z w s) sin(w s) of a lightly damped mode, one from each time."""
    omega = 2 * np.pi * frequency
    since = t[:, None] - at[np.isfinite(at)]
    wave = np.exp(-DAMPING * omega * np.maximum(since, 0)) * np.sin(omega * since)
    return np.where(since > 0, wave, 0.0) @ signs[np.isfinite(at)]


def interpolated(trial: Trial) -> Trial:
    """The trial with lost values filled in, linear between their neighbours."""
    filled = {}
    for name, values in trial.channels.items():
        there = np.isfinite(values)
        filled[name] = np.interp(trial.t, trial.t[there], values[there])
    return replace(trial, channels=filled)
