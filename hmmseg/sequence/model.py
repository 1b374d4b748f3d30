"""What is learned of a plain ordered task, and its file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hmm.alignment import Alignment, Bands, align_many
from hmmseg.io.formats.npz import unpack
from hmmseg.io.task import SequenceTask
from hmmseg.sequence.detectors import Detectors
from hmmseg.sequence.emissions import StudentEmissions
from hmmseg.sequence.features import FeatureMap, Features
from hmmseg.sequence.transitions import Transitions, transitions

FORMAT = "hmmseg.sequence-model/2"


@dataclass(frozen=True)
class SequenceModel:
    """Emissions and durations of a plain ordered task, from `fit_sequence`.

    There is one state a subtask and, where unlabelled trials show it, one more, `settled`: they run on after
    the last event, and what then happens (decay, rest) belongs to the last subtask but looks
    different. `mean_cells`, `presence` (num_states,): mean duration in cells and the probability
    that an optional state occurs. `typical` (num_states,) is the median duration [cells] in the
    trials learned from, `misfit` (2, 2) their median and spread of the two scores of
    hmmseg.sequence.misfit. `others` are further readings of the same trials where no labels decide
    (hmmseg.sequence.readings), with what is left of probability for this one.
    """

    task: SequenceTask
    mapping: FeatureMap
    emissions: StudentEmissions
    mean_cells: np.ndarray
    presence: np.ndarray
    settled: bool
    detectors: Detectors | None
    typical: np.ndarray
    misfit: np.ndarray
    others: tuple[Alternative, ...] = ()

    @property
    def readings(self) -> list[tuple[float, SequenceModel]]:
        """All readings with their probabilities, this one first."""
        rest = [(other.probability, other.model) for other in self.others]
        return [(1.0 - sum(p for p, _ in rest), replace(self, others=())), *rest]

    @property
    def transitions(self) -> Transitions:
        """Transitions between neighbouring cells, without boundary detectors."""
        return transitions(self.mean_cells, self.presence, optional_states(self.task, self.settled))

    def weights(self, trial: Features) -> tuple[np.ndarray, Bands]:
        """Log-likelihoods (num_cells, num_states) and transition bands of one trial."""
        return weights(trial.values, self.emissions, self.detectors, self.transitions.bands)

    def align(self, trials: list[Features]) -> list[Alignment]:
        """Posterior alignments; InfeasibleAlignment for a trial with fewer cells than subtasks."""
        parts = [self.weights(trial) for trial in trials]
        law = self.transitions
        return align_many([p[0] for p in parts], [p[1] for p in parts],
                          log_initial=law.log_initial, log_final=law.log_final)  # fmt: skip


@dataclass(frozen=True)
class Alternative:
    """Another way to read the trials that a model was learned from, as a model without others."""

    probability: float
    model: SequenceModel


def optional_states(task: SequenceTask, settled: bool) -> list[bool]:
    """Which states of the model may be skipped."""
    return [name in task.optional for name in task.sequence] + [True] * settled


def weights(values: np.ndarray, emissions: StudentEmissions, detectors: Detectors | None,
            bands: Bands) -> tuple[np.ndarray, Bands]:  # fmt: skip
    """Log-likelihoods and bands of one trial; detectors make advancing depend on time."""
    ll = emissions.log_likelihoods(values)
    if detectors is None:
        return ll, bands
    ratios = detectors.log_ratios(values[:, : detectors.mean.shape[2]])
    return combined(ll, ratios, detectors, bands)


def combined(log_likelihoods: np.ndarray, log_ratios: np.ndarray, detectors: Detectors,
             bands: Bands) -> tuple[np.ndarray, Bands]:  # fmt: skip
    """Weighted sum of state and boundary emissions; who skips subtasks crosses their boundaries."""
    crossed = np.pad(np.cumsum(detectors.weight * log_ratios, axis=1), ((0, 0), (1, 0)))
    jumps = [
        band + crossed[:, d:] - crossed[:, : crossed.shape[1] - d] for d, band in enumerate(bands[1:], 1)
    ]
    return detectors.state_weight * log_likelihoods, (bands[0], *jumps)


def save_model(model: SequenceModel, path: str | Path) -> None:
    """Write a model to an NPZ file."""
    parts = _table(model)
    for i, other in enumerate(model.others):
        parts |= {f"others.{i}.{key}": value for key, value in _table(other.model).items()}
    with open(path, "wb") as file:
        np.savez(
            file, format=FORMAT, sequence=np.array(model.task.sequence),
            optional=np.array(model.task.optional, dtype=str), channels=np.array(model.mapping.channels),
            step=model.mapping.step, window=model.mapping.window, center=model.mapping.center,
            scale=model.mapping.scale, others=np.array([other.probability for other in model.others]),
            **parts,  # type: ignore[arg-type]
        )  # fmt: skip


def _table(model: SequenceModel) -> dict[str, np.ndarray]:
    """What one reading has of its own."""
    detectors = {} if model.detectors is None else {
        f"detectors.{name}": np.asarray(value) for name, value in vars(model.detectors).items()}  # fmt: skip
    return {
        "loc": model.emissions.loc, "spread": model.emissions.scale,
        "temper": np.asarray(model.emissions.temper),
        "mean_cells": model.mean_cells, "presence": model.presence, "settled": np.asarray(model.settled),
        "typical": model.typical, "misfit": model.misfit, **detectors,
    }  # fmt: skip


def load_model(path: str | Path, task: SequenceTask) -> SequenceModel:
    """Read a model; InputError where the file is no model or was learned for another task."""
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
        others = []
        for i, probability in enumerate(np.ravel(table["others"])):
            prefix = f"others.{i}."
            own = {key.removeprefix(prefix): value for key, value in table.items() if key.startswith(prefix)}
            shared = {
                key: table[key]
                for key in ("sequence", "optional", "channels", "step", "window", "center", "scale")
            }
            other = _from_table(shared | own, task)
            _check(other, shared | own, task, f"{where}, reading {i + 2}")
            if not 0 <= probability <= 1:
                raise InputError(where, f"a reading has probability {probability}", "a number from 0 to 1")
            others.append(Alternative(float(probability), other))
    except KeyError as error:
        raise InputError(where, f"lacks {error.args[0]}", "a complete model") from None
    except InputError:
        raise
    except (TypeError, ValueError):
        raise InputError(where, "holds values that no model has", "a model written by `hmmseg fit`") from None
    return replace(model, others=tuple(others))


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
    return SequenceModel(
        task, mapping, StudentEmissions(table["loc"], table["spread"], float(table["temper"])),
        table["mean_cells"], table["presence"], bool(table["settled"]), detectors,
        table["typical"], table["misfit"],
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
    if model.detectors is not None:
        boundaries, channels = len(task.sequence) - 1, num_features // 2
        windows = (boundaries, 2 * model.detectors.half, channels)
        shapes |= {"detectors.mean": windows, "detectors.spread": windows,
                   "detectors.usual": (channels,), "detectors.jitter": (boundaries,)}  # fmt: skip
    for key, shape in shapes.items():
        if table[key].shape != shape or not np.isfinite(table[key]).all():
            raise InputError(where, f"{key} has shape {table[key].shape}", f"finite numbers of shape {shape}")
