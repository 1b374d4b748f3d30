"""The public functions `simulate` and `diagnose`, which accept paths and tables as well as parsed objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from estimation.identification import Identification
from estimation.report import parse_actual, read_actual
from hmmseg.api import Source, align, block_task
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.align import AlignedTrials
from simgap.gap.diagnose import Diagnosis
from simgap.gap.diagnose import diagnose as diagnose_blocks
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Block, Blocks, blocks_of, paper_blocks, read_properties
from simgap.world.simulate import SimulatedTrial, simulate_trials


def simulate(
    task: Source,
    rig: Source,
    properties: Identification | Mapping[str, Block | Mapping[str, Any]] | str | Path | None = None,
    trials: int = 1,
    seed: int = 0,
    operator: OperatorSettings | None = None,
) -> list[SimulatedTrial]:
    """Simulate trials of the virtual model, performed by a simulated operator, with their truth.

    Args:
        task: A task of blocks: a path, a dict, or the result of `Task.read`.
        rig: The nominal hand: a path, a dict, or the result of `Rig.read`.
        properties: An identification, blocks or tables of their properties [SI] by name, or a file
            (identify's JSON, an `actual.toml`); the paper's blocks by default.
        trials: Number of trials.
        seed: Seed of the first trial; each further trial has the next one.
        operator: Ranges from which motions are drawn.

    Returns:
        The trials, each with true boundaries [s] and blocks.

    Raises:
        InputError: A source is invalid, or the hand cannot reach.

    >>> from hmmseg import example_folder
    >>> from simgap import simulate
    >>> made = simulate(example_folder() / "task.toml", example_folder() / "rig.toml", seed=1)[0]
    >>> made.boundaries.size, made.blocks["block1"].weight
    (8, 0.343)
    """
    order, hand = block_task(task), Rig.read(rig)
    blocks = _blocks(properties, order)
    seeds = range(seed, seed + trials)
    return simulate_trials(order, hand, [blocks] * trials, list(seeds), operator)


def diagnose(
    trials: Source | Sequence[Source] | AlignedTrials | Identification,
    task: Source = None,
    rig: Source = None,
    actual: str | Path | dict[str, Any] | None = None,
    effects: Sequence[str] = (),
    healthy: Source | Sequence[Source] | AlignedTrials | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Where recordings differ from the virtual model, which effect causes it, and how far the gap shrinks.

    Args:
        trials: One source or several (paths, tables, results of `Trial.read`), or the result of
            `hmmseg.align` or `identify`, whose alignment is then used and which needs no `task` or `rig`.
        task: A path, a dict, or the result of `Task.read`.
        rig: The nominal hand: a path, a dict, or the result of `Rig.read`.
        actual: Properties measured independently of the trials: a path or a dict.
        effects: Causes to impose instead of choosing them.
        healthy: Recordings of the same task and hand as the null, in place of the stated noise.
        seed: Seed of all random draws.
        progress: Called with a description of each stage.

    Returns:
        Verdict, causes with their parameters, where the gap is, and its shrinkage on held-out trials.

    Raises:
        InputError: A source is invalid, an effect is unknown or cannot act, or no trial fits its task.
    """
    identified = None
    if isinstance(trials, Identification):
        aligned, identified = trials.aligned, trials.centres
    else:
        aligned = trials if isinstance(trials, AlignedTrials) else align(trials, task, rig)
    order = aligned.task
    if isinstance(actual, dict):
        measured = parse_actual(actual, order.objects)
    else:
        measured = None if actual is None else read_actual(actual, order.objects)
    if healthy is not None and not isinstance(healthy, AlignedTrials):
        healthy = align(healthy, order if task is None else task, aligned.rig)
    return diagnose_blocks(
        aligned, measured, tuple(effects), seed, progress, healthy=healthy, identified=identified
    )


def _blocks(properties: Any, task: BlockTask) -> Blocks:
    """Blocks for every object of a task, from any of the sources that `simulate` accepts."""
    if properties is None:
        return paper_blocks(task)
    if isinstance(properties, Identification):
        return blocks_of(properties.to_json()["properties"], task, "properties")
    if isinstance(properties, str | Path):
        return read_properties(properties, task)
    if isinstance(properties, Mapping) and any(isinstance(entry, Mapping) for entry in properties.values()):
        return blocks_of(properties, task, "properties")
    return properties
