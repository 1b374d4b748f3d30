"""The public function `identify`: it takes paths, tables and arrays as well as what was read already."""

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

    Args:
        trials: One source or several (paths, tables, results of `Trial.read`), or the result of
            `hmmseg.align`, which needs no `task` or `rig`.
        task: A path, a dict, or the result of `Task.read`.
        rig: The nominal hand: a path, a dict, or the result of `Rig.read`.
        seed: Seed of all random draws.
        progress: Called with (steps done, steps at most) while sampling.

    Returns:
        Posterior draws [N, m, 1], intervals, reasons for what is undetermined, and checks. Trials that do
        not fit the task are reported there.

    Raises:
        InputError: A source is invalid.

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
