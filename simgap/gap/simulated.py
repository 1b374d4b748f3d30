"""Simulated recordings with known effects: the recorded task, rig and blocks in the virtual model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimation.priors import PROPERTY_LOG_SD
from estimation.report import Actual
from hmmseg.contact.decompose import PROPERTIES
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from simgap.effects import effect_named
from simgap.effects.base import Performance
from simgap.gap.problem import fit
from simgap.gap.search import Search
from simgap.world.dynamics import interpolated
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Block, Blocks
from simgap.world.simulate import SimulatedTrial, record, simulate_trials
from simgap.world.virtual_model import Surroundings

Values = Mapping[str, Mapping[str, float]]  # effect -> parameter -> value


def performed(
    task: BlockTask,
    rig: Rig,
    blocks: Sequence[Blocks],
    seeds: Sequence[int],
    effects: Values,
    operator: OperatorSettings | None = None,
) -> list[SimulatedTrial]:
    """Simulate trials in the scene as these effects change it (one scene for all)."""
    hand, around, _ = scene_of(rig, {}, effects)
    blocks = [scene_of(rig, each, effects)[2] for each in blocks]
    for grip in (effect_named(name).grip for name in effects):
        if grip is not None:
            operator = operator or OperatorSettings(grip=grip)
    return simulate_trials(task, hand, blocks, seeds, operator, around)


def scene_of(rig: Rig, blocks: Blocks, effects: Values) -> tuple[Rig, Surroundings, Blocks]:
    """Hand, surroundings and blocks as these effects change them."""
    scene: dict[str, float] = {}
    for name, values in effects.items():
        change = effect_named(name).scene
        scene |= change(dict(values)) if change else {}
    pads: dict[str, float] = {k: scene[k] for k in ("normal_stiffness", "shear_stiffness") if k in scene}
    hand = rig.model_copy(update={"fingertip": rig.fingertip.model_copy(update=pads)})
    around = Surroundings(**{k: scene[k] for k in ("tilt", "support_stiffness") if k in scene})
    if "friction" in scene:
        blocks = {n: replace(b, friction=scene["friction"]) for n, b in blocks.items()}
    return hand, around, blocks


def recorded(simulated: SimulatedTrial, task: BlockTask, rig: Rig, effects: Values) -> Trial:
    """What the nominal hand's sensors record of a simulated trial under the given effects.

    Args:
        simulated: The trial.
        task: The task.
        rig: The nominal hand.
        effects: Parameters of each effect.
    """
    rng = np.random.default_rng([simulated.seed, 7])
    when, ends = simulated.t, simulated.boundaries
    held = carried(when, ends, task, simulated.blocks)
    truth = Performance(when, *simulated.motion[:3], ends, rig, *held)
    chosen = [effect_named(n) for n in effects]
    truth = altered(truth, effects, rng)
    t = times = simulated.trial.t
    for effect in chosen:
        if effect.sampled is not None:
            times = effect.sampled(times, dict(effects[effect.name]), rng)
    place, speed, force = (interpolated(times, truth.t, z) for z in truth[1:4])
    trial = record(t, place, speed, force, rig, rng, simulated.trial.file)
    for effect in chosen:
        if effect.finish is not None:
            finish, values = effect.finish, dict(effects[effect.name])
            changed = {c: finish(trial.channels[c], values) for c in FORCE_CHANNELS}
            trial = replace(trial, channels=trial.channels | changed)
    return trial


def altered(truth: Performance, effects: Values, rng: np.random.Generator) -> Performance:
    """A performance as these effects change what sensors see of it, from the truth outwards."""
    for effect in sorted(map(effect_named, effects), key=lambda e: -e.stage):
        if effect.apply is not None:
            truth = effect.apply(truth, dict(effects[effect.name]), rng)
    return truth


def carried(
    t: np.ndarray, boundaries: Sequence[float] | np.ndarray, task: BlockTask, blocks: Blocks
) -> tuple[np.ndarray, np.ndarray]:
    """Weight [N] and width [m] of the lifted block (0 and 1 where there is none) at times `t` [s]."""
    weight, width = np.zeros(t.size), np.ones(t.size)
    for m, move in enumerate(task.performed):
        leave, meet = boundaries[4 * m + 1 : 4 * m + 3]
        inside = (t >= leave) & (t < meet)
        weight[inside], width[inside] = blocks[move.object].weight, blocks[move.object].width
    return weight, width


LEAST = 1e-3  # numerics: N, m; smaller properties cannot be simulated


def blocks_of(found: Search) -> Blocks:
    """The blocks as the recordings alone show them, corrected for the best single effect.

    Raises:
        ValueError: A property is too small to be simulated.
    """
    given, best = found.problem, min((found.healthy, *found.fits), key=lambda one: one.cost)
    usual = given.centre * np.array([PROPERTY_LOG_SD[kind] for kind in PROPERTIES])
    alone, u = replace(given, sd=np.where(given.measured, usual, given.sd)), best.u.copy()
    u[: given.centre.size][given.measured.ravel()] = 0.0
    values = alone.properties(fit(alone, best.effects, u).u)
    if not (values > LEAST).all():
        raise ValueError("a property that no block has")
    return {n: Block(*map(float, v)) for n, v in zip(given.frame.task.objects, values, strict=True)}


def measured_on(blocks: Blocks, actual: Actual | None) -> Actual | None:
    """The same measurements, made of these blocks without error."""
    return actual and {
        name: {kind: (getattr(blocks[name], kind), sd) for kind, (_, sd) in of.items()}
        for name, of in actual.items()
    }
