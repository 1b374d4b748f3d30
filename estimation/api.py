"""The public function `identify`: it takes paths, tables and arrays as well as what was read already."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from estimation.identification import Identification, identify_aligned
from hmmseg.api import Source, align
from hmmseg.segmentation.align import AlignedTrials


def identify(
    trials: Source | Sequence[Source] | AlignedTrials,
    task: Source = None,
    rig: Source = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Identification:
    """Weight, width, height and friction of every block, with uncertainties, all trials pooled.

    `trials`, `task`, `rig`: paths, tables or what the readers give; or what `hmmseg.align` gave, alone.
    `progress(steps_done, steps_at_most)` is called while sampling. InputError for input at fault; trials
    that do not fit the task are reported in the result, not raised.

    >>> from estimation import identify
    >>> from hmmseg import example_folder
    >>> folder = example_folder()
    >>> found = identify(folder / "trial_01.csv", folder / "task.toml", folder / "rig.toml")
    >>> weight = found.of("block1", "weight")  # posterior draws, N
    >>> f"{weight.mean():.2f} N"
    '0.34 N'
    >>> found.of("blok1", "weight")
    Traceback (most recent call last):
    KeyError: "no 'blok1'; expected one of block1, block2 (did you mean block1?)"
    """
    if isinstance(trials, AlignedTrials):
        return identify_aligned(trials, seed, progress)
    return identify_aligned(align(trials, task, rig), seed, progress)
