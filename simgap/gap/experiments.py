"""The next experiment: which of a short list would best tell two causes apart.

Every experiment is simulated once with the leading cause in it, then both causes are fitted to what it
would record. The gain expected is by how much the wrong one would then fit worse: the divergence of the
two after properties and nuisances have done their best (Chaloner & Verdinelli, Statist. Sci. 10, 1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.segmentation import align_trials
from hmmseg.signals import task_space
from simgap.gap.bank import Bank
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.fit import Fitted, Problem, Start, fit, neutral, problem
from simgap.gap.frame import build
from simgap.gap.spread import spreads
from simgap.gap.synthetic import Values, performed, recorded
from simgap.operator import OperatorSettings
from simgap.properties import Block, Blocks
from simgap.writing import task_table

LEAST = 1e-4  # an estimated property below this is not one


@dataclass(frozen=True)
class Experiment:
    """What to do, the operator's settings that do it, and whether the blocks are measured apart."""

    do: str
    operator: dict[str, tuple[float, float]] = field(default_factory=dict)
    measured: bool = False


EXPERIMENTS = (
    Experiment(
        "weigh the blocks and measure them with calipers, and give the values with --actual", {}, True
    ),
    Experiment(
        "hold still in free air for 2 s before, between and after the moves, at different heights",
        {"rest": (2.0, 2.0), "rise": (0.03, 0.045), "finish": (2.0, 2.0), "dwell": (0.8, 1.0)},
    ),
    Experiment("work twice as fast", {"pace": (1.8, 2.0)}),
    Experiment("vary the grip between light and hard", {"grip": (1.2, 5.0), "press": (0.3, 1.5)}),
    Experiment(
        "hold each block for 2 s before lifting and after placing it",
        {"hold": (1.8, 2.0), "place": (1.8, 2.0)},
    ),
)


def next_experiment(
    given: Problem,
    cause: Values,
    partners: Sequence[tuple[str, ...]],
    properties: np.ndarray,
    bank: Bank,
    seed: int,
) -> dict[str, Any] | None:
    """The experiment of the largest expected gain [nats], or None where none can be simulated.

    `cause` holds the parameters of each effect that acts, `partners` the explanations that cannot be told
    from them; `properties` (objects, 3) what is thought of the blocks.
    """
    frame = given.frame
    if not (properties > LEAST).all():
        return None
    blocks = {n: Block(*map(float, p)) for n, p in zip(frame.task.objects, properties, strict=True)}
    best: tuple[float, Experiment] | None = None
    for experiment in EXPERIMENTS:
        try:
            gain = _gain(given, experiment, blocks, cause, partners, bank, seed)
        except (InputError, ValueError):  # this rig or these blocks do not allow it
            continue
        if best is None or gain > best[0]:
            best = gain, experiment
    if best is None:
        return None
    gain, chosen = best
    return {
        "do": chosen.do,
        "separates": sorted({*cause, *(name for each in partners for name in each)}),
        "expected_gain_nats": float(gain),
        "task": task_table(frame.task),
        "operator": {k: list(v) for k, v in chosen.operator.items()},
    }


def _gain(
    given: Problem,
    experiment: Experiment,
    blocks: Blocks,
    truth: Values,
    partners: Sequence[tuple[str, ...]],
    bank: Bank,
    seed: int,
) -> float:
    """How much worse the closest partner fits one trial of the experiment than the cause does [nats]."""
    frame = given.frame
    task, rig = frame.task, frame.rig
    simulated = performed(task, rig, [blocks], [seed + 77], truth, OperatorSettings(**experiment.operator))
    trials = [recorded(s, task, rig, truth) for s in simulated]
    aligned = align_trials([t.file for t in trials], [task_space(t, rig) for t in trials], task, rig)
    actual = None
    if experiment.measured:
        actual = {
            n: {"weight": (b.weight, 5e-4), "width": (b.width, 1e-4), "height": (b.height, 1e-4)}
            for n, b in blocks.items()
        }
    asked = problem(build(trials, aligned, rig), bank.noise, actual)
    healthy = fit(asked, [Start((), neutral(asked))])[0]
    cause, *others = (_cost(asked, healthy, names) for names in (tuple(truth), *partners))
    return min(others) - cause


def _cost(asked: Problem, healthy: Fitted, names: tuple[str, ...]) -> float:
    """What effects leave when fitted together, those that scatter on top of those that shift."""
    shifting = tuple(sorted(deterministic(names)))
    fitted = best_fits(asked, [shifting], healthy)[0] if shifting else healthy
    scattering = [s for s in spreads(asked, fitted) if s.effect in names]
    return fitted.cost - sum(s.evidence for s in scattering)
