"""Healthy twins: the recorded task, rig, pace, blocks, grips and sensors, simulated and diagnosed alike.

The statistic of a recording is a log Bayes factor; that of a healthy one exceeds s with a probability of at
most exp(-s) if the model is right. No model is exactly right: twins show how far off it is for recordings
like these (`simgap.attribution.search.detected`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimation.priors import PROPERTY_LOG_SD
from hmmseg.cache import cache_folder, keep_numbers, kept_numbers
from hmmseg.contact.decompose import PROPERTIES
from hmmseg.errors import InputError
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.attribution.posterior import forms
from simgap.attribution.search import clear, doubtful, sought, statistic
from simgap.effects import effect_named
from simgap.effects.base import Performance
from simgap.gap.frame import as_from_wrist, of_wrist, thinned
from simgap.gap.problem import fit
from simgap.gap.search import PROMISING, Identified, Search, search
from simgap.progress import Progress, silent
from simgap.source_digest import source_digest
from simgap.world.operator import OperatorSettings, Plan
from simgap.world.properties import Block, Blocks
from simgap.world.replay import QUICKEST, plan_again
from simgap.world.simulate import SimulatedTrial, noise_sd, record, simulate_plans, simulate_trials
from simgap.world.virtual_model import Surroundings

# Simulated recordings with known effects, on which the diagnosis is calibrated.

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
    pads = {k: scene[k] for k in ("normal_stiffness", "shear_stiffness") if k in scene}
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
    truth = altered(truth, effects, rng)
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


BATCHES = (1, 3, 4)  # numerics: twins simulated at a time: the first alone usually suffices
# numerics: share of the statistic that leaves doubt, below which no effect of a twin is refined
PROMISES = 0.5
LEAST = 1e-3  # numerics: N, m; smaller properties cannot be simulated
# chosen: quantiles of the aligned trials between which an operator's settings are drawn
QUANTILES = (0.1, 0.9)


def twin_statistics(
    found: Search,
    value: float,
    actual: dict | None,
    seed: int,
    tell: Progress = silent,
) -> Iterator[float]:
    """Statistics of healthy twins of a search, one by one; known ones are read from the cache.

    The effect of sensor noise on a twin's candidates, which can only lower its statistic, is computed only if
    the statistic without it is a sign of a gap and leaves `value` in doubt. There are no twins if this hand
    or these blocks cannot be simulated.

    Args:
        found: The search.
        value: Its own statistic [nats].
        actual: Measured properties.
        seed: Of the twins.
        tell: Called with a description of each stage.
    """
    frame = found.problem.frame
    file = _file(found.trials, frame.task, frame.rig, actual, seed)
    known = kept_numbers(file)
    yield from known
    start = 0
    for size in BATCHES:
        which = range(start, start := start + size)
        if len(known) >= which.stop:
            continue
        tell("simulating healthy twins")
        try:
            blocks = blocks_of(found)
            mine, twins = measured_on(blocks, actual), _recorded(found, blocks, which, seed)
            shown = {(name, kind): getattr(b, kind) for name, b in blocks.items() for kind in PROPERTIES}
        except (InputError, ValueError):
            return
        for k, trials in zip(which, twins, strict=True):
            if k < len(known):
                continue
            with suppress(InputError):  # a twin that drops its block does not count
                tell("diagnosing healthy twins")
                twin = align(trials, frame.task, frame.rig)
                most = healthy_statistic(twin, mine, shown, False, PROMISES * doubtful(value))
                sure = most <= 0 or clear(value, most)  # no sign of a gap counts as zero
                known.append(most if sure else healthy_statistic(twin, mine, shown))
                keep_numbers(file, known)
                yield known[-1]


def healthy_statistic(
    aligned: AlignedTrials, actual: dict | None, identified: Identified | None = None, noisy: bool = True,
    promising: float = 0.0,
) -> float:  # fmt: skip
    """The statistic of one healthy recording, from the whole search with its blocks as `identified`.

    Effects are refined where a linear step gains as much as is `promising` [nats]; `noisy` as in `search`.
    """
    promising = max(promising, PROMISING)
    f = forms(search(aligned, actual, identified=identified, noisy=noisy, promising=promising).gap)
    return statistic(f, sought(f, 1))


def own_healthy(found: Search, healthy: AlignedTrials, actual: dict | None) -> Iterator[float]:
    """Statistics of a user's own healthy recordings, in groups as large as the diagnosed one."""
    every = healthy.trials
    size = min(found.problem.frame.num_trials, len(every))
    for start in range(0, len(every) - size + 1, size):
        yield healthy_statistic(replace(healthy, trials=every[start : start + size]), actual)


def _recorded(found: Search, blocks: Blocks, which: range, seed: int) -> list[list[Trial]]:
    """Recordings of twins, each with as many trials as were searched."""
    frame = found.problem.frame
    trials, task, rig = frame.num_trials, frame.task, frame.rig
    hand = rig.model_copy(update={"rate": float(np.median([trial.rate for trial in found.trials]))})
    seeds = [seed + 7_000_000 + 1000 * k + j for k in which for j in range(trials)]
    every = [blocks] * len(seeds)
    simulated = None
    with suppress(ValueError):  # motion cannot be smoothed without stated noise
        simulated = simulate_plans(task, hand, _plans(found, task, rig, blocks) * len(which), every, seeds)
    # Repeated motions may drop blocks or never reach them.
    if simulated is None or not all(np.isfinite(s.boundaries).all() for s in simulated):
        simulated = performed(task, hand, every, seeds, {}, settings(found))
    twins = [recorded(s, task, hand, {}) for s in simulated]
    if of_wrist(found.trials):
        twins = [as_from_wrist(twin, found.trials[0]) for twin in twins]
    return [twins[k : k + trials] for k in range(0, len(twins), trials)]


def _plans(found: Search, task: BlockTask, rig: Rig, blocks: Blocks) -> list[Plan]:
    """Commands that repeat the recorded motions of every trial, as fast as a hand is commanded."""
    out = []
    for trial, a in zip(found.trials, found.aligned.trials, strict=True):
        small, group = thinned(trial, rig, 1 / QUICKEST)
        signals = task_space(small, rig)
        quieter = {n: getattr(signals, n) / np.sqrt(group) for n in ("sd_x", "sd_y", "sd_vx", "sd_vy")}
        starts = [s.start for s in a.segmentation.spans[1:]]
        noise = noise_sd(rig, "force") / np.sqrt(group)
        out.append(plan_again(replace(signals, **quieter), task, blocks, starts, noise))
    return out


def blocks_of(found: Search) -> Blocks:
    """The blocks as the recordings alone show them, corrected for the best single effect.

    With other blocks, repeated motions would end in the air.

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


def measured_on(blocks: Blocks, actual: dict | None) -> dict | None:
    """The same measurements, made of these blocks without error."""
    return actual and {
        name: {kind: (getattr(blocks[name], kind), sd) for kind, (_, sd) in of.items()}
        for name, of in actual.items()
    }


def settings(found: Search) -> OperatorSettings:
    """An operator who works at the recorded pace and grips as hard as was recorded."""
    frame = found.problem.frame
    usual, arrays, world = OperatorSettings(), frame.arrays, frame.world
    grip, spans = [], dict[str, list[float]]()
    for r in range(frame.num_trials):
        n = frame.lengths[r]
        for s, step in enumerate(frame.steps):
            mine = arrays.subtask[r, :n] == s
            t = world.t[r, :n][mine]
            if mine.any():
                spans.setdefault(step.name, []).append(float(t[-1] - t[0]))
                if step.name == "carry":
                    force = world.force[r, :n][mine]
                    grip.append(float(np.median(force[:, 0] - force[:, 2]) / 2))

    def between(values: Sequence[float], low: float) -> tuple[float, float]:
        a, b = np.quantile(values, QUANTILES)
        return float(max(a, low)), float(max(b, low))

    pace = _carrying(usual) / max(float(np.median(spans.get("carry", [_carrying(usual)]))), 0.2)
    seen = {"pace": (pace, pace)} | ({"grip": between(grip, 0.3)} if grip else {})
    for name, own in (("pickup", "hold"), ("place", "place")):
        if name in spans:
            seen[own] = between([v * pace for v in spans[name]], 0.02)
    return OperatorSettings(**seen)


def _carrying(usual: OperatorSettings) -> float:
    """Usual duration of a carry [s]."""
    return float(
        np.mean(usual.lift) + np.mean(usual.travel) + np.mean(usual.descend) + 2 * np.mean(usual.air)
    )


def _file(trials: Sequence[Trial], task: BlockTask, rig: Rig, actual: dict | None, seed: int) -> Path | None:
    """The cache file of statistics, keyed by recordings, task, rig, measurements, seed and source code."""
    digest = hashlib.sha256()
    for trial in trials:
        for name, values in sorted({"t": trial.t, **trial.channels}.items()):
            digest.update(name.encode() + np.ascontiguousarray(values).tobytes())
    more = (repr(task), rig.model_dump_json(), repr(actual), str(seed), source_digest())
    digest.update("\n".join(more).encode())
    folder = cache_folder()
    return None if folder is None else folder / "twins" / f"{digest.hexdigest()[:24]}.json"
