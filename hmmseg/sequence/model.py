"""The fitted model of a plain ordered task, its file, and the test whether a trial follows the task.

Two scores of a trial are compared with those of the training trials: the log evidence of switching freely
among the same states over that of the forced order, and minus the log evidence of the forced order per cell.
A subtask squeezed to almost nothing did not happen either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hmm import dense as ergodic
from hmmseg.hmm.inference import align
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.io.formats.npz import unpack
from hmmseg.io.task import SequenceTask
from hmmseg.robust import NORMAL
from hmmseg.segmentation.spans import Failure
from hmmseg.sequence.emissions import LEAST_CELLS, Detectors, StudentEmissions, transitions, weigh
from hmmseg.sequence.features import FeatureMap, SequenceFeatures
from hmmseg.tables import Tabled, listed

if TYPE_CHECKING:
    from rich.table import Table

FORMAT = "hmmseg.sequence-model/3"
INDEPENDENT = 250.0  # chosen: independent observations to which the evidence of one trial is coarsened
WIDTHS = 6.0  # chosen: a score that exceeds the usual by this many widths is a misfit
LEAST_WIDTH = (2.0, 0.02)  # chosen: nats for the first score, nats per cell for the second
FEW = 4.0  # chosen: trials; the usual width of n trials is widened by the factor 1 + FEW / n
SQUEEZED = 0.03  # chosen: share of the typical duration


@dataclass(frozen=True)
class NamedCourse:
    """A course (`hmmseg.sequence.courses`) on the fine grid, and which of its changes are the boundaries."""

    probability: float  # of the course
    emissions: StudentEmissions
    mean_cells: np.ndarray
    naming: np.ndarray  # (num_boundaries, num_changes) probability that boundary b is change j
    shift: np.ndarray  # (num_boundaries, num_changes) [cells] mean lag of labelled boundaries behind it

    def align(self, trial: SequenceFeatures) -> AlignmentPosterior:
        """Posterior alignment; InfeasibleAlignment for fewer cells than stretches."""
        count = len(self.mean_cells)
        law = transitions(self.mean_cells, np.ones(count), [False] * count)
        return align([self.emissions.log_likelihoods(trial.values)], [law])[0]


@dataclass(frozen=True, repr=False)
class SequenceModel(Tabled):
    """Emissions and durations of a plain ordered task, from `fit_sequence`.

    Unlabelled trials may show one more state than the task names, the `settled` one: recordings run on after
    the last event, and what follows (decay, rest) belongs to the last subtask but looks different. Unless two
    trials are fully labelled, the model keeps several `courses`, and boundaries are mixtures over them.
    """

    task: SequenceTask
    mapping: FeatureMap
    emissions: StudentEmissions
    mean_cells: np.ndarray  # (num_states,) mean duration [cells]
    presence: np.ndarray  # (num_states,) probability of an optional state
    settled: bool
    detectors: Detectors | None
    typical: np.ndarray  # (num_states,) median duration [cells] in the training trials
    # (2, 2) median and width of the two scores of `misfit` in the training trials
    usual_scores: np.ndarray = field(default_factory=lambda: np.tile([0.0, np.inf], (2, 1)))
    courses: tuple[NamedCourse, ...] = ()  # alternative alignments, most probable first
    # (num_boundaries,) [cells] scale of the Laplace law of boundaries about their change
    lag: np.ndarray = field(default_factory=lambda: np.empty(0))
    # (num_boundaries,) probability that the boundaries of this model are the task's
    sure: np.ndarray = field(default_factory=lambda: np.empty(0))

    def tables(self) -> list[Table]:
        """Its states: how long they usually last, and the probability that they begin where found."""
        sure, rows = ["", *(f"{p:.2f}" for p in self.sure)], []
        for k, name in enumerate(self.task.sequence):
            there = f"{100 * self.presence[k]:.0f} %" if name in self.task.optional else "always"
            lasts = f"{self.typical[k] * self.mapping.step:.3g}"
            rows.append((name, lasts, there, sure[k] if k < len(sure) else ""))
        heads = ("state", "usually lasts [s]", "occurs", "begins here with probability")
        return [listed(f"a model of {', '.join(self.mapping.channels)}", heads, rows, wraps=True)]

    def align(self, trial: SequenceFeatures) -> AlignmentPosterior:
        """Posterior alignment; InfeasibleAlignment for fewer cells than subtasks."""
        law = transitions(self.mean_cells, self.presence, optional_states(self.task, self.settled))
        ll, chain = weigh(trial.values, self.emissions, law, self.detectors)
        return align([ll], [chain])[0]

    def misfit(self, trial: SequenceFeatures) -> tuple[np.ndarray, np.ndarray, AlignmentPosterior]:
        """How badly a trial fits, without boundary templates, which free switching has no counterpart of.

        Evidence of models learned without labels is coarsened (`hmmseg.sequence.courses`).

        Returns:
            (2,) log evidence of free switching over forced order [nats], and minus log evidence per cell;
            the log-likelihoods (num_cells, num_states); the alignment.
        """
        model, temper = replace(self, detectors=None), self.emissions.temper
        if self.detectors is None:
            temper *= INDEPENDENT / (INDEPENDENT + temper * trial.values.size)
            model = replace(model, emissions=replace(self.emissions, temper=temper))
        ll, alignment = model.emissions.log_likelihoods(trial.values), model.align(trial)
        better = ergodic.log_evidence(*self._free(ll)) - alignment.log_evidence
        return np.array([better, -alignment.log_evidence / len(ll)]), ll, alignment

    def _free(self, log_likelihoods: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arguments of the ergodic model: the same durations, and any state next."""
        num_states = log_likelihoods.shape[1]
        leave = 1 / np.maximum(self.mean_cells, LEAST_CELLS)
        transition = np.tile(np.log(leave / max(num_states - 1, 1))[:, None], (1, num_states))
        np.fill_diagonal(transition, np.log1p(-leave) if num_states > 1 else 0.0)
        return log_likelihoods, np.full(num_states, -np.log(num_states)), transition

    def failure(self, trial: SequenceFeatures) -> Failure | None:
        """The first subtask at which a trial leaves the task, the first of all cropped or not; else None."""
        names, optional = self.task.sequence, optional_states(self.task, settled=False)
        scores, ll, alignment = self.misfit(trial)
        cells = alignment.smoothed.sum(axis=0)
        for k in range(1, len(names)):
            if not optional[k] and cells[k] < SQUEEZED * self.typical[k]:  # it has a cell in any alignment
                return Failure(k, names[k], None, "is squeezed to almost nothing: it does not happen")
        worse, poorer = (scores - self.usual_scores[:, 0]) / self.usual_scores[:, 1]
        if worse > WIDTHS:
            k, reason = _first_departure(ergodic.viterbi(*self._free(ll)).path, names, optional)
            return Failure(k, names[k], None, reason)
        if poorer > WIDTHS:
            excess = ll.max(1) - np.median(ll.max(1))
            at = int(np.argmin(np.convolve(excess, np.ones(9), "same")))
            k = min(int(alignment.path[at]), len(names) - 1)
            return Failure(k, names[k], None, "looks like nothing the model has learned")
        return None


def optional_states(task: SequenceTask, settled: bool) -> list[bool]:
    """Which states of the model may be skipped."""
    return [name in task.optional for name in task.sequence] + [True] * settled


def usual_misfit(scores: Sequence[np.ndarray]) -> np.ndarray:
    """Median and width (2, 2) of each score [(2,), ...] over the training trials, wider if they are few."""
    center = np.median(scores, axis=0)
    width = NORMAL * np.median(np.abs(np.array(scores) - center), axis=0)
    return np.column_stack([center, np.maximum(width, LEAST_WIDTH) * (1 + FEW / len(scores))])


def _first_departure(path: np.ndarray, names: Sequence[str], optional: Sequence[bool]) -> tuple[int, str]:
    """The subtask at which the freely switching path first breaks the order, and why."""
    at = -1
    for state in np.minimum(path[np.r_[True, np.diff(path) != 0]], len(names) - 1):
        missing = [k for k in range(at + 1, state) if not optional[k]]
        if missing:
            return missing[0], f"is passed over: {names[state]} comes first"
        if state < at:
            return at, f"is broken off: {names[state]} comes again"
        at = int(state)
    missing = [k for k in range(at + 1, len(names)) if not optional[k]]
    return (missing[0], "never happens") if missing else (at, "does not keep the task's order")


def save_model(model: SequenceModel, path: str | Path) -> None:
    """Write a model to an NPZ file, which `load_model` reads."""

    def parts(thing: Any, prefix: str = "") -> dict[str, Any]:
        table = dict(vars(thing))
        if "emissions" in table:
            emissions = table.pop("emissions")
            table |= {"loc": emissions.loc, "spread": emissions.scale, "temper": emissions.temper}
        return {f"{prefix}{key}": value for key, value in table.items()}

    table = {"format": FORMAT, **parts(model.task), **parts(model.mapping), **parts(model)}
    table |= {"misfit": table.pop("usual_scores"), "courses": len(model.courses)}
    for i, course in enumerate(model.courses):
        table |= parts(course, f"courses.{i}.")
    if model.detectors is not None:
        table |= parts(model.detectors, "detectors.")
    for key in ("task", "mapping", "detectors"):
        del table[key]
    with open(path, "wb") as file:
        np.savez(file, **{key: np.asarray(value) for key, value in table.items()})  # type: ignore[arg-type]


def load_model(path: str | Path, task: SequenceTask) -> SequenceModel:
    """Read a model.

    Args:
        path: a file written by `save_model`.
        task: the task for which it was learned.

    Returns:
        The model.

    Raises:
        InputError: the file is no model, or was learned for another task.
    """
    where, expected = str(path), "a model written by `hmmseg fit`"
    try:
        table = unpack(Path(path))
        found = str(table.get("format", "no format"))
        if found != FORMAT:
            raise InputError(where, f"has format {found!r}", repr(FORMAT))
    except FileNotFoundError:
        raise InputError(where, "no such file", expected) from None
    except InputError:
        raise
    except Exception:  # damaged archives raise errors of zipfile, zlib, NumPy and others
        raise InputError(where, "cannot be read", expected) from None
    try:
        return _model_of(table, task, where)
    except KeyError as error:
        raise InputError(where, f"lacks {error.args[0]}", "a complete model") from None
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError):  # OverflowError: an infinite count
        raise InputError(where, "holds values that no model has", expected) from None


def _model_of(table: dict[str, np.ndarray], task: SequenceTask, where: str) -> SequenceModel:
    for key in ("sequence", "optional"):
        learned, wanted = tuple(np.ravel(table.get(key, [])).tolist()), getattr(task, key)
        if learned != wanted:
            raise InputError(where, f"was learned for {key} {list(learned)}", f"the task's {list(wanted)}")
    channels = tuple(table["channels"].tolist())
    if task.channels is not None and set(task.channels) != set(channels):
        raise InputError(where, f"was learned from channels {list(channels)}",
                         f"the task's {list(task.channels)}")  # fmt: skip

    def take(key: str, *shape: int) -> np.ndarray:
        array = table[key]
        if array.shape != shape or not np.isfinite(array).all():
            problem = "is not finite" if array.shape == shape else f"has shape {array.shape}"
            raise InputError(where, f"{key} {problem}", f"finite numbers of shape {shape}")
        return array

    def emissions(prefix: str, count: int) -> StudentEmissions:
        loc, spread = (take(f"{prefix}{key}", count, num_features) for key in ("loc", "spread"))
        return StudentEmissions(loc, spread, float(take(f"{prefix}temper")))

    settled = bool(table["settled"])
    num_states, num_features = len(task.sequence) + settled, 2 * len(channels)
    boundaries, detectors, courses = len(task.sequence) - 1, None, []
    if any(name.startswith("detectors.") for name in table):
        half = int(take("detectors.half"))
        windows = boundaries, 2 * half, len(channels)
        detectors = Detectors(
            half, take("detectors.mean", *windows), take("detectors.spread", *windows),
            take("detectors.usual", len(channels)), take("detectors.jitter", boundaries),
            float(take("detectors.weight")), float(take("detectors.state_weight")),
        )  # fmt: skip
    for i in range(int(take("courses"))):
        prefix, count = f"courses.{i}.", len(table[f"courses.{i}.mean_cells"])
        probability = float(take(f"{prefix}probability"))
        if not 0 <= probability <= 1:
            raise InputError(where, f"a course has probability {probability}", "a number from 0 to 1")
        of_changes = (take(f"{prefix}{key}", boundaries, count - 1) for key in ("naming", "shift"))
        cells = take(f"{prefix}mean_cells", count)
        courses.append(NamedCourse(probability, emissions(prefix, count), cells, *of_changes))
    mapping = FeatureMap(channels, float(take("step")), int(take("window")), take("center", num_features),
                         take("scale", num_features))  # fmt: skip
    of_states = {key: take(key, num_states) for key in ("mean_cells", "presence", "typical")}
    of_boundaries = {key: take(key, boundaries) if courses else table[key] for key in ("lag", "sure")}
    return SequenceModel(
        task, mapping, emissions("", num_states), settled=settled, detectors=detectors,
        usual_scores=take("misfit", 2, 2), courses=tuple(courses), **of_states, **of_boundaries,
    )  # fmt: skip
