"""Results of a segmentation: spans of subtasks with uncertain boundaries, as data and as tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.table import Table

from hmmseg.contact.decompose import Subtask, labelled
from hmmseg.tables import Tabled, listed


@dataclass(frozen=True)
class Place:
    """A time [s] at which a boundary may lie, and the probability that it lies thereabouts."""

    time: float
    probability: float


@dataclass(frozen=True)
class Question:
    """The one boundary of a trial whose label would decide most.

    `subtask`: the one that begins there. `gain`: expected reduction of entropy [nats].
    """

    trial: str
    subtask: str
    gain: float


@dataclass(frozen=True)
class Span:
    """One subtask's half-open interval [start, end) in s.

    Start and end are posterior medians and may lie between samples; one span's end is the next
    one's start. `*_sd` are posterior standard deviations [s], `*_90` central 90 % intervals [s]
    (of width 0 at the recording's own first and last time). `alternatives`: all places where the start
    may lie, most probable first; empty where there is but one.
    """

    subtask: str
    object: str | None
    state: str
    start: float
    end: float
    start_sd: float
    end_sd: float
    start_90: tuple[float, float]
    end_90: tuple[float, float]
    alternatives: tuple[Place, ...] = ()

    @property
    def label(self) -> str:
        """As `carry block1`."""
        return labelled(self.subtask, self.object)

    def to_json(self) -> dict:
        """The entry of one segment in the JSON of `segment`."""
        document = asdict(self)
        if not self.alternatives:
            del document["alternatives"]
        return document


@dataclass(frozen=True)
class Failure:
    """The first subtask (0-based index in the task's order) that the recording does not show.

    `repetition` (from 1) says in which round of a repeated task; None where it has but one.
    """

    index: int
    subtask: str
    object: str | None
    reason: str
    repetition: int | None = None

    @property
    def label(self) -> str:
        """As `carry block1`."""
        return labelled(self.subtask, self.object)

    def __str__(self) -> str:
        number = "" if self.repetition is None else f"repetition {self.repetition}: "
        return f"does not fit its task at {self.label}: {number}{self.reason}"

    def to_json(self) -> dict:
        """The entry `failed` of one trial."""
        document = asdict(self)
        if self.repetition is None:
            del document["repetition"]
        return document


@dataclass(frozen=True, repr=False)
class Segmentation(Tabled):
    """Spans of one trial; `failed` where the recording does not fit its task.

    `log_evidence` is None from a method that has no likelihood. Of a repeated task, `repetitions` says
    how often the recording shows it and `failures` holds all rounds that do not fit, `failed` the first.
    `recorded` is what `plot` shows: the signals of a block task's trial, the trial itself of a plain
    ordered task. `remarks` say what the recording contradicts in the rig, or leaves open. `question`: the
    label of this trial that would decide most, where its boundaries may lie elsewhere.
    """

    file: str
    rate: float
    log_evidence: float | None
    spans: tuple[Span, ...]
    failed: Failure | None = None
    repetitions: int | None = None
    failures: tuple[Failure, ...] = ()
    recorded: Any = field(default=None, compare=False)
    remarks: tuple[str, ...] = ()
    question: Question | None = None

    @property
    def complete(self) -> bool:
        """Whether the recording shows every subtask of its task, in order."""
        return self.failed is None

    def to_json(self) -> dict:
        """The entry of one trial in the JSON of `segment`."""
        document = {
            "file": self.file,
            "rate": self.rate,
            "log_evidence": self.log_evidence,
            "complete": self.complete,
            "segments": [span.to_json() for span in self.spans],
        }
        if self.failed is not None:
            document["failed"] = self.failed.to_json()
        if self.repetitions is not None:
            document["repetitions"] = self.repetitions
            document["failures"] = [failure.to_json() for failure in self.failures]
        return document

    def to_pandas(self) -> Any:
        """One row a subtask: name, object, state, start and end [s] with their uncertainty."""
        import pandas as pd

        return pd.DataFrame([span.to_json() for span in self.spans])

    def tables(self) -> list[Any]:
        """The spans, one a row."""
        return [spans_table(self)]

    def words(self) -> str:
        """Where it does not fit its task."""
        return str(self.failed or "")

    def plot(self, path: str | Path | None = None) -> list[Any]:
        """Signals over the coloured subtasks; the axes, one a signal. Saved where a path is given.

        ValueError where the segmentation does not keep what was recorded.
        """
        if self.recorded is None:
            raise ValueError("this segmentation keeps no recording to plot")
        from hmmseg.plot.spans import draw_channels, draw_signals

        draw = draw_signals if hasattr(self.recorded, "grip") else draw_channels
        return draw(self.recorded, self, None if path is None else Path(path))


def most_telling(segmentations: Sequence[Segmentation]) -> Question | None:
    """The one label, over all trials, that would decide most; None where nothing is open."""
    questions = [s.question for s in segmentations if s.question is not None]
    return max(questions, key=lambda question: question.gain, default=None)


def known(
    file: str, rate: float, shown: Iterable[Subtask], edges: Iterable[float],
    failed: Failure | None = None, recorded: Any = None,
) -> Segmentation:  # fmt: skip
    """The subtasks `shown` between `edges` [s] (one more) that are known: without uncertainty or evidence."""
    times = [float(edge) for edge in edges]
    spans = tuple(
        Span(s.name, s.object, s.state, a, b, 0.0, 0.0, (a, a), (b, b))
        for s, a, b in zip(shown, times[:-1], times[1:], strict=True)
    )
    return Segmentation(file, rate, None, spans, failed, recorded=recorded)


def spans_table(segmentation: Segmentation) -> Table:
    """The spans of one trial for people to read."""
    elsewhere, rows = any(span.alternatives for span in segmentation.spans), []
    for span in segmentation.spans:
        low, high = span.start_90
        interval = f"{low:.3f} to {high:.3f}" if high > low else ""
        places = ", ".join(f"{p.time:.3f} ({100 * p.probability:.0f} %)" for p in span.alternatives)
        row = [span.label, span.state, f"{span.start:.3f}", interval, f"{span.end:.3f}"]
        rows.append([*row, *[places] * elsewhere])
    heads = ["subtask", "state", "start [s]", "90 % interval", "end [s]"]
    title = f"{Path(segmentation.file).name} ({segmentation.rate:.4g} Hz)"
    heads += ["could as well be at [s]"] * elsewhere
    return listed(title, heads, rows, ("start [s]", "end [s]"), wraps=True)


def trials_table(segmentations: Sequence[Segmentation]) -> Table:
    """One row a trial: whether it fits its task, or where it does not."""
    rows = [(Path(s.file).name, f"{s.rate:.4g} Hz", str(len(s.spans)), str(s.failed or "yes"))
            for s in segmentations]  # fmt: skip
    heads = ("trial", "rate", "subtasks", "fits its task")
    return listed(f"{len(segmentations)} trials", heads, rows, wraps=True)
