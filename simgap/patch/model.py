"""The virtual model of a corrected rig: trials and replays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from simgap.effects import effect_named
from simgap.effects.base import KINEMATICS, Performance
from simgap.gap.twins import carried, recorded, scene_of
from simgap.gap.twins import performed as perform
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Blocks
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
        found.t, found.motion.position, found.motion.velocity, force.reshape(n, 2, 2),
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
