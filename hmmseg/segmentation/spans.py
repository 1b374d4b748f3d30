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
    """A time [s] at which a boundary may lie, with the probability that it lies nearby."""

    time: float
    probability: float


@dataclass(frozen=True)
class Question:
    """The boundary of a trial whose label would be most informative.

    `subtask`: the one that begins there. `gain`: expected reduction of entropy [nats].
    """

    trial: str
    subtask: str
    gain: float


@dataclass(frozen=True)
class Span:
    """Half-open interval [start, end) [s] of one subtask.

    Start and end are posterior medians and may lie between samples; the end of one span is the start of the
    next. `*_sd`: posterior standard deviations [s]; `*_90`: central 90 % intervals [s] (of width 0 at the
    first and last time of the recording). `alternatives`: all places where the start may lie, most probable
    first; empty if there is only one.
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
        """Such as `carry block1`."""
        return labelled(self.subtask, self.object)

    def to_json(self) -> dict[str, Any]:
        """The entry of one segment in the JSON of `segment`."""
        document = asdict(self)
        if not self.alternatives:
            del document["alternatives"]
        return document


def spans_between(
    steps: Sequence[Subtask], edges: Sequence[float], sds: Sequence[float],
    intervals: Sequence[tuple[float, ...]],
) -> tuple[Span, ...]:  # fmt: skip
    """Spans of subtasks (num_steps) between edges [s] with their sds and intervals (num_steps + 1 each)."""
    ends = [each for row in (edges, sds, intervals) for each in (row[:-1], row[1:])]
    return tuple(Span(s.name, s.object, s.state, *rest) for s, *rest in zip(steps, *ends, strict=True))


@dataclass(frozen=True)
class Failure:
    """The first subtask (0-based index in the task's order) that the recording does not show.

    `repetition`: number, from 1, of the round of a repeated task; None for a single round.
    """

    index: int
    subtask: str
    object: str | None
    reason: str
    repetition: int | None = None

    @property
    def label(self) -> str:
        """Such as `carry block1`."""
        return labelled(self.subtask, self.object)

    def __str__(self) -> str:
        number = "" if self.repetition is None else f"repetition {self.repetition}: "
        return f"does not fit its task at {self.label}: {number}{self.reason}"

    def to_json(self) -> dict[str, Any]:
        """The entry `failed` of one trial."""
        document = asdict(self)
        if self.repetition is None:
            del document["repetition"]
        return document


@dataclass(frozen=True, repr=False)
class Segmentation(Tabled):
    """Spans of one trial; `failed` if the recording does not fit its task.

    `log_evidence` is None for methods without a likelihood. For a repeated task, `repetitions` is the number
    of rounds recorded and `failures` lists all failing rounds, `failed` being the first. `recorded` is what
    `plot` draws: the signals of a block task's trial, or the trial itself for a plain ordered task. `remarks`
    state what in the rig the recording contradicts or leaves open. `question`: the most informative label of
    this trial, if its boundaries may lie elsewhere.
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

    def to_json(self) -> dict[str, Any]:
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
        """One row a subtask: name, object, state, start and end [s] with their uncertainties."""
        import pandas as pd

        return pd.DataFrame([span.to_json() for span in self.spans])

    def tables(self) -> list[Any]:
        """The spans, one a row."""
        return [spans_table(self)]

    def words(self) -> str:
        """Where it does not fit its task."""
        return str(self.failed or "")

    def plot(self, path: str | Path | None = None) -> list[Any]:
        """Plot signals over the coloured subtasks, and save the figure if a path is given; returns the axes.

        ValueError if the segmentation does not keep its recording.
        """
        if self.recorded is None:
            raise ValueError("this segmentation keeps no recording to plot")
        from hmmseg.plot.spans import draw_channels, draw_signals

        draw = draw_signals if hasattr(self.recorded, "grip") else draw_channels
        return draw(self.recorded, self, None if path is None else Path(path))


def most_telling(segmentations: Sequence[Segmentation]) -> Question | None:
    """The most informative label over all trials; None if no boundary is ambiguous."""
    questions = [s.question for s in segmentations if s.question is not None]
    return max(questions, key=lambda question: question.gain, default=None)


def known(
    file: str, rate: float, shown: Iterable[Subtask], edges: Iterable[float], recorded: Any = None
) -> Segmentation:
    """A segmentation known exactly: subtasks `shown` between `edges` [s] (one more), without uncertainty."""
    times = [float(edge) for edge in edges]
    spans = spans_between(list(shown), times, [0.0] * len(times), [(edge, edge) for edge in times])
    return Segmentation(file, rate, None, spans, recorded=recorded)


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
    """One row a trial: whether it fits its task, or where it fails."""
    rows = [(Path(s.file).name, f"{s.rate:.4g} Hz", str(len(s.spans)), str(s.failed or "yes"))
            for s in segmentations]  # fmt: skip
    heads = ("trial", "rate", "subtasks", "fits its task")
    return listed(f"{len(segmentations)} trials", heads, rows, wraps=True)
