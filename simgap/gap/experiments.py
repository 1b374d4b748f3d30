"""The next experiment: which of a short list would tell the leading cause from its partners.

Every experiment is simulated with the leading cause in it, then all candidates are fitted to what it would
record, in TRIALS trials: where contacts fall between samples tells much of what delays, and is chance. The
gain expected of a partner is by how much it would then fit worse: the divergence after properties and
nuisances have done their best (Chaloner & Verdinelli, Statist. Sci. 10, 1995), for as many trials as there
are, tempered as their evidence is, less what the effects' forms may be off by. A partner that is told surely
need not be told more surely: of the experiments that tell most partners the first of the list is taken,
which asks least of the model. The same forecast is made of recordings like those at hand: where they told
less than it says, every other forecast is trusted as much less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimation.actual import Actual
from hmmseg.errors import InputError
from hmmseg.segmentation.align import align
from simgap.gap.bank import Bank
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.fit import Fitted, Problem, Start, fit, neutral, problem, slots
from simgap.gap.frame import TRIALS, build
from simgap.gap.spread import spreads
from simgap.gap.synthetic import Values, performed, recorded
from simgap.gap.verdict import DELAYING, TIE, brief, form_share
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Block, Blocks
from simgap.world.writing import task_table

LEAST = 1e-4  # an estimated property below this is not one
ENOUGH = 4 * TIE  # nats (tempered): gains have a standard deviation of the square root of twice their mean


@dataclass(frozen=True)
class Experiment:
    """What to do, the operator's settings that do it, and whether the blocks are measured apart."""

    do: str
    operator: dict[str, tuple[float, float]] = field(default_factory=dict)
    measured: bool = False


USUAL = Experiment("the same again")
# Those whose outcome needs least of the model first: fast work asks most of it.
EXPERIMENTS = (
    Experiment(
        "weigh the blocks and measure them with calipers, and give the values with --actual", {}, True
    ),
    Experiment(
        "hold still in free air for 2 s before, between and after the moves, at different heights",
        {"rest": (2.0, 2.0), "rise": (0.03, 0.045), "finish": (2.0, 2.0), "dwell": (0.8, 1.0)},
    ),
    Experiment(
        "hold each block for 2 s before lifting and after placing it",
        {"hold": (1.8, 2.0), "place": (1.8, 2.0)},
    ),
    Experiment("vary the grip between light and hard", {"grip": (1.2, 5.0), "press": (0.3, 1.5)}),
    Experiment("grip with 4 to 5 N and press down with 3 N", {"grip": (4.0, 5.0), "press": (2.5, 3.5)}),
    Experiment("work twice as fast", {"pace": (1.8, 2.0)}),
)


def next_experiment(
    given: Problem,
    cause: Values,
    partners: Sequence[tuple[str, ...]],
    behind: Sequence[float],
    properties: np.ndarray,
    bank: Bank,
    seed: int,
    actual: Actual | None = None,
    temperature: float = 1.0,
) -> dict[str, Any] | None:
    """The experiment that tells most partners from the cause by ENOUGH nats; None where none tells any.

    `cause` holds the parameters of each effect that acts, `partners` the explanations that cannot be told
    from them and `behind` [nats, tempered] how far each of those is behind; `properties` (objects, 3) what is
    thought of the blocks, `actual` what was measured of them; `temperature` that of the evidence. What is
    told stands in `separates`, the least gain of it beside.
    """
    frame = given.frame
    if not (properties > LEAST).all():
        return None
    blocks = {n: Block(*map(float, p)) for n, p in zip(frame.task.objects, properties, strict=True)}

    def forecast(experiment: Experiment) -> np.ndarray:
        known = _measured(blocks) if experiment.measured else actual
        try:
            gains = _gains(given, experiment, blocks, cause, partners, bank, seed, known)
        except (InputError, ValueError):  # this rig or these blocks do not allow it
            return np.zeros(len(partners))
        return gains * frame.num_trials / temperature

    trust = trusted(forecast(USUAL), np.asarray(behind))
    chosen, told = EXPERIMENTS[0], dict[tuple[str, ...], float]()
    for experiment in EXPERIMENTS:
        if experiment.measured and actual:
            continue
        gains = trust * forecast(experiment)
        sure = {p: g for p, g in zip(partners, gains, strict=True) if g > ENOUGH}
        if len(sure) > len(told):
            chosen, told = experiment, sure
        if len(told) == len(partners):
            break
    if not told:
        return None
    return {
        "do": chosen.do,
        "separates": sorted({*cause, *(name for each in told for name in each)}),
        "expected_gain_nats": float(min(told.values())),
        "task": task_table(frame.task),
        "operator": {k: list(v) for k, v in chosen.operator.items()},
    }


def trusted(forecast: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Share (0 to 1) of a forecast [nats] that is to be expected, from what was forecast of recordings like
    those at hand and by how much partners are `behind` in them."""
    return np.where(forecast > TIE, np.clip((behind + TIE) / np.maximum(forecast, TIE), 0.0, 1.0), 1.0)


def _measured(blocks: Blocks) -> Actual:
    """What a balance and calipers say of blocks."""
    return {
        n: {"weight": (b.weight, 5e-4), "width": (b.width, 1e-4), "height": (b.height, 1e-4)}
        for n, b in blocks.items()
    }


def _gains(
    given: Problem,
    experiment: Experiment,
    blocks: Blocks,
    truth: Values,
    partners: Sequence[tuple[str, ...]],
    bank: Bank,
    seed: int,
    actual: Actual | None,
) -> np.ndarray:
    """How much worse than the cause every partner fits one trial of the experiment, less its form [nats]."""
    frame = given.frame
    task, rig = frame.task, frame.rig
    seeds = [seed + 77 + k for k in range(TRIALS)]
    simulated = performed(task, rig, [blocks] * TRIALS, seeds, truth, OperatorSettings(**experiment.operator))
    trials = [recorded(s, task, rig, truth) for s in simulated]
    aligned = align(trials, task, rig)
    asked = problem(build(trials, aligned, rig), bank.noise, actual)
    healthy = fit(asked, [Start((), neutral(asked))])[0]
    own = _cost(asked, healthy, truth, tuple(truth))
    delays = [v for name in DELAYING & truth.keys() for v in truth[name].values()]
    short = brief(delays, float(np.median(np.diff(asked.frame.world.t[0]))))
    off = [form_share(truth, names, short) * (healthy.cost - own) for names in partners]
    gains = np.array([_cost(asked, healthy, truth, names) - own for names in partners])
    return (gains - np.maximum(off, 0.0)) / asked.frame.num_trials


def _cost(asked: Problem, healthy: Fitted, truth: Values, names: tuple[str, ...]) -> float:
    """What effects leave when fitted together, those that scatter on top of those that shift.

    What the causes have in common with the truth starts from there: only what else they have is sought.
    """
    shifting = tuple(sorted(deterministic(names)))
    shared = tuple(n for n in shifting if n in truth)
    found = fit(asked, [Start(shared, _at(asked, truth))])[0] if shared else healthy
    if shared != shifting:
        found = best_fits(asked, [shifting], healthy, [found])[0]
    scattering = [s for s in spreads(asked, found) if s.effect in names]
    return found.cost - sum(s.evidence for s in scattering)


def _at(asked: Problem, truth: Values) -> np.ndarray:
    """All coordinates, neutral but for the parameters of the truth."""
    u = neutral(asked)
    for slot in slots(asked.num_properties)[0]:
        for j, p in enumerate(slot.effect.parameters):
            value = truth.get(slot.effect.name, {}).get(p.name)
            if value is not None:
                u[slot.start + j] = p.coordinate(value)
    return u
