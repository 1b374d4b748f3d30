"""The cases of a set: their worlds, effects, trials and truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from experiments.blind_check.effects import CATALOGUE, Change, Made, fitted
from experiments.blind_check.hand import Rig
from experiments.blind_check.operator import Style, plan
from experiments.blind_check.outside import OUTSIDE
from experiments.blind_check.perform import Motion, perform
from experiments.blind_check.scene import Block, World
from experiments.blind_check.signals import (
    ENCODER,
    LINKS,
    READOUT,
    SCALE,
    Signals,
    Stage,
    Values,
    noise_of_channels,
    sample,
    sense,
    task_space,
)
from experiments.blind_check.worlds import Circumstances, draw_world

TRIALS = 4
TRIES = 60
# Shares of the tiers. `small`: an effect too small to see; `slight`: healthy, with errors that the rig does
# not state and that are below its [tolerance]; `dense`: four to six effects, one dominant; `withheld`: an
# effect taken out of the catalogue.
TIERS = {"healthy": 30, "single": 32, "pair": 10, "dense": 8, "outside": 10, "slight": 4, "withheld": 3,
         "small": 3}  # fmt: skip
SIZES = {"single": (0.08, 1.0), "pair": (0.3, 1.0), "outside": (0.3, 1.0), "withheld": (0.3, 1.0),
         "small": (0.005, 0.02)}  # fmt: skip
DOMINANT, MINOR = (0.4, 1.0), (0.03, 0.12)  # sizes of a dense case's effects
# Of a slight case: sizes that stay below the tolerances of its rig.
SLIGHT = {"force_bias": 0.1, "force_gain": 0.06, "joint_offset": 0.03, "fingertip_compliance": 0.02,
          "table_tilt": 0.02, "force_crosstalk": 0.05}  # fmt: skip
TOLERANCE = {"position": 5e-4, "force": 0.06, "property": 0.03}  # m, N, share
ROUND = (0.02, 0.08)  # N m/rad of fingertips rounded in height
HOLDS = 2.2  # a block is no heavier than this times the pads' friction, N: or it would be dropped


@dataclass(frozen=True)
class Case:
    """A case: tier, world, blocks, and the values and size (0 to 1) of each effect by name."""

    name: str
    seed: int
    tier: str
    world: Circumstances
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


def tiers(count: int, shares: Mapping[str, int] = TIERS) -> list[str]:
    """The tier of every case: shares hold for any number of cases, spread over the whole set."""
    names, weights = list(shares), np.array(list(shares.values()), float)
    given, out = np.zeros(len(names)), []
    for k in range(count):
        due = weights / weights.sum() * (k + 1) - given
        out.append(names[int(due.argmax())])
        given[int(due.argmax())] += 1
    return out


def draw_cases(
    count: int,
    seed: int,
    nominal: Rig,
    outside: Mapping[str, Made] = OUTSIDE,
    shares: Mapping[str, int] = TIERS,
    fastest: float = float("inf"),
) -> list[Case]:
    """The cases of a set, in an order that tells nothing; names are numbers. `outside` holds the kinds that
    outside cases are drawn from; no world samples faster than `fastest` [Hz].
    """
    rng = np.random.default_rng([seed, 0])
    pools: dict[str, list[str]] = {}
    out = [(tier, _choice(tier, rng, pools, outside)) for tier in tiers(count, shares)]
    order = rng.permutation(count)
    made = {**CATALOGUE, **outside}
    cases = []
    for k, i in enumerate(order):
        own = np.random.default_rng([seed, 1, k])
        lab = draw_world(own, fastest)
        cases.append(_draw(f"case_{k:04d}", out[int(i)], own, seed * 100_003 + k, lab, nominal, made))
    return cases


def _choice(
    tier: str, rng: np.random.Generator, pools: dict[str, list[str]], outside: Mapping[str, Made]
) -> list[str]:
    """Names of a case's effects: each name of its tier is used once before any repeats."""

    def deal(pool: str, names: Sequence[str]) -> str:
        if not pools.get(pool):
            pools[pool] = [str(n) for n in rng.permutation(list(names))]
        return pools[pool].pop()

    if tier == "healthy":
        return []
    if tier == "outside":
        return [deal(tier, list(outside))]
    if tier == "slight":
        return [str(n) for n in rng.permutation(list(SLIGHT))[: rng.integers(2, 4)]]
    first = deal(tier, list(CATALOGUE))
    if tier in ("pair", "dense"):
        more = 1 if tier == "pair" else int(rng.integers(3, 6))
        return [first, *(str(n) for n in rng.permutation([n for n in CATALOGUE if n != first])[:more])]
    return [first]


def _draw(
    name: str,
    kind: tuple[str, list[str]],
    rng: np.random.Generator,
    seed: int,
    world: Circumstances,
    nominal: Rig,
    made: Mapping[str, Made],
) -> Case:
    tier, effects = kind
    rig = world.rig(nominal)
    blocks = draw_blocks(world, rng)
    sizes = {e: _size(tier, e, k, rng) for k, e in enumerate(effects)}
    drawn = {e: {k: float(v) for k, v in made[e].draw(rng, sizes[e]).items()} for e in effects}
    values = {e: fitted(e, v, rig) for e, v in drawn.items()}
    if "grip_slip" in values:
        most = HOLDS * values["grip_slip"]["mu"]
        blocks = {n: replace(b, weight=min(b.weight, most)) for n, b in blocks.items()}
    measured = bool(rng.random() < 0.5) or "actual" in values
    if "offcentre_mass" in values:  # round tips: flat ones would take its moment by themselves
        world = replace(world, pad_turning=float(rng.uniform(*ROUND)))
    if "actual" in values:  # drawn as a share of the property
        values["actual"] = {k: v * getattr(blocks["block1"], k.split(".")[1])
                            for k, v in values["actual"].items()}  # fmt: skip
    exclude = tuple(effects) if tier == "withheld" else ()
    return Case(name, seed, tier, world, blocks, values, sizes, measured, exclude)


def _size(tier: str, effect: str, place: int, rng: np.random.Generator) -> float:
    if tier == "slight":
        return SLIGHT[effect] * float(rng.uniform(0.3, 1.0))
    low, high = (DOMINANT if place == 0 else MINOR) if tier == "dense" else SIZES[tier]
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_blocks(world: Circumstances, rng: np.random.Generator) -> dict[str, Block]:
    """Blocks of the task, the lower ones wider."""
    names = sorted(world.work.on)
    widths = {"block1": (0.014, 0.02), "block2": (0.022, 0.03), "block3": (0.024, 0.032)}
    return {n: _block(rng, *widths[n]) for n in names}


def _block(rng: np.random.Generator, low: float, high: float) -> Block:
    return Block(
        float(rng.uniform(0.25, 0.75)),
        float(rng.uniform(low, high)),
        float(rng.uniform(0.013, 0.019)),
        float(rng.uniform(0.5, 0.8)),
    )


def record_case(
    case: Case,
    nominal: Rig,
    style: dict[str, tuple[float, float]] | None = None,
    first: int = 0,
    outside: Mapping[str, Made] = OUTSIDE,
) -> list[Recorded]:
    """The trials of a case, optionally in another style, numbered from `first`."""
    made = {**CATALOGUE, **outside}
    changes = [made[n].change(v) for n, v in case.effects.items()]
    return [_record(case, nominal, k, style or {}, changes) for k in range(first, first + TRIALS)]


def _record(
    case: Case, nominal: Rig, trial: int, asked: dict[str, tuple[float, float]], changes: Sequence[Change]
) -> Recorded:
    rig, healthy = case.world.rig(nominal), case.world.world()
    # A style that an effect requires (a loose grip) is shared by the healthy twin.
    usual = case.world.style()
    world, style, sampling = healthy, usual, case.world.sampling()
    for change in changes:
        world = change.world(world) if change.world else world
        style, sampling = replace(style, **change.style), replace(sampling, **change.sampling)
    style = replace(style, **asked)
    motion, twin = _motions(case, (world, style), (healthy, replace(style, roll=0.0)), trial)
    own = [s for c in changes for s in c.stages]
    stages = _errors(case.world)
    signals = sense(motion, rig, [*stages, *own], np.random.default_rng([case.seed, trial, 1]))
    t, columns = sample(signals, sampling, np.random.default_rng([case.seed, trial, 2]))
    _, quiet = sample(signals, sampling, np.random.default_rng([case.seed, trial, 2]), noisy=False)
    plain = sense(twin, rig, stages, np.random.default_rng(0))
    quietly = np.random.default_rng([case.seed, trial, 2])
    _, without = sample(plain, case.world.sampling(), quietly, noisy=False)
    ends = (motion.boundaries, twin.boundaries)
    shift, spread = _shifts(rig, t, quiet, without, ends, len(case.world.work.subtasks))
    return Recorded(t, columns, motion.boundaries, shift, spread)


def _errors(world: Circumstances) -> list[tuple[int, Stage]]:
    """The recording chain's part of the errors that are within the stated systematic ones."""
    e = {k: np.array(v) for k, v in world.errors.items()}
    if not e:
        return []

    def encoders(s: Signals, rng: np.random.Generator) -> Signals:
        assert s.q is not None
        return replace(s, q=s.q + e["joint_offset"])

    return [
        (LINKS, lambda s, rng: replace(s, stretch=s.stretch + e["link_length"].reshape(2, 2))),
        (ENCODER, encoders),
        (SCALE, lambda s, rng: replace(s, force=s.force * (1 + e["force_gain"]))),
        (READOUT, lambda s, rng: replace(s, force=s.force + e["force_bias"])),
    ]


def _motions(
    case: Case, own: tuple[World, Style], healthy: tuple[World, Style], trial: int
) -> tuple[Motion, Motion]:
    """The motion and its healthy twin: same operator, same tremor, another world."""
    task = case.world.work

    def moved(world: World, style: Style, seeds: list[int]) -> Motion:
        rng = np.random.default_rng(seeds)
        return perform(plan(task, case.blocks, world, style, rng), case.blocks, world)

    for attempt in range(TRIES):
        seeds = [case.seed, trial, 0, attempt]
        try:
            motion = moved(*own, seeds)
            return motion, motion if own == healthy else moved(*healthy, seeds)
        except ValueError:  # dropped: people try again
            continue
    raise RuntimeError(f"{case.name}: no trial out of {TRIES} came off; {case.world}, effects {case.effects}")


def _shifts(
    rig: Rig, t: np.ndarray, quiet: dict, without: dict, boundaries: tuple, subtasks: int
) -> tuple[dict, dict]:
    n = min(len(next(iter(quiet.values()))), len(next(iter(without.values()))))
    t, a, b = t[:n], *({k: v[:n] for k, v in d.items()} for d in (quiet, without))
    own, other, noise = task_space(rig, a), task_space(rig, b), noise_of_channels(rig, b)
    subtask, twin = (np.searchsorted(e, t, side="right") for e in boundaries)
    same = subtask == twin
    shift: dict[str, list[float]] = {}
    spread: dict[str, list[float]] = {}
    for channel in own:
        z = (own[channel] - other[channel]) / noise[channel]
        rows = [z[same & (subtask == s)] for s in range(subtasks)]
        shift[channel] = [float(r.mean()) if r.size else 0.0 for r in rows]
        spread[channel] = [float(np.sqrt((r**2).mean())) if r.size else 0.0 for r in rows]
    return shift, spread
