"""Noise model and detection thresholds learned on simulated healthy recordings of a rig and task."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import align
from simgap.effects import catalogue
from simgap.gap import judge
from simgap.gap.adapt import fingerprint
from simgap.gap.bank import Bank, Reference
from simgap.gap.bootstrap import TAIL, distribution, gumbel, statistics
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.fit import Fitted, Problem, Start, fit, neutral, problem, raw_residual_at, residual_at
from simgap.gap.frame import Frame, build
from simgap.gap.judge import Calibration
from simgap.gap.locate import Detection, raised
from simgap.gap.noise import NoiseModel, learn
from simgap.gap.spread import spreads
from simgap.gap.synthetic import performed, recorded
from simgap.world.operator import OperatorSettings
from simgap.world.properties import random_properties

HEALTHY, CATALOGUED = 24, 12  # cases, and those of them that the whole catalogue is fitted to
BATCH = 4  # cases that are simulated at once
BRUSHED = 1.3  # times the usual mean square: above it a finger brushed a neighbouring block
ENOUGH = 0.5  # share of the cases that must fit their task
Progress = Callable[[str], None]


def steps(healthy: int = HEALTHY) -> int:
    """How often `learned` tells of progress, at most."""
    return -(-healthy // BATCH) + 2 * healthy


def learned(
    task: BlockTask,
    rig: Rig,
    trials: int,
    calibration: Calibration,
    tell: Progress,
    healthy: int = HEALTHY,
    catalogued: int = CATALOGUED,
) -> Bank:
    """The bank of a rig and task from `healthy` simulated cases of so many trials, without a reference.

    `calibration` is kept except for the floor. InputError where the rig cannot make these moves or most
    cases do not fit their task.
    """
    noise, clean = noise_model(frames(healthy_cases(task, rig, trials, healthy, tell), task, rig, tell))
    fits = [fitted(frame, noise) for frame in clean]
    found, floor = detection(fits, catalogued, tell)
    return Bank(noise, found, replace(calibration, floor=round(floor, 4)))


def healthy_cases(
    task: BlockTask,
    rig: Rig,
    trials: int,
    number: int,
    tell: Progress,
    first: int = 0,
    operator: OperatorSettings | None = None,
) -> list[list[Trial]]:
    """Healthy cases of so many trials each, from the `first` on; blocks are drawn anew for every case."""
    out: list[list[Trial]] = []
    for start in range(first, first + number, BATCH):
        batch = range(start, min(start + BATCH, first + number))
        blocks = [random_properties(task, 1000 + k) for k in batch for _ in range(trials)]
        seeds = [100_000 + trials * k + j for k in batch for j in range(trials)]
        every = [recorded(s, task, rig, {}) for s in performed(task, rig, blocks, seeds, {}, operator)]
        out += [every[k : k + trials] for k in range(0, len(every), trials)]
        tell(f"{len(out)} of {number} healthy cases simulated")
    return out


def frames(cases: Sequence[Sequence[Trial]], task: BlockTask, rig: Rig, tell: Progress) -> list[Frame]:
    """Aligned frames of the cases all of whose trials fit their task; InputError where most do not."""
    out = []
    for k, trials in enumerate(cases, 1):
        aligned = align(trials, task, rig)
        if all(a.segmentation.complete for a in aligned.trials):
            out.append(build(trials, aligned, rig))
        tell(f"{k} of {len(cases)} cases aligned")
    if len(out) < ENOUGH * len(cases):
        raise InputError(
            "simulated healthy recordings of this rig", f"{len(out)} of {len(cases)} cases fit their task",
            "half of them at least",
        )  # fmt: skip
    return out


def fitted(frame: Frame, noise: NoiseModel) -> tuple[Problem, Fitted]:
    """A frame's problem and the fit of properties alone."""
    given = problem(frame, noise)
    return given, fit(given, [Start((), neutral(given))])[0]


def noise_model(given: Sequence[Frame]) -> tuple[NoiseModel, list[Frame]]:
    """Noise model, and the frames it was learned on: those whose fingers touched nothing else."""
    samples, size = [], []
    for frame in given:
        task, found = fitted(frame, NoiseModel.plain())
        size.append(found.square.sum() / task.size)
        samples.append((frame, raw_residual_at(task, (), found.u)))
    clean = [k for k, value in enumerate(size) if value < BRUSHED * np.median(size)]
    return learn([samples[k] for k in clean]), [given[k] for k in clean]


def detection(
    given: Sequence[tuple[Problem, Fitted]], catalogued: int, tell: Progress
) -> tuple[Detection, float]:
    """Distribution of the largest statistics of healthy fits, and the healthy mean square.

    The whole catalogue is fitted to the first `catalogued` for the largest evidence.
    """
    rows, floors, gains = [], [], []
    for k, (task, found) in enumerate(given):
        rows.append(list(raised(task, residual_at(task, (), found.u)).values()))
        floors.append(found.square.sum() / task.size)
        best = ""
        if k < catalogued:
            names = [n for n, e in catalogue().items() if e.chosen]
            fits = best_fits(task, [(n,) for n in deterministic(names)], found)
            scores = {
                f.effects[0]: judge.log_evidence(task, f, found, Calibration().temperature) for f in fits
            }
            scores |= {s.effect: s.evidence / Calibration().temperature for s in spreads(task, found)}
            leading = max(scores, key=lambda n: scores[n])
            gains.append(scores[leading])
            best = f", best of the catalogue: {leading} {scores[leading]:.2f}"
        tell(f"case {k + 1}: largest scores {np.round(rows[-1], 2)}{best}")
    cell, pooled, coherent = (gumbel(np.array(column)) for column in zip(*rows, strict=True))
    return Detection(cell, pooled, coherent, gumbel(np.array(gains), TAIL)), float(np.mean(floors))


def reference(given: Sequence[tuple[Problem, Fitted]], rate: float) -> Reference:
    """What healthy fits such as these are known by, recorded at `rate` [Hz], and their bootstrap pooled."""
    drawn = [statistics(*one, seed=k) for k, one in enumerate(given)]
    together = {name: np.concatenate([d[name] for d in drawn]) for name in drawn[0]}
    frame = given[0][0].frame
    mark = fingerprint(frame.task, frame.rig, rate, frame.num_trials)
    return Reference(mark, frame.world.t.shape[1], distribution(together))
