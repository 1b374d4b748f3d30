"""The virtual model of a corrected rig: trials, replays, and whether it predicts better."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import segment
from simgap.effects import effect_named
from simgap.effects.base import KINEMATICS, Performance
from simgap.gap.twins import carried, recorded, scene_of
from simgap.gap.twins import performed as perform
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Blocks, read_properties
from simgap.world.replay import Replay, replay
from simgap.world.simulate import SimulatedTrial


def performed(
    task: BlockTask, rig: Rig, blocks: Sequence[Blocks], seeds: Sequence[int], operator: OperatorSettings
) -> list[SimulatedTrial]:
    """Trials by the model's own operator in the corrected scene, recorded by the corrected sensors."""
    done = perform(task, rig, blocks, seeds, rig.effects, operator)
    return [replace(s, trial=recorded(s, task, rig, rig.effects)) for s in done]


def replayed(
    trial: Trial, task: BlockTask, rig: Rig, blocks: Blocks, boundaries: Sequence[float] | np.ndarray
) -> Replay:
    """A recording's motions through the corrected model: `force` is what its sensors would have shown.

    Effects that can be are taken off the recorded angles before these drive the model. One that changes
    angles and cannot (play, jitter) cannot be taken back and is left out of the motion.
    """
    hand, around, blocks = scene_of(rig, blocks, rig.effects)
    channels = dict(trial.channels)
    for name, values in rig.effects.items():
        if (restored := effect_named(name).restored) is not None:
            channels = restored(channels, dict(values))
    moved = replace(trial, channels=channels)
    found = replay(moved, task, hand, blocks, boundaries=boundaries, surroundings=around)
    n, force = len(found.t), found.motion.force
    truth = Performance(
        found.t, found.tips, np.gradient(found.tips, found.t, axis=0), force.reshape(n, 2, 2),
        np.asarray(boundaries, float), rig, *carried(found.t, boundaries, task, blocks),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    acting = sorted((effect_named(name) for name in rig.effects), key=lambda e: -e.stage)
    for effect in acting:
        if effect.apply is not None and effect.stage != KINEMATICS:
            truth = effect.apply(truth, dict(rig.effects[effect.name]), rng)
    force = np.stack([np.interp(found.signals.t, found.t, c) for c in truth.force.reshape(n, 4).T], 1)
    for effect in acting:
        if effect.finish is not None:
            force = effect.finish(force, dict(rig.effects[effect.name]))
    return replace(found, force=force.reshape(-1, 2, 2))


def reproduced(
    written: Mapping[str, str], body: Mapping[str, Any], trials: Sequence[Trial], task: BlockTask, rig: Rig
) -> tuple[float, float]:
    """Root mean square [N] of recorded minus predicted forces, by the nominal and by the corrected model.

    Both are driven by the trials' motions; `written` are the files of `simgap.patch.files` for the diagnosis
    `body`, `rig` the nominal one. Trials that do not fit their task are left out; nan where none is left.
    """
    with tempfile.TemporaryDirectory(prefix="hmmseg-") as place:
        for name, text in written.items():
            (Path(place) / name).write_text(text, encoding="utf-8")
        patched = read_rig(Path(place) / "rig.toml")
        after = read_properties(Path(place) / "actual.toml", task)
    shift = body["effects"]["+".join(body["causes"])]["property_shift"]
    before = {n: replace(b, **_before(n, shift)) for n, b in after.items()}
    squares: list[tuple[float, float]] = []
    for trial, spans in zip(trials, segment(trials, task, rig), strict=True):
        if spans.failed is None:
            ends = [s.start for s in spans.spans[1:]]
            both = (replayed(trial, task, *model, ends) for model in ((rig, before), (patched, after)))
            nominal, corrected = (float(np.nanmean(r.residual**2)) for r in both)
            squares.append((nominal, corrected))
    if not squares:
        return float("nan"), float("nan")
    nominal, corrected = np.sqrt(np.mean(squares, axis=0))
    return float(nominal), float(corrected)


def _before(name: str, shift: Mapping[str, Any]) -> dict[str, float]:
    """A block's properties as they were without the causes."""
    return {k.partition(".")[2]: v["before"] for k, v in shift.items() if k.startswith(f"{name}.")}
