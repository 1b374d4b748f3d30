"""A sealed set: which cases there are, what was done to each, and its trials with their truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.blind_check.effects import CATALOGUE, SMALLEST, Made, Values
from experiments.blind_check.hand import Rig
from experiments.blind_check.operator import Style, plan
from experiments.blind_check.outside import OUTSIDE
from experiments.blind_check.perform import Motion, perform
from experiments.blind_check.scene import Block, World
from experiments.blind_check.signals import Sampling, noise_of_channels, sample, sense, task_space

TRIALS = 4
TRIES = 60
# Shares of the tiers; effects too small to see come about by themselves among single effects.
TIERS = {"healthy": 300, "single": 138, "pair": 40, "outside": 36, "withheld": 36}
SUBTASKS = (
    "pregrasp block1", "pickup block1", "carry block1", "place block1", "release block1",
    "pickup block2", "carry block2", "place block2", "release block2",
)  # fmt: skip
HOLDS = 2.2  # a block is no heavier than this times the pads' friction, N: or it would be dropped


@dataclass(frozen=True)
class Case:
    """What a case is: its tier, blocks, and its effects' values by name, each with its size (0 to 1)."""

    name: str
    seed: int
    tier: str
    blocks: dict[str, Block]
    effects: dict[str, Values]
    sizes: dict[str, float]
    measured: bool
    exclude: tuple[str, ...]


@dataclass(frozen=True)
class Recorded:
    """A trial as written (`t`, `columns`) and its truth: `boundaries`, and by channel and subtask the
    mean shift that the effect makes over the noise of one sample (`shift`), and its rms (`spread`).
    """

    t: np.ndarray
    columns: dict[str, np.ndarray]
    boundaries: tuple[float, ...]
    shift: dict[str, list[float]]
    spread: dict[str, list[float]]


def tiers(count: int) -> list[str]:
    """The tier of every case: shares of TIERS kept at any number, spread over the whole set."""
    names, weights = list(TIERS), np.array(list(TIERS.values()), float)
    given, out = np.zeros(len(names)), []
    for k in range(count):
        due = weights / weights.sum() * (k + 1) - given
        out.append(names[int(due.argmax())])
        given[int(due.argmax())] += 1
    return out


def draw_cases(count: int, seed: int) -> list[Case]:
    """The cases of a set, in an order that tells nothing; names are numbers."""
    rng = np.random.default_rng([seed, 0])
    kinds = tiers(count)
    pools: dict[str, list[str]] = {}
    out = []
    for tier in kinds:
        out.append((tier, _choice(tier, rng, pools)))
    order = rng.permutation(count)
    return [
        _draw(f"case_{k:04d}", out[int(i)], np.random.default_rng([seed, 1, k]), seed * 100_003 + k)
        for k, i in enumerate(order)
    ]


def _choice(tier: str, rng: np.random.Generator, pools: dict[str, list[str]]) -> list[str]:
    """Names of the effects of a case: every name of its tier once before any comes again."""

    def deal(pool: str, names: Sequence[str]) -> str:
        if not pools.get(pool):
            pools[pool] = [str(n) for n in rng.permutation(list(names))]
        return pools[pool].pop()

    if tier == "healthy":
        return []
    if tier == "outside":
        return [deal(tier, list(OUTSIDE))]
    if tier == "pair":
        first = deal(tier, list(CATALOGUE))
        return sorted([first, deal("partner", [n for n in CATALOGUE if n != first])])
    return [deal(tier, list(CATALOGUE))]


def _draw(name: str, kind: tuple[str, list[str]], rng: np.random.Generator, seed: int) -> Case:
    tier, effects = kind
    blocks = {n: _block(rng, *width) for n, width in (("block1", (0.014, 0.02)), ("block2", (0.022, 0.03)))}
    if len(effects) != len(set(effects)):
        effects = [effects[0], "force_bias" if effects[0] != "force_bias" else "force_lag"]
    # Pairs and effects to be recognised as unknown are drawn where they can be seen.
    smallest = SMALLEST if tier == "single" else 0.3
    sizes = {e: float(smallest ** rng.uniform(0, 1)) for e in effects}
    values = {e: {k: float(v) for k, v in _made(e).draw(rng, sizes[e]).items()} for e in effects}
    if "grip_slip" in values:
        most = HOLDS * values["grip_slip"]["mu"]
        blocks = {n: replace(b, weight=min(b.weight, most)) for n, b in blocks.items()}
    exclude = tuple(effects) if tier == "withheld" else ()
    return Case(name, seed, tier, blocks, values, sizes, bool(rng.random() < 0.5), exclude)


def _block(rng: np.random.Generator, low: float, high: float) -> Block:
    return Block(
        float(rng.uniform(0.25, 0.75)),
        float(rng.uniform(low, high)),
        float(rng.uniform(0.013, 0.019)),
        float(rng.uniform(0.5, 0.8)),
    )


def _made(name: str) -> Made:
    return CATALOGUE[name] if name in CATALOGUE else OUTSIDE[name]


def record_case(
    case: Case, rig: Rig, style: dict[str, tuple[float, float]] | None = None, first: int = 0
) -> list[Recorded]:
    """The trials of a case, worked in another style if that is given; `first` numbers the first one."""
    return [_record(case, rig, k, style or {}) for k in range(first, first + TRIALS)]


def _record(case: Case, rig: Rig, trial: int, asked: dict[str, tuple[float, float]]) -> Recorded:
    changes = [_made(n).change(v) for n, v in case.effects.items()]
    healthy = World(rig.normal_stiffness, rig.shear_stiffness)
    world, style, sampling = healthy, Style(), Sampling()
    for change in changes:
        world = change.world(world) if change.world else world
        style, sampling = replace(style, **change.style), replace(sampling, **change.sampling)
    style = replace(style, **asked)
    motion, twin = _motions(case, world, healthy, style, trial)
    stages = [s for c in changes for s in c.stages]
    signals = sense(motion, rig, stages, np.random.default_rng([case.seed, trial, 1]))
    t, columns = sample(signals, sampling, np.random.default_rng([case.seed, trial, 2]))
    _, quiet = sample(signals, sampling, np.random.default_rng([case.seed, trial, 2]), noisy=False)
    plain = sense(twin, rig, [], np.random.default_rng(0))
    _, without = sample(plain, Sampling(), np.random.default_rng([case.seed, trial, 2]), noisy=False)
    shift, spread = _shifts(rig, t, quiet, without, (motion.boundaries, twin.boundaries))
    return Recorded(t, columns, motion.boundaries, shift, spread)


def _motions(case: Case, world: World, healthy: World, style: Style, trial: int) -> tuple[Motion, Motion]:
    """The motion and its healthy twin: same operator, same tremor, another world."""
    for attempt in range(TRIES):
        seeds = [case.seed, trial, 0, attempt]
        try:
            motion = perform(
                plan(case.blocks, world, style, np.random.default_rng(seeds)), case.blocks, world
            )
            if world == healthy:
                return motion, motion
            again = plan(case.blocks, healthy, style, np.random.default_rng(seeds))
            return motion, perform(again, case.blocks, healthy)
        except ValueError:  # dropped: people try again
            continue
    raise RuntimeError(f"{case.name}: no trial out of {TRIES} came off; effects {case.effects}")


def _shifts(rig: Rig, t: np.ndarray, quiet: dict, without: dict, boundaries: tuple) -> tuple[dict, dict]:
    n = min(len(next(iter(quiet.values()))), len(next(iter(without.values()))))
    t, a, b = t[:n], *({k: v[:n] for k, v in d.items()} for d in (quiet, without))
    own, other, noise = task_space(rig, a), task_space(rig, b), noise_of_channels(rig, b)
    subtask, twin = (np.searchsorted(e, t, side="right") for e in boundaries)
    same = subtask == twin
    shift: dict[str, list[float]] = {}
    spread: dict[str, list[float]] = {}
    for channel in own:
        z = (own[channel] - other[channel]) / noise[channel]
        rows = [z[same & (subtask == s)] for s in range(len(SUBTASKS))]
        shift[channel] = [float(r.mean()) if r.size else 0.0 for r in rows]
        spread[channel] = [float(np.sqrt((r**2).mean())) if r.size else 0.0 for r in rows]
    return shift, spread
