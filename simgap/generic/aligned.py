"""Real and simulated trials of one plain ordered task, cut into the same subtasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.model import SequenceModel
from hmmseg.sequence.segment import segment_sequence

SPREAD = (0.05, 0.95)  # chosen: quantiles whose distance is a channel's scale


@dataclass(frozen=True)
class Cut:
    """A trial and the edges (K + 1,) [s] of its K subtasks. It may go on after the last one."""

    trial: Trial
    edges: np.ndarray


@dataclass(frozen=True)
class Ensembles:
    """Cut trials of both kinds; `channels` are common to all, `subtasks` those that every trial shows."""

    subtasks: tuple[str, ...]
    channels: tuple[str, ...]
    real: tuple[Cut, ...]
    sim: tuple[Cut, ...]
    warnings: tuple[str, ...] = ()


def align(
    real: Sequence[Trial],
    sim: Sequence[Trial],
    task: SequenceTask,
    model: SequenceModel | None = None,
    boundaries: Mapping[str, np.ndarray] | None = None,
) -> Ensembles:
    """Both kinds of trials cut at given boundaries [s] by file, or by the task's HMM.

    Without a model one is learned from all trials together, every channel first brought to the median and
    spread of its own kind: a bias or a gain between the kinds must not displace boundaries. InputError
    where a kind has no complete trial or there are too few trials to know how trials scatter.
    """
    channels = _channels([*real, *sim], task)
    if boundaries is not None:
        made = [Cut(t, _edges(t, boundaries[t.file], task)) for t in (*real, *sim)]
        return _checked(task.sequence, channels, made[: len(real)], made[len(real) :], ())
    both = [*_standardised(real, channels), *_standardised(sim, channels)] if model is None else [*real, *sim]
    given = model or fit_sequence(both, SequenceTask(task.sequence, channels, task.optional))
    found = segment_sequence(both, given.task, given)
    kept = [s for s in found if s.complete]
    seen = tuple(n for k, n in enumerate(task.sequence) if _shown_by_all(kept, task, k))
    cuts: list[list[Cut]] = [[], []]
    warnings = []
    for k, (trial, segmentation) in enumerate(zip((*real, *sim), found, strict=True)):
        if not segmentation.complete:
            warnings.append(f"{trial.name}: does not fit its task and is left out")
            continue
        spans = [s for s in segmentation.spans if s.subtask in seen]
        edges = np.array([spans[0].start, *(s.end for s in spans)])
        cuts[k >= len(real)].append(Cut(trial, edges))
    return _checked(seen, channels, cuts[0], cuts[1], tuple(warnings))


def _shown_by_all(found, task: SequenceTask, k: int) -> bool:
    name = task.sequence[k]
    return name not in task.optional or all(any(s.subtask == name for s in each.spans) for each in found)


def _edges(trial: Trial, inner: np.ndarray, task: SequenceTask) -> np.ndarray:
    whole = len(inner) == len(task.sequence)  # with the end of what is compared
    edges = np.concatenate([trial.t[:1], np.asarray(inner, float), [] if whole else trial.t[-1:]])
    if edges.size != len(task.sequence) + 1 or not (np.diff(edges) > 0).all():
        raise InputError(f"boundaries of {trial.file}", f"found {np.asarray(inner).tolist()}",
                         f"{len(task.sequence) - 1} increasing times within the trial")  # fmt: skip
    return edges


def _checked(subtasks, channels, real: list[Cut], sim: list[Cut], warnings) -> Ensembles:
    for name, cuts in (("real", real), ("simulated", sim)):
        if not cuts:
            raise InputError(f"{name} trials", "none shows the whole task", "at least one")
    if len(real) + len(sim) < 3:
        raise InputError("trials", "one real and one simulated",
                         "more of one kind at least: how trials scatter must be known")  # fmt: skip
    return Ensembles(tuple(subtasks), channels, tuple(real), tuple(sim), tuple(warnings))


def _channels(trials: Sequence[Trial], task: SequenceTask) -> tuple[str, ...]:
    names = task.channels or tuple(n for n in trials[0].channels if all(n in t.channels for t in trials))
    for trial in trials:
        for name in names:
            if name not in trial.channels:
                raise InputError(f"{trial.file}: column {name}", "missing", ", ".join(names))
    if not names:
        raise InputError(trials[0].file, "shares no channel with the other trials", "a common column")
    return names


def _standardised(trials: Sequence[Trial], channels: tuple[str, ...]) -> list[Trial]:
    """Trials whose channels have median 0 and spread 1 over all of them."""
    out: list[dict[str, np.ndarray]] = [{} for _ in trials]
    for name in channels:
        values = np.concatenate([t.channels[name] for t in trials])
        low, middle, high = np.nanquantile(values, (SPREAD[0], 0.5, SPREAD[1]))
        for k, trial in enumerate(trials):
            out[k][name] = (trial.channels[name] - middle) / (high - low or 1.0)
    return [Trial(t.file, t.t, columns) for t, columns in zip(trials, out, strict=True)]
