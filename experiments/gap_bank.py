"""The bank that the diagnosis is calibrated on: healthy and affected recordings of our own simulator.

    python -m experiments.gap_bank RECORDINGS/CASE [--folder results/gap_bank]

CASE gives the nominal rig.toml and task.toml; its recordings are not read. Writes
simgap/gap/bank.json: noise model, detection thresholds, calibration.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hmmseg import jaxconfig  # noqa: F401  (double precision before any array)
from hmmseg.rig import Rig, read_rig
from hmmseg.segmentation import align_trials
from hmmseg.signals import task_space
from hmmseg.task import BlockTask, read_task
from hmmseg.trial import Trial
from simgap.effects import catalogue
from simgap.gap import bank as store
from simgap.gap import judge
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.fit import Start, fit, neutral, problem, raw_residual_at, residual_at
from simgap.gap.frame import Frame, build
from simgap.gap.judge import Calibration
from simgap.gap.locate import Detection, cells, largest
from simgap.gap.noise import NoiseModel, learn
from simgap.gap.spread import spreads
from simgap.gap.synthetic import performed, recorded
from simgap.properties import random_properties

TRIALS = 4
BRUSHED = 1.3  # times the usual mean square: above it a finger brushed a neighbouring block


class Case(NamedTuple):
    """A simulated case: its effects' values and its trials."""

    effects: dict[str, dict[str, float]]
    trials: list[Trial]


def healthy_cases(task: BlockTask, rig: Rig, number: int) -> list[Case]:
    """Healthy cases, TRIALS each, blocks drawn anew for every case."""
    blocks = [random_properties(task, 1000 + k) for k in range(number)]
    seeds = [100_000 + k for k in range(TRIALS * number)]
    every = performed(task, rig, [b for b in blocks for _ in range(TRIALS)], seeds, {})
    trials = [recorded(s, task, rig, {}) for s in every]
    return [Case({}, trials[k : k + TRIALS]) for k in range(0, len(trials), TRIALS)]


def frames(cases: Sequence[Case], task: BlockTask, rig: Rig) -> list[Frame]:
    """Aligned frames of the cases."""
    out = []
    for case in cases:
        signals = [task_space(t, rig) for t in case.trials]
        aligned = align_trials([t.file for t in case.trials], signals, task, rig)
        out.append(build(case.trials, aligned, rig))
    return out


def noise_model(given: Sequence[Frame]) -> tuple[NoiseModel, list[Frame]]:
    """Noise model, and the frames it was learned on: those whose fingers touched nothing else."""
    samples, size = [], []
    for frame in given:
        task = problem(frame, NoiseModel.plain())
        found = fit(task, [Start((), neutral(task))])[0]
        size.append(found.square.sum() / task.size)
        samples.append((frame, raw_residual_at(task, (), found.u)))
    clean = [k for k, value in enumerate(size) if value < BRUSHED * np.median(size)]
    return learn([samples[k] for k in clean]), [given[k] for k in clean]


def detection(given: Sequence[Frame], noise: NoiseModel, catalogued: int) -> tuple[Detection, float]:
    """Distribution of the largest statistics of healthy frames, and the healthy mean square.

    The whole catalogue is fitted to the first `catalogued` frames for the largest evidence.
    """
    rows, floors, gains = [], [], []
    for k, frame in enumerate(given):
        task = problem(frame, noise)
        found = fit(task, [Start((), neutral(task))])[0]
        rows.append(list(largest(cells(task, residual_at(task, (), found.u))).values()))
        floors.append(found.square.sum() / task.size)
        if k < catalogued:
            names = [n for n, e in catalogue().items() if e.chosen]
            fits = best_fits(task, [(n,) for n in deterministic(names)], found)
            scores = {
                f.effects[0]: judge.log_evidence(task, f, found, Calibration().temperature) for f in fits
            }
            scores |= {s.effect: s.evidence / Calibration().temperature for s in spreads(task, found)}
            best = max(scores, key=lambda n: scores[n])
            gains.append(scores[best])
            print(
                k, "best of the catalogue:", best, round(scores[best], 2), np.round(rows[-1], 2), flush=True
            )
    cell, pooled = (_gumbel(np.array(column)) for column in zip(*rows, strict=True))
    return Detection(cell, pooled, _gumbel(np.array(gains))), float(np.mean(floors))


def _gumbel(values: np.ndarray) -> tuple[float, float]:
    """Location and scale of a Gumbel distribution by quartiles: a brushed block in one case is no rule."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    scale = max(float(high - low) / (np.log(np.log(4)) - np.log(np.log(4 / 3))), 0.3)
    return round(float(middle + scale * np.log(np.log(2))), 3), round(float(scale), 3)


def main(args: Sequence[str] | None = None) -> int:
    """Simulate, learn, write the bank."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("--folder", type=Path, default=Path("results/gap_bank"))
    parser.add_argument("--healthy", type=int, default=24)
    parser.add_argument("--catalogued", type=int, default=12)
    given = parser.parse_args(args)
    rig, task = read_rig(given.case / "rig.toml"), read_task(given.case / "task.toml")
    if not isinstance(task, BlockTask):
        raise SystemExit("a task of blocks is needed")
    given.folder.mkdir(parents=True, exist_ok=True)
    file = given.folder / f"healthy_{given.healthy}.pkl"
    if not file.exists():
        file.write_bytes(pickle.dumps(healthy_cases(task, rig, given.healthy)))
    noise, clean = noise_model(frames(pickle.loads(file.read_bytes()), task, rig))
    found, floor = detection(clean, noise, given.catalogued)
    bank = store.Bank(noise, found, Calibration(floor=round(floor, 4)))
    store.FILE.write_text(bank.to_json(), encoding="utf-8")
    print(f"{len(clean)} healthy cases; {found}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
