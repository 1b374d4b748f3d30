"""Cases of our own simulator with a known gap: none, one effect, two, or one from outside the catalogue."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from simgap.effects import catalogue
from simgap.effects.base import Performance, flat, with_force
from simgap.gap.synthetic import draw, performed, recorded
from simgap.world.properties import Blocks, random_properties
from simgap.world.simulate import SimulatedTrial

TRIALS = 4
SIZES = (0.1, 1.3)  # log-uniform factors on the usual draw of an effect's parameters
APART, TOUCHED = 0.25, 0.05  # s from a grip, N: free motion in which more is felt is none
SCATTER = 0.05  # log sd from trial to trial of what acts between samples: it is never the same twice
# What others of the catalogue stand in for is not a case of "unknown" when it is withheld.
SHARED = ("force_gain", "fingertip_compliance", "link_length", "fingertip_mass", "table_tilt")
Alien = Callable[[Performance, float, np.random.Generator], Performance]


@dataclass(frozen=True)
class Case:
    """Trials with their truth: `effects` are sorted names, an outsider's as `outside:name`.

    `excluded`: effects that the diagnosis is not to think of. `values` are those about which trials scatter.
    """

    name: str
    effects: tuple[str, ...]
    values: dict[str, dict[str, float]]
    size: float
    blocks: Blocks
    trials: tuple[Trial, ...]
    excluded: tuple[str, ...] = ()


def _hum(p: Performance, size: float, rng: np.random.Generator) -> Performance:
    """Mains hum on all channels, seen as an alias."""
    wave = np.sin(2 * np.pi * rng.uniform(2.0, 8.0) * p.t[:, None] + rng.uniform(0, 2 * np.pi, 4))
    return with_force(p, flat(p) + 0.08 * size * wave)


def _jump(p: Performance, size: float, rng: np.random.Generator) -> Performance:
    """Zero of the force channels that jumps once, in the middle of a trial."""
    late = (p.t > rng.uniform(0.3, 0.7) * p.t[-1])[:, None]
    return with_force(p, flat(p) + 0.15 * size * late * rng.choice([-1.0, 1.0], 4))


def _pull(p: Performance, size: float, rng: np.random.Generator) -> Performance:
    """A pull of the table on the fingers that fades with height."""
    pull = 0.25 * size * np.exp(-np.maximum(p.position[:, :, 1], 0.0) / 0.008)
    force = p.force.copy()
    force[:, :, 1] -= pull
    return p._replace(force=force)


def _saturated(p: Performance, size: float, rng: np.random.Generator) -> Performance:
    """Normal forces that a sensor cuts off."""
    force = p.force.copy()
    top = 2.6 - 1.2 * min(size, 1.3)
    force[:, :, 0] = np.clip(force[:, :, 0], -top, top)
    return p._replace(force=force)


def _bent(p: Performance, size: float, rng: np.random.Generator) -> Performance:
    """A sensor with a gain that grows with the force itself."""
    return with_force(p, flat(p) * (1 + 0.06 * size * np.abs(flat(p))))


def _breath(p: Performance, size: float, rng: np.random.Generator) -> Performance:
    """Fingers that sway slowly in height though the joints do not read it."""
    sway = 4e-4 * size * np.sin(2 * np.pi * rng.uniform(0.2, 0.6) * p.t + rng.uniform(0, 6.28))
    position = p.position.copy()
    position[:, 0, 1] += sway
    return p._replace(position=position)


ALIENS: dict[str, Alien] = {
    "hum": _hum, "jump": _jump, "pull": _pull, "saturated": _saturated, "bent": _bent, "breath": _breath,
}  # fmt: skip


def chosen_effects() -> list[str]:
    """Names of the effects that a diagnosis chooses from."""
    return [name for name, effect in catalogue().items() if effect.chosen]


def draw_case(kind: str, effects: tuple[str, ...], seed: int, task: BlockTask, rig: Rig) -> Case:
    """A case by its seed; `kind` is healthy, single, withheld, pair or outside (its name in `effects`)."""
    rng = np.random.default_rng([seed, 11])
    size = float(np.exp(rng.uniform(*np.log(SIZES))))
    if kind in ("pair", "withheld"):
        size = float(np.exp(rng.uniform(*np.log((0.4, SIZES[1])))))
    values = {} if kind == "outside" else {n: draw(n, rng, size) for n in effects}
    blocks = random_properties(task, seed)
    seeds = [100 * seed + k for k in range(TRIALS)]
    alien = ALIENS[effects[0]] if kind == "outside" else None
    trials = []
    for s in seeds:
        own = {n: _scattered(v, rng) if catalogue()[n].coarse else v for n, v in values.items()}
        (simulated,) = performed(task, rig, [blocks], [s], own)
        if brushed(simulated):
            raise ValueError("a finger brushes a block between the moves")
        change = None if alien is None else (lambda p, a=alien: a(p, size, np.random.default_rng([seed, 12])))
        trials.append(recorded(simulated, task, rig, own, change))
    names = tuple(f"outside:{n}" for n in effects) if kind == "outside" else tuple(sorted(effects))
    name = f"{kind}_{'+'.join(effects) or 'none'}_{seed}"
    return Case(name, names, values, size, blocks, tuple(trials), effects if kind == "withheld" else ())


def _scattered(values: dict[str, float], rng: np.random.Generator) -> dict[str, float]:
    return {k: float(x * np.exp(rng.normal(0, SCATTER))) for k, x in values.items()}


def brushed(simulated: SimulatedTrial) -> bool:
    """Whether anything is touched in free motion, away from the grips."""
    edges = np.concatenate([[-np.inf], simulated.boundaries, [np.inf]]).reshape(-1)
    ends = [(edges[k], edges[k + 1]) for k in range(0, edges.size - 1, 4)]  # before, between and after grips
    free = np.any([(simulated.t > a + APART) & (simulated.t < b - APART) for a, b in ends], axis=0)
    return bool((np.abs(simulated.motion.force[free]) > TOUCHED).any())


def plan(rounds: int, first: int = 5000) -> list[tuple[str, tuple[str, ...], int]]:
    """Kind, effects and seed of every case: each round has all singles, outsiders, healthy ones and pairs."""
    rng = np.random.default_rng(first)
    names, out, seed = chosen_effects(), [], first
    for _ in range(rounds):
        batch = [("single", (n,)) for n in names] + 2 * [("outside", (n,)) for n in ALIENS]
        batch += [("withheld", (n,)) for n in names if n not in SHARED] + [("healthy", ())] * 6
        batch += [("pair", tuple(sorted(rng.choice(names, 2, replace=False)))) for _ in range(8)]
        for k in rng.permutation(len(batch)):
            out.append((*batch[k], seed))
            seed += 1
    return out
