"""The next experiment: which of a short list would separate the leading cause from its partners.

Every experiment is simulated with the leading cause, and cause and partners are fitted to its recordings. The
expected gain over a partner is by how much it fits worse with properties refitted (Chaloner & Verdinelli,
Statist. Sci. 10, 1995), scaled to the number of trials. Of the experiments that separate most partners the
first of the list is chosen, which relies least on the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from estimation.report import Actual
from hmmseg.errors import InputError
from hmmseg.segmentation.align import align
from simgap.effects import catalogue, forms_of, name_of
from simgap.gap.frame import build
from simgap.gap.problem import fit, neutral, problem
from simgap.gap.search import Search, best_fit
from simgap.gap.simulated import Values, blocks_of, measured_on, performed, recorded
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Blocks
from simgap.world.simulate import task_table

TRIALS = 2  # numerics: simulated trials: where contacts fall between samples is chance
ENOUGH = 5.0  # physics: a definition: nats, the detection floor


@dataclass(frozen=True)
class Experiment:
    """What to do, the operator settings that do it, and whether blocks are measured apart."""

    do: str
    operator: dict[str, tuple[float, float]] = field(default_factory=dict)
    measured: bool = False


# Experiments that rely least on the model come first: fast work relies on it most.
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
    found: Search, cause: Values, partners: Sequence[str], seed: int, actual: Actual | None = None
) -> dict[str, Any] | None:
    """Choose the experiment that separates most partners from the cause by ENOUGH nats.

    Args:
        found: The search.
        cause: Parameters of each effect that acts, as the interface names them.
        partners: Effects to be separated from it.
        seed: Of the simulated trials.
        actual: Measured properties.

    Returns:
        The document's entry: `separates` lists the cause and the partners separated from it, and
        `expected_gain_nats` is the smallest of their gains. None if no experiment separates any.
    """
    try:
        blocks = blocks_of(found)
    except ValueError:
        return None
    chosen, separated = EXPERIMENTS[0], dict[str, float]()
    for experiment in EXPERIMENTS:
        if experiment.measured and actual:
            continue
        try:
            gains = _gains(found, experiment, blocks, cause, partners, seed, actual)
        except (InputError, ValueError, KeyError):  # cannot be simulated on this rig
            continue
        sure = {p: g for p, g in gains.items() if g > ENOUGH}
        if len(sure) > len(separated):
            chosen, separated = experiment, sure
        if len(separated) == len(partners):
            break
    if not separated:
        return None
    return {
        "do": chosen.do,
        "separates": sorted({*cause, *separated}),
        "expected_gain_nats": float(min(separated.values())),
        "task": task_table(found.problem.frame.task),
        "operator": {k: list(v) for k, v in chosen.operator.items()},
    }


def _gains(
    found: Search, experiment: Experiment, blocks: Blocks, cause: Values, partners: Sequence[str], seed: int,
    actual: Actual | None,
) -> dict[str, float]:  # fmt: skip
    """How much worse each partner fits than the cause [nats], for as many trials as were recorded."""
    frame = found.problem.frame
    seeds = [seed + 77 + k for k in range(TRIALS)]
    done = performed(
        frame.task, frame.rig, [blocks] * TRIALS, seeds, cause, OperatorSettings(**experiment.operator)
    )
    trials = [recorded(s, frame.task, frame.rig, cause) for s in done]
    known = _measured(blocks) if experiment.measured else measured_on(blocks, actual)
    planned = problem(build(align(trials, frame.task, frame.rig)), known)
    healthy = fit(planned, (), neutral(planned))

    def cost(name: str) -> float:
        if catalogue()[name].correct is None:
            raise ValueError("what only scatters is not fitted")
        return min(best_fit(planned, key, healthy).cost for key in forms_of(name_of(name)))

    own = min(cost(name) for name in cause)
    return {p: (cost(p) - own) * frame.num_trials / TRIALS for p in partners}


def _measured(blocks: Blocks) -> Actual:
    """Properties of blocks as a balance and calipers measure them."""
    return {
        n: {"weight": (b.weight, 5e-4), "width": (b.width, 1e-4), "height": (b.height, 1e-4)}
        for n, b in blocks.items()
    }
