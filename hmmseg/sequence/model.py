"""What is learned of a plain ordered task, its file, and whether a trial follows it.

Two scores of a trial are compared with those of the trials that the model was learned from: how much better
free switching among the same states explains it than the forced order does, and how poorly even the forced
order does per cell. Besides, a subtask squeezed to almost nothing did not happen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hmm import dense as ergodic
from hmmseg.hmm.chain import Chain
from hmmseg.hmm.inference import align
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.io.formats.npz import unpack
from hmmseg.io.task import SequenceTask
from hmmseg.robust import NORMAL
from hmmseg.segmentation.spans import Failure
from hmmseg.sequence.emissions import Detectors, StudentEmissions, detecting, transitions
from hmmseg.sequence.features import FeatureMap, SequenceFeatures
from hmmseg.tables import Tabled

FORMAT = "hmmseg.sequence-model/3"
INDEPENDENT = 250.0  # chosen: independent observations that one trial's fit is judged by in the limit of many


@dataclass(frozen=True, repr=False)
class SequenceModel(Tabled):
    """Emissions and durations of a plain ordered task, from `fit_sequence`.

    There is one state a subtask and, where unlabelled trials show it, one more, `settled`: they run on after
    the last event, and what then happens (decay, rest) belongs to the last subtask but looks
    different. `mean_cells`, `presence` (num_states,): mean duration in cells and the probability
    that an optional state occurs. `typical` (num_states,) is the median duration [cells] in the
    trials learned from, `usual_scores` (2, 2) their median and width of the two scores of
    `misfit_scores`. Where not all labels of two trials were given, `courses` are the ways to align the
    trials and to name their changes, and boundaries are as uncertain as all of them together; `lag`
    (num_boundaries,) [cells] is how far they lie off such a change (the scale of a Laplace law), `sure`
    (num_boundaries,) the probability that the boundaries of this model are the task's.
    """

    task: SequenceTask
    mapping: FeatureMap
    emissions: StudentEmissions
    mean_cells: np.ndarray
    presence: np.ndarray
    settled: bool
    detectors: Detectors | None
    typical: np.ndarray
    usual_scores: np.ndarray
    courses: tuple[NamedCourse, ...] = ()
    lag: np.ndarray = field(default_factory=lambda: np.empty(0))
    sure: np.ndarray = field(default_factory=lambda: np.empty(0))

    @property
    def transitions(self) -> Chain:
        """Transitions between neighbouring cells, without boundary detectors."""
        return transitions(self.mean_cells, self.presence, optional_states(self.task, self.settled))

    def tables(self) -> list[Any]:
        """Its states: how long they usually last, and how surely the model has their beginnings."""
        from rich.table import Table

        table = Table(title=f"a model of {', '.join(self.mapping.channels)}", title_justify="left")
        for head in ("state", "usually lasts [s]", "occurs", "begins here with probability"):
            table.add_column(head)
        surely = ["", *(f"{p:.2f}" for p in self.sure)]
        for k, name in enumerate(self.task.sequence):
            there = f"{100 * self.presence[k]:.0f} %" if name in self.task.optional else "always"
            lasts = f"{self.typical[k] * self.mapping.step:.3g}"
            table.add_row(name, lasts, there, surely[k] if k < len(surely) else "")
        return [table]

    def without_templates(self, trial: SequenceFeatures) -> SequenceModel:
        """The model that tells whether a trial fits: templates have no counterpart in free switching; where
        no labels taught it, with evidence coarsened (hmmseg.sequence.courses)."""
        if self.detectors is not None:
            return replace(self, detectors=None)
        temper = self.emissions.temper
        coarsened = temper * INDEPENDENT / (INDEPENDENT + temper * trial.values.size)
        return replace(self, emissions=replace(self.emissions, temper=coarsened))

    def align(self, trials: list[SequenceFeatures]) -> list[AlignmentPosterior]:
        """Posterior alignments; InfeasibleAlignment for a trial with fewer cells than subtasks."""
        law, d = self.transitions, self.detectors
        lls = [self.emissions.log_likelihoods(trial.values) for trial in trials]
        if d is None:
            return align(lls, [law] * len(lls))
        chains = [detecting(law, d.crossing(trial.values)) for trial in trials]
        return align([d.state_weight * ll for ll in lls], chains)


@dataclass(frozen=True)
class NamedCourse:
    """A way to align trials, by an ordered model of more stretches than states, and what its changes are.

    `probability`: of the course; `naming` (num_boundaries, num_changes): that boundary b is change j of
    it, which sums to 1 over j. `shift` (num_boundaries, num_changes) [cells]: by how much labels say that
    boundary b comes after change j.
    """

    probability: float
    emissions: StudentEmissions
    mean_cells: np.ndarray
    naming: np.ndarray
    shift: np.ndarray

    def align(self, trial: SequenceFeatures) -> AlignmentPosterior:
        """Posterior alignment; InfeasibleAlignment for a trial with fewer cells than stretches."""
        count = len(self.mean_cells)
        law = transitions(self.mean_cells, np.ones(count), [False] * count)
        ll = self.emissions.log_likelihoods(trial.values)
        return align([ll], [law])[0]


def optional_states(task: SequenceTask, settled: bool) -> list[bool]:
    """Which states of the model may be skipped."""
    return [name in task.optional for name in task.sequence] + [True] * settled


def save_model(model: SequenceModel, path: str | Path) -> None:
    """Write a model to an NPZ file."""
    detectors = {} if model.detectors is None else {
        f"detectors.{name}": np.asarray(value) for name, value in vars(model.detectors).items()}  # fmt: skip
    courses = {
        f"courses.{i}.{key}": value
        for i, course in enumerate(model.courses)
        for key, value in {
            "probability": np.asarray(course.probability), "loc": course.emissions.loc,
            "spread": course.emissions.scale, "temper": np.asarray(course.emissions.temper),
            "mean_cells": course.mean_cells, "naming": course.naming, "shift": course.shift,
        }.items()
    }  # fmt: skip
    with open(path, "wb") as file:
        np.savez(
            file, format=FORMAT, sequence=np.array(model.task.sequence),
            optional=np.array(model.task.optional, dtype=str), channels=np.array(model.mapping.channels),
            step=model.mapping.step, window=model.mapping.window, center=model.mapping.center,
            scale=model.mapping.scale, loc=model.emissions.loc, spread=model.emissions.scale,
            temper=model.emissions.temper, mean_cells=model.mean_cells, presence=model.presence,
            settled=model.settled, typical=model.typical, misfit=model.usual_scores,
            lag=model.lag, sure=model.sure,
            courses=len(model.courses), **detectors, **courses,  # type: ignore[arg-type]
        )  # fmt: skip


def load_model(path: str | Path, task: SequenceTask) -> SequenceModel:
    """Read a model.

    Args:
        path: a file written by `save_model`.
        task: for which it was learned.

    Returns:
        The model.

    Raises:
        InputError: the file is no model, or was learned for another task.
    """
    where = str(path)
    try:
        table = unpack(Path(path))
    except FileNotFoundError:
        raise InputError(where, "no such file", "a model written by `hmmseg fit`") from None
    except InputError:
        raise
    except Exception:  # of what a damaged archive may raise there is no list: zipfile's, zlib's, NumPy's
        raise InputError(where, "cannot be read", "a model written by `hmmseg fit`") from None
    found = str(table.get("format", "no format"))
    if found != FORMAT:
        raise InputError(where, f"has format {found!r}", repr(FORMAT))
    try:
        model = _from_table(table, task)
        _check(model, table, task, where)
    except KeyError as error:
        raise InputError(where, f"lacks {error.args[0]}", "a complete model") from None
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError):  # the last of an infinite count
        raise InputError(where, "holds values that no model has", "a model written by `hmmseg fit`") from None
    return model


def _from_table(table: dict[str, np.ndarray], task: SequenceTask) -> SequenceModel:
    mapping = FeatureMap(tuple(table["channels"].tolist()), float(table["step"]), int(table["window"]),
                         table["center"], table["scale"])  # fmt: skip
    detectors = None
    if any(name.startswith("detectors.") for name in table):
        part = {name: table[f"detectors.{name}"] for name in Detectors.__dataclass_fields__}
        detectors = Detectors(
            int(part["half"]), part["mean"], part["spread"], part["usual"], part["jitter"],
            float(part["weight"]), float(part["state_weight"]),
        )  # fmt: skip
    courses = []
    for i in range(int(table["courses"])):
        part = {name: table[f"courses.{i}.{name}"] for name in
                ("probability", "loc", "spread", "temper", "mean_cells", "naming", "shift")}  # fmt: skip
        emissions = StudentEmissions(part["loc"], part["spread"], float(part["temper"]))
        courses.append(NamedCourse(float(part["probability"]), emissions, part["mean_cells"],
                                   part["naming"], part["shift"]))  # fmt: skip
    return SequenceModel(
        task, mapping, StudentEmissions(table["loc"], table["spread"], float(table["temper"])),
        table["mean_cells"], table["presence"], bool(table["settled"]), detectors,
        table["typical"], table["misfit"], tuple(courses), table["lag"], table["sure"],
    )  # fmt: skip


def _check(model: SequenceModel, table: dict[str, np.ndarray], task: SequenceTask, where: str) -> None:
    for key in ("sequence", "optional"):
        learned, wanted = tuple(np.ravel(table.get(key, [])).tolist()), getattr(task, key)
        if learned != wanted:
            raise InputError(where, f"was learned for {key} {list(learned)}", f"the task's {list(wanted)}")
    if task.channels is not None and set(task.channels) != set(model.mapping.channels):
        raise InputError(where, f"was learned from channels {list(model.mapping.channels)}",
                         f"the task's {list(task.channels)}")  # fmt: skip
    num_states = len(task.sequence) + model.settled
    num_features = 2 * len(model.mapping.channels)
    shapes = {
        "center": (num_features,), "scale": (num_features,), "loc": (num_states, num_features),
        "spread": (num_states, num_features), "mean_cells": (num_states,), "presence": (num_states,),
        "typical": (num_states,), "misfit": (2, 2),
    }  # fmt: skip
    boundaries = len(task.sequence) - 1
    if model.detectors is not None:
        channels = num_features // 2
        windows = (boundaries, 2 * model.detectors.half, channels)
        shapes |= {"detectors.mean": windows, "detectors.spread": windows,
                   "detectors.usual": (channels,), "detectors.jitter": (boundaries,)}  # fmt: skip
    if model.courses:
        shapes |= {"lag": (boundaries,), "sure": (boundaries,)}
    for i, course in enumerate(model.courses):
        count = len(course.mean_cells)
        shapes |= {f"courses.{i}.{name}": shape for name, shape in {
            "probability": (), "loc": (count, num_features), "spread": (count, num_features),
            "mean_cells": (count,), "naming": (boundaries, count - 1), "shift": (boundaries, count - 1),
        }.items()}  # fmt: skip
        if not 0 <= course.probability <= 1:
            raise InputError(where, f"a course has probability {course.probability}", "a number from 0 to 1")
    for key, shape in shapes.items():
        if table[key].shape != shape or not np.isfinite(table[key]).all():
            raise InputError(where, f"{key} has shape {table[key].shape}", f"finite numbers of shape {shape}")


WIDTHS = 6.0  # chosen: a trial this many widths outside the others does not fit
LEAST_WIDTH = (2.0, 0.02)  # chosen: nats for the first score, nats per cell for the second
FEW = 4.0  # chosen: trials; the usual width of scores is widened by one over their number, times this
MEASURABLE = 20.0  # chosen: cells a subtask usually lasts, for two cells to be too few
SQUEEZED = 0.03  # chosen: of the typical duration


def misfit_scores(
    log_likelihoods: np.ndarray, mean_cells: np.ndarray, alignment: AlignmentPosterior
) -> np.ndarray:
    """(2,): log evidence of free switching over forced order [nats], minus log evidence per cell."""
    return np.array([
        ergodic.log_evidence(*_free(log_likelihoods, mean_cells)) - alignment.log_evidence,
        -alignment.log_evidence / len(log_likelihoods),
    ])  # fmt: skip


def usual_misfit(per_trial: Sequence[np.ndarray]) -> np.ndarray:
    """(2, 2): median and width of each score over the trials learned from.

    The width of few trials is uncertain itself and widened by 1 + FEW / their number.
    """
    table = np.array(per_trial)
    center = np.median(table, 0)
    width = NORMAL * np.median(np.abs(table - center), 0)
    widened = np.maximum(width, LEAST_WIDTH) * (1 + FEW / len(table))
    return np.column_stack([center, widened])


def find_failure(names: Sequence[str], optional: Sequence[bool], typical: np.ndarray, usual: np.ndarray,
                 log_likelihoods: np.ndarray, mean_cells: np.ndarray,
                 alignment: AlignmentPosterior) -> Failure | None:  # fmt: skip
    """The first subtask at which the trial leaves its task; None where it fits.

    `usual` (2, 2): what `usual_misfit` gave of the trials learned from.
    The first subtask may be cropped to any length, so it is never called squeezed.
    """
    for k in range(1, len(names)):
        cells = float(alignment.smoothed[:, k].sum())
        if not optional[k] and typical[k] >= MEASURABLE and cells < max(SQUEEZED * typical[k], 2.0):
            return Failure(k, names[k], None, "is squeezed to almost nothing: it does not happen")
    worse, poorer = (misfit_scores(log_likelihoods, mean_cells, alignment) - usual[:, 0]) / usual[:, 1]
    if worse > WIDTHS:
        path = ergodic.viterbi(*_free(log_likelihoods, mean_cells)).path
        k, reason = _first_departure(path, names, optional)
        return Failure(k, names[k], None, reason)
    if poorer > WIDTHS:
        excess = log_likelihoods.max(1) - np.median(log_likelihoods.max(1))
        k = min(int(alignment.path[np.argmin(np.convolve(excess, np.ones(9), "same"))]), len(names) - 1)
        return Failure(k, names[k], None, "looks like nothing the model has learned")
    return None


def _free(log_likelihoods: np.ndarray, mean_cells: np.ndarray) -> tuple:
    """Arguments of the ergodic model: same durations, any state next."""
    num_states = log_likelihoods.shape[1]
    leave = 1 / np.maximum(mean_cells, 1.5)
    transition = np.tile(np.log(leave / max(num_states - 1, 1))[:, None], (1, num_states))
    np.fill_diagonal(transition, np.log1p(-leave) if num_states > 1 else 0.0)
    return log_likelihoods, np.full(num_states, -np.log(num_states)), transition


def _first_departure(path: np.ndarray, names: Sequence[str], optional: Sequence[bool]) -> tuple[int, str]:
    """Where the freely switching path first breaks the order."""
    runs = np.minimum(path[np.r_[True, np.diff(path) != 0]], len(names) - 1)
    at = -1
    for state in runs:
        missing = [k for k in range(at + 1, state) if not optional[k]]
        if missing:
            return missing[0], f"is passed over: {names[state]} comes first"
        if state < at:
            return at, f"is broken off: {names[state]} comes again"
        at = int(state)
    missing = [k for k in range(at + 1, len(names)) if not optional[k]]
    return (missing[0], "never happens") if missing else (at, "does not keep the task's order")
