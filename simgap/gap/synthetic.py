"""Simulated recordings with known effects: what the diagnosis is calibrated on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from simgap.effects import effect_named
from simgap.effects.base import Performance
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Blocks
from simgap.world.scene import Surroundings
from simgap.world.sensors import record
from simgap.world.simulate import SimulatedTrial, simulate_trials

Values = Mapping[str, Mapping[str, float]]  # effect -> parameter -> value


def performed(
    task: BlockTask,
    rig: Rig,
    blocks: Sequence[Blocks],
    seeds: Sequence[int],
    effects: Values,
    operator: OperatorSettings | None = None,
) -> list[SimulatedTrial]:
    """Simulated trials in a scene changed by those effects that change scenes (one scene for all)."""
    hand, around, _ = scene_of(rig, {}, effects)
    blocks = [scene_of(rig, each, effects)[2] for each in blocks]
    for grip in (effect_named(name).grip for name in effects):
        if grip is not None:
            operator = operator or OperatorSettings(grip=grip)
    return simulate_trials(task, hand, blocks, seeds, operator, around)


def scene_of(rig: Rig, blocks: Blocks, effects: Values) -> tuple[Rig, Surroundings, Blocks]:
    """Hand, surroundings and blocks as those effects make them that change scenes."""
    scene: dict[str, float] = {}
    for name, values in effects.items():
        change = effect_named(name).scene
        scene |= change(dict(values)) if change else {}
    pads = {k: scene[k] for k in ("normal_stiffness", "shear_stiffness") if k in scene}
    hand = rig.model_copy(update={"fingertip": rig.fingertip.model_copy(update=pads)})
    around = Surroundings(**{k: scene[k] for k in ("tilt", "support_stiffness") if k in scene})
    if "friction" in scene:
        blocks = {n: replace(b, friction=scene["friction"]) for n, b in blocks.items()}
    return hand, around, blocks


def recorded(
    simulated: SimulatedTrial,
    task: BlockTask,
    rig: Rig,
    effects: Values,
    change: Callable[[Performance], Performance] | None = None,
) -> Trial:
    """What the nominal hand's sensors record of a simulated trial under the given effects.

    `change` is one more, of the caller's own, that acts on what the sensors would see.
    """
    rng = np.random.default_rng([simulated.seed, 7])
    motion = simulated.motion
    truth = Performance(
        simulated.t,
        motion.position,
        motion.velocity,
        motion.force,
        simulated.boundaries,
        rig,
        *carried(simulated.t, simulated.boundaries, task, simulated.blocks),
    )
    chosen = [effect_named(n) for n in effects]
    for effect in sorted(chosen, key=lambda e: -e.stage):
        if effect.apply is not None:
            truth = effect.apply(truth, dict(effects[effect.name]), rng)
    truth = truth if change is None else change(truth)
    t = times = simulated.trial.t
    for effect in chosen:
        if effect.sampled is not None:
            times = effect.sampled(times, dict(effects[effect.name]), rng)

    def at(values: np.ndarray) -> np.ndarray:
        columns = [np.interp(times, truth.t, c) for c in values.reshape(-1, 4).T]
        return np.stack(columns, 1).reshape(-1, 2, 2)

    trial = record(t, at(truth.position), at(truth.velocity), at(truth.force), rig, rng, simulated.trial.file)
    for effect in chosen:
        if effect.finish is not None:
            finish, values = effect.finish, dict(effects[effect.name])
            changed = {c: finish(trial.channels[c], values) for c in FORCE_CHANNELS}
            trial = replace(trial, channels=trial.channels | changed)
    return trial


def carried(
    t: np.ndarray, boundaries: Sequence[float] | np.ndarray, task: BlockTask, blocks: Blocks
) -> tuple[np.ndarray, np.ndarray]:
    """Weight [N] and width [m] of the block in the air (0 and 1 where there is none) at times `t` [s]."""
    weight, width = np.zeros(t.size), np.ones(t.size)
    for m, move in enumerate(task.performed):
        leave, meet = boundaries[4 * m + 1 : 4 * m + 3]
        inside = (t >= leave) & (t < meet)
        weight[inside], width[inside] = blocks[move.object].weight, blocks[move.object].width
    return weight, width
